"""numba for modules with kernels: what is imported from here keeps its compiled code in zonda's own files (`kernel_cache`)."""

from __future__ import annotations

import numba as nb

from . import keep_kernels

__all__ = ["nb"]

keep_kernels.keep()  # before the first kernel is defined
