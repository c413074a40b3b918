"""The mistakes of a table, told together, each with its line of the file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager

from ..errors import InputError

MOST_TOLD = 12
"""Mistakes that are told one by one; the others are counted."""


class TableError(InputError):
    """Error about the mistakes of a table.

    Parameters
    ----------
    place
        The file, as messages call it.
    mistakes
        (line of the file, cause, cure) of each; line 0: the table as a whole.
    """

    def __init__(self, place: str, mistakes: Sequence[tuple[int, str, str]]) -> None:
        self.mistakes = sorted(mistakes, key=lambda mistake: mistake[0])
        told = [
            (f"line {line}: {text}" if line else text, cure) for line, text, cure in self.mistakes
        ]
        if len(told) == 1:
            (message, cure), *_ = told
        else:
            message = f"{len(told)} mistakes"
            lines = [f"{text}; {cure}" if cure else text for text, cure in told[:MOST_TOLD]]
            cure = "\n".join(
                [*lines, *([f"and {len(told) - MOST_TOLD} more"] if len(told) > MOST_TOLD else [])]
            )
        super().__init__(message, place=place, cure=cure)


class Mistakes:
    """Collects the mistakes of one table."""

    def __init__(self, place: str) -> None:
        self.place = place
        self._found: list[tuple[int, str, str]] = []

    def add(self, line: int, message: str, cure: str) -> None:
        """Note one. ``line``: of the file; 0: the table as a whole."""
        self._found.append((line, message, cure))

    @contextmanager
    def noted(self) -> Iterator[None]:
        """Context that notes a `TableError` of its body, and goes on behind it."""
        try:
            yield
        except TableError as err:
            self._found += err.mistakes

    def tell(self) -> None:
        """Raise `TableError` where there are any."""
        if self._found:
            raise TableError(self.place, self._found)
