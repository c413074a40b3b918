"""Where one scan's atmosphere is evaluated: nodes and steps in time that keep every error below the tolerance."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.numerics.smooth import SmoothField
from zonda.core.types import Floats

from .turbulence.geometry import Track, axes, axes_at, crossing, rays
from .turbulence.nodes import (
    GRIDS,
    LayerModel,
    Nodes,
    candidate_steps,
    choose_nodes,
    differential_rms,
    grid,
    layer_time_error,
    some,
    time_error,
    time_error_within,
    times_with_margin,
)
from .weather.bands import BandAtmosphere
from .weather.radiative_transfer import ELEVATION_MAX

SMALLEST_DIFFERENCE = 1e-5
"""Share of the fluctuation that must differ between detectors for the tolerance to be judged by it."""

MEAN_SHARE = 0.1
"""The mean emission's error, as a share of what the fluctuation's may be: it is so smooth that this costs nothing."""

WINDOWS = (16, 1 << 14)
"""Number and length [samples] of the parts of a longer scan at which its path is looked at."""

LOOKED_AT = 1024
"""Samples of a scan whose velocity and elevation are looked at."""

IN_A_CELL = 4
"""Samples between two steps at which the path's error is looked at: it is a polynomial there, whose square is right to 1 %."""

PAYS_FROM = 1 << 18
"""Points (nodes x times) from which coarser steps for single layers are worth their interpolation."""


