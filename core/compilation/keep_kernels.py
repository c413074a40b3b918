"""Lets zonda's compiled kernels be kept in files of its own (`kernel_cache`), or by numba where that is not possible.

`kernel_cache` leans on the inside of numba's cache, which has no public interface for other files (`NUMBA_CACHE_LOCATOR_CLASSES`
chooses folders alone). Where a future numba has another inside, kernels are kept as numba keeps those of others, and it is said.
"""

from __future__ import annotations

from .without_cache import CHANGED, left_to_numba


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
