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

from zonda.core.columns import spline_of_four

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
    over: bool = False,
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
    over
        Put the map into ``out``, whatever is there, and zeros where there is no map.

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
        over,
        out,
    )
    return int(beyond), int(behind)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _sample(quaternions, matrix, xi, eta, rows, f, ny, nx, bounds, covered, constants, over, out):  # type: ignore[no-untyped-def]
    h, box = np.empty((9, CHUNK), out.dtype), np.empty((9, 2))
    limits, edge = np.empty(4, out.dtype), np.empty(4, out.dtype)
    scratch = np.empty((24, CHUNK))
    place, at = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    u, v, found = np.empty(CHUNK, out.dtype), np.empty(CHUNK, out.dtype), np.empty(CHUNK, out.dtype)
    weights = np.zeros((8, CHUNK), out.dtype)
    flat = weights.reshape(-1)
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
            if first == stop:
                continue
            _spline(place, u, v, first, stop, constants, at, weights)
            for t in range(uint64(first), uint64(stop), uint64(4)):
                spline_of_four(f, uint64(nx), at, flat, uint64(CHUNK), t, found)
            for t in range(uint64(first), uint64(min(stop, count))):
                row[t] += found[t] if place[t] >= 0 else constants[6]
    return beyond, behind


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def chunk(quaternions, matrix, ny, nx, bounds, scratch, h, box, limits, edge):  # type: ignore[no-untyped-def]
    """Pointing of at most `CHUNK` instants: ``h`` (9, CHUNK), H row by row for (xi, eta, 1) counted from its own origin.

    ``box`` (9, 2) float64: least and largest of each element. ``limits`` (4,): first and last place of the first of a sample's
    4 x 4 grid points; ``edge`` (4,): the input map's. Returns the grid point (1, 1), counted from the origin.
    """
    count, cast = len(quaternions), h.dtype.type
    g = scratch[15:]
    _homographies(quaternions, matrix, scratch, g)
    middle = count // 2
    ox, oy, w = g[2, middle], g[5, middle], g[8, middle]
    if w > 0.0 and abs(ox) < 1e8 * w and abs(oy) < 1e8 * w:
        ox, oy = np.floor(ox / w), np.floor(oy / w)
    else:
        ox, oy = 0.0, 0.0
    for k in range(9):
        origin, row, base, to = (ox, oy, 0.0)[k // 3], g[k], g[6 + k % 3], h[k]
        for t in range(count):
            to[t] = cast(row[t] - origin * base[t])
        for t in range(count, CHUNK):
            to[t] = to[count - 1]
        _extent(to, box[k])
    limits[0], limits[1], limits[2], limits[3] = cast(1 - ox), cast(nx - 3 - ox), cast(1 - oy), cast(ny - 3 - oy)
    edge[0], edge[1] = cast(bounds[0] - ox), cast(bounds[1] - ox)
    edge[2], edge[3] = cast(bounds[2] - oy), cast(bounds[3] - oy)
    # far away no sample is on the grid and any number will do
    return int32(1 - max(min(ox, 1e9), -1e9)), int32(1 - max(min(oy, 1e9), -1e9))


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _homographies(quaternions, matrix, scratch, g):  # type: ignore[no-untyped-def]
    """``g`` (9, n): the elements of H = A R, columns sorted for (xi, eta, 1). One output to a loop, so that it is vectorized."""
    n = uint64(len(quaternions))
    x, y, z, w, s = scratch[0], scratch[1], scratch[2], scratch[3], scratch[4]
    for t in range(n):
        x[t], y[t], z[t], w[t] = quaternions[t, 0], quaternions[t, 1], quaternions[t, 2], quaternions[t, 3]
    for t in range(n):
        s[t] = 2.0 / (x[t] * x[t] + y[t] * y[t] + z[t] * z[t] + w[t] * w[t])
    for column in range(3):
        a, b, c = scratch[6], scratch[7], scratch[8]
        if column == 0:  # of xi: the second column of R, reversed
            for t in range(n):
                a[t] = s[t] * (z[t] * w[t] - x[t] * y[t])
            for t in range(n):
                b[t] = s[t] * (x[t] * x[t] + z[t] * z[t]) - 1.0
            for t in range(n):
                c[t] = s[t] * (-x[t] * w[t] - y[t] * z[t])
        elif column == 1:  # of eta: the first, reversed
            for t in range(n):
                a[t] = s[t] * (y[t] * y[t] + z[t] * z[t]) - 1.0
            for t in range(n):
                b[t] = s[t] * (-z[t] * w[t] - x[t] * y[t])
            for t in range(n):
                c[t] = s[t] * (y[t] * w[t] - x[t] * z[t])
        else:
            for t in range(n):
                a[t] = s[t] * (x[t] * z[t] + y[t] * w[t])
            for t in range(n):
                b[t] = s[t] * (y[t] * z[t] - x[t] * w[t])
            for t in range(n):
                c[t] = 1.0 - s[t] * (x[t] * x[t] + y[t] * y[t])
        for row in range(3):
            p, q, r, to = matrix[row, 0], matrix[row, 1], matrix[row, 2], g[3 * row + column]
            for t in range(n):
                to[t] = p * a[t] + q * b[t] + r * c[t]


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath=False)
def _extent(values, box):  # type: ignore[no-untyped-def]
    """The least and the largest of `CHUNK` values, four at a time."""
    a, b, c, d = values[0], values[1], values[2], values[3]
    p, q, r, s = a, b, c, d
    for t in range(uint64(4), uint64(CHUNK), uint64(4)):
        w, x, y, z = values[t], values[t + uint64(1)], values[t + uint64(2)], values[t + uint64(3)]
        a, b, c, d = min(a, w), min(b, x), min(c, y), min(d, z)
        p, q, r, s = max(p, w), max(q, x), max(r, y), max(s, z)
    box[0], box[1] = min(min(a, b), min(c, d)), max(max(p, q), max(r, s))


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath=False)
def misses(box, a, b, limits, edge):  # type: ignore[no-untyped-def]
    """Whether a detector at (a, b) = (xi, eta) is in front of the map and a pixel or more off it at every instant of a chunk.

    By intervals: x = n / w with n and w between bounds, 0 < w, lies between the least and the largest quotient of bounds.
    False where rounding might come to a pixel.
    """
    w_low, w_high = _between(box, 6, a, b)
    if not w_low > 1e-3:
        return False
    for axis in range(2):
        low, high = _between(box, 3 * axis, a, b)
        low, high = min(low / w_low, low / w_high), max(high / w_low, high / w_high)
        if max(-low, high) > 1e6:
            return False
        first, last = min(limits[2 * axis], edge[2 * axis]), max(limits[2 * axis + 1] + 1, edge[2 * axis + 1])
        if low > last + 1.0 or high < first - 1.0:
            return True
    return False


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _between(box, k, a, b):  # type: ignore[no-untyped-def]
    """Bounds of h_k a + h_(k+1) b + h_(k+2)."""
    p, q = a * box[k, 0], a * box[k, 1]
    r, s = b * box[k + 1, 0], b * box[k + 1, 1]
    return min(p, q) + min(r, s) + box[k + 2, 0], max(p, q) + max(r, s) + box[k + 2, 1]


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def locate(h, a, b, count, limits, edge, constants, x0, y0, width, place, u, v):  # type: ignore[no-untyped-def]
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


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath=False)
def count_covered(place, u, v, count, width, covered):  # type: ignore[no-untyped-def]
    """The number of samples whose nearest grid point is covered."""
    total = int32(0)
    for t in range(count):
        if place[t] >= 0:
            column, row = place[t] % width, place[t] // width
            total += covered[row + (2 if v[t] >= 0.5 else 1), column + (2 if u[t] >= 0.5 else 1)]
    return total


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath=False)
def span_on_grid(place, count):  # type: ignore[no-untyped-def]
    """The multiples of four between which all samples on the grid lie; what is filled up behind ``count`` is off the grid."""
    first, last = 0, count - 1
    while first < count and place[first] < 0:
        first += 1
    if first == count:
        return 0, 0
    while place[last] < 0:
        last -= 1
    first, stop = first // 4 * 4, last // 4 * 4 + 4
    for t in range(count, stop):
        place[t] = -1
    return first, stop


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _spline(place, u, v, first, stop, constants, at, weights):  # type: ignore[no-untyped-def]
    """The cubic B-spline weights (8, CHUNK), four along x, four along y; ``at``: ``place``, 0 for samples off the grid."""
    sixth, two_thirds, half, one, two = constants[0], constants[1], constants[2], constants[3], constants[4]
    for k in range(2):
        fractions, w0, w1, w2, w3 = (u, v)[k], weights[4 * k], weights[4 * k + 1], weights[4 * k + 2], weights[4 * k + 3]
        for t in range(uint64(first), uint64(stop)):
            p = fractions[t]
            pm = one - p
            w0[t] = pm * pm * pm * sixth
            w1[t] = two_thirds - half * p * p * (two - p)
            w2[t] = two_thirds - half * pm * pm * (two - pm)
            w3[t] = p * p * p * sixth
    for t in range(uint64(first), uint64(stop)):
        at[t] = max(place[t], int32(0))
