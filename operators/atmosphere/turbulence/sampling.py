"""Evaluation of the layers along lines of sight, at a step in time of each layer's own, from tiles
of their lattices.

A layer's spline coefficients come in tiles (`tiles`). A point has the same bits whichever points it
is evaluated with, and whichever bands look through the same lattices.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from zonda.core.data import Observation
from zonda.core.errors import InputError
from zonda.core.numerics.smooth import PAD, SPLINE_MARGIN, DetectorField, spline_coefficients
from zonda.core.types import AnyFloats, Floats

from .geometry import ScanPlane, rim
from .lattice import Turbulence
from .lines_of_sight import LinesOfSight
from .tiles import Swept, Tiles, Tiling, boxes_of, extent, interpolate, points_of

CELLS_IN_ALL = 2e10
"""Lattice points of one scan beyond which the run is refused."""

TIMES_AT_ONCE = 2048
"""Coarse times whose tiles are held at once."""


@dataclass(frozen=True)
class Drifting:
    """A layer to evaluate: its turbulence, height [m], share, wind [m/s], and step in time
    [samples].
    """

    field: Turbulence
    height: float
    amplitude: float
    wind: Floats
    step: int


class DriftingLayers:
    """The sum of drifting layers at any focal-plane points and times of one scan, in units of the
    PWV's rms.

    Times are numbered in units of ``step``: time k is sample k step. Layers that take a coarser
    step of their own are interpolated in time to the common one (cubic spline).

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
        self._drifting = list(drifting)
        self._step = step
        self._band = 0
        self.weights = np.zeros((0, len(self._drifting)))
        """(k, n_layer) weights of further sums over the layers, which `sums` makes beside the plain
        one.
        """
        self.paths: dict[int, LinesOfSight] = {}
        for own in sorted({step, *(layer.step for layer in drifting)}):
            low, high = (first, stop) if own == step else _coarse(first, stop, own // step)
            self.paths[own] = LinesOfSight(observation, plane, own, low, high - low)
        self._constants: list[AnyFloats] = [
            np.array([1 / 6, 2 / 3, 0.5, 1.0, layer.amplitude], dtype) for layer in drifting
        ]
        self._places = [_place(plane, layer, self.paths[layer.step].seconds) for layer in drifting]
        self._swept = self._sweep(*rim(*points))
        tiles = Tiles()
        self._tilings = [
            Tiling(tiles, n, {0: layer.field}, swept)
            for n, (layer, swept) in enumerate(zip(drifting, self._swept, strict=True))
        ]
        self.cells = sum(swept.cells for swept in self._swept)
        """Lattice points swept over, about."""
        if self.cells > CELLS_IN_ALL:
            field = max(zip(self._swept, drifting, strict=True), key=lambda pair: pair[0].cells)[
                1
            ].field
            raise InputError(
                f"the lines of sight sweep over {self.cells:.1e} lattice points of the turbulence"
                f" ({field.spacing:g} m for a beam of {field.sigma:.3g} m), the limit is"
                f" {CELLS_IN_ALL:.0e}",
                place="atmosphere",
                cure="shorten the scans, narrow the field of view, or raise the lowest layer",
            )

    def __call__(self, xi: Floats, eta: Floats, first: int, count: int) -> tuple[Floats, Floats]:
        """The sum of the layers and the sine of the elevation, each (len(xi), count), from time
        ``first``.
        """
        (total,), _, sine = self.sums([], xi, eta, first, count)
        return np.asarray(total, np.float64), sine

    def sums(
        self,
        others: Sequence[DriftingLayers],
        xi: Floats,
        eta: Floats,
        first: int,
        count: int,
    ) -> tuple[Floats, list[Floats], Floats]:
        """Sums (1 + len(others), len(xi), count) of the layers of this band and of ``others`` that
        look as it does, whose lines of sight are found once; for each band its weighted sums, (k,
        len(xi), count) in the order of its ``weights``; sines of the elevation.

        The plain sums have the same bits with such weights and without.
        """
        bands = [self, *others]
        stop = first + count
        total = np.zeros((len(bands), len(xi), count))
        sine = np.empty((len(xi), count))
        weighted = [np.zeros((len(band.weights), len(xi), count)) for band in bands]
        for own in sorted(set().union(*(band.paths for band in bands))):
            if own == self._step:
                _sums_at(bands, own, xi, eta, first, total, weighted, sine)
            else:
                _add_coarse(bands, own, xi, eta, (first, stop), total, weighted)
        return total, weighted, sine

    def _add_layer(
        self,
        n: int,
        bands: tuple[int, ...],
        which: tuple[int, ...],
        x: Floats,
        y: Floats,
        boxes: Floats,
        at: slice,
        out: Floats,
    ) -> None:
        """Add layer ``n`` at positions x, y and times ``at`` to out[k] of each k in ``which``, as
        these ``bands`` of its tiles see it.
        """
        matrix, i, j = self._places[n]
        i = i[at]
        j = j[at]
        cover = self._tilings[n].cover(bands, matrix, boxes, i, j)
        where = *cover.sides, *cover.origin, cover.width, cover.addresses
        interpolate(matrix, x, y, i, j, *where, self._constants[n], which, out)

    def looks_as(self, other: DriftingLayers) -> bool:
        """True if another band looks along the same lines at the same times, at layers that drift
        alike.
        """
        if self._step != other._step or len(self._drifting) != len(other._drifting):
            return False
        if not all(
            path.same_as(other.paths[step])
            for step, path in self.paths.items()
            if step in other.paths
        ):
            return False
        for n, (layer, theirs) in enumerate(zip(self._drifting, other._drifting, strict=True)):
            own = (*self._places[n], self._constants[n])
            others = (*other._places[n], other._constants[n])
            if layer.step == theirs.step and not all(map(np.array_equal, own, others)):
                return False
        return self._constants[0].dtype == other._constants[0].dtype

    def _sweep(self, xi: Floats, eta: Floats) -> list[Swept]:
        """Regions that the lines of sight of the rim (xi, eta) of the points sweep over, for each
        layer.
        """
        whole = [(1 << 62, -(1 << 62), 1 << 62, -(1 << 62))] * len(self._drifting)
        cells = [0.0] * len(self._drifting)
        for own, path in self.paths.items():
            for start in range(0, path.count, TIMES_AT_ONCE):
                count = min(TIMES_AT_ONCE, path.count - start)
                x, y, _ = path(xi, eta, path.first + start, count)
                boxes = boxes_of(x, y)
                for n, layer in enumerate(self._drifting):
                    if layer.step == own:
                        matrix, i, j = self._places[n]
                        a, b, c, d = extent(
                            matrix,
                            boxes,
                            i[start : start + count],
                            j[start : start + count],
                        )
                        cells[n] += points_of((a, b, c, d))
                        k, m, p, q = whole[n]
                        whole[n] = min(k, a), max(m, b), min(p, c), max(q, d)
        return [
            Swept(box, min(number, points_of(box)))
            for box, number in zip(whole, cells, strict=True)
        ]


def _sums_at(
    bands: Sequence[DriftingLayers],
    step: int,
    xi: Floats,
    eta: Floats,
    first: int,
    total: Floats,
    weighted: Sequence[Floats],
    sine: Floats,
) -> None:
    """Write the sums over the layers that take this ``step`` in time into the arrays that
    `DriftingLayers.sums` returns, at times of that step from ``first`` on.
    """
    path = next(band.paths[step] for band in bands if step in band.paths)
    groups = _groups(bands, step)
    count = sine.shape[1]
    for start in range(0, count, TIMES_AT_ONCE):
        now = slice(start, min(start + TIMES_AT_ONCE, count))
        x, y, sine[:, now] = path(xi, eta, first + start, now.stop - start)
        at = slice(first + start - path.first, first + now.stop - path.first)
        part = np.zeros((len(bands), *x.shape))
        boxes = boxes_of(x, y)
        parts = [np.zeros((len(band.weights), *x.shape)) for band in bands]
        for n, which in groups:
            alone = np.zeros_like(part) if any(len(parts[k]) for k in which) else part
            numbers = tuple(bands[k]._band for k in which)
            bands[which[0]]._add_layer(n, numbers, which, x, y, boxes, at, alone)
            for k in which if alone is not part else ():
                part[k] += alone[k]
                for row, weight in zip(parts[k], bands[k].weights[:, n].tolist(), strict=True):
                    row += weight * alone[k]
        total[:, :, now] = part
        for whole, piece in zip(weighted, parts, strict=True):
            whole[:, :, now] = piece


def _add_coarse(
    bands: Sequence[DriftingLayers],
    step: int,
    xi: Floats,
    eta: Floats,
    span: tuple[int, int],
    total: Floats,
    weighted: Sequence[Floats],
) -> None:
    """Add the layers that take this coarser ``step`` in time, interpolated to the common one over
    ``span`` (first, stop).
    """
    (first, stop), ratio = span, step // bands[0]._step
    low, high = _coarse(first, stop, ratio)
    shape = len(xi), high - low
    values = np.empty((len(bands), *shape))
    others = [np.empty((len(band.weights), *shape)) for band in bands]
    _sums_at(bands, step, xi, eta, low, values, others, np.empty(shape))
    # Coefficient 0 stands at coarse time low + SPLINE_MARGIN, the time -PAD of DetectorField.
    offset = first - (low + SPLINE_MARGIN + PAD) * ratio
    where = slice(0, len(xi)), slice(offset, offset + stop - first)
    for k in (k for k, band in enumerate(bands) if step in band.paths):
        for coarse, into in ((values[k], total[k]), *zip(others[k], weighted[k], strict=True)):
            fine = DetectorField(spline_coefficients(coarse), ratio, (high - low) * ratio)
            into += fine.evaluate(*where)


def _groups(bands: Sequence[DriftingLayers], step: int) -> list[tuple[int, tuple[int, ...]]]:
    """(layer, numbers of bands) of the layers that take a step in time: bands that see one tiling
    are together.
    """
    found: dict[tuple[int, int], tuple[int, ...]] = {}
    for n in range(len(bands[0]._drifting)):
        for k, band in enumerate(bands):
            if band._drifting[n].step == step:
                key = n, id(band._tilings[n])
                found[key] = (*found.get(key, ()), k)
    return [(n, which) for (n, _), which in found.items()]


def share_tiles(bands: Sequence[DriftingLayers]) -> list[Counter[int]]:
    """Let bands of one camera, in the order in which they observe, make tiles for each other where
    they look through one lattice.

    For each band, the number of layers of each other band that are on the lattices it looks
    through.
    """
    tiles = Tiles()
    number = 0
    found = [Counter[int]() for _ in bands]
    for layer in range(len(bands[0]._drifting)):
        left = list(range(len(bands)))
        while left:
            field = bands[left[0]]._drifting[layer].field
            swept = bands[left[0]]._swept[layer]
            here = []
            for other in left:
                one = bands[other]
                if one._drifting[layer].field.alike(field) and (
                    joined := swept.joined(one._swept[layer])
                ):
                    swept = joined
                    here.append(other)
            tiling = Tiling(
                tiles,
                number,
                {k: bands[k]._drifting[layer].field for k in here},
                swept,
            )
            for k in here:
                bands[k]._band, bands[k]._tilings[layer] = k, tiling
                found[k].update(other for other in here if other != k)
            left = [k for k in left if k not in here]
            number = number + 1
    return found


def _coarse(first: int, stop: int, ratio: int) -> tuple[int, int]:
    """Coarse times whose values make times first .. stop - 1: cells, spline neighbours and the
    prefilter's margin.
    """
    return first // ratio - PAD - SPLINE_MARGIN, (stop - 1) // ratio + 3 + SPLINE_MARGIN


def _place(plane: ScanPlane, layer: Drifting, seconds: Floats) -> tuple[Floats, Floats, Floats]:
    """Lattice coordinates (across, along the wind) = matrix (x, y) + (i, j) of positions per metre
    of height.

    Equation (2) of `geometry`; matrix (4,), i and j at ``seconds``, both about 0 where the scan
    begins.
    """
    matrix, start, velocity = plane.affine(layer.height, layer.wind)
    d = layer.field.spacing
    i, j = (
        np.asarray((b + v * seconds) / d, np.float64) for b, v in zip(start, velocity, strict=True)
    )
    return matrix.ravel() / d, i, j
