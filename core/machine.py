"""This machine and this process: memory, threads, the processor, the user's cache folder, processes
that zonda starts, installed packages and their versions, and a hash of zonda's own code.
"""

from __future__ import annotations

import ctypes
import hashlib
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from types import ModuleType
from typing import Any

from .discovery import HOST
from .errors import InputError


def available_memory() -> int:
    """Free memory of this machine in bytes (2 GB where that is unknown)."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    with suppress(OSError, ValueError, AttributeError):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 2 << 30


def available_threads() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def resident_memory() -> int:
    """Bytes of memory that this process holds now, libraries included (0 where that is unknown)."""
    with suppress(OSError, ValueError):
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")
    return 0


def give_back_memory() -> None:
    """Return memory of freed arrays, which the allocator keeps, to the system (glibc only)."""
    with suppress(OSError, AttributeError):
        ctypes.CDLL(None).malloc_trim(0)


def one_blas_thread() -> None:
    """Let BLAS work on one thread, unless the user says otherwise; call it before numpy is
    imported.

    zonda's own threads fill the machine. BLAS threads beside them wait for each other, and sums may
    depend on their number.
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")


RESTRAINTS = (
    "NUMBA_CPU_NAME",
    "NUMBA_CPU_FEATURES",
    "NPY_DISABLE_CPU_FEATURES",
    "OPENBLAS_CORETYPE",
    "GLIBC_TUNABLES",
)
"""Environment variables that forbid some instructions of the processor."""


def cache_folder() -> Path:
    """The user's cache folder, which need not exist: ``$ZONDA_CACHE_DIR``, or ``zonda`` in
    that of the system.
    """
    if given := os.environ.get("ZONDA_CACHE_DIR"):
        return Path(given).expanduser()
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "zonda" / "cache"
    if sys.platform == "darwin":
        return Path("~/Library/Caches/zonda").expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "zonda"


@cache
def processor() -> str:
    """Name of the processor, and the environment's `RESTRAINTS` on its instructions."""
    return " ".join(
        [_name(), *(f"{name}={os.environ[name]}" for name in RESTRAINTS if os.environ.get(name))]
    )


def _name() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return f"{platform.machine()} {line.partition(':')[2].strip()}"
    return f"{platform.machine()} {platform.processor()}"


SAFE = "PYTHONSAFEPATH"
"""Variable that keeps the current folder out of where Python looks for modules."""


def command(module: str, function: str, *arguments: object) -> list[str]:
    """Command line of a Python process that calls a function, which returns the exit status (None:
    0), with this one's path.

    ``python -m`` and ``-c`` look into the current folder first: a user's ``zonda.py`` or
    ``multiprocessing.py`` there would run.

    ``arguments`` are written down: text, numbers. Raises OSError where this is no Python
    interpreter that could be started again.
    """
    if not sys.executable:
        raise OSError("this is no Python interpreter that could be started again")
    call = f"sys.exit({function}(*{arguments!r}))"
    return [
        sys.executable,
        "-P",
        "-c",
        f"import sys; sys.path[:] = {sys.path!r}; from {module} import {function}; {call}",
    ]


@contextmanager
def safe_path() -> Iterator[None]:
    """Processes that others start in the body (`multiprocessing`) do not look into the current
    folder either.
    """
    before = os.environ.get(SAFE)
    os.environ[SAFE] = "1"
    try:
        yield
    finally:
        restore(before)


def restore(before: str | None) -> None:
    """Give ``PYTHONSAFEPATH`` the value it had, also in a child that was started by `safe_path`."""
    if before is None:
        os.environ.pop(SAFE, None)
    else:
        os.environ[SAFE] = before


@contextmanager
def without_script() -> Iterator[None]:
    """Processes that `multiprocessing` starts in the body do not import the user's script again:
    they need nothing of it.

    So a script that begins a campaign needs no ``if __name__ == "__main__"``.
    """
    script = sys.modules["__main__"]
    sys.modules["__main__"] = ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = script


def needed(module: str, extra: str, place: str = "") -> Any:
    """A module of a package that the extra ``extra`` installs. Raises InputError at ``place`` where
    it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as err:
        cure = f"pip install 'zonda[{extra}]'"
        raise InputError(
            f"cannot import {module}: {err}",
            place=place or f"zonda.interop.{extra}",
            cure=cure,
        ) from None


def versions() -> dict[str, str]:
    """Versions of everything that can change a number."""
    found = {"python": platform.python_version(), "machine": platform.machine()}
    for package in (
        "zonda",
        "numpy",
        "scipy",
        "astropy",
        "astropy-iers-data",
        "pyerfa",
        "numba",
        "llvmlite",
        "healpy",
        "h5py",
    ):
        installed = _version(package)
        if installed is not None:
            found[package] = installed
    return found


def arithmetic() -> dict[str, str]:
    """Everything on which bits depend besides the pipeline: libraries, the C library's functions,
    and the instructions that each may use.

    ``cpu`` and ``instructions`` are those that numba compiles for, ``numpy instructions`` those
    that numpy chooses among; ``processor`` is its name. Where all of it is the same, bits are.
    """
    from llvmlite import binding
    from numba.core import config

    features = config.CPU_FEATURES
    if features is None:
        with suppress(RuntimeError):  # unknown to LLVM
            features = binding.get_host_cpu_features().flatten()
    return {
        **versions(),
        "processor": processor(),
        "cpu": config.CPU_NAME or binding.get_host_cpu_name(),
        "instructions": " ".join(
            sorted(f[1:] for f in (features or "").split(",") if f.startswith("+"))
        ),
        "numpy instructions": " ".join(_of_numpy()),
        "libc": " ".join(filter(None, platform.libc_ver())),
        **{
            name: os.environ[name]
            for name in ("GLIBC_TUNABLES", "OPENBLAS_CORETYPE")
            if os.environ.get(name)
        },
    }


def _of_numpy() -> list[str]:
    with suppress(ImportError, AttributeError):
        from numpy._core import _multiarray_umath as inside  # type: ignore[attr-defined]

        return [name for name in inside.__cpu_dispatch__ if inside.__cpu_features__.get(name)]
    return []


@cache
def _version(package: str) -> str | None:
    from importlib.metadata import PackageNotFoundError, version

    try:
        return version(package)
    except PackageNotFoundError:
        return None


@cache
def code_hash() -> str:
    """Hash of the names, times and sizes of zonda's own files."""
    digest = hashlib.blake2b(digest_size=16)
    for folder in _code_folders():
        for path, stat in sorted(_files(folder)):
            digest.update(f"{path} {stat.st_mtime_ns} {stat.st_size}\n".encode())
    return digest.hexdigest()


def _code_folders() -> Iterator[str]:
    """Folders of zonda's own modules."""
    for package in ("core", "operators", "plugins"):
        spec = find_spec(f"{HOST}.{package}")
        yield from spec.submodule_search_locations or () if spec else ()


def _files(folder: str) -> Iterator[tuple[str, os.stat_result]]:
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.is_dir():
                if entry.name != "__pycache__":
                    yield from _files(entry.path)
            elif not entry.name.startswith("."):
                yield entry.path, entry.stat()
