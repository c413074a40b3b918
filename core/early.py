"""Helper processes of operators, started before the pipeline file is parsed.

An operator registers a function in the entry-point group ``zonda.processes`` under its class name;
what the function returns has ``close()``. The function is called where a pipeline file seems to use
the operator and there is a second processor. It should import next to nothing: the process gets
ready while this one imports, reads and plans. The operator asks for the process with `take`; one
that nobody took is closed.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from contextlib import suppress
from typing import Any, Protocol, TypeVar

from .discovery import RAISED, discover

GROUP = "zonda.processes"


class Process(Protocol):
    """A helper process."""

    def close(self) -> None:
        """End it."""


P = TypeVar("P", bound=Process)

_waiting: dict[Callable[[], Any], Any] = {}


def begin(path_or_name: str) -> None:
    """Start the helper processes of a pipeline file's operators, as far as they can be found out.
    Always call `end`.
    """
    from .configuration.locate import locate, read

    with suppress(*RAISED):  # no such file, a broken plugin: whoever needs it says so
        path = locate(path_or_name)
        if not path.is_file():  # a pipe can be read only once
            return
        text = read(path)
        if re.search(r"^campaign\s*:", text, re.MULTILINE):  # other processes do the work
            return
        for found in discover(GROUP):
            if re.search(
                rf"^\s*-\s+(['\"]?){re.escape(found.name)}\1\s*(:|#|$)", text, re.MULTILINE
            ):
                with suppress(*RAISED):
                    start = found.load()
                    _waiting[start] = start()


def take(start: Callable[[], P]) -> P:
    """What ``start`` returned when it was called by `begin`, or returns now; the caller closes
    it.
    """
    return _waiting.pop(start) if start in _waiting else start()


def end() -> None:
    """Close the helper processes that nobody took."""
    while _waiting:
        with suppress(*RAISED):
            _waiting.popitem()[1].close()
