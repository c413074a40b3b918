"""Plate carrée (CAR) images, whose pixels are pixels of the full-sky maps that `pixell` makes by
default (Fejer's first rule).

With N = pi / pixel rows from pole to pole, an integer, pixel (i, j) of the full sky, counted from
0, lies at

    longitude = pi - i pixel,
    latitude = (j + 1/2) pixel - pi / 2.                                              (1)

An image is a rectangle of these pixels: two images of one pixel size fit together without
interpolation.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.kernels import kernel
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.projection import boresights, frame_rotation
from zonda.core.types import Floats

if TYPE_CHECKING:
    from zonda.core.data import Observation

Box = tuple[int, int, int, int]
"""First column, first row, last column, last row of full-sky pixels, columns possibly beyond 0 to 2
N - 1.
"""


def rows_of(pixel: float) -> int:
    """N of equation (1)."""
    return round(math.pi / pixel)


def centre_of(box: Sequence[int], pixel: float) -> tuple[float, float]:
    """(longitude, latitude) [rad] of a box's centre, equation (1)."""
    left, low, right, high = box
    return (math.pi - (left + right) / 2 * pixel) % (2 * math.pi), (
        (low + high + 1) * pixel - math.pi
    ) / 2


def box_about(centre: tuple[float, float], width: float, height: float, pixel: float) -> Box:
    """The pixels of a map of ``width`` and ``height`` [rad] on the sky about ``centre`` (longitude,
    latitude) [rad].
    """
    half = min(width / 2 / max(math.cos(centre[1]), 1e-9), math.pi)
    return _box(centre[0], half, centre[1] - height / 2, centre[1] + height / 2, pixel)


def box_of(
    observations: Sequence[Observation],
    pixel: float,
    frame: str,
    before: Sequence[int] | None = None,
) -> Box:
    """The pixels that hold every sample of the observations, and those of a box ``before``."""
    turn = frame_rotation(frame)
    found = None if before is None else _whole(before, pixel)
    for observation in observations:
        reach = math.atan(observation.focalplane.radius)
        for some in chunks(observation.n_samples):
            x, y, z = turn @ boresights(observation.boresight_radec[some])
            found = _joined(
                found,
                _around(np.arctan2(y, x), np.arcsin(np.clip(z, -1.0, 1.0)), reach, pixel),
                pixel,
            )
    assert found is not None
    return found


def middle_of(fields: Sequence[Sequence[float]], pixel: float) -> tuple[float, float]:
    """(longitude, latitude) [rad] of the only one of some fields (`MapLayout.fields`), else the
    middle of all of them.
    """
    if len(fields) == 1:
        return fields[0][0], fields[0][1]
    found = None
    for longitude, latitude, *_ in fields:
        found = _joined(found, _box(longitude, 0.0, latitude, latitude, pixel), pixel)
    assert found is not None
    return centre_of(found, pixel)


def _around(longitude: Floats, latitude: Floats, reach: float, pixel: float) -> Box:
    """The box of discs of radius ``reach`` [rad] about positions."""
    low, high = float(latitude.min()) - reach, float(latitude.max()) + reach
    if high >= math.pi / 2 or low <= -math.pi / 2:  # a pole is inside
        return _box(0.0, math.pi, low, high, pixel)
    half = np.arcsin(math.sin(reach) / np.cos(latitude))
    middle = longitude[0]
    from_middle = (longitude - middle + math.pi) % (2 * math.pi) - math.pi
    west, east = float((from_middle - half).min()), float((from_middle + half).max())
    return _box(middle + (west + east) / 2, min((east - west) / 2, math.pi), low, high, pixel)


def _box(middle: float, half: float, low: float, high: float, pixel: float) -> Box:
    """Pixels within ``half`` [rad] of a longitude and between two latitudes, with one more on each
    side.
    """
    rows = rows_of(pixel)
    begin, end = ((latitude + math.pi / 2) / math.pi * rows for latitude in (low, high))
    left, right = (
        (math.pi - longitude) / math.pi * rows for longitude in (middle + half, middle - half)
    )
    bottom, top = max(math.floor(begin) - 1, 0), min(math.floor(end) + 1, rows - 1)
    return _whole((round(left) - 1, bottom, round(right) + 1, top), pixel)


def _whole(box: Sequence[int], pixel: float) -> Box:
    """A box of no more columns than there are, the first of them on the full sky."""
    left, low, right, high = box
    around = 2 * rows_of(pixel)
    if right - left + 1 >= around:
        return 0, low, around - 1, high
    turns = left // around * around
    return left - turns, low, right - turns, high


def _joined(one: Box | None, other: Box, pixel: float) -> Box:
    """The narrowest box that holds two."""
    if one is None:
        return other
    around = 2 * rows_of(pixel)
    shifted = [(other[0] + k * around, other[2] + k * around) for k in (-1, 0, 1)]
    left, right = min(
        ((min(one[0], a), max(one[2], b)) for a, b in shifted),
        key=lambda ends: ends[1] - ends[0],
    )
    return _whole((left, min(one[1], other[1]), right, max(one[3], other[3])), pixel)


@kernel
def plate_carree_pixels(  # type: ignore[no-untyped-def]
    h, first, stop, xi, eta, rows, column, row, ny, nx, out
):
    """Flat index y nx + x of the pixel that holds each sample, -1 outside the image, equation (1).
    ``h`` (9, n_samp).
    """
    per_radian, around = rows / math.pi, 2 * rows
    for d in range(xi.size):
        for t in range(first, stop):
            x = h[0, t] * xi[d] + h[1, t] * eta[d] + h[2, t]
            y = h[3, t] * xi[d] + h[4, t] * eta[d] + h[5, t]
            z = h[6, t] * xi[d] + h[7, t] * eta[d] + h[8, t]
            i = (
                np.int64(np.floor((math.pi - math.atan2(y, x)) * per_radian + 0.5)) - column
            ) % around
            j = (
                min(
                    np.int64((math.atan2(z, math.sqrt(x * x + y * y)) + math.pi / 2) * per_radian),
                    rows - 1,
                )
                - row
            )
            out[d, t - first] = np.int32(j * nx + i) if i < nx and 0 <= j < ny else np.int32(-1)
