"""The planner: effects that are simulated, coarsened or dropped within an error budget."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..configuration.pipeline_file import PipelineFile
from ..errors import ZondaError
from ..machine import available_memory, available_threads
from ..pipeline import Pipeline
from ..run.settings import Settings
from .bounds import OTHER_MODES, Bound, Choice, Context, Effect, Estimate, add, exact, full
from .decide import Decided, check_droppable, decide, limits, named
from .planning import planning_of
from .pointing import context_of
from .prediction import memory_of
from .result import Plan
from .structure import Structure, chain_of, prune

NAME = "everything"
"""Name of the effect of an operator that is dropped altogether."""


@dataclass(frozen=True)
class Wishes:
    """Options of a plan: the parameters of `zonda.plan`."""

    keep: Sequence[str] = ()
    drop: Sequence[str] = ()
    prune_all: bool = True
    threads: int | None = None
    memory: int | None = None


def plan_band(file: PipelineFile, wishes: Wishes | None = None, band: str = "") -> Plan:
    """Plan a pipeline file for a camera's only band, or for one ``band`` of several. Errors are
    those of `zonda.plan`.
    """
    wishes = wishes or Wishes()
    _check_arguments(file, wishes)
    pipeline, scene = file.pipeline(), file.scene()
    if not band:
        scene.instrument.check_one_band("zonda plan")
    labels = [o.label for o in pipeline.operators]
    structure = Structure.of_all(pipeline)
    if wishes.prune_all:
        keep = [name if name in labels else name.partition(".")[0] for name in wishes.keep]
        structure = prune(pipeline, keep)
    context = context_of(pipeline, scene, structure, band)
    budget = limits(file.header.budget, context.map_noise, context.depth.sample)
    allowed = {m: v for m, v in budget.items() if m in context.metrics}
    estimates = {o.label: planning_of(o).estimate(context) for o in context.operators}
    effects = [Decided(label, e) for label, estimate in estimates.items() for e in estimate.effects]
    effects.append(Decided("pipeline", _precision(pipeline.precision, context)))
    check_droppable(wishes.drop, effects, labels)
    left, remaining = context, structure
    if whole := [label for label in structure.operators if label in wishes.drop]:
        remaining = _without(pipeline, structure, whole)
        pipeline = file.pipeline()
        left = context_of(pipeline, file.scene(), remaining, band)
        effects = [d for d in effects if d.operator not in whole]
        effects += [Decided(o, _everything_of(o, estimates, context, left)) for o in whole]
    decided = decide(
        effects,
        allowed,
        kept=named(wishes.keep, effects, labels),
        forced={d.name for d in effects if d.effect.name == NAME or any(map(d.means, wishes.drop))},
        prune_all=wishes.prune_all,
        joined=context.joined,
    )
    threads, free = wishes.threads or available_threads(), wishes.memory or available_memory() // 2
    dtype = np.float64 if pipeline.precision == "float64" else np.float32
    return Plan(
        structure,
        tuple(decided),
        limits=allowed,
        spent={m: sum(d.choice.bound.get(m, 0.0) for d in decided if d.chosen) for m in allowed},
        noise=(left.depth.sample, left.map_noise, left.coverage.hits if left.coverage else 0.0),
        memory=memory_of(left, chain_of(pipeline, remaining), Settings(threads, free, dtype)),
        context=context,
    )


def _check_arguments(file: Any, wishes: Wishes) -> None:
    text = cure = ""
    if not isinstance(file, PipelineFile):
        text = f"a plan is made of a pipeline file, not of {file!r:.60}"
        cure = "write zonda.plan(zonda.load(path_or_name))"
    for what, names in (("keep", wishes.keep), ("drop", wishes.drop)):
        if isinstance(names, str):
            text = f"{what} is a list of names, not the text {names!r}"
            cure = f"write {what}=[{names!r}]"
    if text:
        raise ZondaError(text, place="zonda plan", cure=cure)


def _precision(precision: str, context: Context) -> Effect:
    """Precision of the streams. Rounding is independent from sample to sample: 2^-24 / sqrt(3) of
    their rms.
    """
    rms = context.fluctuation * 2.0**-24 / math.sqrt(3.0)
    formula = "2^-24 / sqrt(3) x rms of the stream, independent between samples"
    bound = context.bound(rms)
    if context.noise > 0:
        bound["psd"] = (rms / context.noise) ** 2  # both are white
    return exact("precision", bound, formula, precision)


def _without(pipeline: Pipeline, structure: Structure, dropped: Sequence[str]) -> Structure:
    """The structure without these operators (labels). Raises ZondaError if the others cannot run
    without one.
    """
    every = {o.label: o for o in pipeline.operators if o.label in structure.operators}
    others = {label: o for label, o in every.items() if label not in dropped}
    made = frozenset().union(*(o.provides for o in others.values() if not o.requires & o.provides))
    for label in dropped:
        for o in others.values():
            if missing := (o.requires & every[label].provides) - made:
                what = " and ".join(sorted(missing))
                raise ZondaError(
                    f"{label!r} cannot be dropped: {o.label} reads its {what}, which no other step"
                    " makes",
                    place="zonda plan",
                    cure="remove this --drop, or drop both",
                )
    return replace(structure, operators=tuple(others))


def _everything_of(
    label: str, estimates: Mapping[str, Estimate], context: Context, left: Context
) -> Effect:
    """The effects of an operator as one, that is there or not: their sizes, and the part of other
    operators (noise whose level depends on the load) at another level without it. ``left``: without
    the operator."""
    bound = _contributes(label, estimates[label], context)
    for other in left.operators:
        before, after = context.traits[other.label], left.traits[other.label]
        if (before.loudest, before.noise, before.rms) != (after.loudest, after.noise, after.rms):
            # two levels differ by less than the larger of them
            one = _contributes(other.label, estimates[other.label], context)
            two = _contributes(other.label, planning_of(other).estimate(left), left)
            bound = add(bound, {m: max(one.get(m, 0.0), two.get(m, 0.0)) for m in {*one, *two}})
    text = "sum of what its effects contribute, and of what others make at another level without it"
    if any(t.turns for other, t in context.traits.items() if other != label):
        bound = add(bound, context.other_modes(label))
        text += OTHER_MODES
    dropped = Choice("dropped", "left out", leave_out=True, bound=bound, formula=text)
    return Effect(NAME, (full("in full"), dropped), bound, text)


def _contributes(label: str, estimate: Estimate, context: Context) -> Bound:
    traits = context.traits[label]
    if estimate.without is not None:
        bound: Bound = estimate.without
    elif traits.peak is not None:
        bound = {"tod": traits.peak, "map_rms": traits.peak, "psd": 1.0, **context.sky_error(1.0)}
    else:
        bound = add(*(e.size for e in estimate.effects if e.choices[0].decision != "not simulated"))
    return (
        add(bound, {**context.bound(traits.loudest), "psd": 1.0}) if traits.loudest > 0 else bound
    )
