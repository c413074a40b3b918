"""Compiled kernels: the decorator `kernel`, and the folder where numba stores their machine code.

The folder is ``zonda-kernels`` in ``$NUMBA_CACHE_DIR``, else in the user's cache folder. In it each
module has a folder whose name holds all that machine code depends on: versions, processor, and a
hash of the module's source, of the constants that it imports, and of the modules whose kernels it
imports. (numba itself compiles anew only where the kernel's own module has changed.) A kernel
therefore uses nothing of another module but kernels, intrinsics and plain numbers.
"""

from __future__ import annotations

import contextlib
import functools
import hashlib
import numbers
import os
import platform
import sys
import threading
import warnings
from pathlib import Path
from typing import Any

import filelock
import llvmlite
import numba
import numpy as np
from numba.core import event

from zonda import __version__

from . import machine
from .errors import OutputError

PATIENCE = 600
"""Longest wait for the compilation of another process, s."""
INTRINSICS = "zonda.core.numerics.columns"
"""Module with parts of kernels that has no kernels of its own."""

_with_kernels = {INTRINSICS}
_decorating = threading.Lock()


def kernel(
    function: Any = None,
    *,
    nogil: bool = True,
    boundscheck: bool = False,
    error_model: str = "numpy",
    **options: Any,
) -> Any:
    """Decorator: compile a function with `numba.njit`, and store its machine code for later runs.

    ``options`` are those of `numba.njit`. A kernel that kernels with ``fastmath`` call states its
    own ``fastmath``: it would inherit theirs otherwise.
    """
    if function is None:
        return functools.partial(
            kernel, nogil=nogil, boundscheck=boundscheck, error_model=error_model, **options
        )
    options |= {"nogil": nogil, "boundscheck": boundscheck, "error_model": error_model}
    base = folder()
    if base is None:
        return numba.njit(**options)(function)
    name = function.__module__
    _with_kernels.add(name)
    place = base / _versions() / f"{name.rpartition('.')[2]}-{_digest(name)}"
    with _decorating:  # kernels of other packages stay where numba has them
        before, numba.config.CACHE_DIR = numba.config.CACHE_DIR, str(place)
        try:
            return numba.njit(cache=True, **options)(function)
        finally:
            numba.config.CACHE_DIR = before


contracted = kernel(fastmath={"contract", "nsz"})
"""`kernel` with fused multiply-add and without signed zeros; it takes the other options, too."""


@functools.cache
def folder() -> Path | None:
    """Folder of machine code, with its lock installed; None, after a warning, where nothing can be
    stored.
    """
    try:
        base = Path(os.environ.get("NUMBA_CACHE_DIR") or machine.cache_folder(), "zonda-kernels")
        base.mkdir(parents=True, exist_ok=True, mode=0o700)
        state = base.stat()
        if hasattr(os, "getuid") and (state.st_uid != os.getuid() or state.st_mode & 0o022):
            raise PermissionError(f"others may write to {base}")
        lock = CacheLock(base / "lock")
        lock.try_out()
    except (OSError, RuntimeError) as error:  # RuntimeError: a user without a home
        warnings.warn(
            f"compiled code cannot be kept for the next run: {error}; set NUMBA_CACHE_DIR to a"
            " folder of yours that lasts",
            stacklevel=3,
        )
        return None
    event.register("numba:compiler_lock", lock)
    return base


class CacheLock(event.Listener):  # type: ignore[misc]
    """File lock that this process holds while it holds numba's compiler lock.

    numba numbers the files of a kernel in an index. Two processes that compile at the same time
    could give one number to two signatures, and later runs would then load the wrong machine code.
    A forked process has a lock of its own.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._begin()
        os.register_at_fork(after_in_child=self._begin)

    def _begin(self) -> None:
        self._file = filelock.FileLock(self._path, thread_local=False, fallback_to_soft=False)
        self._guard = threading.Lock()
        self._depth = 0

    def try_out(self) -> None:
        """Take and release the lock once. Raises OSError if the file system has no such locks."""
        with contextlib.suppress(filelock.Timeout), self._file.acquire(timeout=0):
            pass

    def on_start(self, event: Any) -> None:
        """Take the file lock with the first of this process's threads.

        Raises OutputError where another process does not release it within `PATIENCE`.
        """
        with self._guard:
            if self._depth == 0:
                try:
                    self._file.acquire(timeout=PATIENCE)
                except filelock.Timeout:
                    raise OutputError(
                        f"another process has been compiling for {PATIENCE} s",
                        place=str(self._path),
                        cure="end that process, or set NUMBA_CACHE_DIR to another folder",
                    ) from None
            self._depth += 1

    def on_end(self, event: Any) -> None:
        """Release the file lock with the last of this process's threads."""
        with self._guard:
            self._depth -= 1
            if self._depth == 0:
                self._file.release()


@functools.cache
def _versions() -> str:
    """Name of the folder for one set of versions and one processor."""
    processor = hashlib.blake2b(machine.processor().encode(), digest_size=4).hexdigest()
    return (
        f"zonda-{__version__}_numba-{numba.__version__}_llvmlite-{llvmlite.__version__}"
        f"_numpy-{np.__version__}_python-{platform.python_version()}_{processor}"
    )


@functools.cache
def _digest(module: str) -> str:
    """Hash of a module with kernels: its source, the numbers and the kernels that it imports.

    The time of the source is part of it: numba up to 0.67 empties a kernel's index when it changes,
    and a run killed just then would leave a new index beside old files.
    """
    names = vars(sys.modules[module])
    path = Path(names["__file__"])
    found = hashlib.blake2b(path.read_bytes(), digest_size=8)
    found.update(str(path.stat().st_mtime_ns).encode())
    for name, value in sorted(names.items()):
        if isinstance(value, numbers.Number):
            found.update(f"{name}={value!r};".encode())
        elif (other := getattr(value, "__module__", None)) in _with_kernels and other != module:
            found.update(f"{name}={_digest(other)};".encode())
    return found.hexdigest()
