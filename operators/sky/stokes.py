"""Of a map of Stokes parameters I is read. Streams have no polarization: Q, U and V are not used, which a note says."""

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
        raise InputError(f"its first image, {read}, is no intensity", place=place, cure="put the image of I first")
    unused = [name for name in names if is_polarized(name)]
    return {STOKES: f"the first image{f', {read},' if read else ''} is read as I; {_not_used(unused)}"} if unused else {}


def plane_of_cube(header: Any, shape: Sequence[int], place: str) -> tuple[tuple[int, ...], dict[str, str]]:
    """Index of the plane of I among the axes before the last two, and the note about the others.

    Parameters
    ----------
    shape
        Of the image, slowest axis first.

    Raises
    ------
    InputError
        A cube that has no axis STOKES, or no I on it.
    """
    index, notes = [], {}
    for k, length in enumerate(shape[:-2]):
        axis = len(shape) - k  # FITS counts from the fastest
        if str(header.get(f"CTYPE{axis}", "")).strip().upper() != "STOKES":
            if length > 1:
                sides = " x ".join(str(n) for n in reversed(shape))
                cure = "extract one two-dimensional plane of it, or set CTYPE3 to STOKES if its planes are I, Q, U"
                raise InputError(f"the image is a cube of {sides} pixels", place=place, cure=cure)
            index.append(0)
            continue
        first, step, pixel = (float(header.get(f"{key}{axis}", 1.0)) for key in ("CRVAL", "CDELT", "CRPIX"))
        found = [_NAMES.get(round(first + (n + 1 - pixel) * step), "a correlation") for n in range(length)]
        if "I" not in found:
            message = f"its axis STOKES has {', '.join(found)} and no I"
            raise InputError(message, place=place, cure=f"give a map of I, or correct CRVAL{axis}, CDELT{axis} and CRPIX{axis}")
        index.append(found.index("I"))
        if unused := [name for name in found if name != "I"]:
            notes[STOKES] = f"plane {found.index('I') + 1} of {length} is read, I; {_not_used(unused)}"
    return tuple(index), notes


def _not_used(names: Sequence[str]) -> str:
    return f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} not used: detectors measure total intensity"
