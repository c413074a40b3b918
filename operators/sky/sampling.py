"""Sampling a convolved map at every detector and instant by cubic B-splines.

A direction d has the working-grid pixel p = A d, x = p0 / p2, y = p1 / p2 (`core.projection`), a detector looks at
R(t) (-eta, -xi, 1), so that one 3 x 3 matrix per instant, H = A R(t) with its columns sorted, takes (xi, eta, 1) to
pixels: exact for a gnomonic grid.

Precision: H is float64. The pixel of the chunk's boresight, rounded, is taken out of it before it is cast to the block's
type, so that float32 coordinates carry only the offset of a detector from the boresight and of the boresight from its
place within 256 samples: 3 roundings of 6e-8 of that offset, 5e-4 pixel (1e-4 of a beam of 4 pixels) at 3000 pixels.
"""

from __future__ import annotations

import numba as nb
import numpy as np
from numba import int32, uint64
from numpy.typing import NDArray

from zonda.core.columns import four_columns

Floats = NDArray[np.floating]

CHUNK = 256
"""Samples that share a coordinate origin; divides `TILE_SAMPLES`, so chunks are absolute."""


def sample(
    quaternions: NDArray[np.float64],
    pixel_matrix: NDArray[np.float64],
    xi: NDArray[np.float64],
    eta: NDArray[np.float64],
    rows: NDArray[np.int64],
    coefficients: Floats,
    bounds: NDArray[np.float64],
    covered: NDArray[np.uint8],
    out: Floats,
) -> tuple[int, int]:
    """Add the map to ``out`` (n_det, n_samp) at its ``rows``; the numbers of samples (outside the input map, behind it).

    Parameters
    ----------
    quaternions
        (n_samp, 4) boresight, ICRS; the first sample is a multiple of `CHUNK` of the observation.
    pixel_matrix
        (3, 3) ICRS direction to homogeneous working-grid pixel, 0-based.
    xi, eta
        (n_rows,) focal-plane offsets of the detectors at ``rows`` of ``out``.
    coefficients
        (ny, nx) cubic B-spline coefficients of ``out``'s type, C order, fewer than 2^31.
    bounds
        (4,) x_low, x_high, y_low, y_high of the input map on the working grid.
    covered
        (ny, nx) 1 where the input map has data, or (0, 0): everywhere within ``bounds``.

    A sample whose 4 x 4 coefficients are not all on the grid is left as it is. Samples behind the tangent plane are counted
    in both numbers.
    """
    kind = out.dtype.type
    constants = np.array([1 / 6, 2 / 3, 0.5, 1.0, 2.0, 1e6, 0.0], kind)
    beyond, behind = _sample(
        quaternions,
        pixel_matrix,
        xi.astype(kind),
        eta.astype(kind),
        rows,
        coefficients.reshape(-1),
        coefficients.shape[0],
        coefficients.shape[1],
        bounds,
        covered,
        constants,
        out,
    )
    return int(beyond), int(behind)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _homography(quaternion, matrix):  # type: ignore[no-untyped-def]
    """The nine elements of H at one instant, row by row, for (xi, eta, 1)."""
    x, y, z, w = quaternion[0], quaternion[1], quaternion[2], quaternion[3]
    s = 2.0 / (x * x + y * y + z * z + w * w)
    r00, r01, r02 = 1.0 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)
    r10, r11, r12 = s * (x * y + z * w), 1.0 - s * (x * x + z * z), s * (y * z - x * w)
    r20, r21, r22 = s * (x * z - y * w), s * (y * z + x * w), 1.0 - s * (x * x + y * y)
    a, b, c = matrix[0], matrix[1], matrix[2]
    return (
        -(a[0] * r01 + a[1] * r11 + a[2] * r21),
        -(a[0] * r00 + a[1] * r10 + a[2] * r20),
        a[0] * r02 + a[1] * r12 + a[2] * r22,
        -(b[0] * r01 + b[1] * r11 + b[2] * r21),
        -(b[0] * r00 + b[1] * r10 + b[2] * r20),
        b[0] * r02 + b[1] * r12 + b[2] * r22,
        -(c[0] * r01 + c[1] * r11 + c[2] * r21),
        -(c[0] * r00 + c[1] * r10 + c[2] * r20),
        c[0] * r02 + c[1] * r12 + c[2] * r22,
    )


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _sample(quaternions, matrix, xi, eta, rows, f, ny, nx, bounds, covered, constants, out):  # type: ignore[no-untyped-def]
    n_samp = out.shape[1]
    cast = constants.dtype.type
    h = np.empty((9, CHUNK), out.dtype)
    place = np.empty(CHUNK, np.int32)
    u, v = np.empty(CHUNK, out.dtype), np.empty(CHUNK, out.dtype)
    weights = np.empty((8, CHUNK), out.dtype)
    columns = np.empty((CHUNK, 4), out.dtype)
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
        edge[0], edge[1], edge[2], edge[3] = (
            cast(bounds[0] - ox),
            cast(bounds[1] - ox),
            cast(bounds[2] - oy),
            cast(bounds[3] - oy),
        )
        # The grid point (1, 1) counted from (ox, oy); far away no sample is on the grid and any number will do.
        x0, y0 = int32(1 - max(min(ox, 1e9), -1e9)), int32(1 - max(min(oy, 1e9), -1e9))
        for d in range(rows.size):
            inside, front = _locate(h, xi[d], eta[d], count, limits, edge, constants, x0, y0, int32(nx), place, u, v)
            if covered.size > 0:
                inside = _covered(place, u, v, count, nx, covered)
            beyond += count - inside
            behind += count - front
            _spline(place, u, v, count, constants, weights)
            _columns(f, place, count, uint64(nx), weights, columns)
            row = out[rows[d], start : start + count]
            for t in range(count):
                row[t] += (
                    weights[0, t] * columns[t, 0]
                    + weights[1, t] * columns[t, 1]
                    + weights[2, t] * columns[t, 2]
                    + weights[3, t] * columns[t, 3]
                )
    return beyond, behind


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _locate(h, a, b, count, limits, edge, constants, x0, y0, width, place, u, v):  # type: ignore[no-untyped-def]
    """Where a detector at (a, b) = (xi, eta) looks: the index of its first coefficient (-1: none) and the fractions u, v.

    Returns the numbers of samples inside the input map's edges and in front of the tangent plane.
    """
    one, far = constants[3], constants[5]
    inside, front = int32(0), int32(0)
    for t in range(count):
        w = h[6, t] * a + h[7, t] * b + h[8, t]
        over = one / w
        x = (h[0, t] * a + h[1, t] * b + h[2, t]) * over
        y = (h[3, t] * a + h[4, t] * b + h[5, t]) * over
        x, y = max(min(x, far), -far), max(min(y, far), -far)
        fx, fy = np.floor(x), np.floor(y)
        u[t], v[t] = x - fx, y - fy
        ahead = w > constants[6]
        within = ahead & (x >= edge[0]) & (x < edge[1]) & (y >= edge[2]) & (y < edge[3])
        on_grid = ahead & (fx >= limits[0]) & (fx <= limits[1]) & (fy >= limits[2]) & (fy <= limits[3])
        index = int32(int32(int32(int32(fy) - y0) * width) + int32(int32(fx) - x0))
        place[t] = index if on_grid else int32(-1)
        inside = int32(inside + int32(within))
        front = int32(front + int32(ahead))
    return inside, front


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _covered(place, u, v, count, width, covered):  # type: ignore[no-untyped-def]
    """The number of samples whose nearest grid point is covered."""
    total = int32(0)
    for t in range(count):
        if place[t] >= 0:
            column, row = place[t] % width, place[t] // width
            total += covered[row + (2 if v[t] >= 0.5 else 1), column + (2 if u[t] >= 0.5 else 1)]
    return total


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _spline(place, u, v, count, constants, weights):  # type: ignore[no-untyped-def]
    """The cubic B-spline weights (8, count): four along x, four along y; those along y are 0 for samples off the grid."""
    sixth, two_thirds, half, one, two, zero = constants[0], constants[1], constants[2], constants[3], constants[4], constants[6]
    for t in range(count):
        p, q = u[t], v[t]
        pm, qm = one - p, one - q
        weights[0, t] = pm * pm * pm * sixth
        weights[1, t] = two_thirds - half * p * p * (two - p)
        weights[2, t] = two_thirds - half * pm * pm * (two - pm)
        weights[3, t] = p * p * p * sixth
        on = one if place[t] >= 0 else zero
        weights[4, t] = on * (qm * qm * qm * sixth)
        weights[5, t] = on * (two_thirds - half * q * q * (two - q))
        weights[6, t] = on * (two_thirds - half * qm * qm * (two - qm))
        weights[7, t] = on * (q * q * q * sixth)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _columns(f, place, count, stride, weights, columns):  # type: ignore[no-untyped-def]
    """Sums along y of the 4 x 4 coefficients of each sample: four neighbours at once, no gathers."""
    flat = columns.reshape(-1)
    for t in range(uint64(count)):
        p = uint64(max(place[t], int32(0)))
        four_columns(f, p, stride, weights[4, t], weights[5, t], weights[6, t], weights[7, t], flat, uint64(4) * t)
