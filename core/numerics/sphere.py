"""Angles, their units and text, and the width of a Gaussian; directions on the sphere: unit vectors
of longitudes and latitudes, and back. All angles in rad.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Any

import numpy as np

from ..types import Floats

ARCMIN = math.pi / 10800
"""rad."""
ARCSEC = math.pi / 648000
"""rad."""
FWHM_PER_SIGMA = math.sqrt(8 * math.log(2))
"""Full width at half maximum of a Gaussian of unit standard deviation."""


def beam_area(fwhm: float) -> float:
    """Solid angle of a Gaussian beam, sr."""
    return math.pi / math.log(16) * fwhm**2


def angle_text(value: float) -> str:
    """``4°``, ``1.5′``, ``8.5″``, of rad."""
    for unit, name in ((60 * ARCMIN, "°"), (ARCMIN, "′")):
        if abs(value) >= unit:
            return f"{value / unit:.3g}{name}"
    return f"{value / ARCSEC:.3g}″"


def sides_text(y: float, x: float) -> str:
    """Size of a pixel of these sides [rad]: ``2″`` where they are equal to a per cent, else across
    and up, ``1″ x 2″``.
    """
    return angle_text(y) if abs(x / y - 1) < 0.01 else f"{angle_text(x)} x {angle_text(y)}"


def unit_vectors(longitude: Any, latitude: Any) -> Floats:
    """(..., 3) directions of spherical coordinates; the longitude of a horizontal one is minus its
    azimuth.
    """
    c = np.cos(latitude)
    axes = np.broadcast_arrays(c * np.cos(longitude), c * np.sin(longitude), np.sin(latitude))
    vectors: Floats = np.stack(axes, axis=-1)
    return vectors


def angles(vectors: Floats) -> tuple[Floats, Floats]:
    """(longitude, latitude) of directions (..., 3); the longitude from -pi to pi."""
    x, y, z = np.moveaxis(vectors, -1, 0)
    return np.arctan2(y, x), np.arctan2(z, np.hypot(x, y))


def position(direction: Iterable[float]) -> tuple[float, float]:
    """(longitude, latitude) of one direction; the longitude from 0 to 2 pi."""
    x, y, z = map(float, direction)
    return math.atan2(y, x) % (2 * math.pi), math.atan2(z, math.hypot(x, y))


def local_axes(longitude: float, latitude: float) -> Floats:
    """(3, 3) rows: the direction at a point, east and north there."""
    east = [-np.sin(longitude), np.cos(longitude), 0.0]
    north = [
        -np.sin(latitude) * np.cos(longitude),
        -np.sin(latitude) * np.sin(longitude),
        np.cos(latitude),
    ]
    return np.array([unit_vectors(longitude, latitude), east, north])


def angle_between(a: Floats, b: Floats) -> Floats:
    """Between unit vectors (..., 3) and one (3,)."""
    return np.arccos(np.clip(a @ b, -1, 1))


def separation(longitude: Floats, latitude: Floats, centre: tuple[float, float]) -> Floats:
    """Angles of directions from ``centre`` (longitude, latitude), accurate for small ones."""
    lon, lat = centre
    half = (
        np.sin((latitude - lat) / 2) ** 2
        + np.cos(latitude) * np.cos(lat) * np.sin((longitude - lon) / 2) ** 2
    )
    return np.asarray(2 * np.arcsin(np.sqrt(np.clip(half, 0, 1))))
