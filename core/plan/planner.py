"""`zonda plan`: the effects of a scene, their costs, and which are omitted or coarsened within an
error budget.
"""

from __future__ import annotations

import dataclasses
import math
import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..configuration.pipeline_file import PipelineFile
from ..data import Data
from ..errors import ZondaError
from ..machine import available_memory, available_threads
from ..mapmaker import made_by
from ..output import Output
from ..pipeline import Pipeline
from .budget import limits
from .context import Context
from .cost import predict
from .decide import Decided, check_droppable, decide, named
from .estimate import Choice, Cost, Effect, Estimate, full
from .look import look
from .planning import planning_of
from .result import Plan
from .slices import measured
from .structure import Structure, prune, work
from .summary import Prediction
from .whole import everything_of, without

LARGEST_RATIO = 1e5
"""Of a stream's rms to its noise up to which float32 is thought of where the pipeline asks for
float64.
"""

AMPLE = 1 << 60
"""Memory of the machine for which decisions are made: it holds all streams. They must not depend on
the real one, its speed, threads, memory and disk: the same file and seed give the same bits, and
all parts of a campaign's map are made alike."""


@dataclass(frozen=True)
class Wishes:
    """What a plan is asked for, beside the pipeline file: the parameters of `zonda.plan`."""

    keep: Sequence[str] = ()
    drop: Sequence[str] = ()
    prune_all: bool = True
    threads: int | None = None
    memory: int | None = None
    measure: bool = False


def plan_band(file: PipelineFile, wishes: Wishes | None = None, band: str = "") -> Plan:
    """Plan a pipeline file for a camera's only band, or for one ``band`` of several. Errors are
    those of `zonda.plan`.
    """
    wishes = wishes or Wishes()
    keep, drop, prune_all = wishes.keep, wishes.drop, wishes.prune_all
    _check_arguments(file, keep, drop)
    begin = time.process_time()
    pipeline, scene = file.pipeline(), file.scene()
    if not band:
        scene.instrument.check_one_band("zonda plan")
    labels = [o.label for o in pipeline.operators]
    everything = Structure.of_all(pipeline)
    structure = (
        prune(pipeline, [k.partition(".")[0] if k not in labels else k for k in keep])
        if prune_all
        else everything
    )
    context = look(pipeline, scene, structure, band)
    budget = limits(file.header.budget, context.map_noise, context.depth.sample)
    context.limits = allowed = {m: v for m, v in budget.items() if m in context.metrics}
    estimates = {o.label: planning_of(o).estimate(context) for o in context.operators}
    effects, left = _effects(file, structure, context, estimates, drop)
    whole = [label for label in structure.operators if label in drop]
    costs = {label: estimate.cost for label, estimate in estimates.items()}
    item = 8 if pipeline.precision == "float64" else 4
    decided = decide(
        effects,
        allowed,
        predict(context, costs, item, 1, AMPLE, portable=True),
        kept=named(keep, effects, labels),
        forced={
            d.name
            for d in effects
            if d.operator in whole or {d.name, d.effect.name, d.operator} & {*drop}
        },
        prune_all=prune_all,
        joined=context.joined,
    )
    if wishes.measure and (unknown := [label for label, cost in costs.items() if cost is None]):
        costs |= measured(file, unknown)
    machine = wishes.threads or available_threads(), wishes.memory or available_memory() // 2
    now = predict(context, costs, item, *machine)
    prediction = _with_savings(now, decided)
    single = any(d.operator == "pipeline" and d.chosen for d in decided)
    if whole or single:  # what is left out holds nothing
        rest = {o.label: costs[o.label] for o in left.operators}
        prediction = dataclasses.replace(
            prediction, bytes=predict(left, rest, 4 if single else item, *machine).bytes
        )
    pruned = (structure.operators, structure.runs) != (everything.operators, everything.runs)
    unpruned = (
        predict(*_everything_on(pipeline, everything, context, estimates), item, *machine)
        if pruned
        else now
    )
    planning = time.process_time() - begin
    prediction, unpruned = (
        dataclasses.replace(p, startup=p.startup + planning) for p in (prediction, unpruned)
    )
    return Plan(
        structure,
        tuple(decided),
        limits=allowed,
        spent={
            m: sum(d.choice.bound.get(m, 0.0) for d in decided if d.chosen > 0) for m in allowed
        },
        noise=(left.depth.sample, left.map_noise, left.coverage.hits if left.coverage else 0.0),
        prediction=prediction,
        unpruned=unpruned,
        context=context,
        costs={label: cost for label, cost in costs.items() if cost is not None},
    )


