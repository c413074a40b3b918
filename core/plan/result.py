"""A plan: what is decided, as text, as JSON, and in short for headers."""

from __future__ import annotations

import math
import shutil
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

from ..configuration.pipeline_file import PipelineFile
from ..maps.beams import expected_fwhm
from .context import Context
from .decide import Decided
from .estimate import Cost
from .figures import describe, duration, figure, kelvin
from .structure import Structure
from .summary import PlanSummary, Prediction


@dataclass(frozen=True)
class Plan:
    """What is done about each effect; the errors it adds, what is allowed; the time and memory it
    will take.

    Attributes
    ----------
    structure
        What takes part at all.
    decided
        One for each effect.
    limits, spent
        By metric: the budget, and the sum of the bounds of what was dropped or coarsened.
    noise
        White noise that the run will have, under the load of the atmosphere: rms of one sample and
        of a map pixel (0: no map), K; samples per pixel in the deep part of the map.
    prediction, unpruned
        With the plan, and with everything on.
    costs
        Of the operators that state one, as the pipeline asks for them.
    """

    structure: Structure
    decided: tuple[Decided, ...]
    limits: Mapping[str, float]
    spent: Mapping[str, float]
    noise: tuple[float, float, float]
    prediction: Prediction
    unpruned: Prediction
    context: Context
    costs: Mapping[str, Cost] = field(default_factory=dict)

    @property
    def operators(self) -> tuple[str, ...]:
        """Labels of the operators that act."""
        left_out = {d.operator for d in self.decided if d.choice.leave_out}
        return tuple(label for label in self.structure.operators if label not in left_out)

    @property
    def summary(self) -> PlanSummary:
        """What a run takes from it."""
        return PlanSummary(
            self.operators,
            self.structure.runs,
            self.settings(),
            short(self),
            self.prediction,
            self.unpruned,
        )

    def apply(self, file: PipelineFile) -> PipelineFile:
        """The pipeline that is run: an ordinary one, with parameters changed and operators
        omitted.
        """
        return self.summary.apply(file)

    def settings(self) -> dict[str, dict[str, Any]]:
        """Changed parameters by operator. Lists that several effects set are joined."""
        found: dict[str, dict[str, Any]] = {}
        for d in self.decided:
            for key, value in d.choice.settings.items():
                mine = found.setdefault(d.operator, {})
                mine[key] = [*mine.get(key, []), *value] if isinstance(value, list) else value
        return found

    def saved_seconds(self, d: Decided) -> float:
        """CPU time that a decision saves, all signals [reference s]."""
        return d.choice.seconds * self.prediction.times.get(d.operator, 1) if d.chosen else 0.0

    def __str__(self) -> str:
        return text(self)

    def _repr_html_(self) -> str:
        from ..pages import html_table

        return html_table(
            "Plan", [(d.name, f"{d.choice.decision}: {d.choice.what}") for d in self.decided]
        )


def as_dict(plan: Plan) -> dict[str, Any]:
    """Everything, as JSON takes it."""
    p, u = plan.prediction, plan.unpruned
    sample, pixel, hits = plan.noise
    return {
        "noise": {"sample": sample, "map_pixel": pixel, "samples_per_pixel": hits},
        "budget": {m: {"limit": v, "spent": plan.spent[m]} for m, v in plan.limits.items()},
        "left_out": [
            {"run": r.run, "operator": r.operator, "reason": r.reason} for r in plan.structure.rows
        ],
        "derived": dict(plan.structure.derived),
        "joins_bands": plan.context.joined,
        "effects": [_effect_as_dict(plan, d) for d in plan.decided],
        "prediction": {
            "cpu_seconds": p.total,
            "bytes": p.bytes,
            "by_operator": dict(p.seconds),
            "unknown": list(p.unknown),
        },
        "everything_on": {"cpu_seconds": u.total, "bytes": u.bytes},
    }


def _effect_as_dict(plan: Plan, d: Decided) -> dict[str, Any]:
    metrics = plan.context.metrics
    return {
        "operator": d.operator,
        "effect": d.effect.name,
        "decision": d.choice.decision,
        "what": d.choice.what,
        "settings": {k: _plain(v) for k, v in d.choice.settings.items()},
        "bound": {k: float(v) for k, v in d.choice.bound.items() if k in metrics},
        "formula": d.formula,
        "size": {k: float(v) for k, v in d.effect.size.items() if k in metrics},
        "saved_seconds": round(plan.saved_seconds(d), 4),
        "reason": d.reason,
    }


def _plain(value: Any) -> Any:
    return value if isinstance(value, (int, float, str, bool, list, type(None))) else str(value)


