"""Tiles of the layers' spline coefficients: how a lattice is cut into them, and the store that
keeps them.

Tiles overlap by the three cells that a cubic spline needs, so that every point is interpolated from
one tile. A tile has the same bits whenever it is made. Where a scan sweeps over few cells they are
made as one piece; over a strip along the wind, in slabs as wide as that, since squares would hold
more than is used; along a narrow path that turns, in strips.

Bands of one camera whose beams are alike look through the same random numbers, each with kernels of
its own. The band that comes first makes a tile for the others too: the numbers are drawn once.
"""

from __future__ import annotations

import threading
from collections.abc import Mapping, Sequence
from concurrent.futures import Future
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from zonda.core.types import Floats

from .interpolation import extent, mark
from .lattice import Turbulence, coefficients
from .levels import Field

Box = tuple[int, int, int, int]
"""Cells across and along the wind, (low, high, low, high)."""

APRON = 3
"""Cells by which tiles overlap."""

BYTES_KEPT = 256 << 20
"""Memory of the tiles that are kept."""

SQUARE, STRIP = (8, 9), (5, 10)
"""Sides of a tile, as powers of two of cells (across, along the wind): in general, and where the
path is narrow.
"""

NARROW = 96
"""Cells: a path that is narrower than this across the wind, and has no slabs, is tiled by strips.
"""

SLAB, WIDEST, LONGEST = 1 << 18, 1024, 1 << 10
"""Cells of a slab, about; cells across the wind up to which there are slabs; most cells along it.
"""

DENSE = 1.5
"""Slabs serve where all that they hold is at most this many times what is swept over."""

ONE_PIECE = 1 << 16
"""Cells of a layer, with `AROUND` more on every side, up to which all that a scan sweeps over is
made as one piece.
"""

AROUND, SPARE, BEYOND = 20, 2, 32
"""Cells about the made ones that the pyramid works out too, about; cells beyond what some points of
the rim sweep over: so many, and one for so many across the wind."""

MOST = 0.5
"""Bands make tiles for each other where they reach at least this share of the cells between the
outermost of both.
"""

_WHOLE = 30
"""Side of the only tile, as a power of two of cells: none is so large."""

_Tile = tuple[Field, int]
"""Coefficients (rows, cells in a row, bands), and their address."""

Bands = tuple[int, ...]
"""Numbers of bands that look at the same cells at the same times: their coefficients are next to
each other.
"""


class Cover(NamedTuple):
    """The tiles under some lines of sight, as `interpolation.interpolate` takes them."""

    sides: tuple[int, int]
    origin: tuple[int, int]
    """First cell of the first tile."""
    width: int
    """Cells in a row of a tile."""
    addresses: NDArray[np.uint64]
    held: list[Field]
    """The tiles: they might be dropped while they are read."""


class Tiles:
    """The tiles of several lattices and bands, as many as `BYTES_KEPT` allow. Safe for threads."""

    def __init__(self) -> None:
        self._kept: dict[tuple[int, Bands, Box], _Tile] = {}
        self._making: dict[tuple[int, Box], Future[dict[Bands, _Tile]]] = {}
        self._begun: set[tuple[int, Bands, Box]] = set()
        """What was made, whether it is kept or not: it is made once for bands that did not ask."""
        self._lock = threading.Lock()
        self._free = BYTES_KEPT

    def get(self, lattice: int, bands: Bands, box: Box, fields: Mapping[int, Turbulence]) -> _Tile:
        """The cells low <= i < high, low <= j < high of a box, with the apron, as some bands see
        them.

        ``fields``: of all bands that look through this lattice, by number.
        """
        key, place = (lattice, bands, box), (lattice, box)
        if (kept := self._kept.get(key)) is not None:
            return kept
        while True:
            with self._lock:
                kept, making = self._kept.get(key), self._making.get(place)
                if kept is not None:
                    return kept
                if making is None:
                    mine = self._making[place] = Future()
                    others = [(b,) for b in fields if b not in bands]
                    wanted = [
                        bands,
                        *(one for one in others if (lattice, one, box) not in self._begun),
                    ]
                    self._begun.update((lattice, some, box) for some in wanted)
                    break
            if bands in (made := making.result()):  # or it was made for others alone
                return made[bands]
        return self._make(mine, place, {some: [fields[b] for b in some] for some in wanted})[bands]

    def _make(
        self,
        mine: Future[dict[Bands, _Tile]],
        place: tuple[int, Box],
        fields: Mapping[Bands, Sequence[Turbulence]],
    ) -> dict[Bands, _Tile]:
        lattice, box = place
        try:
            a, b, c, d = box
            parts = iter(
                coefficients(
                    [one for some in fields.values() for one in some],
                    a,
                    b + APRON,
                    c,
                    d + APRON,
                )
            )
            tiles = {bands: _alternating([next(parts) for _ in bands]) for bands in fields}
            made = {bands: (tile, tile.ctypes.data) for bands, tile in tiles.items()}
        except BaseException as error:
            mine.set_exception(error)
            with self._lock:
                del self._making[place]
            raise
        with self._lock:
            self._free -= sum(tile.nbytes for tile, _ in made.values())
            while (
                self._free < 0 and self._kept
            ):  # the oldest goes first; a thread that works with it still holds it
                self._free += self._kept.pop(next(iter(self._kept)))[0].nbytes
            self._kept.update({(lattice, bands, box): tile for bands, tile in made.items()})
            del self._making[place]
        mine.set_result(made)
        return made


