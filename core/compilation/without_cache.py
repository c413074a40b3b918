"""What to do where a future numba has another inside than `kernel_cache` leans on."""

from __future__ import annotations

import warnings

CHANGED = (ImportError, AttributeError, TypeError)
"""What a numba whose inside has changed raises."""

_told: list[str] = []


def left_to_numba(error: BaseException) -> None:
    """Say once why zonda's cache is not used."""
    import numba

    if not _told:
        _told.append(str(error))
        warnings.warn(
            f"zonda cannot keep compiled code itself with numba {numba.__version__} ({error}):"
            " numba's own cache is used, or kernels are compiled in every run; do not begin"
            " several first runs at once",
            stacklevel=3,
        )