def text(plan: Plan, width: int | None = None) -> str:
    """The table for a terminal of ``width`` columns; of this one where absent."""
    width = width or max(80, min(shutil.get_terminal_size((120, 50)).columns, 140))
    lines = [_noise(plan)]
    for metric, limit in plan.limits.items():
        lines.append(
            f"budget for {metric}: {figure(metric, plan.spent[metric])} of {figure(metric, limit)}"
            " spent"
        )
    if joined := plan.context.joined:
        said = (
            f"{joined} joins the bands: the bounds are of this band alone and need not hold, so"
            " that nothing is coarsened"
        )
        lines += textwrap.wrap(said, width, subsequent_indent="    ")
    groups: dict[tuple[str, str], list[str]] = {}
    for row in plan.structure.rows:
        groups.setdefault((row.run, row.reason), []).append(row.operator)
    for (run, reason), operators in groups.items():
        what = ": ".join(
            filter(None, (f"signal {run}" if run else "", ", ".join(filter(None, operators))))
        )
        lines += textwrap.wrap(f"omitted: {what} ({reason})", width, subsequent_indent="    ")
    lines += [f"signal {run} is a remainder: {how}" for run, how in plan.structure.derived.items()]
    return "\n".join([*lines, "", *_effects(plan, width), "", str(plan.summary)])


def _noise(plan: Plan) -> str:
    sample, pixel, hits = plan.noise
    if not pixel:
        return f"noise: {kelvin(sample)} per sample; no map" if sample else "noise: none"
    words = (
        f"noise: {kelvin(pixel)} per map pixel ({hits:.0f} samples in the deep part),"
        f" {kelvin(sample)} per sample"
    )
    coverage, plane = plan.context.coverage, plan.context.first.focalplane
    fwhm = expected_fwhm(plane.fwhm, plane.net)
    smoothing = (
        (coverage.pixel if coverage else math.inf) / fwhm * math.sqrt(2 * math.log(2) / math.pi)
    )
    if smoothing < 0.5:  # sqrt(pixel area / (4 pi sigma^2)), where pixels are small
        beam, both = (f"{math.degrees(f) * 3600:.3g} arcsec" for f in (fwhm, math.sqrt(2) * fwhm))
        words += (
            f";\n  {kelvin(pixel * smoothing)} in the map smoothed with the beam ({beam};"
            f" resolution {both}), "
        )
        words += "the white noise alone"
    return words


def _effects(plan: Plan, width: int) -> list[str]:
    """Under each operator and its predicted time: what is done about an effect, what that or
    leaving it out adds, and why.
    """
    lines: list[str] = []
    column = max((len(d.effect.name) for d in plan.decided), default=0) + 2
    operator = formula = ""
    for d in plan.decided:
        choice = d.choice
        if d.operator != operator:
            operator, formula = d.operator, ""
            seconds = plan.prediction.seconds.get(operator)
            lines.append(
                operator + (f"  {duration(seconds)} of CPU time" if seconds is not None else "")
            )
        decision = (
            choice.decision
            if choice.decision == choice.what
            else f"{choice.decision}: {choice.what}"
        )
        lines.append(f"  {d.effect.name:<{column}}{decision}")
        bounds = describe(choice.bound if d.adds_error else d.effect.size, plan.context.metrics)
        saves = plan.saved_seconds(d)
        notes = [f"{'error within' if d.adds_error else 'without it'} {bounds}" if bounds else ""]
        notes += [
            f"saves {saves:.2g} s" if saves >= 0.01 else "",
            d.reason,
            d.formula if d.formula != formula else "",
        ]
        formula = d.formula
        indent = " " * (column + 2)
        lines += textwrap.wrap(
            "; ".join(filter(None, notes)), width, initial_indent=indent, subsequent_indent=indent
        )
    return lines


def short(plan: Plan) -> list[tuple[str, str, str, str]]:
    """Rows for headers: (effect, decision, bound, formula), steps that are omitted by structure
    first.
    """
    found = []
    for row in plan.structure.rows:
        name = (
            f"signal {row.run}" + (f": {row.operator}" if row.operator else "")
            if row.run
            else row.operator
        )
        found.append((name, "left out", "", row.reason))
    found += [
        (f"signal {run}", "remainder", "", how) for run, how in plan.structure.derived.items()
    ]
    for d in plan.decided:
        bound = describe(d.choice.bound, plan.context.metrics) if d.adds_error else ""
        found.append((d.name, f"{d.choice.decision}: {d.choice.what}", bound, d.formula))
    return found
