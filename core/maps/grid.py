"""Grids of map pixels on the sphere: solid angles, steps on the sky, distances and duplicates.

A pixel's size is not a constant: solid angles and steps are those of each pixel, in every
projection that astropy reads. With d(x, y) the direction (a unit vector) of the 0-based pixel
coordinates (x, y),

    step along x = |d_x|,   along y = |d_y|,   solid angle = |d_x cross d_y|,
    metric g_ij = d_i . d_j,   (1)

derivatives over the middle half of the pixel; of gnomonic (TAN) and plate carree (CAR) images in
closed form.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any

import numpy as np
from astropy.wcs import WCS

from ..numerics.projection import (
    central,
    frame_rotation,
    wcs_frame_rotation,
)
from ..numerics.sphere import angles, separation, unit_vectors
from ..storage.fits_files import COMMENTARY, header_of
from ..types import Bools, Floats, Integers

CYLINDERS = ("CAR", "CEA", "MER", "CYP")
ROWS = 256
"""Of an image that are worked on at a time."""


class MapGrid:
    """Positions and sizes of a map's pixels on the sky: an image (`image_grid`) or a list of
    HEALPix pixels (`HealpixPixels`).

    Attributes
    ----------
    shape
        Of the map's arrays: (ny, nx), or (n_pixel,).
    """

    shape: tuple[int, ...]

    @property
    def turn(self) -> Floats:
        """(3, 3) from ICRS directions to those of the grid's frame. InputError for frames that are
        no rotation of it (FK4).
        """
        raise NotImplementedError

    @property
    def areas(self) -> Floats:
        """Solid angles [sr], an array that broadcasts to `shape`; NaN for pixels that are not on
        the sky.
        """
        raise NotImplementedError

    @property
    def once(self) -> Bools:
        """Pixels that are on the sky and repeat no other one (as columns of CAR beyond 360 deg do);
        broadcasts to `shape`.
        """
        raise NotImplementedError

    @property
    def sides(self) -> tuple[float, float]:
        """Steps (y, x) on the sky [rad] of the middle pixel: what spectra and profiles of a small
        map need.
        """
        raise NotImplementedError

    def directions(self) -> Floats:
        """(*shape, 3) unit vectors in the grid's frame; NaN for pixels that are not on the sky."""
        raise NotImplementedError

    def pixels_at(self, directions: Floats) -> Integers:
        """Flat places (...) of the pixels that hold directions (..., 3) of the grid's frame, -1
        where there is none.
        """
        raise NotImplementedError

    @property
    def pixel(self) -> float:
        """Side of the square of the middle pixel's solid angle [rad]."""
        return math.sqrt(math.prod(self.sides))

    @lru_cache(maxsize=2)  # noqa: B019  (every figure of a map's noise asks for it)
    def distance(self, centre: tuple[float, float]) -> Floats:
        """Angles [rad] of the pixels from ``centre`` (longitude, latitude) [rad] in the grid's
        frame, of `shape`. Read only.
        """
        found = separation(*angles(self.directions()), centre)
        found.flags.writeable = False
        return found

    def solid_angle(self, where: Bools) -> float:
        """Solid angle of the pixels ``where`` [sr], each piece of the sky counted once."""
        areas = np.where(self.once, self.areas, 0.0)
        return float(np.broadcast_to(areas, self.shape)[where].sum())


