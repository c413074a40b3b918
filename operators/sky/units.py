"""Units of sky maps as their headers write them."""

from __future__ import annotations

from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.maps.units import KNOWN_UNITS, parse_unit
from zonda.core.types import Floats

from .limits import LARGEST, check_sides, check_values


def unit_of(place: str, header: Any, key: str, given: str | None, notes: dict[str, str]) -> tuple[str, float]:
    """`parse_unit` of the unit ``given``, or of the header's ``key``."""
    written = str(header.get(key, "") or "").strip()
    text = given if given is not None else written
    if not text:
        raise InputError(
            "the unit of the map is missing",
            place=place,
            cure=f"set the header key {key}, or the operator's parameter unit, to {KNOWN_UNITS}",
        )
    if given is not None and written and given != written:
        notes["unit"] = f"{given} as given; {key} = '{written}' is overridden"
    return parse_unit(text, place=place, temperature_scale=header.get("TEMPSCAL"))


def beam_solid_angle(place: str, header: Any, unit: str, given: float | None, notes: dict[str, str]) -> float | None:
    """sr, of the beam of a map in Jy/beam: ``given`` as its FWHM [rad], or the header's BMAJ and BMIN; None in other units."""
    if unit != "Jy/beam":
        if given is not None:
            raise InputError(
                f"input_beam is for maps in Jy/beam, and this one is in {unit}", place=place, cure="remove input_beam"
            )
        return None
    notes["resolution"] = "the map is in Jy/beam, so convolved already; it is convolved with the detector's beam once more"
    major, minor = header.get("BMAJ"), header.get("BMIN", header.get("BMAJ"))
    written = all(isinstance(b, int | float) and np.isfinite(b) and b > 0 for b in (major, minor))
    if given is not None:
        if written:
            notes["input beam"] = f"{np.degrees(given) * 3600:g} arcsec as given; BMAJ and BMIN are overridden"
        return float(np.pi / (4 * np.log(2)) * given**2)
    if not written:
        raise InputError(
            "a map in Jy/beam needs the beam it was made with, and its header has no BMAJ",
            place=place,
            cure="set the header keys BMAJ and BMIN (FWHM in degrees), or the operator's parameter input_beam: 18 arcsec, the "
            "FWHM of the map's beam (not fwhm, which is that of the telescope simulated)",
        )
    check_sides((major, minor), place, "set the header keys BMAJ and BMIN (FWHM in degrees)")
    return float(np.pi / (4 * np.log(2)) * np.radians(major) * np.radians(minor))


def filled(place: str, values: Floats, missing: str, first: str) -> int:
    """Zero the non-finite values in place on request; their number. ``first``: how to name the first one, by its indices."""
    bad = ~np.isfinite(values)
    count = int(bad.sum())
    if count and missing == "error":
        where = np.unravel_index(int(np.flatnonzero(bad)[0]), values.shape)
        raise InputError(
            f"{count} of {values.size} pixels are NaN or infinite, the first at {first.format(*(int(k) + 1 for k in where))}",
            place=place,
            cure="mend the map, or set the operator's parameter missing: zero to take them as zero (they are counted)",
        )
    values[bad] = 0.0
    check_values(values, place, LARGEST, "in its unit", "check the map, and the header's BSCALE and BZERO")
    return count
