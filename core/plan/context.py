"""What the bounds are judged by: the scan, the noise of the products, the filters on the way to them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data import Data, Observation
from ..numerics.projection import rotation_matrices
from ..operator import Operator
from ..pipeline import Pipeline
from ..scene import Scene
from .estimate import Traits
from .planning import planning_of
from .structure import STREAMS, Structure, selected

DEEP = 0.9
"""Quantile of the hits over the covered map: its deeper part has the least noise, so what holds there holds everywhere."""

CELLS, POINTS, DETECTORS = 32, 8192, 96
"""Hits are counted on CELLS x CELLS cells from at most about POINTS instants of all scans and DETECTORS detectors of each; in
pixels where no more samples than that are taken."""


LOOKED_AT = 4
"""Observations whose levels of noise are looked at, apart from those at the extremes of elevation."""

INSTANTS = 64
"""Nodes of a smooth field that are looked at, at most."""

LEAKS = 1.5
"""Factor on what passes a brick wall: a scan has ends."""


@dataclass(frozen=True)
class Coverage:
    """How the scans cover the map.

    Attributes
    ----------
    hits
        Samples per pixel in the deep part of the map (quantile `DEEP`).
    pixel
        Side of a pixel, rad.
    speed
        Median speed of the boresight on the sky, rad/s.
    exact
        Whether every sample was counted, in pixels of this side.
    """

    hits: float
    pixel: float
    speed: float
    exact: bool = False


@dataclass(frozen=True)
class Depth:
    """White noise of all scans.

    Attributes
    ----------
    sample
        rms of one sample of the calibrated stream over detectors and scans, K.
    weighed
        sqrt(hits) times the noise of a map pixel, K, where all detectors and scans share in every pixel alike: with weights w,
        sqrt(N sum w^2 sigma^2) / sum w over the N samples.
    """

    sample: float
    weighed: float


@dataclass
class Context:
    """Everything an `Operator.estimate` may look at.

    Attributes
    ----------
    scene, observations
        Observations have their pointing, and efficiencies and noise levels where those are given.
    operators
        Those that take part, in order, labelled.
    runs
        Number of runs (main and companions) in which each takes part, by label.
    traits
        By label.
    coverage
        None: no map is made.
    metrics
        Which errors matter (see `estimate.METRICS`).
    """

    scene: Scene
    observations: list[Observation]
    operators: list[Operator]
    runs: dict[str, int]
    traits: dict[str, Traits] = field(default_factory=dict)
    coverage: Coverage | None = None
    metrics: frozenset[str] = frozenset()
    limits: dict[str, float] = field(default_factory=dict)
    """The budget by metric: a coarser form whose bound alone exceeds it need not be looked into."""
    depth: Depth = Depth(0.0, 0.0)
    """The white noise that the run will have."""
    kept_streams: frozenset[str] = frozenset()
    """Streams that some operator saves, measures or draws besides ``signal``."""

    @property
    def first(self) -> Observation:
        """The first observation."""
        return self.observations[0]

    @cached_property
    def lowest(self) -> Observation:
        """The observation at the lowest elevation: there the atmosphere is thickest, and what depends on it largest."""
        return min(self.observations, key=lambda o: float(o.elevation.min()))

    @property
    def noise(self) -> float:
        """White noise of one sample of the calibrated stream, the quietest detector's, K: (sum of squares)^(1/2) over the
        operators. See `depth` for that of all of them."""
        return math.sqrt(sum(t.noise**2 for t in self.traits.values()))

    @property
    def fluctuation(self) -> float:
        """Largest rms of one sample's fluctuation, all components, K."""
        return math.sqrt(sum(t.rms**2 + t.loudest**2 + (t.peak or 0.0) ** 2 for t in self.traits.values()))

    @cached_property
    def mean_emission(self) -> float:
        """Largest mean emission in the calibrated stream, K; 0: there is none."""
        return max((float(_calibrated_mean(o).max(initial=0.0)) for o in self.observations), default=0.0)

    @cached_property
    def passed(self) -> float:
        """Largest rms of one sample's fluctuation behind the high-pass filter, K: `LEAKS` of what a brick wall on whole scans
        leaves of it, for scans that do not repeat."""
        return self.weighted(lambda f: 1.0, self.cut, math.inf) * (LEAKS if self.cut > 0 else 1.0)

    def weighted(self, weight: Callable[[float], float], low: float, high: float) -> float:
        """sqrt(int S w^2 df) over a range of frequencies [Hz], K; S of all components, w <= 1 rising or falling (its larger end
        of each step of the grid counts)."""
        if low <= 0 and high == math.inf:
            return self.fluctuation
        top = min(high, 0.5 * self.first.sample_rate)
        grid = np.geomspace(max(low, 1e-4 * top), top, 40)
        if high < math.inf:
            grid = np.r_[0.0, grid]
        total = 0.0
        for t in self.traits.values():
            parts = np.array([t.faster(float(f)) if t.faster else t.rms for f in grid]) ** 2
            noise = t.loudest**2 * np.maximum(1 - 2 * grid / self.first.sample_rate, 0.0)
            above = parts + noise + (t.peak or 0.0) ** 2 * (1 if high == math.inf else 1 - grid / top)
            w = np.array([weight(float(f)) ** 2 for f in grid])
            last = above[-1] * w[-1] if high == math.inf else 0.0
            total += float(np.maximum(above[:-1] - above[1:], 0.0) @ np.maximum(w[:-1], w[1:])) + last
        return math.sqrt(total)

    @property
    def peak(self) -> float:
        """Largest brightness of the sky, K; 0 where there is none."""
        return sum(t.peak or 0.0 for t in self.traits.values())

    @property
    def map_noise(self) -> float:
        """White noise of a map pixel in the deep part, K: sigma / sqrt(hits)."""
        return self.depth.weighed / math.sqrt(self.coverage.hits) if self.coverage else 0.0

    @property
    def removes_common(self) -> bool:
        """Whether what all detectors have in common is removed."""
        return any(t.removes_common for t in self.traits.values())

    @cached_property
    def before_filters(self) -> bool:
        """Whether a stream is saved, measured or drawn above a filter: what the filters remove is then in it."""
        filters = [k for k, o in enumerate(self.operators) if self._filters(o.label)]
        readers = [k for k, o in enumerate(self.operators) if o.main_run_only]
        return bool(filters and readers) and min(readers) < max(filters)

    def _filters(self, label: str) -> bool:
        traits = self.traits.get(label)
        return traits is not None and (traits.removes_common or traits.response is not None)

    @property
    def samples(self) -> int:
        """Detectors x samples of all observations."""
        return sum(o.n_detectors * o.n_samples for o in self.observations)

    @property
    def times(self) -> int:
        """Samples of all observations."""
        return sum(o.n_samples for o in self.observations)

    def response(self, frequency: float) -> float:
        """Amplitude that the filters pass at a frequency, Hz."""
        return math.prod(t.response(frequency) for t in self.traits.values() if t.response)

    @cached_property
    def cut(self) -> float:
        """Frequency below which the filters pass less than a tenth, Hz; 0: there is none."""
        grid = np.geomspace(1e-4, 0.5 * self.first.sample_rate, 400)
        passed = next((f for f in grid if self.response(float(f)) >= 0.1), grid[0])
        return 0.0 if passed == grid[0] else float(passed)

    def in_map(self, tod: float, correlated: float, common: bool) -> float:
        """Map rms of an error of rms ``tod`` in the stream, K.

        The mean of H samples whose errors have correlation rho has the variance tod^2 sum_ij rho_ij / H^2 <= tod^2 c / H, c
        the number of samples that err together: those of one passage through the pixel, and those that fall in it within the
        correlation time. ``correlated``: integral of |rho| over time, s. ``common``: all detectors err alike.
        """
        if self.coverage is None:
            return 0.0
        o, cover = self.first, self.coverage
        passage = o.sample_rate * cover.pixel / max(cover.speed, 1e-12)
        share = cover.hits / max(self.samples, 1)  # of all samples that fall in one pixel
        if common:
            # while the focal plane covers the pixel, every detector may pass it
            area = math.pi * max(o.focalplane.radius, cover.pixel) ** 2
            rate = max(o.n_detectors * cover.pixel**2 / area, o.n_detectors * share) * o.sample_rate
        else:
            rate = share * o.sample_rate
        together = min(min(passage, correlated * o.sample_rate) + rate * correlated, cover.hits)
        return tod * math.sqrt(min(1.0, max(together, 1.0) / max(cover.hits, 1.0)))

    def bound(self, tod: float, correlated: float = 0.0, common: bool = False) -> dict[str, float]:
        """Bound on map and stream from an error of rms ``tod`` in the stream."""
        return {"tod": tod, "map_rms": self.in_map(tod, correlated, common)}

    def other_modes(self, label: str) -> dict[str, float]:
        """Bound on what changes where other singular modes are removed, because what ``label`` makes is no longer the largest
        of what the detectors have in common: all that the others make, and all of the sky."""
        others = replace(self, traits={k: t for k, t in self.traits.items() if k != label or t.removes_common or t.response})
        return {**self.bound(others.passed, self.first.duration, common=True), **self.sky_error(1.0), "psd": 0.0}

    def affords(self, bound: Mapping[str, float]) -> bool:
        """Whether a bound alone is within the budget."""
        return all(v <= self.limits[m] for m, v in bound.items() if m in self.limits)

    def sky_error(self, share: float) -> dict[str, float]:
        """Bound on peak and transfer function from a relative error of the sky's signal."""
        return {"peak": share * self.peak, "transfer": share}


