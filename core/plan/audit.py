"""`zonda plan --audit`: do the omitted effects stay within their bounds?

A slice of the scan, short enough for its cost, is simulated in full, and once more for each effect
that the plan drops or coarsens, with the same random numbers, through the same filters. The bounds
are those that the operators state for the slice. An actual error violates its bound where it
exceeds it by more than two of its own standard errors, which follow from its scatter between parts
of the slice.

Of a map of I, Q and U each plane S is compared. A bound is one of I, the mean of the H samples of a
pixel. For samples of weight a with errors e_i, whose correlations add up to c at most,

    |sum g_i e_i|^2 <= c sum g_i^2 e^2 = (c / H) e^2 / s,   s = w_S / (a H),
    g = a (A^-1)_S r,   w_S = 1 / (A^-1)_SS                                   (1)

(`operators.maps.binning`), so that it holds for the error of S times s^(1/2), which is what is
reported.
"""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..accuracy.metrics import Metric
from ..configuration.pipeline_file import PipelineFile
from ..data import Data, kept
from ..errors import PipelineError
from ..experiment.experiment import AnyVariant, Experiment
from ..experiment.variant import Variant
from ..mapmaker import made_by
from ..signal import Signal
from ..tables import aligned
from ..types import Floats
from .bounds import Choice, Context, add, figure
from .decide import Decided
from .planner import NAME
from .planner import plan as plan_of
from .pointing import DEEP
from .prediction import SECONDS, sliced
from .result import Plan
from .structure import Structure

PARTS = 8
"""Parts of the slice whose scatter gives the standard error."""

SHORTEST = 8.0
"""Shortest slice before detectors are left out, s."""

SAMPLES = 1.5e8
"""Detectors x samples of all runs of an audit, each beside one of the sky alone: some 20 CPU s. The
slice is chosen by it.
"""

HEADLINE, ROUGH = 0.15, 0.4
"""Relative error that the stated noise of a pixel may have: where every sample was counted, in
pixels that lie otherwise than the map's; and where hits were counted on coarse cells, of some of
the samples."""

GIVEN = "sky_given"
"""Name of the signal of the sky that no filter changes."""

ROUNDING = 1e-6
"""Of the stream's rms: differences below are float32 arithmetic in another order, not the effect.
"""


@dataclass(frozen=True)
class Extent:
    """A slice: seconds of the first scan, and every how many detectors."""

    seconds: float
    every: int = 1


