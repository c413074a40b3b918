"""Several targets in one image: about which point, and how large.

Each target has a field, a rectangle on its own tangent plane. A gnomonic projection turns straight
edges into straight edges, so that the box around the images of the corners on another tangent plane
holds the whole field.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from zonda.core.errors import InputError
from zonda.core.numerics.sphere import local_axes, unit_vectors
from zonda.core.types import Floats

MOST_FIELDS = 1000
"""More are taken together as one."""
FARTHEST = math.radians(45.0)
"""From the middle: there a pixel of a tangent plane is stretched by 1 / cos^2 = 2."""


def whole_of(fields: Sequence[Sequence[float]], place: str) -> tuple[float, float, float, float]:
    """(longitude, latitude, half the width, half the height) [rad] of the image that holds all
    fields, each given likewise.

    Of one field: itself. Raises InputError where they are too far apart for an image.
    """
    if len(fields) == 1:
        longitude, latitude, width, height = fields[0]
        return longitude, latitude, width, height
    corners = np.concatenate([_corners(*field) for field in fields])
    direction = np.array([unit_vectors(field[0], field[1]) for field in fields]).mean(axis=0)
    for _ in range(2):  # towards the middle of the box
        axes = _axes(direction)
        x, y = _projected(corners, axes, place)
        direction = axes.T @ [1.0, (x.min() + x.max()) / 2, (y.min() + y.max()) / 2]
    axes = _axes(direction)
    x, y = _projected(corners, axes, place)
    longitude, latitude = _position(axes[0])
    return longitude, latitude, float(abs(x).max()), float(abs(y).max())


def _corners(longitude: float, latitude: float, width: float, height: float) -> Floats:
    """(4, 3) directions of a field's corners."""
    offsets = [[1.0, i * width, j * height] for i in (-1, 1) for j in (-1, 1)]
    corners = np.array(offsets) @ local_axes(longitude, latitude)
    return np.asarray(corners / np.linalg.norm(corners, axis=1)[:, None])


def _position(direction: Floats) -> tuple[float, float]:
    x, y, z = (float(v) for v in direction)
    return math.atan2(y, x) % (2 * math.pi), math.atan2(z, math.hypot(x, y))


def _axes(direction: Floats) -> Floats:
    return local_axes(*_position(direction))


def _projected(corners: Floats, axes: Floats, place: str) -> Floats:
    """(2, n) east and north of corners (n, 3) on the tangent plane of ``axes``."""
    ahead, east, north = axes @ corners.T
    if ahead.min() < math.cos(FARTHEST):
        apart = math.degrees(math.acos(max(float((corners @ corners.T).min()), -1.0)))
        raise InputError(
            f"the scans reach over {apart:.0f} deg, too far for one image (tangent plane)",
            place=place,
            cure=(
                "give nside for a HEALPix map, or make a map of each target (in a campaign: leave"
                " target out of combine)"
            ),
        )
    return np.asarray([east / ahead, north / ahead])
