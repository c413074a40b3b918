"""A map on its grid in K_RJ, averaged over a band."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.maps.header import exact_header
from zonda.core.maps.image import Image
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.types import Floats

from .grid import Grid
from .gridding import Gridding, gridded, interpolated
from .input_map import ImageMap
from .map_header import check_brightness
from .region import Progress, directions_on

if TYPE_CHECKING:
    from zonda.core.instrument import Band

BRIGHT = 1e4
"""K_RJ, averaged over a beam, above which a map's unit is doubted: the Sun has 6000 K."""
ZEROED = "pixels of the input map that are NaN or infinite, taken as zero"
LOST = "bright pixels of the input map beyond its projection, whose flux is lost"
POOR = "grid points whose neighbours determine no third-order fit, taken as their mean"


@dataclass(frozen=True)
class Conversion:
    """Conversion from the unit of a map to K_RJ.

    Attributes
    ----------
    factor
        K_RJ per unit, (ny, nx) where pixels differ; K_RJ sr per unit where ``per_area``: then each
        pixel is divided by its own solid angle while it is resampled.
    typical
        K_RJ per unit, at the median pixel where pixels differ.
    text
        For the log.
    """

    factor: float | Floats
    per_area: bool
    typical: float
    text: str


def conversion(grid: Grid, band: Band, spectral_index: float) -> Conversion:
    """Averaged over ``band``. Raises InputError as `core.numerics.radiation.to_kelvin_rj`."""
    source = grid.source
    total = to_kelvin_rj(source.unit, band, 1.0, spectral_index, source.beam_solid_angle)
    if source.unit != "Jy/pixel":
        return Conversion(total, False, total, f"{total:.6g} K_RJ per {source.unit}")
    factor: float | Floats = total
    per_area = grid.resampled and isinstance(source, ImageMap)
    if not grid.resampled:
        areas = tangent_areas(grid.matrix, grid.shape)
        factor = total / areas
    elif per_area:
        some = (
            np.unique(np.linspace(0, n - 1, min(n, 65)).astype(int))
            for n in grid.source.values.shape
        )
        areas = source.areas(tuple(np.meshgrid(*some, indexing="ij")))
    else:
        areas = source.areas((np.zeros(1, np.int64),))
        factor = total / float(areas[0])
    area = float(np.nanmedian(areas))
    text = f"{total / area:.6g} K_RJ per Jy/pixel at the median pixel, {area:.6g} sr"
    return Conversion(factor, per_area, total / area, text)


def tangent_areas(matrix: Floats, shape: tuple[int, int]) -> Floats:
    """Solid angles (ny, nx) [sr] of the pixels of a TAN grid with `pixel_matrix` ``matrix``.

    With H its inverse, a pixel p = (x, y, 1) looks along H p, and dOmega = |det H| / |H p|^3 dx dy.
    """
    inverse, (y, x) = np.linalg.inv(matrix), np.indices(shape, np.float64)
    rays = np.stack([x, y, np.ones_like(x)], axis=2) @ inverse.T
    return np.asarray(abs(np.linalg.det(inverse)) / np.linalg.norm(rays, axis=2) ** 3)


@dataclass(frozen=True)
class Brightness:
    """A map in K_RJ on its grid.

    Attributes
    ----------
    key
        Of the grid.
    values
        (ny, nx).
    covered
        (ny, nx), or (0, 0): everywhere.
    notes, counts
        What was chosen, and what was taken for something else, for the log.
    polarization
        (2, ny, nx) Q and U from the meridians through `Grid.axis`; 0 where nothing is known. None:
        there are none.
    resolution
        FWHM [rad] of the Gaussians with which pixels were gridded; 0: they were not.
    """

    key: tuple[Hashable, ...]
    values: Floats
    covered: NDArray[np.bool_]
    wcs: Any
    notes: dict[str, str]
    counts: dict[str, int]
    polarization: Floats | None = None
    resolution: float = 0.0

    @property
    def nbytes(self) -> int:
        return (
            self.values.nbytes
            + self.covered.nbytes
            + (0 if self.polarization is None else self.polarization.nbytes)
        )

    def image(self, label: str, axis: Floats) -> Image:
        """For pictures and comparisons; NaN where nothing is known. ``label``: the operator's;
        ``axis``: the grid's.
        """
        header = exact_header(self.wcs)
        header["BUNIT"], header["TEMPSCAL"], header["OPERATOR"] = "K", "K_RJ", label
        if self.resolution:
            header["BMAJ"] = header["BMIN"] = float(np.degrees(self.resolution))
        values = np.where(self.covered, self.values, np.nan) if self.covered.size else self.values
        return Image(values, header, "K_RJ", self.polarization, axis)


