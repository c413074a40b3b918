"""Where the lines of sight cross a layer: ray directions, the plane that turbulence is laid out in, and its drift.

A ray of direction u crosses a flat layer at height h at the horizontal point h X, X = (u_east, u_north) / u_up. Turbulence
is a field on the plane transverse to the mean line of sight n of a scan, whose coordinates are those of the horizontal
plane compressed by sin(elevation) along the mean azimuth:

    M = 1 - (1 - n_up) a a^T,      a = (n_east, n_north) / |..|                                                  (1)

Frozen flow carries the field along with the wind w. For scan k, which begins at t_k,

    P(t) = h [M_k (X(t) - X_k) + alpha_k] - [B_k + M_k (t - t_k)] w                                              (2)
    alpha_(k+1) = alpha_k + (M_k + M_(k+1)) / 2 (X_(k+1) - X_k),      B_(k+1) = B_k + M_k (t_(k+1) - t_k)        (3)

so consecutive scans see the same air, continuously, although their mean lines of sight X_k differ.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.errors import PointingError

Floats = NDArray[np.float64]

LARGEST_REACH = 0.05
"""rad: how far a path is extrapolated beyond the ends of a scan."""


def axes(quaternions: Floats) -> Floats:
    """Focal-plane axes (x, y, boresight) of quaternions (n, 4) in (east, north, up). Shape (n, 3 components, 3 axes).

    TOAST's horizontal frame is (north, west, up) because its longitude is -azimuth.
    """
    x, y, z, w = np.asarray(quaternions, np.float64).T
    north = [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)]
    west = [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)]
    up = [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)]
    return np.moveaxis(np.array([[-v for v in west], north, up]), 2, 0)


def axes_at(quaternions: Floats, index: NDArray[np.int64], step: int) -> Floats:
    """`axes` at sample numbers ``index``, which may lie before the first or after the last sample. Shape (len(index), 3, 3).

    Beyond the ends, where values only feed the margin of the spline in time, the path goes on with its last velocity,
    acceleration and jerk and comes to rest within a few ``step``: A + s A1 + s^2 A2 / 2 + s^3 A3 / 6,
    s = t / (1 + (t / T)^8)^(1/8), T <= 4 step, short enough that it moves by less than about `LARGEST_REACH` (fast scans
    therefore need shorter steps).
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
        sizes = [abs(m).max() / math.factorial(k) + 1e-30 for k, m in enumerate((first, second, third), 1)]
        limits = [(LARGEST_REACH / 2 / size) ** (1 / k) for k, size in enumerate(sizes, 1)]
        s = -t / (1 + (t / min(4.0 * step, *limits)) ** 8) ** 0.125
        out[beyond] = a + s[:, None, None] * (first + (s / 2)[:, None, None] * (second + (s / 3)[:, None, None] * third))
    return out


def rays(axes: Floats, xi: Floats, eta: Floats) -> Floats:
    """Unit directions (east, north, up) of focal-plane points. ``axes`` (n, 3, 3), ``xi``, ``eta`` (m,); shape (3, m, n).

    Raises `PointingError` where a ray is at or below the horizon.
    """
    x, y, z = (axes[:, :, k].T[:, None, :] for k in range(3))
    u = z - np.asarray(eta)[None, :, None] * x - np.asarray(xi)[None, :, None] * y
    u = u / np.sqrt((u * u).sum(0))
    if u.size and u[2].min() <= 0:
        raise PointingError(
            f"a line of sight is {-np.degrees(np.arcsin(u[2].min())):.2f} deg below the horizon",
            place="atmosphere",
            cure="raise the target, or choose a smaller field of view",
        )
    return np.asarray(u, np.float64)


def crossing(u: Floats) -> Floats:
    """X = (east, north) / up of directions (3, ...): the horizontal crossing point per metre of height. Shape (2, ...)."""
    return np.asarray(u[:2] / u[2], np.float64)


