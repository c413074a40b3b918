"""HEALPix maps in FITS tables, of the full sky or of a part of it."""

from __future__ import annotations

import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.maps.header import marked_bad, number, text
from zonda.core.maps.stokes_names import (
    columns_of_q_and_u,
    intensity_column,
    is_polarized,
    pixel_column,
)
from zonda.core.types import Floats

from . import stokes
from .inputs import Frame, HealpixMap, Wanted
from .resolution import made_with
from .units import beam_solid_angle, check_beam, filled, unit_of

_FRAMES: dict[str, Frame] = {
    **dict.fromkeys(("C", "Q", "EQ", "ICRS", "CELESTIAL", "EQUATORIAL"), "icrs"),
    **dict.fromkeys(("G", "GALACTIC"), "galactic"),
    **dict.fromkeys(("E", "ECLIPTIC"), "barycentricmeanecliptic"),
}


def is_healpix(hdu: Any) -> bool:
    """True for an HDU with a table of HEALPix pixels."""
    header = hdu.header
    return header.get("XTENSION") == "BINTABLE" and (
        str(header.get("PIXTYPE", "")).upper() == "HEALPIX"
        or ("NSIDE" in header and "ORDERING" in header)
    )


def read_healpix(hdu: Any, place: str, wanted: Wanted) -> HealpixMap:
    """The map of a table in its column of I (`intensity_column`). Raises InputError as
    `read.read_map`.
    """
    header = hdu.header
    _check_wanted(place, wanted)
    nested = _ordering(place, header)
    notes: dict[str, str] = {}
    frame = _frame(place, header, wanted, notes)
    names = hdu.columns.names
    numbered, first = pixel_column(names), intensity_column(names, wanted.column, place)
    scheme = text(header, "INDXSCHM", place).upper()
    if scheme not in ("", "IMPLICIT", "EXPLICIT"):
        raise InputError(
            f"INDXSCHM = '{scheme}' is not known",
            place=place,
            cure="set it to IMPLICIT or EXPLICIT",
        )
    if numbered is None and scheme == "EXPLICIT":
        cure = "name the column of pixel numbers PIXEL"
        raise InputError(
            f"INDXSCHM is EXPLICIT, and no column numbers the pixels: {', '.join(names)}",
            place=place,
            cure=cure,
        )
    notes |= stokes.of_columns(names, first)
    if len(names) > 1 + (numbered is not None) or wanted.column is not None:
        notes["column"] = f"{names[first]} ({first + 1} of {len(names)}: {', '.join(names)})"
    unit, factor = unit_of(place, header, f"TUNIT{1 + first}", wanted.unit, notes)
    beam = beam_solid_angle(place, header, unit, wanted.input_beam, notes)
    columns, polarized = [first], columns_of_q_and_u(names) if wanted.polarized else None
    sign = 1.0
    if polarized is not None and not is_polarized(names[first]):
        _check_same_unit(header, columns + polarized, place, wanted)
        columns += polarized
        notes.pop(stokes.STOKES, None)
        sign = stokes.sign_of_u(header, wanted.convention, False, place, notes)
    if wanted.header_alone:
        nside = _nside(
            place,
            header,
            nested,
            hdu.header.get("NAXIS2", 0) * _repeat(hdu, first),
            numbered is not None,
        )
        _check_beam(place, beam, nside, wanted, notes)
        return HealpixMap(
            np.zeros(0), np.zeros(0, np.int64), nside, nested, frame, unit, beam, notes
        )
    values = np.stack([_numbers(hdu, k, place) for k in columns])
    pixels = None if numbered is None else _pixel_numbers(hdu, numbered, values.shape[1], place)
    nside = _nside(place, header, nested, values.shape[1], pixels is not None)
    _check_beam(place, beam, nside, wanted, notes)
    if pixels is not None:
        order = np.argsort(pixels, kind="stable")
        pixels, values = pixels[order], values[:, order]
        if len(pixels) and (
            pixels[0] < 0 or pixels[-1] >= 12 * nside * nside or (np.diff(pixels) == 0).any()
        ):
            raise InputError(
                "the pixel numbers are out of range or twice there",
                place=place,
                cure="check NSIDE and the PIXEL column",
            )
    pixels, values = _seen(pixels, values, header, place)
    where = "entry {} of those that are seen (counted from 1)"
    zeroed = filled(place, values[0], wanted.missing, where)
    if len(columns) > 1:
        values[2] *= sign
        zeroed += filled(place, values[1:], wanted.missing, f"plane {{}} of Q and U, {where}")
    values *= factor
    q_and_u = values[1:] if len(columns) > 1 else None
    return HealpixMap(
        values[0],
        pixels,
        nside,
        nested,
        frame,
        unit,
        beam,
        notes,
        zeroed,
        q_and_u,
        made_with(header, wanted.input_beam),
    )


