"""The absolute tiles in which work is cut, so that no result depends on block size, threads or
order.
"""

from __future__ import annotations

TILE_DETECTORS = 16
"""Blocks begin at multiples of this many detectors."""

TILE_SAMPLES = 2048
"""Blocks begin at multiples of this many samples."""
