"""Bounds on errors of the products: effects and their forms, and the scan, noise and filters that
they follow from.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import numpy as np

from ..assembly.signals import Chain
from ..data import Observation
from ..mapmaker import joins
from ..numerics.radiation import LEAST_TRANSMISSION
from ..numerics.smooth import SmoothField
from ..operator import Operator
from ..scene import Scene
from ..types import Floats, Indices

METRICS = {
    "map_rms": "rms error of a map pixel, K",
    "peak": "largest error of the sky's brightness in the map, K",
    "transfer": "largest error of the transfer function",
    "tod": "rms error of one sample of the calibrated time stream, K",
    "psd": "largest relative error of the time stream's power spectrum, before filters",
}
"""What an error may be bounded in."""

Bound = Mapping[str, float]
"""Upper bounds by metric; a metric that is absent is not touched."""

Decision = Literal["full", "coarse", "dropped", "not simulated"]


@dataclass(frozen=True)
class Saving:
    """CPU time that a coarser form saves, as measured in a benchmark scene.

    Attributes
    ----------
    scene
        A shipped pipeline or a scene of ``benchmarks/plan``.
    share
        Share of the CPU time of the run in full (`python benchmarks/plan.py --rungs`).
    """

    scene: str
    share: float


@dataclass(frozen=True)
class Choice:
    """One way to carry out an effect.

    Attributes
    ----------
    decision, what
        Kind, and in a few words what it is (``6 poles``).
    settings
        Parameters of the operator (or of the pipeline: ``precision``) that bring it about.
    leave_out
        The operator does not run at all.
    bound
        Error against the effect as the pipeline asks for it.
    formula
        Where the bound comes from.
    seconds
        Seconds that it saves, stated by planning classes of before: above 0 it is tried after the
        forms that state what they `saves`.
    saves
        Measured saving; None: it saves nothing in this scene, or no plan of a benchmark scene
        affords it, and it is taken only if it is asked for (``--drop``).
    """

    decision: Decision
    what: str
    settings: Mapping[str, Any] = field(default_factory=dict)
    leave_out: bool = False
    bound: Bound = field(default_factory=dict)
    formula: str = ""
    seconds: float = 0.0
    saves: Saving | None = None

    @property
    def pays(self) -> bool:
        """True if the form saves time in this scene."""
        return self.saves is not None or self.seconds > 0

    @property
    def sets(self) -> tuple[Mapping[str, Any], bool]:
        """Settings, and True if the operator is left out."""
        return self.settings, self.leave_out


@dataclass(frozen=True)
class Effect:
    """Something that the sky, the atmosphere, the telescope or the arithmetic does to the products.

    Attributes
    ----------
    name
        Unique in its operator: ``poles``, ``layer 9``.
    choices
        The first is what the pipeline asks for; the others are coarser, each less accurate than the
        one before.
    size, formula
        Upper bound of what the effect contributes (what leaving it out would cost), and where it
        comes from.
    """

    name: str
    choices: tuple[Choice, ...]
    size: Bound = field(default_factory=dict)
    formula: str = ""


@dataclass(frozen=True)
class Cost:
    """CPU seconds stated by planning classes of before; accepted and not used: times are measured.

    Attributes
    ----------
    fixed, per_time, per_sample
        seconds = fixed + per_time N_t + per_sample N_det N_t of one observation.
    once
        Seconds for the whole run.
    """

    fixed: float = 0.0
    per_time: float = 0.0
    per_sample: float = 0.0
    once: float = 0.0
    kernel: str = "stream"
    shared: float = 0.0


@dataclass(frozen=True)
class Estimate:
    """An operator's effects. ``without``: what leaving the whole operator out would cost, where
    that is not what its effects contribute. ``cost`` is accepted and not used."""

    effects: tuple[Effect, ...] = ()
    cost: Cost | None = None
    without: Bound | None = None


@dataclass(frozen=True)
class Traits:
    """Properties of an operator that the bounds of others depend on.

    Attributes
    ----------
    noise
        Adds this much white noise: rms of one sample of the calibrated stream, K; of the quietest
        detector.
    each
        (n_det,) The same of each detector; None: they are alike.
    rms
        Adds a fluctuation of at most this rms to the calibrated stream, K (the smooth mean apart).
    faster
        Rms above a frequency [Hz], K; None: that of all of it.
    peak
        Adds a sky of at most this brightness, K; None: it adds no sky, or does not know.
    pixel
        Makes a map with pixels of this side, rad.
    response
        Amplitude that passes at a frequency [Hz]; None: all.
    removes_common
        Removes what all detectors have in common.
    turns
        Removes modes that it finds in the data: without a part of them it finds others.
    weighs
        Makes a map in which samples are weighed by the inverse variance of their white noise.
    gain_error
        Scatters the detectors' gains by this relative rms, unknown to the calibration.
    """

    noise: float = 0.0
    each: Floats | None = None
    rms: float = 0.0
    faster: Callable[[float], float] | None = None
    peak: float | None = None
    pixel: float = 0.0
    response: Callable[[float], float] | None = None
    removes_common: bool = False
    turns: bool = False
    weighs: bool = False
    gain_error: float = 0.0

    @property
    def loudest(self) -> float:
        """`noise` of the noisiest detector, K."""
        return self.noise if self.each is None else float(self.each.max(initial=0.0))


def add(*bounds: Bound) -> dict[str, float]:
    """The sum of bounds."""
    return {m: sum(b.get(m, 0.0) for b in bounds) for m in METRICS if any(m in b for b in bounds)}


def full(what: str, **more: Any) -> Choice:
    """The first choice of an effect: as the pipeline asks for it."""
    return Choice("full", what, **more)


def exact(name: str, size: Bound, formula: str, what: str = "exact") -> Effect:
    """An effect that has no coarser form."""
    return Effect(name, (full(what),), size, formula)


def single(
    name: str,
    size: Bound,
    formula: str,
    what: str = "exact",
    *,
    without: Bound | None = None,
) -> Estimate:
    """Estimate of an operator with one effect, which has no coarser form."""
    return Estimate((exact(name, size, formula, what),), without=without)


def not_simulated(name: str, what: str, bound: Bound, formula: str) -> Effect:
    """An effect that nature has and zonda leaves out, with a bound on what that costs."""
    choice = Choice("not simulated", what, bound=bound, formula=formula)
    return Effect(name, (choice,), bound, formula)


def figure(metric: str, value: float) -> str:
    """A bound in the unit of its metric, which may name a plane too: ``transfer Q``."""
    return f"{value:.1e}" if metric.split()[0] in ("transfer", "psd") else kelvin(value)


def kelvin(value: float) -> str:
    """A temperature with three figures and a unit that reads well."""
    for factor, unit in ((1.0, "K"), (1e3, "mK"), (1e6, "uK"), (1e9, "nK")):
        if abs(value) * factor >= 1:
            return f"{value * factor:.3g} {unit}"
    return f"{value * 1e9:.1g} nK" if value else "0 K"


OTHER_MODES = "; + 2 x rms of all of the stream, where other modes are removed"
"""Text that `Context.behind_modes` adds to a formula."""

INSTANTS = 64
"""Nodes of a smooth field that are looked at, at most."""

LEAKS = 1.5
"""Factor on what passes a brick wall: a scan has ends."""


@dataclass(frozen=True)
class Coverage:
    """Coverage of the map by the scans.

    Attributes
    ----------
    hits
        Samples per pixel in the deep part of the map (quantile `pointing.DEEP`).
    pixel
        Side of a pixel, rad.
    speed
        Median speed of the boresight on the sky, rad/s.
    exact
        Every sample was counted, in pixels of this side.
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
        sqrt(hits) times the noise of a map pixel, K, where all detectors and scans share in every
        pixel alike: with weights w, sqrt(N sum w^2 sigma^2) / sum w over the N samples.
    """

    sample: float
    weighed: float


@dataclass
class Context:
    """Everything that `Planning.estimate` may look at.

    Attributes
    ----------
    scene, observations
        Observations have their pointing, and efficiencies and noise levels where those are given.
    operators
        Those that take part, in order, labelled.
    traits
        By label.
    coverage
        None: no map is made.
    metrics
        Which errors matter (see `METRICS`).
    """

    scene: Scene
    observations: list[Observation]
    operators: list[Operator]
    traits: dict[str, Traits] = field(default_factory=dict)
    coverage: Coverage | None = None
    metrics: frozenset[str] = frozenset()
    depth: Depth = Depth(0.0, 0.0)
    """The white noise that the run will have."""
    chain: Chain | None = None
    """Steps and signals of each observation."""
    readers: frozenset[str] = frozenset()
    """Labels of the operators that make a product of the time streams themselves
    (`Planning.reads_streams`).
    """
    kept_streams: frozenset[str] = frozenset()
    """Streams that some operator saves, measures or draws besides ``signal``."""
    band: str = ""
    """Which one this is of, where the camera has several."""

    @property
    def first(self) -> Observation:
        """The first observation."""
        return self.observations[0]

    @cached_property
    def lowest(self) -> Observation:
        """The observation at the lowest elevation: there the atmosphere is thickest, and what
        depends on it largest.
        """
        return min(self.observations, key=lambda o: float(o.elevation.min()))

    @property
    def noise(self) -> float:
        """White noise of one sample of the calibrated stream, the quietest detector's, K: (sum of
        squares)^(1/2) over the operators. See `depth` for that of all of them."""
        return math.sqrt(sum(t.noise**2 for t in self.traits.values()))

    @property
    def fluctuation(self) -> float:
        """Largest rms of one sample's fluctuation, all components, K."""
        return math.sqrt(
            sum(t.rms**2 + t.loudest**2 + (t.peak or 0.0) ** 2 for t in self.traits.values())
        )

    @cached_property
    def mean_emission(self) -> float:
        """Largest mean emission in the calibrated stream, K; 0: there is none."""
        return max(map(_calibrated_mean, self.observations), default=0.0)

    @cached_property
    def passed(self) -> float:
        """Largest rms of one sample's fluctuation behind the high-pass filter, K: `LEAKS` of what a
        brick wall on whole scans leaves of it, for scans that do not repeat."""
        return self.weighted(lambda f: 1.0, self.cut, math.inf) * (LEAKS if self.cut > 0 else 1.0)

    def weighted(self, weight: Callable[[float], float], low: float, high: float) -> float:
        """sqrt(int S w^2 df) over a range of frequencies [Hz], K; S of all components, w <= 1
        rising or falling (its larger end of each step of the grid counts)."""
        if low <= 0 and high == math.inf:
            return self.fluctuation
        top = min(high, 0.5 * self.first.sample_rate)
        grid = np.geomspace(max(low, 1e-4 * top), top, 40)
        if low <= 0:
            grid = np.r_[0.0, grid]
        total = 0.0
        for t in self.traits.values():
            parts = np.array([t.faster(float(f)) if t.faster else t.rms for f in grid]) ** 2
            noise = t.loudest**2 * np.maximum(1 - 2 * grid / self.first.sample_rate, 0.0)
            above = (
                parts + noise + (t.peak or 0.0) ** 2 * (1 if high == math.inf else 1 - grid / top)
            )
            w = np.array([weight(float(f)) ** 2 for f in grid])
            last = above[-1] * w[-1] if high == math.inf else 0.0
            total += (
                float(np.maximum(above[:-1] - above[1:], 0.0) @ np.maximum(w[:-1], w[1:])) + last
            )
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
    def joined(self) -> str:
        """Labels of the steps that measure the detectors of all bands together, where there are
        several. Bounds are those of one band: what it alone has in common is not removed, and what
        of another band goes into it is not counted."""
        return " and ".join(o.label for o in self.operators if self.band and joins(o))

    @property
    def removes_common(self) -> bool:
        """A filter removes the detectors' common part."""
        return any(t.removes_common for t in self.traits.values())

    @property
    def turns(self) -> bool:
        """True if a filter finds its modes in the data, so that they turn if a part of the data is
        left out; a filter without a planning class may.
        """
        return any(t.turns for t in self.traits.values())

    @cached_property
    def before_filters(self) -> bool:
        """True if a stream is saved, measured or drawn before a filter acts on it."""
        filtering = {
            label for label, t in self.traits.items() if t.removes_common or t.response is not None
        }
        filters = [k for k, o in enumerate(self.operators) if o.label in filtering]
        readers = [k for k, o in enumerate(self.operators) if o.label in self.readers]
        return bool(filters and readers) and min(readers) < max(filters)

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

        The mean of H samples whose errors have correlation rho has the variance tod^2 sum_ij rho_ij
        / H^2 <= tod^2 c / H, c the number of samples that err together: those of one passage
        through the pixel, and those that fall in it within the correlation time. ``correlated``:
        integral of |rho| over time, s. ``common``: all detectors err alike.
        """
        if self.coverage is None:
            return 0.0
        o = self.first
        cover = self.coverage
        passage = o.sample_rate * cover.pixel / max(cover.speed, 1e-12)
        share = cover.hits / max(self.samples, 1)  # of all samples that fall in one pixel
        if common:
            # while the focal plane covers the pixel, every detector may pass it
            area = math.pi * max(o.focalplane.reach, cover.pixel) ** 2
            rate = max(o.n_detectors * cover.pixel**2 / area, o.n_detectors * share) * o.sample_rate
        else:
            rate = share * o.sample_rate
        together = min(min(passage, correlated * o.sample_rate) + rate * correlated, cover.hits)
        return tod * math.sqrt(min(1.0, max(together, 1.0) / max(cover.hits, 1.0)))

    def bound(self, tod: float, correlated: float = 0.0, common: bool = False) -> dict[str, float]:
        """Bound on map and stream from an error of rms ``tod`` in the stream."""
        return {"tod": tod, "map_rms": self.in_map(tod, correlated, common)}

    def other_modes(self, label: str = "") -> dict[str, float]:
        """Bound on the change beside a part E of the data, where that is left out and other modes
        are removed for it; of what all other steps but ``label`` make, B, and all of the sky.

        With P, P' the projectors on the modes of E + B and of B, Q on the detectors' mean, |.| the
        rms,

            |(1 - P) (E + B) - (1 - P') B|
                <= |(1 - Q) (E + B)| + |(1 - Q) B| <= |(1 - Q) E| + 2 |B|,

        because nothing of the modes' rank leaves less than they do.
        """
        kept = {
            k: t for k, t in self.traits.items() if k != label or t.removes_common or t.response
        }
        others = self if len(kept) == len(self.traits) else replace(self, traits=kept)
        return {
            **self.bound(2 * others.passed, self.first.duration, common=True),
            **self.sky_error(1.0),
            "psd": 0.0,
        }

    def behind_modes(self, bound: Mapping[str, float]) -> dict[str, float]:
        """The bound on an error of a part of the data, behind all filters: where one finds its
        modes in the data, with `other_modes`."""
        return add(bound, self.other_modes()) if self.turns else dict(bound)

    def of_all(self, share: float, common: bool = True) -> dict[str, float]:
        """Bound on an error that is a share of all that is in the stream, the mean emission and the
        sky included.
        """
        rms = share * (self.fluctuation + self.mean_emission)
        return self.bound(rms, self.first.duration, common) | self.sky_error(share)

    def sky_error(self, share: float) -> dict[str, float]:
        """Bound on peak and transfer function from a relative error of the sky's signal."""
        return {"peak": share * self.peak, "transfer": share}


def evenly(number: int, most: int) -> Indices:
    """At most so many numbers from 0 to ``number`` - 1, evenly spaced, with first and last."""
    return np.linspace(0, number - 1, min(most, number)).astype(int)


def calibration(observation: Observation) -> float:
    """Largest factor 1 / (zeta <e^-tau>) over the detectors, of the scan's mean transmission."""
    passed = observation.focalplane.main_beam_efficiency
    if (transmission := observation.smooth.get("transmission")) is not None:
        passed = passed * np.maximum(transmission.time_mean(), LEAST_TRANSMISSION)
    return float(1 / passed.min()) if passed.size else 1.0


def _calibrated_mean(o: Observation) -> float:
    """Largest mean emission of a scan behind the calibration, K; 0: there is none."""
    emission = o.smooth.get("atmosphere")
    transmission = o.smooth.get("transmission")
    if emission is None:
        return 0.0
    share = o.focalplane.illumination_efficiency / o.focalplane.main_beam_efficiency
    largest = share * _largest(emission)
    if transmission is not None:
        largest = largest / np.maximum(-_largest(transmission, -1), LEAST_TRANSMISSION)
    return float(largest.max(initial=0.0))


def _largest(field: SmoothField, sign: int = 1) -> Floats:
    """(n_det,) largest value of a smooth field times ``sign`` over the scan: at the node where the
    detectors' mean is largest, and at `INSTANTS` others at most; all nodes of all detectors would
    take gigabytes.
    """
    values = sign * field.coefficients
    at = np.r_[evenly(values.shape[1], INSTANTS), np.argmax(field.weights.mean(axis=0) @ values)]
    return np.asarray((field.weights @ values[:, at]).max(axis=1))
