"""Sampling a convolved map at every detector and instant by bilinear interpolation: less work than `sampling`, less exact.

Between grid points h apart it errs by h^2 / 2 u (1 - u) f'' along each axis, u the fraction, h^2 / 12 f'' in the mean over u. The
mean is taken out beforehand, by dividing the map's transform by sinc^2(k h) (`beam.convolve`), which leaves

    |e| <= h^2 / 12 (|f_xx| + |f_yy|)                                                                               (1)

and no mean attenuation (Blu, Thevenaz & Unser 2001 call it quasi-interpolation).
"""

from __future__ import annotations

import numba as nb
import numpy as np
from numba import int32, uint64
from numpy.typing import NDArray

from .sampling import CHUNK, chunk, count_covered, locate, misses, span_on_grid

Floats = NDArray[np.floating]


def sample_linear(
    quaternions: NDArray[np.float64],
    pixel_matrix: NDArray[np.float64],
    xi: NDArray[np.float64],
    eta: NDArray[np.float64],
    rows: NDArray[np.int64],
    values: Floats,
    bounds: NDArray[np.float64],
    covered: NDArray[np.uint8],
    out: Floats,
    over: bool = False,
) -> tuple[int, int]:
    """As `sampling.sample`, from the grid's ``values`` (ny, nx). Samples within two points of its border are left as they are."""
    kind = out.dtype.type
    constants = np.array([1 / 6, 2 / 3, 0.5, 1.0, 2.0, 1e6, 0.0], kind)
    a, b = xi.astype(kind), eta.astype(kind)
    flat, (ny, nx) = values.reshape(-1), values.shape
    beyond, behind = _sample(quaternions, pixel_matrix, a, b, rows, flat, ny, nx, bounds, covered, constants, over, out)
    return int(beyond), int(behind)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _sample(quaternions, matrix, xi, eta, rows, f, ny, nx, bounds, covered, constants, over, out):  # type: ignore[no-untyped-def]
    h, box = np.empty((9, CHUNK), out.dtype), np.empty((9, 2))
    limits, edge = np.empty(4, out.dtype), np.empty(4, out.dtype)
    scratch = np.empty((24, CHUNK))
    place = np.empty(CHUNK, np.int32)
    u, v = np.empty(CHUNK, out.dtype), np.empty(CHUNK, out.dtype)
    beyond, behind = 0, 0
    for start in range(0, out.shape[1], CHUNK):
        count = min(CHUNK, out.shape[1] - start)
        x0, y0 = chunk(quaternions[start : start + count], matrix, ny, nx, bounds, scratch, h, box, limits, edge)
        for d in range(rows.size):
            row = out[rows[d], start : start + count]
            if over:
                row[:] = 0
            if misses(box, xi[d], eta[d], limits, edge):
                beyond += count
                continue
            inside, front = locate(h, xi[d], eta[d], count, limits, edge, constants, x0, y0, int32(nx), place, u, v)
            if covered.size > 0:
                inside = count_covered(place, u, v, count, nx, covered)
            beyond += count - inside
            behind += count - front
            first, stop = span_on_grid(place, count)
            stop = min(stop, count)
            _add_bilinear(f, place, u, v, first, stop, uint64(nx), constants, row)
    return beyond, behind


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _add_bilinear(f, place, u, v, first, stop, nx, constants, row):  # type: ignore[no-untyped-def]
    """The four grid points around each sample, one right and one up of its first spline coefficient; 0 off the grid."""
    one, zero = constants[3], constants[6]
    for t in range(uint64(first), uint64(stop)):
        on = one if place[t] >= 0 else zero
        p = uint64(max(place[t], int32(0))) + nx + uint64(1)
        a, b, c, d = f[p], f[p + uint64(1)], f[p + nx], f[p + nx + uint64(1)]
        low, high = a + u[t] * (b - a), c + u[t] * (d - c)
        row[t] += on * (low + v[t] * (high - low))
