"""Decisions of a plan: the coarser forms that save most, while their bounds fit in the budget.

Forms are tried in a fixed order, by the saving that was measured in a benchmark scene
(`bounds.Saving`). No time of this machine enters: the same file gives the same plan everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from ..configuration.diagnostics import nearest
from ..configuration.loaded import Limits
from ..errors import ZondaError
from .bounds import Choice, Effect

TRANSFER = 0.01
"""Error of the transfer function that is allowed where the user states none."""

SHARE = 0.1
"""Share of the noise that is allowed where the user states none."""


def limits(budget: Any, map_noise: float, sample_noise: float) -> dict[str, float]:
    """Largest bound by metric. ``budget``: a share of the noise (a number), or `Limits`.

    Raises
    ------
    ZondaError
        For a share that is not a number from 0 to 1.
    """
    given = (
        {metric: v for metric, v in budget if v is not None} if isinstance(budget, Limits) else {}
    )
    share = SHARE if isinstance(budget, Limits) else float(budget)
    if not 0 <= share <= 1:
        raise ZondaError(
            f"the budget is a share of the noise from 0 to 1, got {share:g}",
            place="budget",
            cure="write e.g. 10 %",
        )
    in_map, transfer = given.get("map_rms", share * map_noise), TRANSFER * min(1.0, share / SHARE)
    return {
        "map_rms": in_map,
        "peak": in_map,
        "transfer": transfer,
        "tod": share * sample_noise,
        "psd": share,
        **given,
    }


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
        """Name for ``--keep`` and ``--drop``."""
        return f"{self.operator}.{self.effect.name}"

    @property
    def simulated(self) -> bool:
        """False for an effect that zonda leaves out: nothing can be decided about it."""
        return self.effect.choices[0].decision != "not simulated"

    @property
    def adds_error(self) -> bool:
        """The bound of the choice is an error of the products."""
        return self.chosen > 0 or not self.simulated

    @property
    def formula(self) -> str:
        """Source of the bound."""
        return self.choice.formula or self.effect.formula

    def bound(self, k: int, metric: str) -> float:
        """Error that choice ``k`` adds; NaN counts as infinite."""
        value = self.effect.choices[k].bound.get(metric, 0.0) if k else 0.0
        return math.inf if math.isnan(value) else value

    def means(self, name: str) -> bool:
        """True for its full name, the effect's, or the operator's."""
        return name in (self.name, self.effect.name, self.operator)


def decide(
    effects: Sequence[Decided],
    allowed: Mapping[str, float],
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

    def share(rung: tuple[Decided, int]) -> float:
        """Share of the budget that a form takes."""
        used = {m: rung[0].bound(rung[1], m) for m in allowed}
        return max((b / allowed[m] if allowed[m] else math.inf for m, b in used.items() if b > 0),
                   default=0.0)  # fmt: skip

    free = {*(d.name for d in effects)} - {*kept} - {*forced} if prune_all and not joined else set()
    rungs = [
        (d, k)
        for d in effects
        for k, choice in enumerate(d.effect.choices)
        if k and d.name in free and choice.pays
    ]
    for d, k in sorted(rungs, key=lambda rung: (*_order(rung), share(rung))):
        used = {m: d.bound(k, m) for m in left}
        if not chosen[d.name] and all(used[m] <= left[m] for m in left):
            chosen[d.name] = k
            left = {m: left[m] - used[m] for m in left}
    stated = dict.fromkeys(kept, "--keep") | dict.fromkeys(forced, "--drop")

    def reason(d: Decided) -> str:
        if not d.simulated:
            over = [m for m, v in d.choice.bound.items() if v > left.get(m, math.inf)]
            words = f"may exceed what is left of the budget for {' and '.join(over)}"
            return words if over else "within the budget"
        if d.name in stated or chosen[d.name]:
            return stated.get(d.name, "within the budget")
        coarser = d.effect.choices[1:]
        if joined and coarser:
            return f"{joined} joins the bands"
        if not prune_all or not coarser:
            return "" if prune_all else "--no-prune"
        if not any(choice.pays for choice in coarser):
            return "a coarser form would save nothing"
        return "a coarser form would exceed the budget"

    return [replace(d, chosen=chosen[d.name], reason=reason(d)) for d in effects]


def _order(rung: tuple[Decided, int]) -> tuple[float, float]:
    """Largest measured saving first, then those that a planning class states in seconds."""
    choice = rung[0].effect.choices[rung[1]]
    return -(choice.saves.share if choice.saves else 0.0), -choice.seconds


def named(names: Sequence[str], effects: Sequence[Decided], labels: Sequence[str]) -> set[str]:
    """Full names of the effects that ``names`` mean. Raises ZondaError for one that means none."""
    short = dict.fromkeys(d.effect.name for d in effects)
    for name in names:
        if name not in labels and not any(d.means(name) for d in effects):
            options = list(dict.fromkeys([*short, *(d.name for d in effects), *labels]))
            cure = nearest(name, options) or f"choose from: {', '.join(short)}"
            text = f"the plan has no effect or operator {name!r}"
            raise ZondaError(text, place="zonda plan", cure=cure)
    return {d.name for d in effects for name in names if d.means(name)}


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
