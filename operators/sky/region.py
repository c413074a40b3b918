"""The part of a tangent-plane lattice that the detectors of a scan reach, which is all that is read
from a larger map; and the blocks in which that is worked on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from zonda.core.data import Observation
from zonda.core.errors import InputError
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.projection import boresights, pixel_matrix, tangent_wcs
from zonda.core.numerics.sphere import local_axes
from zonda.core.types import Bools, Floats, Integers

WIDEST = np.radians(60.0)
"""Largest distance from the tangent point: beyond it a gnomonic projection stretches pixels by more
than 1 / cos^2 = 4.
"""
MOST_PIXELS = 2**27
MARGIN = 16
"""Points of a lattice beyond the last sample's beam: the spline feels the border by 0.27^16 = 8e-10
there.
"""
TILE = 64
"""Side, in points, of the squares that are worked on or not."""
BLOCK = 8 * TILE
"""Side, in points, of a block."""
SPARSE = 0.5
"""Share of the tiles that are reached above which all are worked on: scans of nearly one shape then
share them.
"""

Progress = Callable[[int, int], None]
"""Called with the number of points that are done, and of all."""


@dataclass(frozen=True)
class Disc:
    """A circle on the sky that holds a map: ICRS direction (3,) of its centre, radius in rad."""

    centre: Floats
    radius: float


@dataclass(frozen=True)
class Region:
    """A rectangle of a TAN lattice, and the tiles of it that are reached.

    Attributes
    ----------
    box
        (x0, x1, y0, y1): columns x0 .. x1 - 1 west and rows y0 .. y1 - 1 north of the tangent
        point; multiples of `TILE`.
    tiles
        (rows, columns) of tiles: True where detectors come near; None: everywhere.
    """

    box: tuple[int, int, int, int]
    tiles: Bools | None

    @property
    def shape(self) -> tuple[int, int]:
        """(ny, nx) points."""
        x0, x1, y0, y1 = self.box
        return y1 - y0, x1 - x0


def region(
    observation: Observation,
    step: float,
    reach: float,
    disc: Disc | None,
    place: str,
) -> Region:
    """Region of the lattice of ``step`` [rad] about the observation's centre; one tile that is not
    reached where there is none.

    Parameters
    ----------
    reach
        rad, by which the beam goes beyond a detector's direction.
    disc
        Outside it there is no map; None: a map of the whole sky.

    Raises
    ------
    InputError
        The scan goes further from its centre than a gnomonic projection serves, or the box has too
        many points.
    """
    from scipy.ndimage import maximum_filter

    around = float(np.arctan(observation.focalplane.radius)) + reach
    axes = local_axes(*observation.centre)
    boxes = []
    furthest = 0.0
    for x, y, theta in _on_plane(observation, axes, disc, around):
        furthest = max(furthest, float(theta.max(initial=0.0)))
        if x.size:
            boxes.append((x.min(), x.max(), y.min(), y.max()))
    if furthest + around > WIDEST:
        raise InputError(
            f"the scan reaches {np.degrees(furthest + around):.0f} deg from its centre; a map that"
            f" must be resampled serves up to {np.degrees(WIDEST):.0f} deg",
            place=place,
            cure="scan a smaller field, or give a TAN map",
        )
    if not boxes:
        return Region((0, TILE, 0, TILE), np.zeros((1, 1), bool))
    pad = (np.tan(furthest + around) - np.tan(furthest)) / step + MARGIN
    low = np.min(boxes, axis=0)[[0, 2]] / step - pad
    high = np.max(boxes, axis=0)[[1, 3]] / step + pad
    x0, x1, y0, y1 = _snapped(low, high)
    ny = y1 - y0
    nx = x1 - x0
    if nx * ny > MOST_PIXELS:
        raise InputError(
            f"the working grid would have {nx} x {ny} pixels of {np.degrees(step) * 3600:.3g}"
            " arcsec",
            place=place,
            cure="scan a smaller field, or give a TAN map of it",
        )
    tiles = np.zeros((ny // TILE, nx // TILE), bool)
    for x, y, _ in _on_plane(observation, axes, disc, around):
        tiles[((y / step - y0) // TILE).astype(int), ((x / step - x0) // TILE).astype(int)] = True
    tiles = maximum_filter(tiles, 2 * int(np.ceil(pad / TILE)) + 1, mode="constant")
    return Region((x0, x1, y0, y1), None if tiles.mean() > SPARSE else tiles)


def _on_plane(observation: Observation, axes: Floats, disc: Disc | None, around: float) -> Any:
    """Chunks of (x, y, theta) [tan rad west, tan rad north, rad] of the boresight where it comes
    ``around`` the map.
    """
    boresight = observation.sky_boresight
    for chunk in chunks(observation.n_samples):
        d = boresights(boresight[chunk])
        if disc is not None:
            d = d[:, disc.centre @ d >= np.cos(min(disc.radius + around, np.pi))]
        depth, east, north = axes @ d
        theta = np.arccos(np.clip(depth, -1, 1))
        front = theta < WIDEST  # others end in an error
        yield -east[front] / depth[front], north[front] / depth[front], theta


def _snapped(low: Floats, high: Floats) -> tuple[int, int, int, int]:
    """Edges on an absolute raster of a power of two tiles, an eighth of the box or less: scans of
    nearly one size share it.
    """
    power = max(0, int(np.floor(np.log2(max(float((high - low).max()) / TILE / 8, 1.0)))))
    raster = TILE * 2**power
    (x0, y0), (x1, y1) = (
        np.floor(low / raster).astype(int) * raster,
        np.ceil(high / raster).astype(int) * raster,
    )
    return int(x0), int(x1), int(y0), int(y1)


def tangent_grid_wcs(ra: float, dec: float, box: tuple[int, int, int, int], step: float) -> Any:
    """A north-up TAN `WCS` (ICRS) about (ra, dec) of the points in ``box`` (`Region`);
    `pixel_shape` is set. All in rad.
    """
    x0, x1, y0, y1 = box
    side = float(np.degrees(step))
    crval = float(np.degrees(ra)), float(np.degrees(dec))
    wcs: Any = tangent_wcs("icrs", crval, (1 - x0, 1 - y0), (-side, side))
    wcs.pixel_shape = (x1 - x0, y1 - y0)
    return wcs


def no_progress(done: int, total: int) -> None:
    """Progress callback that does nothing."""


def directions_on(matrix: Floats, x: Any, y: Any) -> Floats:
    """ICRS directions (..., 3) of 0-based points of a TAN grid with `pixel_matrix` ``matrix``."""
    rays = np.stack([x, y, np.ones(np.shape(x))], axis=-1) @ np.linalg.inv(matrix).T
    return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True))


def places_on(matrix: Floats, d: Floats) -> tuple[Floats, Floats]:
    """0-based points (x, y) of a TAN grid at which ICRS directions (n, 3) lie."""
    x, y, depth = matrix @ d.T
    return np.ascontiguousarray(x / depth), np.ascontiguousarray(y / depth)


@dataclass(frozen=True)
class Block:
    """Points of a TAN grid of ``step`` [rad] with `pixel_matrix` ``matrix``.

    Attributes
    ----------
    y, x
        (n,).
    box
        (x0, x1, y0, y1) columns x0 .. x1 - 1 and rows y0 .. y1 - 1, which hold the points.
    tiles
        `Region.tiles` of the grid.
    """

    y: Integers
    x: Integers
    matrix: Floats
    step: float
    box: tuple[int, int, int, int]
    tiles: Bools | None

    @cached_property
    def d(self) -> Floats:
        """(n, 3) ICRS directions of the points."""
        return directions_on(self.matrix, self.x, self.y)

    @property
    def rim(self) -> Floats:
        """(m, 3) ICRS directions around the block, a step beyond it."""
        (x0, x1), (y0, y1) = ((int(k.min()) - 1, int(k.max()) + 1) for k in (self.x, self.y))
        along = np.arange(x0, x1 + 1)
        up = np.arange(y0, y1 + 1)
        x = np.concatenate([along, along, np.full(len(up), x0), np.full(len(up), x1)])
        y = np.concatenate([np.full(len(along), y0), np.full(len(along), y1), up, up])
        return directions_on(self.matrix, x, y)

    def nearest(self, d: Floats) -> Bools:
        """True if ICRS directions (n, 3) are nearest to points of the block."""
        x0, x1, y0, y1 = self.box
        with np.errstate(invalid="ignore", divide="ignore"):
            x, y = (np.rint(k) for k in places_on(self.matrix, d))
            inside = (x >= x0) & (x < x1) & (y >= y0) & (y < y1) & (d @ self.matrix[2] > 0)
        if self.tiles is not None:
            tile = (k[inside].astype(int) // TILE for k in (y, x))
            inside[inside] = self.tiles[tuple(tile)]
        return np.asarray(inside, np.bool_)


def blocks(
    target: Any,
    tiles: Bools | None,
    progress: Progress,
    thin: int = 1,
) -> Iterator[Block]:
    """The points of the TAN grid ``target`` in squares of `BLOCK`; of the ``tiles`` that are True,
    where given.

    ``thin``: only every ``thin``-th point along each axis.
    """
    nx, ny = target.pixel_shape
    matrix = pixel_matrix(target)
    step = float(np.radians(abs(target.wcs.cdelt[1])))
    total = nx * ny if tiles is None else int(tiles.sum()) * TILE**2
    done = 0
    progress(0, total)
    for y0 in range(0, ny, BLOCK):
        for x0 in range(0, nx, BLOCK):
            y1 = min(y0 + BLOCK, ny)
            x1 = min(x0 + BLOCK, nx)
            y, x = (k.ravel() for k in np.mgrid[y0:y1:thin, x0:x1:thin])
            if tiles is not None:
                wanted = tiles[y // TILE, x // TILE]
                y = y[wanted]
                x = x[wanted]
            if not y.size:
                continue
            yield Block(y, x, matrix, step, (x0, x1, y0, y1), tiles)
            done += y.size * thin * thin
            progress(min(done, total), total)