@dataclass(frozen=True, eq=False)
class ImagePixels(MapGrid):
    """Pixels of an image.

    Attributes
    ----------
    wcs
        An `astropy.wcs.WCS` of two celestial axes.
    nominal
        Steps (y, x) [rad] where the header's degrees, which are rounded, are not to be taken; None:
        those.
    """

    wcs: Any
    shape: tuple[int, int]
    nominal: tuple[float, float] | None = None

    @property
    def turn(self) -> Floats:
        return wcs_frame_rotation(self.wcs)

    @cached_property
    def matrix(self) -> Floats:
        """(2, 2) of the WCS: intermediate world coordinates (first axis, second axis) [rad] per
        pixel (x, y).
        """
        found = np.radians(np.asarray(self.wcs.pixel_scale_matrix, np.float64))
        if self.nominal is not None:
            found = found / np.sqrt((found**2).sum(axis=0)) * self.nominal[::-1]
        return found

    @cached_property
    def kind(self) -> str:
        """Three letters of the projection; empty where distortions or parameters make more of
        it.
        """
        names = {str(name)[-3:] for name in self.wcs.wcs.ctype}
        plain = len(names) == 1 and not self.wcs.has_distortion and not len(self.wcs.wcs.get_pv())
        return names.pop() if plain else ""

    @cached_property
    def cylinder(self) -> bool:
        """True if rows are parallels of a cylindrical projection (of its own sphere, which may lie
        askew).
        """
        return (
            self.kind in CYLINDERS
            and self.wcs.wcs.lng == 0
            and not self.matrix[0, 1]
            and not self.matrix[1, 0]
        )

    @property
    def around(self) -> int:
        """Columns of a full turn; 0 where there is no such thing."""
        return round(2 * math.pi / abs(float(self.matrix[0, 0]))) if self.cylinder else 0

    @cached_property
    def latitudes(self) -> Floats:
        """(ny,) of the rows of a CAR image, on the sphere of its projection [rad]."""
        rows = np.arange(self.shape[0]) + 1.0 - float(self.wcs.wcs.crpix[1])
        return np.asarray(np.radians(rows * float(self.wcs.pixel_scale_matrix[1][1])), np.float64)

    @property
    def _unbounded(self) -> Any:
        """The WCS; that of a cylinder takes columns beyond a turn (astropy before 7 forgets that
        when parameters are read).
        """
        if str(self.wcs.wcs.ctype[0])[-3:] in CYLINDERS:
            self.wcs.wcs.bounds_check(False, False)
        return self.wcs

    def at(self, x: Any, y: Any) -> Floats:
        """(..., 3) unit vectors, in the grid's frame, of 0-based pixel coordinates; NaN where they
        are not on the sky.
        """
        x, y = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(y, np.float64))
        if self.kind == "TAN":
            rays = np.stack([x, y, np.ones_like(x)], axis=-1) @ np.linalg.inv(central(self.wcs)).T
            return np.asarray(rays / np.linalg.norm(rays, axis=-1, keepdims=True), np.float64)
        lon, lat = self._unbounded.all_pix2world(x, y, 0)
        if self.wcs.wcs.lng == 1:
            lon, lat = lat, lon
        known = np.isfinite(lon) & np.isfinite(lat)
        if self.kind == "CAR":  # wcslib's own check is off: columns may go round more than once
            native = (y + 1.0 - float(self.wcs.wcs.crpix[1])) if self.cylinder else np.zeros_like(y)
            known &= abs(native * float(self.matrix[1, 1])) <= math.pi / 2 * (1 + 1e-12)
        return np.where(known[..., None], unit_vectors(np.radians(lon), np.radians(lat)), np.nan)

    def metric(self, x: Any, y: Any) -> tuple[Floats, Floats, Floats]:
        """g_xx, g_xy, g_yy of equation (1) [rad^2] at 0-based pixel coordinates."""
        h = 0.25
        across = (self.at(np.asarray(x) + h, y) - self.at(np.asarray(x) - h, y)) / (2 * h)
        along = (self.at(x, np.asarray(y) + h) - self.at(x, np.asarray(y) - h)) / (2 * h)
        return tuple(
            np.asarray((a * b).sum(axis=-1))
            for a, b in ((across, across), (across, along), (along, along))
        )  # type: ignore[return-value]

    @cached_property
    def middle(self) -> tuple[float, float, float]:
        """Metric g_xx, g_xy, g_yy of the middle of the image; of the reference point where that is
        not on the sky.
        """
        ny, nx = self.shape
        found = self.metric((nx - 1) / 2, (ny - 1) / 2)
        if not np.isfinite(found).all():
            x, y = (float(v) - 1 for v in self.wcs.wcs.crpix[:2])
            found = self.metric(x, y)
        xx, xy, yy = (float(g) for g in found)
        return xx, xy, yy

    @property
    def sides(self) -> tuple[float, float]:
        xx, _, yy = self.middle
        return math.sqrt(yy), math.sqrt(xx)

    @property
    def pixel(self) -> float:
        xx, xy, yy = self.middle
        return math.sqrt(math.sqrt(xx * yy - xy**2))

    @cached_property
    def areas(self) -> Floats:
        found = self._solid_angles()
        found.flags.writeable = False
        return found

    def _solid_angles(self) -> Floats:
        ny, nx = self.shape
        flat = abs(float(np.linalg.det(self.matrix)))
        if self.kind == "TAN":  # r^2 on the plane: 1 + r^2 = 1 / cos^2
            x, y = (
                np.arange(n) + 1.0 - float(c)
                for n, c in zip((nx, ny), self.wcs.wcs.crpix[:2], strict=True)
            )
            g = self.matrix.T @ self.matrix
            secant = (
                g[0, 0] * x**2 + (2 * g[0, 1] * x) * y[:, None] + (g[1, 1] * y**2)[:, None] + 1.0
            )
            return np.asarray(flat / (secant * np.sqrt(secant)))
        if self.kind == "CAR" and self.cylinder:
            dx = abs(float(self.matrix[0, 0]))
            dy = abs(float(self.matrix[1, 1]))
            rows = self.latitudes[:, None]
            pole = math.pi / 2
            low, high = (np.clip(rows + side, -pole, pole) for side in (-dy / 2, dy / 2))
            found = dx * 2 * np.sin((high - low) / 2) * np.cos((low + high) / 2)
            return np.where(abs(rows) <= pole * (1 + 1e-12), found, np.nan)
        columns = np.arange(1 if self.cylinder else nx) + (
            float(self.wcs.wcs.crpix[0]) - 1.0 if self.cylinder else 0.0
        )
        found = np.empty((ny, len(columns)))
        for first in range(0, ny, ROWS):
            rows = np.arange(first, min(first + ROWS, ny), dtype=np.float64)
            xx, xy, yy = self.metric(columns[None, :], rows[:, None])
            found[first : first + ROWS] = np.sqrt(np.maximum(xx * yy - xy**2, 0.0))
        return np.where(found > 0, found, np.nan)

    @property
    def once(self) -> Bools:
        found = np.asarray(np.isfinite(self.areas))
        if 0 < self.around < self.shape[1]:
            found = found & (np.arange(self.shape[1]) < self.around)
        return found

    def directions(self) -> Floats:
        ny, nx = self.shape
        found = np.empty((ny, nx, 3))
        for first in range(0, ny, ROWS):
            rows = np.arange(first, min(first + ROWS, ny), dtype=np.float64)
            found[first : first + ROWS] = self.at(np.arange(nx, dtype=np.float64), rows[:, None])
        return found

    def coordinates(self, directions: Floats) -> tuple[Floats, Floats]:
        """0-based pixel coordinates (x, y) of directions (..., 3) of the grid's frame; NaN where
        the projection has none.

        Of a cylindrical image from -1/2 to a full turn beyond; others may lie outside the image.
        """
        directions = np.asarray(directions, np.float64)
        if self.kind == "TAN":
            a, b, c = np.moveaxis(directions @ central(self.wcs).T, -1, 0)
            with np.errstate(invalid="ignore", divide="ignore"):
                return np.where(c > 0, a / c, np.nan), np.where(c > 0, b / c, np.nan)
        lon, lat = np.degrees(angles(directions))
        known = np.isfinite(lon) & np.isfinite(lat)
        pair = [np.where(known, lon % 360.0, 0.0), np.where(known, lat, 0.0)][
            :: -1 if self.wcs.wcs.lng == 1 else 1
        ]
        if self.wcs.has_distortion:
            x, y = self._unbounded.all_world2pix(*pair, 0, quiet=True)
        else:
            x, y = self._unbounded.wcs_world2pix(*pair, 0)
        x = np.where(known, x, np.nan)
        y = np.where(known, y, np.nan)
        if self.cylinder:
            turn = 2 * math.pi / abs(float(self.matrix[0, 0]))
            x = x - turn * np.floor((x + 0.5) / turn)
        return x, y

    def pixels_at(self, directions: Floats) -> Integers:
        x, y = self.coordinates(directions)
        ny, nx = self.shape
        with np.errstate(invalid="ignore"):
            inside = (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)
        column, row = (
            np.rint(np.where(inside, v, 0.0)).astype(np.int64).clip(0, n - 1)
            for v, n in ((x, nx), (y, ny))
        )
        return np.where(inside, row * nx + column, -1)

    def window(self, rows: slice, columns: slice) -> ImagePixels:
        """The grid of a part of the image."""
        (y0, y1, _), (x0, x1, _) = (
            s.indices(n) for s, n in zip((rows, columns), self.shape, strict=True)
        )
        shape = max(y1 - y0, 0), max(x1 - x0, 0)
        world = self.wcs.slice((slice(y0, None), slice(x0, None)))
        return ImagePixels(world, shape, self.nominal)

    def reach(self, angle: float) -> tuple[int, int]:
        """Rows and columns that are at least ``angle`` [rad] wide everywhere in the image."""
        xx, xy, yy = self.scattered_metric
        with np.errstate(invalid="ignore", divide="ignore"):
            rows, columns = (np.sqrt(g / (xx * yy - xy**2)) for g in (xx, yy))
        most = (float(np.nanmax(np.where(np.isfinite(v), v, np.nan))) for v in (rows, columns))
        ny, nx = (min(math.ceil(angle * v), n) for v, n in zip(most, self.shape, strict=True))
        return ny, nx

    @cached_property
    def scattered_metric(self) -> tuple[Floats, Floats, Floats]:
        """The metric at some pixels all over the image, its corners among them."""
        y, x = np.meshgrid(
            *(np.unique(np.linspace(0, n - 1, min(n, 33))) for n in self.shape), indexing="ij"
        )
        return self.metric(x, y)


