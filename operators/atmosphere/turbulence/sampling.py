"""Evaluation of the layers along lines of sight, at a step in time of each layer's own, from tiles of their lattices.

A layer's spline coefficients are made in tiles that overlap by the three cells a cubic spline needs, so that every point is
interpolated from one tile. Tiles are kept up to `BYTES_KEPT`; any tile has the same bits whenever it is made, and a point
the same bits whichever points it is evaluated with. Where a scan sweeps over few cells they are made as one piece; over a strip
along the wind, in slabs as wide as that, since squares would hold more than is used; along a narrow path that turns, in strips.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.compilation.columns import four_columns_at
from zonda.core.compilation.jit import nb
from zonda.core.data import Observation
from zonda.core.errors import InputError
from zonda.core.numerics.smooth import PAD, SPLINE_MARGIN, DetectorField, spline_coefficients
from zonda.core.types import Floats

from .geometry import ScanPlane, rim
from .lattice import Turbulence
from .levels import Field
from .lines_of_sight import LinesOfSight

_Key = tuple[int, tuple[int, int, int, int]]

SQUARE, STRIP = (8, 8), (5, 10)
"""Sides of a tile, as powers of two of cells (across, along the wind): in general, and where the path is narrow."""

NARROW = 96
"""Cells: a path that is narrower than this across the wind, and has no slabs, is tiled by strips."""

SLAB, WIDEST, LONGEST = 1 << 16, 1024, 1 << 10
"""Cells of a slab, about; cells across the wind up to which there are slabs; most cells along it."""

DENSE = 1.5
"""Slabs serve where all that they hold is at most this many times what is swept over at `TIMES_AT_ONCE` times after another."""

APRON = 3
"""Cells by which tiles overlap."""

ONE_PIECE = 1 << 16
"""Cells of a layer, with `AROUND` more on every side, up to which all that a scan sweeps over is made as one piece."""

AROUND, SPARE = 20, 2
"""Cells about the made ones that the pyramid works out too, about; and those beyond what the rim of the points sweeps over."""

BYTES_KEPT = 512 << 20
"""Memory of the tiles that are kept."""

CELLS_IN_ALL = 2e10
"""Lattice points of one scan beyond which the run is refused."""

TIMES_AT_ONCE = 2048
"""Coarse times whose tiles are held at once."""

_CHUNK, _RUN = 256, 16

_WHOLE = 30
"""Side of the only tile, as a power of two of cells: none is so large."""


@dataclass(frozen=True)
class Drifting:
    """A layer to evaluate: its turbulence, height [m], share, wind [m/s], and step in time [samples]."""

    field: Turbulence
    height: float
    amplitude: float
    wind: Floats
    step: int


class Tiles:
    """The coefficients of several layers, as many as `BYTES_KEPT` allow. Safe for threads."""

    def __init__(self) -> None:
        self._kept: dict[_Key, tuple[Field, int]] = {}
        self._making: dict[_Key, Future[tuple[Field, int]]] = {}
        self._lock = threading.Lock()
        self._free = BYTES_KEPT

    def get(self, field: Turbulence, layer: int, box: tuple[int, int, int, int]) -> tuple[Field, int]:
        """Coefficients of a layer and their address: of the cells low <= i < high, low <= j < high of a box, with the apron."""
        key = (layer, box)
        kept = self._kept.get(key)
        if kept is not None:
            return kept
        with self._lock:
            kept = self._kept.get(key)
            if kept is not None:
                return kept
            mine = key not in self._making
            making = self._making.setdefault(key, Future())
        if not mine:
            return making.result()
        try:
            a, b, c, d = box
            tile = field.coefficients(a, b + APRON, c, d + APRON)
            made = tile, tile.ctypes.data
        except BaseException as error:
            making.set_exception(error)
            with self._lock:
                del self._making[key]
            raise
        with self._lock:
            self._free -= tile.nbytes
            while self._free < 0 and self._kept:  # the oldest goes first; a thread that works with it still holds it
                self._free += self._kept.pop(next(iter(self._kept)))[0].nbytes
            self._kept[key] = made
            del self._making[key]
        making.set_result(made)
        return made


class DriftingLayers:
    """The sum of drifting layers at any focal-plane points and times of one scan, in units of the PWV's rms.

    Times are numbered in units of ``step``: time k is sample k step. Layers that take a coarser step of their own are
    interpolated in time to the common one (cubic spline).

    Parameters
    ----------
    observation, plane
        The scan and its plane.
    points
        The focal-plane points (xi, eta) that will be evaluated.
    drifting
        The layers; their steps are ``step`` times powers of two.
    step
        Samples between times.
    span
        First time that may be evaluated, and the one after the last.
    dtype
        What the splines over the lattices are summed in: float32 is right to 1e-7 of each layer.

    Raises
    ------
    InputError
        Where the lines of sight sweep over more than `CELLS_IN_ALL` lattice points.
    PointingError
        Where one is below the horizon.
    """

    def __init__(
        self,
        observation: Observation,
        plane: ScanPlane,
        points: tuple[Floats, Floats],
        drifting: Sequence[Drifting],
        step: int,
        span: tuple[int, int],
        dtype: type = np.float64,
    ) -> None:
        first, stop = span
        self._drifting, self._step, self._tiles = list(drifting), step, Tiles()
        self.paths: dict[int, LinesOfSight] = {}
        for own in sorted({step, *(d.step for d in drifting)}):
            low, high = (first, stop) if own == step else _coarse(first, stop, own // step)
            self.paths[own] = LinesOfSight(observation, plane, own, low, high - low)
        self._constants: list[NDArray[np.floating]] = [
            np.array([1 / 6, 2 / 3, 0.5, 1.0, d.amplitude], dtype) for d in self._drifting
        ]
        self._places = [_place(plane, d, self.paths[d.step].seconds) for d in self._drifting]
        swept = self._swept(*rim(*points))
        self._slabs = [_slab(box, cells) for box, cells in swept]
        self._sides = [STRIP if box[1] - box[0] < NARROW else SQUARE for box, _ in swept]
        self._pieces = [_widened(box) for box, _ in swept]
        self.cells = sum(cells for _, cells in swept)
        """Lattice points swept over, about."""
        if self.cells > CELLS_IN_ALL:
            worst = max(range(len(swept)), key=lambda n: swept[n][1])
            field = drifting[worst].field
            raise InputError(
                f"the lines of sight sweep over {self.cells:.1e} lattice points of the turbulence "
                f"({field.spacing:g} m for a beam of {field.sigma:.3g} m), the limit is {CELLS_IN_ALL:.0e}",
                place="atmosphere",
                cure="shorten the scans, narrow the field of view, or raise the lowest layer",
            )

    def __call__(self, xi: Floats, eta: Floats, first: int, count: int) -> tuple[Floats, Floats]:
        """The sum of the layers and the sine of the elevation, each (len(xi), count), from time ``first``."""
        stop = first + count
        total, sine = np.zeros((len(xi), count)), np.empty((len(xi), count))
        for own, path in self.paths.items():
            ratio = own // self._step
            low, high = (first, stop) if ratio == 1 else _coarse(first, stop, ratio)
            values = total if ratio == 1 else np.empty((len(xi), high - low))
            for start in range(low, high, TIMES_AT_ONCE):
                end = min(start + TIMES_AT_ONCE, high)
                x, y, up = path(xi, eta, start, end - start)
                part, boxes = np.zeros(x.shape), _boxes(x, y)
                for n, layer in enumerate(self._drifting):
                    if layer.step == own:
                        self._add(n, x, y, boxes, start - path.first, part)
                values[:, start - low : end - low] = part
                if ratio == 1:
                    sine[:, start - low : end - low] = up
            if ratio > 1:
                fine = DetectorField(spline_coefficients(values), ratio, (high - low) * ratio)
                # Coefficient 0 stands at coarse time low + SPLINE_MARGIN, where DetectorField has its time -PAD.
                offset = first - (low + SPLINE_MARGIN + PAD) * ratio
                total += fine.evaluate(slice(0, len(xi)), slice(offset, offset + count))
        return total, sine

    def _add(self, n: int, x: Floats, y: Floats, boxes: Floats, start: int, out: Floats) -> None:
        """out += layer ``n`` at the positions (x, y) per metre of height, at times from number ``start`` of its path."""
        layer, sides, (matrix, i, j) = self._drifting[n], self._sides[n], self._places[n]
        i, j = i[start : start + x.shape[1]], j[start : start + x.shape[1]]
        low_i, high_i, low_j, high_j = _extent(matrix, boxes, i, j)
        piece = self._pieces[n]
        if piece and piece[0] <= low_i <= high_i < piece[1] and piece[2] <= low_j <= high_j < piece[3]:
            tile, address = self._tiles.get(layer.field, n, piece)
            addresses, held = np.array([[address]], np.uint64), [tile]
            sides, origin, width = (_WHOLE, _WHOLE), (piece[0], piece[2]), tile.shape[1]
        else:
            slab = self._slabs[n]
            if slab and slab[0] <= low_i <= high_i < slab[1]:
                sides = _WHOLE, slab[2]
            first_i, first_j = low_i >> sides[0], low_j >> sides[1]
            wanted = np.zeros(((high_i >> sides[0]) - first_i + 1, (high_j >> sides[1]) - first_j + 1), np.uint8)
            _mark(matrix, boxes, i, j, *sides, first_i, first_j, wanted)
            begin, across = first_i << sides[0], 1 << sides[0]
            if slab and sides[0] == _WHOLE:
                wanted = wanted.max(axis=0, keepdims=True)
                begin, across = slab[0], slab[1] - slab[0]
            addresses, held = np.zeros(wanted.shape, np.uint64), []
            for a, b in zip(*(index.tolist() for index in np.nonzero(wanted)), strict=True):
                k, m = begin + a * across, (first_j + b) << sides[1]
                box = (k, k + across, m, m + (1 << sides[1]))
                tile, addresses[a, b] = self._tiles.get(layer.field, n, box)
                held.append(tile)  # or it might be dropped while it is read
            origin, width = (begin, first_j << sides[1]), (1 << sides[1]) + APRON
        _interpolate(matrix, x, y, i, j, *sides, *origin, width, addresses, self._constants[n], out)

    def _swept(self, xi: Floats, eta: Floats) -> list[tuple[tuple[int, int, int, int], float]]:
        """For each layer the first and last cells, across and along the wind, that the lines of sight of the rim (xi, eta) of
        the points reach; and about how many lattice points they sweep over."""
        whole = [(1 << 62, -(1 << 62), 1 << 62, -(1 << 62))] * len(self._drifting)
        cells = [0.0] * len(self._drifting)
        for own, path in self.paths.items():
            for start in range(0, path.count, TIMES_AT_ONCE):
                count = min(TIMES_AT_ONCE, path.count - start)
                x, y, _ = path(xi, eta, path.first + start, count)
                boxes = _boxes(x, y)
                for n, layer in enumerate(self._drifting):
                    if layer.step == own:
                        matrix, i, j = self._places[n]
                        a, b, c, d = _extent(matrix, boxes, i[start : start + count], j[start : start + count])
                        cells[n] += (b - a + 2.0 * AROUND) * (d - c + 2.0 * AROUND)
                        k, m, p, q = whole[n]
                        whole[n] = min(k, a), max(m, b), min(p, c), max(q, d)
        return [(box, min(number, _cells_of(box))) for box, number in zip(whole, cells, strict=True)]


def _cells_of(box: tuple[int, int, int, int]) -> float:
    """Lattice points of a box, with those about it."""
    return (box[1] - box[0] + 2.0 * AROUND) * (box[3] - box[2] + 2.0 * AROUND)


def _widened(box: tuple[int, int, int, int]) -> tuple[int, int, int, int] | None:
    """What is made as one piece, low <= i < high, low <= j < high; None where that is too much."""
    if _cells_of(box) > ONE_PIECE:
        return None
    return box[0] - SPARE, box[1] + 1 + SPARE, box[2] - SPARE, box[3] + 1 + SPARE


def _slab(box: tuple[int, int, int, int], swept: float) -> tuple[int, int, int] | None:
    """Of slabs the cells across, low <= i < high, and the side along the wind, a power of two; None where they do not serve."""
    low, high = box[0] - SPARE, box[1] + 1 + SPARE
    if high - low > WIDEST or _cells_of(box) > DENSE * swept:
        return None
    return low, high, max(1, min(SLAB // max(high - low, 1), LONGEST)).bit_length() - 1


def _coarse(first: int, stop: int, ratio: int) -> tuple[int, int]:
    """Coarse times whose values make times first .. stop - 1: cells, spline neighbours and the prefilter's margin."""
    return first // ratio - PAD - SPLINE_MARGIN, (stop - 1) // ratio + 3 + SPLINE_MARGIN


