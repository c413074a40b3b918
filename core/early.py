"""Processes that steps want, started before anything of the pipeline file but its text is looked at.

A step names a function in the entry-point group ``zonda.processes`` under its own name; what the function returns has
``close()``. It is called where a pipeline file seems to have that step and there is a second processor, and imports next to
nothing: the process makes itself ready while this one imports, reads and plans. The step asks for it with `take`; what nobody
took is closed.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol, TypeVar

from .discovery import RAISED, discover

GROUP = "zonda.processes"


class Process(Protocol):
    """What runs beside this process."""

    def close(self) -> None:
        """End it."""


P = TypeVar("P", bound=Process)

_waiting: dict[Callable[[], Any], Any] = {}


def begin(path_or_name: str) -> None:
    """Start what the steps of a pipeline file want; nothing where that is not to be had. Call `end` in any case."""
    from .configuration.locate import locate, read

    with suppress(*RAISED):  # no such file, a broken plugin: whoever needs it says so
        path = locate(path_or_name)
        if not path.is_file():  # a pipe can be read only once
            return
        text = read(path)
        if re.search(r"^campaign\s*:", text, re.MULTILINE):  # other processes do the work
            return
        for found in discover(GROUP):
            if re.search(rf"^\s*-\s+(['\"]?){re.escape(found.name)}\1\s*(:|#|$)", text, re.MULTILINE):
                with suppress(*RAISED):
                    start = found.load()
                    _waiting[start] = start()


def take(start: Callable[[], P]) -> P:
    """What ``start`` returned when it was called by `begin`, or returns now; the caller closes it."""
    return _waiting.pop(start) if start in _waiting else start()


def end() -> None:
    """Close what nobody took."""
    while _waiting:
        with suppress(*RAISED):
            _waiting.popitem()[1].close()
