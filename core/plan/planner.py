"""`zonda.plan`, and the plan of a run: effects that are simulated, coarsened or dropped within an
error budget.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from ..configuration.pipeline_file import PipelineFile
from ..errors import ZondaError
from ..machine import available_memory, available_threads
from ..pipeline import Pipeline
from ..run.budget import files_of
from ..run.settings import Settings
from .bounds import OTHER_MODES, Bound, Choice, Context, Effect, Estimate, add, exact, full
from .decide import Decided, check_droppable, decide, limits, named
from .planning import planning_of
from .pointing import context_of, samples_of
from .prediction import Timing, memory_of, timed
from .result import Plan, PlanOfBand, PlanSummary, unplanned
from .structure import Structure, prune

NAME = "everything"
"""Name of the effect of an operator that is dropped altogether."""


PLANNED_FROM = 200_000_000
"""Detectors x samples x bands of a scene from which it is planned unasked: below, a run takes less
time than planning could save."""


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
    """Plan a pipeline file. A step has one form for all bands of a camera: a coarser one, where its
    bound fits in the budget of each band.

    Parameters
    ----------
    keep
        Effects or operators that stay as the pipeline asks for them (``poles``,
        ``PinkNoise.poles``, ``PinkNoise``).
    drop
        Effects or operators to leave out, whatever that costs; their bounds are stated.
    prune_all
        False: leave nothing out, coarsen nothing (``--no-prune``); ``drop`` still holds.
    threads, memory
        Threads and bytes of the run whose memory is predicted; decisions do not depend on them.
        None: those of this machine.
    measure
        Run slices of a few seconds to predict the CPU time; decisions do not depend on it.

    Raises
    ------
    ZondaError
        For a name that is not in the plan, or a budget that is not a number from 0 to 1.
    """
    _check_arguments(file, keep, drop)
    pipeline = file.pipeline()
    scene = file.scene()
    labels = [o.label for o in pipeline.operators]
    structure = Structure.of_all(pipeline)
    if prune_all:
        kept = [name if name in labels else name.partition(".")[0] for name in keep]
        structure = prune(pipeline, kept)
    whole = [label for label in structure.operators if label in drop]
    remaining = _without(pipeline, structure, whole) if whole else structure
    names = [band.name for band in scene.instrument.bands] or [""]
    threads = threads or available_threads()
    free = memory or available_memory() // 2
    run = {"threads": threads, "files": files_of(free)}
    bands = {name: _in_band(name, file, drop, structure, remaining, run) for name in names}
    every = [d for band in bands.values() for d in band.decided]
    decided = decide(
        [band.decided for band in bands.values()],
        [band.limits for band in bands.values()],
        kept=named(keep, every, labels),
        forced={d.name for d in every if d.effect.name == NAME or any(map(d.means, drop))},
        prune_all=prune_all,
        joined=bands[names[0]].joined,
    )
    contexts = [band.context for band in bands.values()]
    dtype = np.float64 if pipeline.precision == "float64" else np.float32
    made = Plan(
        structure,
        {
            name: replace(bands[name], decided=tuple(own))
            for name, own in zip(names, decided, strict=True)
        },
        memory_of(contexts, Settings(threads, free, dtype)),
    )
    return replace(made, timing=_measured(made.apply(file), contexts)) if measure else made


def _in_band(
    name: str,
    file: PipelineFile,
    drop: Sequence[str],
    structure: Structure,
    remaining: Structure,
    run: Mapping[str, Any],
) -> PlanOfBand:
    """Effects in one band, all in full, and the budget. ``remaining``: the structure without the
    operators that are dropped as a whole.
    """
    pipeline = file.pipeline()
    context = context_of(pipeline, file.scene(), structure, name, **run)
    joined = context.joined
    budget = limits(file.header.budget, context.map_noise, context.depth.sample)
    allowed = {m: v for m, v in budget.items() if m in context.metrics}
    estimates = {o.label: planning_of(o).estimate(context) for o in context.operators}
    found = [Decided(o, e) for o, estimate in estimates.items() for e in estimate.effects]
    found.append(Decided("pipeline", _precision(pipeline.precision, context)))
    check_droppable(drop, found, [o.label for o in pipeline.operators])
    if whole := [label for label in structure.operators if label in drop]:
        left = context_of(file.pipeline(), file.scene(), remaining, name, **run)
        found = [d for d in found if d.operator not in whole]
        found += [Decided(o, _everything_of(o, estimates, context, left)) for o in whole]
        context = left
    return PlanOfBand(tuple(found), allowed, context, joined)


def for_run(
    file: PipelineFile,
    *,
    keep: Sequence[str] = (),
    drop: Sequence[str] = (),
    prune_all: bool | None = None,
    threads: int | None = None,
    memory: int | None = None,
) -> PlanSummary:
    """Summary for a run: a plan from `PLANNED_FROM` samples on, or where one is asked for by
    ``prune_all`` (True), ``keep`` or ``drop``; else what the outputs depend on, in full; everything
    if ``prune_all`` is False. Errors are those of `plan`.
    """
    pipeline = file.pipeline()
    if not (keep or drop or prune_all):
        if prune_all is False:
            return unplanned(Structure.of_all(pipeline), "--no-prune: everything in full")
        samples = samples_of(pipeline, file.scene())
        if samples < PLANNED_FROM:
            few = f"{samples:.2g} samples, less than {PLANNED_FROM:.0e}: no plan is made"
            return unplanned(prune(pipeline), few)
    return plan(file, keep=keep, drop=drop, prune_all=prune_all is not False, threads=threads,
                memory=memory).summary  # fmt: skip


def _measured(file: PipelineFile, contexts: Sequence[Context]) -> Timing | None:
    """CPU time of a planned pipeline; None, with a warning, if a slice of it cannot be run."""
    try:
        every = [o for context in contexts for o in context.observations]
        return timed(file, every, contexts[0].operators)
    except ZondaError as err:
        text = f"no time is predicted, since a slice of the pipeline does not run: {err.message}"
        warnings.warn(text, stacklevel=3)
        return None


def _check_arguments(file: Any, keep: Any, drop: Any) -> None:
    text = cure = ""
    if not isinstance(file, PipelineFile):
        text = f"a plan is made of a pipeline file, not of {file!r:.60}"
        cure = "write zonda.plan(zonda.load(path_or_name))"
    for what, names in (("keep", keep), ("drop", drop)):
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
    label: str,
    estimates: Mapping[str, Estimate],
    context: Context,
    left: Context,
) -> Effect:
    """The effects of an operator as one, that is there or not: their sizes, and the part of other
    operators (noise whose level depends on the load) at another level without it. ``left``: without
    the operator."""
    bound = _contributes(label, estimates[label], context)
    for other in left.operators:
        before = context.traits[other.label]
        after = left.traits[other.label]
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
