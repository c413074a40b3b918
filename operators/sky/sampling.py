"""Sampling a convolved map at every detector and instant by cubic B-splines, or linearly.

A direction d has the working-grid pixel p = A d, x = p0 / p2, y = p1 / p2
(`core.numerics.projection`), a detector looks at R(t) (-eta, -xi, 1), so that one 3 x 3 matrix per
instant, H = A R(t) with its columns sorted, takes (xi, eta, 1) to pixels: exact for a gnomonic
grid.

Precision: H is float64. The pixel of the chunk's boresight, rounded, is taken out of it before it
is cast to the block's type, so that float32 coordinates carry only the offset of a detector from
the boresight and of the boresight from its place within 256 samples: 3 roundings of 6e-8 of that
offset, 5e-4 pixel (1e-4 of a beam of 4 pixels) at 3000 pixels.

Linear interpolation is less work, and less exact. Between grid points h apart it errs by
h^2 / 2 u (1 - u) f'' along each axis, u the fraction, h^2 / 12 f'' in the mean over u. The mean is
taken out beforehand, by dividing the map's transform by sinc^2(k h) (`beam.convolve`), which leaves

    |e| <= h^2 / 12 (|f_xx| + |f_yy|)                                                            (1)

and no mean attenuation (Blu, Thevenaz & Unser 2001 call it quasi-interpolation).
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numba import int32, uint64
from numpy.typing import NDArray

from zonda.core.kernels import contracted
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.columns import spline_of_four
from zonda.core.types import AnyFloats, Floats, Indices

CHUNK = 256
"""Samples that share a coordinate origin; divides `TILE_SAMPLES`, so chunks are absolute."""

CONSTANTS = np.array([1 / 6, 2 / 3, 0.5, 1.0, 2.0, 1e6, 0.0])
"""In the type of the samples: numba takes a number in the source for a float64."""


class Chunks(NamedTuple):
    """Boresight on a grid, in chunks of `CHUNK` samples: made by `pointing`."""

    h: AnyFloats
    """(m, 9, CHUNK) H row by row for (xi, eta, 1); the last chunk is filled up with its last
    sample.
    """
    box: Floats
    """(m, 9, 2) least and largest of each element."""
    limits: AnyFloats
    """(m, 8) first and last place x, y of the first of a sample's 4 x 4 grid points, and the input
    map's edges.
    """
    ones: NDArray[np.int32]
    """(m, 2) the grid point (1, 1)."""

    @property
    def nbytes(self) -> int:
        return sum(part.nbytes for part in self)


class Rows(NamedTuple):
    """The detectors of one beam."""

    numbers: Indices
    """(n,) rows of the block's stream."""
    xi: Floats
    """(n,) focal-plane offsets."""
    eta: Floats


def sample(
    chunks: Chunks,
    rows: Rows,
    coefficients: AnyFloats,
    covered: NDArray[np.uint8],
    out: AnyFloats,
    *,
    linear: bool = False,
    over: bool = False,
) -> tuple[int, int]:
    """Add the map to ``out`` (n_det, n_samp) at its ``rows``; the numbers of samples (outside the
    input map, behind it).

    Parameters
    ----------
    chunks
        `pointing` for the samples of ``out``, of its type.
    coefficients
        (ny, nx) of ``out``'s type, C order, fewer than 2^31: cubic B-spline coefficients, or the
        map's values if ``linear``.
    covered
        (ny, nx) 1 where the input map has data, or (0, 0): everywhere within its bounds.
    over
        Put the map into ``out``, whatever is there, and zeros where there is no map.

    A sample whose 4 x 4 coefficients are not all on the grid is left as it is. Samples behind the
    tangent plane are counted in both numbers.
    """
    kind = out.dtype.type
    width = coefficients.shape[1]
    offsets = (rows.xi.astype(kind), rows.eta.astype(kind))
    constants = CONSTANTS.astype(kind)
    of_map = rows.numbers, coefficients.reshape(-1), width, covered, constants
    beyond, behind = _add_map(*chunks, *offsets, *of_map, linear, over, out)
    return int(beyond), int(behind)


