"""What to write into a pipeline file, and what to type, for a setting."""

from __future__ import annotations

import shlex
from collections.abc import Mapping

from .settings import overrides


def fragment(setting: Mapping[str, str], heading: str) -> str:
    """YAML of the setting: parameters under the step they belong to, to be merged into the file's steps by hand.

    A comment line holds the same for the command line.
    """
    steps: dict[str, list[str]] = {}
    top = []
    for key, value in setting.items():
        step, dot, parameter = key.rpartition(".")
        if dot:
            steps.setdefault(step, []).append(f"{parameter}: {_in_flow(value)}")
        else:
            top.append(f"{key}: {value}")
    lines = [f"# {line}" for line in (heading, f"on the command line: {arguments(setting)}")]
    lines += [*top, "operators:"] if steps else top
    for step, parameters in steps.items():
        lines.append(f"  - {_name(step)}: {{{', '.join(parameters)}}}{_which(step)}")
    return "\n".join(lines) + "\n"


def arguments(setting: Mapping[str, str]) -> str:
    """``--set`` arguments for a shell."""
    return " ".join(f"--set {shlex.quote(text)}" for text in overrides(setting))


def _in_flow(value: str) -> str:
    return value if not set(value) & set(",[]{}#:") else repr(value)


def _name(step: str) -> str:
    base, _, number = step.rpartition(".")
    return base if number.isdigit() else step


def _which(step: str) -> str:
    number = step.rpartition(".")[2]
    return f"  # the {number}. of that name" if number.isdigit() else ""