def look(pipeline: Pipeline, scene: Scene, structure: Structure) -> Context:
    """Point the telescope and gather what the bounds need. ``pipeline`` is the planner's own copy."""
    operators = [o for o in pipeline.operators if o.label in structure.operators]
    data = Data(scene=scene)
    for operator in operators:
        if not (operator.at_end or operator.main_run_only):
            operator.observe(data)
    shown = _some(data.observations)
    for observation in shown:
        for operator in operators:
            operator.configure(observation)
    runs = selected(pipeline, structure)
    streams = frozenset().union(*((o.optional | o.requires) - {"signal"} for o in operators if o.main_run_only))
    context = Context(scene, data.observations, operators, runs, kept_streams=streams)
    context.traits = {o.label: planning_of(o).traits(context.lowest) for o in operators}
    context.depth = _depth(operators, shown, context)
    pixels = [t.pixel for t in context.traits.values() if t.pixel > 0]
    if pixels:
        context.coverage = cover(data.observations, min(pixels))
    context.metrics = _metrics(pipeline, structure, context)
    return context


def _some(observations: Sequence[Observation]) -> list[Observation]:
    """The first, the last, those at the lowest and at the highest elevation, and up to `LOOKED_AT` between them."""
    evenly = np.linspace(0, len(observations) - 1, min(LOOKED_AT, len(observations))).astype(int)
    low = min(range(len(observations)), key=lambda k: float(observations[k].elevation.min()))
    high = max(range(len(observations)), key=lambda k: float(observations[k].elevation.max()))
    return [observations[k] for k in sorted({*evenly.tolist(), low, high})]