def _numbers(hdu: Any, k: int, place: str) -> Floats:
    """The values (n,) of a column."""
    found = np.asarray(hdu.data.field(k))
    if found.dtype.kind not in "iuf":
        cure = "give a column of numbers, or set the operator's parameter column to another"
        raise InputError(
            f"its column {hdu.columns.names[k]} holds no numbers", place=place, cure=cure
        )
    return np.array(found, np.float64).ravel()


def _pixel_numbers(hdu: Any, k: int, n: int, place: str) -> NDArray[np.int64]:
    """The column of pixel numbers. Raises InputError where they are no whole numbers, or another
    number than values.
    """
    found = _numbers(hdu, k, place)
    if (
        len(found) != n
        or not np.isfinite(found).all()
        or (found != np.round(found)).any()
        or (np.abs(found) > 2**52).any()
    ):
        name = hdu.columns.names[k]
        raise InputError(
            f"its column {name} does not number its {n} values",
            place=place,
            cure=f"check the column {name}",
        )
    return found.astype(np.int64)


def _repeat(hdu: Any, k: int) -> int:
    """Values of a column in a row."""
    found = re.match(r"\s*(\d*)", str(hdu.columns.formats[k]))
    return int(found[1] or 1) if found else 1


def _check_beam(
    place: str, beam: float | None, nside: int, wanted: Wanted, notes: dict[str, str]
) -> None:
    side = float(np.sqrt(np.pi / 3) / nside)
    check_beam(place, beam, (side, side), (), wanted.input_beam is not None, notes)


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


def _ordering(place: str, header: Any) -> bool:
    """True if the pixels are numbered in the nested scheme."""
    ordering = str(header.get("ORDERING", "")).strip().upper()
    if ordering == "NUNIQ":
        raise InputError(
            "multi-order HEALPix maps (ORDERING = NUNIQ) are not read",
            place=place,
            cure="flatten it to one resolution, e.g. with ligo-skymap-flatten",
        )
    if not ordering.startswith(("RING", "NEST")):
        raise InputError(
            "the ordering of the HEALPix map is missing",
            place=place,
            cure="set the header key ORDERING to RING or NESTED",
        )
    return ordering.startswith("NEST")


def _frame(place: str, header: Any, wanted: Wanted, notes: dict[str, str]) -> Frame:
    written = str(header.get("COORDSYS", "")).strip().upper()
    system = written if wanted.coordsys is None else wanted.coordsys.upper()
    if system not in _FRAMES:
        raise InputError(
            "the coordinate system of the HEALPix map is"
            f" {f'unknown: COORDSYS = {written!r}' if written else 'missing'}",
            place=place,
            cure=(
                "set the header key COORDSYS to C (ICRS), G or E, or the operator's parameter"
                " coordsys to icrs, galactic or ecliptic (WMAP's and Planck's maps are galactic)"
            ),
        )
    if wanted.coordsys is not None and _FRAMES.get(written, _FRAMES[system]) != _FRAMES[system]:
        notes["coordinates"] = f"{wanted.coordsys} as given; COORDSYS = '{written}' is overridden"
    return _FRAMES[system]


def _nside(place: str, header: Any, nested: bool, n_values: int, partial: bool) -> int:
    import healpy

    stated = number(header, "NSIDE", place)
    if partial:
        nside = int(stated or 0) if stated == int(stated or 0) else 0
    else:
        nside = round((n_values / 12) ** 0.5)
        if 12 * nside * nside != n_values:
            raise InputError(
                f"{n_values} values are no HEALPix map",
                place=place,
                cure="a full map has 12 nside^2 of them",
            )
        if stated is not None and stated != nside:
            cure = f"set the header key NSIDE to {nside}, or give all of the map"
            raise InputError(
                f"NSIDE = {stated:g}, and {n_values} values are a map of nside {nside}",
                place=place,
                cure=cure,
            )
    if nside < 1 or not healpy.isnsideok(nside, nest=nested):
        raise InputError(
            f"NSIDE = {header.get('NSIDE')} is not valid",
            place=place,
            cure="set the header key NSIDE",
        )
    return nside


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
