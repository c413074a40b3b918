"""Verdicts on a claim, computed from numbers alone.

With the paper's value p, its standard error e and the half width r to which it is stated, and n
values of zonda's of mean m and scatter s (one realization; s / sqrt(n) is the standard error of the
mean),

    gap = max(0, |m - p| - r)                                                                    (1)
    distance of one realization = gap / sqrt(e^2 + s^2),
    of the mean = gap / sqrt(e^2 + s^2 / n)        (2)

For a lower limit p, |m - p| is replaced by p - m, for an upper one by m - p. The claim holds where
the distance is at most `LIMIT`: that of one realization, where the paper's figure is one
realization; else that of the mean.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

from zonda.core.experiment.experiment import Values

LIMIT = 2.0
"""Largest distance that counts as agreement, in standard deviations."""

Relation = Literal["equal", "at_least", "at_most"]
Of = Literal["realization", "mean"]


class Verdict(StrEnum):
    """Verdict on a claim. `DIFFERS` is the only one that is not decided."""

    AGREES = "agrees"
    EXPLAINED = "differs, explained"
    CONTRADICTION = "the paper contradicts itself"
    NEEDS_DATA = "needs data we do not have"
    DIFFERS = "differs"

    @property
    def decided(self) -> bool:
        """True if nothing is left to explain."""
        return self is not Verdict.DIFFERS


@dataclass(frozen=True)
class Stated:
    """Statement of the paper: value, standard error, half width of rounding, all SI; its meaning;
    of one realization or of the mean.
    """

    value: float
    error: float = 0.0
    rounding: float = 0.0
    relation: Relation = "equal"
    of: Of = "realization"

    def gap(self, mean: float) -> float:
        """Equation (1); NaN for no value."""
        if math.isnan(mean):
            return math.nan
        away = {
            "equal": abs(mean - self.value),
            "at_least": self.value - mean,
            "at_most": mean - self.value,
        }[self.relation]
        return max(
            0.0, away - self.rounding - 1e-9 * abs(self.value)
        )  # a limit itself is inside, whatever its last bit


def distance(gap: float, sigma: float) -> float:
    """Equation (2): 0 for no gap, infinite for a gap without any uncertainty."""
    if math.isnan(gap) or gap == 0:
        return gap
    return gap / sigma if sigma > 0 else math.inf


@dataclass(frozen=True)
class Comparison:
    """Distances of equation (2), and whether the claim holds."""

    of_one: float
    of_mean: float
    holds: bool


def compare(stated: Stated, found: Values) -> Comparison:
    """Compare what was found with what is stated. What is NaN never holds."""
    gap = stated.gap(found.mean)
    of_one = distance(gap, math.hypot(stated.error, found.scatter))
    of_mean = distance(gap, math.hypot(stated.error, found.standard_error))
    return Comparison(of_one, of_mean, (of_one if stated.of == "realization" else of_mean) <= LIMIT)


def clears(found: Values, above: float | None, below: float | None) -> bool:
    """True if the mean is above and below limits by `LIMIT` standard errors of the mean."""
    margin = LIMIT * found.standard_error
    if math.isnan(found.mean):
        return False
    return (above is None or found.mean - margin >= above) and (
        below is None or found.mean + margin <= below
    )


def contradicted(stated: Stated, other: float, relation: Relation) -> bool:
    """True if the paper's statement cannot stand beside ``other``, which follows from other numbers
    of the paper.
    """
    beside = Stated(other, 0.0, stated.rounding, relation)
    return distance(beside.gap(stated.value), stated.error) > LIMIT


def decide(
    holds: bool | None,
    explanations: Sequence[bool],
    *,
    contradicted: bool = False,
    needs_data: bool = False,
) -> Verdict:
    """The verdict.

    Parameters
    ----------
    holds
        Whether zonda's value agrees; None where there is none.
    explanations
        For each counter-experiment whether its result satisfies its criterion. A difference is
        explained where there is at least one and all do.
    contradicted
        Whether other numbers of the paper exclude the claim.
    needs_data
        Whether it can only be compared with data that are not here.
    """
    if needs_data:
        return Verdict.NEEDS_DATA
    if contradicted:
        return Verdict.CONTRADICTION
    if holds:
        return Verdict.AGREES
    return Verdict.EXPLAINED if explanations and all(explanations) else Verdict.DIFFERS