def _depth(operators: Sequence[Operator], observations: Sequence[Observation], context: Context) -> Depth:
    """See `Depth`. The quietest detector of all scans is noted in the traits."""
    makers = [o for o in operators if context.traits[o.label].noise > 0]
    if not makers:
        return Depth(0.0, 0.0)
    variances, numbers = [], []
    quietest = dict.fromkeys((o.label for o in makers), math.inf)
    for observation in observations:
        total = np.zeros(observation.n_detectors)
        for operator in makers:
            found = planning_of(operator).traits(observation)
            total += found.noise**2 if found.each is None else found.each**2
            quietest[operator.label] = min(quietest[operator.label], found.noise)
        variances.append(total)
        numbers.append(np.full(len(total), float(observation.n_samples)))
    for label, level in quietest.items():
        context.traits[label] = replace(context.traits[label], noise=level)
    variance, number = np.concatenate(variances), np.concatenate(numbers)
    sample = math.sqrt(float(number @ variance / number.sum()))
    weighs = any(t.weighs for t in context.traits.values()) and bool((variance > 0).all())
    weighed = math.sqrt(float(number.sum() / (number @ (1 / variance)))) if weighs else sample
    return Depth(sample, weighed)


def _calibrated_mean(o: Observation) -> NDArray[np.float64]:
    """(n_det,) largest mean emission of a scan behind the calibration, K."""
    emission, transmission = o.smooth.get("atmosphere"), o.smooth.get("transmission")
    if emission is None:
        return np.zeros(1)
    share = o.focalplane.illumination_efficiency / o.focalplane.main_beam_efficiency
    passed: NDArray[Any] = np.ones(1)
    if transmission is not None:
        passed = np.maximum(-_largest(transmission.weights, -transmission.coefficients), 1e-6)
    return np.asarray(share * _largest(emission.weights, emission.coefficients) / passed, np.float64)


