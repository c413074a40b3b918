"""Maps that are compared, and how they are brought to one beam and one grid.

One beam: each map is convolved, on its own pixels, with a Gaussian of FWHM sqrt(target^2 - own^2)
on the sky (`core.maps.smoothing`). Pixels count with their solid angles W; those without a value
count neither in the sum nor in its weight, and stay without one:

    m'_p = sum_q K_pq W_q m_q / sum_q K_pq W_q,
    q with a value                                            (1)
    n'_p = [sum_q (K_pq W_q n_q)^2]^(1/2) / sum_q K_pq W_q      (pixels independent before)      (2)

One grid: that of the map with the smaller pixels, so that nothing is aliased; of a HEALPix map its
pixels, whatever those of the other. The other is interpolated by cubic B-splines (HEALPix by the
four neighbours); a pixel has a value where the pixel of the other map that it lies in has one.
Where the grids differ by whole pixels values are copied, bit by bit. With the weights w_i of an
interpolation and the correlation rho_ij = exp(-r_ij^2 / 4 sigma^2) that a smoothing by sigma has
left between pixels, noise becomes

    n'^2 = n^2 sum_ij w_i w_j rho_ij                                                             (3)
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from astropy.wcs import WCS
from astropy.wcs.utils import pixel_to_pixel

from zonda.core.errors import InputError
from zonda.core.maps.grid import HealpixPixels, ImagePixels, MapGrid, image_grid
from zonda.core.maps.map_arrays import on_plane
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.planes import ELSEWHERE, WHITE, noise_factor
from zonda.core.maps.smoothing import smoothed
from zonda.core.numerics.projection import pixel_matrix
from zonda.core.numerics.sphere import FWHM_PER_SIGMA, angle_text, angles, local_axes
from zonda.core.types import Bools, Floats

SAME = 1e-4
"""Pixels: offsets of grids that differ from whole ones by less count as whole."""
EQUAL_BEAMS = 1e-3
"""Relative difference of beams that count as one."""
MOST = 2000
"""Points along each side of the plane onto which a HEALPix map is brought."""
NEIGHBOURS = 12
"""Pixels on either side that a cubic spline through values looks at: beyond, its weights are below
2e-7.
"""


EMPTY, NOT_EMPTY = "no pixel has a value", "give a map that is not NaN everywhere"
"""Message about a map without values, and its cure."""


@dataclass(frozen=True)
class Plane:
    """A map on an image grid, or of HEALPix pixels.

    Attributes
    ----------
    name
        Its name in messages and pictures.
    values
        (ny, nx), or (n_pixel,) of HEALPix; NaN where nothing is known.
    header
        FITS keywords of a two-dimensional celestial WCS; None of HEALPix.
    unit
        Of the values.
    fwhm
        Resolution, rad; 0 for a sky before any beam; None: unknown.
    noise
        Standard error, of the same shape and unit; None: unknown.
    pixels
        Of HEALPix, else None.
    blurred
        Standard deviation [rad] of the Gaussian that the noise was smoothed with: 0 where pixels
        are independent.
    spread
        Solid angle [sr] of the pixels on which it was before it was brought to these; 0: these are
        its own.
    alone, alone_of
        A map of the noise alone, of the same shape and unit (all but the sky; half the difference
        of two halves of the samples), and what it is in words; None, empty: there is none.
    factor
        What `measured` has multiplied the noise by; None: it is white noise alone.
    quiet
        There is no noise in its values: ``noise`` is that of another map.
    """

    name: str
    values: Floats
    header: Any
    unit: str = "K_RJ"
    fwhm: float | None = None
    noise: Floats | None = None
    pixels: HealpixPixels | None = None
    blurred: float = 0.0
    alone: Floats | None = None
    alone_of: str = ""
    factor: float | None = None
    spread: float = 0.0
    quiet: bool = False

    @property
    def noise_in_words(self) -> str:
        """Source of its noise in words; empty if none is known."""
        if self.noise is None:
            return ""
        if self.factor is None:
            return ELSEWHERE if self.quiet else WHITE
        return f"{self.factor:.3g} x white noise, as in {self.alone_of}"

    @property
    def grid(self) -> MapGrid:
        """The positions of its pixels."""
        return image_grid(self.header, self.values.shape) if self.pixels is None else self.pixels

    @property
    def wcs(self) -> Any:
        """The `astropy.wcs.WCS` of an image."""
        return WCS(self.header, naxis=2).celestial

    @property
    def pixel(self) -> float:
        """Side of the square of the median solid angle of the pixels with a value, rad."""
        areas = np.broadcast_to(self.grid.areas, self.values.shape)
        known = areas[np.isfinite(self.values) & np.isfinite(areas)]
        return math.sqrt(float(np.median(known))) if known.size else self.grid.pixel

    def scaled(self, factor: float | Floats, unit: str) -> Plane:
        """In another unit."""
        return replace(
            self,
            values=self.values * factor,
            unit=unit,
            noise=None if self.noise is None else self.noise * factor,
            alone=None if self.alone is None else self.alone * factor,
        )

    def smoothed(self, fwhm: float) -> Plane:
        """The map with a resolution of ``fwhm`` [rad], equations (1) and (2); as it is where its
        own is unknown or equal.
        """
        if self.fwhm is None or self.fwhm >= fwhm * (1 - EQUAL_BEAMS):
            return self
        more = math.sqrt(fwhm**2 - self.fwhm**2)
        noise = self.noise
        if noise is not None:
            noise = np.where(np.isfinite(self.values), noise, np.nan)
        values, noise = smoothed(self.grid, self.values, more, noise=noise)
        if noise is not None and self.blurred:  # pixels were not independent before
            noise = noise * _left(self.blurred, more / FWHM_PER_SIGMA, self.pixel)
        alone = None if self.alone is None else smoothed(self.grid, self.alone, more)[0]
        blurred = math.hypot(self.blurred, more / FWHM_PER_SIGMA)
        return replace(self, values=values, noise=noise, fwhm=fwhm, blurred=blurred, alone=alone)

    def measured(self) -> Plane:
        """The map with the noise times what ``alone`` is of it (`noise_factor`); as it is where
        there is no ``alone``.
        """
        if self.alone is None or self.noise is None:
            return self
        factor = noise_factor(self.noise, self.alone)
        return self if factor is None else replace(self, noise=self.noise * factor, factor=factor)

    def onto(self, other: Plane) -> Plane:
        """On the grid of another; NaN where it does not reach."""
        there = {"header": other.header, "pixels": other.pixels, "alone": None}
        if self.pixels is not None:
            values, noise = _of_neighbours(self, other.grid)
        else:
            x, y = positions(other.grid, self.grid)
            values = _sampled(self.values, x, y, 3)
            noise = None
            if self.noise is not None:
                noise = np.sqrt(_sampled(self.noise**2, x, y, 1))
                noise = noise * _kept(x, y, self.blurred, self.grid.sides)
        return replace(self, values=values, noise=noise, spread=self.pixel**2, **there)

    def independent(self, where: Bools) -> float:
        """Number of independent values of the noise in the pixels ``where``, at most their number.

        It is their solid angle over 2 pi blurred^2, the integral of the square of the correlation,
        or over that of its own pixels if that is larger.
        """
        count = float(np.count_nonzero(where))
        each = max(2 * math.pi * self.blurred**2, self.spread)
        return min(count, max(self.grid.solid_angle(where) / each, 1.0)) if each else count


def _left(before: float, more: float, pixel: float) -> float:
    """Factor on equation (2) for white noise that a Gaussian of ``before`` [rad] has smoothed, of
    ``more`` after it.

    The rms goes from 1 / (sqrt(4 pi) before) to 1 / (sqrt(4 pi) hypot(before, more)); equation (2)
    divides by sqrt(4 pi) more / pixel.
    """
    return max(1.0, before / math.hypot(before, more) * math.sqrt(4 * math.pi) * more / pixel)


def positions(target: MapGrid, source: MapGrid) -> tuple[Floats, Floats]:
    """0-based pixels (x, y) of the image ``source`` at the pixels of a grid, of its shape; NaN
    where the projection has none.
    """
    assert isinstance(source, ImagePixels)  # HEALPix has no such coordinates
    if isinstance(target, ImagePixels) and target.kind == source.kind == "TAN":
        y, x = np.indices(target.shape, np.float64)
        matrix: Floats = pixel_matrix(source.wcs) @ np.linalg.inv(pixel_matrix(target.wcs))
        a, b, c = np.tensordot(matrix, np.stack([x, y, np.ones_like(x)]), 1)
        with np.errstate(invalid="ignore", divide="ignore"):
            return np.where(c > 0, a / c, np.nan), np.where(c > 0, b / c, np.nan)
    try:
        turn = source.turn @ target.turn.T
    except InputError:  # FK4 is no rotation of ICRS
        if not isinstance(target, ImagePixels):
            raise
        y, x = np.indices(target.shape, np.float64)
        return pixel_to_pixel(target.wcs, source.wcs, x, y)  # type: ignore[no-any-return]
    return source.coordinates(target.directions() @ turn.T)


def _sampled(values: Floats, x: Floats, y: Floats, order: int) -> Floats:
    """``values`` at pixels (x, y), by splines of ``order``; copied where all lie at whole
    pixels.
    """
    from scipy.ndimage import distance_transform_edt, map_coordinates

    ny, nx = values.shape
    with np.errstate(invalid="ignore"):
        inside = (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)
    column, row = (
        np.rint(np.where(inside, at, 0)).astype(np.int64).clip(0, n - 1)
        for at, n in ((x, nx), (y, ny))
    )
    near = np.where(inside, values[row, column], np.nan)
    if _whole(x, y, inside):
        return near
    missing = ~np.isfinite(values)
    if missing.any() and not missing.all():
        nearest = distance_transform_edt(missing, return_distances=False, return_indices=True)
        values = values[tuple(nearest)]
    at = np.stack([np.where(inside, y, 0.0), np.where(inside, x, 0.0)])
    edge: Any = {"order": order, "mode": "nearest" if order == 1 else "mirror"}
    return np.where(np.isfinite(near), map_coordinates(values, at, **edge), np.nan)


def _whole(x: Floats, y: Floats, known: Bools) -> bool:
    """True if the positions that are ``known`` are whole pixels."""
    away = [np.abs(at - np.rint(at))[known].max(initial=0.0) for at in (x, y)]
    return bool(max(away) < SAME)


def _kept(x: Floats, y: Floats, blurred: float, sides: tuple[float, float]) -> Floats:
    """Equation (3) of a cubic spline: n' / n at pixels (x, y) of an image with pixels of these
    sides (y, x).
    """
    if _whole(x, y, np.isfinite(x) & np.isfinite(y)):
        return np.ones_like(x)
    offsets = np.linspace(0.0, 1.0, 33)
    found = np.ones_like(x)
    for at, side in ((y, sides[0]), (x, sides[1])):
        share = np.nan_to_num(at - np.floor(at))
        found *= np.interp(share, offsets, _variances(offsets, blurred / side))
    return np.sqrt(found)


def _variances(offsets: Floats, sigma: float) -> Floats:
    """sum_ij w_i w_j rho_ij of the cubic spline along one axis at ``offsets`` (n,) from a pixel;
    ``sigma`` in pixels.
    """
    from zonda.core.numerics.smooth import interpolating, spline_basis

    count = 2 * NEIGHBOURS
    coefficients = interpolating(np.eye(count))  # (pixel, coefficient): through a one at each pixel
    middle = NEIGHBOURS - 1  # offsets lie between it and the next
    weights = coefficients[:, middle - 1 : middle + 3] @ spline_basis(offsets)  # (pixel, n)
    apart = np.subtract.outer(np.arange(count), np.arange(count))
    rho = np.exp(-(apart**2) / (4 * sigma**2)) if sigma > 0 else np.eye(count)
    return np.asarray(np.einsum("in,ij,jn->n", weights, rho, weights), np.float64)


def _of_neighbours(plane: Plane, target: MapGrid) -> tuple[Floats, Floats | None]:
    """Values and noise of a HEALPix map at the pixels of a grid: its own where the two are alike,
    else from four neighbours.
    """
    import healpy

    source = plane.pixels
    assert source is not None  # asked for of HEALPix maps alone
    directions = target.directions() @ target.turn @ source.turn.T
    own = source.pixels_at(directions)
    there = (own >= 0) & np.isfinite(plane.values[own])
    if _same_pixels(target, source):
        noise = None if plane.noise is None else np.where(there, plane.noise[own], np.nan)
        return np.where(there, plane.values[own], np.nan), noise
    lon, lat = angles(directions)
    near, weights = healpy.get_interp_weights(
        source.nside,
        np.pi / 2 - lat.ravel(),
        lon.ravel(),
        nest=source.nest,
    )
    place = np.clip(np.searchsorted(source.pixels, near), 0, len(source.pixels) - 1)
    known = (source.pixels[place] == near) & np.isfinite(plane.values[place])
    weights = np.where(known, weights, 0.0).reshape(4, *target.shape)
    place = place.reshape(4, *target.shape)
    with np.errstate(invalid="ignore", divide="ignore"):
        weights = weights / weights.sum(axis=0)
        values = np.where(there, (weights * np.nan_to_num(plane.values[place])).sum(axis=0), np.nan)
        if plane.noise is None:
            return values, None
        noise = np.nan_to_num(plane.noise[place])
        apart = np.array(healpy.pix2vec(source.nside, source.pixels[place], nest=source.nest))
        apart = ((apart[:, :, None] - apart[:, None]) ** 2).sum(axis=0)
        rho = np.exp(-apart / (4 * plane.blurred**2)) if plane.blurred else (apart == 0) * 1.0
        variance = np.einsum("i...,ij...,j...->...", weights * noise, rho, weights * noise)
        return values, np.where(there, np.sqrt(variance), np.nan)


def _same_pixels(a: Any, b: Any) -> bool:
    both = isinstance(a, HealpixPixels) and isinstance(b, HealpixPixels)
    return both and (a.nside, a.frame) == (b.nside, b.frame)


def common(
    reference: Plane,
    other: Plane,
    fwhm: float | None = None,
) -> tuple[Plane, Plane, list[str]]:
    """The two maps with one beam and on one grid, and notes of the changes.

    Parameters
    ----------
    fwhm
        Resolution, rad; where absent, the wider of the two.

    Raises
    ------
    InputError
        ``fwhm`` is less than one of the two; the maps have no pixel with a value in common.
    """
    target = common_beam(reference, other) if fwhm is None else fwhm
    notes = []
    made = []
    for plane in (reference, other):
        if not np.isfinite(plane.values).any():
            raise InputError(EMPTY, place=plane.name, cure=NOT_EMPTY)
        if plane.fwhm is None:
            notes.append(f"{plane.name}: its beam is not known (BMAJ), so that it is not smoothed")
        elif target < plane.fwhm * (1 - EQUAL_BEAMS):
            wide = angle_text(plane.fwhm)
            what = f"the beam of {angle_text(target)} is smaller than the map's, {wide}"
            raise InputError(what, place=plane.name, cure="choose a larger one")
    for plane in (reference, other):
        made.append(plane.smoothed(target).measured())
        if plane.fwhm is not None and made[-1].fwhm != plane.fwhm:
            before = f"from {angle_text(plane.fwhm)} " if plane.fwhm else ""
            notes.append(f"{plane.name}: smoothed {before}to {angle_text(target)}")
    stays = int(_is_the_grid(made[1], made[0]))
    grid = made[stays]
    own = made[1 - stays]
    made[1 - stays] = own.onto(grid)
    first, second = made
    if not (np.isfinite(first.values) & np.isfinite(second.values)).any():
        raise InputError(
            f"{reference.name} and {other.name} have no pixel in common",
            place="compare",
            cure="compare maps of one field",
        )
    pixels = f"grid of {grid.name}, pixels of {angle_text(grid.pixel)}"
    notes.append(f"{pixels}; {own.name} is {_how(grid, own)}")
    return first, second, notes


def on_a_plane(
    pixels: HealpixPixels,
    planes: Mapping[str, Floats],
) -> tuple[Any, dict[str, Floats]]:
    """Planes of HEALPix pixels as images about their middle, with points as far apart as the pixels
    are and the value of the pixel that each lies in: header, and planes. For pictures and
    spectra."""
    directions = pixels.directions()
    middle = directions.mean(axis=0)
    longitude, latitude = (float(a) for a in angles(middle))
    cosine = (directions @ middle).min() / np.linalg.norm(middle)
    reach = float(np.arccos(np.clip(cosine, -1, 1)))
    size = int(min(MOST, max(8.0, 2 * reach / pixels.pixel + 2)))
    ones = np.ones(len(pixels.pixels))
    product = MapProduct(
        ones,
        ones.astype(np.int64),
        ones,
        ones,
        None,
        None,
        (longitude, latitude),
        pixels.pixel,
        frame=pixels.frame,
        nside=pixels.nside,
        nest=pixels.nest,
        pixels=pixels.pixels,
    )
    made, wcs = on_plane(product, dict(planes), size=size)
    found = {key: np.asarray(values, np.float64) for key, values in made.items()}
    return wcs.to_header(relax=True), found


def cell_of(grid: ImagePixels) -> Floats:
    """(2, 2): steps east and north [rad] of the middle pixel, by one in x (first column) and in
    y.
    """
    y, x = ((n - 1) / 2 for n in grid.shape)
    if not np.isfinite(grid.at(x, y)).all():
        x, y = (float(v) - 1 for v in grid.wcs.wcs.crpix[:2])
    h = 0.25
    longitude, latitude = angles(grid.at(x, y))
    east, north = local_axes(float(longitude), float(latitude))[1:]
    steps = [
        (grid.at(x + h * i, y + h * j) - grid.at(x - h * i, y - h * j)) / (2 * h)
        for i, j in ((1, 0), (0, 1))
    ]
    return np.array([[axis @ step for step in steps] for axis in (east, north)])


def common_beam(reference: Plane, other: Plane) -> float:
    """The wider of two resolutions, rad; 0 where none is known."""
    return max((plane.fwhm for plane in (reference, other) if plane.fwhm is not None), default=0.0)


def _is_the_grid(second: Plane, first: Plane) -> bool:
    """True if two maps are compared on the pixels of the second.

    HEALPix pixels come first, of two such maps the larger ones; of two images the smaller ones.
    """
    if first.pixels is not None and second.pixels is not None:
        return second.pixels.nside < first.pixels.nside
    if first.pixels is not None or second.pixels is not None:
        return second.pixels is not None
    return second.pixel < first.pixel * (1 - EQUAL_BEAMS)


def _how(grid: Plane, own: Plane) -> str:
    """The way in which a map comes to a grid, in words."""
    if own.pixels is not None:
        same = _same_pixels(grid.pixels, own.pixels)
        how = "interpolated between four neighbours"
    else:
        x, y = positions(grid.grid, own.grid)
        same = _whole(x, y, np.isfinite(x) & np.isfinite(y))
        how = "interpolated by cubic splines"
    return "on the same pixels" if same else how
