"""Maps of Stokes parameters: I is read. Streams have no polarization, so Q, U and V are not used, and a note says so."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any

from zonda.core.errors import InputError

STOKES = "Stokes parameters"
"""Key of the note about them."""

_NAMES = {1: "I", 2: "Q", 3: "U", 4: "V"}
"""Values of a FITS axis STOKES (Greisen & Calabretta 2002); those below zero are correlations."""
_POLARIZED = re.compile(r"(STOKES[ _-]?)?[QUV]([ _-].*)?", re.IGNORECASE)
"""Names of columns and extensions: Q_POLARISATION (healpy), Q_STOKES (Planck), STOKES_Q, Q."""


def is_polarized(name: str) -> bool:
    """Whether a column or an extension of this name holds Q, U or V."""
    return _POLARIZED.fullmatch(name.strip()) is not None


def of_columns(names: Sequence[str], read: int, place: str) -> dict[str, str]:
    """The note about a table's columns of which number ``read`` is read as I.

    Raises
    ------
    InputError
        That column is named as Q, U or V.
    """
    if is_polarized(names[read]):
        raise InputError(
            f"its first map, the column {names[read]}, is no intensity", place=place, cure="put the column of I first"
        )
    unused = [name for name in names[read + 1 :] if is_polarized(name)]
    return {STOKES: f"column {names[read]} is read as I; {_not_used(unused)}"} if unused else {}


def of_extensions(read: str, names: Sequence[str], place: str) -> dict[str, str]:
    """The note about a file's image ``read``, beside which there are others called ``names``. Raises as `of_columns`."""
    if is_polarized(read):
        raise InputError(
            f"its first image, {read}, is no intensity",
            place=place,
            cure="put the image of I first, or name it by the operator's parameter hdu",
        )
    unused = [name for name in names if is_polarized(name)]
    return {STOKES: f"the first image{f', {read},' if read else ''} is read as I; {_not_used(unused)}"} if unused else {}


def plane(header: Any, axis: int, length: int, wanted: int | None, place: str) -> tuple[int, dict[str, str]]:
    """Number of the plane of I, or of the one that is ``wanted``, along the FITS axis STOKES; the note about the others.

    Raises
    ------
    InputError
        There is no I on the axis.
    """
    first, step, pixel = (float(header.get(f"{key}{axis}", 1.0)) for key in ("CRVAL", "CDELT", "CRPIX"))
    found = [_NAMES.get(round(first + (n + 1 - pixel) * step), "a correlation") for n in range(length)]
    if "I" not in found and wanted is None:
        message = f"its axis STOKES has {', '.join(found)} and no I"
        raise InputError(message, place=place, cure=f"give a map of I, or correct CRVAL{axis}, CDELT{axis} and CRPIX{axis}")
    number = found.index("I") + 1 if wanted is None else wanted
    unused = [name for k, name in enumerate(found, 1) if k != number]
    if not unused:
        return number, {}
    as_what = found[number - 1] + ("" if found[number - 1] == "I" else " as I")
    return number, {STOKES: f"plane {number} of {length} is read, {as_what}; {_not_used(unused)}"}


def _not_used(names: Sequence[str]) -> str:
    return f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} not used: detectors measure total intensity"
