"""Atomic writes, errors of files with a cure, and compressed files, which are unpacked into memory
up to a stated size.
"""

from __future__ import annotations

import bz2
import contextlib
import errno
import gzip
import lzma
import os
import re
import secrets
import stat
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any, Literal

from .. import machine
from ..errors import InputError, OutputError, ZondaError

AnyPath = str | os.PathLike[str]
"""Path of a file or folder."""
_CURES = {
    errno.ENOSPC: ("no space left on the disk", "free some space or choose another output folder"),
    errno.EDQUOT: ("the disk quota is used up", "free some space or choose another output folder"),
    errno.EFBIG: (
        "the file grew beyond what this file system allows",
        "choose another output folder or write fewer streams",
    ),
    errno.EACCES: ("permission denied", "choose an output folder that you may write to"),
    errno.EPERM: ("permission denied", "choose an output folder that you may write to"),
    errno.EROFS: ("the file system is read-only", "choose another output folder"),
    errno.EISDIR: ("there is a folder of that name", "remove it or choose another output folder"),
    errno.ENOTDIR: (
        "a part of the path is a file, not a folder",
        "remove that file or choose another output folder",
    ),
    errno.EEXIST: ("there is a file of that name", "remove it or choose another output folder"),
    errno.ENOENT: (
        "the folder does not exist",
        "it may have been removed during the run: make it again or choose another one",
    ),
    errno.ENAMETOOLONG: ("the name is too long", "choose a shorter name"),
}


MOST_AT_ONCE = 4
"""Files that are written at a time."""

RECORDS: list[Any] = []
"""Records (`output_folder.Record`) of the output folders of runs at work."""


def output_error(error: OSError, path: AnyPath) -> OutputError:
    """The `OutputError` that tells the user what an operating-system error on ``path`` means and
    how to mend it.

    HDF5 reports a full disk without an error number: its message text is read instead.
    """
    number = error.errno
    if number is None and (match := re.search(r"errno = (\d+)", str(error))):
        number = int(match.group(1))
    if number is None and "no space left" in str(error).lower():
        number = errno.ENOSPC
    fallback = (
        str(error).splitlines()[0] if str(error) else type(error).__name__,
        "choose another output folder",
    )
    cause, cure = _CURES.get(number or 0, fallback)
    return OutputError(f"cannot be written: {cause}", place=str(path), cure=cure)


@contextlib.contextmanager
def writing(path: AnyPath) -> Iterator[None]:
    """Raise an `OutputError` about ``path`` for every operating-system error in the body."""
    try:
        yield
    except OSError as error:
        raise output_error(error, path) from error


@contextlib.contextmanager
def reading(place: str, kind: str, cure: str) -> Iterator[None]:
    """Raise an `InputError` for whatever reading a file of foreign bytes raises in the body.

    Libraries meet corrupt bytes with nearly every exception there is, so all are caught: keep only
    the reading in the body.

    Parameters
    ----------
    place
        The file, as messages call it.
    kind
        What it should be: ``FITS``.
    cure
        What to do where it is something else.
    """
    try:
        yield
    except ZondaError:
        raise
    except Exception as error:
        message = f"cannot be read as {kind}: {first_line(error)}"
        if isinstance(error, FileNotFoundError):
            message = "there is no such file"
            cure = _whereabouts(error.filename)
        elif isinstance(error, IsADirectoryError):
            message = "is a folder, not a file"
            cure = "give the file's path"
        elif isinstance(error, PermissionError):
            message = "permission denied"
            cure = "make the file readable"
        elif isinstance(error, KeyError):
            message = f"is incomplete or corrupt: {error.args[0] if error.args else ''}"
        elif isinstance(error, MemoryError):
            message = "needs more memory than there is"
        raise InputError(message, place=place, cure=cure) from error


def _whereabouts(path: str | bytes | int | None) -> str:
    """Cure for a path that does not exist: a similar name in its folder, or the missing folder."""
    otherwise = "check the path; if it was there before, it has been moved or removed"
    if not isinstance(path, (str, bytes)):
        return otherwise
    file = Path(os.fsdecode(path)).absolute()
    if not file.parent.is_dir():
        return f"check the path: there is no folder {file.parent}"
    from ..configuration.diagnostics import nearest  # most runs miss no file

    with contextlib.suppress(OSError):
        return nearest(file.name, os.listdir(file.parent), otherwise)
    return otherwise


