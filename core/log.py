"""Counts and figures that the user must know of."""

from __future__ import annotations

import threading
from collections.abc import Iterator


class Log:
    """Counts and figures that the user must know of: what was clipped, dropped, approximated.
    Thread-safe.

    Keys are (who, what): the operator's label and a short phrase with its unit, e.g.
    ``("SkyMap", "samples outside the input map")``.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: dict[tuple[str, str], int] = {}
        self._figures: dict[tuple[str, str], str] = {}
        self._totals: dict[tuple[str, str], int] = {}

    def count(self, who: str, what: str, number: int, of: int = 0) -> None:
        """Add ``number`` to a count (a count of zero is kept: it says that nothing happened);
        ``of``: among how many, where its share is worth telling."""
        with self._lock:
            self._counts[who, what] = self._counts.get((who, what), 0) + int(number)
            if of:
                self._totals[who, what] = self._totals.get((who, what), 0) + int(of)

    def state(self, who: str, what: str, text: str) -> None:
        """Record a figure or a choice as text; the last statement wins."""
        with self._lock:
            self._figures[who, what] = text

    def update(self, other: Log, prefix: str = "", suffix: str = "") -> None:
        """Add another log's counts and statements, ``prefix`` before their operators' labels,
        ``suffix`` behind them.
        """
        for (who, what), number in other._counts.items():
            self.count(prefix + who + suffix, what, number, other._totals.get((who, what), 0))
        for (who, what), text in other._figures.items():
            self.state(prefix + who + suffix, what, text)

    def __iter__(self) -> Iterator[tuple[str, str, str]]:
        """Rows (who, what, value) in a fixed order."""
        with self._lock:
            rows = [(*k, f"{v}") for k, v in self._counts.items()] + [
                (*k, v) for k, v in self._figures.items()
            ]
        return iter(sorted(rows))

    def counts(self) -> list[tuple[str, str, int]]:
        """Counts (who, what, number), sorted."""
        with self._lock:
            return sorted((*k, v) for k, v in self._counts.items())

    def figures(self) -> list[tuple[str, str, str]]:
        """Statements (who, what, text), sorted."""
        with self._lock:
            return sorted((*k, v) for k, v in self._figures.items())

    def totals(self) -> list[tuple[str, str, int]]:
        """Among how many the counts were made that have a share, in a fixed order."""
        with self._lock:
            return sorted((*k, v) for k, v in self._totals.items())

    def told(self) -> Iterator[tuple[str, str, str]]:
        """Rows as `__iter__`, with the share of counts that have one: ``2623184 (20.3 %)``."""
        for who, what, value in self:
            whole = self._totals.get((who, what), 0)
            yield (
                who,
                what,
                f"{value} ({percent(self.get(who, what) / whole)})"
                if whole and self.get(who, what)
                else value,
            )

    def get(self, who: str, what: str) -> int:
        """A count, 0 where there is none."""
        return self._counts.get((who, what), 0)


def percent(share: float, digits: int = 3) -> str:
    """``20.3 %``; never 100 for what is less."""
    return "more than 99.9 %" if 0.9995 < share < 1 else f"{100 * share:.{digits}g} %"
