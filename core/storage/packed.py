"""Compressed files from elsewhere: unpacked piece by piece, up to a stated size and no further."""

from __future__ import annotations

import io
import os
import zipfile
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import IO, Any

from ..errors import InputError
from .files import check_memory

UNPACKED_MAX = 4_000_000_000
"""Bytes that a compressed FITS file, or the tiles of an image, may unpack to."""
TEXT_MAX = 16_000_000
"""Bytes of a table of numbers as text, unpacked."""

_PACKED = {
    b"\x1f\x8b\x08": "gzip",
    b"BZh": "bz2",
    b"\xfd7z": "lzma",
    b"\x1f\x9d\x90": "uncompresspy",
}
_BY_NAME = {".gz": "gzip", ".bz2": "bz2", ".xz": "lzma", ".lzma": "lzma"}
PIECE = 1 << 20


def too_large(size: int, most: int, place: str, *, least: bool) -> InputError:
    """That something unpacks to ``size`` bytes or, ``least``, to no less."""
    return InputError(
        f"unpacks to {'at least ' if least else ''}{size / 1e9:.4g} GB; reading stops at"
        f" {most / 1e9:.4g} GB",
        place=place,
        cure=(
            "where that is its true size, unpack it before; else it is corrupt or made to harm:"
            " make it again"
        ),
    )


def stream(path: str | os.PathLike[str], place: str) -> tuple[IO[bytes], bool]:
    """The file's content, unpacked while it is read, and whether it was compressed. The caller
    closes it.

    The one file in a zip archive is unpacked into memory (`InputError` where it is larger than
    `UNPACKED_MAX`).
    """
    with open(path, "rb") as raw:
        magic = raw.read(4)
    if magic == b"PK\x03\x04":
        return io.BytesIO(_unzipped(path, place)), True
    unpack = next((m for start, m in _PACKED.items() if magic.startswith(start)), "")
    if unpack == "uncompresspy":
        if find_spec(unpack) is None:
            raise InputError(
                "compress (.Z) needs the package uncompresspy",
                place=place,
                cure="unpack it: uncompress FILE",
            )
        file: Any = import_module(unpack).LZWFile(path)
        return file, True
    file = import_module(unpack).open(path, "rb") if unpack else open(path, "rb")  # noqa: SIM115
    return file, bool(unpack)


def text(path: Path, place: str) -> str:
    """A table's text; compressed where its suffix is one of gzip, bzip2 or xz. `InputError` where
    it is longer than `TEXT_MAX`.

    Other failures are OSError or ValueError.
    """
    import lzma
    import zlib

    unpack = _BY_NAME.get(path.suffix.lower(), "")
    try:
        with import_module(unpack).open(path, "rb") if unpack else open(path, "rb") as file:
            content: bytes = file.read(TEXT_MAX + 1)
    except (EOFError, OSError, zlib.error, lzma.LZMAError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # the file, not what is in it
            raise
        raise ValueError(f"it cannot be unpacked ({error})") from error
    if len(content) > TEXT_MAX:
        raise InputError(
            f"{'unpacks to' if unpack else 'has'} more than {TEXT_MAX / 1e6:g} MB, where reading"
            " stops",
            place=place,
            cure="give a table of numbers; a coarser one where it is that long",
        )
    return content.decode("utf-8-sig")


def _unzipped(path: str | os.PathLike[str], place: str) -> bytes:
    with zipfile.ZipFile(path) as archive:
        members = archive.infolist()
        if len(members) != 1:
            raise OSError(f"a zip archive of {len(members)} files, not one")
        size = members[0].file_size
        if size > UNPACKED_MAX:
            raise too_large(size, UNPACKED_MAX, place, least=False)
        check_memory(size, "the file in the zip archive", place)
        with archive.open(members[0]) as file:
            return b"".join(iter(lambda: file.read(PIECE), b""))
