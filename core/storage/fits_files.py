"""FITS files from elsewhere: opened for reading, and as long as their headers promise."""

from __future__ import annotations

import contextlib
import io
import math
import os
import re
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from ..errors import InputError
from . import packed
from .files import check_memory, reading

COMPRESSED = (".gz", ".bz2", ".xz", ".z", ".zip")
"""Suffixes of files whose length says nothing about what is in them."""

FIELDS_MAX = 999
"""Axes of an array, and columns of a table, that FITS 4.0 allows (4.4.1, 7.3.1); astropy loops over
what is claimed.
"""
HEADER_MAX = 10_000_000
"""Bytes of one header: 125 000 cards."""


@contextlib.contextmanager
def opened(
    path: str | os.PathLike[str], place: str, cure: str, kind: str = "FITS"
) -> Iterator[Any]:
    """An `astropy.io.fits.HDUList` to read from; whatever goes wrong in the body is an `InputError`
    about ``place``.
    """
    with reading(place, kind, cure):
        from astropy.io import fits
        from astropy.utils.exceptions import AstropyWarning

        source = _survey(path, place)
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", AstropyWarning)
            with fits.open(source, memmap=False, ignore_missing_simple=False) as hdus:
                yield hdus


def check_size(path: str | os.PathLike[str], hdu: Any, place: str, *, whole: bool = True) -> None:
    """Before data are read: OSError where the file ends before them, `InputError` where, read
    ``whole``, they need more memory than is free."""
    size = _data_bytes(hdu.header)
    tiled = hdu.header.get("ZIMAGE") or type(hdu).__name__ == "CompImageHDU"
    if tiled and size > packed.UNPACKED_MAX:
        raise packed.too_large(size, packed.UNPACKED_MAX, place, least=False)
    if whole:
        check_memory(size, "the array or table", place)
    info = hdu.fileinfo()
    if info is None or tiled or Path(path).suffix.lower() in COMPRESSED:
        return
    needed, found = info["datLoc"] + size, os.path.getsize(path)
    if found < needed:
        raise OSError(
            f"the file is truncated: {found} bytes, its header promises at least {needed}"
        )


def _survey(path: str | os.PathLike[str], place: str) -> Any:
    """What astropy may open: the path, or what was in an xz file or a zip archive (astropy would
    unpack it to a temporary file).

    Refused are headers that would keep a reader busy without end, and compressed files whose
    headers lead beyond `packed.UNPACKED_MAX` (`InputError`); what else is wrong is left to astropy.
    """
    content, compressed = packed.stream(path, place)
    with content as file:
        while size := _next_header(file, place):
            end = file.tell() - (-size // 2880) * 2880 - 2880
            if compressed and end > packed.UNPACKED_MAX:
                raise packed.too_large(end, packed.UNPACKED_MAX, place, least=True)
            file.seek(end)
        if type(file).__name__ == "LZMAFile":  # astropy 6 does not know xz
            file.seek(0)
            return io.BytesIO(file.read(packed.UNPACKED_MAX))
        return io.BytesIO(file.getvalue()) if isinstance(file, io.BytesIO) else path


_END = re.compile(rb"END( {0,76}[^A-Z0-9_-]|$)")
"""What astropy takes for the end of a header."""
_NUMBER = re.compile(rb"(NAXIS\d{0,3}|TFIELDS|BITPIX|PCOUNT|GCOUNT) *= *(-?\d+)")


def _next_header(file: IO[bytes], place: str) -> int:
    """Read one header; 2880 bytes more than the data behind it, 0 at the end of the file."""
    found: dict[bytes, int] = {}
    for _ in range(0, HEADER_MAX, 2880):
        block = file.read(2880)
        for card in (block[k : k + 80] for k in range(0, len(block), 80)):
            if match := _NUMBER.match(card):
                key, value = match[1], int(match[2][:20])
                found.setdefault(key, value)
                if key in (b"NAXIS", b"TFIELDS") and value > FIELDS_MAX:
                    message = (
                        f"{key.decode()} = {value}, more than the {FIELDS_MAX} that FITS allows"
                    )
                    raise InputError(
                        message, place=place, cure="the file is corrupt: copy or make it again"
                    )
            if _END.match(card):
                size = math.prod(
                    found.get(b"NAXIS%d" % k, 0) for k in range(1, found.get(b"NAXIS", 0) + 1)
                )
                size = size if found.get(b"NAXIS", 0) > 0 else 0
                size = (
                    abs(found.get(b"BITPIX", 8))
                    // 8
                    * found.get(b"GCOUNT", 1)
                    * (size + found.get(b"PCOUNT", 0))
                )
                if size < 0:  # astropy would go back in the file and never come to its end
                    message = "a header claims data of a negative length (NAXISn, PCOUNT, GCOUNT)"
                    raise InputError(
                        message, place=place, cure="the file is corrupt: copy or make it again"
                    )
                return 2880 + size if size < 2**62 else 0
        if len(block) < 2880:
            return 0
    raise InputError(
        f"a header is longer than {HEADER_MAX / 1e6:g} MB",
        place=place,
        cure="the file is corrupt: copy or make it again",
    )


def _data_bytes(header: Any) -> int:
    size = abs(int(header.get("BITPIX", 8))) // 8
    for k in range(1, int(header.get("NAXIS", 0)) + 1):
        size *= int(header.get(f"NAXIS{k}", 0))
    if size < 0 or int(header.get("NAXIS", 0)) > 999:
        raise ValueError("the axes have impossible lengths")
    return size
