"""numba for modules with kernels: what is imported from here keeps its compiled code in zonda's own
files (`kernel_cache`).

`kernel_cache` leans on the inside of numba's cache, which has no public interface for other files
(`NUMBA_CACHE_LOCATOR_CLASSES` chooses folders alone). Where a future numba has another inside,
kernels are kept as numba keeps those of others, and it is said.
"""

from __future__ import annotations

import numba as nb

from .without_cache import CHANGED, left_to_numba

__all__ = ["nb", "share"]


def share(polite: bool = False) -> None:
    """See `kernel_cache.share`; without it processes compile what they need, each its own."""
    try:
        from . import kernel_cache

        kernel_cache.share(polite)
    except CHANGED as error:
        left_to_numba(error)


try:  # before the first kernel is defined
    from . import kernel_cache

    kernel_cache.install()
except CHANGED as error:
    left_to_numba(error)