def _largest(weights: NDArray[Any], coefficients: NDArray[Any]) -> NDArray[Any]:
    """(n_det,) largest value of a smooth field over the scan: at the node where the detectors' mean is largest, and at `INSTANTS`
    others at most; all nodes of all detectors would take gigabytes."""
    nodes = coefficients.shape[1]
    evenly = np.linspace(0, nodes - 1, min(INSTANTS, nodes)).astype(int)
    at = np.r_[evenly, np.argmax(weights.mean(axis=0) @ coefficients)]
    return np.asarray((weights @ coefficients[:, at]).max(axis=1))


def _metrics(pipeline: Pipeline, structure: Structure, context: Context) -> frozenset[str]:
    found = set()
    if context.coverage is not None:
        found |= {"map_rms", "peak"}
        made = set().union(*(o.provides for o in context.operators)) & STREAMS
        if made <= {"sky", "signal"} or any(pipeline.runs[r].only == ["sky"] for r in structure.runs):
            found.add("transfer")
    if any(o.main_run_only for o in context.operators) or context.coverage is None:
        found |= {"tod", "psd"}
    return frozenset(found)


def cover(observations: Sequence[Observation], pixel: float) -> Coverage:
    """Hits per pixel of side ``pixel`` [rad] and scan speed, from a thinned set of instants and detectors."""
    points: list[NDArray[np.float64]] = []
    weights: list[NDArray[np.float64]] = []
    speeds: list[NDArray[np.float64]] = []
    passed: list[NDArray[np.float64]] = []
    centre = rotation_matrices(observations[0].boresight_radec[:1])[0]
    number, most = max(POINTS // len(observations), 64), DETECTORS
    if exact := sum(o.n_samples * o.n_detectors for o in observations) <= POINTS * DETECTORS:
        number, most = (max(sizes) for sizes in zip(*((o.n_samples, o.n_detectors) for o in observations), strict=True))
    for o in observations:
        times = np.unique(np.linspace(0, o.n_samples - 1, min(number, o.n_samples)).astype(int))
        rows = np.unique(np.linspace(0, o.n_detectors - 1, min(most, o.n_detectors)).astype(int))
        turn = centre.T @ rotation_matrices(o.boresight_radec[times])
        plane = np.array([-o.focalplane.eta[rows], -o.focalplane.xi[rows], np.ones(len(rows))])
        looking = turn @ plane  # (time, 3, detector)
        front = looking[:, 2] > 0.1
        points.append(np.array([looking[:, 0][front] / looking[:, 2][front], looking[:, 1][front] / looking[:, 2][front]]))
        weights.append(np.full(points[-1].shape[1], o.n_samples * o.n_detectors / (len(times) * len(rows))))
        passage = np.full(len(times), float(o.n_samples))  # samples that a detector takes to cross a pixel, at these instants
        if o.n_samples > 1:
            at = times[:-1]
            ends = rotation_matrices(o.boresight_radec[np.stack([at, at + 1], 1).ravel()])[:, :, 2].reshape(-1, 2, 3)
            speeds.append(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) * o.sample_rate)
            crossing = o.sample_rate * pixel / np.maximum(np.append(speeds[-1], speeds[-1][-1:]), 1e-12)
            passage = np.clip(crossing, 1.0, passage)
        looked = np.maximum(passage * len(times) / o.n_samples, 1.0)
        share = np.stack([1 / looked, o.n_samples * o.n_detectors / (len(times) * len(rows)) / passage])
        passed.append(np.broadcast_to(share[:, :, None], (2, len(times), len(rows)))[:, front])
    where, weight = np.concatenate(points, axis=1), np.concatenate(weights)
    speed = float(np.median(np.concatenate(speeds))) if speeds else 0.0
    if exact:
        index = np.floor(where / pixel).astype(np.int64)
        index -= index.min(axis=1, keepdims=True)
        _, each = np.unique(index[0] * (index[1].max() + 1) + index[1], return_counts=True)
        return Coverage(max(float(np.quantile(each, DEEP)), 1.0), pixel, speed, exact)
    reach = np.maximum(np.ptp(where, axis=1), pixel)
    cells = np.maximum(1, np.minimum(CELLS, np.floor(reach / pixel))).astype(int)
    low = where.min(axis=1)
    side = np.maximum(np.ptp(where, axis=1) / cells, 1e-15)
    column, row = (np.minimum(((where[k] - low[k]) / side[k]).astype(np.int64), cells[k] - 1) for k in (0, 1))
    cell = column * cells[1] + row
    covered = _covered(where, cell, pixel, max(float(side[0] * side[1]) / pixel**2, 1.0), np.concatenate(passed, axis=1))
    counts = np.bincount(cell, weight, len(covered))
    hits = counts[covered > 0] / covered[covered > 0]
    return Coverage(max(float(np.quantile(hits, DEEP)), 1.0), pixel, speed)


