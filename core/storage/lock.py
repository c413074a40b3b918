"""One run at a time in an output folder, and locks that outlive nobody.

A lock is a file that names its holder: host, boot, process and when that process began, in ticks
since the boot; the time of day, which may jump, plays no part. A holder of this host that is gone
has left its lock behind, and the lock is taken over. Of another host nothing is known: there the
file's own lock (``flock``), which file servers pass on, decides, and where that is not to be had
the user.
"""

from __future__ import annotations

import contextlib
import errno
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import OutputError
from .files import writing

NAME = ".zonda-lock"


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
        Where somebody else holds it.
    """
    path = Path(folder) / (f"{NAME}.{part}" if part else NAME)
    with writing(path):
        handle = _take(path)
    try:
        others = [Path(folder) / NAME] if part else sorted(Path(folder).glob(f"{NAME}.*"))
        for other in others:
            if other != path and (holder := _living(other)) is not None:
                raise _held(other, holder)
        yield
    finally:
        with contextlib.suppress(OSError):
            path.unlink()
        os.close(handle)


def _take(path: Path) -> int:
    """The open, locked file at ``path``, with this process's name in it."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
        try:
            locked = _flock(handle)
            holder = _read(path)
            if locked is False or (holder is not None and _lives(holder, locked)):
                raise _held(path, holder)
            with contextlib.suppress(FileNotFoundError):
                if os.fstat(handle).st_ino == os.stat(path).st_ino:  # nobody has removed it between
                    os.ftruncate(handle, 0)
                    os.write(handle, json.dumps(_myself()).encode())
                    os.fsync(handle)
                    return handle
        except BaseException:
            os.close(handle)
            raise
        os.close(handle)


def _living(path: Path) -> dict[str, Any] | None:
    """The holder of another lock, where there is one and it is not known to be gone. What one that
    is gone left is removed.
    """
    try:
        handle = os.open(path, os.O_RDWR | os.O_CLOEXEC)
    except FileNotFoundError:
        return None
    try:
        locked = _flock(handle)
        holder = _read(path)
        if locked is False or (holder is not None and _lives(holder, locked)):
            return holder or {}
        if locked:  # whoever opened it before looks whether it is still there when he has the lock
            with contextlib.suppress(OSError):
                if os.fstat(handle).st_ino == os.stat(path).st_ino:
                    path.unlink()
        return None
    finally:
        os.close(handle)


def _flock(handle: int) -> bool | None:
    """Lock an open file: True; False where another process holds it; None where this file system
    cannot say.
    """
    try:
        import fcntl
    except ImportError:  # not POSIX
        return None
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as err:
        return False if err.errno in (errno.EWOULDBLOCK, errno.EACCES) else None
    return True


def _myself() -> dict[str, Any]:
    return {
        "host": socket.gethostname(),
        "boot": _boot(),
        "pid": os.getpid(),
        "began": _began(os.getpid()),
    }


def _lives(holder: dict[str, Any], locked: bool | None) -> bool:
    """Whether the process that a lock names may still be there."""
    if holder.get("host") != socket.gethostname():
        return True  # `locked` says nothing where a file server does not pass locks on
    if locked or holder.get("boot") != _boot():
        return False
    pid = holder.get("pid")
    return isinstance(pid, int) and _began(pid) is not None and _began(pid) == holder.get("began")


def _began(pid: int) -> str | None:
    """When a process began, in ticks since the boot (Linux); None: there is none. Elsewhere just
    whether there is one.
    """
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        if Path("/proc/self/stat").exists():
            return None
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return None
    except OSError:
        pass
    return "unknown"


def _boot() -> str:
    with contextlib.suppress(OSError):
        return Path("/proc/sys/kernel/random/boot_id").read_text().strip()
    return ""


def _read(path: Path) -> dict[str, Any] | None:
    try:
        found = json.loads(path.read_text())
    except (OSError, ValueError):
        return None  # not written yet, or cut short: nobody is named
    return found if isinstance(found, dict) else None


def _held(path: Path, holder: dict[str, Any] | None) -> OutputError:
    who = f"process {holder.get('pid')} on {holder.get('host')}" if holder else "another process"
    return OutputError(
        f"{who} is writing to this folder",
        place=str(path.parent),
        cure=(
            f"wait for it or choose another output folder; if it is gone for certain, remove {path}"
        ),
    )
