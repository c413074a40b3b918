"""What the bounds are judged by: the scan, the noise of the products, the filters on the way to them."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from ..data import Data, Observation
from ..numerics.projection import rotation_matrices
from ..operator import Operator
from ..pipeline import Pipeline
from ..scene import Scene
from .estimate import Traits
from .structure import STREAMS, Structure, selected

DEEP = 0.9
"""Quantile of the hits over the covered map: its deeper part has the least noise, so what holds there holds everywhere."""

CELLS, POINTS, DETECTORS = 32, 8192, 96
"""Hits are counted on CELLS x CELLS cells from at most about POINTS instants of all scans and DETECTORS detectors of each."""


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
    """

    hits: float
    pixel: float
    speed: float


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
    kept_streams: frozenset[str] = frozenset()
    """Streams that some operator saves, measures or draws besides ``signal``."""

    @property
    def first(self) -> Observation:
        """The first observation."""
        return self.observations[0]

    @property
    def noise(self) -> float:
        """White noise of one sample of the calibrated stream, K: (sum of squares)^(1/2) over the operators."""
        return math.sqrt(sum(t.noise**2 for t in self.traits.values()))

    @property
    def fluctuation(self) -> float:
        """Largest rms of one sample's fluctuation, all components, K."""
        return math.sqrt(sum(t.rms**2 + t.noise**2 + (t.peak or 0.0) ** 2 for t in self.traits.values()))

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
            noise = t.noise**2 * np.maximum(1 - 2 * grid / self.first.sample_rate, 0.0)
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
        return self.noise / math.sqrt(self.coverage.hits) if self.coverage else 0.0

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
    for operator in operators:
        operator.configure(data.observations[0])
    runs = selected(pipeline, structure)
    streams = frozenset().union(*((o.optional | o.requires) - {"signal"} for o in operators if o.main_run_only))
    context = Context(scene, data.observations, operators, runs, kept_streams=streams)
    context.traits = {o.label: o.traits(data.observations[0]) for o in operators}
    pixels = [t.pixel for t in context.traits.values() if t.pixel > 0]
    if pixels:
        context.coverage = cover(data.observations, min(pixels))
    context.metrics = _metrics(pipeline, structure, context)
    return context


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
    speeds = []
    centre = rotation_matrices(observations[0].boresight_radec[:1])[0]
    number = max(POINTS // len(observations), 64)
    for o in observations:
        times = np.unique(np.linspace(0, o.n_samples - 1, min(number, o.n_samples)).astype(int))
        rows = np.unique(np.linspace(0, o.n_detectors - 1, min(DETECTORS, o.n_detectors)).astype(int))
        turn = centre.T @ rotation_matrices(o.boresight_radec[times])
        plane = np.array([-o.focalplane.eta[rows], -o.focalplane.xi[rows], np.ones(len(rows))])
        looking = turn @ plane  # (time, 3, detector)
        front = looking[:, 2] > 0.1
        points.append(np.array([looking[:, 0][front] / looking[:, 2][front], looking[:, 1][front] / looking[:, 2][front]]))
        weights.append(np.full(points[-1].shape[1], o.n_samples * o.n_detectors / (len(times) * len(rows))))
        if o.n_samples > 1:
            at = times[:-1]
            ends = rotation_matrices(o.boresight_radec[np.stack([at, at + 1], 1).ravel()])[:, :, 2].reshape(-1, 2, 3)
            speeds.append(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) * o.sample_rate)
    where, weight = np.concatenate(points, axis=1), np.concatenate(weights)
    reach = np.maximum(np.ptp(where, axis=1), pixel)
    cells = np.maximum(1, np.minimum(CELLS, np.floor(reach / pixel))).astype(int)
    low = where.min(axis=1)
    side = np.maximum(np.ptp(where, axis=1) / cells, 1e-15)
    column, row = (np.minimum(((where[k] - low[k]) / side[k]).astype(np.int64), cells[k] - 1) for k in (0, 1))
    counts = np.bincount(column * cells[1] + row, weight)
    area = max(float(side[0] * side[1]), pixel**2)
    hits = counts[counts > 0] * min(1.0, pixel**2 / area)
    speed = float(np.median(np.concatenate(speeds))) if speeds else 0.0
    return Coverage(max(float(np.quantile(hits, DEEP)), 1.0), pixel, speed)
