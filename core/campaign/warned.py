"""Warnings of worker processes: kept there, sent with the results, and shown by the main process as
its own.
"""

from __future__ import annotations

import contextlib
import os
import platform
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from typing import Any, TypeVar

R = TypeVar("R")

Warned = tuple[str, type[Warning], str, int]
"""Text, category, file and line of a warning."""

Registry = dict[str | tuple[str, type[Warning], int], int]
"""What was shown, as `warnings` notes it."""

_kept: list[Warned] = []
_lock = threading.Lock()
_at_work: list[Any] = []
"""How this process showed warnings before it kept them, once for each call at work in it."""


def here() -> str:
    """Name of this process."""
    return f"{platform.node()} {os.getpid()}"


def keep() -> None:
    """In a new worker process: keep warnings for the main process instead of writing them to
    stderr.
    """
    warnings.showwarning = _keep


def call(main: str, function: Callable[..., R], *arguments: Any) -> tuple[R, list[Warned]]:
    """The result of a call, and the warnings that this process has kept; none in ``main`` (`here`),
    which shows them itself.
    """
    if here() == main:
        return function(*arguments), []
    with _kept_during():
        result = function(*arguments)
    with _lock:
        found = _kept.copy()
        _kept.clear()
    return result, found


@contextlib.contextmanager
def _kept_during() -> Iterator[None]:
    """Keep the warnings of all threads; as before when the last call in this process is done
    (Dask's may have several).
    """
    with _lock:
        _at_work.append(warnings.showwarning)
        keep()
    try:
        yield
    finally:
        with _lock:
            before = _at_work.pop()
            if not _at_work:
                warnings.showwarning = before


def show(found: Sequence[Warned], shown: Registry) -> None:
    """Warn here. ``shown``: a registry of what was shown; a text in it is not shown again, unless
    the user's filters say so.
    """
    for text, category, file, line in found:
        warnings.warn_explicit(text, category, file, line, registry=shown)


def _keep(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    *more: Any,
    **others: Any,
) -> None:
    known = (
        category if category.__module__ == "builtins" else UserWarning
    )  # others may not be importable there
    _kept.append((str(message), known, filename, lineno))
