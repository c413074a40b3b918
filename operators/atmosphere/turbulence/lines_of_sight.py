"""Crossings of many lines of sight with the plane of the turbulence, compiled: `geometry` for every
detector and coarse time.

A focal-plane point (xi, eta) looks at u = (z - eta x - xi y) / sqrt(1 + xi^2 + eta^2), with x, y, z
the axes of the focal plane. On one plane (equation 2 of `geometry`) its position is a quotient of
linear functions of (xi, eta). On the unrolled cone (equation 4 there) it is

    P = q(|u_h|) (c(t^2) + i t s(t^2)) exp(i k phi_b) a,   t = u_side / (|u_h| + u_ahead),
    k = 1 / sin e_0    (1)

as a complex number, with phi_b the azimuth of the boresight about the cone's axis a, (ahead, side)
the horizontal components along and across the boresight's azimuth, so that t = tan(dphi / 2), and
q, c = cos(2 k atan t), s = sin(2 k atan t) / t polynomials of one variable, as long as they need to
be over the field and scan (`_ERROR`). Towards the horizon, where q is singular in |u_h|, it is a
polynomial of u_up instead.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numba as nb
import numpy as np

from zonda.core.data import Observation
from zonda.core.errors import PointingError
from zonda.core.kernels import kernel
from zonda.core.types import Floats

from .geometry import Cone, ScanPlane, axes_at, check_above_horizon, rim

_ERROR = 1e-9
"""Error of a polynomial in equation (1): micrometres at a layer kilometres away."""

_WORST = 1e-4
"""What such a polynomial may err by in wide fields near the horizon, where none reaches `_ERROR`;
beyond, a scan is refused.
"""

_DEGREES = (4, 6, 8, 11, 15, 20, 28, 40)

_WIDER = 0.05
"""Share by which the ranges of the polynomials reach beyond what the rim of the field spans."""
_NARROWEST = 1e-5
"""Least reach beyond, in sines of the elevation: axes beyond the ends of a scan are unit vectors to
1e-6.
"""


class LinesOfSight:
    """Positions at samples first x step, (first + 1) x step .. of one scan; beyond its ends the
    path is extrapolated.

    Parameters
    ----------
    observation, plane
        The scan and its plane.
    step
        Samples between the times.
    first, count
        The times that will be evaluated.

    Attributes
    ----------
    low, high
        Smallest and largest sine of the elevation over the field, at all times (a little beyond).

    Raises
    ------
    PointingError
        Where a line of sight is at or below the horizon.
    """

    def __init__(
        self,
        observation: Observation,
        plane: ScanPlane,
        step: int,
        first: int,
        count: int,
    ) -> None:
        self.step = step
        self.first = first
        self.count = count
        index = step * (first + np.arange(count, dtype=np.int64))
        self.seconds = observation.seconds_at(index)
        axes = axes_at(observation.boresight_azel, index, step)  # (n, 3 components, 3 axes)
        # Components of u before normalization: rows (east, north, up), columns (1, xi, eta).
        linear = np.stack([axes[:, :, 2], -axes[:, :, 1], -axes[:, :, 0]], axis=2)
        xi, eta = rim(observation.focalplane.xi, observation.focalplane.eta)
        self.low, self.high = self._sines(linear[:, 2], np.r_[0.0, xi], np.r_[0.0, eta])
        self._cone = plane.cone
        if plane.cone is None:
            rows = np.concatenate(
                [np.einsum("ab,nbc->nac", plane.matrix, linear[:, :2]), linear[:, 2:]],
                axis=1,
            )
            self._shift = plane.matrix @ plane.centre
            self._turn = np.zeros((2, 0))
            self._series: tuple[Floats, ...] = ()
        else:
            rows, self._turn = _about_the_boresight(linear, plane.cone)
            self._shift = np.cos(plane.cone.elevation) * plane.cone.axis
            self._series = self._polynomials(plane.cone, rows, np.r_[0.0, xi], np.r_[0.0, eta])
        self._linear = np.ascontiguousarray(np.moveaxis(rows.reshape(count, 9), 0, 1))  # (9, n)

    def __call__(
        self,
        xi: Floats,
        eta: Floats,
        first: int,
        count: int,
    ) -> tuple[Floats, Floats, Floats]:
        """(x, y) on the plane per metre of height, and sines of the elevation, each (len(xi),
        count), from time ``first``.
        """
        start = first - self.first
        if not 0 <= start <= start + count <= self.count:
            raise ValueError(
                f"times {first}:{first + count} outside {self.first}:{self.first + self.count}"
            )
        x, y, sine = (np.empty((len(xi), count)) for _ in range(3))
        if self._cone is None:
            _on_plane(self._linear, start, xi, eta, self._shift, x, y, sine)
        else:
            _on_cone(
                self._linear, self._turn, start, xi, eta, self._shift, *self._series, x, y, sine
            )
        return x, y, sine

    def same_as(self, other: LinesOfSight) -> bool:
        """True if another's positions have the same bits."""
        own, theirs = ((one._linear, one._turn, one._shift, *one._series) for one in (self, other))
        times = (self.step, self.first, self.count) == (other.step, other.first, other.count)
        return times and len(own) == len(theirs) and all(map(np.array_equal, own, theirs))

    def _sines(self, up: Floats, xi: Floats, eta: Floats) -> tuple[float, float]:
        norm = 1 / np.sqrt(1 + xi * xi + eta * eta)
        low = 1.0
        high = 0.0
        for a, b, n in zip(xi, eta, norm, strict=True):
            sine = (up[:, 0] + a * up[:, 1] + b * up[:, 2]) * n
            low = min(low, float(sine.min()))
            high = max(high, float(sine.max()))
        check_above_horizon(low)
        radius = math.atan(float(np.hypot(xi, eta).max()))
        if (
            math.asin(min(float(up[:, 0].max()), 1.0)) + radius > math.pi / 2
        ):  # the zenith may lie inside the field
            high = 1.0
        wider = max(_WIDER * (high - low), _NARROWEST)
        return max(low - wider, low / 2), min(high + wider, 1.0)

    def _polynomials(self, cone: Cone, rows: Floats, xi: Floats, eta: Floats) -> tuple[Floats, ...]:
        ahead, side = (
            np.stack([r[:, 0] + a * r[:, 1] + b * r[:, 2] for a, b in zip(xi, eta, strict=True)])
            for r in (rows[:, 0], rows[:, 1])
        )
        largest = float(abs(side / (np.hypot(ahead, side) + ahead)).max()) * (1 + _WIDER)
        k, offset = (
            1 / math.sin(cone.elevation),
            math.cos(cone.elevation) - math.asinh(1 / math.tan(cone.elevation)),
        )

        def of_up(sine: Floats) -> Floats:
            return np.asarray(offset + np.arctanh(np.sqrt(1 - sine * sine)), np.float64)

        def of_horizontal(cosine: Floats) -> Floats:
            return np.asarray(offset + np.arctanh(cosine), np.float64)

        def cosine(square: Floats) -> Floats:
            return np.asarray(np.cos(2 * k * np.arctan(np.sqrt(square))), np.float64)

        def sine_over(square: Floats) -> Floats:
            t = np.sqrt(np.maximum(square, 1e-30))
            return np.asarray(np.sin(2 * k * np.arctan(t)) / t, np.float64)

        low, high = (math.sqrt(1 - v * v) for v in (self.high, self.low))
        ways = _polynomial(of_horizontal, low, high), _polynomial(of_up, self.low, self.high)
        q, at_q, error = min(ways, key=lambda way: (max(way[2], _ERROR), len(way[0])))
        if not error <= _WORST:
            raise PointingError(
                f"lines of sight so close to the horizon or the zenith are laid out to {error:.0e}"
                " of the height at best",
                place="atmosphere",
                cure="raise or lower the target, or choose a smaller field of view",
            )
        by_up = at_q[0] == (self.low + self.high) / 2
        c, at_t, _ = _polynomial(cosine, 0.0, max(largest * largest, 1e-6))
        s, _, _ = _polynomial(sine_over, 0.0, max(largest * largest, 1e-6))
        return q, c, s, np.array([*at_q, *at_t, float(by_up)])


