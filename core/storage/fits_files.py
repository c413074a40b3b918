"""FITS files: headers and images to be written, files from elsewhere opened for reading."""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import warnings
from collections.abc import Iterable, Iterator
from typing import IO, Any

import numpy as np
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning
from numpy.typing import NDArray

from ..errors import InputError
from . import files
from .files import AnyPath, check_memory, reading

FIELDS_MAX = 999
"""Axes of an array, and columns of a table, that FITS 4.0 allows (4.4.1, 7.3.1); astropy loops over
every claimed one.
"""
HEADER_MAX = 10_000_000
"""Bytes of one header: 125 000 cards."""
BLOCK = 2880
CARD = 80
COMMENTARY = {"", "COMMENT", "HISTORY"}
"""Keys of cards without a value."""
PIECE = 1 << 20
"""Bytes of an image that are converted at a time."""

# --------------------------------------------------------------------------------------------------
# writing


def card(key: str, value: Any, comment: str = "") -> fits.Card:
    """A card with all digits of a number; astropy cuts it after 20 letters.

    Raises ValueError for NaN, infinity and text outside printable ASCII.
    """
    digits = repr(float(value)) if isinstance(value, float) and math.isfinite(value) else ""
    text = f"{key:8}= {digits.upper()}" + (f" / {comment}" if comment else "")
    if len(digits) > 20:
        return fits.Card.fromstring(text[:CARD])
    room = CARD - 3 - max(30, len(str(fits.Card(key, value)).rstrip()))
    return fits.Card(key, value, comment[:room] if room > 0 else comment)


def header_of(cards: Iterable[tuple[Any, ...]] = (), history: Iterable[str] = ()) -> fits.Header:
    """A header of (key, value) and (key, value, comment), and lines of HISTORY."""
    made = fits.Header([card(*one) for one in cards])
    for line in history:
        made.add_history(line or " ")
    return made


def joined(*headers: fits.Header) -> fits.Header:
    """A header with the cards of some headers; the last card of each key holds."""
    made = fits.Header()
    for header in headers:
        for key in set(header.keys()) - COMMENTARY:
            made.remove(key, ignore_missing=True)
        made.extend(header.copy(), unique=False)
    return made


