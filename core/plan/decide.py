"""What is decided about each effect: the largest saving for the share of the budget that it takes,
first.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from ..configuration.diagnostics import nearest
from ..errors import ZondaError
from .estimate import Choice, Effect
from .summary import Prediction

LEAST_SAVING = 0.005
"""Share of the predicted time that a decision must save to be worth an error."""


@dataclass(frozen=True)
class Decided:
    """An effect with the choice that was made and why. ``operator``: a label, or ``pipeline``."""

    operator: str
    effect: Effect
    chosen: int = 0
    reason: str = ""

    @property
    def choice(self) -> Choice:
        """The form that was chosen."""
        return self.effect.choices[self.chosen]

    @property
    def name(self) -> str:
        """As ``--keep`` and ``--drop`` take it."""
        return f"{self.operator}.{self.effect.name}"

    @property
    def simulated(self) -> bool:
        """False for what nature has and zonda leaves out: nothing can be decided about it."""
        return self.effect.choices[0].decision != "not simulated"

    @property
    def adds_error(self) -> bool:
        """Whether the bound of the choice is an error of the products."""
        return self.chosen > 0 or not self.simulated

    @property
    def formula(self) -> str:
        """Where the bound comes from."""
        return self.choice.formula or self.effect.formula

    def bound(self, k: int, metric: str) -> float:
        """Error that choice ``k`` adds; one that is not a number allows nothing."""
        value = self.effect.choices[k].bound.get(metric, 0.0) if k else 0.0
        return math.inf if math.isnan(value) else value

    def saving(self, k: int, predicted: Prediction) -> float:
        """CPU seconds that choice ``k`` saves on the machine of the prediction, all signals."""
        times = predicted.times.get(self.operator, 1)
        return self.effect.choices[k].seconds * times * max(predicted.factors.values(), default=1.0)


def decide(
    effects: Sequence[Decided],
    allowed: Mapping[str, float],
    predicted: Prediction,
    *,
    kept: Collection[str] = (),
    forced: Collection[str] = (),
    prune_all: bool = True,
    joined: str = "",
) -> list[Decided]:
    """Choose one form of each effect, so that the sums of bounds stay within the budget.

    Parameters
    ----------
    allowed
        The budget by metric.
    predicted
        On the reference machine: decisions must not depend on this one.
    kept, forced
        Names of effects that stay as the pipeline asks for them, and of those that take their
        coarsest form.
    prune_all
        False: nothing is coarsened but what is forced.
    joined
        Steps for which the bounds do not hold (`Context.joined`): likewise.
    """
    chosen = {d.name: len(d.effect.choices) - 1 if d.name in forced else 0 for d in effects}
    left = {
        m: allowed[m] - sum(d.bound(chosen[d.name], m) for d in effects if d.name in forced)
        for m in allowed
    }
    worth = LEAST_SAVING * predicted.total
    free = [
        d
        for d in effects
        if prune_all and not joined and d.name not in kept and d.name not in forced
    ]
    while True:
        steps: list[tuple[float, Decided, int]] = []
        for d in free:
            now = chosen[d.name]
            for k in range(now + 1, len(d.effect.choices)):
                saved = d.saving(k, predicted) - d.saving(now, predicted)
                more = {m: d.bound(k, m) - d.bound(now, m) for m in left}
                if saved >= worth and all(extra <= left[m] for m, extra in more.items()):
                    share = max(
                        (extra / allowed[m] for m, extra in more.items() if extra > 0), default=0.0
                    )
                    steps.append((saved / max(share, 1e-9), d, k))
        if not steps:
            break
        _, d, k = max(steps, key=lambda step: step[0])
        left = {m: v - d.bound(k, m) + d.bound(chosen[d.name], m) for m, v in left.items()}
        chosen[d.name] = k
    stated = dict.fromkeys(kept, "--keep") | dict.fromkeys(forced, "--drop")
    coarser_forms = "" if prune_all else "--no-prune"
    found = []
    for d in effects:
        reason = (
            _within(d, left)
            if not d.simulated
            else stated.get(d.name) or ("within the budget" if chosen[d.name] else "")
        )
        if joined and len(d.effect.choices) > 1:
            reason = reason or f"{joined} joins the bands"
        reason = reason or coarser_forms or _why_in_full(d, predicted, worth)
        found.append(replace(d, chosen=chosen[d.name], reason=reason))
    return found


def _within(d: Decided, left: Mapping[str, float]) -> str:
    over = [m for m, v in d.choice.bound.items() if v > left.get(m, math.inf)]
    return (
        f"may exceed what is left of the budget for {' and '.join(over)}"
        if over
        else "within the budget"
    )


def _why_in_full(d: Decided, predicted: Prediction, worth: float) -> str:
    coarser = range(1, len(d.effect.choices))
    if not coarser:
        return ""
    if max(d.saving(k, predicted) for k in coarser) < worth:
        return "leaving it out would save nothing"
    return "a coarser form would exceed the budget"


def named(names: Sequence[str], effects: Sequence[Decided], labels: Sequence[str]) -> set[str]:
    """Full names of the effects that ``names`` mean. Raises ZondaError for one that means none."""
    found: set[str] = set()
    for name in names:
        mine = {d.name for d in effects if name in (d.name, d.effect.name, d.operator)}
        if not mine and name not in labels:
            options = [
                *dict.fromkeys(
                    [*(d.effect.name for d in effects), *(d.name for d in effects), *labels]
                )
            ]
            cure = (
                nearest(name, options)
                or f"choose from: {', '.join(dict.fromkeys(d.effect.name for d in effects))}"
            )
            raise ZondaError(
                f"the plan has no effect or operator {name!r}", place="zonda plan", cure=cure
            )
        found |= mine
    return found


def check_droppable(drop: Sequence[str], effects: Sequence[Decided], labels: Sequence[str]) -> None:
    """Raise ZondaError for an effect that has no coarser form."""
    named(drop, effects, labels)
    for name in drop:
        mine = [d for d in effects if name in (d.name, d.effect.name)]
        if mine and name not in labels and all(len(d.effect.choices) == 1 for d in mine):
            what = "has no coarser form" if mine[0].simulated else "is not simulated"
            raise ZondaError(
                f"{name!r} cannot be dropped: it {what}",
                place="zonda plan",
                cure="remove this --drop",
            )