@contextlib.contextmanager
def own_data(path: Path) -> Iterator[Any]:
    """A numpy archive that comes with zonda. Raises `InputError` where it is missing or damaged
    (its checksums are tested).
    """
    import numpy as np

    cure = "the installation is damaged: pip install --force-reinstall zonda"
    try:
        with (
            reading(f"data file {path}", "a numpy archive", cure),
            np.load(path, allow_pickle=False) as archive,
        ):
            yield archive
    except InputError as error:
        raise InputError(error.message, place=error.place, cure=cure) from error


def first_line(error: Exception) -> str:
    """The line of an error's text that says why: wcslib begins with the line of its own source
    code.
    """
    lines = [
        line for line in str(error).splitlines() if line.strip() and not line.startswith("ERROR ")
    ]
    return (lines or [type(error).__name__])[0].strip().rstrip(".")[:300]


def check_memory(size: int, what: str, place: str) -> None:
    """Refuse to read ``what`` of ``size`` bytes where that is more than the machine has free
    (`InputError`).
    """
    free = machine.available_memory()
    if size > free:
        raise InputError(
            f"{what} needs {size / 1e9:.3g} GB of memory, {free / 1e9:.3g} GB are free",
            place=place,
            cure=(
                "if the file should be smaller it is corrupt: copy it again; else give a smaller"
                " one or a larger machine"
            ),
        )


UNPACKED_MAX = 4_000_000_000
"""Bytes that a compressed FITS file, or the tiles of an image, may unpack to."""


def _only_member(path: AnyPath, mode: Literal["rb"]) -> IO[bytes]:
    archive = zipfile.ZipFile(path)
    if len(members := archive.infolist()) != 1:
        raise ValueError(f"a zip archive of {len(members)} files, not one")
    return archive.open(members[0])


def _compress(path: AnyPath, mode: str) -> IO[bytes]:
    raise ValueError("it is packed with compress; unpack it first")


OPENERS: dict[bytes, Any] = {
    b"\x1f\x9d\x90": _compress,
    b"\x1f\x8b\x08": gzip.open,
    b"BZh": bz2.open,
    b"\xfd7z": lzma.open,
    b"PK\x03\x04": _only_member,
}
"""Functions that open a file, by its first bytes."""


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


def check_kind(path: AnyPath) -> None:
    """Raise ValueError for a pipe or a device, whose reader might wait for ever, and OSError for a
    path that leads nowhere.
    """
    mode = os.stat(path).st_mode
    if not (stat.S_ISREG(mode) or stat.S_ISDIR(mode)):
        raise ValueError("it is a pipe or a device, not a file")


def _opener(path: AnyPath) -> Any:
    check_kind(path)
    with open(path, "rb") as file:
        magic = file.read(4)
    return next((opener for begin, opener in OPENERS.items() if magic.startswith(begin)), open)


def is_packed(path: AnyPath) -> bool:
    """True for a file that begins as gzip, bzip2, xz or zip do."""
    return _opener(path) is not open


@contextlib.contextmanager
def _unpacking(path: AnyPath) -> Iterator[IO[bytes]]:
    """A file to read from, unpacked if it is compressed. Raises ValueError for content that cannot
    be unpacked, and OSError.
    """
    try:
        with _opener(path)(path, "rb") as file:
            yield file
    except (EOFError, OSError, zlib.error, lzma.LZMAError, zipfile.BadZipFile) as error:
        if isinstance(error, OSError) and error.errno is not None:  # the file, not its content
            raise
        raise ValueError(f"it cannot be unpacked ({error})") from error


def first_bytes(path: AnyPath, size: int = 9) -> bytes:
    """The first bytes of a file's content, unpacked if it is compressed. Raises as `unpacked`."""
    with _unpacking(path) as file:
        return file.read(size)


def unpacked(path: AnyPath, place: str, most: int) -> bytes:
    """The content of a file, unpacked if it is compressed.

    Raises `InputError` for more than ``most`` bytes or than memory has free, ValueError for content
    that cannot be unpacked, and OSError.
    """
    most = min(most, machine.available_memory())
    with _unpacking(path) as file:
        content = file.read(most + 1)
    if len(content) > most:
        what = "unpacks to" if is_packed(path) else "has"
        raise too_large(f"{what} more than {most / 1e6:g} MB, where reading stops", place)
    return content


def temporary_sibling(path: AnyPath) -> Path:
    """A hidden name beside ``path``, with its suffix (writers choose the format by it), that no
    other run uses.
    """
    path = Path(path)
    return path.with_name(
        f".{path.stem[:100]}.{os.getpid()}-{secrets.token_hex(4)}.part{path.suffix}"
    )


