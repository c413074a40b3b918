"""`zonda plan`: what a scene calls for, what each effect costs, and what is left out or coarsened within an error budget."""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..configuration.diagnostics import nearest
from ..configuration.pipeline_file import PipelineFile
from ..data import Data
from ..errors import ZondaError
from ..machine import available_memory, available_threads
from ..pipeline import Pipeline
from ..run.derived import derivation
from .budget import limits
from .context import Context, look
from .cost import predict
from .estimate import METRICS, Bound, Choice, Cost, Effect, Estimate, full
from .outcome import Prediction, apply
from .planning import planning_of
from .structure import Structure, prune, selected
from .whole import everything_of, without

LARGEST_RATIO = 1e5
"""Of a stream's rms to its noise up to which float32 is thought of where the pipeline asks for float64."""

LEAST_SAVING = 0.005
"""Share of the predicted time that a decision must save to be worth an error."""

AMPLE = 1 << 60
"""Memory of the machine for which decisions are made: it holds all streams. They must not depend on the real one, its speed,
threads, memory and disk: the same file and seed give the same bits, and all parts of a campaign's map are made alike."""


@dataclass(frozen=True)
class Decided:
    """An effect with the choice that was made and why. ``operator``: a label, or ``pipeline``."""

    operator: str
    effect: Effect
    chosen: int
    reason: str = ""

    @property
    def choice(self) -> Choice:
        """What is done."""
        return self.effect.choices[self.chosen]

    @property
    def name(self) -> str:
        """As ``--keep`` and ``--drop`` take it."""
        return f"{self.operator}.{self.effect.name}"


