"""Headers of sky maps beside the user's options: units, beams, conventions; and numbers that no sky
has, beyond which arithmetic overflows.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from zonda.core.configuration.units import factor_to
from zonda.core.errors import InputError
from zonda.core.maps.beams import check_width, size_text
from zonda.core.maps.header import SMALLEST_PIXEL, FileHeader
from zonda.core.maps.units import KNOWN_UNITS, parse_unit
from zonda.core.numerics.radiation import BOLTZMANN
from zonda.core.numerics.sphere import ARCSEC, angle_text
from zonda.core.types import Floats

from .input_map import InputMap

LARGEST = 1e30
"""Value of a pixel, in any unit."""
BRIGHTEST = 1e15
"""Brightness, K_RJ: the square of it is a float32."""
LARGEST_PIXEL = 360.0
"""Side of a pixel, and width of a beam, deg; the least of both is `SMALLEST_PIXEL`."""
MANY = 60.0
"""Pixels per FWHM of a map's beam beyond which that is doubted."""
OBLONG = 20.0
"""Ratio of a pixel's sides beyond which an image's scale is doubted."""
COARSE = 100.0
"""Beams in a pixel beyond which an image's scale is doubted."""
TOLD = 5e-3
"""Loss of point sources' peaks by a second beam, as a share, from which a run warns."""
DOUBT = "doubtful"
"""Key of the note about what is possible and not likely."""
BEAM = "set the header keys BMAJ and BMIN (FWHM in degrees), or the operator's parameter input_beam"


@dataclass(frozen=True)
class Wanted:
    """Parameters of `SkyMap` that say how a file is read, angles in rad.

    Attributes
    ----------
    centred
        True where the caller says where the map's centre lies: then the header's position is not
        needed.
    plane
        Of a cube, counted from 1; one number for each axis that is longer than one. None: the only
        one, or that of Stokes I.
    polarized
        True where Q and U are read, too.
    convention
        Of them: `SkyMap.polarization_convention`.
    column
        Of a HEALPix table, by name or counted from 1: the column of I.
    temperature
        True for a map of electron temperatures, in keV or K: it is read in J.
    header_alone
        True for a look at a large file: everything but its values is read and checked; they are
        zeros.
    """

    unit: str | None = None
    pixel_size: float | None = None
    centred: bool = False
    missing: Literal["error", "zero"] = "error"
    input_beam: float | None = None
    coordsys: Literal["icrs", "galactic", "ecliptic"] | None = None
    plane: tuple[int, ...] | None = None
    hdu: int | str | None = None
    polarized: bool = False
    convention: Literal["cosmo", "iau"] | None = None
    column: int | str | None = None
    temperature: bool = False
    header_alone: bool = False


