"""Largest and smallest values accepted in a sky map: beyond them arithmetic overflows, and no sky
has them.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.numerics.angles import ARCSEC
from zonda.core.types import Floats

LARGEST = 1e30
"""Value of a pixel, in any unit."""
BRIGHTEST = 1e15
"""Brightness, K_RJ: the square of it is a float32."""
SMALLEST_PIXEL, LARGEST_PIXEL = 1e-6 / 3600, 360.0
"""Side of a pixel, and width of a beam, deg."""
FARTHEST = 1e9
"""Pixel of the reference point."""
EQUINOXES = (1500.0, 2500.0)
OBLONG = 20.0
"""Ratio of a pixel's sides beyond which an image's scale is doubted."""
COARSE = 100.0
"""Beams in a pixel beyond which an image's scale is doubted."""


def check_values(values: Floats, place: str, most: float, unit: str, cure: str) -> None:
    """Raise InputError where a value of a map is larger than ``most``. ``values`` may hold NaN."""
    if values.size and (size := float(np.nanmax(np.abs(values), initial=0.0))) > most:
        raise InputError(
            f"its largest value is {size:.3g} {unit}, more than {most:g}", place=place, cure=cure
        )


def check_brightness(values: Floats, place: str) -> None:
    """Raise InputError where a map in K_RJ is brighter than anything."""
    check_values(
        values,
        place,
        BRIGHTEST,
        "K_RJ",
        "check its unit (the header's, or the parameter unit), and the parameter scale",
    )


def check_sides(sides: Any, place: str, cure: str) -> None:
    """Raise InputError where the side of a pixel, or the width of a beam, [deg] is none that a map
    has.
    """
    for side in np.abs(np.asarray(sides, np.float64)):
        if not SMALLEST_PIXEL <= side <= LARGEST_PIXEL:
            raise InputError(
                f"{side:.3g} deg is no size of a pixel or beam, which is 1e-6 arcsec to 360 deg",
                place=place,
                cure=cure,
            )


def check_geometry(matrix: Floats, crpix: Any, header: Any, place: str) -> None:
    """Raise InputError where a WCS with the pixel scale ``matrix`` (2, 2) [deg] cannot be that of a
    map.
    """
    check_sides(np.hypot(matrix[0], matrix[1]), place, "check CDELT1, CDELT2, PC and CD")
    if np.abs(np.asarray(crpix, np.float64)).max() > FARTHEST:
        message = f"the reference point is pixel {', '.join(f'{p:.3g}' for p in crpix)}"
        raise InputError(message, place=place, cure=f"CRPIX1 and CRPIX2 may be up to {FARTHEST:g}")
    for key in ("EQUINOX", "EPOCH"):
        year = header.get(key)
        if isinstance(year, int | float) and year and not EQUINOXES[0] <= year <= EQUINOXES[1]:
            raise InputError(
                f"{key} = {year:g} is no year of an equinox",
                place=place,
                cure=f"set {key}, e.g. to 2000.0",
            )


def odd_pixels(sides: Floats, shape: tuple[int, ...], beam: float) -> str:
    """Warning about pixels that are far too large or too small for a beam, or empty.

    ``sides`` (2,): of a pixel [rad]; ``shape``: (ny, nx); ``beam``: FWHM [rad].
    """
    x, y = (float(side) / ARCSEC for side in sides)
    across, fwhm = max(x * shape[1], y * shape[0]), beam / ARCSEC
    text = f"its pixels are {x:.4g} x {y:.4g} arcsec"
    cure = "are CDELT1 and CDELT2 in degrees?"
    if across < fwhm:
        return (
            f"{text} and all of it {across:.4g} arcsec, less than the beam of {fwhm:.4g} arcsec;"
            f" {cure}"
        )
    if max(x, y) > OBLONG * min(x, y):
        return f"{text}: is one of CDELT1 and CDELT2 wrong?"
    return f"{text}, and the beam {fwhm:.4g} arcsec; {cure}" if min(x, y) > COARSE * fwhm else ""
