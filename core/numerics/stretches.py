"""The old name of `core.numerics.chunks`; goes when nobody imports it."""

from .chunks import chunks as stretches
from .chunks import empty as untouched

__all__ = ["stretches", "untouched"]