@dataclass(frozen=True, eq=False)
class HealpixPixels(MapGrid):
    """A list of HEALPix pixels, sorted."""

    nside: int
    nest: bool
    pixels: Integers
    frame: str = "icrs"

    @property
    def shape(self) -> tuple[int, ...]:  # type: ignore[override]
        return (len(self.pixels),)

    @property
    def turn(self) -> Floats:
        return frame_rotation(self.frame)

    @property
    def areas(self) -> Floats:
        return np.array([math.pi / (3 * self.nside**2)])

    @property
    def once(self) -> Bools:
        return np.ones(1, np.bool_)

    @property
    def sides(self) -> tuple[float, float]:
        side = math.sqrt(4 * math.pi / (12 * self.nside**2))
        return side, side

    def directions(self) -> Floats:
        import healpy

        return np.stack(healpy.pix2vec(self.nside, self.pixels, nest=self.nest), axis=-1)

    def pixels_at(self, directions: Floats) -> Integers:
        import healpy

        wanted = np.asarray(
            healpy.vec2pix(self.nside, *np.moveaxis(directions, -1, 0), nest=self.nest)
        )
        pixels = self.pixels if len(self.pixels) else np.array([-1])
        place = np.clip(np.searchsorted(pixels, wanted), 0, len(pixels) - 1)
        return np.where(pixels[place] == wanted, place, -1)


