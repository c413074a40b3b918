"""Evaluation of the layers along lines of sight: in boxes of bounded memory, at a step in time of each layer's own."""

from __future__ import annotations

import math
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

CELLS_AT_ONCE = 1 << 20
"""Lattice points made at a time: bounds the memory."""

CELLS_IN_ALL = 4e9
"""Lattice points of one layer and scan beyond which the run is refused."""

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
    for own in sorted({d.step for d in drifting}):
        ratio = own // step
        group = [d for d in drifting if d.step == own]
        if ratio == 1:
            _add(observation, track, nodes, first + step * np.arange(n_time), step, group, out)
            continue
        coarse = first + own * (np.arange(-(-n_time // ratio) + 3 + 2 * MARGIN) - PAD - MARGIN)
        values = np.zeros((n_node, len(coarse)), dtype)
        _add(observation, track, nodes, coarse, own, group, values)
        for start in range(0, n_node, 64):
            rows = slice(start, start + 64)
            part = DetectorField.from_values(values[rows], ratio, n_time)
            out[rows] += part.evaluate(slice(0, len(part.coefficients)), slice(0, n_time))
    return out


def times_with_margin(n_samples: int, step: int) -> NDArray[np.int64]:
    """Samples at which `SmoothField.from_values` wants its values."""
    return step * np.arange(-PAD - MARGIN, -(-n_samples // step) + 2 + MARGIN, dtype=np.int64)


def _add(
    observation: Observation, track: Track, nodes: Nodes, index: NDArray[np.int64], step: int, group: list[Drifting], out: Floats
) -> None:
    chunk = max(1, POINTS_AT_ONCE // len(nodes.xi))
    for start in range(0, len(index), chunk):
        now = slice(start, start + chunk)
        seconds = float(observation.seconds[0]) + index[now] / observation.sample_rate
        plane = track.unroll(crossing(rays(axes_at(observation.boresight_azel, index[now], step), nodes.xi, nodes.eta)))
        for layer in group:
            across, along = track.place(plane, seconds, layer.height, layer.wind)
            sample(layer.field, across, along, layer.amplitude, out[:, now])


def sample(beam: Turbulence, across: Floats, along: Floats, amplitude: float, out: Floats) -> None:
    """out += amplitude x the field at (across, along) [m], each (n_node, n_time), in boxes of at most `CELLS_AT_ONCE` points.

    Raises `InputError` where that would take more than `CELLS_IN_ALL` points.
    """
    x, y = across / beam.spacing, along / beam.spacing
    todo, made = [(slice(0, x.shape[0]), slice(0, x.shape[1]))], 0.0
    while todo:
        nodes, times = todo.pop()
        px, py = x[nodes, times], y[nodes, times]
        i0, i1 = math.floor(px.min()) - 1, math.floor(px.max()) + 3
        j0, j1 = math.floor(py.min()) - 1, math.floor(py.max()) + 3
        cells = (i1 - i0) * (j1 - j0)
        if cells > CELLS_AT_ONCE and px.size > 1:
            todo.extend(_halves(nodes, times, px, py))
            continue
        made += cells
        if made > CELLS_IN_ALL:
            raise InputError(
                f"a beam of {beam.sigma:.3g} m sweeps over more than {CELLS_IN_ALL:.0e} lattice points of one layer",
                place="atmosphere",
                cure="shorten the scans, narrow the field of view, or raise the lowest layer",
            )
        coefficients = beam.coefficients(i0, i1, j0, j1)
        part = np.zeros(px.shape)
        interpolate(coefficients, i0, j0, np.ascontiguousarray(px), np.ascontiguousarray(py), amplitude, part)
        out[nodes, times] += part


def _halves(nodes: slice, times: slice, x: Floats, y: Floats) -> list[tuple[slice, slice]]:
    """Cut where it makes the boxes smaller: in time, or between nodes once they spread more than the path is long."""
    spread = np.ptp(x, axis=0).max() + np.ptp(y, axis=0).max()
    path = np.ptp(x, axis=1).max() + np.ptp(y, axis=1).max()
    if x.shape[1] > 1 and (path >= spread or x.shape[0] == 1):
        middle = (times.start + times.stop) // 2
        return [(nodes, slice(middle, times.stop)), (nodes, slice(times.start, middle))]
    middle = (nodes.start + nodes.stop) // 2
    return [(slice(middle, nodes.stop), times), (slice(nodes.start, middle), times)]
