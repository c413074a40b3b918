"""Putting an image where the user wants it on the sky."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.numerics.sphere import local_axes

from .geometry import is_plain_tan, rescaled
from .inputs import WcsMap
from .resample import from_pixels


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
    return rescaled(wcs, matrix)


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
    return replace(image, turn=local_axes(np.radians(lon), np.radians(lat)).T @ local_axes(*centre))