@dataclass(frozen=True)
class Plan:
    """What is done about each effect; the errors it adds, what is allowed; the time and memory it will take.

    Attributes
    ----------
    structure
        What runs at all.
    decided
        One for each effect.
    limits, spent
        By metric: the budget, and the sum of the bounds of what was dropped or coarsened.
    noise
        White noise that the run will have, under the load of the atmosphere: rms of one sample and of a map pixel (0: no map), K;
        samples per pixel in the deep part of the map.
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
    pruned: bool = True
    costs: Mapping[str, Cost] = dataclasses.field(default_factory=dict)

    @property
    def operators(self) -> tuple[str, ...]:
        """Labels of the operators that act."""
        left_out = {d.operator for d in self.decided if d.choice.leave_out}
        return tuple(label for label in self.structure.operators if label not in left_out)

    def apply(self, file: PipelineFile) -> PipelineFile:
        """The pipeline that is run: an ordinary one, with parameters changed and operators left out."""
        return apply(file, self.operators, self.structure.runs, self.settings())

    def settings(self) -> dict[str, dict[str, Any]]:
        """Changed parameters by operator. Lists that several effects set are joined."""
        found: dict[str, dict[str, Any]] = {}
        for d in self.decided:
            for key, value in d.choice.settings.items():
                mine = found.setdefault(d.operator, {})
                mine[key] = [*mine.get(key, []), *value] if isinstance(value, list) else value
        return found

    @cached_property
    def coarsened(self) -> tuple[Decided, ...]:
        """What is not simulated in full although the pipeline asks for it."""
        return tuple(d for d in self.decided if d.chosen > 0)

    def __str__(self) -> str:
        from .table import text

        return text(self)

    def _repr_html_(self) -> str:
        from ..notebook import html_table
        from .table import rows

        return html_table("Plan", [(f"{r['operator']}.{r['effect']}", f"{r['decision']}: {r['what']}") for r in rows(self)])


def _check_arguments(file: Any, keep: Any, drop: Any) -> None:
    if not isinstance(file, PipelineFile):
        cure = "write zonda.plan(zonda.load(path_or_name))"
        raise ZondaError(f"a plan is made of a pipeline file, not of {file!r:.60}", place="zonda plan", cure=cure)
    for what, names in (("keep", keep), ("drop", drop)):
        if isinstance(names, str):
            cure = f"write {what}=[{names!r}]"
            raise ZondaError(f"{what} is a list of names, not the text {names!r}", place="zonda plan", cure=cure)


def plan(
    file: PipelineFile,
    *,
    keep: Sequence[str] = (),
    drop: Sequence[str] = (),
    prune_all: bool = True,
    threads: int | None = None,
    memory: int | None = None,
    measure: bool = False,
) -> Plan:
    """Plan a pipeline file: decide as on a reference machine (one thread, memory for all), predict for this one.

    Parameters
    ----------
    keep
        Effects or operators that stay as the pipeline asks for them (``poles``, ``PinkNoise.poles``, ``PinkNoise``).
    drop
        Effects or operators to leave out, whatever that costs; their bounds are stated.
    prune_all
        False: leave nothing out, coarsen nothing (``--no-prune``); ``drop`` still holds.
    measure
        Run a slice of a few seconds to find the cost of operators that do not state it; decisions do not depend on it.

    Raises
    ------
    ZondaError
        For a name that is not in the plan, or a budget that is not a number from 0 to 1.
    """
    _check_arguments(file, keep, drop)
    begin = time.process_time()
    pipeline, scene = file.pipeline(), file.scene()
    labels = [o.label for o in pipeline.operators]
    derived = {run: derivation(parts) for run, parts in pipeline.derived.items()}
    everything = Structure(tuple(labels), tuple(pipeline.runs), (), derived=derived)
    structure = prune(pipeline, [k.partition(".")[0] if k not in labels else k for k in keep]) if prune_all else everything
    context = look(pipeline, scene, structure)
    budget = limits(file.header.budget, context.map_noise, context.depth.sample)
    allowed = {m: v for m, v in budget.items() if m in context.metrics}
    context.limits = allowed
    estimates = {o.label: planning_of(o).estimate(context) for o in context.operators}
    effects = [Decided(label, e, 0) for label, estimate in estimates.items() for e in estimate.effects]
    effects += [Decided("pipeline", e, 0) for e in _of_pipeline(pipeline, context)]
    _named(drop, effects, labels)
    _check_droppable(drop, effects, labels)
    whole = [label for label in structure.operators if label in drop]
    left = without(file, structure, whole) if whole else context
    effects = [d for d in effects if d.operator not in whole]
    effects += [Decided(label, everything_of(label, estimates, context, left), 0) for label in whole]
    kept = _named(keep, effects, labels)
    forced = {d.name for d in effects if d.operator in whole or {d.name, d.effect.name, d.operator} & {*drop}}
    item = 8 if pipeline.precision == "float64" else 4
    settings = threads or available_threads(), item, memory or available_memory() // 2
    costs = {label: estimate.cost for label, estimate in estimates.items()}
    reference = predict(context, costs, 1, item, AMPLE, portable=True)
    decided = _decide(effects, kept, forced, allowed, reference, context, prune_all)
    if measure and any(costs[o.label] is None for o in context.operators):
        from .audit import measured

        costs |= measured(file, [label for label, cost in costs.items() if cost is None])
    now = predict(context, costs, *settings)
    spent = {m: sum(d.choice.bound.get(m, 0.0) for d in decided if d.chosen > 0) for m in allowed}
    noise = (left.depth.sample, left.map_noise, left.coverage.hits if left.coverage else 0.0)
    prediction = _saving(now, decided, context)
    if whole:  # what is left out holds nothing
        rest = {o.label: costs[o.label] for o in left.operators}
        prediction = dataclasses.replace(prediction, bytes=predict(left, rest, *settings).bytes)
    unpruned = _unpruned(pipeline, scene, structure, everything, context, estimates, now, settings)
    planning = time.process_time() - begin
    prediction, unpruned = (dataclasses.replace(p, startup=p.startup + planning) for p in (prediction, unpruned))
    known = {label: cost for label, cost in costs.items() if cost is not None}
    return Plan(structure, tuple(decided), allowed, spent, noise, prediction, unpruned, context, prune_all, known)


def _decide(
    effects: list[Decided],
    kept: set[str],
    forced: set[str],
    allowed: Mapping[str, float],
    now: Prediction,
    context: Context,
    prune_all: bool,
) -> list[Decided]:
    """Largest saving for the share of the budget that it takes, first; sums of bounds stay within the budget."""
    chosen = {d.name: (len(d.effect.choices) - 1 if d.name in forced else 0) for d in effects}
    by_name = {d.name: d for d in effects}
    left = {m: allowed[m] - sum(_bound(d, chosen[d.name], m) for d in effects if d.name in forced) for m in allowed}
    worth = LEAST_SAVING * now.total
    while prune_all:
        best: tuple[float, str, int] | None = None
        for name, d in by_name.items():
            if name in kept or name in forced:
                continue
            for k in range(chosen[name] + 1, len(d.effect.choices)):
                saved = _seconds(d, k, now) - _seconds(d, chosen[name], now)
                more = {m: _bound(d, k, m) - _bound(d, chosen[name], m) for m in left}
                if saved < worth or any(not extra <= left[m] for m, extra in more.items()):
                    continue
                share = max((extra / allowed[m] for m, extra in more.items() if extra > 0), default=0.0)
                merit = saved / max(share, 1e-9)
                if best is None or merit > best[0]:
                    best = (merit, name, k)
        if best is None:
            break
        _, name, k = best
        d = by_name[name]
        left = {m: v - _bound(d, k, m) + _bound(d, chosen[name], m) for m, v in left.items()}
        chosen[name] = k
    return [dataclasses.replace(d, chosen=chosen[d.name], reason=_why(d, chosen, kept, forced, left, worth, now, context,
                                                                      prune_all)) for d in effects]  # fmt: skip


def _bound(d: Decided, k: int, metric: str) -> float:
    value = d.effect.choices[k].bound.get(metric, 0.0) if k else 0.0
    return value if value == value else math.inf  # a bound that is not a number allows nothing


def _seconds(d: Decided, k: int, now: Prediction) -> float:
    """CPU seconds that a choice saves on this machine, all runs."""
    runs = now.runs.get(d.operator, 1)
    return d.effect.choices[k].seconds * runs * max(now.factors.values(), default=1.0)


def _why(
    d: Decided,
    chosen: Mapping[str, int],
    kept: set[str],
    forced: set[str],
    left: Mapping[str, float],
    worth: float,
    now: Prediction,
    context: Context,
    prune_all: bool,
) -> str:
    k, choices = chosen[d.name], d.effect.choices
    if choices[0].decision == "not simulated":
        over = [m for m, v in choices[0].bound.items() if m in context.metrics and v > left.get(m, math.inf)]
        return f"may exceed what is left of the budget for {' and '.join(over)}" if over else "within the budget"
    if d.name in forced:
        return "--drop"
    if d.name in kept:
        return "--keep"
    if k > 0:
        return "within the budget"
    if not prune_all:
        return "--no-prune"
    if len(choices) == 1:
        return ""
    if max(_seconds(d, j, now) for j in range(1, len(choices))) < worth:
        return "leaving it out would save nothing"
    return "a coarser form would exceed the budget"


def _saving(now: Prediction, decided: Iterable[Decided], context: Context) -> Prediction:
    seconds, memory = dict(now.seconds), now.bytes
    for d in decided:
        saved = _seconds(d, d.chosen, now) if d.chosen else 0.0
        if d.choice.leave_out:
            saved = seconds.get(d.operator, 0.0)
        if d.operator in seconds:
            seconds[d.operator] = max(seconds[d.operator] - saved, 0.0)
        memory -= d.choice.bytes if d.chosen else 0.0
    return dataclasses.replace(now, seconds=seconds, bytes=memory)


def _unpruned(
    pipeline: Pipeline,
    scene: Any,
    structure: Structure,
    everything: Structure,
    context: Context,
    estimates: Mapping[str, Estimate],
    now: Prediction,
    settings: tuple[int, int, int],
) -> Prediction:
    """What the pipeline would take with everything on."""
    if structure.operators == everything.operators and structure.runs == everything.runs:
        return now
    runs = selected(pipeline, everything)
    whole = dataclasses.replace(context, operators=list(pipeline.operators), runs=runs)
    costs: dict[str, Cost | None] = {}
    for operator in pipeline.operators:
        known = estimates.get(operator.label)
        if known is None:
            if not (operator.at_end or operator.main_run_only):
                operator.observe(Data(scene=scene, observations=list(context.observations)))
            operator.configure(whole.first)
            known = planning_of(operator).estimate(whole)
        costs[operator.label] = known.cost
    return predict(whole, costs, *settings)


def _of_pipeline(pipeline: Pipeline, context: Context) -> list[Effect]:
    """Precision of the streams. Rounding is independent from sample to sample: 2^-24 / sqrt(3) of their rms."""
    rms = context.fluctuation * 2.0**-24 / math.sqrt(3.0)
    formula = "2^-24 / sqrt(3) x rms of the stream, independent between samples"
    bound = context.bound(rms)
    if context.noise > 0:
        bound["psd"] = (rms / context.noise) ** 2  # both are white
    if pipeline.precision == "float32":
        return [Effect("precision", (full("float32"),), bound, formula)]
    carries_mean = context.cut == 0 and any("atmosphere" in o.provides for o in context.operators)
    if carries_mean or context.fluctuation > LARGEST_RATIO * context.noise:  # the filters refuse float32 there
        return [Effect("precision", (full("float64"),), bound, formula)]
    whole = max(o.n_samples * o.n_detectors for o in context.observations) * 4
    seconds = 4e-9 * context.samples
    single = Choice("coarse", "float32", {"precision": "float32"}, bound=bound, formula=formula, seconds=seconds, bytes=whole)
    return [Effect("precision", (full("float64"), single), bound, formula)]


def _named(names: Sequence[str], effects: Sequence[Decided], labels: Sequence[str]) -> set[str]:
    """Full names of the effects that ``names`` mean. Raises ZondaError for one that means none."""
    found: set[str] = set()
    for name in names:
        mine = {d.name for d in effects if name in (d.name, d.effect.name, d.operator)}
        if not mine and name not in labels:
            options = [*dict.fromkeys([*(d.effect.name for d in effects), *(d.name for d in effects), *labels])]
            cure = nearest(name, options) or f"choose from: {', '.join(dict.fromkeys(d.effect.name for d in effects))}"
            raise ZondaError(f"the plan has no effect or operator {name!r}", place="zonda plan", cure=cure)
        found |= mine
    return found


def _check_droppable(drop: Sequence[str], effects: Sequence[Decided], labels: Sequence[str]) -> None:
    for name in drop:
        mine = [d for d in effects if name in (d.name, d.effect.name)]
        if mine and name not in labels and all(len(d.effect.choices) == 1 for d in mine):
            what = "is not simulated" if mine[0].choice.decision == "not simulated" else "has no coarser form"
            raise ZondaError(f"{name!r} cannot be dropped: it {what}", place="zonda plan", cure="leave out --drop for it")


def describe(bound: Bound, metrics: Iterable[str]) -> str:
    """A bound in the products' units, the metrics that matter only."""
    parts = []
    for metric in METRICS:
        if metric in bound and metric in metrics:
            value = bound[metric]
            parts.append(f"{metric} {figure(metric, value)}")
    return ", ".join(parts)


def figure(metric: str, value: float) -> str:
    """A bound in its metric's unit."""
    return f"{value:.1e}" if metric in ("transfer", "psd") else kelvin(value)


def kelvin(value: float) -> str:
    """A temperature with two figures and a unit that reads well."""
    for factor, unit in ((1.0, "K"), (1e3, "mK"), (1e6, "uK"), (1e9, "nK")):
        if abs(value) * factor >= 1:
            return f"{value * factor:.3g} {unit}"
    return f"{value * 1e9:.1g} nK" if value else "0 K"
