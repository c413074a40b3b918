"""A first look at an HDF5 file in a process of its own: python -m zonda.core.storage.hdf5_survey FILE.

On some corrupt files libhdf5 itself never returns, or takes the process with it (damaged global heaps, B-trees that lead back to
themselves). Here that costs nothing but this process. It touches what a reader touches: every object, attribute and small data
set. Python's own errors are left to the reader, who tells them better.
"""

from __future__ import annotations

import contextlib
import sys
from typing import Any

SMALL = 1 << 20
"""Bytes up to which a data set is read whole; of larger ones the first value."""
MEMORY = 4 << 30
"""Bytes that this process may take."""


def main(path: str) -> int:
    """Touch everything in a file; 0, however bad it is, where that comes to an end."""
    with contextlib.suppress(ImportError, ValueError, OSError):
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    import h5py

    def touch(name: str, item: Any) -> None:
        with contextlib.suppress(Exception):
            for key in list(item.attrs):
                with contextlib.suppress(Exception):
                    item.attrs[key]
            if isinstance(item, h5py.Dataset) and item.size and not item.external and not item.is_virtual:
                item[()] if item.size * item.dtype.itemsize <= SMALL else item[(0,) * item.ndim]

    with contextlib.suppress(Exception), h5py.File(path, "r") as file:
        touch("/", file)
        file.visititems(touch)
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1]))
