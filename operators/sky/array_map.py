"""Maps that are given as arrays in Python: numpy arrays, astropy quantities and FITS units in
memory.

Each becomes the unit of a FITS file that would hold it, so that everything behind it is the same:
units, beams, projections, missing pixels.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray

from zonda.core.configuration.diagnostics import TextValue, mistake
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
STOKES = {"CTYPE3": "STOKES", "CRPIX3": 1.0, "CRVAL3": 1.0, "CDELT3": 1.0}
"""Three images without a header are I, Q and U."""
TYPES = ("uint8", "int16", "int32", "int64", "float32", "float64")
"""Types of numbers that FITS has."""


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
            cards, value = _cards(value.header), value.data
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
            cards |= STOKES
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
