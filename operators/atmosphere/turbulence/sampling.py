"""Evaluation of the layers along lines of sight, at a step in time of each layer's own, from tiles of their lattices.

A layer's spline coefficients are made in tiles that overlap by the three cells a cubic spline needs, so that every point is
interpolated from one tile. Tiles are kept (`tiles`); any tile has the same bits whenever it is made, and a point
the same bits whichever points it is evaluated with. Where a scan sweeps over few cells they are made as one piece; over a strip
along the wind, in slabs as wide as that, since squares would hold more than is used; along a narrow path that turns, in strips.

Bands of one camera whose detectors and steps are the same look through the same cells of the same lattices, each with kernels
of its own: random numbers, positions, cells and weights are found once for all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.errors import InputError
from zonda.core.numerics.smooth import PAD, SPLINE_MARGIN, DetectorField, spline_coefficients
from zonda.core.types import Floats

from .geometry import ScanPlane, rim
from .interpolation import boxes_of, extent, interpolate, mark
from .lattice import Turbulence
from .lines_of_sight import LinesOfSight
from .tiles import Tiles

SQUARE, STRIP = (8, 8), (5, 10)
"""Sides of a tile, as powers of two of cells (across, along the wind): in general, and where the path is narrow."""

NARROW = 96
"""Cells: a path that is narrower than this across the wind, and has no slabs, is tiled by strips."""

SLAB, WIDEST, LONGEST = 1 << 16, 1024, 1 << 10
"""Cells of a slab, about; cells across the wind up to which there are slabs; most cells along it."""

DENSE = 1.5
"""Slabs serve where all that they hold is at most this many times what is swept over at `TIMES_AT_ONCE` times after another."""

ONE_PIECE = 1 << 16
"""Cells of a layer, with `AROUND` more on every side, up to which all that a scan sweeps over is made as one piece."""

AROUND, SPARE = 20, 2
"""Cells about the made ones that the pyramid works out too, about; and those beyond what the rim of the points sweeps over."""

CELLS_IN_ALL = 2e10
"""Lattice points of one scan beyond which the run is refused."""

TIMES_AT_ONCE = 2048
"""Coarse times whose tiles are held at once."""

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


@dataclass(frozen=True)
class Sheet:
    """A layer as some bands see it that step through it alike; ``lattice``: the number of the lattice that it lies on."""

    layer: Drifting
    bands: tuple[int, ...]
    lattice: int

    def of(self, bands: Sequence[int]) -> tuple[int, ...]:
        """Those of some bands that see it."""
        return tuple(band for band in bands if band in self.bands)


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
    others
        The same layers as further bands see them, of which the first has number 1.

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
        others: Sequence[Sequence[Drifting]] = (),
    ) -> None:
        first, stop = span
        self._lattices, self._sheets = _sheets([drifting, *others])
        self._step, self._tiles = step, Tiles()
        self.paths: dict[int, LinesOfSight] = {}
        for own in sorted({step, *(s.layer.step for s in self._sheets)}):
            low, high = (first, stop) if own == step else _coarse(first, stop, own // step)
            self.paths[own] = LinesOfSight(observation, plane, own, low, high - low)
        self._constants: list[NDArray[np.floating]] = [
            np.array([1 / 6, 2 / 3, 0.5, 1.0, s.layer.amplitude], dtype) for s in self._sheets
        ]
        self._places = [_place(plane, s.layer, self.paths[s.layer.step].seconds) for s in self._sheets]
        swept = self._swept(*rim(*points))
        self._slabs = [_slab(box, cells) for box, cells in swept]
        self._sides = [STRIP if box[1] - box[0] < NARROW else SQUARE for box, _ in swept]
        self._pieces = [_widened(box) for box, _ in swept]
        self.cells = sum(cells for fields, (_, cells) in zip(self._lattices, swept, strict=True) if 0 in fields)
        """Lattice points swept over, about, of one band."""
        if self.cells > CELLS_IN_ALL:
            worst = max(range(len(swept)), key=lambda n: swept[n][1])
            field = next(iter(self._lattices[worst].values()))
            raise InputError(
                f"the lines of sight sweep over {self.cells:.1e} lattice points of the turbulence "
                f"({field.spacing:g} m for a beam of {field.sigma:.3g} m), the limit is {CELLS_IN_ALL:.0e}",
                place="atmosphere",
                cure="shorten the scans, narrow the field of view, or raise the lowest layer",
            )

    def __call__(self, xi: Floats, eta: Floats, first: int, count: int) -> tuple[Floats, Floats]:
        """The sum of the layers and the sine of the elevation, each (len(xi), count), from time ``first``."""
        total, sine = self.of_bands((0,), xi, eta, first, count)
        return total[0], sine

    def of_bands(self, bands: tuple[int, ...], xi: Floats, eta: Floats, first: int, count: int) -> tuple[Floats, Floats]:
        """As a call: the sums that some bands see, (len(bands), len(xi), count), and the sine."""
        stop = first + count
        total, sine = np.zeros((len(bands), len(xi), count)), np.empty((len(xi), count))
        for own, path in self.paths.items():
            ratio = own // self._step
            through = [k for k, band in enumerate(bands) if any(s.layer.step == own and band in s.bands for s in self._sheets)]
            if ratio > 1 and not through:
                continue
            low, high = (first, stop) if ratio == 1 else _coarse(first, stop, ratio)
            values = total if ratio == 1 else np.empty((len(bands), len(xi), high - low))
            for start in range(low, high, TIMES_AT_ONCE):
                end = min(start + TIMES_AT_ONCE, high)
                x, y, up = path(xi, eta, start, end - start)
                part, places = np.zeros((len(bands), *x.shape)), (x, y, boxes_of(x, y))
                for n, sheet in enumerate(self._sheets):
                    if sheet.layer.step == own and sheet.of(bands):
                        self._add(n, bands, places, start - path.first, part)
                values[:, :, start - low : end - low] = part
                if ratio == 1:
                    sine[:, start - low : end - low] = up
            for k in through if ratio > 1 else ():
                fine = DetectorField(spline_coefficients(values[k]), ratio, (high - low) * ratio)
                # Coefficient 0 stands at coarse time low + SPLINE_MARGIN, where DetectorField has its time -PAD.
                offset = first - (low + SPLINE_MARGIN + PAD) * ratio
                total[k] += fine.evaluate(slice(0, len(xi)), slice(offset, offset + count))
        return total, sine

    def _add(self, n: int, bands: tuple[int, ...], places: tuple[Floats, Floats, Floats], start: int, out: Floats) -> None:
        """out[k] += layer ``n`` as bands[k] sees it, at times from number ``start`` of its path.

        ``places``: positions (x, y) per metre of height, and their boxes.
        """
        sheet, (matrix, i, j), (x, y, boxes) = self._sheets[n], self._places[n], places
        number, i, j = sheet.lattice, i[start : start + x.shape[1]], j[start : start + x.shape[1]]
        # Of all bands that are asked for, also of those that step through the layer otherwise.
        fields = {band: field for band, field in self._lattices[number].items() if band in bands}
        planes = np.array([list(fields).index(band) for band in sheet.of(bands)], np.int64)
        rows = np.array([bands.index(band) for band in sheet.of(bands)], np.int64)
        low_i, high_i, low_j, high_j = extent(matrix, boxes, i, j)
        piece, slab, sides = self._pieces[number], self._slabs[number], self._sides[number]
        if piece and piece[0] <= low_i <= high_i < piece[1] and piece[2] <= low_j <= high_j < piece[3]:
            tile, address = self._tiles.get(fields, number, piece)
            addresses, held = np.array([[address]], np.uint64), [tile]
            sides, origin = (_WHOLE, _WHOLE), (piece[0], piece[2])
        else:
            if slab and slab[0] <= low_i <= high_i < slab[1]:
                sides = _WHOLE, slab[2]
            first_i, first_j = low_i >> sides[0], low_j >> sides[1]
            wanted = np.zeros(((high_i >> sides[0]) - first_i + 1, (high_j >> sides[1]) - first_j + 1), np.uint8)
            mark(matrix, boxes, i, j, *sides, first_i, first_j, wanted)
            begin, across = first_i << sides[0], 1 << sides[0]
            if slab and sides[0] == _WHOLE:
                wanted = wanted.max(axis=0, keepdims=True)
                begin, across = slab[0], slab[1] - slab[0]
            addresses, held = np.zeros(wanted.shape, np.uint64), []
            for a, b in zip(*(index.tolist() for index in np.nonzero(wanted)), strict=True):
                k, m = begin + a * across, (first_j + b) << sides[1]
                box = (k, k + across, m, m + (1 << sides[1]))
                tile, addresses[a, b] = self._tiles.get(fields, number, box)
                held.append(tile)  # or it might be dropped while it is read
            origin = begin, first_j << sides[1]
        interpolate(matrix, x, y, i, j, *sides, *origin, held[0].shape, addresses, self._constants[n], planes, rows, out)

    def _swept(self, xi: Floats, eta: Floats) -> list[tuple[tuple[int, int, int, int], float]]:
        """For each lattice the first and last cells, across and along the wind, that the lines of sight of the rim (xi, eta) of
        the points reach; and about how many lattice points they sweep over."""
        whole = [(1 << 62, -(1 << 62), 1 << 62, -(1 << 62))] * len(self._lattices)
        cells = [0.0] * len(self._sheets)
        for own, path in self.paths.items():
            for start in range(0, path.count, TIMES_AT_ONCE):
                count = min(TIMES_AT_ONCE, path.count - start)
                x, y, _ = path(xi, eta, path.first + start, count)
                boxes = boxes_of(x, y)
                for n, sheet in enumerate(self._sheets):
                    if sheet.layer.step == own:
                        matrix, i, j = self._places[n]
                        a, b, c, d = extent(matrix, boxes, i[start : start + count], j[start : start + count])
                        cells[n] += (b - a + 2.0 * AROUND) * (d - c + 2.0 * AROUND)
                        k, m, p, q = whole[sheet.lattice]
                        whole[sheet.lattice] = min(k, a), max(m, b), min(p, c), max(q, d)
        most = [
            max(number for number, sheet in zip(cells, self._sheets, strict=True) if sheet.lattice == k)
            for k in range(len(whole))
        ]
        return [(box, min(number, _cells_of(box))) for box, number in zip(whole, most, strict=True)]


def _sheets(of_bands: Sequence[Sequence[Drifting]]) -> tuple[list[dict[int, Turbulence]], list[Sheet]]:
    """The lattices, each with the fields of the bands that see the layer on it, by number; and layer by layer what bands that
    step through it alike evaluate together."""
    lattices: list[dict[int, Turbulence]] = []
    sheets: list[Sheet] = []
    for together in zip(*of_bands, strict=True):
        left = dict(enumerate(together))
        while left:
            first = next(iter(left.values()))
            here = {band: d for band, d in left.items() if d is first or _on_one_lattice(first, d)}
            for step in dict.fromkeys(d.step for d in here.values()):
                mine = {band: d for band, d in here.items() if d.step == step}
                sheets.append(Sheet(next(iter(mine.values())), tuple(mine), len(lattices)))
            lattices.append({band: d.field for band, d in here.items()})
            left = {band: d for band, d in left.items() if band not in here}
    return lattices, sheets


def _on_one_lattice(one: Drifting, other: Drifting) -> bool:
    places = one.height == other.height and one.amplitude == other.amplitude and np.array_equal(one.wind, other.wind)
    return places and one.field.alike(other.field)


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
