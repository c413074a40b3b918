"""Pixels in which detectors look, tile by tile.

Two bands take one another's where each would make the same bits by itself: `Looking.key` is a
fingerprint of all numbers that pixels are made of.
"""

from __future__ import annotations

import hashlib
from collections.abc import Hashable, Iterator
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.numerics.chunks import TILE_DETECTORS, TILE_SAMPLES
from zonda.core.observation import Observation
from zonda.core.types import Floats

from .grid import Grid, HealpixGrid

MOST = 16 << 20
"""Bytes of pixels that a thread holds while it adds a block to maps."""


@dataclass(frozen=True)
class Looking:
    """Pointing of one observation's detectors.

    Attributes
    ----------
    pointing
        What `Grid.pointing` gives.
    """

    observation: Observation
    grid: Grid
    pointing: Floats

    @classmethod
    def of(cls, observation: Observation, grid: Grid) -> Looking:
        """The pointing of all detectors of an observation."""
        return cls(observation, grid, grid.pointing(observation))

    @cached_property
    def key(self) -> Hashable:
        """Fingerprint of what pixels are made of; None where there is no other band."""
        if self.observation.common is None:
            return None
        grid, plane = self.grid, self.observation.focalplane
        known = (
            (grid.nside, grid.nest, fingerprint(grid.pixels_covered))
            if isinstance(grid, HealpixGrid)
            else grid
        )
        return "pixels", known, fingerprint(self.pointing, plane.xi, plane.eta)

    def pixels(self, which: NDArray[np.intp], start: int, stop: int) -> NDArray[np.int32]:
        """(n, stop - start) pixels of the detectors ``which`` (n,), -1 outside."""
        plane, index = self.observation.focalplane, np.empty((which.size, stop - start), np.int32)
        self.grid.pixels(self.pointing, start, stop, plane.xi[which], plane.eta[which], index)
        return index


class Cells:
    """Pixels of one block, found once for all bands and sums that look at the same; up to `MOST`
    bytes are held.
    """

    def __init__(self) -> None:
        self._found: dict[Hashable, NDArray[np.int32]] = {}
        self._left = MOST

    def of(
        self, looking: Looking, which: NDArray[np.intp], start: int, stop: int
    ) -> NDArray[np.int32]:
        """`Looking.pixels`. Read only."""
        key = looking.key or id(looking), which.tobytes(), start, stop
        if key in self._found:
            return self._found[key]
        found = looking.pixels(which, start, stop)
        if found.nbytes <= self._left:
            self._found[key], self._left = found, self._left - found.nbytes
        return found


def fingerprint(*arrays: NDArray[Any]) -> bytes:
    """Sixteen bytes that differ where the arrays do."""
    found = hashlib.blake2b(digest_size=16)
    for array in arrays:
        found.update(f"{array.dtype}{array.shape}".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.digest()


def tiles(block: Block, used: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.int64], int, int]]:
    """Pieces of a block that stay in the cache: rows of the detectors that are ``used``
    (n_det,), first and last sample.

    Which detectors are together does not depend on the others.
    """
    for first in range(0, used.size, TILE_DETECTORS):
        some = first + np.flatnonzero(used[first : first + TILE_DETECTORS])
        if some.size:
            for start in range(block.samples.start, block.samples.stop, TILE_SAMPLES):
                yield some, start, min(start + TILE_SAMPLES, block.samples.stop)
