"""HEALPix maps in FITS tables, of the full sky or of a part of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.maps.header import marked_bad
from zonda.core.maps.map_reading import STOKES, HealpixTable
from zonda.core.maps.stokes_names import columns_of_q_and_u, intensity_column, is_polarized
from zonda.core.types import Floats

from . import stokes
from .input_map import HealpixMap, Wanted
from .units import beam_solid_angle, check_beam, filled, made_with, unit_of


def read_healpix(hdu: Any, place: str, wanted: Wanted) -> HealpixMap:
    """The map of a table in its column of I (`intensity_column`).

    Raises InputError as `read.read_map`.
    """
    table, header = HealpixTable(hdu, place), hdu.header
    _check_wanted(place, wanted)
    nested = table.nest
    frame, notes = table.frame(wanted.coordsys)
    names, numbered = table.names, table.pixel_column is not None
    first = intensity_column(names, wanted.column, place)
    notes |= stokes.of_columns(names, first)
    if len(names) > 1 + numbered or wanted.column is not None:
        notes["column"] = f"{names[first]} ({first + 1} of {len(names)}: {', '.join(names)})"
    unit, factor = unit_of(place, header, f"TUNIT{1 + first}", wanted.unit, notes)
    beam = beam_solid_angle(place, header, unit, wanted.input_beam, notes)
    columns, polarized = [first], columns_of_q_and_u(names) if wanted.polarized else None
    sign = 1.0
    if polarized is not None and not is_polarized(names[first]):
        _check_same_unit(header, columns + polarized, place, wanted)
        columns += polarized
        notes.pop(STOKES, None)
        sign = stokes.sign_of_u(header, wanted.convention, False, place, notes)
    if wanted.header_alone:
        values, pixels = np.zeros((1, 0)), None
        nside = table.nside(table.length(first))
    else:
        values = np.stack([table.numbers(k) for k in columns])
        nside = table.nside(values.shape[1])
        pixels = table.pixels(nside, values.shape[1])
    if pixels is not None:
        order = np.argsort(pixels, kind="stable")
        pixels, values = pixels[order], values[:, order]
    pixels, values = _seen(pixels, values, header, place)
    found = HealpixMap(
        values=values[0],
        unit=unit,
        beam_solid_angle=beam,
        notes=notes,
        beam=made_with(header, wanted.input_beam),
        pixels=pixels,
        nside=nside,
        nest=nested,
        frame=frame,
    )
    check_beam(place, beam, found.sides, (), wanted.input_beam is not None, notes)
    where = "entry {} of those that are seen (counted from 1)"
    found.zeroed = filled(place, values[0], wanted.missing, where)
    if len(values) > 1:
        values[2] *= sign
        found.zeroed += filled(place, values[1:], wanted.missing, f"plane {{}} of Q and U, {where}")
        found.polarization = values[1:]
    values *= factor
    return found


def _check_wanted(place: str, wanted: Wanted) -> None:
    given = {
        "centre": wanted.centred,
        "pixel_size": wanted.pixel_size is not None,
        "plane": wanted.plane is not None,
    }
    for name in (n for n, is_given in given.items() if is_given):
        raise InputError(
            f"{name} does not apply to a HEALPix map", place=place, cure=f"remove {name}"
        )


def _check_same_unit(header: Any, columns: list[int], place: str, wanted: Wanted) -> None:
    """Raise InputError where Q or U is in another unit than I."""
    units = [str(header.get(f"TUNIT{1 + k}", "") or "").strip() for k in columns]
    if wanted.unit is None and any(unit not in ("", units[0]) for unit in units[1:]):
        raise InputError(
            f"its columns of I, Q and U are in {', '.join(unit or '(none)' for unit in units)}",
            place=place,
            cure=(
                "write all three in one unit, or set the operator's parameter unit, which then"
                " holds for all"
            ),
        )


def _seen(
    pixels: NDArray[np.int64] | None, values: Floats, header: Any, place: str
) -> tuple[NDArray[np.int64] | None, Floats]:
    """The pixels whose first values of (n_planes, n) are not marked as unseen, and where others
    are, NaN; None as pixels: all.
    """
    unseen = marked_bad(values, header, place)
    values[1:][unseen[1:]] = np.nan
    if not unseen[0].any():
        return pixels, values
    seen = ~unseen[0]
    return (np.flatnonzero(seen) if pixels is None else pixels[seen]), values[:, seen]
