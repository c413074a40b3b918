"""`zonda plan --audit`: does what was left out stay within its bound?

A slice of the scan, short enough for its cost, is simulated in full, and once more for each effect that the plan drops or
coarsens, with the same random numbers, through the same filters. The bounds are those that the operators state for the slice. An
actual error violates its bound where it exceeds it by more than two of its own standard errors, which follow from its scatter
between parts of the slice.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from ..configuration.pipeline_file import PipelineFile, Step
from ..data import Data, Observation
from ..focalplane import Focalplane
from ..operator import Operator
from ..run.companion import Companion
from .context import Context
from .cost import calibrate
from .estimate import Choice, Cost
from .planner import Decided, Plan, plan
from .structure import Structure

PARTS = 8
"""Parts of the slice whose scatter gives the standard error."""

SECONDS, SHORTEST = 60.0, 8.0
"""Longest slice, and the shortest before detectors are left out, s."""

COST = 20.0
"""CPU seconds [reference machine] that an audit may take, all its runs: the slice is chosen by it."""

ROUNDING = 1e-6
"""Of the stream's rms: differences below are float32 arithmetic in another order, not the effect."""


class Slice(Operator):
    """Keep the first samples of the first observations, and every so many detectors: random numbers are addressed, not drawn in
    order, so that all runs over a slice see the same."""

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    observations: int = Field(1, ge=1)
    """How many are kept."""
    seconds: float = Field(SECONDS, gt=0)
    """How long they last, s."""
    every: int = Field(1, ge=1)
    """Every so many detectors are kept, the outermost four too."""

    def observe(self, data: Data) -> None:
        """Cut."""
        data.observations[:] = [_cut(o, self.seconds, self.every) for o in data.observations[: self.observations]]


def _cut(o: Observation, seconds: float, every: int) -> Observation:
    n = min(o.n_samples, max(1, round(seconds * o.sample_rate)))
    o = dataclasses.replace(
        o, seconds=o.seconds[:n], boresight_azel=o.boresight_azel[:n], boresight_radec=o.boresight_radec[:n], flags=o.flags[:n]
    )
    if every == 1:
        return o
    plane = o.focalplane
    outer = [int(f(v)) for v in (plane.xi, plane.eta) for f in (np.argmin, np.argmax)]
    kept = np.unique(np.r_[np.arange(0, len(plane), every), outer])
    chosen = {f.name: _taken(getattr(plane, f.name), kept) for f in dataclasses.fields(plane)}
    return dataclasses.replace(o, focalplane=Focalplane(**chosen), detector_flags=o.detector_flags[kept])


def _taken(values: Any, index: NDArray[np.intp]) -> Any:
    return values[index] if isinstance(values, np.ndarray) else [values[k] for k in index]


@dataclass(frozen=True)
class Extent:
    """A slice: seconds of the first scan, and every how many detectors."""

    seconds: float
    every: int = 1


