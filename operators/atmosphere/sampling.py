"""Evaluation of the layers along lines of sight: in boxes of bounded memory, at a step in time of each layer's own."""

from __future__ import annotations

import math
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.errors import InputError
from zonda.core.smooth import PAD, DetectorField

from .geometry import Track, axes_at, crossing, rays
from .nodes import MARGIN, Nodes
from .turbulence import Turbulence, interpolate

Floats = NDArray[np.float64]

CELLS_AT_ONCE = 1 << 22
"""Lattice points worked on at a time: bounds the memory."""

TILE = 256
"""Cells: side of a tile of spline coefficients that is kept for lines of sight which come back to it."""

TILES_KEPT = 2000
"""Tiles, of 256 kB each."""

CELLS_IN_ALL = 2e10
"""Lattice points of one scan beyond which the run is refused."""

POINTS_AT_ONCE = 1 << 20
"""Lines of sight worked on at a time."""

DOUBLE_UP_TO = 1 << 22
"""Points up to which the sum of the layers is kept in float64; in float32 beyond (1e-7 of the fluctuation)."""


@dataclass(frozen=True)
class Drifting:
    """A layer to evaluate: its turbulence, height [m], share, wind [m/s], and step in time [samples]."""

    field: Turbulence
    height: float
    amplitude: float
    wind: Floats
    step: int


