"""Output folders: the record of the files that runs write there, and one run at a time.

A later run removes the files of an earlier one, and no other file.
`zonda-files.jsonl` holds a line of JSON for each file: its path in the folder, its size and its
time of change. The line is written before the file gets its name: a run that is killed leaves no
product that the next one does not know.

The lock of a folder is a file that the system locks (`filelock`, flock) as long as its holder
lives: a process that is killed leaves a file that nobody holds. Where the file system knows no such
locks the folder is refused, because no other kind tells a run that is gone from one that works.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
import stat
import threading
import warnings
from collections.abc import Iterable, Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import OutputError
from . import files

RECORD = "zonda-files.jsonl"
LOCK = ".zonda-lock"
RECORD_MAX = 64_000_000
"""Bytes of a record that are read."""
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)

Stamp = tuple[int, int]
"""Size [bytes] and time of change [ns] of a file."""


def earlier(folder: Path, inputs: Iterable[Path] = ()) -> list[Path]:
    """Files of earlier runs in an output folder, without the ``inputs`` of this one.

    Raises
    ------
    OutputError
        One of them was changed since, or the record is no regular file.
    """
    root = folder.resolve()
    kept = {os.path.realpath(path) for path in inputs}
    found = []
    for name, stamps in _read(folder).items():
        path = root / name
        if str(path) in kept:
            continue  # read by this run
        if (unchanged := _unchanged(path, stamps)) is None:
            continue
        if not unchanged:
            raise OutputError(
                "was changed after the run that wrote it, and this run would replace or remove it",
                place=str(folder / name),
                cure="move or remove it, or choose another output folder",
            )
        found.append(path)
    return found


def clear(folder: Path, old: Iterable[Path]) -> None:
    """Remove files that `earlier` found and that were not changed since, the folders that this
    empties, and the record.
    """
    root = folder.resolve()
    stamps = _read(folder)
    with files.writing(folder):
        for path in old:
            if not _unchanged(path, stamps.get(path.relative_to(root).as_posix(), set())):
                continue
            path.unlink(missing_ok=True)
            with contextlib.suppress(OSError):  # the others are not empty
                for parent in path.parents:
                    if parent == root:
                        break
                    parent.rmdir()
        (root / RECORD).unlink(missing_ok=True)


@contextlib.contextmanager
def recording(folder: Path, *, anew: bool, inputs: Iterable[Path] = ()) -> Iterator[None]:
    """Record what is written into an output folder while the body runs.

    Parameters
    ----------
    anew
        A new run begins: the files of earlier ones are removed before its first one is in place,
        and a warning names those that it has not made again. Else the files belong to a run that
        goes on.
    inputs
        Files that the run reads; they are not removed.

    Raises
    ------
    OutputError
        As `earlier`.
    """
    if any(record.folder == Path(os.path.abspath(folder)) for record in files.RECORDS):
        yield  # the caller records
        return
    record = Record(folder, earlier(folder, inputs) if anew else None)
    files.RECORDS.append(record)
    try:
        yield
    finally:
        files.RECORDS.remove(record)
        record.close()


class Record:
    """The files that a run writes into a folder; `files.atomic_path` calls `add`.

    Parameters
    ----------
    old
        Files to remove before the first one is in place; None: the run goes on.
    """

    def __init__(self, folder: Path, old: list[Path] | None) -> None:
        self.folder = Path(os.path.abspath(folder))
        self._old = old
        self._new: set[str] = set()
        self._lock = threading.Lock()

    def add(self, path: Path, temporary: Path) -> None:
        """Note a file that is about to be renamed from ``temporary`` to ``path``."""
        path = Path(os.path.abspath(path))
        if not path.is_relative_to(self.folder):
            return
        name = path.relative_to(self.folder).as_posix()
        about = os.lstat(temporary)
        line = json.dumps([name, about.st_size, about.st_mtime_ns]) + "\n"
        with self._lock:
            if self._old is not None and not self._new:
                clear(self.folder, self._old)
            self._new.add(name)
            opened = files.open_own(self.folder / RECORD, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
            with open(opened, "ab", buffering=0) as file:
                file.write(line.encode())

    def close(self) -> None:
        """Warn of the files of earlier runs that are gone; remove the record if no file came."""
        root = self.folder.resolve()
        if self._new and self._old is not None:
            with contextlib.suppress(OSError):
                if not any(os.path.lexists(root / name) for name in self._new):
                    (root / RECORD).unlink()
        gone = [
            name
            for p in self._old or ()
            if (name := str(p.relative_to(root))) not in self._new and not os.path.lexists(p)
        ]
        if gone and self._new:
            more = f" and {len(gone) - 6} more" if len(gone) > 6 else ""
            text = f"removed {', '.join(gone[:6])}{more}: of an earlier run, not made by this one"
            warnings.warn(f"{self.folder}: {text}", stacklevel=4)


def _unchanged(path: Path, stamps: set[Stamp]) -> bool | None:
    """True for a file that has one of the stamps; None where it was removed, or a link leads to
    it.
    """
    if os.path.realpath(path.parent) != str(path.parent):
        return None
    try:
        about = os.lstat(path)
    except OSError:
        return None
    return stat.S_ISREG(about.st_mode) and (about.st_size, about.st_mtime_ns) in stamps


def _read(folder: Path) -> dict[str, set[Stamp]]:
    """Files that the record of a folder names, each with the stamps that it had; lines that cannot
    be read are left out.
    """
    found: dict[str, set[Stamp]] = {}
    try:
        with open(files.open_own(folder / RECORD, os.O_RDONLY), "rb") as file:
            lines = file.read(RECORD_MAX).splitlines()
    except FileNotFoundError:
        return {}
    for line in lines:
        with contextlib.suppress(ValueError, TypeError, OverflowError, RecursionError):
            name, size, changed = json.loads(line)
            inside = isinstance(name, str) and "\0" not in name and not Path(name).is_absolute()
            os.fsencode(name)
            if inside and Path(name).parts and ".." not in Path(name).parts:
                found.setdefault(name, set()).add((int(size), int(changed)))
    return found


@contextlib.contextmanager
def lock(folder: files.AnyPath, part: str = "") -> Iterator[None]:
    """Hold a folder while the body runs.

    Parameters
    ----------
    part
        Name of a share of the work (a job of an array): parts of other names may run beside it, a
        whole run may not.

    Raises
    ------
    OutputError
        Somebody else holds it, or the file system has no locks.
    """
    path = Path(folder) / (f"{LOCK}.{part}" if part else LOCK)
    with _held(path):
        others = [Path(folder) / LOCK] if part else sorted(Path(folder).glob(f"{LOCK}.*"))
        for other in others:
            if other.exists():
                with _held(other):
                    pass
        yield


@contextlib.contextmanager
def _held(path: Path) -> Iterator[None]:
    """Hold one lock file, which is removed after the body."""
    holder = ""
    if os.path.lexists(path):  # read before it is locked, which may empty it
        with (
            contextlib.suppress(OSError),
            open(files.open_own(path, os.O_RDONLY), errors="replace") as file,
        ):
            holder = file.read(200).strip()
    with files.writing(path):
        taken = _take(path)
        while taken is not None and (again := _take(path)) is not None:
            again.release()  # the file was removed between opening and locking
            taken.release()
            taken = _take(path)
    if taken is None:
        raise OutputError(
            f"{holder or 'another process'} is writing to this folder",
            place=str(path.parent),
            cure="wait for it or choose another output folder",
        )
    try:
        with files.writing(path), open(files.open_own(path, os.O_WRONLY | os.O_TRUNC), "w") as file:
            file.write(f"process {os.getpid()} on {socket.gethostname()}\n")
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        taken.release()


def _take(path: Path) -> FileLock | None:
    """A lock on a file, None if another holds it."""
    found = FileLock(path, thread_local=False, fallback_to_soft=False)
    try:
        found.acquire(blocking=False)
    except Timeout:
        return None
    except (NotImplementedError, OSError) as error:
        if isinstance(error, OSError) and error.errno not in _NO_LOCKS:
            raise
        with contextlib.suppress(OSError):
            path.unlink()
        raise OutputError(
            "is on a file system without locks, which keep two runs apart",
            place=str(path.parent),
            cure="choose a folder on a local disk, or mount the file system with locks (flock)",
        ) from error
    return found
