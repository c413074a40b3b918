"""Memory and threads of this machine and of this process."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path


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


def one_blas_thread() -> None:
    """Let BLAS work on one thread, unless the user says otherwise; call it before numpy is
    imported.

    zonda's own threads fill the machine. BLAS threads beside them wait for each other, and sums may
    depend on their number.
    """
    for name in ("OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS"):
        os.environ.setdefault(name, "1")
