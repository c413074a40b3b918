"""The user's cache folder, ``$ZONDA_CACHE_DIR`` or ``zonda`` in that of the system, and the name of
the processor that what is kept there was made for.
"""

from __future__ import annotations

import os
import platform
import sys
from contextlib import suppress
from functools import cache
from pathlib import Path

RESTRAINTS = (
    "NUMBA_CPU_NAME",
    "NUMBA_CPU_FEATURES",
    "NPY_DISABLE_CPU_FEATURES",
    "OPENBLAS_CORETYPE",
    "GLIBC_TUNABLES",
)
"""Variables with which other instructions are chosen than the processor's own."""


def folder() -> Path:
    """The folder, which need not exist."""
    if given := os.environ.get("ZONDA_CACHE_DIR"):
        return Path(given).expanduser()
    if sys.platform == "win32" and (local := os.environ.get("LOCALAPPDATA")):
        return Path(local) / "zonda" / "cache"
    if sys.platform == "darwin":
        return Path("~/Library/Caches/zonda").expanduser()
    return Path(os.environ.get("XDG_CACHE_HOME") or "~/.cache").expanduser() / "zonda"


@cache
def processor() -> str:
    """This machine's processor, as the system calls it, and what the environment forbids it."""
    return " ".join(
        [_name(), *(f"{name}={os.environ[name]}" for name in RESTRAINTS if os.environ.get(name))]
    )


def _name() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return f"{platform.machine()} {line.partition(':')[2].strip()}"
    return f"{platform.machine()} {platform.processor()}"
