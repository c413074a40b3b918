"""In which pixels detectors look, and at which angles: tile by tile, and once for all bands that look at the same.

What bands share is known by a fingerprint of all numbers that it is made of, not by where these come from: two bands take one
another's pixels only where each would make the same bits by itself.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Hashable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.numerics.tiles import TILE_DETECTORS, TILE_SAMPLES
from zonda.core.observation import Observation
from zonda.core.polarization import PolarizationAngles
from zonda.core.shared import of_block
from zonda.core.types import Floats

from .grid import Grid, HealpixGrid
from .stokes_kernel import rounded_angles

Made = Callable[[], NDArray[np.int32]]


@dataclass(frozen=True)
class Looking:
    """Pointing of one observation's detectors.

    Attributes
    ----------
    pointing
        What `Grid.pointing` gives.
    angles
        None where polarization does not matter.
    keys
        Fingerprints of what pixels and angles are made of; empty where there is no other band.
    """

    observation: Observation
    grid: Grid
    pointing: Floats
    angles: PolarizationAngles | None = None
    keys: tuple[Hashable, ...] = ()

    @classmethod
    def of(cls, observation: Observation, grid: Grid, angles: PolarizationAngles | None = None) -> Looking:
        """Where all detectors of an observation look; ``angles``: those of its boresight."""
        pointing, keys = grid.pointing(observation), list[Hashable]()
        if observation.shared is not None:
            plane = observation.focalplane
            known = (grid.nside, grid.nest, fingerprint(grid.pixels_covered)) if isinstance(grid, HealpixGrid) else grid
            keys = [(known, fingerprint(pointing, plane.xi, plane.eta))]
            if angles is not None:
                made_of = angles.poles, angles.axes, angles.plate, angles.gamma, plane.polarization_efficiency
                keys.append(fingerprint(*made_of))
        return cls(observation, grid, pointing, angles, tuple(keys))

    def pixels(self, which: NDArray[np.intp], start: int, stop: int) -> NDArray[np.int32]:
        """(n, stop - start) pixels of the detectors ``which`` (n,), -1 outside. Read only."""
        plane = self.observation.focalplane

        def make() -> NDArray[np.int32]:
            index = np.empty((which.size, stop - start), np.int32)
            self.grid.pixels(self.pointing, start, stop, plane.xi[which], plane.eta[which], index)
            return index

        return self._once(0, which, start, stop, make)

    def turns(self, which: NDArray[np.intp], start: int, stop: int) -> NDArray[np.int32]:
        """(2, n, stop - start) p cos 2 psi and p sin 2 psi of the detectors ``which`` (n,) in units of 2^-30. Read only."""
        angles, plane = self.angles, self.observation.focalplane
        assert angles is not None

        def make() -> NDArray[np.int32]:
            turn = np.empty((2, which.size, stop - start), np.int32)
            efficiency = plane.polarization_efficiency[which]
            rounded_angles(angles.poles, angles.axes, angles.plate, angles.gamma, which, start, efficiency, turn)
            return turn

        return self._once(1, which, start, stop, make)

    def _once(self, what: int, which: NDArray[np.intp], start: int, stop: int, make: Made) -> NDArray[np.int32]:
        """What is the same for all bands with this key: 4 or 8 bytes for each sample."""
        if not self.keys:
            return make()
        size = (4, 8)[what] * which.size * (stop - start)
        return of_block(self.observation.shared, (what, self.keys[what], which.tobytes(), start, stop), size, make)


def fingerprint(*arrays: NDArray[Any]) -> bytes:
    """Sixteen bytes that differ where the arrays do."""
    found = hashlib.blake2b(digest_size=16)
    for array in arrays:
        found.update(f"{array.dtype}{array.shape}".encode())
        found.update(np.ascontiguousarray(array).data)
    return found.digest()


def tiles(block: Block, used: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.int64], int, int]]:
    """Of a block, in pieces that stay in the cache: rows of the detectors that are ``used`` (n_det,), first and last sample.

    Which detectors are together does not depend on the others.
    """
    for first in range(0, used.size, TILE_DETECTORS):
        some = first + np.flatnonzero(used[first : first + TILE_DETECTORS])
        if some.size:
            for start in range(block.samples.start, block.samples.stop, TILE_SAMPLES):
                yield some, start, min(start + TILE_SAMPLES, block.samples.stop)
