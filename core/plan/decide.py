"""Decisions of a plan: the coarser forms that save most, while their bounds fit in the budget.

Forms are tried in a fixed order, by the saving that was measured in a benchmark scene
(`bounds.Saving`). No time of this machine enters: the same file gives the same plan everywhere.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

from ..configuration.diagnostics import nearest
from ..configuration.loaded import Limits
from ..errors import ZondaError
from .bounds import Choice, Effect

TRANSFER = 0.01
"""Error of the transfer function that is allowed where the user states none."""

SHARE = 0.1
"""Share of the noise that is allowed where the user states none."""


def limits(budget: float | Limits, map_noise: float, sample_noise: float) -> dict[str, float]:
    """Largest bound by metric. ``budget``: a share of the noise from 0 to 1, or `Limits`."""
    stated = {}
    share = SHARE
    if isinstance(budget, Limits):
        stated = {metric: value for metric, value in budget if value is not None}
    else:
        share = budget
    in_map = stated.get("map_rms", share * map_noise)
    return {
        "map_rms": in_map,
        "peak": in_map,
        "transfer": TRANSFER * min(1.0, share / SHARE),
        "tod": share * sample_noise,
        "psd": share,
        **stated,
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

    def error(self, metric: str) -> float:
        """Error that the choice adds; NaN counts as infinite."""
        value = self.choice.bound.get(metric, 0.0) if self.chosen else 0.0
        return math.inf if math.isnan(value) else value

    def means(self, name: str) -> bool:
        """True for its full name, the effect's, or the operator's."""
        return name in (self.name, self.effect.name, self.operator)


def decide(
    bands: Sequence[Sequence[Decided]],
    allowed: Sequence[Mapping[str, float]],
    *,
    kept: Collection[str] = (),
    forced: Collection[str] = (),
    prune_all: bool = True,
    joined: str = "",
) -> list[list[Decided]]:
    """Choose one form of each effect for all bands, so that in each band the sums of bounds stay
    within its budget.

    Parameters
    ----------
    bands
        The effects of each band.
    allowed
        The budget of each band by metric.
    kept, forced
        Names of effects that stay as the pipeline asks for them, and of those that take their
        coarsest form.
    prune_all
        False: nothing is coarsened but what is forced.
    joined
        Steps for which the bounds do not hold (`Context.joined`): likewise.
    """
    forms = _forms(bands)
    taken = {form[0].name: form for form in forms if form[0].name in forced}  # the coarsest
    left = [
        {m: v - sum(form[k].error(m) for form in taken.values()) for m, v in own.items()}
        for k, own in enumerate(allowed)
    ]

    def order(form: list[Decided]) -> tuple[float, float, float]:
        """Largest measured saving first, then what planning classes state in seconds, then the
        smallest share of the budget.
        """
        used = [
            (d.error(m), limit)
            for d, own in zip(form, allowed, strict=True)
            for m, limit in own.items()
            if d.error(m) > 0
        ]
        share = max((b / limit if limit else math.inf for b, limit in used), default=0.0)
        choice = form[0].choice
        return -(choice.saves.share if choice.saves else 0.0), -choice.seconds, share

    free = prune_all and not joined
    tried = [f for f in forms if free and f[0].chosen and f[0].name not in kept]
    for form in sorted((f for f in tried if all(d.choice.pays for d in f)), key=order):
        both = list(zip(form, left, strict=True))
        if form[0].name not in taken and all(d.error(m) <= own[m] for d, own in both for m in own):
            taken[form[0].name] = form
            left = [{m: v - d.error(m) for m, v in own.items()} for d, own in both]
    stated = dict.fromkeys(kept, "--keep") | dict.fromkeys(forced, "--drop")

    def reason(d: Decided, left: Mapping[str, float]) -> str:
        coarser = d.effect.choices[1:]
        if not d.simulated:
            over = [m for m, v in d.choice.bound.items() if v > left.get(m, math.inf)]
            return f"above the budget: {', '.join(over)}" if over else "within the budget"
        if d.name in forced and coarser and not taken.get(d.name, [d])[0].chosen:
            return "--drop: the bands have no coarser form in common"
        if d.name in stated or d.name in taken:
            return stated.get(d.name, "within the budget")
        if joined and coarser:
            return f"{joined} joins the bands"
        if not prune_all:
            return "--no-prune"
        if not any(choice.pays for choice in coarser):
            return "coarser only with --drop" if coarser else ""
        return f"coarser exceeds the budget{' of a band' if len(bands) > 1 else ''}"

    return [
        [
            replace(taken[d.name][k] if d.name in taken else d, reason=reason(d, left[k]))
            for d in own
        ]
        for k, own in enumerate(bands)
    ]


def _forms(bands: Sequence[Sequence[Decided]]) -> list[list[Decided]]:
    """Forms that an effect has in all bands: those with the same settings. Each is a list with one
    `Decided` for each band.
    """
    found, (first, *others) = [], bands
    for d in first:
        for k, choice in enumerate(d.effect.choices):
            form = [replace(d, chosen=k)]
            for e in (e for own in others for e in own if e.name == d.name):
                alike = [n for n, c in enumerate(e.effect.choices) if c.sets == choice.sets]
                form += [replace(e, chosen=n) for n in alike[:1]]
            if len(form) == len(bands):
                found.append(form)
    return found


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
            text = f"{name!r} cannot be dropped: it {what}"
            raise ZondaError(text, place="zonda plan", cure="remove this --drop")