def pointing(
    quaternions: Floats,
    matrix: Floats,
    shape: tuple[int, ...],
    bounds: Floats,
    kind: Any,
) -> Chunks:
    """Boresight on a working grid, in m chunks of `CHUNK` samples, each counted from its own
    origin.

    Parameters
    ----------
    quaternions
        (n_samp, 4) boresight, ICRS; the first sample is a multiple of `CHUNK` of the observation.
    matrix
        (3, 3) ICRS direction to homogeneous working-grid pixel, 0-based.
    shape
        (ny, nx) of the grid.
    bounds
        (4,) x_low, x_high, y_low, y_high of the input map on it.
    kind
        Type of the samples, float32 or float64, and of ``h`` and ``limits``.
    """
    m = -(-len(quaternions) // CHUNK)
    h = np.empty((m, 9, CHUNK), kind)
    limits = np.empty((m, 8), kind)
    box = np.empty((m, 9, 2))
    ones = np.empty((m, 2), np.int32)
    _point(quaternions, matrix, *shape, bounds, h, box, limits, ones)
    return Chunks(h, box, limits, ones)


@contracted
def _point(  # type: ignore[no-untyped-def]
    quaternions, matrix, ny, nx, bounds, h, box, limits, ones
):
    turn, g, cast = np.empty((9, CHUNK)), np.empty((9, CHUNK)), h.dtype.type
    for k in range(len(h)):
        start = k * CHUNK
        count = min(CHUNK, len(quaternions) - start)
        for t in range(
            count
        ):  # H = A R, the columns of R sorted for (xi, eta, 1): second and first reversed, third
            q = quaternions[start + t]
            x, y, z, w = q[0], q[1], q[2], q[3]
            s = 2.0 / (x * x + y * y + z * z + w * w)
            turn[0, t], turn[1, t], turn[2, t] = (
                s * (z * w - x * y),
                s * (x * x + z * z) - 1.0,
                s * (-x * w - y * z),
            )
            turn[3, t], turn[4, t], turn[5, t] = (
                s * (y * y + z * z) - 1.0,
                s * (-z * w - x * y),
                s * (y * w - x * z),
            )
            turn[6, t], turn[7, t], turn[8, t] = (
                s * (x * z + y * w),
                s * (y * z - x * w),
                1.0 - s * (x * x + y * y),
            )
        for j in range(9):
            a, b, c, to = turn[j % 3 * 3], turn[j % 3 * 3 + 1], turn[j % 3 * 3 + 2], g[j]
            m = matrix[j // 3]
            for t in range(count):
                to[t] = m[0] * a[t] + m[1] * b[t] + m[2] * c[t]
            for t in range(count, CHUNK):
                to[t] = to[count - 1]
        ox, oy, w = g[2, count // 2], g[5, count // 2], g[8, count // 2]
        if w > 0.0 and abs(ox) < 1e8 * w and abs(oy) < 1e8 * w:
            ox, oy = np.floor(ox / w), np.floor(oy / w)
        else:
            ox, oy = 0.0, 0.0
        for j in range(9):
            origin, row, base, at = (
                ox if j < 3 else oy if j < 6 else 0.0,
                g[j],
                g[6 + j % 3],
                h[k, j],
            )
            for t in range(CHUNK):
                at[t] = cast(row[t] - origin * base[t])
            low, high = at[0], at[0]
            for t in range(CHUNK):
                low, high = min(low, at[t]), max(high, at[t])
            box[k, j, 0], box[k, j, 1] = low, high
        for j in range(2):
            origin = oy if j else ox
            limits[k, 2 * j], limits[k, 2 * j + 1] = (
                cast(1 - origin),
                cast((ny if j else nx) - 3 - origin),
            )
            limits[k, 4 + 2 * j], limits[k, 5 + 2 * j] = (
                cast(bounds[2 * j] - origin),
                cast(bounds[2 * j + 1] - origin),
            )
            ones[k, j] = int32(
                1 - max(min(origin, 1e9), -1e9)
            )  # far away no sample is on the grid and any number will do


@contracted
def _add_map(  # type: ignore[no-untyped-def]
    h, box, limits, ones, xi, eta, rows, f, nx, covered, constants, linear, over, out
):
    """The work of `sample`."""
    place, at = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    u, v, found = np.empty(CHUNK, out.dtype), np.empty(CHUNK, out.dtype), np.empty(CHUNK, out.dtype)
    weights = np.zeros((8, CHUNK), out.dtype)
    flat = weights.reshape(-1)
    beyond, behind = 0, 0
    for k in range(len(h)):
        start = k * CHUNK
        count = min(CHUNK, out.shape[1] - start)
        for d in range(rows.size):
            row = out[rows[d], start : start + count]
            for t in range(count if over else 0):
                row[t] = constants[6]
            if _misses(box[k], xi[d], eta[d], limits[k]):
                beyond += count
                continue
            inside, front = _locate(
                h[k],
                xi[d],
                eta[d],
                count,
                limits[k],
                constants,
                ones[k],
                int32(nx),
                place,
                u,
                v,
            )
            if covered.size > 0:
                inside = _count_covered(place, u, v, count, nx, covered)
            beyond += count - inside
            behind += count - front
            first, stop = _span_on_grid(place, count)
            if linear:
                _add_bilinear(f, place, u, v, first, min(stop, count), uint64(nx), constants, row)
                continue
            if first == stop:
                continue
            _spline(place, u, v, first, stop, constants, at, weights)
            for t in range(uint64(first), uint64(stop), uint64(4)):
                spline_of_four(f, uint64(nx), at, flat, uint64(CHUNK), t, found)
            for t in range(uint64(first), uint64(min(stop, count))):
                row[t] += found[t] if place[t] >= 0 else constants[6]
    return beyond, behind


# What follows is inlined, that is compiled with its caller only: half the time of functions that
# are compiled before, too.


@contracted(inline="always")
def _misses(box, a, b, limits):  # type: ignore[no-untyped-def]
    """True if a detector at (a, b) = (xi, eta) is in front of the map and a pixel or more off it at
    every instant of a chunk.

    By intervals: x = n / w with n and w between bounds, 0 < w, lies between the least and the
    largest quotient of bounds. False where rounding might come to a pixel.
    """
    w_low, w_high = _between(box, 6, a, b)
    if not w_low > 1e-3:
        return False
    for axis in range(2):
        low, high = _between(box, 3 * axis, a, b)
        low, high = min(low / w_low, low / w_high), max(high / w_low, high / w_high)
        if max(-low, high) > 1e6:
            return False
        first, last = (
            min(limits[2 * axis], limits[2 * axis + 4]),
            max(limits[2 * axis + 1] + 1, limits[2 * axis + 5]),
        )
        if low > last + 1.0 or high < first - 1.0:
            return True
    return False


@contracted(inline="always")
def _between(box, k, a, b):  # type: ignore[no-untyped-def]
    """Bounds of h_k a + h_(k+1) b + h_(k+2)."""
    p, q = a * box[k, 0], a * box[k, 1]
    r, s = b * box[k + 1, 0], b * box[k + 1, 1]
    return min(p, q) + min(r, s) + box[k + 2, 0], max(p, q) + max(r, s) + box[k + 2, 1]


@contracted(inline="always")
def _locate(  # type: ignore[no-untyped-def]
    h, a, b, count, limits, constants, ones, width, place, u, v
):
    """Position of a detector at (a, b) = (xi, eta) on the grid: the index of its first coefficient
    (-1: none) and the fractions u, v.

    Returns the numbers of samples inside the input map's edges and in front of the tangent plane.
    """
    one, far, x0, y0, edge = constants[3], constants[5], ones[0], ones[1], limits[4:]
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
        on_grid = (
            ahead & (fx >= limits[0]) & (fx <= limits[1]) & (fy >= limits[2]) & (fy <= limits[3])
        )
        index = int32(int32(int32(int32(fy) - y0) * width) + int32(int32(fx) - x0))
        place[t] = index if on_grid else int32(-1)
        inside = int32(inside + int32(within))
        front = int32(front + int32(ahead))
    return inside, front


@contracted(inline="always")
def _count_covered(place, u, v, count, width, covered):  # type: ignore[no-untyped-def]
    """The number of samples whose nearest grid point is covered."""
    total = int32(0)
    for t in range(count):
        if place[t] >= 0:
            column, row = place[t] % width, place[t] // width
            total += covered[row + (2 if v[t] >= 0.5 else 1), column + (2 if u[t] >= 0.5 else 1)]
    return total


@contracted(inline="always")
def _span_on_grid(place, count):  # type: ignore[no-untyped-def]
    """The multiples of four between which all samples on the grid lie; what is filled up behind
    ``count`` is off the grid.
    """
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


@contracted(inline="always")
def _spline(place, u, v, first, stop, constants, at, weights):  # type: ignore[no-untyped-def]
    """The cubic B-spline weights (8, CHUNK), four along x, four along y; ``at``: ``place``, 0 for
    samples off the grid.
    """
    sixth, two_thirds, half, one, two = (
        constants[0],
        constants[1],
        constants[2],
        constants[3],
        constants[4],
    )
    for k in range(2):
        fractions, w0, w1, w2, w3 = (
            (u, v)[k],
            weights[4 * k],
            weights[4 * k + 1],
            weights[4 * k + 2],
            weights[4 * k + 3],
        )
        for t in range(uint64(first), uint64(stop)):
            p = fractions[t]
            pm = one - p
            w0[t] = pm * pm * pm * sixth
            w1[t] = two_thirds - half * p * p * (two - p)
            w2[t] = two_thirds - half * pm * pm * (two - pm)
            w3[t] = p * p * p * sixth
    for t in range(uint64(first), uint64(stop)):
        at[t] = max(place[t], int32(0))


@contracted(inline="always")
def _add_bilinear(f, place, u, v, first, stop, nx, constants, row):  # type: ignore[no-untyped-def]
    """The four grid points around each sample, one right and one up of its first spline
    coefficient; 0 off the grid.
    """
    one, zero = constants[3], constants[6]
    for t in range(uint64(first), uint64(stop)):
        on = one if place[t] >= 0 else zero
        p = uint64(max(place[t], int32(0))) + nx + uint64(1)
        a, b, c, d = f[p], f[p + uint64(1)], f[p + nx], f[p + nx + uint64(1)]
        low, high = a + u[t] * (b - a), c + u[t] * (d - c)
        row[t] += on * (low + v[t] * (high - low))


NEIGHBOURS = 24
"""Points in each local fit: of HEALPix pixels, two rings and a few more."""
FITTED_AT_ONCE = 16384
"""Positions that are fitted together."""


def local_fit(points: Floats, data: Floats, at: Floats) -> tuple[Floats, int]:
    """Moving least squares of third degree at ``at`` (n, 2) from scattered ``data`` (k, m) at
    ``points`` (m, 2).

    Each value comes from the polynomial of third degree that best fits the `NEIGHBOURS` nearest
    points, with weights 1 / distance^4: it passes through the data. Where the neighbours do not
    determine it, it is their weighted mean. Of fewer points all are neighbours.

    Returns the values (k, n), and how many of them are means.
    """
    from scipy.spatial import cKDTree

    tree: Any = cKDTree(points)
    poor = 0
    found = np.empty((len(data), len(at)))
    for part in chunks(len(at), FITTED_AT_ONCE):
        distance, index = tree.query(at[part], np.arange(1, min(NEIGHBOURS, tree.n) + 1))
        scale = np.maximum(distance[:, -1:], 1e-300)
        u, v = np.moveaxis((points[index] - at[part, None, :]) / scale[:, :, None], 2, 0)
        weight = 1.0 / ((distance / scale) ** 2 + 1e-6)
        square = weight**2
        mean = np.sum(square * data[:, index], axis=2) / np.sum(square, axis=1)
        found[:, part] = mean
        if tree.n < 10:  # fewer than the coefficients
            poor += mean.shape[1]
            continue
        powers = [np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3]
        q, r = np.linalg.qr(np.stack(powers, axis=2) * weight[:, :, None])
        pivots = np.abs(np.diagonal(r, axis1=1, axis2=2))
        fitted = pivots.min(axis=1) >= 1e-6 * pivots.max(axis=1)
        poor += int(np.count_nonzero(~fitted))
        for value, plane in zip(found[:, part], data, strict=True):
            right = np.einsum("nkj,nk->nj", q, weight * plane[index])[:, :, None]
            solved = np.linalg.solve(r + 1e-300 * np.eye(10), right)[:, 0, 0]
            value[fitted] = solved[fitted]
    return found, poor
