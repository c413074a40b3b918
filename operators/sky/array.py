"""Maps that are given as arrays in Python: numpy arrays, astropy quantities and FITS units in
memory.

Each becomes what a FITS file would hold, so that everything behind it is the same: units, beams,
projections, missing pixels.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from astropy.io import fits
from astropy.io.fits import Header
from numpy.typing import NDArray
from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import core_schema

from zonda.core.configuration.diagnostics import mistake
from zonda.core.errors import InputError
from zonda.core.maps.header import exact_header
from zonda.core.maps.map_reading import is_healpix
from zonda.core.maps.units import parse_unit
from zonda.core.storage.fits_files import joined

IN_A_FILE = (
    "an array is given in Python, as in SkyMap(map=array); in a pipeline file write file:"
    " my_map.fits"
)
GIVEN = "ZARRAY"
"""FITS key of a file that an array was written to: `ArrayMap.text`."""
_STRUCTURE = frozenset(
    [
        "SIMPLE",
        "XTENSION",
        "BITPIX",
        "PCOUNT",
        "GCOUNT",
        "EXTEND",
        "BSCALE",
        "BZERO",
        "BLANK",
        "END",
        "COMMENT",
        "HISTORY",
    ]
)
"""Keys that say how an array lies in a file, or nothing about the map."""

STOKES = (("CTYPE3", "STOKES"), ("CRPIX3", 1.0), ("CRVAL3", 1.0), ("CDELT3", 1.0))
"""Three images without a header are I, Q and U."""

_TYPES = [np.dtype(kind) for kind in ("u1", "i2", "i4", "i8", "f4", "f8")]
"""Types of numbers that FITS has."""


@dataclass(frozen=True, eq=False, repr=False)
class ArrayMap:
    """An image in memory, or a HEALPix table.

    Attributes
    ----------
    values
        (ny, nx), or with more axes; a copy that cannot be changed. Of a table an empty array.
    header
        FITS keywords: unit, world coordinates, beam.
    table
        The `astropy.io.fits.BinTableHDU` of a HEALPix map, else None.
    given
        Hash of what was given, before world coordinates were added; empty: it is as it was given.
    """

    NOUN: ClassVar[str] = "an array"

    values: NDArray[Any]
    header: Header
    table: Any = None
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
        if isinstance(value, list) and any(hasattr(hdu, "header") for hdu in value):
            raise mistake(
                "map takes one HDU, not a list of them", f"choose one: map=hdus[{_first(value)}]"
            )
        if hasattr(value, "header") and hasattr(value, "data"):
            return cls._of_hdu(value)
        cards: list[tuple[str, Any]] = []
        if hasattr(value, "unit") and hasattr(value, "value"):
            value, unit = _in_known_unit(value)
            if unit:
                cards.append(("BUNIT", unit))
        if isinstance(value, np.ma.MaskedArray):
            value = np.ma.filled(value.astype(np.float64), np.nan)
        values = np.array(value)  # a copy: what becomes of the user's array does not matter
        if values.dtype.kind not in "fiu" or values.dtype.itemsize > 8:
            raise mistake(f"expected an array of numbers, got {value!r:.60}")
        if values.ndim == 1:
            cure = (
                "give a HEALPix map as a table HDU, or write it with healpy.write_map and give"
                " file="
            )
            raise mistake(
                f"expected an image (ny, nx), got an array of shape {values.shape}; {cure}"
            )
        if values.ndim < 2 or not values.size:
            raise mistake(f"expected an image (ny, nx), got an array of shape {values.shape}")
        if values.ndim == 3 and len(values) == 3:
            cards += STOKES
        return cls._image(values, Header(cards))

    @classmethod
    def _of_hdu(cls, hdu: Any) -> ArrayMap:
        if is_healpix(hdu):
            return cls(np.zeros((0, 0)), _cards(hdu.header), hdu.copy())
        if hdu.data is None or not getattr(hdu, "is_image", False):
            raise mistake("the HDU holds neither an image nor a HEALPix table")
        values = np.array(hdu.data)
        if values.ndim < 2:
            raise mistake(
                f"expected an image of two axes or more, got an HDU of shape {values.shape}"
            )
        return cls._image(values, _cards(hdu.header))

    @classmethod
    def _image(cls, values: NDArray[Any], header: Header) -> ArrayMap:
        if values.dtype.newbyteorder("=") not in _TYPES:
            values = values.astype(np.float64)  # types that FITS does not know
        values = np.ascontiguousarray(values, values.dtype.newbyteorder("="))
        values.flags.writeable = False
        return cls(values, header)

    @cached_property
    def digest(self) -> str:
        """Hash of the numbers and of the header."""
        found = hashlib.blake2b(digest_size=8)
        found.update(
            repr((self.values.dtype.str, self.values.shape, sorted(self.header.items()))).encode()
        )
        found.update(
            (self.values if self.table is None else np.ascontiguousarray(self.table.data)).data
        )
        return found.hexdigest()

    @property
    def name(self) -> str:
        """Name in messages: ``array of 64 x 48``."""
        if self.table is not None:
            return "HEALPix table in memory"
        return f"array of {' x '.join(str(n) for n in reversed(self.values.shape))}"

    @property
    def nbytes(self) -> int:
        return self.values.nbytes

    def with_wcs(self, wcs: WorldCoordinates) -> ArrayMap:
        """The image with these world coordinates."""
        header = joined(self.header, Header(wcs.items()))
        return ArrayMap(self.values, header, self.table, self.given or self.digest)

    @property
    def text(self) -> str:
        """Entry of the log: ``array of 64 x 48, float64, hash 0123456789abcdef``."""
        kind = "" if self.table is not None else f", {self.values.dtype.name}"
        return f"{self.name}{kind}, hash {self.given or self.digest}"

    def record(self) -> dict[str, Any]:
        """Shape, type, unit and hash, for products."""
        unit = {"unit": self.header["BUNIT"]} if "BUNIT" in self.header else {}
        shape = (
            {"healpix": int(self.header.get("NSIDE") or 0)}
            if self.table is not None
            else {"array": list(self.values.shape)}
        )
        return {**shape, "type": self.values.dtype.name, **unit, "hash": self.digest}

    def write(self, path: Path) -> None:
        """Write a FITS file that reads back to the same bits: header values are rounded as astropy
        does, in memory too.

        The key `GIVEN` says what it was.
        """
        made = (
            fits.PrimaryHDU(self.values, self.header) if self.table is None else self.table.copy()
        )
        made.header[GIVEN] = self.text
        made.writeto(path, overwrite=True)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, ArrayMap) and self.digest == other.digest

    def __hash__(self) -> int:
        return hash(self.digest)

    def __repr__(self) -> str:
        return f"<{self.name}, hash {self.digest}>"

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        written = core_schema.plain_serializer_function_ser_schema(
            lambda found: found.record(), when_used="json"
        )
        return core_schema.no_info_plain_validator_function(cls.parse, serialization=written)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: Any, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "null"}


class WorldCoordinates(dict[str, Any]):
    """The FITS keywords of an astropy `WCS`, a header or a mapping."""

    NOUN: ClassVar[str] = "an astropy WCS"

    shape: tuple[int, ...] | None = None
    """(ny, nx) of the image that they are made for; None: not known."""

    @classmethod
    def parse(cls, value: Any) -> WorldCoordinates:
        """Raises the error of `mistake` for anything else."""
        if isinstance(value, cls):
            return value
        shape = None
        if hasattr(value, "to_header") and hasattr(value, "wcs"):
            shape = getattr(value, "pixel_shape", None)
            value, shape = exact_header(value), None if shape is None else tuple(reversed(shape))
        elif not isinstance(value, Mapping) and not hasattr(value, "cards"):
            raise mistake(f"expected an astropy WCS or FITS keywords, got {value!r:.60}")
        made = cls(_cards(value))
        made.shape = shape
        return made

    @classmethod
    def __get_pydantic_core_schema__(
        cls, source: Any, handler: GetCoreSchemaHandler
    ) -> core_schema.CoreSchema:
        written = core_schema.plain_serializer_function_ser_schema(dict, when_used="json")
        return core_schema.no_info_plain_validator_function(cls.parse, serialization=written)

    @classmethod
    def __get_pydantic_json_schema__(
        cls, schema: Any, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        return {"type": "null"}


def check_shape(array: ArrayMap, wcs: WorldCoordinates) -> None:
    """Raise ValueError for world coordinates of another image."""
    if (
        wcs.shape is not None
        and array.table is None
        and tuple(wcs.shape[-2:]) != array.values.shape[-2:]
    ):
        ours, theirs = (
            " x ".join(str(n) for n in reversed(shape[-2:]))
            for shape in (array.values.shape, wcs.shape)
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
        scale, factor = parse_unit(given, place="unit")
        own_scale, own_factor = parse_unit(own, place="map", temperature_scale=scale)
    except InputError:
        return  # said when the map is read
    if (scale, factor) != (own_scale, own_factor):
        raise ValueError(
            f"the map is a quantity in {own}, and unit is {given}; convert one of them"
        )


def _cards(header: Any) -> Header:
    """A header without the keys that say how the numbers lie in a file."""
    made: dict[str, Any] = {}
    for key in dict.fromkeys(header):
        if (
            not key
            or key.upper() in _STRUCTURE
            or key.upper().startswith("NAXIS")
            or " " in key
            or len(key) > 8
        ):
            continue
        value = header[key]
        if isinstance(value, bool | int | float | str | np.bool_ | np.integer | np.floating):
            if not isinstance(value, str) and not math.isfinite(value):
                continue
            made[key.upper()] = value.item() if isinstance(value, np.generic) else value
    return Header(made.items())


def _in_known_unit(quantity: Any) -> tuple[NDArray[Any], str]:
    """The numbers of a quantity and their unit as headers write it; an intensity becomes MJy/sr.
    Empty: a pure number.
    """
    text = str(quantity.unit).strip()
    try:
        parse_unit(text, place="map", temperature_scale="K_RJ")
    except InputError:
        if text and quantity.unit.is_equivalent("MJy/sr"):
            return np.asarray(quantity.to_value("MJy/sr")), "MJy/sr"
        if text and quantity.unit.is_equivalent("K"):
            return np.asarray(quantity.to_value("K")), "K"
        if text:
            raise mistake(
                f"'{text}' is no unit of a map of the sky; use K, Jy/beam, Jy/pix or MJy/sr"
            ) from None
    return np.asarray(quantity.value), text


def _first(hdus: list[Any]) -> int:
    return next((k for k, hdu in enumerate(hdus) if getattr(hdu, "data", None) is not None), 0)
