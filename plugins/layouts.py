"""Published focal planes, by generators: each name in `LAYOUTS` is an attribute of this module, for
an entry point.

Wafers, and where they stand, are those of the hardware models of the Simons Observatory
(simonsobs/sotodlib, cfe6397: sotodlib/sim_hardware.py, sotodlib/toast/sim_focalplane.py) and CMB-S4
(CMB-S4/s4sim, 3a15318: s4sim/hardware/config.py, sim.py): spacings in mm times the plate scale.
Places are composed on the sphere as TOAST composes them, and given on the tangent plane.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from zonda.core.instrument import ARRAY
from zonda.core.layouts import Layout, hexagon


def turned(xi: Any, eta: Any, gamma: Any = 0.0) -> Rotation:
    """Rotations from the boresight to ``xi``, ``eta`` (sines), turned by ``gamma`` from eta towards
    xi [rad]: TOAST's.
    """
    xi, eta, gamma = np.broadcast_arrays(xi, eta, gamma)
    azimuth = np.arctan2(-xi, -eta)
    return Rotation.from_euler(
        "ZYZ",
        np.stack([azimuth, np.arcsin(np.hypot(xi, eta)), gamma - azimuth], axis=-1),
    )


def about_boresight(degrees: float) -> Rotation:
    """A turn about the boresight."""
    return Rotation.from_euler("Z", degrees, degrees=True)


def rhombi(number: int, size: float) -> Rotation:
    """``number`` feedhorns on a hexagonal wafer of three rhombi of m x m, its pitch ``size`` / m
    [rad].

    The axes of A lie at 22.5 and 67.5 deg in alternate rows of a rhombus. m is the smallest that
    suffices. Of a full wafer two places are left out first, for alignment pins, then those farthest
    from the middle.
    """
    side = math.ceil(math.sqrt(number / 3))
    pitch = size / side
    row = np.concatenate([np.full(side - abs(side - 1 - k), k) for k in range(2 * side - 1)])
    across = np.concatenate(
        [np.arange(n) - (n - 1) / 2 for n in side - np.abs(side - 1 - np.arange(2 * side - 1))]
    )
    one = turned(
        across * pitch,
        math.sqrt(3) / 2 * (side - 1 - row) * pitch,
        np.radians(22.5 + 45 * (row % 2)),
    )
    away = ((side - 1) / 2 + 1 / math.sqrt(3)) * pitch
    thirds = [(-30.0, 30.0), (90.0, -90.0), (210.0, 150.0)]
    places = [
        turned(away * math.cos(math.radians(a)), away * math.sin(math.radians(a)), math.radians(g))
        for a, g in thirds
    ]
    whole = Rotation.concatenate([place * one for place in places])
    middle = whole.as_matrix()[:, 2, 2]  # the cosine of the distance from the middle
    middle[side * side + side * (side - 1) // 2 + np.array([0, side - 2])] = -1.0
    return whole[np.sort(np.argsort(-middle, kind="stable")[:number])]


def hexagons(number: int, size: float) -> Rotation:
    """``number`` pixels in hexagons about the middle one, corners towards xi, from the middle to a
    corner ``size`` [rad].

    The axes of A lie at 0 and 45 deg in alternate rows.
    """
    x, y = hexagon(number)
    distance = np.hypot(x, y) * size / max(float(np.abs(x).max()), 1.0)
    sine = np.sin(distance)
    angle = np.arctan2(y, x)
    row = np.rint(y / (math.sqrt(3) / 2)).astype(int)
    return turned(sine * np.cos(angle), sine * np.sin(angle), np.pi / 4 * (row % 2))


def sinuous(number: int, size: float) -> Rotation:
    """`hexagons` with corners towards eta: the wafers of the Simons Observatory's low
    frequencies.
    """
    return about_boresight(30) * hexagons(number, size)


def spiral(place: int, distance: float) -> Rotation:
    """TOAST's place number ``place`` of a hexagonal lattice with the pitch ``distance`` [rad]: in
    rings from the middle.
    """
    ring = 0
    while place > 3 * ring * (ring + 1):
        ring += 1
    sector, step = divmod(place - 3 * ring * (ring - 1) - 1, ring) if ring else (0, 0)
    corner, edge = (np.exp(1j * np.pi / 3 * turn) for turn in (sector, sector + 2))
    at = distance * (ring * corner + step * edge)
    sine = np.sin(abs(at)) * np.exp(1j * np.angle(at))
    return turned(sine.real, sine.imag)


@dataclass(frozen=True)
class Wafers:
    """A layout of wafers that are alike: ``pixels`` (number, size) of one, and the rotation from
    the boresight to each.
    """

    pixels: Callable[[int, float], Rotation]
    size: float
    places: tuple[Rotation, ...]
    margin: float = 1.0
    """Radius of the field of view in units of the distance of the farthest pixel."""

    @property
    def wafers(self) -> int:
        """Number of wafers that share the pixels equally."""
        return len(self.places)

    def __call__(self, number: int) -> Layout:
        """``number`` pixels, wafer after wafer, on the tangent plane [tan(rad)] with the angles of
        A [rad].
        """
        one = self.pixels(number // self.wafers, self.size)
        frames = np.concatenate([(place * one).as_matrix() for place in self.places])
        x = -frames[:, 1, 2] / frames[:, 2, 2]
        y = -frames[:, 0, 2] / frames[:, 2, 2]
        angle = np.arctan2(frames[:, 1, 0] - frames[:, 0, 1], frames[:, 0, 0] + frames[:, 1, 1])
        wafer = np.repeat(np.arange(self.wafers), number // self.wafers)
        return Layout(x, y, wafer, angle, radius=float(np.hypot(x, y).max()) * self.margin)


def _lat(
    pixels: Callable[[int, float], Rotation],
    size: float,
    tubes: Iterable[Rotation],
) -> Wafers:
    """Tubes of the SO LAT with three wafers each, ``size`` and spacing in mm."""
    radius = 128.4 * LAT / 2
    corners = (
        (-radius, radius / math.sqrt(3), 240.0),
        (radius, radius / math.sqrt(3), 0.0),
        (0.0, -2 * radius / math.sqrt(3), 120.0),
    )
    within = [
        about_boresight(180) * turned(x, y) * about_boresight(angle - 60) for x, y, angle in corners
    ]
    return Wafers(
        pixels,
        size * LAT,
        tuple(about_boresight(90) * tube * wafer for tube in tubes for wafer in within),
    )


def _sat(pixels: Callable[[int, float], Rotation], size: float) -> Wafers:
    """The tube of an SO SAT with seven wafers, ``size`` and spacing in mm."""
    turns = (240, 0, 300, 180, 120, 60, 60)
    places = (
        about_boresight(150) * spiral(k, 128.4 * SAT) * about_boresight(turn)
        for k, turn in enumerate(turns)
    )
    return Wafers(pixels, size * SAT, tuple(places))


def _s4(
    pixels: Callable[[int, float], Rotation],
    size: float,
    tubes: Iterable[int],
    turn: float = 0.0,
) -> Wafers:
    """Tubes of a Chilean LAT of CMB-S4 with one wafer each, ``size`` in mm; tubes by TOAST's
    numbers of places.
    """
    places = (
        about_boresight(45) * spiral(k, math.radians(0.87)) * about_boresight(turn) for k in tubes
    )
    return Wafers(pixels, size * S4, tuple(places))


LAT, SAT, S4 = math.radians(0.00495), math.radians(0.09668), math.radians(0.003964)
"""Plate scales, rad / mm."""
TUBES = 359.6 * LAT
"""Distance between the optics tubes of the SO LAT, 1.78 deg."""
MODULES = 1.78
"""deg: distance between modules of Prime-Cam, 461.3 mm at 13.89 arcsec / mm (fyst-trajectories,
ccatobs/fyst-trajectories).
"""
HORNS = 12 * 5.3
"""mm: side of a rhombus of 12 x 12 feedhorns, with one pitch around."""
MIDDLE = turned(0.0, 0.0)

LAYOUTS: dict[str, Wafers] = {
    "so_lat_lf": _lat(sinuous, 3 * 18.0, [MIDDLE]),
    "so_lat_mf": _lat(rhombi, HORNS, [spiral(k, TUBES) for k in (2, 3, 5, 6)]),
    "so_lat_uhf": _lat(rhombi, HORNS, [turned(-TUBES / 2, 0.0), turned(TUBES / 2, 0.0)]),
    "so_sat_lf": _sat(sinuous, 3 * 18.0),
    "so_sat": _sat(rhombi, HORNS),
    "cmb_s4_lat_lf": _s4(rhombi, 4 * 16.1, (62, 64, 67, 69, 75, 78, 80, 83)),
    "cmb_s4_lat_mf": _s4(
        rhombi,
        HORNS,
        (*range(19, 61), 63, 70, 72, 73, 74, 77, 84, 85, 87, 88, 89, 90),
    ),
    "cmb_s4_lat_hf": _s4(hexagons, 12 * 5.2, range(19), -90.0),
    "prime_cam_module": replace(_lat(rhombi, HORNS, [MIDDLE]), margin=ARRAY * MODULES / (1.3 / 2)),
}
"""By name."""


def __getattr__(name: str) -> Wafers:
    if name not in LAYOUTS:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return LAYOUTS[name]


def __dir__() -> list[str]:
    return sorted(LAYOUTS)
