"""Maps in FITS files: the extension, the planes of its cube or the pixels of its HEALPix table, and
which of them are I, Q and U.

`SkyMap` and comparisons of maps read with it. Nothing is guessed: if a file leaves a choice, the
error lists the possible ones.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from typing import Any, Literal

import numpy as np

from ..errors import InputError
from ..types import Floats, Integers
from .header import FileHeader, is_celestial, marked_bad, with_known_frame

Frame = Literal["icrs", "galactic", "barycentricmeanecliptic"]
"""Names of frames as astropy has them."""
STOKES = "Stokes parameters"
"""Key of the note about Stokes parameters that are not used."""
Index = tuple[int, ...]
"""Index of a plane, along the axes of an image before the last two."""
_FRAMES: dict[str, Frame] = {
    **dict.fromkeys(("C", "Q", "EQ", "ICRS", "CELESTIAL", "EQUATORIAL"), "icrs"),
    **dict.fromkeys(("G", "GALACTIC"), "galactic"),
    **dict.fromkeys(("E", "ECLIPTIC"), "barycentricmeanecliptic"),
}
"""Values of COORDSYS."""

# --------------------------------------------------------------------------------------------------
# names of Stokes parameters


_NAMES = {1: "I", 2: "Q", 3: "U", 4: "V"}
"""Values of a FITS axis STOKES (Greisen & Calabretta 2002); those below zero are correlations."""
_POLARIZED = re.compile(r"(STOKES[ _-]?)?([QUV])([ _-].*)?", re.IGNORECASE)
"""Names of columns and extensions: Q_POLARISATION (healpy), Q_STOKES (Planck), STOKES_Q, Q."""
_INTENSITY = re.compile(
    r"(STOKES[ _-]?)?[IT]|[IT][ _-]?STOKES|I[ _-]POL[A-Z]*"
    r"|TEMP(ERATURE)?|INTENSITY|SIGNAL|BRIGHTNESS|T[ _-]?B",
    re.IGNORECASE,
)
"""Names of columns of a brightness: I_STOKES (Planck), TEMPERATURE (healpy), SIGNAL (zonda,
HEALPix's own tools).
"""
_PIXEL = re.compile(
    r"(I?PIX(EL|ELS|NUM|NO|ID)?|PIXEL?[ _-]?(INDEX|NUMBER|NUM|ID)|INDEX"
    r"|HPX[ _-]?(PIXEL|INDEX|ID)|HEALPIX|HPIX)",
    re.IGNORECASE,
)
_OTHER = re.compile(
    r"(.*[ _-])?(N?[ _-]?HITS?|N[ _-]?OBS(ERVATIONS)?|N[ _-]?SAMP(LES)?"
    r"|COUNTS?|WEIGHTS?|WGTS?|COV(ARIANCE|ERAGE)?|STD(DEV)?|STDEV|SIGMA|RMS|ERR(ORS?)?"
    r"|VAR(IANCE)?|NOISE|[TPIQU]?MASK|R?COND(ITION)?"
    r"|EXPOSURE|TIME|FLAGS?|RA|DEC|GLON|GLAT|LON|LAT)"
    r"([ _-].*|\d+)?|[IQUV][IQUV]",
    re.IGNORECASE,
)
"""Names of columns that hold no map of the sky: hits, weights, errors, masks, coordinates."""


def polarized_letter(name: str) -> str:
    """Q, U or V of the name of a column or an extension that holds it; empty of another one."""
    found = _POLARIZED.fullmatch(name.strip())
    return "" if found is None or _OTHER.fullmatch(name.strip()) else found[2].upper()


def unused(what: str, names: Sequence[str], read: int | None = None) -> dict[str, str]:
    """A note that ``what`` is read as I, and that Stokes parameters among ``names`` are not used;
    ``read``: the number of ``what`` among them.
    """
    beside = [name for k, name in enumerate(names) if k != read and polarized_letter(name)]
    return {STOKES: f"{what} is read as I; {_not_used(beside)}"} if beside else {}


def _not_used(names: Sequence[str]) -> str:
    """Statement about Stokes parameters that unpolarized detectors do not see."""
    return (
        f"{', '.join(names)} {'is' if len(names) == 1 else 'are'} not used: detectors measure total"
        " intensity"
    )


def q_and_u(names: Sequence[str]) -> list[int]:
    """Numbers of the columns or extensions of these names that hold Q and U; none if they are not
    both there.
    """
    letters = [polarized_letter(name) for name in names]
    return [letters.index("Q"), letters.index("U")] if {"Q", "U"} <= set(letters) else []


# --------------------------------------------------------------------------------------------------
# extensions


def is_healpix(hdu: Any) -> bool:
    """True for a table of HEALPix pixels."""
    header = hdu.header
    return header.get("XTENSION") == "BINTABLE" and (
        str(header.get("PIXTYPE", "")).upper() == "HEALPIX"
        or ("NSIDE" in header and "ORDERING" in header)
    )


def chosen(hdus: Any, wanted: int | str | None, place: str) -> tuple[Any, dict[str, str]]:
    """The extension ``wanted``, by name or number, else the first map; notes.

    Raises InputError if there is none, or it is no map: a HEALPix table, or an image of two axes or
    more.
    """
    name = str(wanted).strip().upper()
    contents = _contents(hdus)
    about = FileHeader({}, place)
    asked = [
        hdu
        for k, hdu in enumerate(hdus)
        if wanted is None or name in (str(k), str(hdu.name).upper())
    ]
    maps = [
        hdu for hdu in asked if is_healpix(hdu) or (hdu.is_image and hdu.header.get("NAXIS", 0) > 1)
    ]
    if wanted is None and not maps:
        one = any(hdu.is_image and hdu.header.get("NAXIS", 0) == 1 for hdu in hdus)
        what = "it holds no image of two axes and no HEALPix table"
        if one:
            what = "its image has one axis (a spectrum?)"
        raise about.error(
            f"is not a map: {what}; in the file: {contents}",
            "give a FITS file with a two-dimensional image that has a celestial WCS, or with a"
            " HEALPix table",
        )
    if not asked:
        message = f"there is no extension {wanted}"
        raise about.error(message, f"set hdu to one of these: {contents}")
    if asked[0] not in maps and wanted is not None:
        message = f"the extension {wanted} is neither an image of two axes nor a HEALPix table"
        raise about.error(message, f"set hdu to another of these: {contents}")
    if wanted is not None or len(maps) == 1:
        return maps[0], {}
    told = f"the first of {len(maps)} maps is read; in the file: {contents}"
    return maps[0], {"extension": told}


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
    sides = [str(header.get(f"NAXIS{k + 1}")) for k in range(header.get("NAXIS", 0))]
    return f"image of {' x '.join(sides)}" if sides else "empty"


def celestial(hdu: Any, place: str) -> tuple[Cube, Any, str]:
    """The planes of an image on the sky, its two-dimensional celestial WCS, and the note of
    `with_known_frame`. Raises InputError where there is no such WCS.
    """
    from astropy.wcs import WCS

    header, note = with_known_frame(hdu.header, place)
    wcs = WCS(header)
    shape = hdu.shape
    if not wcs.has_celestial:
        kinds = ", ".join(str(header.get(f"CTYPE{k}", "none")) for k in (1, 2))
        message = f"is not a map: it has no celestial coordinates (CTYPE: {kinds})"
        cure = "give a FITS file with an image that has a celestial WCS, or with a HEALPix table"
        raise InputError(message, place=place, cure=cure)
    for axis in range(3, len(shape) + 1):
        if shape[len(shape) - axis] == 1:  # whatever it is of, there is no choice
            header[f"CTYPE{axis}"] = ""
    return Cube(header, place, shape), wcs.celestial, note


# --------------------------------------------------------------------------------------------------
# planes of cubes


class Cube(FileHeader):
    """Header of an image of ``shape`` (slowest axis first), and the choice of its planes, along the
    axes before the last two, if it has such.
    """

    def __init__(self, header: Any, place: str, shape: Sequence[int]) -> None:
        super().__init__(header, place)
        self.sides = " x ".join(str(n) for n in reversed(shape))
        # FITS counts from the fastest
        self.lengths = {len(shape) - k: n for k, n in enumerate(shape[:-2])}
        self.names = {axis: self._word("CTYPE", axis).upper() for axis in self.lengths}
        self.asked = [
            axis
            for axis, length in sorted(self.lengths.items())
            if length > 1 and self.names[axis] != "STOKES"
        ]
        """FITS numbers of the axes along which a plane is to be chosen."""

    def _word(self, key: str, axis: int) -> str:
        return str(self.header.get(f"{key}{axis}", "")).strip()

    def plane(self, wanted: Index | None) -> tuple[Index, dict[str, str]]:
        """Index of a plane, and notes about the others.

        Parameters
        ----------
        wanted
            The plane, counted from 1, in FITS's order of the axes. An axis STOKES may be left out:
            of it I is read.

        Raises
        ------
        InputError
            A cube without a wanted plane, or one that is not there; no I; axes of the sky that are
            not the first two.
        """
        stray = [axis for axis in sorted(self.names) if is_celestial(self.header, axis)]
        if stray:
            raise self.error(
                "the axes of the sky are not the first two of the cube, but"
                f" {', '.join(f'{axis} ({self.names[axis]})' for axis in stray)}",
                "transpose it, so that axes 1 and 2 are longitude and latitude",
            )
        numbers = self._numbers(wanted)
        planes = []
        notes: dict[str, str] = {}
        for axis, length in self.lengths.items():
            if self.names[axis] == "STOKES":
                numbers[axis], note = self._plane_of_i(axis, numbers.get(axis))
                notes |= note
            elif length > 1:
                planes.append(self._which(axis, numbers[axis]))
        if planes:
            notes["plane"] = "; ".join(planes)
        return tuple(numbers.get(axis, 1) - 1 for axis in self.lengths), notes

    def _numbers(self, wanted: Index | None) -> dict[int, int]:
        """The number of the wanted plane by axis."""
        lengths = self.lengths
        asked = self.asked
        ranges = ", ".join(
            f"1 to {lengths[axis]} along {self.names[axis] or f'axis {axis}'}" for axis in asked
        )
        ones = ", ".join("1" for _ in asked)
        example = ones if len(asked) == 1 else f"[{ones}]"
        if wanted is None:
            if not asked:
                return {}
            cure = f"choose the plane ({ranges}): plane: {example} in a pipeline file,"
            cure += f" --plane {ones.replace(' ', '')} of zonda compare"
            if not all(self.names[axis] for axis in asked):
                cure += "; or set CTYPE3 to STOKES if its planes are I, Q, U"
            raise self.error(f"the image is a cube of {self.sides} pixels, not a map", cure)
        long = sorted(axis for axis, length in lengths.items() if length > 1) or sorted(lengths)
        numbered = next((some for some in (long, asked) if len(some) == len(wanted)), None)
        if not numbered:
            cure = f"set plane: {example} ({ranges})" if asked else "remove plane"
            message = f"plane has {len(wanted)} numbers, and the image has {self.sides} pixels"
            raise self.error(message, cure)
        found = dict(zip(numbered, wanted, strict=True))
        for axis, n in found.items():
            if not 1 <= n <= lengths[axis]:
                where = f" along {self.names[axis]}" if self.names[axis] else ""
                message = f"there is no plane {n} of {lengths[axis]}{where}"
                raise self.error(message, "planes are counted from 1")
        return found

    def _which(self, axis: int, plane: int) -> str:
        header = self.header
        name = self._word("CTYPE", axis)
        unit = self._word("CUNIT", axis)
        told = f"{plane} of {self.lengths[axis]}{f' along {name}' if name else ''}"
        try:
            step = header.get(f"CDELT{axis}", header.get(f"CD{axis}_{axis}"))
            away = plane - float(header.get(f"CRPIX{axis}", 0.0))
            value = float(header[f"CRVAL{axis}"]) + away * float(step)
        except (KeyError, TypeError, ValueError):
            return told
        return f"{told}, at {value:.6g}{f' {unit}' if unit else ''}"

    def _plane_of_i(self, axis: int, wanted: int | None) -> tuple[int, dict[str, str]]:
        """Number of the plane of I, or of the wanted one, along the FITS axis STOKES; the note
        about the others. Raises InputError for an axis without I.
        """
        found = self.along_stokes(axis)
        if "I" not in found and wanted is None:
            cure = f"give a map of I, or correct CRVAL{axis}, CDELT{axis} and CRPIX{axis}"
            raise self.error(f"its axis STOKES has {', '.join(found)} and no I", cure)
        plane = found.index("I") + 1 if wanted is None else wanted
        beside = [name for k, name in enumerate(found, 1) if k != plane]
        if not beside:
            return plane, {}
        as_what = found[plane - 1] + ("" if found[plane - 1] == "I" else " as I")
        text = f"plane {plane} of {len(found)} is read, {as_what}; {_not_used(beside)}"
        return plane, {STOKES: text}

    def along_stokes(self, axis: int) -> list[str]:
        """Stokes parameter of each plane along the FITS axis STOKES: I, Q and U if no card says
        anything.

        Raises
        ------
        InputError
            Its cards are no numbers, or not all there; they give no whole numbers, or one for
            several planes.
        """
        length = self.lengths[axis]
        cure = f"correct CRVAL{axis}, CDELT{axis} and CRPIX{axis}: 1, 1, 1 for I, Q, U"
        given = [self.number(f"{key}{axis}", cure) for key in ("CRVAL", "CDELT", "CRPIX")]
        if (given[0] is None) != (given[2] is None):
            raise self.error(f"of CRVAL{axis} and CRPIX{axis} one is missing", cure)
        first, step, pixel = (1.0 if value is None else value for value in given)
        values = [first + (n + 1 - pixel) * step for n in range(length)]
        if (
            any(abs(value - round(value)) > 1e-3 for value in values)
            or len({round(value) for value in values}) < length
        ):
            told = ", ".join(f"{value:g}" for value in values[:4])
            raise self.error(f"the planes of its axis STOKES have the values {told}", cure)
        return [_NAMES.get(round(value), "a correlation") for value in values]

    def q_and_u(self, plane: Index) -> list[Index]:
        """Indices of the planes of Q and U beside that of I, ``plane``; none without them.

        A plane of Q that is named as if it were I has no others.
        """
        for k, axis in enumerate(self.lengths):
            if self.names[axis] == "STOKES":
                found = self.along_stokes(axis)
                if found[plane[k]] == "I" and {"Q", "U"} <= set(found):
                    return [(*plane[:k], found.index(name), *plane[k + 1 :]) for name in "QU"]
        return []


# --------------------------------------------------------------------------------------------------
# HEALPix tables


class HealpixTable(FileHeader):
    """A FITS table of HEALPix pixels."""

    def __init__(self, hdu: Any, place: str) -> None:
        super().__init__(hdu.header, place)
        self.hdu = hdu
        self.names: list[str] = list(hdu.columns.names)
        """The names of the columns."""

    @property
    def nest(self) -> bool:
        """True for pixels that are numbered in the nested scheme. Raises InputError without one."""
        ordering = str(self.header.get("ORDERING", "")).strip().upper()
        if ordering == "NUNIQ":
            raise self.error(
                "multi-order HEALPix maps (ORDERING = NUNIQ) are not read",
                "flatten it to one resolution, e.g. with ligo-skymap-flatten",
            )
        if not ordering.startswith(("RING", "NEST")):
            message = "the ordering of the HEALPix map is missing"
            raise self.error(message, "set the header key ORDERING to RING or NESTED")
        return ordering.startswith("NEST")

    def frame(self, given: str | None) -> tuple[Frame, dict[str, str]]:
        """The frame by COORDSYS, or the ``given`` one; a note about a contradiction."""
        written = self.text("COORDSYS").upper()
        system = written if given is None else given.upper()
        if system not in _FRAMES:
            what = f"unknown: COORDSYS = {system!r}" if system else "missing"
            raise self.error(
                f"the coordinate system of the HEALPix map is {what}",
                "set the header key COORDSYS to C, G or E, or give coordsys: icrs, galactic or"
                " ecliptic in a pipeline file, --coordsys C, G or E to zonda compare (WMAP's and"
                " Planck's maps are galactic)",
            )
        found = _FRAMES[system]
        if given is not None and _FRAMES.get(written, found) != found:
            return found, {"coordinates": f"{given} as given; COORDSYS = '{written}' is overridden"}
        return found, {}

    @property
    def pixel_column(self) -> int | None:
        """The column that numbers the pixels; None: row k is pixel k."""
        found = next((k for k, n in enumerate(self.names) if _PIXEL.fullmatch(n.strip())), None)
        scheme = self.text("INDXSCHM").upper()
        if scheme not in ("", "IMPLICIT", "EXPLICIT"):
            raise self.error(
                f"INDXSCHM = '{scheme}' is not known",
                "set it to IMPLICIT or EXPLICIT",
            )
        if found is None and scheme == "EXPLICIT":
            raise self.error(
                f"INDXSCHM is EXPLICIT, and no column numbers the pixels: {', '.join(self.names)}",
                "name the column of pixel numbers PIXEL",
            )
        return found

    def intensity(self, wanted: int | str | None = None) -> int:
        """The column that is read as I: the one that is ``wanted``, by name or counted from 1; that
        of a known name, or the only possible one.

        Raises
        ------
        InputError
            There is no such column; none may be I; several may be.
        """
        names = self.names
        pixel = self.pixel_column
        there = ", ".join(self.names)
        if wanted is not None:
            name = str(wanted).strip().upper()
            same = [k for k, n in enumerate(names) if name in (n.strip().upper(), str(k + 1))]
            if not same or same[0] == pixel:
                message = f"there is no map in a column {wanted}"
                raise self.error(message, f"set column to one of: {there}")
            return same[0]
        may_be = [
            k
            for k, name in enumerate(names)
            if k != pixel and not polarized_letter(name) and not _OTHER.fullmatch(name.strip())
        ]
        if not may_be:
            raise self.error(
                f"none of its columns is an intensity: {there}",
                "write a column I_STOKES, or set column (--column of zonda compare) to the one that"
                " is the map",
            )
        known = [k for k in may_be if _INTENSITY.fullmatch(names[k].strip())]
        known = known or [
            k for k in may_be if re.match(r"I[ _-]|STOKES[ _-]?I", names[k].strip(), re.IGNORECASE)
        ]
        if not known and len(may_be) > 1:
            which = ", ".join(names[k] for k in may_be)
            cure = f"set column (--column of zonda compare), e.g. to {names[may_be[0]]}"
            raise self.error(f"several of its columns may be the map: {which}", cure)
        return (known or may_be)[0]

    def read(
        self,
        columns: Mapping[str, int],
        header_alone: bool = False,
    ) -> tuple[dict[str, Floats], Integers | None, int]:
        """Values (n,) of ``columns``, the first of which is I, in the order of their pixels; the
        pixels' numbers (None: value k is pixel k); nside.

        Pixels that the file marks as not seen are left out of I, and NaN in the others. Raises
        InputError for columns of text, and where number, resolution and pixels do not agree.
        """
        if header_alone:
            repeat = re.match(r"\s*(\d*)", str(self.hdu.columns.formats[columns["I"]]))
            n = int(self.header.get("NAXIS2", 0)) * int((repeat and repeat[1]) or 1)
            return {"I": np.zeros(0)}, None, self._nside(n)
        values = np.stack([self._numbers(k) for k in columns.values()])
        nside = self._nside(values.shape[1])
        n = values.shape[1]
        if (pixels := self._pixels(nside, n)) is not None:
            order = np.argsort(pixels, kind="stable")
            pixels = pixels[order]
            values = values[:, order]
        unseen = marked_bad(values, self)
        values[1:][unseen[1:]] = np.nan
        if unseen[0].any():
            seen = ~unseen[0]
            pixels = np.flatnonzero(seen) if pixels is None else pixels[seen]
            values = values[:, seen]
        return dict(zip(columns, values, strict=True)), pixels, nside

    def _numbers(self, column: int) -> Floats:
        found = np.asarray(self.hdu.data.field(column))
        if found.dtype.kind not in "iuf":
            cure = "give a column of numbers, or set column (--column of zonda compare) to another"
            raise self.error(f"its column {self.names[column]} holds no numbers", cure)
        return np.array(found, np.float64).ravel()

    def _pixels(self, nside: int, n: int) -> Integers | None:
        """The numbers of the pixels of ``n`` values."""
        if (column := self.pixel_column) is None:
            return None
        found = self._numbers(column)
        name = self.names[column]
        if (
            len(found) != n
            or not np.isfinite(found).all()
            or (found != np.round(found)).any()
            or (np.abs(found) > 2**52).any()
        ):
            message = f"its column {name} does not number its {n} values"
            raise self.error(message, f"check the column {name}")
        pixels = found.astype(np.int64)
        if len(np.unique(pixels)) < n or ((pixels < 0) | (pixels >= 12 * nside * nside)).any():
            message = "the pixel numbers are out of range or twice there"
            raise self.error(message, "check NSIDE and the PIXEL column")
        return pixels

    def _nside(self, n: int) -> int:
        """The resolution of a table of ``n`` values. Raises InputError if it is none, or NSIDE
        contradicts it.
        """
        import healpy

        stated = self.number("NSIDE")
        if self.pixel_column is not None:
            nside = int(stated or 0) if stated == int(stated or 0) else 0
        else:
            nside = round((n / 12) ** 0.5)
            if 12 * nside * nside != n:
                message = f"{n} values are no HEALPix map"
                raise self.error(message, "a full map has 12 nside^2 of them")
            if stated is not None and stated != nside:
                raise self.error(
                    f"NSIDE = {stated:g}, and {n} values are a map of nside {nside}",
                    f"set the header key NSIDE to {nside}, or give all of the map",
                )
        if nside < 1 or not healpy.isnsideok(nside, nest=self.nest):
            message = f"NSIDE = {self.header.get('NSIDE')} is not valid"
            raise self.error(message, "set the header key NSIDE")
        return nside
