"""`zonda.plan`: the plan of a pipeline file. Of a camera with several bands each band is planned
like a camera that has no other, and one pipeline is run for all.

What a band's map needs is simulated for all of them; what is coarser is so where every band's plan
says so.
"""

from __future__ import annotations

import dataclasses
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..configuration.pipeline_file import PipelineFile
from ..errors import ZondaError
from ..run.budget import BASE
from .planner import Wishes, plan_band
from .pointing import samples_of
from .prediction import Memory, Timing, timed
from .result import Plan, PlanSummary, as_dict_of, foreseen, unplanned
from .structure import Structure, prune

PLANNED_FROM = 200_000_000
"""Detectors x samples x bands of a scene from which it is planned unasked: below, a run takes less
time than planning could save."""


@dataclass(frozen=True)
class PlanOfBands:
    """The plans of all bands, by their names."""

    plans: Mapping[str, Plan]

    timing: Timing | None = None
    """CPU time of all bands, where it was measured."""

    @cached_property
    def summary(self) -> PlanSummary:
        """Summary for a run of all bands."""
        return combined({name: made.summary for name, made in self.plans.items()}, self.timing)

    def apply(self, file: PipelineFile) -> PipelineFile:
        """The pipeline that is run: an ordinary one, with parameters changed and operators
        omitted.
        """
        return self.summary.apply(file)

    def __str__(self) -> str:
        return (
            "\n\n".join(f"band {name}: {made}" for name, made in self.plans.items())
            + f"\n\nall bands: {self.summary}"
        )

    def as_dict(self) -> dict[str, Any]:
        """Everything, for JSON."""
        bands = {name: one.as_dict() for name, one in self.plans.items()}
        if self.timing is None or self.summary.memory is None:
            return {"bands": bands}
        return {"bands": bands, "prediction": as_dict_of(self.summary.memory, self.timing)}


def plan(
    file: PipelineFile,
    *,
    keep: Sequence[str] = (),
    drop: Sequence[str] = (),
    prune_all: bool = True,
    threads: int | None = None,
    memory: int | None = None,
    measure: bool = False,
) -> Plan | PlanOfBands:
    """Plan a pipeline file.

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

    Returns
    -------
    Plan | PlanOfBands
        The plan, or those of all bands of a camera with several.

    Raises
    ------
    ZondaError
        For a name that is not in the plan, or a budget that is not a number from 0 to 1.
    """
    wishes = Wishes(keep, drop, prune_all, threads, memory)
    names = files_of_bands(file) if isinstance(file, PipelineFile) else {}
    if not names:
        one = plan_band(file, wishes)
        if not measure:
            return one
        return dataclasses.replace(one, timing=_measured(one.apply(file), [one]))
    bands = PlanOfBands({name: plan_band(file, wishes, name) for name in names})
    if not measure:
        return bands
    found = _measured(bands.apply(file), list(bands.plans.values()))
    return dataclasses.replace(bands, timing=found)


def _measured(file: PipelineFile, plans: Sequence[Plan]) -> Timing | None:
    """CPU time of a planned pipeline; None, with a warning, if a slice of it cannot be run."""
    try:
        return timed(file, [o for made in plans for o in made.context.observations])
    except ZondaError as err:
        text = f"no time is predicted, since a slice of the pipeline does not run: {err.message}"
        warnings.warn(text, stacklevel=3)
        return None


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


def files_of_bands(file: PipelineFile) -> dict[str, PipelineFile]:
    """The file with a camera that has one band alone, by name of the band; empty if the camera has
    one band.
    """
    scene = file.scene()
    return {
        name: dataclasses.replace(file, _scene=scene.model_copy(update={"instrument": camera}))
        for name, camera in (scene.instrument.cameras.items() if scene.instrument.bands else ())
    }


def combined(summaries: Mapping[str, PlanSummary], timing: Timing | None = None) -> PlanSummary:
    """One summary for all bands: all operators and signals that one of them needs, settings that
    all of them have.
    """
    every = list(summaries.values())
    first = every[0]
    order = max((s.operators for s in every), key=len)
    operators = [*order, *(label for s in every for label in s.operators if label not in order)]
    runs = dict.fromkeys(run for s in every for run in s.runs)
    settings: dict[str, dict[str, Any]] = {}
    for label, own in first.settings.items():
        common = {
            key: value
            for key, value in own.items()
            if all(s.settings.get(label, {}).get(key) == value for s in every)
        }
        if common:
            settings[label] = common
    short = [(f"{name}: {row[0]}", *row[1:]) for name, s in summaries.items() for row in s.short]
    memory = _added([s.memory for s in every if s.memory is not None])
    return PlanSummary(tuple(dict.fromkeys(operators)), tuple(runs), settings, short, memory,
                       foreseen(memory, timing))  # fmt: skip


def _added(each: list[Memory]) -> Memory:
    """Memory of all bands: what each holds while another acts adds up."""
    products = sum(m.products for m in each)
    largest = max(max(m.bytes - m.products, BASE) for m in each)
    return Memory(largest + products, products)
