"""Quaternions (n, 4) in the order x, y, z, w, of unit length. Of many, each component is contiguous
(Fortran's order).
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from ..types import Bools, Floats
from .chunks import empty
from .sphere import angles

_FAR = math.cos(math.radians(150))


def series(components: int, n: int) -> Floats:
    """An empty array of vectors or quaternions (n, components)."""
    return empty((components, n)).T


def multiply(a: Floats, b: Floats) -> Floats:
    """Product (n, 4): the rotation b, then a."""
    ax, ay, az, aw = a.T
    bx, by, bz, bw = b.T
    return np.stack(
        [
            aw * bx + ax * bw + ay * bz - az * by,
            aw * by - ax * bz + ay * bw + az * bx,
            aw * bz + ax * by - ay * bx + az * bw,
            aw * bw - ax * bx - ay * by - az * bz,
        ]
    ).T


def conjugate(a: Floats) -> Floats:
    """The inverse rotation."""
    inverse: Floats = a * np.array([-1.0, -1.0, -1.0, 1.0])
    return inverse


def rotate(a: Floats, vector: Floats) -> Floats:
    """Vectors (n, 3) or (3,) turned by quaternions (n, 4)."""
    qx, qy, qz, w = a.T
    vx, vy, vz = vector.T
    tx = 2 * (qy * vz - qz * vy)
    ty = 2 * (qz * vx - qx * vz)
    tz = 2 * (qx * vy - qy * vx)
    return np.stack(
        [
            vx + w * tx + qy * tz - qz * ty,
            vy + w * ty + qz * tx - qx * tz,
            vz + w * tz + qx * ty - qy * tx,
        ]
    ).T


def directions(a: Floats) -> Floats:
    """Directions (n, 3) of boresights (n, 4): their z axes."""
    x, y, z, w = a.T
    return np.stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)], axis=1)


def middle(radec: Floats, good: Bools) -> tuple[float, float]:
    """(ra, dec) [rad] of the mean direction of the boresights that are ``good`` (n,)."""
    use = np.flatnonzero(good) if good.any() else np.arange(len(good))
    ra, dec = angles(directions(radec[use[:: max(1, len(use) // 10_000)]]).mean(axis=0))
    return float(ra % (2 * np.pi)), float(dec)


def shortest_rotation(a: Floats, b: Floats) -> Floats:
    """Quaternions (n, 4) that turn unit vectors a into b along great circles; a and b are not
    opposite.
    """
    (ax, ay, az), (bx, by, bz) = a.T, b.T
    half = np.stack(
        [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx, 1 + (ax * bx + ay * by + az * bz)]
    )
    turned: Floats = (half / np.sqrt((half * half).sum(axis=0))).T
    return turned


def from_angles(longitude: Any, latitude: Any) -> Floats:
    """TOAST's Rz(longitude) Ry(pi/2 - latitude), psi = 0: (n, 4)."""
    a = np.asarray(longitude) / 2
    b = np.pi / 4 - np.asarray(latitude) / 2
    ca = np.cos(a)
    sa = np.sin(a)
    cb = np.cos(b)
    sb = np.sin(b)
    quaternions: Floats = np.moveaxis(np.array([-sa * sb, ca * sb, sa * cb, ca * cb]), 0, -1)
    return quaternions


def detector_quaternions(xi: Any, eta: Any, angle: Any) -> Floats:
    """Rotations (n, 4) that take the boresight frame's Z axis to (-eta, -xi, 1) and its X axis to
    the polarization angle.

    q = Rz(phi) Ry(theta) Rz(angle - phi), theta = atan |(xi, eta)|, phi = atan2(-xi, -eta); see
    `core.focalplane.Focalplane`.
    """
    half = np.arctan(np.hypot(xi, eta)) / 2
    phi = np.arctan2(-np.asarray(xi), -np.asarray(eta))
    roll = np.asarray(angle) / 2
    x = -np.sin(half) * np.sin(phi - roll)
    y = np.sin(half) * np.cos(phi - roll)
    return np.stack([x, y, np.cos(half) * np.sin(roll), np.cos(half) * np.cos(roll)], 1)


class Upright:
    """`from_angles` of unit vectors (n, 3), chunk by chunk: (n, 4), neighbours with neighbouring
    signs.

    By half angles: with z = cos(b) and r = sin(b) for the distance b from the pole,

        cos(b / 2) = sqrt((1 + z) / 2),   sin(b / 2) = r / (2 cos(b / 2)),   (3)

    and so for the longitude counted from the very first direction's, in chunks in which that stays
    below `_FAR`.
    """

    def __init__(self) -> None:
        self._first = self._last = math.nan  # longitudes, without jumps

    def __call__(self, directions: Floats) -> Floats:
        x, y, z = directions.T
        if not len(x):
            return np.empty((0, 4))
        if math.isnan(self._first):
            self._first = self._last = math.atan2(y[0], x[0])
        r = np.sqrt(x * x + y * y)
        if r.min() > 0.0 and z.min() >= -0.9 and abs(self._last - self._first) < math.pi:
            cosine = (x * math.cos(self._first) + y * math.sin(self._first)) / r
            if cosine.min() >= _FAR:
                return self._by_half_angles(x, y, z, r, cosine)
        longitude = np.unwrap(np.concatenate([[self._last], np.arctan2(y, x)]))[1:]
        self._last = float(longitude[-1])
        return from_angles(longitude, np.arctan2(z, r))

    def _by_half_angles(self, x: Floats, y: Floats, z: Floats, r: Floats, cosine: Floats) -> Floats:
        sine = y * math.cos(self._first) - x * math.sin(self._first)  # times r
        self._last = self._first + math.atan2(sine[-1], r[-1] * cosine[-1])
        cl = np.sqrt((1 + cosine) / 2)
        cb = np.sqrt((1 + z) / 2)
        sl = sine / (2 * r * cl)
        sb = r / (2 * cb)
        c = math.cos(self._first / 2)
        s = math.sin(self._first / 2)
        ca = c * cl - s * sl
        sa = s * cl + c * sl
        return np.stack([-sa * sb, ca * sb, sa * cb, ca * cb]).T
