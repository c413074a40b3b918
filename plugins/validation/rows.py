"""A claim with what was found of it."""

from __future__ import annotations

from dataclasses import dataclass

from .amount import Amount
from .claims import Claim, Experiment
from .verdict import Comparison, Values, Verdict


@dataclass(frozen=True)
class CounterResult:
    """A counter-experiment: its name, what it shows, its values, whether its criterion is
    satisfied; the unit that its values are stated in (of its criterion, which need not be that of
    the claim), and whether they are of the claim's quantity."""

    name: str
    shows: str
    experiment: Experiment
    values: Values
    satisfied: bool
    unit: Amount
    comparable: bool


@dataclass(frozen=True)
class Row:
    """A claim and what was found of it."""

    claim: Claim
    values: Values
    comparison: Comparison | None
    counters: tuple[CounterResult, ...]
    verdict: Verdict
