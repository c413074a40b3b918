"""Options that commands share, types of options, and the request of ``zonda run``.

Only click is imported with this module.
"""

from __future__ import annotations

import shlex
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    _Integer = click.ParamType[int]
    _Anything = click.ParamType[Any]
else:
    _Integer = _Anything = click.ParamType  # an older click's has no type of its values


@dataclass(frozen=True)
class RunRequest:
    """The arguments and options of ``zonda run``."""

    pipelines: tuple[str, ...]
    settings: tuple[str, ...]
    keep: tuple[str, ...]
    drop: tuple[str, ...]
    only: tuple[str, ...]
    prune: bool | None
    output: Path | None
    threads: int | None
    memory: int | None
    verbose: bool
    verify: bool
    engine: str | None
    workers: int | None
    scheduler: str | None
    share: tuple[int, int] | None

    @property
    def is_campaign(self) -> bool:
        """True if the arguments make a campaign, whatever the file says."""
        return bool(
            len(self.pipelines) > 1 or self.engine or self.workers or self.scheduler or self.share
        )

    @property
    def command(self) -> str:
        """The command that makes the same products elsewhere: what changes no result (threads,
        memory, folder) is left out.
        """
        options = [
            ("--set", self.settings),
            ("--keep", self.keep),
            ("--drop", self.drop),
            ("--only", self.only),
        ]
        parts = [part for option, texts in options for text in texts for part in (option, text)]
        pruning = {None: [], True: ["--prune"], False: ["--no-prune"]}[self.prune]
        return shlex.join(["zonda", "run", *self.pipelines, *parts, *pruning])


_UNITS = {
    "": 1,
    "B": 1,
    **{
        f"{p}{i}B": b ** (k + 1) for k, p in enumerate("KMGT") for i, b in (("", 1000), ("I", 1024))
    },
}

LEAST_BYTES = 1_000_000
"""A smaller number without a unit was not meant to be bytes."""


class Bytes(_Integer):
    """A size such as 4GB or 500MiB, in bytes."""

    name = "SIZE"

    def convert(self, value: Any, param: click.Parameter | None, ctx: click.Context | None) -> int:
        """Bytes; fails with what was expected."""
        if isinstance(value, int):
            return value
        text = str(value).strip()
        number = text.rstrip("abcdefghijklmnopqrstuvwxyzABCDEFGHIJKLMNOPQRSTUVWXYZ ")
        try:
            size = float(number) * _UNITS[text[len(number) :].strip().upper()]
        except (ValueError, KeyError):
            self.fail(f"{value!r} is not a size; write e.g. 4GB or 500MiB", param, ctx)
        if number == text and size < LEAST_BYTES:
            self.fail(
                f"{value!r} has no unit and would be bytes; write e.g. 1GB or 500MiB",
                param,
                ctx,
            )
        if not 1 <= size < 2**63:
            self.fail(f"{value!r} is not a size a computer has", param, ctx)
        return int(size)


class Share(_Anything):
    """``3/8``, the third of eight shares, as (3, 8)."""

    name = "K/N"

    def convert(
        self,
        value: Any,
        param: click.Parameter | None,
        ctx: click.Context | None,
    ) -> tuple[int, int]:
        """(K, N); fails with what was expected."""
        first, _, second = str(value).partition("/")
        if not (first.isdecimal() and second.isdecimal() and 1 <= int(first) <= int(second)):
            self.fail(
                f"{value!r} is no share of the tasks; write K/N with K from 1 to N, e.g. 3/8",
                param,
                ctx,
            )
        return int(first), int(second)


set_option = click.option(
    "--set",
    "settings",
    multiple=True,
    metavar="KEY=VALUE",
    help="Change one value, e.g. Step.parameter='0.5 Hz' or seed=8.",
)
keep_option = click.option(
    "--keep",
    multiple=True,
    metavar="NAME",
    help="Simulate this effect or operator in full.",
)
drop_option = click.option(
    "--drop",
    multiple=True,
    metavar="NAME",
    help="Leave this effect or operator out, whatever that costs.",
)
only_option = click.option(
    "--only",
    multiple=True,
    metavar="COMPONENT",
    help="Simulate this component (e.g. sky) alone.",
)

_ON_ENGINE = (
    click.option(
        "--threads",
        type=click.IntRange(min=1),
        metavar="N",
        help="Threads (of each task); results do not depend on it.  [default: all]",
    ),
    click.option(
        "--memory",
        type=Bytes(),
        metavar="SIZE",
        help=(
            "Most memory to hold, of a campaign all its workers' on this machine (with MPI and Dask"
            " each process's), e.g. 4GB; results do not depend on it.  [default: half of the free]"
        ),
    ),
    click.option(
        "-v",
        "--verbose",
        is_flag=True,
        help="Say all that was counted, chosen and approximated, not only what was lost.",
    ),
    click.option(
        "--engine",
        type=click.Choice(["serial", "processes", "mpi", "dask"]),
        help="Run scans as tasks of a campaign.  [default: as in the file's campaign]",
    ),
    click.option(
        "--workers",
        type=click.IntRange(min=1),
        metavar="N",
        help="Processes of --engine processes.",
    ),
    click.option(
        "--scheduler",
        metavar="ADDRESS",
        help="Of Dask, e.g. tcp://host:8786, or its scheduler file.",
    ),
)


def on_engine(command: Callable[..., Any]) -> Callable[..., Any]:
    """Decorator: options of the commands that run a pipeline, on an engine if asked."""
    for option in reversed(_ON_ENGINE):
        command = option(command)
    return command