def extent(made: Plan, runs: int) -> Extent:
    """The longest slice for which that many runs take no more than `SAMPLES`. It is not made
    shorter than `SHORTEST` for it: detectors are left out instead.
    """
    o, samples = made.context.first, SAMPLES / max(runs, 1)
    seconds = min(max(samples / (o.n_detectors * o.sample_rate), SHORTEST), SECONDS, o.duration)
    every = max(1, math.ceil(seconds * o.sample_rate * o.n_detectors / samples))
    return Extent(seconds, min(every, max(o.n_detectors // 64, 1)))


@dataclass(frozen=True)
class Checked:
    """One effect in one metric: its bound, what the error was, the standard error of that.

    ``exercised``: whether the coarser form changed anything that could show the error; where it did
    not, nothing is said of the bound. ``within``: the bound is no bound but a prediction, which the
    actual value meets within this share of it.
    """

    effect: str
    what: str
    metric: str
    bound: float
    actual: float
    error: float
    exercised: bool = True
    within: float | None = None

    @property
    def verdict(self) -> str:
        """The verdict in words."""
        if self.within is not None:
            return "DISAGREES" if self.violated else "agrees"
        return "VIOLATED" if self.violated else "holds" if self.exercised else "not exercised"

    @property
    def violated(self) -> bool:
        """True if the bound, or the prediction, does not hold."""
        if self.within is not None:
            return not abs(self.actual - self.bound) - 2 * self.error <= self.within * self.bound
        return not self.actual - 2 * self.error <= self.bound


@dataclass(frozen=True)
class Audit:
    """Comparisons of an audit."""

    rows: tuple[Checked, ...]
    slice: str

    @property
    def violated(self) -> bool:
        """True if any bound was violated."""
        return any(r.violated for r in self.rows)

    def __str__(self) -> str:
        nothing = "nothing was coarsened, and no output depends on what was dropped"
        if not self.rows:
            return f"audit of {self.slice}: {nothing}"
        table = []
        for r in self.rows:
            figures = (figure(r.metric, v) for v in (r.bound, r.actual, r.error))
            table.append((r.effect, r.what, r.metric, *figures, r.verdict))
        head = ("effect", "decision", "metric", "bound", "actual", "standard error", "")
        lines = [f"audit of {self.slice}", *aligned(table, head)]
        if all(r.within is not None for r in self.rows):
            lines.append(nothing)
        count = sum(r.violated for r in self.rows)
        idle = sum(not r.exercised for r in self.rows)
        words = f", {idle} not exercised" if idle else ""
        return "\n".join([*lines, f"{len(self.rows)} bounds, {count} violated{words}"])

    def json(self) -> str:
        """The rows as JSON."""
        rows = [{**dataclasses.asdict(r), "violated": r.violated} for r in self.rows]
        return json.dumps({"slice": self.slice, "rows": rows})


@dataclass(frozen=True)
class AuditOfBands:
    """The audits of all bands, by their names."""

    bands: Mapping[str, Audit]

    @property
    def violated(self) -> bool:
        """True if a bound of any band is violated."""
        return any(found.violated for found in self.bands.values())

    def __str__(self) -> str:
        rows = [r for found in self.bands.values() for r in found.rows]
        text = "\n\n".join(f"band {name}: {found}" for name, found in self.bands.items())
        return f"{text}\n\nall bands: {len(rows)} bounds, {sum(r.violated for r in rows)} violated"

    def json(self) -> str:
        """The rows of each band as JSON."""
        return json.dumps(
            {"bands": {name: json.loads(found.json()) for name, found in self.bands.items()}}
        )


def audit_of_bands(file: PipelineFile, made: Plan, *, threads: int | None = None) -> AuditOfBands:
    """`audit` of each band, in a camera that has no other."""
    scene, found = file.scene(), {}
    for name, camera in scene.instrument.cameras.items():
        alone = scene.model_copy(update={"instrument": camera})
        one = dataclasses.replace(made, bands={name: made.bands[name]})
        found[name] = audit(dataclasses.replace(file, _scene=alone), one, threads=threads)
    return AuditOfBands(found)


def audit(
    file: PipelineFile,
    made: Plan,
    *,
    threads: int | None = None,
    seconds: float | None = None,
) -> Audit:
    """Compare every decision of ``made`` with the full simulation of a slice of ``file``, chosen by
    cost (`extent`) where no ``seconds`` are given."""
    chosen = [d for d in made.decided if d.chosen > 0]
    size = extent(made, len(chosen) + 2) if seconds is None else Extent(seconds)
    if made.structure.instead:  # nothing that is made of the complete signal is asked for
        file = made.deciding().apply(file)
    part = sliced(file, size.seconds, size.every)
    labels = tuple(o.label for o in part.pipeline().operators)
    whole = Structure(labels, tuple(part.runs), ())
    kept = (*made.structure.operators, "Slice")
    fewer = dataclasses.replace(whole, operators=tuple(label for label in labels if label in kept))
    dropped = [d.operator for d in chosen if d.effect.name == NAME and d.operator in labels]
    plan = plan_of(part, prune_all=False, drop=dropped)
    words = f"the first {size.seconds:.3g} s of 1 scan"
    if size.every > 1:
        words += f", every {size.every}th detector"
    if made.joined:
        words += (
            f", this band alone: with the others, which {made.joined} joins, the bounds"
            " need not hold"
        )

    def planned(*those: Decided, structure: Structure = whole) -> PipelineFile:
        return plan.deciding(*those, structure=structure).apply(part)

    noise = dataclasses.replace(plan, structure=whole).apply(part)
    rows = _noise(noise, plan, threads)
    if not chosen and fewer == whole:
        return Audit(tuple(rows), words)
    stated = {d.name: d for d in plan.decided}
    same = [s for d in chosen if (s := _on_slice(d, stated)) is not None]
    reference = _variant(_with_sky_given(planned()))
    others: dict[AnyVariant, Choice] = {_variant(planned(d), d.name): d.choice for d in same}
    if fewer != whole:
        nothing = Choice("dropped", "what no output depends on", bound={"map_rms": 0.0})
        others[_variant(planned(structure=fewer), "structure")] = nothing
    if len(same) > 1:
        bound: dict[str, float] = {}
        for d in same:
            # what is bounded for the sky alone is in the stream and the map too
            sky = d.choice.bound.get("peak", 0.0)
            bound = add(bound, {"tod": sky, "map_rms": sky, **d.choice.bound})
        others[_variant(planned(*same), "all together")] = Choice("coarse", "", bound=bound)
    full: list[_Result] = []

    def take(variant: AnyVariant, number: int, found: Mapping[str, _Result]) -> None:
        (result,) = found.values()
        if variant is reference:
            full.append(result)
        else:
            choice = others[variant]
            rows.extend(_compare(str(variant), choice, full[0], result, plan.context))

    Experiment([reference, *others], 1, [_StreamsAndMaps()], threads=threads).run(take=take)
    return Audit(tuple(rows), words)


def _noise(part: PipelineFile, made: Plan, threads: int | None) -> list[Checked]:
    """The white noise of a map pixel of the slice: as the plan states it, and as it is where the
    hits are those of the deep part.

    It is what the map of white noise and atmosphere has more than that of the atmosphere alone,
    through which it is calibrated.
    """
    provided = [made_by(s.operator) for s in part.steps]
    if not made.context.map_noise or not any("white" in p for p in provided):
        return []
    air = ["atmosphere"] if any("atmosphere" in p for p in provided) else []
    runs = {"white": Signal(only=["white", *air], filters="none")}
    runs |= {"air": Signal(only=air, filters="none")} if air else {}
    part = dataclasses.replace(part, header=part.header.model_copy(update={"runs": runs}))
    try:
        products = Variant(part.pipeline(), part.scene()).run(threads=threads).products
    except PipelineError as err:
        if "too large for the map's fixed-point sums" not in err.message:
            raise
        # an opaque atmosphere, calibrated and not filtered: the map's samples have no noise to
        # compare
        return []
    maps = {run: _map_of(products, f"{run}/") for run in runs}
    first, several = maps["white"], sum("map" in p for p in provided) > 1
    if None in maps.values() or several or getattr(first, "smoothed_by", 0.0) > 0:
        return []  # the plan's pixel is none of these maps'
    noise = np.ravel(first.signal - (maps["air"].signal if air else 0.0))
    hits = np.ravel(first.hits)
    seen = (hits > 0) & np.isfinite(noise)
    if np.count_nonzero(seen) < 2 * PARTS:
        return []
    deep = float(np.quantile(hits[seen], DEEP))
    actual, error = _rms(np.array_split(noise[seen] ** 2 * hits[seen] / deep, PARTS))
    within = HEADLINE if made.context.coverage and made.context.coverage.exact else ROUGH
    about = ("white noise", "of the plan", "map_rms")
    return [Checked(*about, made.context.map_noise, actual, error, within=within)]


def _on_slice(d: Decided, stated: Mapping[str, Decided]) -> Decided | None:
    """The same choice with the bound that holds for the slice; None where the slice has no such
    choice.
    """
    mine = stated.get(d.name)
    for number, choice in enumerate(mine.effect.choices if mine else ()):
        if mine and choice.what == d.choice.what:
            return dataclasses.replace(mine, chosen=number)
    return None


@dataclass(frozen=True)
class _Result:
    """Streams and maps of a run.

    Attributes
    ----------
    sky, given, own
        Maps of the sky alone: behind the filters; as it comes in, which a transfer function is
        relative to; with modes of its own, where the pipeline asks for that.
    """

    signal: list[Floats]
    map: Any
    sky: Any = None
    given: Any = None
    own: Any = None


class _StreamsAndMaps(Metric):
    """Streams and maps of a run."""

    def measure(self, data: Data) -> _Result:
        signal = [
            kept(o, "signal")[o.good_detectors][:, o.good_samples]
            for o in data.observations
            if "signal" in o.detdata
        ]
        runs = ("", "sky_alone/", f"{GIVEN}/", "sky_with_own_modes/")
        return _Result(signal, *(_map_of(data.products, run) for run in runs))


def _variant(file: PipelineFile, name: str = "") -> Variant:
    """Variant of a file; its signal is kept if a step makes it."""
    made = any("signal" in s.operator.provides for s in file.steps)
    return Variant(file.pipeline(), file.scene(), name, ("signal",) if made else ())


def _map_of(products: Mapping[str, Any], run: str) -> Any:
    """The first map of a run (``name/``; empty: the complete signal); None where there is none."""
    for name, product in products.items():
        mine = name.startswith(run) if run else "/" not in name
        if mine and hasattr(product, "hits") and hasattr(product, "signal"):
            return product
    return None


def _with_sky_given(file: PipelineFile) -> PipelineFile:
    """The file with a run of the sky that no filter has seen, beside that of the sky alone."""
    runs = dict(file.runs)
    if "sky_alone" in runs:
        runs[GIVEN] = Signal(only=["sky"], filters="none")
    return dataclasses.replace(file, header=file.header.model_copy(update={"runs": runs}))


def _compare(
    name: str,
    choice: Choice,
    full: _Result,
    other: _Result,
    context: Context,
) -> list[Checked]:
    rows = []

    def add(metric: str, actual: float, error: float, rounding: float, plane: str = "") -> None:
        if metric in choice.bound and math.isfinite(actual):
            bound, what = choice.bound[metric], f"{metric} {plane}".strip()
            # a zero bound is tested only if there was something that could change
            exercised = actual > 0 or (bound == 0 and rounding > 0)
            about = (name, choice.what, what)
            rows.append(Checked(*about, bound + rounding, actual, error, exercised))

    scale = ROUNDING * _rms(s * s for s in full.signal)[0]
    if [a.shape for a in full.signal] == [b.shape for b in other.signal]:
        parts = (
            part**2
            for a, b in zip(full.signal, other.signal, strict=True)
            for part in np.array_split(a - b, PARTS, axis=1)
        )
        add("tod", *_rms(parts), scale)
    if full.map is not None and other.map is not None and context.coverage is not None:
        hits, usual = np.ravel(full.map.hits), context.coverage.hits
        for plane, share, one, two in _planes(full.map, other.map):
            difference = np.ravel((one.signal - two.signal) * share)
            deep = (hits >= usual / 2) & np.isfinite(difference)
            if deep.any():
                scaled = difference[deep] ** 2 * hits[deep] / usual
                add("map_rms", *_rms(np.array_split(scaled, PARTS)), scale, plane)
    both = [(full.sky, other.sky), (full.own, other.own)]
    skies = [(one, two) for one, two in both if one is not None and two is not None]
    if skies:
        given = skies[0][0] if full.given is None else full.given
        strongest = float(np.nanmax(np.abs(given.signal), initial=0.0))
        largest: dict[str, float] = {}
        for one, two in skies:
            for plane, share, a, b in _planes(one, two):
                found = float(np.nanmax(np.abs(a.signal - b.signal) * share, initial=0.0))
                largest[plane] = max(largest.get(plane, 0.0), found)
        for plane, value in largest.items():
            add("peak", value, 0.0, ROUNDING * strongest, plane)
            if strongest > 0:
                add("transfer", value / strongest, 0.0, ROUNDING, plane)
    return rows


def _planes(full: Any, other: Any) -> list[tuple[str, Any, Any, Any]]:
    """Name (empty for I), s^(1/2) of equation (1), and the two maps, of each plane."""
    if getattr(full, "polarization", None) is None:
        return [("", 1.0, full, other)]
    with np.errstate(invalid="ignore", divide="ignore"):
        most = float(np.nanmax(full.weights / full.hits, initial=0.0))  # a, or a little less
        both = [(plane, full.stokes(plane), other.stokes(plane)) for plane in "IQU"]
        return [
            (plane.strip("I"), np.sqrt(one.weights / (most * np.maximum(full.hits, 1))), one, two)
            for plane, one, two in both
        ]


def _rms(parts: Iterable[NDArray[Any]]) -> tuple[float, float]:
    """Rms of squares in several parts, and its standard error from the scatter between them,
    sigma(s^2) / (2 rms sqrt(n)).
    """
    means = [float(part.mean()) for part in parts if part.size]
    rms = math.sqrt(sum(means) / max(len(means), 1))
    if len(means) < 2 or rms == 0:
        return rms, 0.0
    return rms, float(np.std(means, ddof=1) / math.sqrt(len(means)) / (2 * rms))