def _place(plane: ScanPlane, layer: Drifting, seconds: Floats) -> tuple[Floats, Floats, Floats]:
    """Lattice coordinates (across, along the wind) = matrix (x, y) + (i, j) of positions per metre of height.

    Equation (2) of `geometry`; matrix (4,), i and j at ``seconds``, both about 0 where the scan begins.
    """
    matrix, start, velocity = plane.affine(layer.height, layer.wind)
    d = layer.field.spacing
    i, j = (np.asarray((b + v * seconds) / d, np.float64) for b, v in zip(start, velocity, strict=True))
    return matrix.ravel() / d, i, j


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _boxes(x, y):  # type: ignore[no-untyped-def]
    """Middles and half widths of what `_RUN` successive positions span: (n, runs, 4) x, y, half x, half y."""
    out = np.empty((x.shape[0], (x.shape[1] + _RUN - 1) // _RUN, 4))
    for n in range(x.shape[0]):
        for r in range(out.shape[1]):
            a, b = x[n, r * _RUN], y[n, r * _RUN]
            c, d = a, b
            for t in range(r * _RUN + 1, min((r + 1) * _RUN, x.shape[1])):
                a, c = min(a, x[n, t]), max(c, x[n, t])
                b, d = min(b, y[n, t]), max(d, y[n, t])
            out[n, r, 0], out[n, r, 1], out[n, r, 2], out[n, r, 3] = (a + c) / 2, (b + d) / 2, (c - a) / 2, (d - b) / 2
    return out


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _cells(a, b, box, first, last):  # type: ignore[no-untyped-def]
    """First and last cells, one of rounding included, at which the 4 coefficients of a x + b y + (first .. last) begin."""
    middle, half = a * box[0] + b * box[1], abs(a) * box[2] + abs(b) * box[3]
    rounding = 1e-9 * (abs(middle) + half) + 1e-9
    low, high = middle - half + min(first, last) - rounding, middle + half + max(first, last) + rounding
    return np.int64(np.floor(low)) - 1, np.int64(np.floor(high)) - 1


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _extent(matrix, boxes, i, j):  # type: ignore[no-untyped-def]
    """First and last cells: across low, high, along low, high. The drift (i, j) is steady, so its ends bound it."""
    low_i = low_j = np.int64(1 << 62)
    high_i = high_j = -low_i
    for n in range(boxes.shape[0]):
        for r in range(boxes.shape[1]):
            t, last = r * _RUN, min((r + 1) * _RUN, i.size) - 1
            a, b = _cells(matrix[0], matrix[1], boxes[n, r], i[t], i[last])
            c, d = _cells(matrix[2], matrix[3], boxes[n, r], j[t], j[last])
            low_i, high_i, low_j, high_j = min(low_i, a), max(high_i, b), min(low_j, c), max(high_j, d)
    return low_i, high_i, low_j, high_j


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _mark(matrix, boxes, i, j, side_i, side_j, first_i, first_j, wanted):  # type: ignore[no-untyped-def]
    """Set 1 where a tile is wanted; (first_i, first_j) is the first tile."""
    for n in range(boxes.shape[0]):
        for r in range(boxes.shape[1]):
            t, last = r * _RUN, min((r + 1) * _RUN, i.size) - 1
            a, b = _cells(matrix[0], matrix[1], boxes[n, r], i[t], i[last])
            c, d = _cells(matrix[2], matrix[3], boxes[n, r], j[t], j[last])
            for k in range(a >> side_i, (b >> side_i) + 1):
                for m in range(c >> side_j, (d >> side_j) + 1):
                    wanted[k - first_i, m - first_j] = 1


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _interpolate(matrix, x, y, i, j, side_i, side_j, low_i, low_j, width, addresses, constants, out):  # type: ignore[no-untyped-def]
    """out += amplitude * the cubic B-spline whose coefficients lie at ``addresses`` (uint64, one for each tile).

    (low_i, low_j): the first cell of the first tile; ``width``: cells in a row of a tile. ``constants``: 1/6, 2/3, 1/2, 1 and the
    amplitude, of the type that the spline is summed in.
    """
    a, b, c, d = matrix[0], matrix[1], matrix[2], matrix[3]
    inside_i, inside_j = nb.int32((1 << side_i) - 1), nb.int32((1 << side_j) - 1)
    width, columns_of_tiles = nb.int32(width), nb.int32(addresses.shape[1])
    shift_i, shift_j = nb.int32(side_i), nb.int32(side_j)
    # Cells are counted from the first tile's, in 32 bits: what the box of one call holds fits.
    origin_i, origin_j = float(low_i), float(low_j)
    stride, flat = nb.uint64(width), addresses.reshape(-1)
    sixth, two_thirds, half, one, amplitude = constants[0], constants[1], constants[2], constants[3], constants[4]
    tile, inside = np.empty(_CHUNK, np.int32), np.empty(_CHUNK, np.int32)
    kind = constants.dtype
    u, v, sums = np.empty(_CHUNK, kind), np.empty(_CHUNK, kind), np.empty(4 * _CHUNK, kind)
    w0, w1, w2, w3 = np.empty(_CHUNK, kind), np.empty(_CHUNK, kind), np.empty(_CHUNK, kind), np.empty(_CHUNK, kind)
    for n in range(x.shape[0]):
        for start in range(0, x.shape[1], _CHUNK):
            count = nb.uint64(min(_CHUNK, x.shape[1] - start))
            px, py, pi, pj, row = x[n][start:], y[n][start:], i[start:], j[start:], out[n][start:]
            for t in range(count):
                p, q = a * px[t] + b * py[t] + pi[t], c * px[t] + d * py[t] + pj[t]
                fp, fq = np.floor(p), np.floor(q)
                u[t], v[t] = p - fp, q - fq
                k, m = nb.int32(fp - 1 - origin_i), nb.int32(fq - 1 - origin_j)
                tile[t] = nb.int32(nb.int32((k >> shift_i) * columns_of_tiles) + (m >> shift_j))
                inside[t] = nb.int32(nb.int32((k & inside_i) * width) + (m & inside_j))
            for t in range(count):
                p = u[t]
                q = one - p
                w0[t], w1[t] = amplitude * (q * q * q * sixth), amplitude * (two_thirds - p * p * (one - p * half))
                w2[t], w3[t] = amplitude * (two_thirds - q * q * (one - q * half)), amplitude * (p * p * p * sixth)
            for t in range(count):
                where = flat[nb.uint64(tile[t])] + nb.uint64(4) * nb.uint64(inside[t])
                four_columns_at(where, stride, w0[t], w1[t], w2[t], w3[t], sums, nb.uint64(4) * t)
            for t in range(count):
                p = v[t]
                q = one - p
                w0[t], w1[t] = q * q * q * sixth, two_thirds - p * p * (one - p * half)
                w2[t], w3[t] = two_thirds - q * q * (one - q * half), p * p * p * sixth
            for t in range(count):
                row[t] += w0[t] * sums[4 * t] + w1[t] * sums[4 * t + 1] + w2[t] * sums[4 * t + 2] + w3[t] * sums[4 * t + 3]