def _check_arguments(file: Any, keep: Any, drop: Any) -> None:
    if not isinstance(file, PipelineFile):
        cure = "write zonda.plan(zonda.load(path_or_name))"
        raise ZondaError(
            f"a plan is made of a pipeline file, not of {file!r:.60}", place="zonda plan", cure=cure
        )
    for what, names in (("keep", keep), ("drop", drop)):
        if isinstance(names, str):
            cure = f"write {what}=[{names!r}]"
            raise ZondaError(
                f"{what} is a list of names, not the text {names!r}", place="zonda plan", cure=cure
            )


def _effects(
    file: PipelineFile,
    structure: Structure,
    context: Context,
    estimates: Mapping[str, Estimate],
    drop: Sequence[str],
) -> tuple[list[Decided], Context]:
    """All effects, those of an operator that is dropped altogether as one; and the context without
    such operators.
    """
    pipeline = file.pipeline()
    effects = [Decided(label, e) for label, estimate in estimates.items() for e in estimate.effects]
    effects += [Decided("pipeline", e) for e in _of_pipeline(pipeline, context)]
    check_droppable(drop, effects, [o.label for o in pipeline.operators])
    whole = [label for label in structure.operators if label in drop]
    if not whole:
        return effects, context
    left = without(file, structure, whole, context.band)
    effects = [d for d in effects if d.operator not in whole]
    return effects + [
        Decided(label, everything_of(label, estimates, context, left)) for label in whole
    ], left


def _with_savings(now: Prediction, decided: Iterable[Decided]) -> Prediction:
    """The prediction less what the decisions save."""
    seconds = dict(now.seconds)
    for d in decided:
        if d.operator in seconds:
            saved = seconds[d.operator] if d.choice.leave_out else d.saving(d.chosen, now)
            seconds[d.operator] = max(seconds[d.operator] - saved, 0.0)
    return dataclasses.replace(now, seconds=seconds)


def _everything_on(
    pipeline: Pipeline, everything: Structure, context: Context, estimates: Mapping[str, Estimate]
) -> tuple[Context, dict[str, Cost | None]]:
    """The context and the costs of the complete pipeline."""
    whole = dataclasses.replace(
        context, operators=list(pipeline.operators), work=work(pipeline, everything)
    )
    costs: dict[str, Cost | None] = {}
    for operator in pipeline.operators:
        known = estimates.get(operator.label)
        if known is None:
            if not (isinstance(operator, Output) or planning_of(operator).reads_streams):
                operator.observe(Data(scene=context.scene, observations=list(context.observations)))
            operator.configure(whole.first)
            known = planning_of(operator).estimate(whole)
        costs[operator.label] = known.cost
    return whole, costs


def _of_pipeline(pipeline: Pipeline, context: Context) -> list[Effect]:
    """Precision of the streams. Rounding is independent from sample to sample: 2^-24 / sqrt(3) of
    their rms.
    """
    rms = context.fluctuation * 2.0**-24 / math.sqrt(3.0)
    formula = "2^-24 / sqrt(3) x rms of the stream, independent between samples"
    bound = context.bound(rms)
    if context.noise > 0:
        bound["psd"] = (rms / context.noise) ** 2  # both are white
    if pipeline.precision == "float32":
        return [Effect("precision", (full("float32"),), bound, formula)]
    carries_mean = context.cut == 0 and any("atmosphere" in made_by(o) for o in context.operators)
    if (
        carries_mean or context.fluctuation > LARGEST_RATIO * context.noise
    ):  # the filters refuse float32 there
        return [Effect("precision", (full("float64"),), bound, formula)]
    seconds = 4e-9 * context.samples
    single = Choice(
        "coarse", "float32", {"precision": "float32"}, bound=bound, formula=formula, seconds=seconds
    )
    return [Effect("precision", (full("float64"), single), bound, formula)]
