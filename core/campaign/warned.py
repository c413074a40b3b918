"""Warnings of worker processes: kept there, sent with the results, and shown by the main process as its own."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from typing import Any, TypeVar

R = TypeVar("R")

Warned = tuple[str, type[Warning], str, int]
"""Text, category, file and line of a warning."""

Registry = dict[str | tuple[str, type[Warning], int], int]
"""What was shown, as `warnings` notes it."""

_kept: list[Warned] = []


def keep() -> None:
    """In a new worker process: keep warnings for the main process instead of writing them to stderr."""
    warnings.showwarning = _keep


def call(function: Callable[..., R], *arguments: Any) -> tuple[R, list[Warned]]:
    """The result of a call, and the warnings that this process has kept; none where it shows them itself."""
    result = function(*arguments)
    found = _kept.copy()
    del _kept[: len(found)]
    return result, found


def show(found: Sequence[Warned], shown: Registry) -> None:
    """Warn here. ``shown``: a registry of what was shown; a text in it is not shown again, unless the user's filters say so."""
    for text, category, file, line in found:
        warnings.warn_explicit(text, category, file, line, registry=shown)


def _keep(message: Warning | str, category: type[Warning], filename: str, lineno: int, *more: Any, **others: Any) -> None:
    known = category if category.__module__ == "builtins" else UserWarning  # others may not be importable there
    _kept.append((str(message), known, filename, lineno))