class MapHeader(FileHeader):
    """A map's header with what is ``wanted`` of it; ``notes``: what is chosen or changed, for the
    log.
    """

    def __init__(self, header: Any, place: str, wanted: Wanted, notes: dict[str, str]) -> None:
        super().__init__(header, place)
        self.wanted = wanted
        self.notes = notes

    def refuse(self, message: str, **options: object) -> None:
        """Raise InputError if one of the ``options`` is given, which ``message`` names."""
        for name, given in options.items():
            if given not in (None, False):
                raise self.error(message.format(name), f"remove {name}")

    def unit(self, key: str, others: list[str], what: str) -> tuple[str, float]:
        """`parse_unit` of the unit that is wanted, or of the header's ``key``.

        ``others``: units of Q and U, which are ``what`` in the file. Raises InputError if they are
        not that of I.
        """
        written = self.text(key)
        wanted = self.wanted.unit
        if self.wanted.temperature:
            for unit, joule in (("J", 1.0), ("K", BOLTZMANN)):
                if written and (factor := factor_to(unit, written)):
                    return "J", factor * joule
            what = f"a map of electron temperatures is in keV or K, not '{written}'"
            raise self.error(what, f"set the header key {key} to keV")
        if wanted is None and any(unit not in ("", written) for unit in others):
            units = ", ".join(unit or "(none)" for unit in (written, *others))
            raise self.error(
                f"its {what} of I, Q and U are in {units}",
                "write all three in one unit, or set the operator's parameter unit, which then"
                " holds for all",
            )
        if not (wanted or written):
            raise self.error(
                "the unit of the map is missing",
                f"set the header key {key}, or the operator's parameter unit, to {KNOWN_UNITS}",
            )
        if wanted is not None and written and wanted != written:
            self.notes["unit"] = f"{wanted} as given; {key} = '{written}' is overridden"
        scale = self.text("TEMPSCAL")
        return parse_unit(
            written if wanted is None else wanted,
            place=self.place,
            temperature_scale=scale,
        )

    def beam(self, unit: str) -> tuple[float, float] | None:
        """FWHM (major, minor) [rad] of the beam that the map was made with; None: none is named.

        Raises InputError where a map in Jy/beam has none.
        """
        given = self.wanted.input_beam
        needed = unit == "Jy/beam"
        if given is not None:
            if not needed:
                message = f"input_beam is for maps in Jy/beam, and this one is in {unit}"
                raise self.error(message, "remove input_beam")
            if "BMAJ" in self.header:
                size = f"{np.degrees(given) * 3600:g} arcsec"
                self.notes["input beam"] = f"{size} as given; BMAJ and BMIN are overridden"
            return given, given
        if not needed:
            major = self.header.get("BMAJ")
            sides = [major, self.header.get("BMIN", major)]
            known = [isinstance(b, float | int) and 0 < b < math.inf for b in sides]
            return (math.radians(sides[0]), math.radians(sides[1])) if all(known) else None
        major = self.number("BMAJ", BEAM)
        if major is None:
            raise self.error(
                "a map in Jy/beam needs the beam it was made with, and its header has no BMAJ",
                f"{BEAM}: 18 arcsec, the FWHM of the map's beam (not fwhm, which is that of the"
                " telescope simulated)",
            )
        minor = self.number("BMIN", BEAM)
        minor = major if minor is None else minor
        if min(major, minor) <= 0:
            raise self.error(f"BMAJ = {major:g} and BMIN = {minor:g} are no widths", BEAM)
        self.check_sides((major, minor), BEAM)
        return math.radians(major), math.radians(minor)

    def check_sides(self, sides: Any, cure: str) -> None:
        """Raise InputError where the side of a pixel, or the width of a beam, [deg] is none that a
        map has.
        """
        for side in np.abs(np.asarray(sides, np.float64)):
            if not SMALLEST_PIXEL <= side <= LARGEST_PIXEL:
                text = "deg is no size of a pixel or beam, which is 1e-6 arcsec to 360 deg"
                raise self.error(f"{side:.3g} {text}", cure)

    def check_beam(self, found: InputMap, across: float) -> None:
        """Refuse a beam that the map, ``across`` [rad] wide, cannot have: wider than all of it, or
        far smaller than its pixels. If the user states it, it is doubted alone.
        """
        if found.unit != "Jy/beam" or found.beam is None:
            return
        fwhm, side = (math.sqrt(a * b) for a, b in (found.beam, found.sides.tolist()))
        text = f"the beam of the map is {size_text(fwhm)} wide"
        cure = (
            "BMAJ and BMIN are degrees (of 18 arcsec 0.005); correct them, or set the operator's"
            " parameter input_beam: 18 arcsec"
        )
        if self.wanted.input_beam is None:
            check_width(fwhm, across, self.place, cure)
            if fwhm < side / 5:
                raise self.error(f"{text}, and its pixels {size_text(side)}", cure)
        if not side / 2 <= fwhm <= min(across, MANY * side):
            self.notes[DOUBT] = (
                f"{text}, its pixels {size_text(side)} and all of it {size_text(across)}: is that"
                f" right? {cure}"
            )

    def sign_of_u(self, image: bool) -> float:
        """Factor on U that brings it to COSMO's convention: that of IAU has the other sign.

        Raises InputError if the header has an unknown POLCCONV; or if an ``image`` has none, and
        none is wanted.
        """
        written = self.text("POLCCONV").upper()
        given = self.wanted.convention
        if given is None and written not in ("COSMO", "IAU", ""):
            raise self.error(
                f"POLCCONV = '{written}' is neither COSMO nor IAU",
                "correct it, or set the operator's parameter polarization_convention to cosmo or"
                " iau",
            )
        if given is None and not written and image:
            raise self.error(
                "its header does not say in which convention U is (no POLCCONV)",
                "set the header key POLCCONV to COSMO or IAU, or the operator's parameter"
                " polarization_convention: cosmo (angles from south to east, as in HEALPix) or iau"
                " (from north to east)",
            )
        found = given.upper() if given else written or "COSMO"
        why = "POLCCONV" if written else "as in all HEALPix maps that do not say so"
        note = f"Q and U are read, convention {found} ({'as given' if given else why})"
        if given and written and written != found:
            note += f"; POLCCONV = '{written}' is overridden"
        self.notes["polarization"] = note
        return -1.0 if found == "IAU" else 1.0

    def filled(self, values: Floats, first: str) -> int:
        """Zero the non-finite values in place if that is wanted; their number. ``first``: how to
        name the first one, by its indices.
        """
        bad = ~np.isfinite(values)
        count = int(bad.sum())
        if count and self.wanted.missing == "error":
            where = (int(k) + 1 for k in np.argwhere(bad)[0])
            raise self.error(
                f"{count} of {values.size} pixels are NaN or infinite, the first at"
                f" {first.format(*where)}",
                "mend the map, or set the operator's parameter missing: zero to take them as zero"
                " (they are counted)",
            )
        values[bad] = 0.0
        cure = "check the map, and the header's BSCALE and BZERO"
        _check_values(values, self.place, LARGEST, "in its unit", cure)
        return count


