"""Lets zonda's compiled kernels be kept in files of its own (`kernel_cache`), or by numba where that is not possible.

`kernel_cache` leans on the inside of numba's cache, which has no public interface for other files (`NUMBA_CACHE_LOCATOR_CLASSES`
chooses folders alone). Where a future numba has another inside, kernels are kept as numba keeps those of others, and it is said.
"""

from __future__ import annotations

import warnings

CHANGED = (ImportError, AttributeError, TypeError)
"""What a numba whose inside has changed raises."""

_told: list[str] = []


def keep() -> None:
    """Call it before any kernel is defined."""
    try:
        from . import kernel_cache

        kernel_cache.install()
    except CHANGED as error:
        left_to_numba(error)


def share(polite: bool = False) -> None:
    """See `kernel_cache.share`; without it processes compile what they need, each its own."""
    try:
        from . import kernel_cache

        kernel_cache.share(polite)
    except CHANGED as error:
        left_to_numba(error)


def left_to_numba(error: BaseException) -> None:
    """Say once why zonda's cache is not used."""
    import numba

    if not _told:
        _told.append(str(error))
        warnings.warn(
            f"zonda cannot keep compiled code itself with numba {numba.__version__} ({error}): numba's own cache is "
            "used, or kernels are compiled in every run; do not begin several first runs at once",
            stacklevel=3,
        )
