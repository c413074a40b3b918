"""Predictions of a run: memory from the shapes of what it holds, CPU time from short slices on this
machine.
"""

from __future__ import annotations

import dataclasses
import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from tempfile import TemporaryDirectory
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..configuration.pipeline_file import PipelineFile, Step
from ..data import Data, Observation
from ..focalplane import Focalplane
from ..mapmaker import joins, made_by, makes_products
from ..operator import Operator
from ..output import Output
from ..run.budget import BASE, share_in_step
from ..run.schedule import Chain, schedule
from ..run.settings import Settings
from ..signal import Signal
from .bounds import Context
from .planning import planning_of

POINTED = 200
"""Bytes for one sample of one observation, whatever the detectors: times, boresight, flags."""

SECONDS = 60.0
"""Longest slice, s."""

SAMPLES = 2e7
"""Detectors x samples of the slice that is timed, and of one `SHORTER` times as long."""

SHORTER = 4
TIMES = 2
LEAST_SECONDS = 4.0
"""Length of the timed slice before detectors are left out, s."""


@dataclass(frozen=True)
class Memory:
    """Bytes of a run.

    Attributes
    ----------
    bytes
        At once, at most.
    products
        Held while another band of the camera acts: what steps add up over all scans, and all where
        bands are executed together.
    """

    bytes: float
    products: float = 0.0


def memory_of(context: Context, item: int, threads: int, memory: int) -> Memory:
    """Memory of the pipeline, all signals.

    Parameters
    ----------
    item
        Bytes of one sample of a stream.
    threads, memory
        As in `Settings`, but the memory is that of the whole process.
    """
    longest = max(context.observations, key=lambda o: o.n_samples * o.n_detectors)
    during = [o for o in context.operators if not isinstance(o, Output)]
    held = POINTED * context.times + sum(planning_of(o).memory(longest) for o in during)
    after = sum(planning_of(o).memory(longest) for o in context.operators if isinstance(o, Output))
    dtype = np.float64 if item == 8 else np.float32
    settings = Settings(threads, max(int(memory - BASE - held), 1), dtype)
    work = context.work
    chain = Chain(work.steps, work.signals, work.components)
    products = sum(planning_of(o).memory(longest) for o in during if makes_products(o))
    bands = context.bands_alike
    in_step = None
    if bands > 1:
        alone = dataclasses.replace(
            settings, memory=max(settings.memory - (bands - 1) * products, 1)
        )
        in_step = share_in_step(chain, longest, alone, bands, (bands - 1) * (held - products))
    found = schedule(chain, longest, in_step or settings)
    if in_step is not None:
        products = held + found.bytes
    if any(map(joins, work.steps)):  # its part of the stream of all bands
        products = held + found.bytes + item * longest.n_samples * longest.n_detectors
    return Memory(BASE + max(held + found.bytes, after), products)


@dataclass(frozen=True)
class Timing:
    """CPU seconds of a run, by step: set-up, and what grows with the samples. Imports and planning
    are not counted, nor that streams may be made again if memory is short.
    """

    setup: Mapping[str, float]
    growing: Mapping[str, float]
    slice: str

    @property
    def total(self) -> float:
        """CPU seconds of the whole run."""
        return sum(self.setup.values()) + sum(self.growing.values())

    def of(self, label: str) -> float:
        """CPU seconds of one step."""
        return self.setup.get(label, 0.0) + self.growing.get(label, 0.0)


def timed(file: PipelineFile, observations: Sequence[Observation]) -> Timing:
    """Time of a pipeline from two slices of its first scan, one `SHORTER` times as long as the
    other; each is run `TIMES` times, of which the least time of a step counts.

    A step's time is s_p + s_o n + r N: s_p once (outputs, finishing), s_o for each of n scans,
    r for each of N detectors x samples. ``observations``: of the whole pipeline, every band's.

    Raises
    ------
    ZondaError
        As the pipeline does.
    """
    first, bands = observations[0], {o.instrument.band.name for o in observations}
    detectors = first.n_detectors * len(bands)
    seconds = min(SAMPLES / (detectors * first.sample_rate), SECONDS, first.duration)
    if seconds < LEAST_SECONDS:
        seconds = min(LEAST_SECONDS, first.duration)
    every = max(1, math.ceil(seconds * first.sample_rate * detectors / SAMPLES))
    small = _least([_run(file, seconds / SHORTER, every, False) for _ in range(TIMES)])
    large = _least([_run(file, seconds, every, k == 0) for k in range(TIMES)])
    scans = len(observations) / len(bands)
    samples = sum(o.n_detectors * o.n_samples for o in observations)
    setup: dict[str, float] = {}
    growing: dict[str, float] = {}
    for label, (once, each) in large.seconds.items():
        few = small.seconds.get(label, (0.0, 0.0))[1]
        apart = large.samples - small.samples
        rate = max(each - few, 0.0) / apart if apart else 0.0
        growing[label] = rate * samples
        setup[label] = once + scans * max(min(few, each) - rate * small.samples, 0.0)
    words = f"{seconds:.3g} s of the first scan"
    return Timing(setup, growing, words + (f", every {every}th detector" if every > 1 else ""))


