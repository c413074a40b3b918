"""Layouts of a camera's pixels: hexagonal lattices, rings, and wafers of them. Lengths are in units
of the layout's own.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from .types import Floats, Indices, Integers

GAP = 0.03
"""Distance between the edges of wafers, beyond one pitch, in units of the distance between their
centres.
"""


@dataclass(frozen=True)
class Layout:
    """Places of ``n`` pixels, returned by a registered layout (entry points ``zonda.layouts``) that
    is called with their number.

    The callable may have an attribute ``wafers``: a number that divides that of the pixels.

    Attributes
    ----------
    x, y
        (n,) places on the tangent plane, towards increasing azimuth and elevation, in a unit of its
        own.
    wafer
        (n,) whole numbers: the wafer of each.
    angle
        (n,) angles of the axes of A from +y towards +x [rad], for pairs of polarized detectors;
        None: 0 and 45 deg in turn.
    radius
        That of the field of view in the same unit; None: the distance of the farthest pixel.
    """

    x: Floats
    y: Floats
    wafer: Integers
    angle: Floats | None = None
    radius: float | None = None

    @property
    def reach(self) -> float:
        """``radius``, or what stands for it."""
        return float(np.hypot(self.x, self.y).max()) if self.radius is None else self.radius


def hexagonal_packing(n: int) -> tuple[Floats, Floats]:
    """The ``n`` points of a unit-pitch hexagonal lattice nearest its origin. Two arrays (n,),
    nearest first.
    """
    x, y = _lattice(n)
    order = _order(n, x, y, np.hypot(x, y))
    return x[order], y[order]


def rings(n: int) -> tuple[Floats, Floats]:
    """``n`` points on rings one unit apart: one in the centre, 6 k on ring k, what is left evenly
    on the last.
    """
    x = [np.zeros(1)]
    y = [np.zeros(1)]
    k = 0
    left = n - 1
    while left > 0:
        k += 1
        on_ring = min(6 * k, left)
        angle = 2 * np.pi * np.arange(on_ring) / on_ring
        x.append(k * np.cos(angle))
        y.append(k * np.sin(angle))
        left -= on_ring
    return np.concatenate(x), np.concatenate(y)


def hexagon(n: int) -> tuple[Floats, Floats]:
    """The first ``n`` points of a unit-pitch lattice in hexagons about its origin, with corners at
    0 and 60 deg.
    """
    x, y = _lattice(n)
    shell = np.max(
        np.abs([x - y / math.sqrt(3), 2 * y / math.sqrt(3), x + y / math.sqrt(3)]),
        axis=0,
    )
    order = _order(n, x, y, shell)
    return x[order], y[order]


def wafers(n: int, number: int) -> tuple[Floats, Floats, Integers]:
    """``n`` points shared equally by ``number`` hexagonal wafers, edge to edge about the origin: x,
    y and the wafer of each.

    Wafer after wafer; ``number`` divides ``n``.
    """
    x, y = hexagon(n // number)
    apothem = math.sqrt(3) / 2 * max(float(np.abs(x).max()), 1.0)
    distance = (2 * apothem + 1) * (1 + GAP)
    v, u = _compact(number)  # neighbours at 30 deg: across the edges of a wafer
    u = distance * (u - u.mean())
    v = distance * (v - v.mean())
    return (
        np.add.outer(u, x).ravel(),
        np.add.outer(v, y).ravel(),
        np.repeat(np.arange(number), n // number),
    )


def _compact(n: int) -> tuple[Floats, Floats]:
    """``n`` points of a unit-pitch hexagonal lattice, about a point, a middle of two or of three:
    where they reach least far.
    """
    x, y = _lattice(n)
    found = []
    for a, b in ((0.0, 0.0), (0.5, 0.0), (0.5, math.sqrt(3) / 6)):
        away = np.hypot(x - a, y - b)
        order = _order(n, x - a, y - b, away)
        found.append((float(away[order[-1]]), x[order], y[order]))
    return min(found, key=lambda one: round(one[0], 9))[1:]


def _order(n: int, x: Floats, y: Floats, distance: Floats) -> Indices:
    """The ``n`` points of the least ``distance``, of equal ones those of the least angle first."""
    return np.lexsort((np.round(np.arctan2(y, x), 9), np.round(distance, 9)))[:n]


def _lattice(n: int) -> tuple[Floats, Floats]:
    """Points of a hexagonal lattice, in rows; more than the ``n`` nearest its origin."""
    reach = math.ceil(math.sqrt(n)) + 1
    i, j = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    return np.asarray((i + j / 2.0).ravel(), np.float64), np.asarray(
        (j * math.sqrt(3) / 2).ravel(),
        np.float64,
    )
