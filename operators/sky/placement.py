"""Where an image lies on the sky, and what its pixels are worth in K_RJ."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.numerics.projection import pixel_matrix
from zonda.core.numerics.radiation import to_kelvin_rj
from zonda.core.types import Floats

from .geometry import is_plain_tan, linear
from .inputs import HealpixMap, WcsMap
from .resample import from_pixels, pixel_areas

if TYPE_CHECKING:
    from zonda.core.instrument import Band

CHECKED = 2**22
"""Pixels of which it is looked up whether they are on the sky."""
BRIGHT = 1e4
"""K_RJ, averaged over a beam, above which a map's unit is doubted: the Sun has 6000 K."""


def placed(image: WcsMap, centre: tuple[float, float] | None) -> Any:
    """The TAN `WCS` of an image, or None where it must be resampled (another projection, distortions).

    Parameters
    ----------
    centre
        ICRS (ra, dec) [rad]: the image's centre, pixel ((nx + 1) / 2, (ny + 1) / 2) counted from 1, is put there and becomes
        the tangent point; scale and orientation with respect to north are kept. None: where the header puts it.

    """
    if image.wcs is not None and not is_plain_tan(image.wcs):
        return None
    if centre is None:
        return image.wcs
    from astropy.wcs import WCS

    rows, columns = image.values.shape
    if image.wcs is not None:
        matrix, swapped = np.asarray(image.wcs.pixel_scale_matrix), image.wcs.wcs.lng == 1
    else:
        assert image.scale is not None  # the reader gives one or the other
        matrix, swapped = np.degrees(image.scale), False
    wcs = WCS(naxis=2)
    wcs.wcs.ctype = ["DEC--TAN", "RA---TAN"] if swapped else ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crval = np.degrees(centre)[::-1] if swapped else np.degrees(centre)
    wcs.wcs.crpix = [(columns + 1) / 2, (rows + 1) / 2]
    wcs.wcs.radesys = "ICRS"
    return linear(wcs, matrix)


def turned(image: WcsMap, centre: tuple[float, float], place: str = "") -> WcsMap:
    """An image of any projection with its centre at ``centre``, ICRS (ra, dec) [rad], and its north (of its own coordinates)
    north there: the sphere is turned, so that the image keeps its shape.

    Raises InputError where the image's centre is beyond its projection.
    """
    rows, columns = image.values.shape
    lon, lat = (float(c) for c in from_pixels(image.wcs, np.array((columns - 1) / 2), np.array((rows - 1) / 2)))
    if not np.isfinite([lon, lat]).all():
        raise InputError(
            f"the middle of the map is beyond its projection {', '.join(image.wcs.wcs.ctype)}",
            place=place,
            cure="remove centre, or cut the map",
        )
    return replace(image, turn=_axes(np.radians(lon), np.radians(lat)) @ _axes(*centre).T)


def _axes(lon: float, lat: float) -> Floats:
    """(3, 3) columns: the direction at (lon, lat), east and north there."""
    towards = [np.cos(lat) * np.cos(lon), np.cos(lat) * np.sin(lon), np.sin(lat)]
    east = [-np.sin(lon), np.cos(lon), 0.0]
    north = [-np.sin(lat) * np.cos(lon), -np.sin(lat) * np.sin(lon), np.cos(lat)]
    return np.array([towards, east, north]).T


def tangent_areas(matrix: Floats, shape: tuple[int, int]) -> Floats:
    """Solid angles (ny, nx) [sr] of the pixels of a TAN grid with `pixel_matrix` ``matrix``.

    With H its inverse, a pixel p = (x, y, 1) looks along H p, and dOmega = |det H| / |H p|^3 dx dy.
    """
    inverse = np.linalg.inv(matrix)
    y, x = np.mgrid[0.0 : shape[0], 0.0 : shape[1]]
    rays = np.stack([x, y, np.ones_like(x)], axis=2) @ inverse.T
    return np.asarray(abs(np.linalg.det(inverse)) / np.linalg.norm(rays, axis=2) ** 3)


@dataclass(frozen=True)
class Conversion:
    """From the unit of a map to K_RJ.

    Attributes
    ----------
    factor
        K_RJ per unit, or K_RJ sr per unit where ``per_area``: then each pixel is divided by its own solid angle.
    typical
        K_RJ per unit, at the median pixel where ``per_area``.
    text
        For the tally.
    """

    factor: float
    per_area: bool
    typical: float
    text: str


def conversion(source: WcsMap | HealpixMap, band: Band, spectral_index: float) -> Conversion:
    """Averaged over ``band``, of a map that is resampled.

    Raises InputError as `core.numerics.radiation.to_kelvin_rj`.
    """
    factor = to_kelvin_rj(source.unit, band, 1.0, spectral_index, source.beam_solid_angle)
    if source.unit != "Jy/pixel":
        return Conversion(factor, False, factor, f"{factor:.6g} K_RJ per {source.unit}")
    if isinstance(source, HealpixMap):
        area = np.pi / (3 * source.nside**2)
    else:
        area = float(np.nanmedian(pixel_areas(source.wcs, *(_some(n) for n in source.values.shape))))
    whole = isinstance(source, HealpixMap)
    return Conversion(factor / area if whole else factor, not whole, factor / area, _per_pixel(factor, area))


def _per_pixel(factor: float, area: float) -> str:
    return f"{factor / area:.6g} K_RJ per Jy/pixel at the median pixel, {area:.6g} sr"


def _some(length: int) -> NDArray[np.int64]:
    return np.unique(np.linspace(0, length - 1, min(length, 65)).astype(np.int64))


def lost(image: WcsMap) -> int:
    """How many bright pixels in Jy/pixel lie beyond the projection, where there is no sky; of `CHECKED` and more an estimate."""
    if image.unit != "Jy/pixel":
        return 0
    step = int(np.ceil(np.sqrt(image.values.size / CHECKED)))
    y, x = np.nonzero(image.values[::step, ::step])
    lon, lat = from_pixels(image.wcs, x.astype(np.float64) * step, y.astype(np.float64) * step)
    return int(np.count_nonzero(~(np.isfinite(lon) & np.isfinite(lat)))) * step * step


def kelvin(source: WcsMap, band: Band, spectral_index: float, wcs: Any) -> tuple[Floats, str]:
    """The values in K_RJ averaged over ``band`` of an image on the TAN WCS ``wcs``, and the conversion as text.

    Jy/pixel is divided by each pixel's own solid angle. Raises InputError as `conversion`.
    """
    factor = to_kelvin_rj(source.unit, band, 1.0, spectral_index, source.beam_solid_angle)
    if source.unit != "Jy/pixel":
        return source.values * factor, f"{factor:.6g} K_RJ per {source.unit}"
    areas = tangent_areas(pixel_matrix(wcs), (source.values.shape[0], source.values.shape[1]))
    return source.values * (factor / areas), _per_pixel(factor, float(np.nanmedian(areas)))


def too_bright(peak: float, conversion: str) -> str:
    """What to say of a sky whose brightness in the beam is up to ``peak`` [K_RJ]; empty where that is possible."""
    if peak <= BRIGHT:
        return ""
    return (
        f"in the beam the sky is as bright as {peak:.3g} K_RJ, and the Sun has 6000 K; is the map's unit right ({conversion}), "
        "or are its pixels counts? `unit` replaces the header's, `scale` multiplies the map"
    )
