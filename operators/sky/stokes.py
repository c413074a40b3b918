"""Maps of Stokes parameters: I, for polarized cameras Q and U; notes name the others."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal

from zonda.core.errors import InputError
from zonda.core.maps.header import text
from zonda.core.maps.map_reading import STOKES, not_used
from zonda.core.maps.stokes_names import is_polarized


def of_columns(names: Sequence[str], read: int) -> dict[str, str]:
    """The note about a table's columns of which number ``read`` is read as I."""
    unused = [name for k, name in enumerate(names) if k != read and is_polarized(name)]
    return {STOKES: f"column {names[read]} is read as I; {not_used(unused)}"} if unused else {}


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
        {STOKES: f"the first image{f', {read},' if read else ''} is read as I; {not_used(unused)}"}
        if unused
        else {}
    )


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
