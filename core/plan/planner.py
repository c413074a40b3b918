"""The planner: effects that are simulated, coarsened or dropped within an error budget."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from ..configuration.pipeline_file import PipelineFile
from ..errors import ZondaError
from ..machine import available_memory, available_threads
from .bounds import OTHER_MODES, Bound, Choice, Context, Effect, Estimate, add, exact, full
from .decide import Decided, check_droppable, decide, limits, named
from .planning import planning_of
from .pointing import context_of
from .prediction import memory_of
from .result import Plan
from .structure import Structure, prune

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
        structure = prune(pipeline, [k.partition(".")[0] if k not in labels else k
                                     for k in wishes.keep])  # fmt: skip
    context = context_of(pipeline, scene, structure, band)
    budget = limits(file.header.budget, context.map_noise, context.depth.sample)
    allowed = {m: v for m, v in budget.items() if m in context.metrics}
    effects, left = _effects(file, structure, context, wishes.drop)
    decided = decide(
        effects,
        allowed,
        kept=named(wishes.keep, effects, labels),
        forced={
            d.name
            for d in effects
            if d.effect.name == NAME or any(d.means(name) for name in wishes.drop)
        },
        prune_all=wishes.prune_all,
        joined=context.joined,
    )
    item = 8 if pipeline.precision == "float64" else 4
    threads = wishes.threads or available_threads()
    return Plan(
        structure,
        tuple(decided),
        limits=allowed,
        spent={
            m: sum(d.choice.bound.get(m, 0.0) for d in decided if d.chosen > 0) for m in allowed
        },
        noise=(left.depth.sample, left.map_noise, left.coverage.hits if left.coverage else 0.0),
        memory=memory_of(left, item, threads, wishes.memory or available_memory() // 2),
        context=context,
    )


def _check_arguments(file: Any, wishes: Wishes) -> None:
    if not isinstance(file, PipelineFile):
        cure = "write zonda.plan(zonda.load(path_or_name))"
        raise ZondaError(
            f"a plan is made of a pipeline file, not of {file!r:.60}", place="zonda plan", cure=cure
        )
    for what, names in (("keep", wishes.keep), ("drop", wishes.drop)):
        if isinstance(names, str):
            cure = f"write {what}=[{names!r}]"
            raise ZondaError(
                f"{what} is a list of names, not the text {names!r}", place="zonda plan", cure=cure
            )


def _effects(
    file: PipelineFile, structure: Structure, context: Context, drop: Sequence[str]
) -> tuple[list[Decided], Context]:
    """Effects of all operators, those of one that is dropped altogether as one; and the context
    without such operators.
    """
    estimates = {o.label: planning_of(o).estimate(context) for o in context.operators}
    pipeline = file.pipeline()
    effects = [Decided(label, e) for label, estimate in estimates.items() for e in estimate.effects]
    effects.append(Decided("pipeline", _precision(pipeline.precision, context)))
    check_droppable(drop, effects, [o.label for o in pipeline.operators])
    whole = [label for label in structure.operators if label in drop]
    if not whole:
        return effects, context
    left = _without(file, structure, whole, context.band)
    effects = [d for d in effects if d.operator not in whole]
    return effects + [
        Decided(label, _everything_of(label, estimates, context, left)) for label in whole
    ], left


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


def _without(
    file: PipelineFile, structure: Structure, dropped: Sequence[str], band: str
) -> Context:
    """The context of the bounds without these operators (labels). Raises ZondaError if the others
    cannot run without one.
    """
    pipeline = file.pipeline()
    every = {o.label: o for o in pipeline.operators if o.label in structure.operators}
    others = [o for label, o in every.items() if label not in dropped]
    made = frozenset().union(*(o.provides for o in others if not o.requires & o.provides))
    for label in dropped:
        for o in others:
            if missing := (o.requires & every[label].provides) - made:
                what = " and ".join(sorted(missing))
                raise ZondaError(
                    f"{label!r} cannot be dropped: {o.label} reads its {what}, which no other step"
                    " makes",
                    place="zonda plan",
                    cure="remove this --drop, or drop both",
                )
    kept = tuple(o.label for o in others)
    return context_of(pipeline, file.scene(), dataclasses.replace(structure, operators=kept), band)


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
