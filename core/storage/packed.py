"""Compressed files from elsewhere, unpacked into memory up to a stated size and no further."""

from __future__ import annotations

import lzma
import os
import zipfile
import zlib
from importlib import import_module
from pathlib import Path
from typing import IO, Any

from .. import machine
from ..errors import InputError

UNPACKED_MAX = 4_000_000_000
"""Bytes that a compressed FITS file, or the tiles of an image, may unpack to."""
TEXT_MAX = 16_000_000
"""Bytes of a table of numbers as text, unpacked."""

_PACKED = {b"\x1f\x8b\x08": "gzip", b"BZh": "bz2", b"\xfd7z": "lzma", b"PK\x03\x04": "zip"}
_COMPRESS = b"\x1f\x9d\x90"


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


def is_packed(path: str | os.PathLike[str]) -> bool:
    """True for a file that begins as gzip, bzip2, xz, zip or compress do."""
    with open(path, "rb") as file:
        return file.read(4).startswith((*_PACKED, _COMPRESS))


def unpacked(path: str | os.PathLike[str], place: str, most: int) -> bytes:
    """The content of a file, unpacked if it is compressed.

    Raises `InputError` for more than ``most`` bytes or than memory has free, ValueError for content
    that cannot be unpacked, and OSError.
    """
    with open(path, "rb") as raw:
        magic = raw.read(4)
    if magic.startswith(_COMPRESS):
        raise InputError("is packed with compress", place=place, cure="unpack it: uncompress FILE")
    most = min(most, machine.available_memory())
    kind = next((kind for start, kind in _PACKED.items() if magic.startswith(start)), "")
    try:
        with _opened(path, kind) as file:
            content = file.read(most + 1)
    except (EOFError, OSError, zlib.error, lzma.LZMAError, zipfile.BadZipFile) as error:
        if isinstance(error, OSError) and error.errno is not None:  # the file, not its content
            raise
        raise ValueError(f"it cannot be unpacked ({error})") from error
    if len(content) > most:
        what = "unpacks to" if kind else "has"
        raise too_large(f"{what} more than {most / 1e6:g} MB, where reading stops", place)
    return content


def _opened(path: str | os.PathLike[str], kind: str) -> IO[bytes]:
    if kind != "zip":
        file: Any = import_module(kind or "io").open(path, "rb")
        return file  # type: ignore[no-any-return]
    archive = zipfile.ZipFile(path)
    if len(members := archive.infolist()) != 1:
        raise ValueError(f"a zip archive of {len(members)} files, not one")
    return archive.open(members[0])


def text(path: Path, place: str) -> str:
    """The text of a table, unpacked.

    Raises `InputError` for a text longer than `TEXT_MAX`, ValueError and OSError.
    """
    return unpacked(path, place, TEXT_MAX).decode("utf-8-sig")