def _about_the_boresight(linear: Floats, cone: Cone) -> tuple[Floats, Floats]:
    """Rows (ahead, side, up) instead of (east, north, up), and exp(i k phi_b) a as (2, n)."""
    horizontal = linear[:, :2, 0]
    ahead = horizontal / np.hypot(*horizontal.T)[:, None]
    rows = np.empty_like(linear)
    rows[:, 0] = ahead[:, :1] * linear[:, 0] + ahead[:, 1:] * linear[:, 1]
    rows[:, 1] = ahead[:, :1] * linear[:, 1] - ahead[:, 1:] * linear[:, 0]
    rows[:, 2] = linear[:, 2]
    one, two = cone.axis
    azimuth = np.arctan2(
        one * ahead[:, 1] - two * ahead[:, 0],
        one * ahead[:, 0] + two * ahead[:, 1],
    )
    turn = azimuth / math.sin(cone.elevation)
    c = np.cos(turn)
    s = np.sin(turn)
    return rows, np.stack([one * c - two * s, one * s + two * c])


def _polynomial(
    function: Callable[[Floats], Floats],
    low: float,
    high: float,
) -> tuple[Floats, tuple[float, float], float]:
    """Coefficients, highest first, in z = (x - m) w, (m, w), and the error: `_ERROR` over [low,
    high], or more.
    """
    middle, half = (low + high) / 2, max((high - low) / 2, 1e-12)
    for degree in _DEGREES:
        series = np.polynomial.Chebyshev.interpolate(lambda z: function(middle + half * z), degree)
        z = np.linspace(-1, 1, 4 * degree + 3)
        truth = function(middle + half * z)
        error = float(abs(series(z) - truth).max())
        if error <= _ERROR:
            break
    return (
        np.asarray(np.polynomial.chebyshev.cheb2poly(series.coef)[::-1], np.float64).copy(),
        (middle, 1 / half),
        error,
    )


