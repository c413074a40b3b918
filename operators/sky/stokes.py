"""Maps of Stokes parameters: I is read, and for a polarized camera Q and U. Of others a note says
that they are not used.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from zonda.core.errors import InputError
from zonda.core.maps.header import text
from zonda.core.maps.stokes_names import along_axis, is_polarized

STOKES = "Stokes parameters"
"""Key of the note about them."""


def of_columns(names: Sequence[str], read: int) -> dict[str, str]:
    """The note about a table's columns of which number ``read`` is read as I."""
    unused = [name for k, name in enumerate(names) if k != read and is_polarized(name)]
    return {STOKES: f"column {names[read]} is read as I; {_not_used(unused)}"} if unused else {}


def of_extensions(read: str, names: Sequence[str], place: str) -> dict[str, str]:
    """The note about a file's image ``read``, beside which there are others called ``names``.

    Raises InputError where it is Q, U or V.
    """
    if is_polarized(read):
        raise InputError(
            f"its first image, {read}, is no intensity",
            place=place,
            cure="put the image of I first, or name it by the operator's parameter hdu",
        )
    unused = [name for name in names if is_polarized(name)]
    return (
        {STOKES: f"the first image{f', {read},' if read else ''} is read as I; {_not_used(unused)}"}
        if unused
        else {}
    )


def plane(
    header: Any, axis: int, length: int, wanted: int | None, place: str
) -> tuple[int, dict[str, str]]:
    """Number of the plane of I, or of the one that is ``wanted``, along the FITS axis STOKES; the
    note about the others.

    Raises
    ------
    InputError
        There is no I on the axis.
    """
    found = along_axis(header, axis, length, place)
    if "I" not in found and wanted is None:
        message = f"its axis STOKES has {', '.join(found)} and no I"
        raise InputError(
            message,
            place=place,
            cure=f"give a map of I, or correct CRVAL{axis}, CDELT{axis} and CRPIX{axis}",
        )
    number = found.index("I") + 1 if wanted is None else wanted
    unused = [name for k, name in enumerate(found, 1) if k != number]
    if not unused:
        return number, {}
    as_what = found[number - 1] + ("" if found[number - 1] == "I" else " as I")
    return number, {STOKES: f"plane {number} of {length} is read, {as_what}; {_not_used(unused)}"}


def planes_of_q_and_u(
    header: Any, shape: Sequence[int], plane: tuple[int, ...]
) -> list[tuple[int, ...]] | None:
    """Indices of the planes of Q and U beside that of I, ``plane``, in a cube; None where there are
    none.

    Someone who names the plane of Q as if it were I has no others.
    """
    for k, length in enumerate(shape[:-2]):
        axis = len(shape) - k
        if str(header.get(f"CTYPE{axis}", "")).strip().upper() == "STOKES":
            found = along_axis(header, axis, length)
            if found[plane[k]] == "I" and {"Q", "U"} <= set(found):
                return [(*plane[:k], found.index(name), *plane[k + 1 :]) for name in ("Q", "U")]
    return None


def sign_of_u(
    header: Any,
    given: Literal["cosmo", "iau"] | None,
    image: bool,
    place: str,
    notes: dict[str, str],
) -> float:
    """Factor on U that brings it to COSMO's convention: that of IAU has the other sign.

    Raises
    ------
    InputError
        The header has an unknown POLCCONV; an image has none, and none is ``given``.
    """
    written = text(header, "POLCCONV", place).upper()
    if given is None and written not in ("COSMO", "IAU", ""):
        raise InputError(
            f"POLCCONV = '{written}' is neither COSMO nor IAU",
            place=place,
            cure=(
                "correct it, or set the operator's parameter polarization_convention to cosmo"
                " or iau"
            ),
        )
    if given is None and not written and image:
        raise InputError(
            "its header does not say in which convention U is (no POLCCONV)",
            place=place,
            cure=(
                "set the header key POLCCONV to COSMO or IAU, or the operator's parameter"
                " polarization_convention: cosmo (angles from south to east, as in HEALPix) or iau"
                " (from north to east)"
            ),
        )
    found = given.upper() if given else written or "COSMO"
    why = (
        "as given"
        if given
        else "POLCCONV"
        if written
        else "as in all HEALPix maps that do not say so"
    )
    notes["polarization"] = f"Q and U are read, convention {found} ({why})"
    if given and written and written != found:
        notes["polarization"] += f"; POLCCONV = '{written}' is overridden"
    return -1.0 if found == "IAU" else 1.0


def _not_used(names: Sequence[str]) -> str:
    return (
        f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} not used: detectors measure total"
        " intensity"
    )
