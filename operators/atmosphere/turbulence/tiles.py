"""Tiles of the layers' spline coefficients: how a lattice is cut into them, the store that keeps
them, and the kernels that find the cells that lines of sight cross and interpolate between them.

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

import numba as nb
import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel
from zonda.core.numerics.columns import four_columns_at
from zonda.core.types import Floats

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

CHUNK, RUN = 256, 16
"""Positions that are interpolated at once, and of which one box is made."""


class Cover(NamedTuple):
    """The tiles under some lines of sight, as `interpolate` takes them."""

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
        key = (lattice, bands, box)
        place = (lattice, box)
        if (kept := self._kept.get(key)) is not None:
            return kept
        while True:
            with self._lock:
                kept = self._kept.get(key)
                making = self._making.get(place)
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
        self._tiles = tiles
        self._number = number
        self.fields = fields
        low, high, begin, end = swept.box
        spare = SPARE + (high - low) // BEYOND
        low = low - spare
        high = high + 1 + spare
        begin = begin - spare
        end = end + 1 + spare
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
        piece = self._piece
        slab = self._slab
        sides = self._sides
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
        first_i = low_i >> sides[0]
        first_j = low_j >> sides[1]
        wanted = np.zeros(
            ((high_i >> sides[0]) - first_i + 1, (high_j >> sides[1]) - first_j + 1),
            np.uint8,
        )
        mark(matrix, boxes, i, j, *sides, first_i, first_j, wanted)
        begin = first_i << sides[0]
        across = 1 << sides[0]
        if slab and sides[0] == _WHOLE:
            wanted = wanted.max(axis=0, keepdims=True)
            begin = slab[0]
            across = slab[1] - slab[0]
        addresses = np.zeros(wanted.shape, np.uint64)
        held = []
        for a, b in zip(*(index.tolist() for index in np.nonzero(wanted)), strict=True):
            k = begin + a * across
            m = (first_j + b) << sides[1]
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


@kernel
def boxes_of(x, y):  # type: ignore[no-untyped-def]
    """Middles and half widths of what `RUN` successive positions span: (n, runs, 4) x, y, half x,
    half y.
    """
    out = np.empty((x.shape[0], (x.shape[1] + RUN - 1) // RUN, 4))
    for n in range(x.shape[0]):
        for r in range(out.shape[1]):
            a, b = x[n, r * RUN], y[n, r * RUN]
            c, d = a, b
            for t in range(r * RUN + 1, min((r + 1) * RUN, x.shape[1])):
                a, c = min(a, x[n, t]), max(c, x[n, t])
                b, d = min(b, y[n, t]), max(d, y[n, t])
            out[n, r, 0], out[n, r, 1], out[n, r, 2], out[n, r, 3] = (
                (a + c) / 2,
                (b + d) / 2,
                (c - a) / 2,
                (d - b) / 2,
            )
    return out


@kernel
def _cells(a, b, box, first, last):  # type: ignore[no-untyped-def]
    """First and last cells, one of rounding included, at which the 4 coefficients of a x + b y +
    (first .. last) begin.
    """
    middle, half = a * box[0] + b * box[1], abs(a) * box[2] + abs(b) * box[3]
    rounding = 1e-9 * (abs(middle) + half) + 1e-9
    low, high = (
        middle - half + min(first, last) - rounding,
        middle + half + max(first, last) + rounding,
    )
    return np.int64(np.floor(low)) - 1, np.int64(np.floor(high)) - 1


@kernel
def extent(matrix, boxes, i, j):  # type: ignore[no-untyped-def]
    """First and last cells: across low, high, along low, high. The drift (i, j) is steady, so its
    ends bound it.
    """
    low_i = low_j = np.int64(1 << 62)
    high_i = high_j = -low_i
    for n in range(boxes.shape[0]):
        for r in range(boxes.shape[1]):
            t, last = r * RUN, min((r + 1) * RUN, i.size) - 1
            a, b = _cells(matrix[0], matrix[1], boxes[n, r], i[t], i[last])
            c, d = _cells(matrix[2], matrix[3], boxes[n, r], j[t], j[last])
            low_i, high_i, low_j, high_j = (
                min(low_i, a),
                max(high_i, b),
                min(low_j, c),
                max(high_j, d),
            )
    return low_i, high_i, low_j, high_j


@kernel
def mark(  # type: ignore[no-untyped-def]
    matrix, boxes, i, j, side_i, side_j, first_i, first_j, wanted
):
    """Set 1 where a tile is wanted; (first_i, first_j) is the first tile."""
    for n in range(boxes.shape[0]):
        for r in range(boxes.shape[1]):
            t, last = r * RUN, min((r + 1) * RUN, i.size) - 1
            a, b = _cells(matrix[0], matrix[1], boxes[n, r], i[t], i[last])
            c, d = _cells(matrix[2], matrix[3], boxes[n, r], j[t], j[last])
            for k in range(a >> side_i, (b >> side_i) + 1):
                for m in range(c >> side_j, (d >> side_j) + 1):
                    wanted[k - first_i, m - first_j] = 1


@kernel
def interpolate(  # type: ignore[no-untyped-def]
    matrix, x, y, i, j, side_i, side_j, low_i, low_j, width, addresses, constants, bands, out
):
    """out[band] += amplitude * the cubic B-spline of the band's coefficients, for each of the
    ``bands`` (a tuple).

    ``addresses``: (tiles across, tiles along) uint64, of tiles in which the coefficients of the
    bands alternate. (low_i, low_j): the first cell of the first tile; ``width``: cells in a row of
    a tile. ``constants``: 1/6, 2/3, 1/2, 1 and the amplitude, of the type that the spline is summed
    in.
    """
    m0, m1, m2, m3 = matrix[0], matrix[1], matrix[2], matrix[3]
    inside_i, inside_j = nb.int32((1 << side_i) - 1), nb.int32((1 << side_j) - 1)
    n_bands = nb.uint64(len(bands))
    stride, width, columns_of_tiles = (
        nb.uint64(width) * n_bands,
        nb.int32(width),
        nb.int32(addresses.shape[1]),
    )
    shift_i, shift_j = nb.int32(side_i), nb.int32(side_j)
    # Cells are counted from the first tile's, in 32 bits: what the box of one call holds fits.
    origin_i, origin_j = float(low_i), float(low_j)
    flat = addresses.reshape(-1)
    sixth, two_thirds, half, one, amplitude = (
        constants[0],
        constants[1],
        constants[2],
        constants[3],
        constants[4],
    )
    tile, inside = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    kind, size = constants.dtype, nb.uint64(4) * n_bands  # numbers of a point, and bytes of a cell
    u, v, sums = (
        np.empty(CHUNK, kind),
        np.empty(CHUNK, kind),
        np.empty(4 * len(bands) * CHUNK, kind),
    )
    w0, w1, w2, w3 = (
        np.empty(CHUNK, kind),
        np.empty(CHUNK, kind),
        np.empty(CHUNK, kind),
        np.empty(CHUNK, kind),
    )
    for n in range(x.shape[0]):
        for start in range(0, x.shape[1], CHUNK):
            count = nb.uint64(min(CHUNK, x.shape[1] - start))
            px, py, pi, pj = x[n][start:], y[n][start:], i[start:], j[start:]
            for t in range(count):
                p, q = m0 * px[t] + m1 * py[t] + pi[t], m2 * px[t] + m3 * py[t] + pj[t]
                fp, fq = np.floor(p), np.floor(q)
                u[t], v[t] = p - fp, q - fq
                k, m = nb.int32(fp - 1 - origin_i), nb.int32(fq - 1 - origin_j)
                tile[t] = nb.int32(nb.int32((k >> shift_i) * columns_of_tiles) + (m >> shift_j))
                inside[t] = nb.int32(nb.int32((k & inside_i) * width) + (m & inside_j))
            for t in range(count):
                p = u[t]
                q = one - p
                w0[t], w1[t] = (
                    amplitude * (q * q * q * sixth),
                    amplitude * (two_thirds - p * p * (one - p * half)),
                )
                w2[t], w3[t] = (
                    amplitude * (two_thirds - q * q * (one - q * half)),
                    amplitude * (p * p * p * sixth),
                )
            for t in range(count):
                where = flat[nb.uint64(tile[t])] + size * nb.uint64(inside[t])
                four_columns_at(where, stride, w0[t], w1[t], w2[t], w3[t], bands, sums, size * t)
            for t in range(count):
                p = v[t]
                q = one - p
                w0[t], w1[t] = q * q * q * sixth, two_thirds - p * p * (one - p * half)
                w2[t], w3[t] = two_thirds - q * q * (one - q * half), p * p * p * sixth
            for b in range(n_bands):
                row = out[bands[b], n][start:]
                for t in range(count):
                    k, m, p, q = size * t + b, n_bands, 2 * n_bands, 3 * n_bands
                    row[t] += (
                        w0[t] * sums[k]
                        + w1[t] * sums[k + m]
                        + w2[t] * sums[k + p]
                        + w3[t] * sums[k + q]
                    )