def image_grid(header: Any, shape: tuple[int, ...], nominal: float | None = None) -> ImagePixels:
    """The grid of an image by its FITS header, or any mapping of its keywords.

    ``nominal``: side of a pixel at the reference point [rad], where it is known better than by the
    header's degrees.
    """
    known = ((key, header[key]) for key in header if key not in COMMENTARY)
    cards = tuple(
        (key, value) for key, value in known if isinstance(value, bool | int | float | str)
    )
    return _image(cards, shape, nominal)


def wcs_grid(wcs: Any, shape: tuple[int, ...], nominal: float | None = None) -> ImagePixels:
    """The grid of an image by its `astropy.wcs.WCS`; ``nominal`` as of `image_grid`."""
    wcs = wcs.celestial
    if str(wcs.wcs.ctype[0])[-3:] in CYLINDERS:
        wcs = wcs.deepcopy()  # `_unbounded` changes it
    ny, nx = (int(n) for n in shape)
    return ImagePixels(wcs, (ny, nx), None if nominal is None else (nominal, nominal))


@lru_cache(maxsize=4)  # the maps of all signals of a run share one
def _image(cards: Any, shape: tuple[int, ...], nominal: float | None) -> ImagePixels:
    return wcs_grid(WCS(header_of(cards), naxis=2), shape, nominal)
