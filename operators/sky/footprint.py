"""Place of an input map on the sky by its header alone, for `zonda check` and ``target: map``."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.configuration.target import Target
from zonda.core.maps.map_reading import chosen, is_healpix
from zonda.core.numerics.projection import pixel_matrix
from zonda.core.numerics.sphere import angle_between, angles, unit_vectors
from zonda.core.storage.files import reading
from zonda.core.storage.fits_files import opened
from zonda.core.types import Floats

from .geometry import geometry, moved, placed
from .input_map import ImageMap


@dataclass(frozen=True)
class Footprint:
    """Centre and extent of a map on the sky.

    Attributes
    ----------
    centre
        ICRS direction (3,) of the middle of the image.
    radius
        Largest distance of its pixels from there, rad.
    matrix
        From ICRS directions to pixels (`pixel_matrix`) of a TAN image, else None.
    shape
        (ny, nx).
    """

    centre: Floats
    radius: float
    matrix: Floats | None
    shape: tuple[int, int]

    def holds(self, direction: Floats) -> bool:
        """True if an ICRS direction (3,) is on the map; in other projections than TAN, within its
        `radius`.
        """
        if self.matrix is None:
            return bool(direction @ self.centre >= np.cos(self.radius))
        x, y, depth = self.matrix @ direction
        ny, nx = self.shape
        return bool(depth > 0 and -0.5 <= x / depth <= nx - 0.5 and -0.5 <= y / depth <= ny - 0.5)

    @property
    def target(self) -> Target:
        """Its centre as text, to 1e-9 deg."""
        ra, dec = np.degrees(angles(self.centre))
        return Target.parse(f"{ra:.9f} deg {dec:.9f} deg")


def footprint(
    header: Any, shape: tuple[int, int], pixel_size: float | None, centre: Target | None, place: str
) -> Footprint | None:
    """The footprint of an image (`header_of`); None where it has no place of its own: an image
    without a WCS.

    ``pixel_size`` [rad] and ``centre`` as `SkyMap` has them. Raises `InputError` as
    `read.read_map`.
    """
    wcs, placeless = geometry(place, header, shape, pixel_size, centre is not None, {})
    values = np.broadcast_to(np.float64(0.0), shape)
    image = ImageMap(values=values, unit="K_RJ", wcs=wcs, placeless=placeless)
    if centre is None and placeless:
        return None
    tangent = placed(image, None if centre is None else centre.icrs())
    if centre is not None:
        image = moved(image, centre.icrs(), place)
    with reading(place, "FITS", "check CTYPE, CRVAL, CRPIX, CDELT, PC or CD"):
        disc, _ = image.extent
    if disc is None:
        return None
    matrix = None if tangent is None else pixel_matrix(tangent)
    return Footprint(disc.centre, disc.radius, matrix, shape)


def header_of(
    path: Path, wanted: int | str | None, place: str
) -> tuple[Any, tuple[int, int]] | None:
    """Header and (ny, nx) of a file's first image, or of the extension ``wanted``; None: a HEALPix
    table.
    """
    with opened(
        path, place, "check the file, e.g. with fitsinfo or fitsverify, or copy it again"
    ) as hdus:
        hdu, _ = chosen(hdus, wanted, place)
        if is_healpix(hdu):
            return None
        return hdu.header.copy(), (
            int(hdu.header.get("NAXIS2", 1)),
            int(hdu.header.get("NAXIS1", 1)),
        )


def off_the_map(found: Footprint, centre: tuple[float, float], label: str) -> str:
    """The warning about a scan about ``centre``, ICRS (ra, dec) [rad], that is not on the map;
    empty where it is.
    """
    ra, dec = centre
    direction = unit_vectors(ra, dec)
    if found.holds(direction):
        return ""
    away = np.degrees(angle_between(direction, found.centre))
    return (
        f"{label}: the target {position(ra, dec)} is not on the input map, whose centre,"
        f" {position(*found.target.icrs())}, is {away:.3g} deg away; `target: map` looks there"
    )


def position(ra: float, dec: float) -> str:
    """ICRS coordinates as a pipeline file takes them."""
    return f"{np.degrees(ra):.5f} deg {np.degrees(dec):.5f} deg"
