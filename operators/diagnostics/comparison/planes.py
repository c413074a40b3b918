"""Maps that are compared, and how they are brought to one beam and one grid.

One beam: each map is convolved, on its own pixels, with a Gaussian of FWHM sqrt(target^2 - own^2). Pixels without a value count
neither in the sum nor in its weight, and stay without one:

    m'_p = sum_q K_(p-q) m_q / sum_q K_(p-q),    q with a value                                              (1)
    n'_p = [sum_q K_(p-q)^2 n_q^2]^(1/2) / sum_q K_(p-q)      (pixels independent before)                    (2)

One grid: that of the map with the smaller pixels, so that nothing is aliased. The other is interpolated by cubic B-splines; a
pixel has a value where the pixel of the other map that it lies in has one. Where the grids differ by whole pixels values are
copied, bit by bit.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.numerics import tangent
from zonda.core.numerics.angles import FWHM_PER_SIGMA, angle_text
from zonda.core.numerics.projection import pixel_matrix
from zonda.core.numerics.transforms import gaussian_taps
from zonda.core.types import Floats

SAME = 1e-4
"""Pixels: offsets of grids that differ from whole ones by less count as whole."""
EQUAL_BEAMS = 1e-3
"""Relative difference of beams that count as one."""


@dataclass(frozen=True)
class Plane:
    """A map on an image grid.

    Attributes
    ----------
    name
        Its name in messages and pictures.
    values
        (ny, nx), NaN where nothing is known.
    header
        FITS keywords of a two-dimensional celestial WCS.
    unit
        Of the values.
    fwhm
        Resolution, rad; 0 for a sky before any beam; None: unknown.
    noise
        (ny, nx) standard error, same unit; None: unknown.
    """

    name: str
    values: Floats
    header: Any
    unit: str = "K_RJ"
    fwhm: float | None = None
    noise: Floats | None = None

    @property
    def wcs(self) -> Any:
        """A `TangentWcs` or an `astropy.wcs.WCS`."""
        found = tangent.plain(self.header)
        if found is not None:
            return found
        from astropy.wcs import WCS

        return WCS(self.header, naxis=2).celestial

    @property
    def sides(self) -> tuple[float, float]:
        """Of a pixel along y and x, rad."""
        x, y = np.radians(np.sqrt((np.asarray(self.wcs.pixel_scale_matrix) ** 2).sum(axis=0)))
        return float(y), float(x)

    @property
    def pixel(self) -> float:
        """Side of the square of a pixel's area, rad."""
        return math.sqrt(math.prod(self.sides))

    def scaled(self, factor: float, unit: str) -> Plane:
        """In another unit."""
        return replace(self, values=self.values * factor, unit=unit, noise=None if self.noise is None else self.noise * factor)

    def smoothed(self, fwhm: float) -> Plane:
        """With a resolution of ``fwhm`` [rad], equations (1) and (2); as it is where its own is unknown or equal."""
        if self.fwhm is None or self.fwhm >= fwhm * (1 - EQUAL_BEAMS):
            return self
        sigmas = [math.sqrt(fwhm**2 - self.fwhm**2) / FWHM_PER_SIGMA / side for side in self.sides]
        known = np.isfinite(self.values)
        share = _convolved(known.astype(np.float64), sigmas)
        with np.errstate(invalid="ignore", divide="ignore"):
            values = np.where(known, _convolved(np.where(known, self.values, 0.0), sigmas) / share, np.nan)
            noise = None
            if self.noise is not None:
                variance = _convolved(np.where(np.isfinite(self.noise), self.noise, 0.0) ** 2, sigmas, squared=True)
                noise = np.where(np.isfinite(self.noise), np.sqrt(variance) / share, np.nan)
        return replace(self, values=values, noise=noise, fwhm=fwhm)

    def onto(self, other: Plane) -> Plane:
        """On the grid of another; NaN where it does not reach."""
        shape = other.values.shape
        x, y = positions(other.wcs, shape, self.wcs)
        noise = None if self.noise is None else _sampled(self.noise, x, y, 1)
        return replace(self, values=_sampled(self.values, x, y, 3), noise=noise, header=other.header)


def _convolved(values: Floats, sigmas: list[float], squared: bool = False) -> Floats:
    """With a Gaussian of ``sigmas`` pixels along y and x, zeros beyond the edges; or with the square of the kernel."""
    from scipy.ndimage import correlate1d

    for axis, sigma in enumerate(sigmas):
        side = gaussian_taps(sigma)
        taps = np.concatenate([side[:0:-1], side])
        values = correlate1d(values, taps**2 if squared else taps, axis, mode="constant")
    return np.asarray(values, np.float64)


