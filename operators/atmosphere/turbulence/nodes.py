"""Nodes over the focal plane and steps in time for the smooth atmosphere, chosen from an error
bound.

For a layer of covariance sum_k w_k exp(-r^2 / 4 e_k) (`covariance.mixture`) the expected squared
error of a linear interpolation with weights W (summing to 1) is exact and separable on a grid:

    E_d = sum_k w_k [1 - 2 (W_x . k_x)(W_y . k_y) + (W_x K_x W_x)(W_y K_y W_y)]                  (1)

In time, a cubic spline through samples a time dt apart makes, along a ray that crosses the layer at
speed v and whose path is itself interpolated to within delta,

    E_t = sum_k w_k G(v dt / sqrt(e_k)) + 2 S(delta)                                             (2)
    G(q) = int dw/2pi P_q(w) [(1 - A_0 b)^2 + sum_{m != 0} (A_m b)^2],
    A_m = sinc^4((w + 2 pi m) / 2),   b = 3 / (2 + cos w)

with P_q the spectrum of exp(-q^2 n^2 / 4).
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cache, lru_cache
from pathlib import Path

import numpy as np

from zonda.core.numerics.smooth import PAD, SPLINE_MARGIN
from zonda.core.types import Floats, Integers

from .beams import Aperture
from .covariance import mixture

SPLINE_TABLE = Path(__file__).parent.parent / "data" / "spline_error.npz"

LARGEST_STEP = 2048
"""Samples; see `core.numerics.chunks`."""

GRIDS = (1, 2, 3, 4, 5, 6, 8, 10, 12, 14, 16, 20, 24, 32, 40, 48, 64)
_TRIED = 64

_COARSE = {"step": 0.7, "depth": 1e-3}
"""Of `mixture`: covariance and structure function are right to 3e-5."""

_SERIES, _SERIES_TO = 7, 0.03
"""Terms of the series of 1 - exp(-x), and up to which x: the next term is 1e-17 of the first."""


@dataclass(frozen=True)
class Layer:
    """One layer as a telescope sees it: its share a_l of the fluctuation; lengths in metres.

    Attributes
    ----------
    height, distance
        Above the site, and along the mean line of sight.
    outer_scale, sigma
        r0, and the standard deviation of the Gaussian footprint.
    aperture
        A footprint with a rim; ``sigma`` is then that of the Gaussian of equal second moment.
    wind
        Velocity of its air (east, north), m/s.
    """

    amplitude: float
    height: float
    distance: float
    outer_scale: float
    sigma: float
    aperture: Aperture | None = None
    wind: Floats = field(default_factory=lambda: np.zeros(2), compare=False)

    def components(self) -> tuple[Floats, Floats]:
        """(e, w) of equation (1); behind an aperture those of a spectrum that is nowhere smaller
        (`Aperture.bound`).
        """
        return _components(self)

    def gaussian(self) -> tuple[Floats, Floats]:
        """(e, w) behind the Gaussian of ``sigma``."""
        return mixture(self.outer_scale, self.sigma, **_COARSE)


@lru_cache(maxsize=64)
def _components(layer: Layer) -> tuple[Floats, Floats]:
    if layer.aperture is None:
        return layer.gaussian()
    square, share = layer.aperture.bound()
    parts = [mixture(layer.outer_scale, math.sqrt(v), **_COARSE) for v in square]
    return np.concatenate([e for e, _ in parts]), np.concatenate(
        [c * w for c, (_, w) in zip(share, parts, strict=True)]
    )


@dataclass(frozen=True)
class Nodes:
    """Points of the focal plane and the weights that interpolate from them: xi, eta (n_node,),
    weights (n_det, n_node).
    """

    xi: Floats
    eta: Floats
    weights: Floats
    """Empty where the detectors are the nodes."""
    shape: tuple[int, int] | None
    """(along xi, along eta), or None where the detectors are the nodes."""

    def __str__(self) -> str:
        return (
            f"{self.shape[0]} x {self.shape[1]} Chebyshev"
            if self.shape
            else f"none: each of {len(self.xi)} detectors by itself"
        )


def chebyshev(low: float, high: float, n: int) -> Floats:
    """The n Chebyshev nodes of [low, high], shape (n,)."""
    return (low + high) / 2 + (high - low) / 2 * np.cos(np.pi * (np.arange(n) + 0.5) / n)


def lagrange(nodes: Floats, x: Floats) -> Floats:
    """Weights (len(x), n) of the polynomial through values at ``nodes`` (barycentric form, Berrut &
    Trefethen 2004).
    """
    n = len(nodes)
    if n == 1:
        return np.ones((len(x), 1))
    k = np.arange(n)
    barycentric = (-1.0) ** k * np.sin(np.pi * (k + 0.5) / n)
    gap = np.subtract.outer(x, nodes)
    hit = gap == 0
    ratio = barycentric / np.where(hit, 1.0, gap)
    weights = ratio / ratio.sum(1, keepdims=True)
    struck = hit.any(1)
    weights[struck] = hit[struck]
    return np.asarray(weights, np.float64)


def grid(xi: Floats, eta: Floats, n: int) -> Nodes:
    """n x n Chebyshev nodes over the rectangle that holds the detectors (one node across a
    rectangle of no width).
    """
    x, y = _sides(xi, eta, n)
    weights = (lagrange(x, xi)[:, :, None] * lagrange(y, eta)[:, None, :]).reshape(len(xi), -1)
    return Nodes(np.repeat(x, len(y)), np.tile(y, len(x)), weights, (len(x), len(y)))


def _sides(xi: Floats, eta: Floats, n: int) -> list[Floats]:
    return [
        chebyshev(float(v.min()), float(v.max()), n if v.max() > v.min() else 1) for v in (xi, eta)
    ]


def grid_error(
    x: Floats,
    y: Floats,
    xi: Floats,
    eta: Floats,
    layers: Sequence[Layer],
    stretch: float = 1.0,
) -> float:
    """Expected rms error of the interpolation from nodes x times y to detectors at (xi, eta), in
    units of the fluctuation before the beam.

    Equation (1), mean over the detectors. ``stretch`` multiplies distances along eta (1 /
    sin(elevation) where the turbulence lies in the horizontal plane).
    """
    weight, nearness = _weights_and_nearness(layers, [layer.components() for layer in layers])
    one = _separable(x, xi, nearness)
    two = _separable(y, eta, nearness * stretch**2)
    total = float((1 - 2 * (one[0] * two[0]).mean(0) + (one[1] * two[1]).mean(0)) @ weight)
    return float(np.sqrt(max(total, 0.0)))


def _weights_and_nearness(
    layers: Sequence[Layer],
    components: Sequence[tuple[Floats, Floats]],
) -> tuple[Floats, Floats]:
    """a_l^2 w and z^2 / 4e of the components of all layers."""
    weight = np.concatenate(
        [layer.amplitude**2 * w for layer, (_, w) in zip(layers, components, strict=True)]
    )
    return weight, np.concatenate(
        [layer.distance**2 / (4 * e) for layer, (e, _) in zip(layers, components, strict=True)]
    )


def _separable(nodes: Floats, points: Floats, nearness: Floats) -> tuple[Floats, Floats]:
    """(W . k, W K W) of one axis for covariances exp(-nearness r^2): each (n_points,
    len(nearness)).
    """
    weights = lagrange(nodes, points)
    cross = np.exp(np.multiply.outer(-(np.subtract.outer(points, nodes) ** 2), nearness))
    first, second = np.triu_indices(len(nodes), 1)
    pairs = 2 * weights[:, first] * weights[:, second]
    among = np.exp(np.multiply.outer(-((nodes[first] - nodes[second]) ** 2), nearness))
    own = (weights**2).sum(1, keepdims=True)
    return np.matmul(weights[:, None, :], cross)[:, 0], own + pairs @ among


def differential_rms(
    xi: Floats,
    eta: Floats,
    layers: Sequence[Layer],
    stretch: float = 1.0,
) -> float:
    """Expected rms of the fluctuation minus its focal-plane mean, in units of the fluctuation
    before the beam.
    """
    i, j = np.triu_indices(len(xi), 1)
    square = (xi[i] - xi[j]) ** 2 + (stretch * (eta[i] - eta[j])) ** 2
    weight, nearness = _weights_and_nearness(layers, [layer.gaussian() for layer in layers])
    return float(np.sqrt(_gone(nearness, square) @ weight * 2 / len(xi) ** 2))


def _gone(nearness: Floats, square: Floats) -> Floats:
    """Sums over the squared separations of 1 - exp(-nearness square), for each nearness; by its
    series where that is short.
    """
    largest = float(square.max(initial=0.0))
    near = nearness * largest > _SERIES_TO
    out = np.zeros(len(nearness))
    x = nearness[~near] * largest
    powers = square / max(largest, 1e-300)
    term = -np.ones(len(x))
    power = np.ones(len(square))
    for k in range(1, _SERIES + 1):
        term = term * -x / k
        power = power * powers
        out[~near] += term * power.sum()
    out[near] = -np.expm1(np.multiply.outer(-nearness[near], square)).sum(1)
    return out


def spread_evenly(xi: Floats, eta: Floats, number: int = _TRIED) -> tuple[Floats, Floats]:
    """At most ``number`` detectors evenly taken from the list, the outermost four included."""
    if len(xi) <= number:
        return xi, eta
    outer = [int(f(v)) for v in (xi, eta) for f in (np.argmin, np.argmax)]
    index = np.unique(np.r_[np.linspace(0, len(xi) - 1, number - 4).astype(int), outer])
    return xi[index], eta[index]


def choose_nodes(
    xi: Floats,
    eta: Floats,
    layers: Sequence[Layer],
    tolerance: float,
    stretch: float = 1.0,
    most: float = math.inf,
) -> tuple[Nodes, float]:
    """The coarsest grid whose `grid_error` is <= ``tolerance``, and that error.

    Where a grid would need as many nodes as there are detectors, or more than ``most``, the
    detectors are the nodes.
    """
    few_xi, few_eta = spread_evenly(xi, eta)

    @cache
    def error(n: int) -> float:
        x, y = _sides(xi, eta, n)
        return grid_error(x, y, few_xi, few_eta, layers, stretch)

    sizes = [n for n in GRIDS if n * n < len(xi) and n * n <= most]
    reach = 1
    while (
        reach < len(sizes) and error(sizes[reach - 1]) > tolerance
    ):  # small grids cost little, and serve most often
        reach *= 2
    place = bisect_left(
        sizes,
        True,
        reach // 2,
        min(reach, len(sizes)),
        key=lambda size: error(size) <= tolerance,
    )
    if place == len(sizes):
        return (
            Nodes(np.asarray(xi, np.float64), np.asarray(eta, np.float64), np.zeros((0, 0)), None),
            0.0,
        )
    n = sizes[place]
    return grid(xi, eta, n), error(n)


@lru_cache(maxsize=1)
def _spline_table() -> tuple[float, float, Floats, Floats]:
    """First ln q and the steps per unit of it, ln G(q) and its steps (made by
    benchmarks/atmosphere_data).
    """
    with np.load(SPLINE_TABLE) as kept:
        log_q = kept["log_q"]
        log_g = kept["log_g"]
    return float(log_q[0]), (len(log_q) - 1) / float(log_q[-1] - log_q[0]), log_g, np.diff(log_g)


def spline_error(q: Floats) -> Floats:
    """G(q) of equation (2): squared error of the cubic spline for the covariance exp(-(q n)^2 / 4)
    of a unit-spaced series.

    Falls as q^8 where q -> 0, and tends to 1.7 where the samples are independent.
    """
    first, density, log_g, rise = _spline_table()
    place = (np.log(np.maximum(q, 1e-30)) - first) * density
    inside = np.clip(place, 0.0, len(rise))
    cell = np.minimum(inside.astype(np.intp), len(rise) - 1)
    log_error = log_g[cell] + (inside - cell) * rise[cell]
    log_error += np.minimum(place, 0.0) * (8 / density)
    return np.asarray(np.exp(log_error), np.float64)


def time_error(
    layers: Sequence[Layer],
    speeds: Sequence[Floats],
    deltas: Sequence[float],
    dt: float,
    enough: float = math.inf,
) -> float:
    """Expected rms error of the spline in time, equation (2), in units of the fluctuation before
    the beam.

    ``speeds``: per layer, speeds [m/s] that the rays have at times evenly spread over the scan (the
    mean of E_t is taken); ``deltas``: per layer, rms error of the interpolated ray path, m. Beyond
    ``enough`` no further layer is added.
    """
    total = 0.0
    for one in zip(layers, speeds, deltas, strict=True):
        total += layer_time_error(*one, dt)
        if math.sqrt(total) > enough:
            break
    return math.sqrt(total)


def layer_time_error(layer: Layer, speeds: Floats, delta: float, dt: float) -> float:
    """One layer's part of `time_error`, squared."""
    e, w = layer.components()
    share = spline_error(np.multiply.outer(speeds, dt / np.sqrt(e))).mean(0) @ w
    share += 2 * (-np.expm1(-(delta**2) / (4 * e)) @ w)
    return layer.amplitude**2 * float(share)


def times_with_margin(n_samples: int, step: int) -> Integers:
    """Samples at which `SmoothField.from_values` wants its values."""
    return step * np.arange(
        -PAD - SPLINE_MARGIN,
        -(-n_samples // step) + 2 + SPLINE_MARGIN,
        dtype=np.int64,
    )


def candidate_steps(n_samples: int) -> list[int]:
    """Powers of two from `LARGEST_STEP` down to 1 that put at least four cells into the scan (1
    where it is shorter).
    """
    steps = [1 << k for k in range(LARGEST_STEP.bit_length() - 1, -1, -1)]
    return [s for s in steps if 4 * s <= n_samples or s == 1]
