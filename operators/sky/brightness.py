"""A map on its grid in K_RJ, averaged over a band."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.maps.header import exact_header
from zonda.core.maps.image import Image
from zonda.core.numerics.projection import pixel_matrix
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.types import Floats

from .grid import Grid
from .inputs import HealpixMap, WcsMap
from .limits import check_brightness
from .resample import ImageOnSky, Progress, resample_healpix, resample_image
from .spread import Spread, spread_map

if TYPE_CHECKING:
    from zonda.core.instrument import Band

CHECKED = 2**22
"""Pixels of which it is looked up whether they are on the sky."""
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
        For the tally.
    """

    factor: float | Floats
    per_area: bool
    typical: float
    text: str


def conversion(grid: Grid, band: Band, spectral_index: float) -> Conversion:
    """Averaged over ``band``. Raises InputError as `core.numerics.radiation.to_kelvin_rj`."""
    source = grid.source
    total = to_kelvin_rj(source.unit, band, 1.0, spectral_index, source.beam_solid_angle)
    factor: float | Floats = total
    if source.unit != "Jy/pixel":
        return Conversion(factor, False, total, f"{total:.6g} K_RJ per {source.unit}")
    per_area = False
    if isinstance(source, HealpixMap):
        area = np.pi / (3 * source.nside**2)
        factor = total / area
    elif grid.resampled:
        x, y = np.meshgrid(*(_some(n) for n in source.values.shape[::-1]))
        area, per_area = float(np.nanmedian(ImageOnSky(source).areas(x, y))), True
    else:
        areas = tangent_areas(pixel_matrix(grid.wcs), grid.shape)
        area, factor = float(np.nanmedian(areas)), total / areas
    text = f"{total / area:.6g} K_RJ per Jy/pixel at the median pixel, {area:.6g} sr"
    return Conversion(factor, per_area, total / area, text)


def _some(length: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, length - 1, min(length, 65)).astype(np.int64))


def tangent_areas(matrix: Floats, shape: tuple[int, int]) -> Floats:
    """Solid angles (ny, nx) [sr] of the pixels of a TAN grid with `pixel_matrix` ``matrix``.

    With H its inverse, a pixel p = (x, y, 1) looks along H p, and dOmega = |det H| / |H p|^3 dx dy.
    """
    inverse = np.linalg.inv(matrix)
    return np.asarray(
        abs(np.linalg.det(inverse)) / np.linalg.norm(_rays(inverse, shape), axis=2) ** 3
    )


def tangent_directions(matrix: Floats, shape: tuple[int, int]) -> Floats:
    """ICRS directions (ny, nx, 3) of the pixels of a TAN grid with `pixel_matrix` ``matrix``."""
    rays = _rays(np.linalg.inv(matrix), shape)
    return np.asarray(rays / np.linalg.norm(rays, axis=2, keepdims=True))


def _rays(inverse: Any, shape: tuple[int, int]) -> Floats:
    y, x = np.mgrid[0.0 : shape[0], 0.0 : shape[1]]
    return np.asarray(np.stack([x, y, np.ones_like(x)], axis=2) @ inverse.T)


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
        What was chosen, and what was taken for something else, for the tally.
    polarization
        (2, ny, nx) Q and U from the meridians through `Grid.axis`; 0 where nothing is known. None:
        there are none.
    resolution
        FWHM [rad] of the Gaussians by which pixels were spread; 0: they were not.
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
    source = grid.source
    values = source.values * found.factor * scale
    check_brightness(values, place)
    pixel = np.linalg.norm(np.asarray(grid.wcs.pixel_scale_matrix), axis=0) * 3600
    notes = {
        **source.notes,
        "input map": (
            f"TAN, {grid.shape[1]} x {grid.shape[0]} pixels of {pixel[0]:.6g} x {pixel[1]:.6g}"
            " arcsec"
        ),
        "conversion": found.text,
    }
    polarization = None
    if source.polarization is not None and grid.pole is not None:
        turn = between_meridians(
            tangent_directions(pixel_matrix(grid.wcs), grid.shape), grid.pole, grid.axis
        )
        polarization = turned_by(source.polarization * (found.factor * scale), turn)
        check_brightness(polarization, place)
    return Brightness(
        grid.key,
        values,
        np.zeros((0, 0), bool),
        grid.wcs,
        notes,
        {ZEROED: source.zeroed},
        polarization,
    )


def resampled(
    grid: Grid,
    found: Conversion,
    scale: float,
    outside: float,
    place: str,
    progress: Progress,
    spread: Spread | None,
) -> Brightness:
    """A map on a TAN grid, spread or interpolated; ``outside`` where it has no data. Raises as
    `on_own_pixels`.
    """
    assert isinstance(found.factor, float)  # of own pixels alone there is one for each
    source, wcs, factor = grid.source, grid.wcs, found.factor * scale
    least_and_largest = np.array(
        [np.min(source.values, initial=0.0), np.max(source.values, initial=0.0)]
    )
    check_brightness(least_and_largest * (found.typical * scale), place)
    counts, axis = {ZEROED: source.zeroed}, None if source.polarization is None else grid.axis
    if isinstance(source, HealpixMap):
        kind = f"HEALPix of nside {source.nside}"
    else:
        kind, counts[LOST] = f"projection {', '.join(source.wcs.wcs.ctype)}", _lost(source)
    part = (
        f", of which {grid.points / np.prod(grid.shape):.0%} is reached"
        if grid.tiles is not None
        else ""
    )
    where = (
        f"TAN grid of {grid.shape[1]} x {grid.shape[0]} pixels of"
        f" {np.degrees(grid.step) * 3600:.6g} arcsec about the observation"
    )
    if spread is not None:
        how = f"its pixels spread, by their own solid angles, over a {where}{part}"
        values, covered = spread_map(
            source,
            wcs,
            spread,
            factor,
            per_area=found.per_area,
            outside=outside,
            tiles=grid.tiles,
            progress=progress,
            axis=axis,
        )
    else:
        how = (
            f"interpolated (third order) onto a {where}{part}; its error falls with the third power"
            " of the input's pixel size"
        )
        if isinstance(source, HealpixMap):
            values, covered, counts[POOR] = resample_healpix(
                source, wcs, grid.tiles, progress, axis
            )
        else:
            values, covered = resample_image(
                source, wcs, grid.tiles, progress, found.per_area, axis
            )
        values *= factor
    progress(0, 0)
    notes = {**source.notes, "input map": f"{kind}, {how}", "conversion": found.text}
    mask = np.zeros((0, 0), bool) if covered.all() else covered
    intensity = values if axis is None else values[0]
    bright = np.where(covered, intensity, outside) if spread is None else intensity + outside
    resolution = 0.0 if spread is None else spread.resolution
    return Brightness(
        grid.key, bright, mask, wcs, notes, counts, None if axis is None else values[1:], resolution
    )


def _lost(image: WcsMap) -> int:
    """Number of bright pixels in Jy/pixel beyond the projection, where there is no sky; an estimate
    for `CHECKED` and more.
    """
    if image.unit != "Jy/pixel":
        return 0
    step = int(np.ceil(np.sqrt(image.values.size / CHECKED)))
    y, x = np.nonzero(image.values[::step, ::step])
    d = ImageOnSky(image).grid.at(x * step, y * step)
    return int(np.count_nonzero(~np.isfinite(d).all(axis=-1))) * step * step


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
