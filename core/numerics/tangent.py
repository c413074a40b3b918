"""World coordinates of a plain tangent-plane (TAN) image, without `astropy.wcs`, which takes 0.4 s
to import.

No rotation, no distortion, in ICRS or Galactic coordinates: what zonda makes, and most of what it
reads. `TangentWcs` answers to the names of `astropy.wcs.WCS` that zonda asks for; any other name is
answered by astropy.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..storage.fits_image import Cards
from ..types import Floats
from .projection import central

AXES = {"icrs": ("RA---TAN", "DEC--TAN"), "galactic": ("GLON-TAN", "GLAT-TAN")}
_WORDS = {
    "icrs": ("Right ascension", "Declination"),
    "galactic": ("Galactic longitude", "Galactic latitude"),
}

_MORE = re.compile(
    r"CD\d|PC\d|PV|PS|CROTA|[AB]P?_|C[PQ]DIS|D[PQ]\d|D2IM|DVERR|RADECSYS|EPOCH|EQUINOX|VELANGL"
)
"""Keys that may make of a header more than a `TangentWcs`."""


@dataclass(frozen=True)
class TangentWcs:
    """A TAN image.

    Attributes
    ----------
    frame
        ``icrs`` or ``galactic``.
    crval, crpix, cdelt
        As in a FITS header: (longitude, latitude) [deg] of the tangent point, less than 90 deg from
        the equator; its pixel (x, y), counted from 1; degrees per pixel along x and y.
    """

    frame: str
    crval: tuple[float, float]
    crpix: tuple[float, float]
    cdelt: tuple[float, float]

    naxis = 2
    lng, lat = 0, 1
    lonpole = 180.0
    has_distortion = False

    @property
    def wcs(self) -> TangentWcs:
        """Itself: astropy keeps FITS's parameters one level down."""
        return self

    celestial = wcs

    @property
    def ctype(self) -> tuple[str, str]:
        """FITS names of the axes."""
        return AXES[self.frame]

    @property
    def pixel_scale_matrix(self) -> Floats:
        """(2, 2) deg per pixel."""
        return np.diag(self.cdelt)

    def set(self) -> None:
        """Nothing: it is consistent."""

    def get_pv(self) -> list[Any]:
        """No parameters of the projection."""
        return []

    def wcs_pix2world(self, *arguments: Any) -> Any:
        """(x, y, origin) to two arrays, or (pixels (n, 2), origin) to (n, 2): longitudes in [0,
        360) and latitudes [deg].
        """
        *pixels, origin = arguments
        pair = (
            np.asarray(pixels[0], np.float64).T
            if len(pixels) == 1
            else np.broadcast_arrays(*pixels)
        )
        x, y = (np.asarray(axis, np.float64) - origin for axis in pair)
        a, b, c = np.tensordot(np.linalg.inv(central(self)), np.stack([x, y, np.ones_like(x)]), 1)
        world = np.degrees(np.arctan2(b, a)) % 360.0, np.degrees(np.arctan2(c, np.hypot(a, b)))
        return np.stack(world, axis=1) if len(pixels) == 1 else list(world)

    def to_header(self, relax: bool = True) -> Cards:
        """The keys that astropy writes."""
        header = Cards([("WCSAXES", 2, "Number of coordinate axes")])
        degrees = "Units of coordinate increment and value"
        for key, values, text in (
            ("CRPIX", self.crpix, ["Pixel coordinate of reference point"] * 2),
            ("CDELT", self.cdelt, ["[deg] Coordinate increment at reference point"] * 2),
            ("CUNIT", ("deg", "deg"), [degrees] * 2),
            ("CTYPE", self.ctype, [f"{word}, gnomonic projection" for word in _WORDS[self.frame]]),
            ("CRVAL", self.crval, ["[deg] Coordinate value at reference point"] * 2),
        ):
            for k in (0, 1):
                header[f"{key}{k + 1}"] = (values[k], text[k])
        header["LONPOLE"] = (self.lonpole, "[deg] Native longitude of celestial pole")
        header["LATPOLE"] = (self.crval[1], "[deg] Native latitude of celestial pole")
        header["MJDREF"] = (0.0, "[d] MJD of fiducial time")
        if self.frame == "icrs":
            header["RADESYS"] = ("ICRS", "Equatorial coordinate system")
        return header

    def astropy(self) -> Any:
        """The same as an `astropy.wcs.WCS`."""
        from astropy.wcs import WCS

        return WCS(self.to_header())

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        whole = self.astropy()
        return getattr(whole if hasattr(whole, name) else whole.wcs, name)


def plain(header: Any) -> TangentWcs | None:
    """What a FITS header says, or None where that is more than a `TangentWcs` holds, or not
    valid.
    """
    frame = next(
        (f for f, axes in AXES.items() if axes == (header.get("CTYPE1"), header.get("CTYPE2"))),
        None,
    )
    if frame is None or any(_MORE.match(key) for key in header):
        return None
    system = header.get("RADESYS", "ICRS" if frame == "icrs" else "")
    if system != ("ICRS" if frame == "icrs" else "") or header.get("LONPOLE", 180.0) != 180.0:
        return None
    if (
        any(header.get(f"CUNIT{k}", "deg") != "deg" for k in (1, 2))
        or header.get("WCSAXES", 2) != 2
    ):
        return None
    crval, crpix, cdelt = (
        [header.get(f"{key}{k}") for k in (1, 2)] for key in ("CRVAL", "CRPIX", "CDELT")
    )
    if not all(type(v) in (int, float) and math.isfinite(v) for v in (*crval, *crpix, *cdelt)):
        return None
    if not all(cdelt) or not abs(crval[1]) < 90.0:
        return None
    return TangentWcs(
        frame,
        (float(crval[0]), float(crval[1])),
        (float(crpix[0]), float(crpix[1])),
        (float(cdelt[0]), float(cdelt[1])),
    )