@dataclass(frozen=True)
class Swept:
    """Region of a lattice that lines of sight sweep over: first and last cells, and about how many
    lattice points.
    """

    box: Box
    cells: float

    def joined(self, other: Swept) -> Swept | None:
        """Union of two regions if they mostly overlap, else None."""
        (a, b, c, d), (e, f, g, h) = self.box, other.box
        joined = min(a, e), max(b, f), min(c, g), max(d, h)
        common = max(min(b, f) - max(a, e) + 1.0, 0.0) * max(min(d, h) - max(c, g) + 1.0, 0.0)
        if common < MOST * (joined[1] - joined[0] + 1.0) * (joined[3] - joined[2] + 1.0):
            return None
        return Swept(joined, max(self.cells, other.cells))


class Tiling:
    """A lattice as some bands see it, cut into tiles.

    Parameters
    ----------
    tiles, number
        Where its tiles are kept, and its number there.
    fields
        Of the bands, by number.
    swept
        By the lines of sight of all of them.
    """

    def __init__(
        self,
        tiles: Tiles,
        number: int,
        fields: Mapping[int, Turbulence],
        swept: Swept,
    ) -> None:
        self._tiles, self._number, self.fields = tiles, number, fields
        low, high, begin, end = swept.box
        spare = SPARE + (high - low) // BEYOND
        low, high, begin, end = low - spare, high + 1 + spare, begin - spare, end + 1 + spare
        held = points_of(swept.box)
        self._piece = (low, high, begin, end) if held <= ONE_PIECE else None
        self._slab: tuple[int, int, int] | None = None
        """Cells across, low <= i < high, and the side along the wind, a power of two."""
        if high - low <= WIDEST and held <= DENSE * swept.cells:
            self._slab = (
                low,
                high,
                max(1, min(SLAB // max(high - low, 1), LONGEST)).bit_length() - 1,
            )
        self._sides = STRIP if swept.box[1] - swept.box[0] < NARROW else SQUARE

    def cover(self, bands: Bands, matrix: Floats, boxes: Floats, i: Floats, j: Floats) -> Cover:
        """The tiles under the cells at matrix (x, y) + (i, j), as some bands see them; ``boxes`` of
        x, y as of `boxes_of`.
        """
        low_i, high_i, low_j, high_j = extent(matrix, boxes, i, j)
        piece, slab, sides = self._piece, self._slab, self._sides
        if (
            piece
            and piece[0] <= low_i <= high_i < piece[1]
            and piece[2] <= low_j <= high_j < piece[3]
        ):
            tile, address = self._get(bands, piece)
            return Cover(
                (_WHOLE, _WHOLE),
                (piece[0], piece[2]),
                tile.shape[1],
                np.array([[address]], np.uint64),
                [tile],
            )
        if slab and slab[0] <= low_i <= high_i < slab[1]:
            sides = _WHOLE, slab[2]
        first_i, first_j = low_i >> sides[0], low_j >> sides[1]
        wanted = np.zeros(
            ((high_i >> sides[0]) - first_i + 1, (high_j >> sides[1]) - first_j + 1),
            np.uint8,
        )
        mark(matrix, boxes, i, j, *sides, first_i, first_j, wanted)
        begin, across = first_i << sides[0], 1 << sides[0]
        if slab and sides[0] == _WHOLE:
            wanted = wanted.max(axis=0, keepdims=True)
            begin, across = slab[0], slab[1] - slab[0]
        addresses, held = np.zeros(wanted.shape, np.uint64), []
        for a, b in zip(*(index.tolist() for index in np.nonzero(wanted)), strict=True):
            k, m = begin + a * across, (first_j + b) << sides[1]
            tile, addresses[a, b] = self._get(bands, (k, k + across, m, m + (1 << sides[1])))
            held.append(tile)
        return Cover(sides, (begin, first_j << sides[1]), held[0].shape[1], addresses, held)

    def _get(self, bands: Bands, box: Box) -> _Tile:
        return self._tiles.get(self._number, bands, box, self.fields)


def _alternating(parts: Sequence[Field]) -> Field:
    """Fields next to each other: (rows, cells, fields)."""
    return parts[0][:, :, None] if len(parts) == 1 else np.stack(parts, axis=2)


def points_of(box: Box) -> float:
    """Lattice points of a box of cells, with those about it."""
    return (box[1] - box[0] + 2.0 * AROUND) * (box[3] - box[2] + 2.0 * AROUND)
