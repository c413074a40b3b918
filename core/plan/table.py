"""A plan as text, as JSON, and in short for headers."""

from __future__ import annotations

import math
import shutil
import textwrap
from typing import TYPE_CHECKING, Any

import numpy as np

from .outcome import duration, line
from .planner import Decided, Plan, describe, figure, kelvin

if TYPE_CHECKING:
    pass


def rows(plan: Plan) -> list[dict[str, Any]]:
    """One row per effect: operator, effect, decision, what, bound, formula, size, saved seconds, reason."""
    return [_row(plan, d) for d in plan.decided]


def _row(plan: Plan, d: Decided) -> dict[str, Any]:
    choice = d.choice
    metrics = plan.context.metrics
    bound = {k: float(v) for k, v in choice.bound.items() if k in metrics}
    runs = plan.prediction.runs.get(d.operator, 1)
    return {
        "operator": d.operator,
        "effect": d.effect.name,
        "decision": choice.decision,
        "what": choice.what,
        "settings": {k: _plain(v) for k, v in choice.settings.items()},
        "bound": bound,
        "formula": choice.formula or d.effect.formula,
        "size": {k: float(v) for k, v in d.effect.size.items() if k in metrics},
        "saved_seconds": round(choice.seconds * runs, 4) if d.chosen else 0.0,
        "reason": d.reason,
    }


def _plain(value: Any) -> Any:
    return value if isinstance(value, (int, float, str, bool, list, type(None))) else str(value)


def text(plan: Plan, width: int | None = None) -> str:
    """The table for a terminal of ``width`` columns; of this one where absent."""
    width = width or max(80, min(shutil.get_terminal_size((120, 50)).columns, 140))
    lines = []
    metrics = plan.context.metrics
    sample, pixel, hits = plan.noise
    if pixel:
        lines.append(f"noise: {kelvin(pixel)} per map pixel ({hits:.0f} samples in the deep part), {kelvin(sample)} per sample")
        coverage, fwhm = plan.context.coverage, float(np.mean(plan.context.first.focalplane.fwhm))
        smoothing = (coverage.pixel if coverage else math.inf) / fwhm * math.sqrt(2 * math.log(2) / math.pi)
        if smoothing < 0.5:  # sqrt(pixel area / (4 pi sigma^2)), where pixels are small
            beam, both = (f"{math.degrees(f) * 3600:.3g} arcsec" for f in (fwhm, math.sqrt(2) * fwhm))
            lines[-1] += f";\n  {kelvin(pixel * smoothing)} in the map smoothed with the beam ({beam}; resolution {both}), "
            lines[-1] += "the white noise alone"
    else:
        lines.append(f"noise: {kelvin(sample)} per sample; no map" if sample else "noise: none")
    for metric, limit in plan.limits.items():
        spent = plan.spent[metric]
        lines.append(f"budget for {metric}: {figure(metric, spent)} of {figure(metric, limit)} spent")
    groups: dict[tuple[str, str], list[str]] = {}
    for row in plan.structure.rows:
        groups.setdefault((row.run, row.reason), []).append(row.operator)
    for (run, reason), operators in groups.items():
        named = ", ".join(filter(None, operators))
        left_out = f"left out: {f'run {run}' if run else ''}{': ' if run and named else ''}{named} ({reason})"
        lines += textwrap.wrap(left_out, width, subsequent_indent="    ")
    lines += [f"run {run} is not simulated: it is {how}" for run, how in plan.structure.derived.items()]
    lines += ["", *_effects(plan, metrics, width), "", line(plan)]
    return "\n".join(lines)


def _effects(plan: Plan, metrics: frozenset[str], width: int) -> list[str]:
    """Under each operator and its predicted time: what is done about an effect, what that or leaving it out adds, and why."""
    lines: list[str] = []
    column = max((len(d.effect.name) for d in plan.decided), default=0) + 2
    operator = formula = ""
    for d in plan.decided:
        choice = d.choice
        if d.operator != operator:
            operator, formula = d.operator, ""
            seconds = plan.prediction.seconds.get(operator)
            lines.append(operator + (f"  {duration(seconds)} of CPU time" if seconds is not None else ""))
        decision = choice.decision if choice.decision == choice.what else f"{choice.decision}: {choice.what}"
        lines.append(f"  {d.effect.name:<{column}}{decision}")
        added = d.chosen > 0 or choice.decision == "not simulated"
        bounds = describe(choice.bound if added else d.effect.size, metrics)
        saves = choice.seconds * plan.prediction.runs.get(d.operator, 1) if d.chosen else 0.0
        notes = [f"{'error within' if added else 'without it'} {bounds}" if bounds else ""]
        notes += [f"saves {saves:.2g} s" if saves >= 0.01 else "", d.reason]
        new = choice.formula or d.effect.formula
        notes.append(new if new != formula else "")
        formula = new
        indent = " " * (column + 2)
        lines += textwrap.wrap("; ".join(filter(None, notes)), width, initial_indent=indent, subsequent_indent=indent)
    return lines


def as_dict(plan: Plan) -> dict[str, Any]:
    """Everything, as JSON takes it."""
    p, u = plan.prediction, plan.unpruned
    sample, pixel, hits = plan.noise
    return {
        "noise": {"sample": sample, "map_pixel": pixel, "samples_per_pixel": hits},
        "budget": {m: {"limit": v, "spent": plan.spent[m]} for m, v in plan.limits.items()},
        "left_out": [{"run": r.run, "operator": r.operator, "reason": r.reason} for r in plan.structure.rows],
        "derived": dict(plan.structure.derived),
        "effects": rows(plan),
        "prediction": {"cpu_seconds": p.total, "bytes": p.bytes, "by_operator": dict(p.seconds), "unknown": list(p.unknown)},
        "everything_on": {"cpu_seconds": u.total, "bytes": u.bytes},
    }


def short(plan: Plan) -> list[tuple[str, str, str, str]]:
    """For headers: (effect, decision, bound, formula), what is left out by structure first."""
    found = []
    for row in plan.structure.rows:
        name = f"run {row.run}" + (f": {row.operator}" if row.operator else "") if row.run else row.operator
        found.append((name, "left out", "", row.reason))
    found += [(f"run {run}", "not simulated", "", how) for run, how in plan.structure.derived.items()]
    for d in plan.decided:
        bound = describe(d.choice.bound, plan.context.metrics) if d.chosen or d.choice.decision == "not simulated" else ""
        found.append((d.name, f"{d.choice.decision}: {d.choice.what}", bound, d.choice.formula or d.effect.formula))
    return found