def _covered(
    where: NDArray[np.float64], cell: NDArray[np.int64], pixel: float, most: float, passages: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Pixels in each cell that samples fall in, of ``most`` in it, from some points ``where`` (2, n) that fall in u of them.

    ``passages`` (2, n): what each point counts of the passages through pixels that were looked at, and of all there are. Passages
    fall in u = P (1 - exp(-n / P)) of P pixels if they do so at random: P follows from those that were looked at, and then the
    pixels that all of them fall in. Few passages, each through a pixel of its own, do not tell P: it is the whole cell.
    """
    number = int(cell.max()) + 1
    index = np.floor(where / pixel).astype(np.int64)
    index -= index.min(axis=1, keepdims=True)
    one = (cell * (index[0].max() + 1) + index[0]) * (index[1].max() + 1) + index[1]
    _, first = np.unique(one, return_index=True)
    u = np.bincount(cell[first], minlength=number).astype(np.float64)
    looked, whole = (np.maximum(np.bincount(cell, some, number), np.minimum(u, 1.0)) for some in passages)
    pixels = np.minimum(u, most)
    for _ in range(50):
        pixels = np.minimum(u / np.maximum(-np.expm1(-looked / np.maximum(pixels, 1e-9)), 1e-9), most)
    pixels = np.where(looked <= 1.02 * u, most, pixels)
    covered = np.maximum(-pixels * np.expm1(-whole / np.maximum(pixels, 1e-9)), np.minimum(u, most))
    return np.asarray(np.where(u > 0, np.maximum(covered, 1.0), 0.0), np.float64)
