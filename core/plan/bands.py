"""Plans of cameras with several bands: each band is planned like a camera that has no other, and one pipeline is run for all.

What a band's map needs is simulated for all of them; what is coarser is so where every band's plan says so.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any

from ..configuration.pipeline_file import PipelineFile
from ..run.budget import BASE
from . import planner, result
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
        """The pipeline that is run: an ordinary one, with parameters changed and operators omitted."""
        return self.summary.apply(file)

    def __str__(self) -> str:
        return "\n\n".join(f"band {name}: {made}" for name, made in self.plans.items()) + f"\n\nall bands: {self.summary}"


def plan(file: PipelineFile, **options: Any) -> Plan | PlanOfBands:
    """Plan a pipeline file, each band of its camera; arguments and errors as of `planner.plan`."""
    names = files_of_bands(file) if isinstance(file, PipelineFile) else {}
    if not names:
        return planner.plan(file, **options)
    return PlanOfBands({name: planner.plan(file, band=name, **options) for name in names})


def as_dict(made: Plan | PlanOfBands) -> dict[str, Any]:
    """Everything, as JSON takes it."""
    if isinstance(made, Plan):
        return result.as_dict(made)
    return {"bands": {name: result.as_dict(one) for name, one in made.plans.items()}}


def files_of_bands(file: PipelineFile) -> dict[str, PipelineFile]:
    """By name of the band, the file with a camera that has this band alone; empty where the camera has one band."""
    scene = file.scene()
    return {
        name: dataclasses.replace(file, _scene=scene.model_copy(update={"instrument": camera}))
        for name, camera in (scene.instrument.cameras.items() if scene.instrument.bands else ())
    }


def combined(summaries: Mapping[str, PlanSummary]) -> PlanSummary:
    """One summary for all bands: all operators and signals that one of them needs, settings that all of them have."""
    every = list(summaries.values())
    first = every[0]
    order = max((s.operators for s in every), key=len)
    operators = [*order, *(label for s in every for label in s.operators if label not in order)]
    runs = dict.fromkeys(run for s in every for run in s.runs)
    settings: dict[str, dict[str, Any]] = {}
    for label, own in first.settings.items():
        common = {key: value for key, value in own.items() if all(s.settings.get(label, {}).get(key) == value for s in every)}
        if common:
            settings[label] = common
    short = [(f"{name}: {row[0]}", *row[1:]) for name, s in summaries.items() for row in s.short]
    whole = (_added([getattr(s, which) for s in every]) for which in ("prediction", "unpruned"))
    return PlanSummary(tuple(dict.fromkeys(operators)), tuple(runs), settings, short, *whole)


def _added(predictions: list[Prediction]) -> Prediction:
    """Bands follow each other scan by scan: times add up, and of their memory what each holds while another acts."""
    products = sum(p.products for p in predictions)
    seconds: dict[str, float] = {}
    for p in predictions:
        for label, used in p.seconds.items():
            seconds[label] = seconds.get(label, 0.0) + used
    return dataclasses.replace(
        predictions[0],
        seconds=seconds,
        bytes=max(max(p.bytes - p.products, BASE) for p in predictions) + products + max(p.shared for p in predictions),
        products=products,
        unknown=tuple(dict.fromkeys(label for p in predictions for label in p.unknown)),
        startup=max(p.startup for p in predictions),
    )
