"""Plans of cameras with several bands: each band is planned like a camera that has no other, and
one pipeline is run for all.

What a band's map needs is simulated for all of them; what is coarser is so where every band's plan
says so.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..configuration.pipeline_file import PipelineFile
from ..run.budget import BASE
from . import result
from .planner import Wishes, plan_band
from .result import Plan
from .summary import PlanSummary, Prediction


@dataclass(frozen=True)
class PlanOfBands:
    """The plans of all bands, by their names."""

    plans: Mapping[str, Plan]

    @cached_property
    def summary(self) -> PlanSummary:
        """What a run takes from them."""
        return combined({name: made.summary for name, made in self.plans.items()})

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
    """Plan a pipeline file: decide as on a reference machine (one thread, memory for all), predict
    for this one.

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
        Of the run that is predicted [memory in bytes]; decisions do not depend on them. None: those
        of this machine.
    measure
        Run a slice of a few seconds to find the cost of operators that do not state it; decisions
        do not depend on it.

    Returns
    -------
    Plan | PlanOfBands
        The plan, or those of all bands of a camera with several.

    Raises
    ------
    ZondaError
        For a name that is not in the plan, or a budget that is not a number from 0 to 1.
    """
    wishes = Wishes(keep, drop, prune_all, threads, memory, measure)
    names = files_of_bands(file) if isinstance(file, PipelineFile) else {}
    if not names:
        return plan_band(file, wishes)
    return PlanOfBands({name: plan_band(file, wishes, name) for name in names})


def as_dict(made: Plan | PlanOfBands) -> dict[str, Any]:
    """Everything, as JSON takes it."""
    if isinstance(made, Plan):
        return result.as_dict(made)
    return {"bands": {name: result.as_dict(one) for name, one in made.plans.items()}}


def files_of_bands(file: PipelineFile) -> dict[str, PipelineFile]:
    """By name of the band, the file with a camera that has this band alone; empty where the camera
    has one band.
    """
    scene = file.scene()
    return {
        name: dataclasses.replace(file, _scene=scene.model_copy(update={"instrument": camera}))
        for name, camera in (scene.instrument.cameras.items() if scene.instrument.bands else ())
    }


def combined(summaries: Mapping[str, PlanSummary]) -> PlanSummary:
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
    whole = (_added([getattr(s, which) for s in every]) for which in ("prediction", "unpruned"))
    return PlanSummary(tuple(dict.fromkeys(operators)), tuple(runs), settings, short, *whole)


def _added(predictions: list[Prediction]) -> Prediction:
    """Times add up, and of their memory what each holds while another acts."""
    products = sum(p.products for p in predictions)
    seconds: dict[str, float] = {}
    for p in predictions:
        for label, used in p.seconds.items():
            seconds[label] = seconds.get(label, 0.0) + used
    return dataclasses.replace(
        predictions[0],
        seconds=seconds,
        bytes=max(max(p.bytes - p.products, BASE) for p in predictions) + products,
        products=products,
        unknown=tuple(dict.fromkeys(label for p in predictions for label in p.unknown)),
        startup=max(p.startup for p in predictions),
    )
