"""Checks of numerical accuracy: figures measured on this machine against a reference and a limit.

`zonda doctor` runs those that are registered; with `tests/checks/` they make up the tests
(`tests/test_hard_cases.py`) and the published page (`docs/stability.md`). A package adds a `Family`
of its own under the entry-point group ``zonda.checks``:

    checks = Family("receiver")

    @checks.add(CASE, reference="closed form", limit=1e-9, unit="K")
    def time_constant() -> float:
        '''step response of the slowest detector'''
        return largest_error
"""

from __future__ import annotations

import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass

from .discovery import RAISED
from .registry import checks

Measured = float | tuple[float, str]
"""A figure, or a figure and a remark."""


@dataclass(frozen=True)
class Case:
    """A row of the stability matrix: a numerical difficulty, and the error that is accepted."""

    text: str
    acceptance: str


@dataclass(frozen=True)
class Check:
    """One figure of one case.

    Attributes
    ----------
    name
        Unique: family and function.
    what
        What is measured, one line.
    reference
        What it is compared with.
    limit
        Largest figure that passes; 0: exactly nothing.
    unit
        Of the figure and the limit; empty: a ratio or a count.
    measure
        Returns the figure reached.
    """

    case: Case
    name: str
    what: str
    reference: str
    limit: float
    unit: str
    measure: Callable[[], Measured]

    def run(self) -> Result:
        """Measure. A check that raises has failed; the result says with what."""
        start = time.perf_counter()
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("ignore")  # what a hard case warns of is part of the case
                found = self.measure()
        except RAISED as err:  # a check may fail in any way, the others go on
            return Result(
                self,
                math.nan,
                time.perf_counter() - start,
                f"{type(err).__name__}: {err}",
            )
        figure, remark = found if isinstance(found, tuple) else (found, "")
        return Result(self, float(figure), time.perf_counter() - start, remark)


@dataclass(frozen=True)
class Result:
    """Value of a `Check`, the time it took [s], and a remark."""

    check: Check
    figure: float
    seconds: float
    remark: str = ""

    @property
    def passed(self) -> bool:
        """Within the limit; NaN is not."""
        return self.figure <= self.check.limit

    @property
    def reached(self) -> str:
        """The figure with its unit."""
        return quantity(self.figure, self.check.unit)

    @property
    def accepted(self) -> str:
        """The limit with its unit."""
        return quantity(self.check.limit, self.check.unit)


class Family:
    """Checks that belong together; iterating gives them in the order in which they were added."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._checks: list[Check] = []

    def add(
        self,
        case: Case,
        *,
        reference: str,
        limit: float,
        unit: str = "",
    ) -> Callable[[Callable[[], Measured]], Callable[[], Measured]]:
        """Decorator: add a function that returns the figure; the first paragraph of its docstring
        says what it measures.
        """

        def added(function: Callable[[], Measured]) -> Callable[[], Measured]:
            what = " ".join((function.__doc__ or "").split("\n\n")[0].split())
            if not what:
                raise ValueError(f"the check {function.__name__} has no docstring")
            name = f"{self.name}.{function.__name__}"
            self._checks.append(Check(case, name, what, reference, limit, unit, function))
            return function

        return added

    def __iter__(self) -> Iterator[Check]:
        return iter(self._checks)


def registered() -> list[Check]:
    """Every check of every registered family. Raises `RegistryError` where a plugin's cannot be
    imported.
    """
    return [check for name in checks for check in checks.create(name)]


def measure(checks: Iterable[Check]) -> Iterator[Result]:
    """Run checks one after the other."""
    for check in checks:
        yield check.run()


def quantity(value: float, unit: str) -> str:
    """A figure in two digits: ``0``, ``3.1e-14``, ``2 samples``."""
    number = f"{value:g}" if abs(value) < 1e6 and value == round(value) else f"{value:.2g}"
    return f"{number} {unit}".strip()
