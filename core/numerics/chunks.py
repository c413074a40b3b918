"""Long scans are worked on in chunks: fresh memory for what is used for a moment takes longer than
the sums.

What is only used for a moment then stays in the cache, and in memory that was touched before; what
lasts goes into one array.
"""

from __future__ import annotations

import mmap
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

TILE_DETECTORS = 16
"""Blocks begin at multiples of this many detectors."""

TILE_SAMPLES = 2048
"""Blocks begin at multiples of this many samples."""


CHUNK = 1 << 14
"""Instants that are worked on at a time."""

LARGE = 1 << 22
"""Bytes from which on numpy asks for large pages."""


def chunks(n: int, size: int = CHUNK) -> list[slice]:
    """Slices of ``n`` instants, or of anything, ``size`` at a time."""
    return [slice(k, min(k + size, n)) for k in range(0, n, size)]


def empty(shape: tuple[int, int], dtype: Any = np.float64) -> NDArray[Any]:
    """An array of zeros, in pages of ordinary size.

    numpy asks for large pages, which on a virtual machine may cost five times more to touch first:
    3 ms for each 2 MB.
    """
    size = shape[0] * shape[1] * np.dtype(dtype).itemsize
    if size >= LARGE and hasattr(mmap, "MAP_ANONYMOUS"):
        with suppress(OSError):  # refused: numpy's MemoryError says so
            pages = mmap.mmap(-1, size, flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)
            return np.frombuffer(pages, dtype).reshape(shape)
    return np.zeros(shape, dtype)
