"""Units of sky maps as their headers write them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.maps.beams import check_width, size_text
from zonda.core.maps.header import number, text
from zonda.core.maps.units import KNOWN_UNITS, parse_unit
from zonda.core.numerics.angles import angle_text
from zonda.core.types import Floats

from .limits import LARGEST, check_sides, check_values

TOLD = 5e-3
"""Share by which a second beam lowers the peaks of point sources from which it is told."""


def made_with(header: Mapping[str, Any], given: float | None = None) -> tuple[float, float] | None:
    """FWHM (major, minor) [rad] of the beam that a map was made with; None: none is named.

    ``given``: `SkyMap.input_beam` [rad], which replaces the header's BMAJ and BMIN.
    """
    if given is not None:
        return given, given
    major = header.get("BMAJ")
    minor = header.get("BMIN", major)
    sides = [
        b
        for b in (major, minor)
        if isinstance(b, int | float) and not isinstance(b, bool) and math.isfinite(b) and b > 0
    ]
    return (math.radians(sides[0]), math.radians(sides[1])) if len(sides) == 2 else None


def seen_twice(
    beam: tuple[float, float] | None, given: float | None, telescope: Floats
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
    was, now = angle_text(math.sqrt(beam[0] * beam[1])), angle_text(result)
    text = (
        f"made with a beam of {was} (BMAJ), convolved with one of {angle_text(simulated)}: {now}"
        " in all"
    )
    share = (simulated / result) ** 2
    if 1 - share < TOLD or (given is not None and abs(result / own - 1) < TOLD / 2):
        return text, ""
    rest = own**2 - beam[0] * beam[1]
    both = (
        f", `fwhm: {math.degrees(math.sqrt(rest)) * 3600:.4g} arcsec` makes {angle_text(own)}"
        " in all"
        if rest > 0
        else ""
    )
    return (
        text,
        (
            f"the map was made with a beam of {was} (BMAJ) and is convolved with the telescope's of"
            f" {angle_text(simulated)} once more: the resolution becomes {now}, and point sources"
            f" keep {share:.2g} of the peak that they have in the telescope's beam. `beam: none`"
            f" samples the map as it is{both}; if the map shows the sky before any beam, remove"
            " BMAJ from its header"
        ),
    )


MANY = 60.0
"""Pixels per FWHM of a map's beam beyond which that is doubted."""
DOUBT = "doubtful"
"""Key of the note about what is possible and not likely."""


def unit_of(
    place: str, header: Any, key: str, given: str | None, notes: dict[str, str]
) -> tuple[str, float]:
    """`parse_unit` of the unit ``given``, or of the header's ``key``."""
    written = text(header, key, place)
    wanted = given if given is not None else written
    if not wanted:
        raise InputError(
            "the unit of the map is missing",
            place=place,
            cure=f"set the header key {key}, or the operator's parameter unit, to {KNOWN_UNITS}",
        )
    if given is not None and written and given != written:
        notes["unit"] = f"{given} as given; {key} = '{written}' is overridden"
    return parse_unit(wanted, place=place, temperature_scale=text(header, "TEMPSCAL", place))


def beam_solid_angle(
    place: str, header: Any, unit: str, given: float | None, notes: dict[str, str]
) -> float | None:
    """sr, of the beam of a map in Jy/beam: ``given`` as its FWHM [rad], or the header's BMAJ and
    BMIN; None in other units.
    """
    if unit != "Jy/beam":
        if given is not None:
            raise InputError(
                f"input_beam is for maps in Jy/beam, and this one is in {unit}",
                place=place,
                cure="remove input_beam",
            )
        return None
    degrees = (
        "set the header keys BMAJ and BMIN (FWHM in degrees), or the operator's parameter"
        " input_beam"
    )
    if given is not None:
        if "BMAJ" in header:
            notes["input beam"] = (
                f"{np.degrees(given) * 3600:g} arcsec as given; BMAJ and BMIN are overridden"
            )
        return float(np.pi / (4 * np.log(2)) * given**2)
    major = number(header, "BMAJ", place, degrees)
    minor = number(header, "BMIN", place, degrees) if major is not None else None
    minor = major if minor is None else minor
    if major is None or minor is None:
        raise InputError(
            "a map in Jy/beam needs the beam it was made with, and its header has no BMAJ",
            place=place,
            cure=(
                "set the header keys BMAJ and BMIN (FWHM in degrees), or the operator's parameter"
                " input_beam: 18 arcsec, the FWHM of the map's beam (not fwhm, which is that of the"
                " telescope simulated)"
            ),
        )
    if min(major, minor) <= 0:
        raise InputError(
            f"BMAJ = {major:g} and BMIN = {minor:g} are no widths", place=place, cure=degrees
        )
    check_sides((major, minor), place, degrees)
    return float(np.pi / (4 * np.log(2)) * np.radians(major) * np.radians(minor))


def check_beam(
    place: str,
    area: float | None,
    pixels: Floats,
    shape: tuple[int, ...],
    given: bool,
    notes: dict[str, str],
) -> None:
    """Refuse a beam of ``area`` [sr] that the map cannot have: wider than all of it, or far smaller
    than its pixels.

    Parameters
    ----------
    pixels
        (2,) sides of a pixel along (x, y), rad.
    shape
        (ny, nx), () of a HEALPix map.
    given
        True where the user states the beam: then what is not likely is doubted alone.

    Raises
    ------
    InputError
        The header's beam is `beams.WIDER` than the map, or narrower than a fifth of a pixel.
    """
    if area is None:
        return
    fwhm, side = math.sqrt(area * 4 * math.log(2) / math.pi), math.sqrt(pixels[0] * pixels[1])
    text = f"the beam of the map is {size_text(fwhm)} wide"
    cure = (
        "BMAJ and BMIN are degrees (of 18 arcsec 0.005); correct them, or set the operator's"
        " parameter input_beam: 18 arcsec"
    )
    across = max(shape[0] * pixels[1], shape[1] * pixels[0]) if len(shape) == 2 else math.pi
    if not given:
        check_width(fwhm, across, place, cure)
    if not given and fwhm < side / 5:
        raise InputError(f"{text}, and its pixels {size_text(side)}", place=place, cure=cure)
    if not side / 2 <= fwhm <= min(across, MANY * side):
        notes[DOUBT] = (
            f"{text}, its pixels {size_text(side)} and all of it {size_text(across)}: is that"
            f" right? {cure}"
        )


def filled(place: str, values: Floats, missing: str, first: str) -> int:
    """Zero the non-finite values in place on request; their number. ``first``: how to name the
    first one, by its indices.
    """
    bad = ~np.isfinite(values)
    count = int(bad.sum())
    if count and missing == "error":
        where = np.unravel_index(int(np.flatnonzero(bad)[0]), values.shape)
        raise InputError(
            f"{count} of {values.size} pixels are NaN or infinite, the first at"
            f" {first.format(*(int(k) + 1 for k in where))}",
            place=place,
            cure=(
                "mend the map, or set the operator's parameter missing: zero to take them as zero"
                " (they are counted)"
            ),
        )
    values[bad] = 0.0
    check_values(
        values, place, LARGEST, "in its unit", "check the map, and the header's BSCALE and BZERO"
    )
    return count
