"""Names of Stokes parameters in files: columns, extensions, and planes along an axis STOKES; and of
the other contents of columns.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from ..errors import InputError
from .header import number

_NAMES = {1: "I", 2: "Q", 3: "U", 4: "V"}
"""Values of a FITS axis STOKES (Greisen & Calabretta 2002); those below zero are correlations."""
_POLARIZED = re.compile(r"(STOKES[ _-]?)?[QUV]([ _-].*)?", re.IGNORECASE)
"""Names of columns and extensions: Q_POLARISATION (healpy), Q_STOKES (Planck), STOKES_Q, Q."""
_INTENSITY = re.compile(
    r"(STOKES[ _-]?)?[IT]|[IT][ _-]?STOKES|I["
    r" _-]POL[A-Z]*|TEMP(ERATURE)?|INTENSITY|SIGNAL|BRIGHTNESS|T[ _-]?B",
    re.IGNORECASE,
)
"""Names of columns of a brightness: I_STOKES (Planck), TEMPERATURE (healpy), SIGNAL (zonda,
HEALPix's own tools).
"""
_PIXEL = re.compile(
    r"(I?PIX(EL|ELS|NUM|NO|ID)?|PIXEL?[ _-]?(INDEX|NUMBER|NUM|ID)|INDEX|HPX["
    r" _-]?(PIXEL|INDEX|ID)|HEALPIX|HPIX)",
    re.IGNORECASE,
)
_OTHER = re.compile(
    r"(.*[ _-])?(N?[ _-]?HITS?|N[ _-]?OBS(ERVATIONS)?|N["
    r" _-]?SAMP(LES)?|COUNTS?|WEIGHTS?|WGTS?|COV(ARIANCE|ERAGE)?|"
    r"STD(DEV)?|STDEV|SIGMA|RMS|ERR(ORS?)?|VAR(IANCE)?|NOISE|[TPIQU]?MASK|R?COND(ITION)?"
    r"|EXPOSURE|TIME|FLAGS?|RA|DEC|GLON|GLAT|LON|LAT)"
    r"([ _-].*|\d+)?|[IQUV][IQUV]",
    re.IGNORECASE,
)
"""Names of columns that hold no map of the sky: hits, weights, errors, masks, coordinates."""


def is_polarized(name: str) -> bool:
    """True if a column or an extension of this name holds Q, U or V."""
    return _POLARIZED.fullmatch(name.strip()) is not None and _OTHER.fullmatch(name.strip()) is None


def pixel_column(names: Sequence[str]) -> int | None:
    """Column of a HEALPix table that numbers its pixels; None if there is none, so that row k is
    pixel k.
    """
    return next((k for k, name in enumerate(names) if _PIXEL.fullmatch(name.strip())), None)


def intensity_column(names: Sequence[str], wanted: int | str | None, place: str) -> int:
    """Column of a HEALPix table that is read as I: the one that is ``wanted``, that of a known
    name, or the only possible one.

    Parameters
    ----------
    wanted
        Name, or number counted from 1.

    Raises
    ------
    InputError
        There is no such column; none may be I; several may be.
    """
    there = ", ".join(names)
    pixel = pixel_column(names)
    if wanted is not None:
        same = [
            k
            for k, n in enumerate(names, 1)
            if str(wanted).strip().upper() in (n.strip().upper(), str(k))
        ]
        if not same or same[0] - 1 == pixel:
            raise InputError(
                f"there is no map in a column {wanted}",
                place=place,
                cure=f"set column to one of: {there}",
            )
        return same[0] - 1
    may_be = [
        k
        for k, name in enumerate(names)
        if k != pixel and not is_polarized(name) and not _OTHER.fullmatch(name.strip())
    ]
    known = [k for k in may_be if _INTENSITY.fullmatch(names[k].strip())]
    known = known or [
        k for k in may_be if re.match(r"I[ _-]|STOKES[ _-]?I", names[k].strip(), re.IGNORECASE)
    ]
    if not may_be:
        raise InputError(
            f"none of its columns is an intensity: {there}",
            place=place,
            cure=(
                "write a column I_STOKES, or set the operator's parameter column to the one that is"
                " the map"
            ),
        )
    if not known and len(may_be) > 1:
        which = ", ".join(names[k] for k in may_be)
        cure = f"set the operator's parameter column, e.g. to {names[may_be[0]]}"
        raise InputError(f"several of its columns may be the map: {which}", place=place, cure=cure)
    return (known or may_be)[0]


def columns_of_q_and_u(names: Sequence[str]) -> list[int] | None:
    """Columns or extensions of these names that hold Q and U; None if they are not both there."""
    letters = [_letter(name) for name in names]
    return [letters.index("Q"), letters.index("U")] if {"Q", "U"} <= set(letters) else None


def along_axis(header: Any, axis: int, length: int, place: str = "") -> list[str]:
    """Stokes parameter of each plane along the FITS axis STOKES: I, Q and U if no card says
    anything.

    Raises
    ------
    InputError
        Its cards are no numbers, or not all there; they give no whole numbers, or one for several
        planes.
    """
    cure = f"correct CRVAL{axis}, CDELT{axis} and CRPIX{axis}: 1, 1, 1 for I, Q, U"
    given = [number(header, f"{key}{axis}", place, cure) for key in ("CRVAL", "CDELT", "CRPIX")]
    if (given[0] is None) != (given[2] is None):
        raise InputError(f"of CRVAL{axis} and CRPIX{axis} one is missing", place=place, cure=cure)
    first, step, pixel = (1.0 if value is None else value for value in given)
    values = [first + (n + 1 - pixel) * step for n in range(length)]
    if (
        any(abs(value - round(value)) > 1e-3 for value in values)
        or len({round(value) for value in values}) < length
    ):
        told = ", ".join(f"{value:g}" for value in values[:4])
        raise InputError(
            f"the planes of its axis STOKES have the values {told}", place=place, cure=cure
        )
    return [_NAMES.get(round(value), "a correlation") for value in values]


def _letter(name: str) -> str:
    return re.sub(r"^STOKES[ _-]?", "", name.strip().upper())[:1] if is_polarized(name) else ""
