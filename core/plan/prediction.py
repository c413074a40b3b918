"""Predictions of a run: memory from the shapes of what it holds, CPU time from short slices on this
machine.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from tempfile import TemporaryDirectory

import numpy as np
from pydantic import Field

from ..configuration.pipeline_file import PipelineFile, Step
from ..data import Data, Observation
from ..mapmaker import joins, made_by, makes_products
from ..operator import Operator
from ..output import Output
from ..run.budget import BASE, at_end
from ..run.schedule import Schedule, does_the_same, schedule
from ..run.settings import Settings
from ..run.views import View
from ..signal import Signal
from ..types import Floats
from .bounds import Context
from .planning import planning_of, samples_in

POINTED = 200
"""Bytes for one sample of one observation, whatever the detectors: times, boresight, flags."""

SECONDS = 60.0
"""Longest slice, s."""

SAMPLES = 2e7
"""Detectors x samples of the slice that is timed, and of one `SHORTER` times as long."""

SHORTER = 4
TIMES = 2
COUNTED_DETECTORS = 32
"""Detectors over the whole first scan, in which work is counted, beside the outermost four."""
LEAST_SECONDS = 4.0
"""Length of the timed slice before detectors are left out, s."""


def memory_of(contexts: Sequence[Context], settings: Settings) -> float:
    """Bytes that a run holds at once, at most. ``contexts``: of each band; ``settings``: as of a
    run, but the memory is that of the whole process.
    """
    views, sizes, products = list[View](), list[int](), list[int]()
    threads, pointed = settings.threads, 0
    for context in contexts:
        longest = max(context.observations, key=lambda o: o.n_samples * o.n_detectors)
        assert context.chain is not None
        views.append(View(context.chain, longest))
        steps = [o for o in context.operators if not isinstance(o, Output)]
        pointed += POINTED * context.times
        sizes.append(sum(planning_of(o).held(longest, threads) for o in steps))
        products.append(
            sum(planning_of(o).held(longest, threads) for o in steps if makes_products(o))
        )
    outputs = {o.label: o for c in contexts for o in c.operators if isinstance(o, Output)}
    base, end = BASE + pointed, sum(at_end(views, list(outputs.values())).values())

    def blocks(some: Sequence[View], taken: int) -> Schedule:
        room = max(int(settings.memory - base - taken), 1)
        return schedule(some, replace(settings, memory=room))

    alone = [blocks([view], own) for view, own in zip(views, sizes, strict=True)]
    for k, (view, one) in enumerate(zip(views, alone, strict=True)):  # copies of what is on disk
        sizes[k] += one.mapped + sum(
            each.held(view.observation, threads, one.spilled) - each.held(view.observation, threads)
            for each in map(planning_of, view.chain.steps)
        )
    joined, rest = any(map(joins, views[0].chain.steps)), blocks(views, sum(sizes))
    if len(views) > 1 and (
        joined or (rest.at_once > 1 and does_the_same(views, rest.settings, alone))
    ):
        return base + max(sum(sizes) + rest.bytes, end)
    # band after band: the products of the other bands stay in memory
    each = zip(sizes, alone, products, strict=True)
    return base + max(end, sum(products) + max(h + one.bytes - own for h, one, own in each))


@dataclass(frozen=True)
class Timing:
    """CPU seconds of a run, by step: set-up, and what grows with the samples. Imports and planning
    are not counted, nor that streams may be made again if memory is short. ``basis``: of estimates
    of single steps, in words.
    """

    setup: Mapping[str, float]
    growing: Mapping[str, float]
    slice: str
    basis: Mapping[str, str] = field(default_factory=dict)

    @property
    def total(self) -> float:
        """CPU seconds of the whole run."""
        return sum(self.setup.values()) + sum(self.growing.values())

    def of(self, label: str) -> float:
        """CPU seconds of one step."""
        return self.setup.get(label, 0.0) + self.growing.get(label, 0.0)


def timed(
    file: PipelineFile, observations: Sequence[Observation], observed: Sequence[Operator] = ()
) -> Timing:
    """Time of a pipeline from two slices of its first scan, one `SHORTER` times as long as the
    other; each is run `TIMES` times, of which the least time of a step counts.

    A step's time is s_p + s_o n + r N: s_p once (outputs, finishing), s_o for each of n scans,
    r for each of N detectors x samples; `Planning.finishing` says where finishing grows with N.
    Work that a short slice does not tell (`Planning.counted`) is counted over the whole first scan,
    with few detectors.
    ``observations``: of the whole pipeline, every band's; ``observed``: operators that know them.

    Raises
    ------
    ZondaError
        As the pipeline does.
    """
    first, bands = observations[0], {o.instrument.band.name for o in observations}
    rate = first.n_detectors * len(bands) * first.sample_rate
    know = {o.label: o for o in observed}
    steps = {o.label: planning_of(know.get(o.label, o)) for o in file.pipeline().operators}
    least = max(planning.shortest for planning in steps.values())
    seconds = min(max(SAMPLES / rate, LEAST_SECONDS, SHORTER * least), SECONDS, first.duration)
    every = max(1, math.ceil(seconds * rate / SAMPLES))
    shorter = min(max(seconds / SHORTER, least), seconds)
    brief = _with_operators(file, {label: planning.brief for label, planning in steps.items()})
    less, short = _least(brief, Slice(seconds=shorter, every=every), outputs=False)
    part, long = _least(brief, Slice(seconds=seconds, every=every), outputs=True)
    cut = Slice(seconds=first.duration, every=max(first.n_detectors // COUNTED_DETECTORS, 1))
    for label, step in steps.items():
        if (counted := step.counted(observations)) is not None:
            step.whole = _least(
                _with_operators(file, {label: counted}), cut, outputs=False, times=1
            )[0]
    few, many, samples = (
        samples_in(o) for o in (less.observations, part.observations, observations)
    )
    scans = len(observations) / len(bands)
    setup, growing, basis = dict[str, float](), dict[str, float](), dict[str, str]()
    for label, (once, each, end) in long.items():
        before = short.get(label, np.zeros(3))[1]
        slope = max(each - before, 0.0) / (many - few) if many > few else 0.0
        growing[label] = float(slope * samples)
        setup[label] = float(once + scans * max(min(before, each) - slope * few, 0.0))
        planning = steps.get(label)
        end, words = planning.finishing(float(end), part, observations) if planning else (end, "")
        (growing if words else setup)[label] += float(end)
        if words:
            basis[label] = words
    words = f"{seconds:.3g} s of the first scan"
    words += f", every {every}th detector" if every > 1 else ""
    return Timing(setup, growing, words, basis)


def _with_operators(file: PipelineFile, operators: Mapping[str, Operator]) -> PipelineFile:
    """The pipeline with other ``operators`` of the same labels."""
    labels = [o.label for o in file.pipeline().operators]
    steps = [
        replace(s, operator=operators.get(label, s.operator))
        for label, s in zip(labels, file.steps, strict=True)
    ]
    return replace(file, steps=tuple(steps))


def _least(
    file: PipelineFile, cut: Slice, outputs: bool, times: int = TIMES
) -> tuple[Data, dict[str, Floats]]:
    """Data of a slice, and the least CPU seconds of each step in so many runs: once per run, once
    per scan, and when products are finished. Outputs, if wanted, act in the first run.
    """
    least: dict[str, Floats] = {}
    for k in range(times):
        shown = outputs and k == 0
        steps = [s for s in file.steps if shown or not isinstance(s.operator, Output)]
        part = replace(file, steps=_cut(steps, cut))
        with TemporaryDirectory() as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the plan has warned
            data = part.pipeline().run(part.scene(), output=folder, threads=1)
        found: dict[str, Floats] = {}
        for label, stage, used in data.provenance["timings"]:
            place = {"observe": 0, "finalize": 2}.get(stage, 1)
            found.setdefault(label, np.zeros(3))[place] += used
        del found["Slice"]
        for label, each in found.items():
            least[label] = np.minimum(least.get(label, each), each)
    return data, least


class Slice(Operator):
    """Keep the first samples of the first observation, and every so many detectors: random numbers
    are addressed, not drawn in order, so that all runs over a slice see the same."""

    requires = frozenset({"boresight"})
    seconds: float = Field(SECONDS, gt=0)
    """Length of the observation, s."""
    every: int = Field(1, ge=1)
    """One detector of so many is kept, and the outermost four."""

    def observe(self, data: Data) -> None:
        """Cut the first scan to the slice; leave the others out."""
        o = data.observations[0]
        o = o.thinned(slice(0, max(1, round(self.seconds * o.sample_rate))))
        if self.every > 1:
            plane = o.focalplane
            outer = [int(f(v)) for v in (plane.xi, plane.eta) for f in (np.argmin, np.argmax)]
            kept = np.unique(np.r_[np.arange(0, len(plane), self.every), outer])
            o = replace(o, focalplane=plane.rows(kept), detector_flags=o.detector_flags[kept])
        data.observations[:] = [o]


def _cut(steps: Sequence[Step], step: Slice) -> tuple[Step, ...]:
    """The steps with a slice after the last one that points."""
    last = max(k for k, s in enumerate(steps) if "boresight" in s.operator.provides)
    return (*steps[: last + 1], Step("Slice", step), *steps[last + 1 :])


def sliced(file: PipelineFile, seconds: float = SECONDS, every: int = 1) -> PipelineFile:
    """The same pipeline over a slice, without what writes or draws, with a run of the sky as it is
    in the complete map, and one of the sky with modes of its own where the pipeline has such a
    signal."""
    steps = [
        s
        for s in file.steps
        if not (isinstance(s.operator, Output) or planning_of(s.operator).reads_streams)
    ]
    cut = Slice(seconds=seconds, every=every)
    made = frozenset[str]().union(*(made_by(s.operator) for s in steps))
    runs = {}
    if "sky" in made and made & {"atmosphere", "white", "pink"}:
        runs["sky_alone"] = Signal(only=["sky"], modes="full")
        if _has_own_modes(file):
            runs["sky_with_own_modes"] = Signal(only=["sky"])
    header = file.header.model_copy(update={"runs": runs})
    return replace(file, steps=_cut(steps, cut), header=header)


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