def put(path: Path, content: bytes) -> None:
    """Write a file for later runs, whole or not at all, readable by all and written by this user
    alone; raises OSError.

    Unlike a product it need not outlive a crash of the machine: nothing waits for the disk.
    """
    temporary = temporary_sibling(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        temporary.write_bytes(content)
        temporary.chmod(
            0o644
        )  # whatever the umask: compiled code that others may write to is not read
        os.replace(temporary, path)
    except BaseException:
        discard(temporary)
        raise


def open_own(path: AnyPath, flags: int) -> int:
    """Descriptor of a file that zonda alone names, in a folder that others may write to: it follows
    no link and waits for no pipe.

    Raises
    ------
    OutputError
        It is a link, a pipe, a device or a folder.
    OSError
        As `os.open`.
    """
    try:
        opened = os.open(path, flags | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC, 0o644)
        if stat.S_ISREG(os.fstat(opened).st_mode):
            return opened
        os.close(opened)
    except OSError as error:
        if error.errno not in (errno.ELOOP, errno.EMLINK, errno.ENXIO, errno.EISDIR):
            raise
    raise OutputError(
        "is no regular file (a link, a pipe, a device or a folder)",
        place=str(path),
        cure="remove it, if you know who made it, or choose another output folder",
    )


def discard(temporary: Path) -> None:
    """Remove a temporary file; not an error where there is none."""
    with contextlib.suppress(OSError):
        temporary.unlink(missing_ok=True)


@contextlib.contextmanager
def atomic_path(path: AnyPath) -> Iterator[Path]:
    """A temporary sibling of ``path`` to write to: renamed to ``path`` on success, removed on any
    failure or Ctrl-C.

    Raises
    ------
    OutputError
        For every operating-system error in the body (disk full, not writable, a folder in the way),
        with place and cure.
    """
    path = Path(path)
    temporary = temporary_sibling(path)
    try:
        with writing(path):
            make_folder(path.parent)
            if path.is_dir():
                raise IsADirectoryError(errno.EISDIR, os.strerror(errno.EISDIR), str(path))
            yield temporary
            _synchronize(temporary)
            for record in tuple(RECORDS):
                record.add(path, temporary)
            os.replace(temporary, path)
    except BaseException:
        discard(temporary)
        raise


def write_text(path: AnyPath, text: str) -> Path:
    """Write a UTF-8 text file atomically, and return its path."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def product_path(folder: AnyPath, name: str, suffix: str = "") -> Path:
    """Path of a product called ``name`` in ``folder``: it never leaves the folder and is a legal
    file name everywhere.

    Slashes become underscores, other unusual characters dashes; ``../../etc/passwd`` becomes
    ``etc_passwd``.
    """
    stem = re.sub(r"[^\w.+=@-]+", "-", name.replace("\\", "/").replace("/", "_")).strip("._- ")
    if not stem:
        raise OutputError(
            f"{name!r} cannot name a file",
            place=str(folder),
            cure="use letters, digits, '-' and '_'",
        )
    return Path(folder) / f"{stem[:180]}{suffix}"


def make_folder(path: AnyPath) -> Path:
    """Make a folder and those above it; its path. Raises OSError, and `OutputError` where the file
    system takes no new ones.
    """
    folder = Path(path)
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except FileNotFoundError as error:
        above = next(parent for parent in folder.absolute().parents if parent.is_dir())
        cure = "choose another output folder"
        raise OutputError(
            f"cannot be made: {above} takes no new folders",
            place=str(folder),
            cure=cure,
        ) from error
    return folder


def check_output_folder(path: AnyPath) -> Path:
    """Create an output folder and prove that it takes files, before a long run starts; its path.

    Raises
    ------
    OutputError
        Not creatable, not writable, a file in its place, or no space for even a small file.
    """
    folder = Path(path)
    probe = temporary_sibling(
        folder / "probe"
    )  # where a kill leaves one, a campaign finds it by this name
    try:
        with writing(folder):
            make_folder(folder)
            probe.write_bytes(b"zonda")
    finally:
        discard(probe)
    return folder


def _synchronize(path: Path) -> None:
    """Ask the disk to hold the file: some file systems report a full disk only now."""
    descriptor = os.open(path, os.O_RDWR)
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP, errno.EROFS):
            raise
    finally:
        os.close(descriptor)