def positions(target: Any, shape: tuple[int, int], source: Any) -> tuple[Floats, Floats]:
    """0-based pixels (x, y) of ``source`` at the pixels of a grid (ny, nx); NaN where the projection has none."""
    y, x = np.indices(shape, np.float64)
    try:
        matrix = pixel_matrix(source) @ np.linalg.inv(pixel_matrix(target))
    except InputError:
        return _by_astropy(target, source, x, y)
    a, b, c = np.tensordot(matrix, np.stack([x, y, np.ones_like(x)]), 1)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(c > 0, a / c, np.nan), np.where(c > 0, b / c, np.nan)


def _by_astropy(target: Any, source: Any, x: Floats, y: Floats) -> tuple[Floats, Floats]:
    from astropy.wcs.utils import pixel_to_pixel

    whole = [wcs.astropy() if isinstance(wcs, tangent.TangentWcs) else wcs for wcs in (target, source)]
    try:
        return pixel_to_pixel(*whole, x, y)  # type: ignore[no-any-return]
    except Exception as error:
        raise InputError(
            f"the two projections cannot be compared: {error}", place="WCS", cure="check CTYPE and RADESYS"
        ) from error


def _sampled(values: Floats, x: Floats, y: Floats, order: int) -> Floats:
    """``values`` at pixels (x, y), by splines of ``order``; copied where all lie at whole pixels."""
    from scipy.ndimage import distance_transform_edt, map_coordinates

    ny, nx = values.shape
    with np.errstate(invalid="ignore"):
        inside = (x >= -0.5) & (x < nx - 0.5) & (y >= -0.5) & (y < ny - 0.5)
    column, row = (np.rint(np.where(inside, at, 0)).astype(np.int64).clip(0, n - 1) for at, n in ((x, nx), (y, ny)))
    near = np.where(inside, values[row, column], np.nan)
    off = max(float(np.abs(np.where(inside, at - whole, 0)).max(initial=0.0)) for at, whole in ((x, column), (y, row)))
    if off < SAME or not inside.any():
        return near
    missing = ~np.isfinite(values)
    if missing.any() and not missing.all():
        values = values[tuple(distance_transform_edt(missing, return_distances=False, return_indices=True))]
    at = np.stack([np.where(inside, y, 0.0), np.where(inside, x, 0.0)])
    if order == 1:
        found = map_coordinates(values, at, order=1, mode="nearest")
    else:
        found = map_coordinates(values, at, order=3, mode="mirror")
    return np.where(np.isfinite(near), found, np.nan)


def common(reference: Plane, other: Plane, fwhm: float | None = None) -> tuple[Plane, Plane, list[str]]:
    """Both maps with one beam and on one grid, and what was done to them.

    Parameters
    ----------
    fwhm
        Resolution, rad; where absent, the wider of the two.

    Raises
    ------
    InputError
        ``fwhm`` is less than one of the two; the maps have no pixel with a value in common.
    """
    known = [plane.fwhm for plane in (reference, other) if plane.fwhm is not None]
    target, notes = max(known, default=0.0) if fwhm is None else fwhm, []
    for plane in (reference, other):
        if not np.isfinite(plane.values).any():
            raise InputError("no pixel has a value", place=plane.name, cure="give a map that is not NaN everywhere")
        if plane.fwhm is None:
            notes.append(f"{plane.name}: its beam is not known (BMAJ), so that it is not smoothed")
        elif target < plane.fwhm * (1 - EQUAL_BEAMS):
            beams = f"the beam of {angle_text(target)} is smaller than the map's, {angle_text(plane.fwhm)}"
            raise InputError(beams, place=plane.name, cure="choose a larger one")
    made = []
    for plane in (reference, other):
        made.append(plane.smoothed(target))
        if made[-1] is not plane:
            before = f"from {angle_text(plane.fwhm)} " if plane.fwhm else ""
            notes.append(f"{plane.name}: smoothed {before}to {angle_text(target)}")
    first, second = made
    if second.pixel < first.pixel * (1 - EQUAL_BEAMS):
        moved, grid = first.onto(second), second
        first = moved
    else:
        moved, grid = second.onto(first), first
        second = moved
    both = np.isfinite(first.values) & np.isfinite(second.values)
    if not both.any():
        raise InputError(
            f"{reference.name} and {other.name} have no pixel in common", place="compare", cure="compare maps of one field"
        )
    notes.append(f"grid of {grid.name}, pixels of {angle_text(grid.pixel)}; {moved.name} {_how(grid, moved, reference, other)}")
    return first, second, notes


def _how(grid: Plane, moved: Plane, *given: Plane) -> str:
    own = next(plane for plane in given if plane.name == moved.name)
    x, y = positions(grid.wcs, grid.values.shape, own.wcs)
    whole = np.nanmax(np.abs([x - np.rint(x), y - np.rint(y)])) < SAME
    return "is on the same pixels" if whole else "is interpolated by cubic splines"