def evaluate_layers(observation: Observation, track: Track, nodes: Nodes, step: int, drifting: list[Drifting]) -> Floats:
    """Sum of the layers at the nodes and at `times_with_margin`: (n_node, n_time), in units of the PWV's rms.

    Layers that take a coarser step of their own are interpolated in time to the common one (cubic spline).
    """
    n_node, n_time = len(nodes.xi), len(times_with_margin(observation.n_samples, step))
    first = int(times_with_margin(observation.n_samples, step)[0])
    dtype = np.float64 if n_node * n_time <= DOUBLE_UP_TO else np.float32
    out = np.zeros((n_node, n_time), dtype)
    tiles = Tiles()
    for own in sorted({d.step for d in drifting}):
        ratio = own // step
        group = [d for d in drifting if d.step == own]
        if ratio == 1:
            _add(observation, track, nodes, first + step * np.arange(n_time), step, group, out, tiles)
            continue
        coarse = first + own * (np.arange(-(-n_time // ratio) + 3 + 2 * MARGIN) - PAD - MARGIN)
        values = np.zeros((n_node, len(coarse)), dtype)
        _add(observation, track, nodes, coarse, own, group, values, tiles)
        for start in range(0, n_node, 64):
            rows = slice(start, start + 64)
            part = DetectorField.from_values(values[rows], ratio, n_time)
            out[rows] += part.evaluate(slice(0, len(part.coefficients)), slice(0, n_time))
    return out


def times_with_margin(n_samples: int, step: int) -> NDArray[np.int64]:
    """Samples at which `SmoothField.from_values` wants its values."""
    return step * np.arange(-PAD - MARGIN, -(-n_samples // step) + 2 + MARGIN, dtype=np.int64)


def _add(
    observation: Observation,
    track: Track,
    nodes: Nodes,
    index: NDArray[np.int64],
    step: int,
    group: list[Drifting],
    out: Floats,
    tiles: Tiles,
) -> None:
    chunk = max(1, POINTS_AT_ONCE // len(nodes.xi))
    for start in range(0, len(index), chunk):
        now = slice(start, start + chunk)
        seconds = float(observation.seconds[0]) + index[now] / observation.sample_rate
        plane = track.unroll(crossing(rays(axes_at(observation.boresight_azel, index[now], step), nodes.xi, nodes.eta)))
        for layer in group:
            across, along = track.place(plane, seconds, layer.height, layer.wind)
            sample(layer.field, across, along, layer.amplitude, out[:, now], tiles)


class Tiles:
    """Spline coefficients of wide boxes, assembled from tiles that are kept: a scan comes back to the same air."""

    def __init__(self) -> None:
        self._kept: OrderedDict[tuple[int, int, int], NDArray[np.float32]] = OrderedDict()
        self.made = 0
        """Lattice points made so far."""

    def coefficients(self, field: Turbulence, i0: int, i1: int, j0: int, j1: int) -> NDArray[np.float32]:
        """As `Turbulence.coefficients`."""
        if min(i1 - i0, j1 - j0) < TILE:
            self.made += (i1 - i0) * (j1 - j0)
            return field.coefficients(i0, i1, j0, j1)
        out = np.empty((i1 - i0, j1 - j0), np.float32)
        for i in range(i0 // TILE, -(-i1 // TILE)):
            for j in range(j0 // TILE, -(-j1 // TILE)):
                a, b, c, d = max(i * TILE, i0), min(i * TILE + TILE, i1), max(j * TILE, j0), min(j * TILE + TILE, j1)
                tile = self._tile(field, i, j)
                out[a - i0 : b - i0, c - j0 : d - j0] = tile[a - i * TILE : b - i * TILE, c - j * TILE : d - j * TILE]
        return out

    def _tile(self, field: Turbulence, i: int, j: int) -> NDArray[np.float32]:
        key = (id(field), i, j)
        if key in self._kept:
            self._kept.move_to_end(key)
            return self._kept[key]
        self.made += TILE * TILE
        tile = field.coefficients(i * TILE, (i + 1) * TILE, j * TILE, (j + 1) * TILE)
        self._kept[key] = tile
        if len(self._kept) > TILES_KEPT:
            self._kept.popitem(last=False)
        return tile


def sample(field: Turbulence, across: Floats, along: Floats, amplitude: float, out: Floats, tiles: Tiles | None = None) -> None:
    """out += amplitude x the field at (across, along) [m], each (n_node, n_time), in boxes of at most `CELLS_AT_ONCE` points.

    Raises `InputError` where more than `CELLS_IN_ALL` points have been made.
    """
    tiles = tiles or Tiles()
    x, y = across / field.spacing, along / field.spacing
    todo = [(slice(0, x.shape[0]), slice(0, x.shape[1]))]
    while todo:
        nodes, times = todo.pop()
        px, py = x[nodes, times], y[nodes, times]
        i0, i1 = math.floor(px.min()) - 1, math.floor(px.max()) + 3
        j0, j1 = math.floor(py.min()) - 1, math.floor(py.max()) + 3
        if (i1 - i0) * (j1 - j0) > CELLS_AT_ONCE and px.size > 1:
            todo.extend(_halves(nodes, times, px, py))
            continue
        coefficients = tiles.coefficients(field, i0, i1, j0, j1)
        if tiles.made > CELLS_IN_ALL:
            raise InputError(
                f"the lines of sight sweep over more than {CELLS_IN_ALL:.0e} lattice points of the turbulence "
                f"({field.spacing:g} m for a beam of {field.sigma:.3g} m)",
                place="atmosphere",
                cure="shorten the scans, narrow the field of view, or raise the lowest layer",
            )
        interpolate(coefficients, i0, j0, px, py, amplitude, out[nodes, times])


def _halves(nodes: slice, times: slice, x: Floats, y: Floats) -> list[tuple[slice, slice]]:
    """Cut where it makes the boxes smaller: in time, or between nodes once they spread more than the path is long."""
    spread = np.ptp(x, axis=0).max() + np.ptp(y, axis=0).max()
    path = np.ptp(x, axis=1).max() + np.ptp(y, axis=1).max()
    if x.shape[1] > 1 and (path >= spread or x.shape[0] == 1):
        middle = (times.start + times.stop) // 2
        return [(nodes, slice(middle, times.stop)), (nodes, slice(times.start, middle))]
    middle = (nodes.start + nodes.stop) // 2
    return [(slice(middle, nodes.stop), times), (slice(nodes.start, middle), times)]
