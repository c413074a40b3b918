"""Errors that a user can mend. Each names the place, the cause and the cure; the CLI prints them
without a traceback.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager


class ZondaError(Exception):
    """Base of every error that is the user's to mend (exit code 2 at the command line).

    Parameters
    ----------
    message
        The cause, one sentence, lower case, no full stop.
    place
        Where: a file, a key, an operator, an observation. May be empty.
    cure
        What to do about it. May be empty.
    """

    def __init__(self, message: str, *, place: str = "", cure: str = "") -> None:
        super().__init__(message)
        self.message = message
        self.place = place
        self.cure = cure

    def __str__(self) -> str:
        text = f"{self.place}: {self.message}" if self.place else self.message
        return "\n  = ".join([text, *self.cure.splitlines()])


class InputError(ZondaError):
    """A file or array given by the user cannot be used (missing, unreadable, wrong unit, NaN, no
    WCS ...).
    """


class OutputError(ZondaError):
    """A product cannot be written (folder not writable, disk full ...)."""


class PointingError(ZondaError):
    """The telescope cannot point there (target never up, outside the elevation limits ...)."""


class PipelineError(ZondaError):
    """The operators of a pipeline do not fit together (missing input, wrong order, too little
    memory ...).
    """


@contextmanager
def within(place: str) -> Iterator[None]:
    """Errors that are raised inside name this place before their own; those with places in a file
    (`diagnostics`) keep them.
    """
    try:
        yield
    except ZondaError as err:
        if not hasattr(err, "diagnostics"):
            err.place = f"{place}: {err.place}" if err.place else place
        raise


@contextmanager
def placed(place: str) -> Iterator[None]:
    """Errors that are raised inside and name no place are given this one."""
    try:
        yield
    except ZondaError as err:
        err.place = err.place or place
        raise


class PluginError(ZondaError):
    """A fault in a plugin, not in the pipeline that uses it."""
