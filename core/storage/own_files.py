"""Files that are run or unpickled: only those that nobody but this user, or who installed zonda,
can have written.
"""

from __future__ import annotations

import os
import stat
from functools import cache
from pathlib import Path


class ForeignFile(OSError):
    """A file that somebody else may have written."""


def read_own(path: Path) -> bytes:
    """The content of a file. Raises `ForeignFile` for one that others own or may write to, or that
    is in such a folder; OSError.

    It is the open file that is looked at, so that none can be put in its place between the look and
    the reading. Where the system knows no owners (Windows), the user's profile is trusted.
    """
    descriptor = os.open(
        path,
        os.O_RDONLY
        | getattr(os, "O_CLOEXEC", 0)
        | getattr(os, "O_NOFOLLOW", 0)
        | getattr(os, "O_BINARY", 0),
    )
    with os.fdopen(descriptor, "rb") as file:
        for state, what in (
            (os.fstat(descriptor), "it"),
            (os.stat(path.parent), f"its folder {path.parent}"),
        ):
            if why := _foreign(state):
                raise ForeignFile(f"{what} {why}")
        return file.read()


def own_folder(folder: Path, otherwise: Path) -> Path:
    """``folder``, or ``otherwise``, made for this user alone, where others may write to
    ``folder``.
    """
    try:
        if not _foreign(os.stat(folder)):
            return folder
    except OSError:  # not there yet: it will be made by this user
        there = next((p for p in folder.parents if p.exists()), None)
        if there is None or not _foreign(os.stat(there)):
            return folder
    otherwise.mkdir(parents=True, exist_ok=True, mode=0o700)
    return otherwise


def _foreign(state: os.stat_result) -> str:
    """Why what others may have changed is not trusted; empty where it is."""
    if not hasattr(os, "getuid"):
        return ""
    if state.st_uid not in (
        0,
        os.getuid(),
        os.stat(__file__).st_uid,
    ):  # who installed this code can run any
        return "is another user's"
    if state.st_mode & stat.S_IWOTH or (
        state.st_mode & stat.S_IWGRP and not _private(state.st_gid, state.st_uid)
    ):
        return "may be written to by others"
    return ""


@cache
def _private(group: int, user: int) -> bool:
    """Whether a group has no other member than its user, as most Linux systems give each user
    one.
    """
    try:
        import grp
        import pwd

        return grp.getgrgid(group).gr_name == pwd.getpwuid(user).pw_name and not set(
            grp.getgrgid(group).gr_mem
        ) - {pwd.getpwuid(user).pw_name}
    except (ImportError, KeyError):
        return False