def _check_values(values: Floats, place: str, most: float, unit: str, cure: str) -> None:
    """Raise InputError where a value of a map is larger than ``most``. ``values`` may hold NaN."""
    if values.size and (size := float(np.nanmax(np.abs(values), initial=0.0))) > most:
        message = f"its largest value is {size:.3g} {unit}, more than {most:g}"
        raise InputError(message, place=place, cure=cure)


def check_brightness(values: Floats, place: str) -> None:
    """Raise InputError where a map in K_RJ is brighter than anything."""
    cure = "check its unit (the header's, or the parameter unit), and the parameter scale"
    _check_values(values, place, BRIGHTEST, "K_RJ", cure)


def odd_pixels(sides: Floats, shape: tuple[int, ...], beam: float) -> str:
    """Warning about pixels that are far too large or too small for a beam, or empty.

    ``sides`` (2,): of a pixel [rad]; ``shape``: (ny, nx); ``beam``: FWHM [rad].
    """
    x, y = (float(side) / ARCSEC for side in sides)
    across = max(x * shape[1], y * shape[0])
    fwhm = beam / ARCSEC
    text = f"its pixels are {x:.4g} x {y:.4g} arcsec"
    cure = "are CDELT1 and CDELT2 in degrees?"
    if across < fwhm:
        less = f"less than the beam of {fwhm:.4g} arcsec"
        return f"{text} and all of it {across:.4g} arcsec, {less}; {cure}"
    if max(x, y) > OBLONG * min(x, y):
        return f"{text}: is one of CDELT1 and CDELT2 wrong?"
    return f"{text}, and the beam {fwhm:.4g} arcsec; {cure}" if min(x, y) > COARSE * fwhm else ""


def seen_twice(
    beam: tuple[float, float] | None,
    given: float | None,
    telescope: Floats,
) -> tuple[str, str]:
    """Statement about a map that was made with a ``beam`` (major, minor) [rad], and the warning;
    either may be empty.

    ``given``: `SkyMap.fwhm`; ``telescope`` (n,): the detectors' FWHM [rad]. There is no warning
    where peaks fall by less than `TOLD`, nor where ``given`` makes the resolution that of the
    telescope.
    """
    if beam is None or not telescope.size:
        return "", ""
    own = float(np.median(telescope))
    simulated = own if given is None else given
    major, minor = (math.hypot(simulated, b) for b in beam)
    result = math.sqrt(major * minor)
    was = angle_text(math.sqrt(beam[0] * beam[1]))
    now = angle_text(result)
    seen = angle_text(simulated)
    text = f"made with a beam of {was} (BMAJ), convolved with one of {seen}: {now} in all"
    share = (simulated / result) ** 2
    if 1 - share < TOLD or (given is not None and abs(result / own - 1) < TOLD / 2):
        return text, ""
    rest = own**2 - beam[0] * beam[1]
    narrower = f"`fwhm: {math.sqrt(max(rest, 0.0)) / ARCSEC:.4g} arcsec` makes {angle_text(own)}"
    return text, (
        f"the map was made with a beam of {was} (BMAJ) and is convolved with the telescope's of"
        f" {seen} once more: the resolution becomes {now}, and point sources keep {share:.2g} of"
        " the peak that they have in the telescope's beam. `beam: none` samples the map as it is"
        f"{f', {narrower} in all' if rest > 0 else ''}; if the map shows the sky before any beam,"
        " remove BMAJ from its header"
    )