def extent(made: Plan, runs: int) -> Extent:
    """The longest slice for which that many runs, each beside one of the sky alone, take no more than `COST`.

    Set-up (reading, convolving, laying out) is counted once for each run; what remains buys samples. A slice is not made shorter
    than `SHORTEST` for it: detectors are left out instead.
    """
    o, estimates = made.context.first, made.costs
    fixed = sum(c.fixed + c.once for c in estimates.values())
    rate = 2 * sum(c.per_sample for c in estimates.values())
    samples = max(COST / max(runs, 1) - fixed, 0.25 * COST / max(runs, 1)) / max(rate, 1e-9)
    seconds = min(max(samples / (o.n_detectors * o.sample_rate), SHORTEST), SECONDS, o.duration)
    every = max(1, math.ceil(seconds * o.sample_rate * o.n_detectors / samples))
    return Extent(seconds, min(every, max(o.n_detectors // 64, 1)))


@dataclass(frozen=True)
class Checked:
    """One effect in one metric: its bound, what the error was, the standard error of that."""

    effect: str
    what: str
    metric: str
    bound: float
    actual: float
    error: float

    @property
    def violated(self) -> bool:
        """Whether the bound does not hold."""
        return not self.actual - 2 * self.error <= self.bound


@dataclass(frozen=True)
class Audit:
    """All comparisons."""

    rows: tuple[Checked, ...]
    slice: str

    @property
    def violated(self) -> bool:
        """Whether any bound was."""
        return any(r.violated for r in self.rows)

    def __str__(self) -> str:
        table = [("effect", "decision", "metric", "bound", "actual", "standard error", "")]
        for r in self.rows:
            bound, actual, error = (f"{v:.2e}" for v in (r.bound, r.actual, r.error))
            table.append((r.effect, r.what, r.metric, bound, actual, error, "VIOLATED" if r.violated else "holds"))
        widths = [max(len(row[k]) for row in table) for k in range(6)]
        lines = [f"audit of {self.slice}"]
        lines += ["  ".join([*(c.ljust(w) for c, w in zip(r, widths, strict=False)), r[6]]).rstrip() for r in table]
        count = sum(r.violated for r in self.rows)
        if not self.rows:
            return f"{lines[0]}: nothing was coarsened, and no output depends on what was dropped"
        lines.append(f"{len(self.rows)} bounds, {count} violated")
        return "\n".join(lines)

    def json(self) -> str:
        """The rows as JSON."""
        return json.dumps({"slice": self.slice, "rows": [{**dataclasses.asdict(r), "violated": r.violated} for r in self.rows]})


def audit(
    file: PipelineFile, made: Plan, *, threads: int | None = None, seconds: float | None = None, observations: int = 1
) -> Audit:
    """Compare every decision of ``made`` with the full simulation of a slice of ``file``, chosen by cost (`extent`) where no
    ``seconds`` are given."""
    chosen = [d for d in made.decided if d.chosen > 0]
    size = extent(made, len(chosen) + 2) if seconds is None else Extent(seconds)
    seconds = size.seconds
    if made.structure.instead:  # nothing that the main run of the file would make is asked for
        file = dataclasses.replace(made, decided=()).apply(file)
    part = sliced(file, seconds, observations, size.every)
    whole = Structure(tuple(o.label for o in part.pipeline().operators), tuple(part.runs), ())
    whole_plan = plan(part, prune_all=False)
    words = f"the first {seconds:.3g} s of {observations} scan{'s' if observations > 1 else ''}"
    if size.every > 1:
        words += f", every {size.every}th detector"
    fewer = tuple(label for label in whole.operators if label in made.structure.operators or label == "Slice")
    if not chosen and fewer == whole.operators:
        return Audit((), words)
    stated = {d.name: d for d in whole_plan.decided}
    same = [s for d in chosen if (s := _on_slice(d, stated)) is not None]
    reference = _run(dataclasses.replace(whole_plan, structure=whole).apply(part), whole_plan.context, threads)
    rows: list[Checked] = []
    for d in same:
        one = dataclasses.replace(whole_plan, structure=whole, decided=(d,))
        rows += _compare(d.name, d.choice, reference, _run(one.apply(part), whole_plan.context, threads), whole_plan.context)
    if fewer != whole.operators and reference.map is not None:
        bare = dataclasses.replace(whole_plan, structure=dataclasses.replace(whole, operators=fewer), decided=())
        result = dataclasses.replace(_run(bare.apply(part), whole_plan.context, threads), signal=[], sky=None)
        nothing = Choice("dropped", "what no output depends on", bound={"map_rms": 0.0})
        rows += _compare("structure", nothing, reference, result, whole_plan.context)
    if len(same) > 1:
        together = dataclasses.replace(whole_plan, structure=whole, decided=tuple(same))
        result = _run(together.apply(part), whole_plan.context, threads)
        bound: dict[str, float] = {}
        for d in same:
            for metric, value in d.choice.bound.items():
                bound[metric] = bound.get(metric, 0.0) + value
        rows += _compare("all together", Choice("coarse", "", bound=bound), reference, result, whole_plan.context)
    return Audit(tuple(rows), words)


def sliced(file: PipelineFile, seconds: float = SECONDS, observations: int = 1, every: int = 1) -> PipelineFile:
    """The same pipeline over a slice, without what writes or draws, with a run of the sky alone."""
    steps: list[Step] = []
    for step in file.steps:
        o = step.operator
        if o.at_end or o.main_run_only:
            continue
        if "boresight" not in o.provides and steps and "boresight" in steps[-1].operator.provides:
            steps.append(Step("Slice", Slice(seconds=seconds, observations=observations, every=every)))
        steps.append(step)
    sky = any("sky" in s.operator.provides for s in steps) and any(
        s.operator.provides & {"atmosphere", "white", "pink"} for s in steps
    )
    runs = {"sky_alone": Companion(only=["sky"])} if sky else {}
    return dataclasses.replace(file, steps=tuple(steps), header=file.header.model_copy(update={"runs": runs}))


def measured(file: PipelineFile, labels: Sequence[str], seconds: float = 5.0) -> dict[str, Cost]:
    """Cost of operators that state none, from a slice that is run twice (the first run compiles). What writes is not run."""
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


def _on_slice(d: Decided, stated: dict[str, Decided]) -> Decided | None:
    """The same choice with the bound that holds for the slice; None where the slice has no such choice."""
    mine = stated.get(d.name)
    numbers = [] if mine is None else [k for k, c in enumerate(mine.effect.choices) if c.what == d.choice.what]
    return dataclasses.replace(mine, chosen=numbers[0]) if mine is not None and numbers else None


@dataclass(frozen=True)
class _Result:
    signal: list[NDArray[np.float64]]
    map: Any
    sky: Any


def _run(file: PipelineFile, context: Context, threads: int | None) -> _Result:
    made = any("signal" in s.operator.provides for s in file.steps)
    data = file.pipeline().run(file.scene(), threads=threads, keep=["signal"] if made else ())
    maps = [k for k, v in data.products.items() if hasattr(v, "hits") and hasattr(v, "signal")]
    main = next((data.products[k] for k in maps if "/" not in k), None)
    sky = next((data.products[k] for k in maps if k.startswith("sky_alone/")), None)
    kept = [o for o in data.observations if "signal" in o.detdata]
    return _Result([np.asarray(o.detdata["signal"][o.good_detectors][:, o.good_samples], np.float64) for o in kept], main, sky)


def _compare(name: str, choice: Choice, full: _Result, other: _Result, context: Context) -> list[Checked]:
    rows = []

    def add(metric: str, actual: float, error: float, rounding: float) -> None:
        if metric in choice.bound and math.isfinite(actual):
            rows.append(Checked(name, choice.what, metric, choice.bound[metric] + rounding, actual, error))

    scale = ROUNDING * _rms([float((s * s).mean()) for s in full.signal if s.size])
    if [a.shape for a in full.signal] == [b.shape for b in other.signal]:
        squares = [
            float((p * p).mean())
            for a, b in zip(full.signal, other.signal, strict=True)
            for p in np.array_split(a - b, PARTS, axis=1)
            if p.size
        ]
        add("tod", _rms(squares), _rms_error(squares), scale)
    if full.map is not None and other.map is not None and context.coverage is not None:
        difference, hits = np.ravel(full.map.signal - other.map.signal), np.ravel(full.map.hits)
        deep = (hits >= context.coverage.hits / 2) & np.isfinite(difference)
        if deep.any():
            scaled = difference[deep] ** 2 * hits[deep] / context.coverage.hits
            squares = [float(p.mean()) for p in np.array_split(scaled, PARTS) if p.size]
            add("map_rms", _rms(squares), _rms_error(squares), scale)
    if full.sky is not None and other.sky is not None:
        difference = np.abs(full.sky.signal - other.sky.signal)
        largest = float(np.nanmax(difference, initial=0.0))
        strongest = float(np.nanmax(np.abs(full.sky.signal), initial=0.0))
        add("peak", largest, 0.0, ROUNDING * strongest)
        if strongest > 0:
            add("transfer", largest / strongest, 0.0, ROUNDING)
    return rows


def _rms(squares: Sequence[float]) -> float:
    return math.sqrt(sum(squares) / max(len(squares), 1))


def _rms_error(squares: Sequence[float]) -> float:
    """Standard error of the rms from its scatter between the parts: sigma(s^2) / (2 rms sqrt(n))."""
    rms = _rms(squares)
    if len(squares) < 2 or rms == 0:
        return 0.0
    return float(np.std(squares, ddof=1) / math.sqrt(len(squares)) / (2 * rms))
