"""Cards of FITS headers from elsewhere, checked for their type at reading, for maps, masks and
comparisons alike; headers of world coordinates.
"""

from __future__ import annotations

import math
import re
from typing import Any

import numpy as np
from astropy.io.fits import Header

from ..errors import InputError
from ..storage.fits_files import COMMENTARY, header_of
from ..types import AnyFloats, Bools

FRAMES = ("ICRS", "FK5", "FK4", "FK4-NO-E")
"""Values of RADESYS that are read (FITS 4.0, table 24, without GAPPT: apparent places, which depend
on an instant).
"""
_SAME = {
    **dict.fromkeys(("J2000", "J2000.0", "FK5J2000", "EQUATORIALJ2000"), ("FK5", 2000.0)),
    **dict.fromkeys(("B1950", "B1950.0", "FK4B1950"), ("FK4", 1950.0)),
    **dict.fromkeys(("ICRF", "ICRF2", "ICRF3", "GCRS"), ("ICRS", None)),
}  # fmt: skip
"""What CASA, AIPS and others write: RADESYS and equinox."""
_NUMBERS = re.compile(
    r"(CRPIX|CRVAL|CDELT|CROTA)[12]|(CD|PC)[12]_[12]|LONPOLE|LATPOLE|PV[12]_\d+|EQUINOX|EPOCH"
)
"""Cards of world coordinates that are numbers: astropy takes a default for one that is none."""
_OBSERVED = re.compile("DATE|MJD-|REST")
ANGLES = {
    **dict.fromkeys(("deg", "degree", "degrees"), "deg"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    **dict.fromkeys(("arcmin", "arcminute", "arcminutes"), "arcmin"),
    **dict.fromkeys(("arcsec", "arcsecond", "arcseconds", "asec"), "arcsec"),
    "mas": "mas",
}
"""Values of CUNIT that are read, as FITS has them."""
SMALLEST_PIXEL = 1e-6 / 3600
"""Side of a pixel, deg; the finest interferometer resolves ten times as much."""
_EQUATORIAL = ("RADESYS", "RADECSYS", "EQUINOX", "EPOCH")


class FileHeader:
    """Header of the FITS file that messages call ``place``; cards are checked as they are read."""

    def __init__(self, header: Any, place: str) -> None:
        self.header = header
        self.place = place

    def error(self, message: str, cure: str) -> InputError:
        """An error about the file, to be raised."""
        return InputError(message, place=self.place, cure=cure)

    def number(self, key: str, cure: str = "") -> float | None:
        """The finite number of a card; None where there is no such card, or it has no value. Raises
        InputError for anything else.
        """
        if (value := self._value(key)) is None:
            return None
        if (
            isinstance(value, bool)
            or not isinstance(value, int | float)
            or not math.isfinite(value)
        ):
            cure = cure or f"write {key} as a number, or remove it"
            raise self.error(f"{key} = {value!r} is no number", cure)
        return float(value)

    def text(self, key: str) -> str:
        """The text of a card, empty where there is none. Raises InputError for a number or a
        logical value.
        """
        if (value := self._value(key)) is None:
            return ""
        if not isinstance(value, str):
            raise self.error(f"{key} = {value!r} is no text", f"write {key} in quotes")
        return value.strip()

    def no_angle(self, key: str, written: str) -> InputError:
        """An error about a card that is no unit of an angle, to be raised."""
        return self.error(f"{key} = '{written}' is no angle", f"set {key} to 'deg' or 'rad'")

    def _value(self, key: str) -> Any:
        """The value of a card; None without a card or a value: astropy has an object of its own for
        it.
        """
        value = self.header.get(key)
        blank = type(value).__name__ == "Undefined" or not str(value).strip()
        return None if blank else value


UNSEEN = -1.6375e30
"""Value of pixels that HEALPix's tools did not see."""


def marked_bad(values: AnyFloats, header: FileHeader) -> Bools:
    """True for values that a map's file marks as not observed: `UNSEEN`, and that of the card
    BAD_DATA. NaN is not among them.

    Raises InputError where BAD_DATA is no number.
    """
    stated = header.number("BAD_DATA")
    found = np.zeros(values.shape, bool)
    with np.errstate(over="ignore", invalid="ignore"):
        for bad in {UNSEEN} | (set() if stated is None else {stated}):
            found |= np.abs(values - bad) <= 1e-5 * abs(bad)
    return found


def is_celestial(header: Any, axis: int | str) -> bool:
    """True if an axis is a longitude or a latitude on the sky, by its CTYPE."""
    kind = str(header.get(f"CTYPE{axis}", "")).strip().upper()
    return re.match(r"RA--|DEC-|[GESH]L(ON|AT)|HP(LN|LT)|[A-Z]{2}L[NT]", kind) is not None


def with_known_units(header: Any, place: str) -> Any:
    """A copy of an image's header whose celestial axes have units that FITS knows. Raises
    InputError for units that are no angles.
    """
    about = FileHeader(header.copy(), place)
    for axis in "12":
        key = f"CUNIT{axis}"
        written = about.text(key)
        if written.lower() in ANGLES:
            about.header[key] = ANGLES[written.lower()]
        elif written and is_celestial(header, axis):
            raise about.no_angle(key, written)
    return about.header


def with_known_frame(header: Any, place: str) -> tuple[Any, str]:
    """A copy of an image's header whose RADESYS is one of `FRAMES`, or absent, and a note where
    another one was read as that.

    Of Galactic axes what belongs to equatorial ones is removed: astropy would take ICRS.

    Raises
    ------
    InputError
        RADESYS is none that is known, or no text; cards of the world coordinates are no numbers,
        units no angles.
    """
    from astropy.units import Unit

    about = FileHeader(with_known_units(header, place), place)
    made = about.header
    for key in list(made):
        if _NUMBERS.fullmatch(key) and about.number(key) is None:
            made.remove(key, ignore_missing=True)
    for axis in "12":
        key = f"CRVAL{axis}"
        unit = about.text(f"CUNIT{axis}") or "deg"
        degrees = Unit(ANGLES.get(unit, "deg")).to("deg")
        if abs(about.number(key) or 0.0) * degrees > 720.0:
            cure = f"correct {key}, or the unit CUNIT{axis}"
            raise about.error(f"{key} = {made[key]:g} {unit} is no longitude or latitude", cure)
        width = abs(about.number(f"CDELT{axis}") or 1.0)
        key = f"CDELT{axis}"
        if rows := [about.number(f"CD{row}_{axis}") for row in "12" if f"CD{row}_{axis}" in made]:
            width = math.hypot(*(each or 0.0 for each in rows))
            key = f"CD1_{axis}, CD2_{axis}"
        if is_celestial(made, axis) and width * degrees < SMALLEST_PIXEL:
            text = f"{width:g} {unit} is no size of a pixel, which is 1e-6 arcsec or more"
            raise about.error(f"{key}: {text}", f"check {key}, and its unit")
    kinds = {str(header.get(f"CTYPE{axis}", "")).strip().upper()[:4] for axis in "12"}
    if kinds == {"GLON", "GLAT"}:
        for key in _EQUATORIAL:
            made.remove(key, ignore_missing=True)
        return made, ""
    for key in ("EQUINOX", "EPOCH"):
        if not about.number(key):  # 0: not known
            made.remove(key, ignore_missing=True)
    key = "RADESYS" if "RADESYS" in made else "RADECSYS"
    written = about.text(key)
    if not written:
        made.remove(key, ignore_missing=True)
    if not written or written in FRAMES:
        return made, ""
    plain = re.sub(r"[ ()_/]", "", written.upper())
    frame, equinox = _SAME.get(plain, (written.upper(), None))
    if frame not in FRAMES:
        raise about.error(
            f"{key} = '{written}' is no frame of coordinates that is read",
            f"set {key} to {', '.join(FRAMES[:-1])} or {FRAMES[-1]}, or convert the map to ICRS",
        )
    made[key] = frame
    if equinox is not None and about.number("EQUINOX") is None:
        made["EQUINOX"] = equinox
    return made, f"{frame}: {key} = '{written}'"


def exact_header(wcs: Any) -> Header:
    """World coordinates of an `astropy.wcs.WCS` with all digits, of which `to_header` writes 14.

    Time and rest frequency of the observation are left out.
    """
    header = wcs.to_header(relax=True)
    numbers = wcs.wcs
    exact: dict[str, float] = {}
    for i in range(numbers.naxis):
        for key, values in (
            ("CRPIX", numbers.crpix),
            ("CRVAL", numbers.crval),
            ("CDELT", numbers.get_cdelt()),
        ):
            exact[f"{key}{i + 1}"] = float(values[i])
        for j in range(numbers.naxis):
            exact[f"PC{i + 1}_{j + 1}"] = float(numbers.get_pc()[i, j])
    exact["LONPOLE"], exact["LATPOLE"] = float(numbers.lonpole), float(numbers.latpole)
    return header_of(
        (card.keyword, exact.get(card.keyword, card.value), card.comment)
        for card in header.cards
        if card.keyword not in COMMENTARY and not _OBSERVED.match(card.keyword)
    )