def write_image(
    file: IO[bytes],
    header: fits.Header,
    values: NDArray[Any],
    dtype: Any = None,
) -> None:
    """Append an image to an open file: the primary one, or an extension.

    ``values`` (ny, nx), or with more axes, are converted piece by piece to ``dtype`` (default:
    their own).
    """
    kind = np.dtype(values.dtype if dtype is None else dtype).newbyteorder(">")
    form = np.broadcast_to(np.zeros((), kind), values.shape)
    image = (fits.ImageHDU if file.tell() else fits.PrimaryHDU)(form, header)
    if not file.tell():
        image.header.set("EXTEND", True, after=f"NAXIS{values.ndim}")
    file.write(image.header.tostring().encode("ascii"))
    rows = max(1, PIECE // max(1, kind.itemsize * math.prod(values.shape[1:])))
    for k in range(0, values.shape[0], rows):
        file.write(values[k : k + rows].astype(kind).tobytes())
    file.write(bytes(-values.size * kind.itemsize % BLOCK))


def table_bytes(table: fits.BinTableHDU) -> bytes:
    """A table as it stands in a file behind the primary header."""
    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(stream)
    return stream.getvalue()[BLOCK:]


# --------------------------------------------------------------------------------------------------
# reading


@contextlib.contextmanager
def opened(
    path: AnyPath,
    place: str,
    cure: str,
    kind: str = "FITS",
) -> Iterator[Any]:
    """An `astropy.io.fits.HDUList` to read from; each failure of the body is an `InputError` about
    ``place``.

    A compressed file is unpacked into memory, up to `files.UNPACKED_MAX`. Headers that would keep
    astropy busy without end are refused.
    """
    with reading(place, kind, cure), warnings.catch_warnings():
        warnings.simplefilter("ignore", AstropyWarning)
        content = None
        if files.is_packed(path):
            content = files.unpacked(path, place, files.UNPACKED_MAX)
        with io.BytesIO(content) if content is not None else open(path, "rb") as file:
            while (size := _next_header(file, place)) is not None:
                file.seek(-(-size // BLOCK) * BLOCK, os.SEEK_CUR)
        source = path if content is None else io.BytesIO(content)
        with fits.open(source, memmap=False, ignore_missing_simple=False) as hdus:
            yield hdus


def check_size(hdu: Any, place: str, *, whole: bool = True) -> None:
    """Before data are read: OSError if the file ends before them, `InputError` if, read ``whole``,
    they need more memory than is free."""
    size = _data_bytes(hdu.header)
    tiled = hdu.header.get("ZIMAGE") or type(hdu).__name__ == "CompImageHDU"
    if tiled and size > files.UNPACKED_MAX:
        most = f"reading stops at {files.UNPACKED_MAX / 1e9:.4g} GB"
        raise files.too_large(f"unpacks to {size / 1e9:.4g} GB; {most}", place)
    if whole:
        check_memory(size, "the array or table", place)
    info = hdu.fileinfo()
    if info is None or tiled:
        return
    needed = info["datLoc"] + size
    found = info["file"].size
    if found < needed:
        raise OSError(
            f"the file is truncated: {found} bytes, its header promises at least {needed}"
        )


_END = re.compile(rb"END( {0,76}[^A-Z0-9_-]|$)")
"""The end of a header, as astropy recognizes it."""
_NUMBER = re.compile(rb"(NAXIS\d{0,3}|TFIELDS|BITPIX|PCOUNT|GCOUNT) *= *([-+]?) *(\d+)")


def _next_header(file: IO[bytes], place: str) -> int | None:
    """Read one header; the bytes of the data behind it, None at the end of the file."""
    found: dict[bytes, int] = {}
    for _ in range(0, HEADER_MAX, BLOCK):
        block = file.read(BLOCK)
        for line in (block[k : k + CARD] for k in range(0, len(block), CARD)):
            if match := _NUMBER.match(line):
                key, value = match[1], int(match[2] + match[3][:20])  # astropy takes "- 21"
                found.setdefault(key, value)
                if key in (b"NAXIS", b"TFIELDS") and value > FIELDS_MAX:
                    raise _corrupt(
                        f"{key.decode()} = {value}, more than the {FIELDS_MAX} that FITS allows",
                        place,
                    )
            if _END.match(line):
                axes = range(1, found.get(b"NAXIS", 0) + 1)
                size = math.prod(found.get(b"NAXIS%d" % k, 0) for k in axes) if axes else 0
                each = abs(found.get(b"BITPIX", 8)) // 8 * found.get(b"GCOUNT", 1)
                size = each * (size + found.get(b"PCOUNT", 0))
                if size < 0:  # astropy would go back in the file and never come to its end
                    raise _corrupt(
                        "a header claims data of a negative length (NAXISn, PCOUNT, GCOUNT)",
                        place,
                    )
                return size if size < 2**62 else None
        if len(block) < BLOCK:
            return None
    raise _corrupt(f"a header is longer than {HEADER_MAX / 1e6:g} MB", place)


def _corrupt(message: str, place: str) -> InputError:
    return InputError(message, place=place, cure="the file is corrupt: copy or make it again")


def _data_bytes(header: Any) -> int:
    size = abs(int(header.get("BITPIX", 8))) // 8
    for k in range(1, int(header.get("NAXIS", 0)) + 1):
        size *= int(header.get(f"NAXIS{k}", 0))
    if size < 0 or int(header.get("NAXIS", 0)) > FIELDS_MAX:
        raise ValueError("the axes have impossible lengths")
    return size
