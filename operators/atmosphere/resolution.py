"""Nodes and steps in time at which one scan's atmosphere is evaluated, so that every error stays
below the tolerance.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from zonda.core.data import Observation
from zonda.core.numerics.smooth import SmoothField
from zonda.core.types import Floats, Integers

from .fluctuations import units_fit
from .turbulence.geometry import ScanPlane, axes, axes_at, crossing, looking, rays
from .turbulence.nodes import (
    GRIDS,
    Layer,
    Nodes,
    candidate_steps,
    choose_nodes,
    differential_rms,
    grid,
    layer_time_error,
    spread_evenly,
    time_error,
    times_with_margin,
)
from .weather.radiative_transfer import ELEVATION_MAX

Emission = Callable[[Floats], Floats]
"""The mean emission [K_RJ] at elevations [rad]."""

SMALLEST_DIFFERENCE = 1e-5
"""Share of the fluctuation that must differ between detectors for the tolerance to be judged by it.
"""

MEAN_SHARE = 0.1
"""The mean emission's error, as a share of what the fluctuation's may be: it is so smooth that this
costs nothing.
"""

WINDOWS = (16, 1 << 14)
"""Number and length [samples] of the parts of a longer scan at which its path is examined."""

LOOKED_AT = 1024
"""Samples of a scan whose velocity and elevation are looked at."""

IN_A_CELL = 4
"""Samples between two steps at which the path's error is looked at: it is a polynomial there, whose
square is right to 1 %.
"""

INTERPOLATED, STREAMS = 330, 2
"""Detectors that are interpolated from a node, in emission and transmission, at the cost of
evaluating a point: 80 ns for ten layers, 0.12 ns for each product; and these two."""

SHORT_STEP = 4
"""Samples: steps are hardly shorter."""

PAYS_FROM = 1 << 18
"""Points (nodes x times) from which coarser steps for single layers are worth their interpolation.
"""


@dataclass(frozen=True)
class Resolution:
    """Nodes and steps in time; the error allowed and those expected, relative to the rms of the
    fluctuation after the beam.

    ``steps``: one for each layer, multiples of ``step``. ``mean_nodes``, ``mean_step``: for the
    mean emission.
    """

    nodes: Nodes
    step: int
    steps: tuple[int, ...]
    tolerance: float
    focal_plane_error: float
    time_error: float
    differential: float
    mean_nodes: Nodes
    mean_step: int


def choose_resolution(
    observation: Observation,
    plane: ScanPlane,
    layers: Sequence[Layer],
    variance: float,
    tolerance: float,
    emission: Emission,
    pwv_rms: float,
) -> Resolution:
    """The coarsest nodes and steps that keep each error below ``tolerance`` of what the focal-plane
    mean, subtracted, leaves.

    Where the detectors are the nodes, since these would cost more (`INTERPOLATED`), the steps in
    time may err by both shares, sqrt(2) of it. ``variance`` is that of the sum of the layers after
    the beam. The mean emission may be wrong by `MEAN_SHARE` of that.
    """
    xi = observation.focalplane.xi
    eta = observation.focalplane.eta
    rms = math.sqrt(variance)
    left = differential_rms(*spread_evenly(xi, eta), layers, plane.stretch)
    # Of the rms of the fluctuation. A single detector, or none apart, is judged as if a hundredth
    # were left.
    tolerance = tolerance * (left / rms if left > SMALLEST_DIFFERENCE * rms else 0.01)
    most = _most_nodes(len(xi), observation.n_samples)
    nodes, error = choose_nodes(xi, eta, layers, tolerance * rms, plane.stretch, most)

    path = observation.once(("path", *looking(observation)), lambda: _Path(observation, xi, eta))
    elevations = np.quantile(path.elevation, [0.0, 0.5, 1.0])
    # What the mean emission may be wrong by, K_RJ (as if 0.01 % of the PWV fluctuated where none
    # does).
    allowed = max(
        MEAN_SHARE * tolerance * float(emission(elevations[1])) * max(pwv_rms, 1e-4),
        1e-9,
    )
    mean_nodes = _mean_nodes(xi, eta, emission, elevations, allowed)

    timing = _Timing(path, observation, plane, layers)
    candidates = candidate_steps(observation.n_samples)
    late_allowed = tolerance * rms * (1.0 if nodes.shape else math.sqrt(2.0))
    slope = float(np.max(abs(_slope(emission, elevations))))
    mean_step = next(s for s in candidates if s == 1 or slope * timing.path_errors(s)[1] <= allowed)
    step, late = timing.common_step(candidates[:-1], late_allowed)
    steps = [step] * len(layers)
    if len(nodes.xi) * observation.n_samples / step > PAYS_FROM:
        late = timing.double(steps, late, late_allowed, candidates[0])
    return Resolution(
        nodes,
        step,
        tuple(steps),
        tolerance,
        error / rms,
        late / rms,
        left / rms,
        mean_nodes,
        mean_step,
    )


def _most_nodes(n_detectors: int, n_samples: int) -> float:
    """Number of nodes from which evaluating every detector costs less, where the series of all fit
    in memory.
    """
    fit = units_fit(n_detectors, n_samples, SHORT_STEP, STREAMS)
    return n_detectors / (1 + n_detectors / INTERPOLATED) if fit else n_detectors


def _slope(emission: Emission, elevation: Floats) -> Floats:
    """d emission / d elevation, K_RJ per rad."""
    h = 1e-4
    low = np.minimum(elevation, ELEVATION_MAX - h)
    return np.asarray((emission(low + h) - emission(low)) / h, np.float64)


def _mean_nodes(
    xi: Floats,
    eta: Floats,
    emission: Emission,
    elevations: Floats,
    allowed: float,
) -> Nodes:
    """The coarsest grid from which the mean emission is within ``allowed`` [K_RJ] at some
    elevations of the boresight.
    """

    def at(xi: Floats, eta: Floats) -> Floats:
        c, s = np.cos(elevations), np.sin(elevations)
        return emission(
            np.arcsin((s + eta[:, None] * c) / np.sqrt(1 + xi * xi + eta * eta)[:, None])
        )

    truth = at(xi, eta)
    for size in GRIDS:
        nodes = grid(xi, eta, size)
        if float(abs(truth - nodes.weights @ at(nodes.xi, nodes.eta)).max()) <= allowed:
            break
    return nodes


class _Timing:
    """Errors of steps in time, for each layer."""

    def __init__(
        self,
        path: _Path,
        observation: Observation,
        plane: ScanPlane,
        layers: Sequence[Layer],
    ) -> None:
        self._path = path
        self._observation = observation
        self._plane = plane
        self._layers = layers
        self._speeds = _speeds(path, plane, layers)
        self._tried: dict[int, tuple[list[float], float]] = {}

    def path_errors(self, step: int) -> tuple[list[float], float]:
        """Errors of the position in each layer [m], and of the elevation [rad].

        Between steps samples count as a comb: where they are none, the wind moves on by its speed
        times their `jitter`.
        """
        if step not in self._tried:
            delta_x, delta_el = self._path.errors(step) if step > 1 else (np.zeros(2), 0.0)
            stretched = self._plane.matrix @ delta_x if self._plane.cone is None else delta_x
            late = self._observation.jitter if step > 1 else 0.0
            blown = [
                float(np.hypot(*(self._plane.drift @ layer.wind))) * late for layer in self._layers
            ]
            here = [
                float(abs(stretched * layer.height).max()) + b
                for layer, b in zip(self._layers, blown, strict=True)
            ]
            self._tried[step] = here, delta_el
        return self._tried[step]

    def common_step(self, candidates: Sequence[int], allowed: float) -> tuple[int, float]:
        """The first of the candidates whose error is at most ``allowed``, and that error; or (1,
        0).
        """
        still = [0.0] * len(self._layers)
        for step in candidates:
            dt = step / self._observation.sample_rate
            if time_error(self._layers, self._speeds, still, dt, allowed) > allowed:
                continue  # even along an exact path
            error = time_error(self._layers, self._speeds, self.path_errors(step)[0], dt)
            if error <= allowed:
                return step, error
        return 1, 0.0

    def double(self, steps: list[int], error: float, allowed: float, largest: int) -> float:
        """Double those of the layers' steps that save most for the error they add; the error
        then.
        """

        @cache
        def layer_error(k: int, step: int) -> float:
            if step == 1:
                return 0.0
            delta = self.path_errors(step)[0][k]
            return layer_time_error(
                self._layers[k],
                self._speeds[k],
                delta,
                step / self._observation.sample_rate,
            )

        spent = error**2
        while True:
            more = {
                k: layer_error(k, 2 * s) - layer_error(k, s)
                for k, s in enumerate(steps)
                if 2 * s <= largest
            }
            fits = [k for k, added in more.items() if spent + added <= allowed**2]
            if not fits:
                return math.sqrt(spent)
            best = min(fits, key=lambda k: (max(more[k], 0.0) * steps[k], k))
            spent, steps[best] = spent + more[best], 2 * steps[best]


def layer_speeds(
    observation: Observation,
    plane: ScanPlane,
    layers: Sequence[Layer],
) -> list[Floats]:
    """Speeds [m/s] of the line of sight of the boresight through each layer, 64 quantiles over the
    scan.
    """
    return _speeds(_Path(observation, np.zeros(1), np.zeros(1)), plane, layers)


def _speeds(path: _Path, plane: ScanPlane, layers: Sequence[Layer]) -> list[Floats]:
    velocity = path.velocity(plane)
    quantiles = (np.arange(64) + 0.5) / 64 * (velocity.shape[1] - 1)
    drifts = (layer.height * velocity - (plane.drift @ layer.wind)[:, None] for layer in layers)
    return [np.interp(quantiles, np.arange(v.shape[1]), np.sort(np.hypot(*v))) for v in drifts]


class _Path:
    """Lines of sight of three points of the focal plane over a scan, and how well a spline in time
    follows them.

    Of long scans some windows are looked at, the first and the last samples among them.
    """

    def __init__(self, observation: Observation, xi: Floats, eta: Floats) -> None:
        self._observation = observation
        centre = np.array([(xi.min() + xi.max()) / 2, (eta.min() + eta.max()) / 2])
        points = np.array([centre, [xi.max(), eta.max()], [xi.min(), eta.max()]]).T
        self._xi: Floats = points[0] if len(xi) > 1 else xi
        self._eta: Floats = points[1] if len(xi) > 1 else eta
        n, number, length = observation.n_samples, *WINDOWS
        starts = (
            [0]
            if n <= number * length
            else np.linspace(0, n - length, number).astype(np.int64).tolist()
        )
        self._windows = [
            slice(start, min(n, start + length) if len(starts) > 1 else n) for start in starts
        ]
        index = np.concatenate([np.arange(w.start, w.stop) for w in self._windows])
        last = np.cumsum([w.stop - w.start for w in self._windows]) - 1
        picked = np.unique(np.linspace(0, max(len(index) - 2, 0), LOOKED_AT).astype(np.int64))
        self._picked = (
            index[picked[~np.isin(picked, last)]] if n > 1 else index
        )  # the next sample is in the same window
        self.elevation = np.arcsin(self._rays(self._picked)[2])
        self._errors: dict[int, tuple[Floats, float]] = {}

    def _rays(self, index: Integers | slice) -> Floats:
        return rays(axes(self._observation.boresight_azel[index]), self._xi, self._eta)

    def velocity(self, plane: ScanPlane) -> Floats:
        """Velocity of the crossing point on the plane per metre of height, 1/s, over the scan: (2,
        <= LOOKED_AT).
        """
        if self._observation.n_samples == 1:
            return np.zeros((2, 1))
        ends = plane.unroll(
            np.stack([crossing(self._rays(self._picked + k))[:, 0] for k in (0, 1)], axis=1)
        )
        return np.asarray((ends[:, 1] - ends[:, 0]) * self._observation.sample_rate, np.float64)

    def errors(self, step: int) -> tuple[Floats, float]:
        """Errors of `_errors_of`, each worked out once: bands share a path."""
        if step not in self._errors:
            self._errors[step] = self._errors_of(step)
        return self._errors[step]

    def _errors_of(self, step: int) -> tuple[Floats, float]:
        """Rms spline errors of the crossing X (2,) and of the elevation [rad], the worst of the
        three points; from `IN_A_CELL` samples of each cell."""
        squares = np.zeros(9)
        total = 0
        each = max(1, step // IN_A_CELL)
        for window in self._windows:
            n = window.stop - window.start
            index = window.start + times_with_margin(n, step)
            u = rays(axes_at(self._observation.boresight_azel, index, step), self._xi, self._eta)
            here = self._rays(slice(window.start, window.stop, each))
            count = -(-n // each)
            rows = 3 * len(self._xi)
            truth = np.concatenate([crossing(here).reshape(-1, count), np.arcsin(here[2])])
            values = np.concatenate([crossing(u).reshape(-1, len(index)), np.arcsin(u[2])])
            spline = SmoothField.from_values(np.eye(rows), values, step // each, count)
            found = ((spline.evaluate(slice(0, rows), slice(0, count)) - truth) ** 2).sum(1)
            squares[:rows] += found
            total += count
        rms = np.sqrt(squares[: 3 * len(self._xi)] / total).reshape(3, -1).max(1)
        return rms[:2], float(rms[2])