@dataclass(frozen=True)
class Plan:
    """Nodes and steps in time; the error allowed and those expected, relative to the rms of the fluctuation after the beam.

    ``steps``: one for each layer, multiples of ``step``. ``mean_nodes``, ``mean_step``: for the mean emission.
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


def make_plan(
    observation: Observation,
    track: Track,
    models: Sequence[LayerModel],
    winds: Sequence[Floats],
    variance: float,
    tolerance: float,
    band: BandAtmosphere,
    pwv: float,
    pwv_rms: float,
) -> Plan:
    """The coarsest nodes and steps that keep each error below ``tolerance`` of what the focal-plane mean, subtracted, leaves.

    Where the detectors are the nodes, the steps in time may err by both shares, sqrt(2) of it.
    ``variance`` is that of the sum of the layers after the beam. The mean emission may be wrong by `MEAN_SHARE` of that.
    """
    xi, eta = observation.focalplane.xi, observation.focalplane.eta
    rms = math.sqrt(variance)
    stretch = 1 / math.sin(track.elevation) if track.kind == "horizontal" else 1.0
    left = differential_rms(*some(xi, eta), models, stretch)
    # Of the rms of the fluctuation. A single detector, or none apart, is judged as if a hundredth were left.
    tolerance = tolerance * (left / rms if left > SMALLEST_DIFFERENCE * rms else 0.01)
    nodes, error = choose_nodes(xi, eta, models, tolerance * rms, stretch)

    path = _Path(observation, xi, eta)
    elevations = np.quantile(path.elevation, [0.0, 0.5, 1.0])
    slope = float(np.max(abs(_slope(band, pwv, elevations))))
    # What the mean emission may be wrong by, K_RJ (as if 0.01 % of the water fluctuated where none does).
    kelvin = float(band.emission(pwv, elevations[1]))
    allowed = max(MEAN_SHARE * tolerance * kelvin * max(pwv_rms, 1e-4), 1e-9)
    truth = _mean_emission(xi, eta, band, pwv, elevations)
    for size in GRIDS:
        mean_nodes = grid(xi, eta, size)
        at_nodes = _mean_emission(mean_nodes.xi, mean_nodes.eta, band, pwv, elevations)
        if float(abs(truth - mean_nodes.weights @ at_nodes).max()) <= allowed:
            break

    velocity = path.velocity(track)
    quantiles = (np.arange(64) + 0.5) / 64 * (velocity.shape[1] - 1)
    drifts = ((model.height * velocity - (track.drift @ wind)[:, None]) for model, wind in zip(models, winds, strict=True))
    speeds = [np.interp(quantiles, np.arange(v.shape[1]), np.sort(np.hypot(*v))) for v in drifts]
    candidates = candidate_steps(observation.n_samples)
    tried: dict[int, tuple[list[float], float]] = {}

    def path_errors(step: int) -> tuple[list[float], float]:
        """Of the position in each layer [m], and of the elevation [rad].

        Between steps samples count as a comb: where they are none, the wind moves on by its speed times their `jitter`.
        """
        if step not in tried:
            delta_x, delta_el = path.errors(step) if step > 1 else (np.zeros(2), 0.0)
            stretched = track.matrix @ delta_x if track.cone is None else delta_x
            late = observation.jitter if step > 1 else 0.0
            blown = [float(np.hypot(*(track.drift @ wind))) * late for wind in winds]
            tried[step] = [float(abs(stretched * m.height).max()) + b for m, b in zip(models, blown, strict=True)], delta_el
        return tried[step]

    late_allowed = tolerance * rms * (1.0 if nodes.shape else math.sqrt(2.0))
    mean_step = next(s for s in candidates if s == 1 or slope * path_errors(s)[1] <= allowed)
    step, late, still = 1, 0.0, [0.0] * len(models)
    for candidate in candidates[:-1]:
        dt = candidate / observation.sample_rate
        if not time_error_within(models, speeds, still, dt, late_allowed):
            continue  # even along an exact path
        late = time_error(models, speeds, path_errors(candidate)[0], dt)
        if late <= late_allowed:
            step = candidate
            break
        late = 0.0

    steps = [step] * len(models)
    if len(nodes.xi) * observation.n_samples / step > PAYS_FROM:

        @cache
        def layer_error(k: int, of: int) -> float:
            deltas = path_errors(of)[0]
            return layer_time_error(models[k], speeds[k], deltas[k], of / observation.sample_rate) if of > 1 else 0.0

        spent = late**2
        while True:  # double the step that saves most for the error it adds
            more = {k: (layer_error(k, 2 * s) - layer_error(k, s)) for k, s in enumerate(steps) if 2 * s <= candidates[0]}
            fits = [k for k, error in more.items() if spent + error <= late_allowed**2]
            if not fits:
                break
            best = min(fits, key=lambda k: (max(more[k], 0.0) * steps[k], k))
            spent, steps[best] = spent + more[best], 2 * steps[best]
        late = math.sqrt(spent)
    return Plan(nodes, step, tuple(steps), tolerance, error / rms, late / rms, left / rms, mean_nodes, mean_step)


def _slope(band: BandAtmosphere, pwv: float, elevation: Floats) -> Floats:
    """d emission / d elevation, K_RJ per rad."""
    h = 1e-4
    low = np.minimum(elevation, ELEVATION_MAX - h)
    return np.asarray((band.emission(pwv, low + h) - band.emission(pwv, low)) / h, np.float64)


def _mean_emission(xi: Floats, eta: Floats, band: BandAtmosphere, pwv: float, elevations: Floats) -> Floats:
    """The mean emission over the focal plane at some elevations of the boresight: (len(xi), len(elevations)), K_RJ."""
    c, s = np.cos(elevations), np.sin(elevations)
    return band.emission(pwv, np.arcsin((s + eta[:, None] * c) / np.sqrt(1 + xi * xi + eta * eta)[:, None]))


class _Path:
    """Lines of sight of three points of the focal plane over a scan, and how well a spline in time follows them.

    Of long scans some windows are looked at, the first and the last samples among them.
    """

    def __init__(self, observation: Observation, xi: Floats, eta: Floats) -> None:
        self._observation = observation
        centre = np.array([(xi.min() + xi.max()) / 2, (eta.min() + eta.max()) / 2])
        points = np.array([centre, [xi.max(), eta.max()], [xi.min(), eta.max()]]).T
        self._xi: Floats = points[0] if len(xi) > 1 else xi
        self._eta: Floats = points[1] if len(xi) > 1 else eta
        n, number, length = observation.n_samples, *WINDOWS
        starts = [0] if n <= number * length else np.linspace(0, n - length, number).astype(np.int64).tolist()
        self._windows = [slice(start, min(n, start + length) if len(starts) > 1 else n) for start in starts]
        index = np.concatenate([np.arange(w.start, w.stop) for w in self._windows])
        last = np.cumsum([w.stop - w.start for w in self._windows]) - 1
        some = np.unique(np.linspace(0, max(len(index) - 2, 0), LOOKED_AT).astype(np.int64))
        self._some = index[some[~np.isin(some, last)]] if n > 1 else index  # the next sample is in the same window
        self.elevation = np.arcsin(self._rays(self._some)[2])

    def _rays(self, index: NDArray[np.int64] | slice) -> Floats:
        return rays(axes(self._observation.boresight_azel[index]), self._xi, self._eta)

    def velocity(self, track: Track) -> Floats:
        """Velocity of the crossing point on the plane per metre of height, 1/s, over the scan: (2, <= LOOKED_AT)."""
        if self._observation.n_samples == 1:
            return np.zeros((2, 1))
        ends = track.unroll(np.stack([crossing(self._rays(self._some + k))[:, 0] for k in (0, 1)], axis=1))
        return np.asarray((ends[:, 1] - ends[:, 0]) * self._observation.sample_rate, np.float64)

    def errors(self, step: int) -> tuple[Floats, float]:
        """Rms spline errors of the crossing X (2,) and of the elevation [rad], the worst of the three points; from `IN_A_CELL`
        samples of each cell."""
        squares, total = np.zeros(9), 0
        each = max(1, step // IN_A_CELL)
        for window in self._windows:
            n = window.stop - window.start
            index = window.start + times_with_margin(n, step)
            u = rays(axes_at(self._observation.boresight_azel, index, step), self._xi, self._eta)
            here = self._rays(slice(window.start, window.stop, each))
            some, rows = -(-n // each), 3 * len(self._xi)
            truth = np.concatenate([crossing(here).reshape(-1, some), np.arcsin(here[2])])
            values = np.concatenate([crossing(u).reshape(-1, len(index)), np.arcsin(u[2])])
            spline = SmoothField.from_values(np.eye(rows), values, step // each, some)
            found = ((spline.evaluate(slice(0, rows), slice(0, some)) - truth) ** 2).sum(1)
            squares[:rows] += found
            total += some
        rms = np.sqrt(squares[: 3 * len(self._xi)] / total).reshape(3, -1).max(1)
        return rms[:2], float(rms[2])
