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

from .sampling import CHUNK, _covered, _homography, _locate

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
) -> tuple[int, int]:
    """As `sampling.sample`, from the grid's ``values`` (ny, nx). Samples within two points of its border are left as they are."""
    kind = out.dtype.type
    constants = np.array([1 / 6, 2 / 3, 0.5, 1.0, 2.0, 1e6, 0.0], kind)
    a, b = xi.astype(kind), eta.astype(kind)
    flat, (ny, nx) = values.reshape(-1), values.shape
    beyond, behind = _sample(quaternions, pixel_matrix, a, b, rows, flat, ny, nx, bounds, covered, constants, out)
    return int(beyond), int(behind)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _sample(quaternions, matrix, xi, eta, rows, f, ny, nx, bounds, covered, constants, out):  # type: ignore[no-untyped-def]
    n_samp = out.shape[1]
    cast = constants.dtype.type
    one, zero = constants[3], constants[6]
    h = np.empty((9, CHUNK), out.dtype)
    place = np.empty(CHUNK, np.int32)
    u, v, found = np.empty(CHUNK, out.dtype), np.empty(CHUNK, out.dtype), np.empty(CHUNK, out.dtype)
    limits, edge = np.empty(4, out.dtype), np.empty(4, out.dtype)
    beyond, behind = 0, 0
    for start in range(0, n_samp, CHUNK):
        count = min(CHUNK, n_samp - start)
        g = _homography(quaternions[start + count // 2], matrix)
        ox, oy = 0.0, 0.0
        if g[8] > 0.0 and abs(g[2]) < 1e8 * g[8] and abs(g[5]) < 1e8 * g[8]:
            ox, oy = np.floor(g[2] / g[8]), np.floor(g[5] / g[8])
        for t in range(count):
            g0, g1, g2, g3, g4, g5, g6, g7, g8 = _homography(quaternions[start + t], matrix)
            h[0, t], h[1, t], h[2, t] = g0 - ox * g6, g1 - ox * g7, g2 - ox * g8
            h[3, t], h[4, t], h[5, t] = g3 - oy * g6, g4 - oy * g7, g5 - oy * g8
            h[6, t], h[7, t], h[8, t] = g6, g7, g8
        limits[0], limits[1], limits[2], limits[3] = cast(1 - ox), cast(nx - 3 - ox), cast(1 - oy), cast(ny - 3 - oy)
        edge[0], edge[1] = cast(bounds[0] - ox), cast(bounds[1] - ox)
        edge[2], edge[3] = cast(bounds[2] - oy), cast(bounds[3] - oy)
        x0, y0 = int32(1 - max(min(ox, 1e9), -1e9)), int32(1 - max(min(oy, 1e9), -1e9))
        for d in range(rows.size):
            inside, front = _locate(h, xi[d], eta[d], count, limits, edge, constants, x0, y0, int32(nx), place, u, v)
            if covered.size > 0:
                inside = _covered(place, u, v, count, nx, covered)
            beyond += count - inside
            behind += count - front
            _bilinear(f, place, u, v, count, uint64(nx), one, zero, found)
            row = out[rows[d], start : start + count]
            for t in range(count):
                row[t] += found[t]
    return beyond, behind


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _bilinear(f, place, u, v, count, nx, one, zero, found):  # type: ignore[no-untyped-def]
    """The four grid points around each sample, one right and one up of its first spline coefficient; 0 off the grid."""
    for t in range(uint64(count)):
        on = one if place[t] >= 0 else zero
        p = uint64(max(place[t], int32(0))) + nx + uint64(1)
        a, b, c, d = f[p], f[p + uint64(1)], f[p + nx], f[p + nx + uint64(1)]
        low, high = a + u[t] * (b - a), c + u[t] * (d - c)
        found[t] = on * (low + v[t] * (high - low))
