"""Reading sky maps from FITS files and arrays: images with or without a celestial WCS, and HEALPix
tables.

Nothing is guessed: where the unit, the scale or the position is neither in the file nor given, the
error lists the header keys and the parameters that would mend it. Arrays that are given in Python
(numpy's, astropy quantities, HDUs in memory) become the HDU of a FITS file that would hold them, so
that everything behind it is the same: units, beams, projections, missing pixels.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from contextlib import AbstractContextManager, nullcontext
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from zonda.core.configuration.diagnostics import TextValue, mistake
from zonda.core.errors import InputError
from zonda.core.maps.header import FileHeader, exact_header
from zonda.core.maps.map_reading import (
    STOKES,
    Cube,
    HealpixTable,
    chosen,
    is_healpix,
    polarized_letter,
    q_and_u,
    unused,
)
from zonda.core.maps.units import parse_unit
from zonda.core.storage.fits_files import check_size, joined, opened
from zonda.core.types import Floats

from .geometry import ImageHeader
from .input_map import HealpixMap, ImageMap, InputMap
from .map_header import MapHeader, Wanted

IN_A_FILE = (
    "an array is given in Python, as in SkyMap(map=array); in a pipeline file write file:"
    " my_map.fits"
)
GIVEN = "ZARRAY"
"""FITS key of a file that an array was written to: `ArrayMap.text`."""
STOKES_AXIS = {"CTYPE3": "STOKES", "CRPIX3": 1.0, "CRVAL3": 1.0, "CDELT3": 1.0}
"""Keys of an array of three images without a header: I, Q and U."""
TYPES = ("uint8", "int16", "int32", "int64", "float32", "float64")
"""Types of numbers that FITS has."""


def read_map(source: Path | ArrayMap, **options: Any) -> InputMap:
    """An image or HEALPix table of a FITS file or in memory; of Stokes parameters I, and a note
    names those that are not used.

    Parameters
    ----------
    options
        `Wanted`'s attributes.

    Raises
    ------
    InputError
        Unreadable file; no map in it; unit, scale or position missing; unknown unit; NaN; a cube of
        which no plane is wanted; no I; options that do not apply.
    """
    wanted = Wanted(**options)
    cure = "check the file, e.g. with fitsinfo or fitsverify, or copy it again"
    hdus: AbstractContextManager[Any]
    made: InputMap
    if isinstance(source, ArrayMap):
        place = f"sky map {source.name}"
        hdus = nullcontext([source.hdu])
    else:
        place = f"sky map {source}"
        hdus = opened(source, place, cure)
    with hdus as found:
        hdu, notes = chosen(found, wanted.hdu, place)
        check_size(hdu, place, whole=not wanted.header_alone)
        if is_healpix(hdu):
            made = _healpix(HealpixTable(hdu, place), MapHeader(hdu.header, place, wanted, notes))
        else:
            made = _image(hdu, found, ImageHeader(hdu.header, place, wanted, notes))
        given = source.text if isinstance(source, ArrayMap) else hdu.header.get(GIVEN)
    if made.polarization is not None:
        notes.pop(STOKES, None)
    if given:
        notes["input"] = f"{given}, in {made.unit}, given in Python"
    return made


def _filled(header: MapHeader, found: InputMap, planes: Floats, factor: float, where: str) -> None:
    """Put ``planes`` (1 or 3, ...) of I, or I, Q and U in COSMO's convention, into a map; in its
    unit they are times ``factor``. ``where`` names a pixel by its indices.
    """
    found.zeroed = header.filled(planes[0], where)
    if len(planes) > 1:
        found.zeroed += header.filled(planes[1:], f"plane {{}} of Q and U, {where}")
        found.polarization = planes[1:]
    planes *= factor
    found.values = planes[0]


def _image(hdu: Any, hdus: Any, header: ImageHeader) -> ImageMap:
    place = header.place
    wanted = header.wanted
    notes = header.notes
    beside = _beside(hdu, hdus, header) if wanted.hdu is None else []
    images = [hdu, *beside]
    values = [_pixels(image, wanted) for image in images]
    if values[0].ndim < 2 or values[0].size == 0:
        raise header.error("the image has no pixels", "give a two-dimensional image")
    if values[0].dtype.kind not in "iuf":
        message = f"its pixels are {values[0].dtype}, not numbers"
        raise header.error(message, "give an image of numbers")
    header.refuse("{} is for HEALPix maps", coordsys=wanted.coordsys, column=wanted.column)
    shape = values[0].shape
    cube = Cube(header.header, place, shape)
    plane, more = cube.plane(wanted.plane)
    notes |= more
    planes = [values[0][plane], *values[1:]]
    if wanted.polarized and (found := cube.q_and_u(plane)):
        planes = [values[0][k] for k in (plane, *found)]
    units = [FileHeader(image.header, place).text("BUNIT") for image in beside]
    unit, factor = header.unit("BUNIT", units, "images")
    beam = header.beam(unit)
    wcs, placeless = header.geometry(shape)
    image = ImageMap(
        values=planes[0],
        unit=unit,
        beam=beam,
        notes=notes,
        wcs=wcs,
        placeless=placeless,
    )
    header.check_beam(image, float((image.sides[::-1] * image.shape).max()))
    sign = header.sign_of_u(True) if len(planes) > 1 else 1.0
    if not wanted.header_alone:
        stack = np.array(planes, np.float64)
        stack[2:] *= sign
        _filled(header, image, stack, factor, "row {}, column {} (counted from 1)")
    return image


def _pixels(hdu: Any, wanted: Wanted) -> Floats:
    """The array of an image; of the header alone one of zeros that takes no memory."""
    if wanted.header_alone:
        return np.broadcast_to(np.float64(0.0), hdu.shape)
    return np.asarray(hdu.data)


def _beside(first: Any, hdus: Any, header: MapHeader) -> list[Any]:
    """Images of Q and U beside the ``first`` one, if they are wanted and there; a note names them
    otherwise.
    """
    if polarized_letter(first.name):
        raise header.error(
            f"its first image, {first.name}, is no intensity",
            "put the image of I first, or name it by the operator's parameter hdu",
        )
    what = f"the first image{f', {first.name},' if first.name else ''}"
    header.notes |= unused(what, [hdu.name for hdu in hdus if hdu.is_image])
    images = [hdu for hdu in hdus if hdu.is_image and hdu.header.get("NAXIS", 0) == 2]
    found = q_and_u([hdu.name for hdu in images]) if header.wanted.polarized else []
    beside = [images[k] for k in found]
    if any(hdu.shape != first.shape for hdu in beside):
        raise header.error(
            "its images of I, Q and U differ in size",
            "give three images of one grid",
        )
    for hdu in beside:
        check_size(hdu, header.place, whole=not header.wanted.header_alone)
    return beside


def _healpix(table: HealpixTable, header: MapHeader) -> HealpixMap:
    """The map of a table in its column of I (`HealpixTable.intensity`)."""
    wanted = header.wanted
    notes = header.notes
    header.refuse(
        "{} does not apply to a HEALPix map",
        centre=wanted.centred,
        pixel_size=wanted.pixel_size,
        plane=wanted.plane,
    )
    nest = table.nest
    names = table.names
    frame, more = table.frame(wanted.coordsys)
    first = table.intensity(wanted.column)
    notes |= more | unused(f"column {names[first]}", names, first)
    if len(names) > 1 + (table.pixel_column is not None) or wanted.column is not None:
        notes["column"] = f"{names[first]} ({first + 1} of {len(names)}: {', '.join(names)})"
    wanted_too = wanted.polarized and not polarized_letter(names[first])
    others = q_and_u(names) if wanted_too else []
    units = [str(header.header.get(f"TUNIT{1 + k}", "") or "").strip() for k in others]
    unit, factor = header.unit(f"TUNIT{1 + first}", units, "columns")
    beam = header.beam(unit)
    sign = header.sign_of_u(False) if others else 1.0
    columns = dict(zip("IQU", (first, *others), strict=False))
    planes, pixels, nside = table.read(columns, wanted.header_alone)
    values = np.stack(list(planes.values()))
    found = HealpixMap(
        values=values[0],
        unit=unit,
        beam=beam,
        notes=notes,
        pixels=pixels,
        nside=nside,
        nest=nest,
        frame=frame,
    )
    header.check_beam(found, math.pi)
    values[2:] *= sign
    _filled(header, found, values, factor, "entry {} of those that are seen (counted from 1)")
    return found


@dataclass(frozen=True, eq=False, repr=False)
class ArrayMap(TextValue):
    """An image in memory, or a HEALPix table.

    Attributes
    ----------
    hdu
        Of `astropy.io.fits`: an image of two axes or more, or the table.
    given
        Hash of what was given, before world coordinates were added; empty: it is as it was given.
    """

    NOUN: ClassVar[str] = "an array"
    json_schema: ClassVar[dict[str, Any]] = {"type": "null"}

    hdu: Any
    given: str = ""

    @classmethod
    def parse(cls, value: Any) -> ArrayMap:
        """The map in an array, a Quantity or an HDU. Raises ValueError for anything else."""
        if isinstance(value, cls):
            return value
        if isinstance(value, str | Path):
            raise mistake(f"map takes an array; a file is given as file={str(value)!r}")
        if isinstance(value, Mapping):
            raise mistake(IN_A_FILE)
        if isinstance(value, fits.HDUList):
            first = next((k for k, hdu in enumerate(value) if hdu.data is not None), 0)
            raise mistake("map takes one HDU, not a list of them", f"choose one: map=hdus[{first}]")
        cards: dict[str, Any] = {}
        if given := hasattr(value, "header") and hasattr(value, "data"):
            if is_healpix(value):
                return cls(value.copy())
            if value.data is None or not getattr(value, "is_image", False):
                raise mistake("the HDU holds neither an image nor a HEALPix table")
            cards = _cards(value.header)
            value = value.data
        elif hasattr(value, "unit") and hasattr(value, "value"):
            value, unit = _in_known_unit(value)
            cards = {"BUNIT": unit} if unit else {}
        if isinstance(value, np.ma.MaskedArray):
            value = np.ma.filled(value.astype(np.float64), np.nan)
        values = np.array(value)  # a copy: what becomes of the user's array does not matter
        if values.dtype.kind not in "fiu" or values.dtype.itemsize > 8:
            raise mistake(f"expected an array of numbers, got {value!r:.60}")
        if values.ndim < 2 or not values.size:
            cure = (
                "; give a HEALPix map as a table HDU, or write it with healpy.write_map and give"
                " file="
                if values.ndim == 1
                else ""
            )
            raise mistake(f"expected an image (ny, nx), got an array of shape {values.shape}{cure}")
        if not given and values.ndim == 3 and len(values) == 3:
            cards |= STOKES_AXIS
        kind = values.dtype.newbyteorder("=")
        values = values.astype(kind if kind.name in TYPES else np.float64)
        values.flags.writeable = False
        return cls(fits.PrimaryHDU(values, fits.Header(cards.items())))

    @property
    def header(self) -> fits.Header:
        """FITS keywords: unit, world coordinates, beam."""
        return self.hdu.header

    @property
    def is_table(self) -> bool:
        """True for a HEALPix table."""
        return isinstance(self.hdu, fits.BinTableHDU)

    @cached_property
    def digest(self) -> str:
        """Hash of the numbers and of the header."""
        found = hashlib.blake2b(repr(sorted(self.header.items())).encode(), digest_size=8)
        found.update(np.ascontiguousarray(self.hdu.data).data)
        return found.hexdigest()

    @property
    def name(self) -> str:
        """Name in messages: ``array of 64 x 48``."""
        if self.is_table:
            return "HEALPix table in memory"
        return f"array of {' x '.join(str(n) for n in reversed(self.hdu.shape))}"

    def with_wcs(self, wcs: WorldCoordinates) -> ArrayMap:
        """The image with these world coordinates."""
        header = joined(self.header, fits.Header(wcs.items()))
        return ArrayMap(fits.PrimaryHDU(self.hdu.data, header), self.given or self.digest)

    @property
    def text(self) -> str:
        """Entry of the log: ``array of 64 x 48, float64, hash 0123456789abcdef``."""
        kind = "" if self.is_table else f", {self.hdu.data.dtype.name}"
        return f"{self.name}{kind}, hash {self.given or self.digest}"

    def dump(self) -> dict[str, Any]:
        """Shape, type, unit and hash, for products."""
        found: dict[str, Any] = (
            {"healpix": int(self.header.get("NSIDE") or 0)}
            if self.is_table
            else {"array": list(self.hdu.shape), "type": self.hdu.data.dtype.name}
        )
        if "BUNIT" in self.header:
            found["unit"] = self.header["BUNIT"]
        return {**found, "hash": self.digest}

    def write(self, path: Path) -> None:
        """Write a FITS file that reads back to the same bits: header values are rounded as astropy
        does, in memory too.

        The key `GIVEN` says what it was.
        """
        made = self.hdu.copy()
        made.header[GIVEN] = self.text
        made.writeto(path, overwrite=True)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ArrayMap) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self) -> str:
        return f"<{self.name}, hash {self.digest}>"


class WorldCoordinates(dict[str, Any], TextValue):
    """The FITS keywords of an astropy `WCS`, a header or a mapping."""

    NOUN: ClassVar[str] = "an astropy WCS"
    json_schema: ClassVar[dict[str, Any]] = {"type": "null"}

    shape: tuple[int, ...] | None = None
    """(ny, nx) of the image that they are made for; None: not known."""

    @classmethod
    def parse(cls, value: Any) -> WorldCoordinates:
        """Raises the error of `mistake` for anything else."""
        if isinstance(value, cls):
            return value
        shape = getattr(value, "pixel_shape", None)
        if hasattr(value, "to_header") and hasattr(value, "wcs"):
            value = exact_header(value)
        elif not isinstance(value, Mapping | fits.Header):
            raise mistake(f"expected an astropy WCS or FITS keywords, got {value!r:.60}")
        made = cls(_cards(value))
        made.shape = None if shape is None else tuple(reversed(shape))
        return made

    def dump(self) -> dict[str, Any]:
        return dict(self)

    def check(self, image: ArrayMap) -> None:
        """Raise ValueError if they are those of another image."""
        if self.shape is None or image.is_table or self.shape[-2:] == image.hdu.shape[-2:]:
            return
        ours, theirs = (
            " x ".join(str(n) for n in reversed(shape[-2:]))
            for shape in (image.hdu.shape, self.shape)
        )
        raise ValueError(
            f"the WCS is that of an image of {theirs} pixels, the array has {ours} (array[y, x])"
        )


def checked_unit(array: ArrayMap, given: str | None) -> None:
    """Raise ValueError where ``unit`` contradicts the unit of a quantity: its prefix would be read
    twice.
    """
    own = array.header.get("BUNIT")
    if not isinstance(own, str) or given is None:
        return
    try:
        unit = parse_unit(given, place="unit")
        same = unit == parse_unit(own, place="map", temperature_scale=unit[0])
    except InputError:
        return  # said when the map is read
    if not same:
        raise ValueError(
            f"the map is a quantity in {own}, and unit is {given}; convert one of them"
        )


def _cards(header: Any) -> dict[str, Any]:
    """A header's cards without those that say how the numbers lie in a file."""
    if isinstance(header, fits.Header):
        header = header.copy(strip=True)
    plain = (bool, int, float, str, np.bool_, np.integer, np.floating)
    found = {key.upper(): header[key] for key in header if key and isinstance(header[key], plain)}
    return {
        key: value.item() if isinstance(value, np.generic) else value
        for key, value in found.items()
        if len(key) <= 8 and " " not in key and key not in ("BLANK", "COMMENT", "HISTORY")
    }


def _in_known_unit(quantity: Any) -> tuple[NDArray[Any], str]:
    """The numbers of a quantity and their unit as headers write it; an intensity becomes MJy/sr.
    Empty: a pure number.
    """
    text = str(quantity.unit).strip()
    try:
        parse_unit(text, place="map", temperature_scale="K_RJ")
    except InputError:
        for unit in ("MJy/sr", "K") if text else ():
            if quantity.unit.is_equivalent(unit):
                return np.asarray(quantity.to_value(unit)), unit
        if text:
            raise mistake(
                f"'{text}' is no unit of a map of the sky; use K, Jy/beam, Jy/pix or MJy/sr"
            ) from None
    return np.asarray(quantity.value), text
