"""The map in a FITS file: its extension, the plane of its cube, the pixels of its HEALPix table.

Readers of skies and of maps to be compared share these rules. Nothing is guessed: if a file leaves
a choice, the error lists the possible ones.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from ..types import Floats
from .header import number, text
from .stokes_names import along_axis, pixel_column

Frame = Literal["icrs", "galactic", "barycentricmeanecliptic"]
"""Names of frames as astropy has them."""
STOKES = "Stokes parameters"
"""Key of the note about Stokes parameters that are not used."""
_FRAMES: dict[str, Frame] = {
    **dict.fromkeys(("C", "Q", "EQ", "ICRS", "CELESTIAL", "EQUATORIAL"), "icrs"),
    **dict.fromkeys(("G", "GALACTIC"), "galactic"),
    **dict.fromkeys(("E", "ECLIPTIC"), "barycentricmeanecliptic"),
}
"""Values of COORDSYS."""


@dataclass(frozen=True)
class Cures:
    """Cures of messages, which say where the user sets an option; default: those of operators."""

    plane: str = "set the operator's parameter plane: {example} ({ranges})"
    coordsys: str = (
        "set the header key COORDSYS to C (ICRS), G or E, or the operator's parameter coordsys to"
        " icrs, galactic or ecliptic (WMAP's and Planck's maps are galactic)"
    )


OPERATORS = Cures()

# --------------------------------------------------------------------------------------------------
# extensions


def is_healpix(hdu: Any) -> bool:
    """True for a table of HEALPix pixels."""
    header = hdu.header
    return header.get("XTENSION") == "BINTABLE" and (
        str(header.get("PIXTYPE", "")).upper() == "HEALPIX"
        or ("NSIDE" in header and "ORDERING" in header)
    )


def is_map(hdu: Any) -> bool:
    """True for a HEALPix table and for an image of two axes or more."""
    return is_healpix(hdu) or bool(hdu.is_image and hdu.header.get("NAXIS", 0) > 1)


def chosen(hdus: Any, wanted: int | str | None, place: str) -> tuple[Any, dict[str, str]]:
    """The extension ``wanted``, by name or number, else the first map; notes.

    Raises InputError if there is none, or it is no map.
    """
    maps = [hdu for hdu in hdus if is_map(hdu)]
    if wanted is None:
        if not maps:
            one = any(hdu.is_image and hdu.header.get("NAXIS", 0) == 1 for hdu in hdus)
            what = (
                "its image has one axis (a spectrum?)"
                if one
                else "it holds no image of two axes and no HEALPix table"
            )
            raise InputError(
                f"is not a map: {what}; in the file: {_contents(hdus)}",
                place=place,
                cure="give a FITS file with a two-dimensional image that has a celestial WCS, or"
                " with a HEALPix table",
            )
        told = f"the first of {len(maps)} maps is read; in the file: {_contents(hdus)}"
        return maps[0], {"extension": told} if len(maps) > 1 else {}
    found = [
        hdu
        for k, hdu in enumerate(hdus)
        if str(wanted).strip().upper() in (str(k), str(hdu.name).upper())
    ]
    if not found:
        raise InputError(
            f"there is no extension {wanted}",
            place=place,
            cure=f"set hdu to one of these: {_contents(hdus)}",
        )
    if not is_map(found[0]):
        raise InputError(
            f"the extension {wanted} is neither an image of two axes nor a HEALPix table",
            place=place,
            cure=f"set hdu to another of these: {_contents(hdus)}",
        )
    return found[0], {}


def _contents(hdus: Any) -> str:
    return "; ".join(
        f"{k}{f' {hdu.name}' if hdu.name else ''}: {_kind(hdu)}" for k, hdu in enumerate(hdus)
    )


def _kind(hdu: Any) -> str:
    header = hdu.header
    if is_healpix(hdu):
        return "HEALPix table"
    if not hdu.is_image:
        return f"table of {header.get('NAXIS2', 0)} rows"
    if not header.get("NAXIS", 0):
        return "empty"
    return "image of " + " x ".join(
        str(header.get(f"NAXIS{k + 1}")) for k in range(header["NAXIS"])
    )


# --------------------------------------------------------------------------------------------------
# planes of cubes


def is_celestial(ctype: str) -> bool:
    """True for the CTYPE of a longitude or a latitude on the sky."""
    return (
        re.match(r"(RA--|DEC-|[GESH]L(ON|AT)|HP(LN|LT)|[A-Z]{2}L[NT])", ctype.upper()) is not None
    )


def plane_of_cube(
    header: Any,
    shape: Sequence[int],
    wanted: tuple[int, ...] | None,
    place: str,
    cures: Cures = OPERATORS,
) -> tuple[tuple[int, ...], dict[str, str]]:
    """Index of a plane among the axes before the last two, and notes about the others.

    Parameters
    ----------
    shape
        Of the image, slowest axis first.
    wanted
        The plane, counted from 1, in FITS's order of the axes. An axis STOKES may be left out: of
        it I is read.

    Raises
    ------
    InputError
        A cube without a wanted plane, or one that is not there; no I; axes of the sky that are not
        the first two.
    """
    axes = {
        len(shape) - k: length for k, length in enumerate(shape[:-2])
    }  # FITS counts from the fastest
    names = {axis: str(header.get(f"CTYPE{axis}", "")).strip().upper() for axis in axes}
    if stray := [f"{axis} ({name})" for axis, name in names.items() if is_celestial(name)]:
        raise InputError(
            "the axes of the sky are not the first two of the cube, but"
            f" {', '.join(sorted(stray))}",
            place=place,
            cure="transpose it, so that axes 1 and 2 are longitude and latitude",
        )
    numbers = _numbers_of_planes(axes, names, shape, wanted, place, cures)
    notes: dict[str, str] = {}
    for axis, length in axes.items():
        if names[axis] == "STOKES":
            numbers[axis], note = _plane_of_i(header, axis, length, numbers.get(axis), place)
            notes |= note
        elif length > 1:
            found = _which(header, axis, length, numbers[axis])
            notes["plane"] = "; ".join([*([notes["plane"]] if "plane" in notes else []), found])
    return tuple(numbers.get(axis, 1) - 1 for axis in axes), notes


def axes_of_planes(header: Any, shape: Sequence[int]) -> list[int]:
    """FITS numbers of the axes along which a plane is to be chosen."""
    every = range(3, len(shape) + 1)
    stokes = [a for a in every if str(header.get(f"CTYPE{a}", "")).strip().upper() == "STOKES"]
    return [a for a in every if shape[len(shape) - a] > 1 and a not in stokes]


def _numbers_of_planes(
    axes: dict[int, int],
    names: dict[int, str],
    shape: Sequence[int],
    wanted: tuple[int, ...] | None,
    place: str,
    cures: Cures,
) -> dict[int, int]:
    """The number of the wanted plane by axis."""
    sides = " x ".join(str(n) for n in reversed(shape))
    long = sorted(axis for axis, length in axes.items() if length > 1) or sorted(axes)
    asked = [axis for axis in long if names[axis] != "STOKES" and axes[axis] > 1]
    ranges = ", ".join(
        f"1 to {axes[axis]}{f' along {names[axis]}' if names[axis] else f' along axis {axis}'}"
        for axis in asked
    )
    ones = ", ".join("1" for _ in asked)
    example = ones if len(asked) == 1 else f"[{ones}]"
    if wanted is None:
        if asked:
            known = all(names[axis] for axis in asked)
            cure = cures.plane.format(
                example=example, ranges=ranges, list=ones.replace(" ", "")
            ) + ("" if known else ", or CTYPE3 to STOKES if its planes are I, Q, U")
            message = f"the image is a cube of {sides} pixels, not a map"
            raise InputError(message, place=place, cure=cure)
        return {}
    numbered = next((counted for counted in (long, asked) if len(counted) == len(wanted)), None)
    if not numbered:
        raise InputError(
            f"plane has {len(wanted)} numbers, and the image has {sides} pixels",
            place=place,
            cure=f"set plane: {example} ({ranges})" if asked else "remove plane",
        )
    for axis, n in zip(numbered, wanted, strict=True):
        if not 1 <= n <= axes[axis]:
            where = f" along {names[axis]}" if names[axis] else ""
            raise InputError(
                f"there is no plane {n} of {axes[axis]}{where}",
                place=place,
                cure="planes are counted from 1",
            )
    return dict(zip(numbered, wanted, strict=True))


def _which(header: Any, axis: int, length: int, plane: int) -> str:
    name, unit = (str(header.get(f"{key}{axis}", "")).strip() for key in ("CTYPE", "CUNIT"))
    told = f"{plane} of {length}{f' along {name}' if name else ''}"
    try:
        step = header.get(f"CDELT{axis}", header.get(f"CD{axis}_{axis}"))
        away = plane - float(header.get(f"CRPIX{axis}", 0.0))
        value = float(header[f"CRVAL{axis}"]) + away * float(step)
    except (KeyError, TypeError, ValueError):
        return told
    return f"{told}, at {value:.6g}{f' {unit}' if unit else ''}"


def _plane_of_i(
    header: Any, axis: int, length: int, wanted: int | None, place: str
) -> tuple[int, dict[str, str]]:
    """Number of the plane of I, or of the wanted one, along the FITS axis STOKES; the note about
    the others. Raises InputError for an axis without I.
    """
    found = along_axis(header, axis, length, place)
    if "I" not in found and wanted is None:
        raise InputError(
            f"its axis STOKES has {', '.join(found)} and no I",
            place=place,
            cure=f"give a map of I, or correct CRVAL{axis}, CDELT{axis} and CRPIX{axis}",
        )
    plane = found.index("I") + 1 if wanted is None else wanted
    unused = [name for k, name in enumerate(found, 1) if k != plane]
    if not unused:
        return plane, {}
    as_what = found[plane - 1] + ("" if found[plane - 1] == "I" else " as I")
    return plane, {STOKES: f"plane {plane} of {length} is read, {as_what}; {not_used(unused)}"}


def planes_of_q_and_u(
    header: Any, shape: Sequence[int], plane: tuple[int, ...]
) -> list[tuple[int, ...]] | None:
    """Indices of the planes of Q and U beside that of I, ``plane``, in a cube; None without them.

    A plane of Q that is named as if it were I has no others.
    """
    for k, length in enumerate(shape[:-2]):
        axis = len(shape) - k
        if str(header.get(f"CTYPE{axis}", "")).strip().upper() == "STOKES":
            found = along_axis(header, axis, length)
            if found[plane[k]] == "I" and {"Q", "U"} <= set(found):
                return [(*plane[:k], found.index(name), *plane[k + 1 :]) for name in ("Q", "U")]
    return None


def not_used(names: Sequence[str]) -> str:
    """Statement about Stokes parameters that unpolarized detectors do not see."""
    return (
        f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} not used: detectors measure total"
        " intensity"
    )


# --------------------------------------------------------------------------------------------------
# HEALPix tables


@dataclass(frozen=True)
class HealpixTable:
    """A FITS table of HEALPix pixels.

    Attributes
    ----------
    place
        The file, as messages call it.
    """

    hdu: Any
    place: str

    @property
    def header(self) -> Any:
        """The header of the table."""
        return self.hdu.header

    @property
    def names(self) -> list[str]:
        """The names of the columns."""
        return list(self.hdu.columns.names)

    @property
    def nest(self) -> bool:
        """True for pixels that are numbered in the nested scheme. Raises InputError without one."""
        ordering = str(self.header.get("ORDERING", "")).strip().upper()
        if ordering == "NUNIQ":
            raise InputError(
                "multi-order HEALPix maps (ORDERING = NUNIQ) are not read",
                place=self.place,
                cure="flatten it to one resolution, e.g. with ligo-skymap-flatten",
            )
        if not ordering.startswith(("RING", "NEST")):
            raise InputError(
                "the ordering of the HEALPix map is missing",
                place=self.place,
                cure="set the header key ORDERING to RING or NESTED",
            )
        return ordering.startswith("NEST")

    def frame(self, given: str | None, cures: Cures = OPERATORS) -> tuple[Frame, dict[str, str]]:
        """The frame by COORDSYS, or the ``given`` one; a note about a contradiction."""
        written = text(self.header, "COORDSYS", self.place).upper()
        system = written if given is None else given.upper()
        if system not in _FRAMES:
            what = f"unknown: COORDSYS = {system!r}" if system else "missing"
            raise InputError(
                f"the coordinate system of the HEALPix map is {what}",
                place=self.place,
                cure=cures.coordsys,
            )
        found = _FRAMES[system]
        if given is not None and _FRAMES.get(written, found) != found:
            return found, {"coordinates": f"{given} as given; COORDSYS = '{written}' is overridden"}
        return found, {}

    @property
    def pixel_column(self) -> int | None:
        """The column that numbers the pixels; None: row k is pixel k."""
        found, scheme = pixel_column(self.names), text(self.header, "INDXSCHM", self.place).upper()
        if scheme not in ("", "IMPLICIT", "EXPLICIT"):
            raise InputError(
                f"INDXSCHM = '{scheme}' is not known",
                place=self.place,
                cure="set it to IMPLICIT or EXPLICIT",
            )
        if found is None and scheme == "EXPLICIT":
            raise InputError(
                f"INDXSCHM is EXPLICIT, and no column numbers the pixels: {', '.join(self.names)}",
                place=self.place,
                cure="name the column of pixel numbers PIXEL",
            )
        return found

    def numbers(self, column: int) -> Floats:
        """The values (n,) of a column. Raises InputError for text."""
        found = np.asarray(self.hdu.data.field(column))
        if found.dtype.kind not in "iuf":
            cure = "give a column of numbers, or set the operator's parameter column to another"
            raise InputError(
                f"its column {self.names[column]} holds no numbers", place=self.place, cure=cure
            )
        return np.array(found, np.float64).ravel()

    def pixels(self, nside: int, n: int) -> NDArray[np.int64] | None:
        """The numbers of the pixels of ``n`` values; None: value k is pixel k.

        Raises InputError for numbers that are not whole, out of range or twice there, and for
        another number of them.
        """
        column = self.pixel_column
        if column is None:
            return None
        found, name = self.numbers(column), self.names[column]
        if (
            len(found) != n
            or not np.isfinite(found).all()
            or (found != np.round(found)).any()
            or (np.abs(found) > 2**52).any()
        ):
            raise InputError(
                f"its column {name} does not number its {n} values",
                place=self.place,
                cure=f"check the column {name}",
            )
        pixels = found.astype(np.int64)
        if len(pixels) and (
            pixels.min() < 0
            or pixels.max() >= 12 * nside * nside
            or len(np.unique(pixels)) < len(pixels)
        ):
            raise InputError(
                "the pixel numbers are out of range or twice there",
                place=self.place,
                cure="check NSIDE and the PIXEL column",
            )
        return pixels

    def length(self, column: int) -> int:
        """Number of values of a column by the header."""
        found = re.match(r"\s*(\d*)", str(self.hdu.columns.formats[column]))
        return int(self.header.get("NAXIS2", 0)) * (int(found[1] or 1) if found else 1)

    def nside(self, n: int) -> int:
        """The resolution of a table of ``n`` values. Raises InputError if it is none, or NSIDE
        contradicts it.
        """
        import healpy

        stated = number(self.header, "NSIDE", self.place)
        if self.pixel_column is not None:
            nside = int(stated or 0) if stated == int(stated or 0) else 0
        else:
            nside = round((n / 12) ** 0.5)
            if 12 * nside * nside != n:
                raise InputError(
                    f"{n} values are no HEALPix map",
                    place=self.place,
                    cure="a full map has 12 nside^2 of them",
                )
            if stated is not None and stated != nside:
                cure = f"set the header key NSIDE to {nside}, or give all of the map"
                raise InputError(
                    f"NSIDE = {stated:g}, and {n} values are a map of nside {nside}",
                    place=self.place,
                    cure=cure,
                )
        if nside < 1 or not healpy.isnsideok(nside, nest=self.nest):
            raise InputError(
                f"NSIDE = {self.header.get('NSIDE')} is not valid",
                place=self.place,
                cure="set the header key NSIDE",
            )
        return nside
