"""Lines of sight through a layer: ray directions, the plane that turbulence is laid out in, and its
drift.

A ray of direction u crosses a flat layer at height h at the horizontal point h X, X = (u_east,
u_north) / u_up. Turbulence is a field on the plane transverse to the mean line of sight n of a
scan, whose coordinates are those of the horizontal plane compressed by sin(elevation) along the
mean azimuth:

    M = 1 - (1 - n_up) a a^T,
    a = (n_east, n_north) / |..|                                                  (1)

Frozen flow carries the field along with the wind w. For scan k, which begins at t_k,

    P(t) = h' M_k (X(t) - X_k) + h alpha_k - [B_k + M_k (t - t_k)] w                             (2)
    alpha_(k+1) = alpha_k + (M_k + M_(k+1)) / 2 (X_(k+1) - X_k),
    B_(k+1) = B_k + M_k (t_(k+1) - t_k)        (3)

so consecutive scans see the same air, continuously, although their mean lines of sight X_k differ.
The layer is a spherical shell, met nearer than a flat one: h' = z sin(e) with z the distance along
the mean line of sight (5 % at 5 deg and 5 km).

In a wide throw or field the transverse plane turns. Separations across the line of sight at azimuth
phi and elevation e have the metric z^2 (de^2 + cos^2(e) dphi^2), which with rho = cot e = |X| is
sin^2(e) drho^2 + rho^2 dphi^2: a surface of revolution. Its tangent cone along the mean elevation
e_0 unrolls onto a plane without stretching (`Cone`), in polar coordinates

    q = cos e_0 + arsinh(rho) - arsinh(cot e_0),
    angle phi / sin(e_0)                                       (4)

exact along the elevation and, at e_0, along the azimuth however wide the throw; the azimuthal scale
is off by (e - e_0)^2 / (2 sin^2 e_0) at other elevations. It replaces M_k (X - X_k) in equation
(2), which it equals to first order.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal

import numpy as np

from zonda.core.data import Observation
from zonda.core.errors import PointingError
from zonda.core.types import Floats, Integers

from ..weather.radiative_transfer import EARTH_RADIUS

FLAT = 0.02
"""Largest relative error of squared separations up to which one transverse plane serves a whole
scan.
"""

LARGEST_TURN = 0.75 * np.pi
"""rad: half of the angle that an unrolled cone may cover; farther apart, its two ends would be
neighbours.
"""

LARGEST_REACH = 0.05
"""rad: how far a path is extrapolated beyond the ends of a scan."""


def axes(quaternions: Floats) -> Floats:
    """Focal-plane axes (x, y, boresight) of quaternions (n, 4) in (east, north, up). Shape (n, 3
    components, 3 axes).

    TOAST's horizontal frame is (north, west, up) because its longitude is -azimuth.
    """
    x, y, z, w = np.asarray(quaternions, np.float64).T
    north = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
    west = [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]
    up = [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
    return np.moveaxis(np.array([[-v for v in west], north, up]), 2, 0)


def axes_at(quaternions: Floats, index: Integers, step: int) -> Floats:
    """`axes` at sample numbers ``index``, which may lie before the first or after the last sample.
    Shape (len(index), 3, 3).

    Beyond the ends, where values only feed the margin of the spline in time, the path goes on with
    its last velocity, acceleration and jerk and comes to rest within a few ``step``: A + s A1 + s^2
    A2 / 2 + s^3 A3 / 6, s = t / (1 + (t / T)^8)^(1/8), T <= 8 step, short enough that it moves by
    less than about `LARGEST_REACH` (fast scans therefore need shorter steps).
    """
    n = len(quaternions)
    out = axes(quaternions[np.clip(index, 0, n - 1)])
    gap = min(max(step // 8, 1), (n - 1) // 3)
    if gap == 0:
        return out
    for end, inward in ((0, 1), (n - 1, -1)):
        beyond = (index < 0) if end == 0 else (index > n - 1)
        a, b, c, d = axes(quaternions[[end + inward * k * gap for k in range(4)]])
        first = (18 * b - 11 * a - 9 * c + 2 * d) / (6 * gap)
        second = (2 * a - 5 * b + 4 * c - d) / gap**2
        third = (3 * b - a - 3 * c + d) / gap**3
        t = abs(index[beyond] - end).astype(np.float64)
        sizes = [  # of the axis that moves most: its length, whatever the azimuth
            np.sqrt((m * m).sum(0)).max() / math.factorial(k) + 1e-30
            for k, m in enumerate((first, second, third), 1)
        ]
        limits = [(LARGEST_REACH / 2 / size) ** (1 / k) for k, size in enumerate(sizes, 1)]
        s = -t / (1 + (t / min(8.0 * step, *limits)) ** 8) ** 0.125
        out[beyond] = a + s[:, None, None] * (
            first + (s / 2)[:, None, None] * (second + (s / 3)[:, None, None] * third)
        )
    return out


def rays(axes: Floats, xi: Floats, eta: Floats) -> Floats:
    """Unit directions (east, north, up) of focal-plane points. ``axes`` (n, 3, 3), ``xi``, ``eta``
    (m,); shape (3, m, n).

    Raises `PointingError` where a ray is at or below the horizon.
    """
    x, y, z = (axes[:, :, k].T[:, None, :] for k in range(3))
    u = z - np.asarray(eta)[None, :, None] * x - np.asarray(xi)[None, :, None] * y
    u = u / np.sqrt((u * u).sum(0))
    check_above_horizon(float(u[2].min(initial=1.0)))
    return np.asarray(u, np.float64)


def check_above_horizon(sine: float) -> None:
    """Raise `PointingError` where the lowest line of sight, of this ``sine`` of the elevation, is
    at or below the horizon.
    """
    if sine <= 0:
        raise PointingError(
            f"a line of sight is {-math.degrees(math.asin(sine)):.2f} deg below the horizon",
            place="atmosphere",
            cure="raise the target, or choose a smaller field of view",
        )


def crossing(u: Floats) -> Floats:
    """X = (east, north) / up of directions (3, ...): the horizontal crossing point per metre of
    height. Shape (2, ...).
    """
    return np.asarray(u[:2] / u[2], np.float64)


@dataclass(frozen=True)
class Cone:
    """The unrolled cone of equation (4) about azimuth ``axis`` (unit vector, 2) and elevation
    ``elevation`` [rad].
    """

    axis: Floats
    elevation: float

    def polar(self, crossings: Floats) -> tuple[Floats, Floats]:
        """(q, angle) of crossings X (2, ...)."""
        x = np.einsum("a,a...->...", self.axis, crossings)
        y = self.axis[0] * crossings[1] - self.axis[1] * crossings[0]
        q = (
            np.cos(self.elevation)
            + np.arcsinh(np.hypot(x, y))
            - np.arcsinh(1 / np.tan(self.elevation))
        )
        return np.asarray(q, np.float64), np.asarray(
            np.arctan2(y, x) / np.sin(self.elevation),
            np.float64,
        )

    def unroll(self, crossings: Floats) -> Floats:
        """Positions on the plane, per metre of height, zero at the centre: (2, ...)."""
        q, angle = self.polar(crossings)
        x = q * np.cos(angle) - np.cos(self.elevation)
        y = q * np.sin(angle)
        return np.stack([self.axis[0] * x - self.axis[1] * y, self.axis[1] * x + self.axis[0] * y])

    def error(self, crossings: Floats) -> float:
        """Largest relative error of squared transverse separations at crossings (2, ...); infinite
        where it overlaps.
        """
        q, angle = self.polar(crossings)
        if q.min() <= 0 or abs(angle).max() > LARGEST_TURN:
            return np.inf
        return float(abs((q / np.hypot(*crossings) / np.sin(self.elevation)) ** 2 - 1).max())


@dataclass(frozen=True)
class ScanPlane:
    """The plane of one scan, equations (1) to (4).

    Attributes
    ----------
    matrix
        M: (2, 2). The unit matrix where the horizontal plane is used.
    centre
        X of the mean line of sight, (2,).
    alpha, advection
        alpha_k (2,) and B_k (2, 2), s.
    frame
        M of the run's first scan: its image of the wind is the lattice axis, so that strips are
        narrow.
    elevation
        Of the mean line of sight, rad.
    kind
        ``transverse``: one plane; ``cone``: the throw or the field is wide, see equation (4);
        ``horizontal``: both fail (a scan round the whole horizon), separations along the elevation
        are too large.
    bound
        Largest relative error of squared transverse separations at one instant, over the whole
        field and scan; the structure function, concave in the squared separation, is wrong by no
        more.
    drift
        What the wind is multiplied by, (2, 2): M, or the mean over the scan of the cone's
        derivative.
    drift_bound
        Largest relative error of the drift of any wind (a vector) at any azimuth of the scan.
    """

    matrix: Floats
    centre: Floats
    alpha: Floats
    advection: Floats
    frame: Floats
    elevation: float
    kind: Literal["transverse", "cone", "horizontal"]
    bound: float
    drift: Floats
    drift_bound: float
    cone: Cone | None = None

    @property
    def stretch(self) -> float:
        """Factor by which separations along the elevation are too large."""
        return 1 / math.sin(self.elevation) if self.kind == "horizontal" else 1.0

    def unroll(self, crossings: Floats) -> Floats:
        """M (X - X_k), or equation (4): positions per metre of height, (2, ...)."""
        if self.cone:
            return self.cone.unroll(crossings)
        shift = self.matrix @ self.centre
        moved = np.einsum("ab,b...->a...", self.matrix, crossings) - shift.reshape(
            2, *[1] * (crossings.ndim - 1)
        )
        return np.asarray(moved, np.float64)

    def effective(self, height: float) -> float:
        """Height whose flat layer lies as far along the mean line of sight as a spherical one does,
        m: z sin(elevation).
        """
        sine = math.sin(self.elevation)
        across = EARTH_RADIUS * sine
        return (
            sine
            * height
            * (2 * EARTH_RADIUS + height)
            / (math.hypot(across, math.sqrt(2 * EARTH_RADIUS * height + height**2)) + across)
        )

    def positions(
        self,
        crossings: Floats,
        seconds: Floats,
        height: float,
        wind: Floats,
    ) -> tuple[Floats, Floats]:
        """(across, along) the wind, m, of crossings X (2, m, n) at ``seconds`` (n,) after the
        start. Equation (2).
        """
        x, y = self.unroll(crossings)
        parts = zip(*self.affine(height, wind), strict=True)
        across, along = (m[0] * x + m[1] * y + (b + v * seconds) for m, b, v in parts)
        return across, along

    def affine(self, height: float, wind: Floats) -> tuple[Floats, Floats, Floats]:
        """Terms of equation (2): (across, along) = matrix (2, 2) unrolled + start (2,) [m] +
        velocity (2,) [m/s] seconds.
        """
        along = self.frame @ wind
        speed = float(np.hypot(*along))
        c, s = along / speed if speed > 0 else (1.0, 0.0)
        turn = np.array([[-s, c], [c, s]])
        start = turn @ (height * self.alpha - self.advection @ wind)
        return self.effective(height) * turn, start, turn @ (self.drift @ -wind)


def scan_plane(observation: Observation) -> ScanPlane:
    """The plane of one scan by itself (alpha and advection zero).

    A separation seen along u has the metric G = 1 - u_h u_h^T, the plane of n has 1 - n_h n_h^T and
    the horizontal plane 1. The bound is the spectral norm of the difference over the smallest
    eigenvalue u_up^2, for every line of sight of the scan and the rim of the field. One plane is
    used where it is good to `FLAT`, else the cone where it is better.
    """
    every = max(1, observation.n_samples // 2000)
    xi, eta = rim(observation.focalplane.xi, observation.focalplane.eta)
    u = rays(axes(observation.boresight_azel[::every]), np.r_[0.0, xi], np.r_[0.0, eta])
    boresight = u[:, 0]
    n = boresight.mean(1)
    n = n / np.sqrt(n @ n)
    level = float(np.hypot(n[0], n[1]))
    a = n[:2] / level if level > 0 else np.zeros(2)
    matrix = np.eye(2) - (1 - n[2]) * np.outer(a, a)
    transverse = _error(matrix @ matrix, u)
    flat = _error(np.eye(2), u)
    middle = float(np.median(np.arcsin(boresight[2])))
    elevation = float(np.arcsin(n[2]))
    centre = n[:2] / n[2]
    kind: Literal["transverse", "cone", "horizontal"] = "transverse"
    bound = transverse
    cone = None
    if transverse > FLAT and level > 0:
        highest = float(np.arcsin(boresight[2]).max()) + float(np.arctan(np.hypot(xi, eta).max()))
        unrolled = Cone(a, middle)
        # The tip of a cone is no place to be near.
        error = unrolled.error(crossing(u)) if highest < np.pi / 2 else np.inf
        if error < min(transverse, flat):
            kind = "cone"
            bound = error
            cone = unrolled
            matrix = np.eye(2) - (1 - np.sin(middle)) * np.outer(a, a)
            elevation = middle
            centre = a / np.tan(middle)
    if cone is None and transverse > max(0.5 * flat, FLAT):
        # The mean direction may be the zenith.
        kind = "horizontal"
        bound = flat
        matrix = np.eye(2)
        elevation = middle
    drift: tuple[Floats, float] = (matrix, bound)
    if cone:
        drift = _mean_drift(cone, crossing(boresight))
    still = np.zeros(2), np.zeros((2, 2))
    return ScanPlane(matrix, centre, *still, matrix, elevation, kind, bound, *drift, cone)


def _mean_drift(cone: Cone, crossings: Floats) -> tuple[Floats, float]:
    """The mean D over crossings X (2, n) of the derivative J of equation (4), and the largest norm
    of (D - J) J^-1.
    """
    h = 1e-6
    columns = [
        (cone.unroll(crossings + h * e[:, None]) - cone.unroll(crossings - h * e[:, None]))
        / (2 * h)
        for e in np.eye(2)
    ]
    each = np.stack(columns, axis=-1).transpose(1, 0, 2)  # (n, 2, 2)
    mean = each.mean(0)
    return mean, float(np.linalg.norm((mean - each) @ np.linalg.inv(each), 2, axis=(1, 2)).max())


def looking(observation: Observation) -> tuple[int, bytes, bytes]:
    """Key that tells whether two bands look along the same lines of sight."""
    plane = observation.focalplane
    return id(observation.boresight_azel), plane.xi.tobytes(), plane.eta.tobytes()


def rim(xi: Floats, eta: Floats, number: int = 12) -> tuple[Floats, Floats]:
    """The outermost points in ``number`` directions: xi, eta."""
    angle = 2 * np.pi * np.arange(number) / number
    outer = np.unique(np.argmax(np.outer(np.cos(angle), xi) + np.outer(np.sin(angle), eta), axis=1))
    return xi[outer], eta[outer]


def _error(metric: Floats, u: Floats) -> float:
    """Largest spectral norm of metric - G over u_up^2, for directions u (3, ...)."""
    constant = (metric - np.eye(2)).reshape(2, 2, *[1] * (u.ndim - 1))
    difference = constant + u[:2, None] * u[None, :2]
    half_trace = (difference[0, 0] + difference[1, 1]) / 2
    norm = abs(half_trace) + np.hypot((difference[0, 0] - difference[1, 1]) / 2, difference[0, 1])
    return float((norm / u[2] ** 2).max())


def scan_planes(observations: Sequence[Observation]) -> list[ScanPlane]:
    """One `ScanPlane` per observation, in order of time given; positions are counted from the first
    one's start.
    """
    out: list[ScanPlane] = []
    for k, observation in enumerate(observations):
        here = observation.once(("plane", *looking(observation)), partial(scan_plane, observation))
        if not out:
            out.append(replace(here, alpha=here.matrix @ here.centre))
            continue
        before = out[-1]
        alpha = before.alpha + (before.matrix + here.matrix) / 2 @ (here.centre - before.centre)
        advection = before.advection + before.drift * observation.start.seconds_since(
            observations[k - 1].start
        )
        out.append(replace(here, alpha=alpha, advection=advection, frame=before.frame))
    return out
