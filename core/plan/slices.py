"""A short slice of a pipeline's scans, for audits and for the cost of operators that state none."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..configuration.pipeline_file import PipelineFile, Step
from ..data import Data, Observation
from ..focalplane import Focalplane
from ..mapmaker import made_by
from ..operator import Operator
from ..output import Output
from ..signal import Signal
from .cost import calibrate
from .estimate import Cost
from .planning import planning_of

SECONDS = 60.0
"""Longest slice, s."""


class Slice(Operator):
    """Keep the first samples of the first observations, and every so many detectors: random numbers
    are addressed, not drawn in order, so that all runs over a slice see the same."""

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    observations: int = Field(1, ge=1)
    """How many are kept."""
    seconds: float = Field(SECONDS, gt=0)
    """How long they last, s."""
    every: int = Field(1, ge=1)
    """Every so many detectors are kept, the outermost four too."""

    def observe(self, data: Data) -> None:
        """Cut every scan to the slice."""
        data.observations[:] = [
            _cut(o, self.seconds, self.every) for o in data.observations[: self.observations]
        ]


def _cut(o: Observation, seconds: float, every: int) -> Observation:
    n = min(o.n_samples, max(1, round(seconds * o.sample_rate)))
    o = o.thinned(slice(0, n))
    if every == 1:
        return o
    plane = o.focalplane
    outer = [int(f(v)) for v in (plane.xi, plane.eta) for f in (np.argmin, np.argmax)]
    kept = np.unique(np.r_[np.arange(0, len(plane), every), outer])
    chosen = {f.name: _taken(getattr(plane, f.name), kept) for f in dataclasses.fields(plane)}
    return dataclasses.replace(
        o, focalplane=Focalplane(**chosen), detector_flags=o.detector_flags[kept]
    )


def _taken(values: Any, index: NDArray[np.intp]) -> Any:
    return values[index] if isinstance(values, np.ndarray) else [values[k] for k in index]


def sliced(
    file: PipelineFile, seconds: float = SECONDS, observations: int = 1, every: int = 1
) -> PipelineFile:
    """The same pipeline over a slice, without what writes or draws, with a run of the sky as it is
    in the complete map, and one of the sky with modes of its own where the pipeline has such a
    signal."""
    steps: list[Step] = []
    for step in file.steps:
        o = step.operator
        if isinstance(o, Output) or planning_of(o).reads_streams:
            continue
        if "boresight" not in o.provides and steps and "boresight" in steps[-1].operator.provides:
            steps.append(
                Step("Slice", Slice(seconds=seconds, observations=observations, every=every))
            )
        steps.append(step)
    made = frozenset[str]().union(*(made_by(s.operator) for s in steps))
    sky = "sky" in made and made & {"atmosphere", "white", "pink"}
    runs = {"sky_alone": Signal(only=["sky"], modes="full")} if sky else {}
    if sky and _has_own_modes(file):
        runs["sky_with_own_modes"] = Signal(only=["sky"])
    return dataclasses.replace(
        file, steps=tuple(steps), header=file.header.model_copy(update={"runs": runs})
    )


def _has_own_modes(file: PipelineFile) -> bool:
    """Whether a signal of the sky is filtered by itself, not as a part of the complete one."""
    signals = file.pipeline().signals
    return any(
        signal.filtered
        and not signal.model
        and signals.makers(name)
        and signals.all[name].components <= {"sky"}
        for name, signal in signals.all.items()
        if name
    )


def measured(file: PipelineFile, labels: Sequence[str], seconds: float = 5.0) -> dict[str, Cost]:
    """Cost of operators that state none, from a slice that is run twice (the first run compiles).
    What writes is not run.
    """
    part = sliced(file, seconds)
    part = dataclasses.replace(part, header=part.header.model_copy(update={"runs": {}}))
    for _ in range(2):
        data = part.pipeline().run(part.scene(), threads=1)
    samples = sum(o.n_detectors * o.n_samples for o in data.observations)
    found: dict[str, Cost] = {}
    for label in labels:
        used = sum(s for who, _, s in data.provenance["timings"] if who == label)
        if used > 0:
            found[label] = Cost(per_sample=used / samples / calibrate()["stream"])
    return found