def on_own_pixels(grid: Grid, found: Conversion, scale: float, place: str) -> Brightness:
    """The values of a TAN image times ``scale``. Raises InputError where it is brighter than
    anything.
    """
    source, polarization = grid.source, None
    values = source.values * found.factor * scale
    check_brightness(values, place)
    if source.polarization is not None and grid.pole is not None:
        y, x = np.indices(grid.shape, np.float64)
        turn = between_meridians(directions_on(grid.matrix, x, y), grid.pole, grid.axis)
        polarization = turned_by(source.polarization * (found.factor * scale), turn)
        check_brightness(polarization, place)
    sides = np.linalg.norm(np.asarray(grid.wcs.pixel_scale_matrix), axis=0) * 3600
    what = (
        f"TAN, {grid.shape[1]} x {grid.shape[0]} pixels of {sides[0]:.6g} x {sides[1]:.6g} arcsec"
    )
    notes = {**source.notes, "input map": what, "conversion": found.text}
    everywhere, counts = np.zeros((0, 0), bool), {ZEROED: source.zeroed}
    return Brightness(grid.key, values, everywhere, grid.wcs, notes, counts, polarization)


def resampled(
    grid: Grid,
    found: Conversion,
    scale: float,
    outside: float,
    place: str,
    progress: Progress,
    gridding: Gridding | None,
) -> Brightness:
    """A map on a TAN grid, gridded or interpolated; ``outside`` where it has no data. Raises as
    `on_own_pixels`.
    """
    assert isinstance(found.factor, float)  # of own pixels alone there is one for each
    source, factor, resolution = grid.source, found.factor * scale, 0.0
    ends = np.array([np.min(source.values, initial=0.0), np.max(source.values, initial=0.0)])
    check_brightness(ends * (found.typical * scale), place)
    counts, axis = {ZEROED: source.zeroed}, None if source.polarization is None else grid.axis
    counts[LOST] = source.lost
    where = (
        f"TAN grid of {grid.shape[1]} x {grid.shape[0]} pixels of"
        f" {np.degrees(grid.step) * 3600:.6g} arcsec about the observation"
    )
    if grid.tiles is not None:
        where += f", of which {grid.points / np.prod(grid.shape):.0%} is reached"
    if gridding is not None:
        how, resolution = "its pixels spread, by their own solid angles, over", gridding.resolution
        values, covered = gridded(
            source,
            grid.wcs,
            gridding,
            factor,
            per_area=found.per_area,
            outside=outside,
            tiles=grid.tiles,
            progress=progress,
            axis=axis,
        )
        values[0] += outside
    else:
        how = "interpolated (third order) onto"
        where += "; its error falls with the third power of the input's pixel size"
        values, covered, counts[POOR] = interpolated(
            source, grid.wcs, grid.tiles, progress, found.per_area, axis
        )
        values *= factor
        values[0, ~covered] = outside
    progress(0, 0)
    what = f"{source.kind}, {how} a {where}"
    notes = {**source.notes, "input map": what, "conversion": found.text}
    mask = np.zeros((0, 0), bool) if covered.all() else covered
    q_and_u = None if axis is None else values[1:]
    return Brightness(grid.key, values[0], mask, grid.wcs, notes, counts, q_and_u, resolution)


def too_bright(peak: float, conversion: str) -> str:
    """The warning about a sky whose brightness in the beam is up to ``peak`` [K_RJ]; empty where
    that is plausible.
    """
    if peak <= BRIGHT:
        return ""
    return (
        f"in the beam the sky is as bright as {peak:.3g} K_RJ, and the Sun has 6000 K; is the map's"
        f" unit right ({conversion}), or are its pixels counts? `unit` replaces the header's,"
        " `scale` multiplies the map"
    )
