"""Compressed files from elsewhere, unpacked into memory up to a stated size and no further."""

from __future__ import annotations

import bz2
import gzip
import lzma
import os
import zipfile
import zlib
from pathlib import Path
from typing import IO, Any, Literal

from .. import machine
from ..errors import InputError

UNPACKED_MAX = 4_000_000_000
"""Bytes that a compressed FITS file, or the tiles of an image, may unpack to."""
TEXT_MAX = 16_000_000
"""Bytes of a table of numbers as text, unpacked."""


def _only_member(path: str | os.PathLike[str], mode: Literal["rb"]) -> IO[bytes]:
    archive = zipfile.ZipFile(path)
    if len(members := archive.infolist()) != 1:
        raise ValueError(f"a zip archive of {len(members)} files, not one")
    return archive.open(members[0])


def _compress(path: str | os.PathLike[str], mode: str) -> IO[bytes]:
    raise ValueError("it is packed with compress; unpack it first")


OPENERS: dict[bytes, Any] = {
    b"\x1f\x9d\x90": _compress,
    b"\x1f\x8b\x08": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7z": lzma.open,
    b"PK\x03\x04": _only_member,
}
"""By how a file begins: what opens it."""


def too_large(message: str, place: str) -> InputError:
    """Error about content that unpacks to more than is read."""
    return InputError(
        message,
        place=place,
        cure=(
            "where that is its true size, unpack it before; else it is corrupt or made to harm:"
            " make it again"
        ),
    )


def _opener(path: str | os.PathLike[str]) -> Any:
    with open(path, "rb") as file:
        magic = file.read(4)
    return next((opener for begin, opener in OPENERS.items() if magic.startswith(begin)), open)


def is_packed(path: str | os.PathLike[str]) -> bool:
    """True for a file that begins as gzip, bzip2, xz or zip do."""
    return _opener(path) is not open


def unpacked(path: str | os.PathLike[str], place: str, most: int) -> bytes:
    """The content of a file, unpacked if it is compressed.

    Raises `InputError` for more than ``most`` bytes or than memory has free, ValueError for content
    that cannot be unpacked, and OSError.
    """
    most = min(most, machine.available_memory())
    opener = _opener(path)
    try:
        with opener(path, "rb") as file:
            content: bytes = file.read(most + 1)
    except (EOFError, OSError, zlib.error, lzma.LZMAError, zipfile.BadZipFile) as error:
        if isinstance(error, OSError) and error.errno is not None:  # the file, not its content
            raise
        raise ValueError(f"it cannot be unpacked ({error})") from error
    if len(content) > most:
        what = "has" if opener is open else "unpacks to"
        raise too_large(f"{what} more than {most / 1e6:g} MB, where reading stops", place)
    return content


def text(path: Path, place: str, most: int | None = None) -> str:
    """The text of a table, unpacked.

    Raises `InputError` for a text longer than ``most`` (`TEXT_MAX`), ValueError and OSError.
    """
    return unpacked(path, place, most or TEXT_MAX).decode("utf-8-sig")
