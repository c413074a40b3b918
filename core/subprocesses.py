"""Processes that zonda starts: they find the modules that this one finds, and none in the folder
they happen to run in.

``python -m`` and ``-c`` look into the current folder first: a user's ``zonda.py`` or
``multiprocessing.py`` there would run.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from types import ModuleType

SAFE = "PYTHONSAFEPATH"


def command(module: str, function: str, *arguments: object) -> list[str]:
    """Command line of a Python process that calls a function, which returns the exit status (None:
    0), with this one's path.

    ``arguments`` are written down: text, numbers. Raises OSError where this is no Python
    interpreter that could be started again.
    """
    if not sys.executable:
        raise OSError("this is no Python interpreter that could be started again")
    call = f"sys.exit({function}(*{arguments!r}))"
    return [
        sys.executable,
        "-P",
        "-c",
        f"import sys; sys.path[:] = {sys.path!r}; from {module} import {function}; {call}",
    ]


@contextmanager
def safe_path() -> Iterator[None]:
    """Processes that others start in the body (`multiprocessing`) do not look into the current
    folder either.
    """
    before = os.environ.get(SAFE)
    os.environ[SAFE] = "1"
    try:
        yield
    finally:
        restore(before)


def restore(before: str | None) -> None:
    """Give ``PYTHONSAFEPATH`` the value it had, also in a child that was started by `safe_path`."""
    if before is None:
        os.environ.pop(SAFE, None)
    else:
        os.environ[SAFE] = before


@contextmanager
def without_script() -> Iterator[None]:
    """Processes that `multiprocessing` starts in the body do not import the user's script again:
    they need nothing of it.

    So a script that begins a campaign needs no ``if __name__ == "__main__"``.
    """
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script