@dataclass(frozen=True)
class _Run:
    samples: int
    seconds: Mapping[str, tuple[float, float]]
    """CPU seconds of each step: once per run, and once per scan."""


def _least(runs: Sequence[_Run]) -> _Run:
    """Least time of each step of some runs of the same slice."""
    found: dict[str, tuple[float, float]] = {}
    for label in runs[0].seconds:
        each = [run.seconds[label] for run in runs if label in run.seconds]
        found[label] = min(once for once, _ in each), min(scan for _, scan in each)
    return _Run(runs[0].samples, found)


def _run(file: PipelineFile, seconds: float, every: int, outputs: bool) -> _Run:
    steps = file.steps if outputs else [s for s in file.steps if not isinstance(s.operator, Output)]
    part = dataclasses.replace(file, steps=_cut(steps, Slice(seconds=seconds, every=every)))
    with TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the plan has warned
        data = part.pipeline().run(part.scene(), output=folder, threads=1)
    found: dict[str, tuple[float, float]] = {}
    for label, stage, used in data.provenance["timings"]:
        if label == Slice.__name__:
            continue
        once, each = found.get(label, (0.0, 0.0))
        whole = stage in ("observe", "finalize")
        found[label] = (once + used, each) if whole else (once, each + used)
    return _Run(sum(o.n_detectors * o.n_samples for o in data.observations), found)


class Slice(Operator):
    """Keep the first samples of the first observations, and every so many detectors: random numbers
    are addressed, not drawn in order, so that all runs over a slice see the same."""

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    observations: int = Field(1, ge=1)
    """Number of observations that are kept."""
    seconds: float = Field(SECONDS, gt=0)
    """Length of each observation, s."""
    every: int = Field(1, ge=1)
    """One detector of so many is kept, and the outermost four."""

    def observe(self, data: Data) -> None:
        """Cut every scan to the slice."""
        data.observations[:] = [self._of(o) for o in data.observations[: self.observations]]

    def _of(self, o: Observation) -> Observation:
        n = min(o.n_samples, max(1, round(self.seconds * o.sample_rate)))
        o = o.thinned(slice(0, n))
        if self.every == 1:
            return o
        plane = o.focalplane
        outer = [int(f(v)) for v in (plane.xi, plane.eta) for f in (np.argmin, np.argmax)]
        kept = np.unique(np.r_[np.arange(0, len(plane), self.every), outer])
        chosen = {f.name: _taken(getattr(plane, f.name), kept) for f in dataclasses.fields(plane)}
        return dataclasses.replace(
            o, focalplane=Focalplane(**chosen), detector_flags=o.detector_flags[kept]
        )


def _taken(values: Any, index: NDArray[np.intp]) -> Any:
    return values[index] if isinstance(values, np.ndarray) else [values[k] for k in index]


def _cut(steps: Sequence[Step], step: Slice) -> tuple[Step, ...]:
    """The steps with a slice after the last one that points."""
    last = max(k for k, s in enumerate(steps) if "boresight" in s.operator.provides)
    return (*steps[: last + 1], Step("Slice", step), *steps[last + 1 :])


def sliced(
    file: PipelineFile, seconds: float = SECONDS, observations: int = 1, every: int = 1
) -> PipelineFile:
    """The same pipeline over a slice, without what writes or draws, with a run of the sky as it is
    in the complete map, and one of the sky with modes of its own where the pipeline has such a
    signal."""
    steps = [
        s
        for s in file.steps
        if not (isinstance(s.operator, Output) or planning_of(s.operator).reads_streams)
    ]
    cut = Slice(seconds=seconds, observations=observations, every=every)
    made = frozenset[str]().union(*(made_by(s.operator) for s in steps))
    sky = "sky" in made and made & {"atmosphere", "white", "pink"}
    runs = {"sky_alone": Signal(only=["sky"], modes="full")} if sky else {}
    if sky and _has_own_modes(file):
        runs["sky_with_own_modes"] = Signal(only=["sky"])
    header = file.header.model_copy(update={"runs": runs})
    return dataclasses.replace(file, steps=_cut(steps, cut), header=header)


def _has_own_modes(file: PipelineFile) -> bool:
    """True if a signal of the sky is filtered by itself, not as a part of the complete one."""
    signals = file.pipeline().signals
    return any(
        signal.filtered
        and not signal.model
        and signals.makers(name)
        and signals.all[name].components <= {"sky"}
        for name, signal in signals.all.items()
        if name
    )
