"""This machine and this process: memory, threads, the processor, the user's cache folder, and
processes that zonda starts.
"""

from __future__ import annotations

import ctypes
import os
import platform
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from functools import cache
from pathlib import Path
from types import ModuleType


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