@kernel
def _on_plane(linear, start, xi, eta, shift, x, y, sine):  # type: ignore[no-untyped-def]
    n = nb.uint64(x.shape[1])
    x0, x1, x2 = linear[0][start:], linear[1][start:], linear[2][start:]
    y0, y1, y2 = linear[3][start:], linear[4][start:], linear[5][start:]
    u0, u1, u2 = linear[6][start:], linear[7][start:], linear[8][start:]
    for d in range(xi.size):
        a, b = xi[d], eta[d]
        norm = 1 / np.sqrt(1 + a * a + b * b)
        px, py, up = x[d], y[d], sine[d]
        for t in range(n):
            w = u0[t] + a * u1[t] + b * u2[t]
            px[t] = (x0[t] + a * x1[t] + b * x2[t]) / w - shift[0]
            py[t] = (y0[t] + a * y1[t] + b * y2[t]) / w - shift[1]
            up[t] = w * norm


@kernel
def _on_cone(  # type: ignore[no-untyped-def]
    linear, turn, start, xi, eta, shift, q, c, s, scales, x, y, sine
):
    n = nb.uint64(x.shape[1])
    x0, x1, x2 = linear[0][start:], linear[1][start:], linear[2][start:]
    y0, y1, y2 = linear[3][start:], linear[4][start:], linear[5][start:]
    u0, u1, u2 = linear[6][start:], linear[7][start:], linear[8][start:]
    real, imaginary = turn[0][start:], turn[1][start:]
    by_up = scales[4] > 0
    tangent, z, radius = np.empty(x.shape[1]), np.empty(x.shape[1]), np.empty(x.shape[1])
    for d in range(xi.size):
        a, b = xi[d], eta[d]
        norm = 1 / np.sqrt(1 + a * a + b * b)
        cosine, over, up = x[d], y[d], sine[d]
        for t in range(n):
            ahead, side = x0[t] + a * x1[t] + b * x2[t], y0[t] + a * y1[t] + b * y2[t]
            level = np.sqrt(ahead * ahead + side * side)
            tangent[t] = side / (level + ahead)
            up[t] = (u0[t] + a * u1[t] + b * u2[t]) * norm
            z[t] = ((up[t] if by_up else level * norm) - scales[0]) * scales[1]
        _horner(q, z, radius)
        for t in range(n):
            z[t] = (tangent[t] * tangent[t] - scales[2]) * scales[3]
        _horner(c, z, cosine)
        _horner(s, z, over)
        for t in range(n):
            p, i = radius[t] * cosine[t], radius[t] * tangent[t] * over[t]
            cosine[t] = p * real[t] - i * imaginary[t] - shift[0]
            over[t] = p * imaginary[t] + i * real[t] - shift[1]


@kernel
def _horner(coefficients, z, out):  # type: ignore[no-untyped-def]
    n = nb.uint64(z.size)
    first = coefficients[0]
    for t in range(n):
        out[t] = first
    for k in range(1, coefficients.size):
        term = coefficients[k]
        for t in range(n):
            out[t] = out[t] * z[t] + term
