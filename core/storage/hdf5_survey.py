"""A first look at an HDF5 file in a process of its own, which calls `main`.

On some corrupt files libhdf5 itself never returns, or takes the process with it (damaged global
heaps, B-trees that lead back to themselves). Here that costs nothing but this process. It touches
what a reader touches: every object, attribute and small data set. Python's own errors about the
file are left to the reader, who tells them better; whatever else goes wrong ends the process with
another status than 0.
"""

from __future__ import annotations

import contextlib
from typing import Any

from ..machine import one_blas_thread

SMALL = 1 << 20
"""Bytes up to which a data set is read whole; of larger ones the first value."""
MEMORY = 4 << 30
"""Bytes that this process may take."""


def main(path: str) -> int:
    """Touch everything in a file; 0, however bad it is, where that comes to an end."""
    one_blas_thread()  # each thread of BLAS takes address space
    import h5py

    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))

    def touch(name: str, item: Any) -> None:
        with contextlib.suppress(Exception):
            for key in list(item.attrs):
                with contextlib.suppress(Exception):
                    item.attrs[key]
            if (
                isinstance(item, h5py.Dataset)
                and item.size
                and not item.external
                and not item.is_virtual
            ):
                item[()] if item.size * item.dtype.itemsize <= SMALL else item[(0,) * item.ndim]

    with contextlib.suppress(Exception), h5py.File(path, "r") as file:
        touch("/", file)
        file.visititems(touch)
    return 0
