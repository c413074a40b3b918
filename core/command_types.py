"""Types of command-line options that commands share. Only click is imported with this module."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import click

if TYPE_CHECKING:
    _Integer = click.ParamType[int]
    _Anything = click.ParamType[Any]
else:
    _Integer = _Anything = click.ParamType  # an older click's has no type of its values

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
                f"{value!r} has no unit and would be bytes; write e.g. 1GB or 500MiB", param, ctx
            )
        if not 1 <= size < 2**63:
            self.fail(f"{value!r} is not a size a computer has", param, ctx)
        return int(size)


class Share(_Anything):
    """``3/8``, the third of eight shares, as (3, 8)."""

    name = "K/N"

    def convert(
        self, value: Any, param: click.Parameter | None, ctx: click.Context | None
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