@dataclass(frozen=True)
class Track:
    """The plane of one scan, equations (1) to (3).

    Attributes
    ----------
    matrix
        M: (2, 2). The unit matrix where the horizontal plane is used.
    centre
        X of the mean line of sight, (2,).
    alpha, advection
        alpha_k (2,) and B_k (2, 2), s.
    frame
        M of the run's first scan: its image of the wind is the lattice axis, so that strips are narrow.
    elevation
        Of the mean line of sight, rad.
    horizontal
        True: the azimuth throw is so wide that the transverse plane turns, and the horizontal plane is used.
    bound
        Largest relative error of squared transverse separations that either plane makes.
    """

    matrix: Floats
    centre: Floats
    alpha: Floats
    advection: Floats
    frame: Floats
    elevation: float
    horizontal: bool
    bound: float

    def positions(self, crossings: Floats, seconds: Floats, height: float, wind: Floats) -> tuple[Floats, Floats]:
        """(across, along) the wind, m, of crossings X (2, m, n) at ``seconds`` (n,) after the start. Equation (2)."""
        moved = self.matrix @ wind
        offset = height * (self.alpha - self.matrix @ self.centre) - self.advection @ wind
        p = height * np.einsum("ab,bmn->amn", self.matrix, crossings)
        p += offset[:, None, None] - moved[:, None, None] * seconds
        along = self.frame @ wind
        speed = float(np.hypot(*along))
        c, s = along / speed if speed > 0 else np.array([1.0, 0.0])
        return -s * p[0] + c * p[1], c * p[0] + s * p[1]


def plane(observation: Observation) -> tuple[Floats, Floats, float, bool, float]:
    """(M, centre, elevation, horizontal, bound) of one scan; see `Track`.

    A separation seen along u has the metric 1 - u_h u_h^T, the plane of n has 1 - n_h n_h^T and the horizontal plane 1.
    The bound is the spectral norm of the difference over the smallest eigenvalue u_up^2. The horizontal plane is taken
    where the transverse plane's bound is more than half of its own, and more than 1 %.
    """
    every = max(1, observation.n_samples // 5000)
    u = rays(axes(observation.boresight_azel[::every]), np.zeros(1), np.zeros(1))[:, 0]
    n = u.mean(1)
    n = n / np.sqrt(n @ n)
    outer = u[:2, None] * u[None, :2] - (n[:2, None] * n[None, :2])[..., None]
    half_trace = (outer[0, 0] + outer[1, 1]) / 2
    norm = abs(half_trace) + np.hypot((outer[0, 0] - outer[1, 1]) / 2, outer[0, 1])
    transverse = float((norm / u[2] ** 2).max())
    flat = float(((u[0] ** 2 + u[1] ** 2) / u[2] ** 2).max())
    horizontal = transverse > max(0.5 * flat, 0.01)
    level = float(np.hypot(n[0], n[1]))
    a = n[:2] / level if level > 0 else np.zeros(2)
    matrix = np.eye(2) if horizontal else np.eye(2) - (1 - n[2]) * np.outer(a, a)
    return matrix, n[:2] / n[2], float(np.arcsin(n[2])), horizontal, flat if horizontal else transverse


def tracks(observations: Sequence[Observation]) -> list[Track]:
    """One `Track` per observation, in order of time given; positions are counted from the first one's start."""
    out: list[Track] = []
    for k, observation in enumerate(observations):
        matrix, centre, elevation, horizontal, bound = plane(observation)
        if not out:
            alpha, advection, frame = matrix @ centre, np.zeros((2, 2)), matrix
        else:
            before = out[-1]
            alpha = before.alpha + (before.matrix + matrix) / 2 @ (centre - before.centre)
            advection = before.advection + before.matrix * observation.start.seconds_since(observations[k - 1].start)
            frame = before.frame
        out.append(Track(matrix, centre, alpha, advection, frame, elevation, horizontal, bound))
    return out
