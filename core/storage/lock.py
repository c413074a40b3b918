"""One run at a time in an output folder.

The lock of a folder is a file that the system locks (`filelock`, flock) as long as its holder
lives: a process that is killed leaves a file that nobody holds. Where the file system knows no such
locks the folder is refused, because no other kind tells a run that is gone from one that works.
"""

from __future__ import annotations

import contextlib
import errno
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from filelock import FileLock, Timeout

from ..errors import OutputError
from .files import open_own, writing

NAME = ".zonda-lock"
_NO_LOCKS = (errno.ENOSYS, errno.ENOLCK, errno.ENOTSUP, errno.EOPNOTSUPP)


@contextlib.contextmanager
def lock(folder: str | os.PathLike[str], part: str = "") -> Iterator[None]:
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
    path = Path(folder) / (f"{NAME}.{part}" if part else NAME)
    with _held(path):
        others = [Path(folder) / NAME] if part else sorted(Path(folder).glob(f"{NAME}.*"))
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
            open(open_own(path, os.O_RDONLY), errors="replace") as file,
        ):
            holder = file.read(200).strip()
    with writing(path):
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
        with writing(path), open(open_own(path, os.O_WRONLY | os.O_TRUNC), "w") as file:
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
