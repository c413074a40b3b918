"""Kernels that find the lattice cells that lines of sight cross, and interpolate between them."""

from __future__ import annotations

import numba as nb
import numpy as np

from zonda.core.kernels import kernel
from zonda.core.numerics.columns import four_columns_at

CHUNK, RUN = 256, 16
"""Positions that are interpolated at once, and of which one box is made."""


@kernel
def boxes_of(x, y):  # type: ignore[no-untyped-def]
    """Middles and half widths of what `RUN` successive positions span: (n, runs, 4) x, y, half x,
    half y.
    """
    out = np.empty((x.shape[0], (x.shape[1] + RUN - 1) // RUN, 4))
    for n in range(x.shape[0]):
        for r in range(out.shape[1]):
            a, b = x[n, r * RUN], y[n, r * RUN]
            c, d = a, b
            for t in range(r * RUN + 1, min((r + 1) * RUN, x.shape[1])):
                a, c = min(a, x[n, t]), max(c, x[n, t])
                b, d = min(b, y[n, t]), max(d, y[n, t])
            out[n, r, 0], out[n, r, 1], out[n, r, 2], out[n, r, 3] = (
                (a + c) / 2,
                (b + d) / 2,
                (c - a) / 2,
                (d - b) / 2,
            )
    return out


@kernel
def _cells(a, b, box, first, last):  # type: ignore[no-untyped-def]
    """First and last cells, one of rounding included, at which the 4 coefficients of a x + b y +
    (first .. last) begin.
    """
    middle, half = a * box[0] + b * box[1], abs(a) * box[2] + abs(b) * box[3]
    rounding = 1e-9 * (abs(middle) + half) + 1e-9
    low, high = (
        middle - half + min(first, last) - rounding,
        middle + half + max(first, last) + rounding,
    )
    return np.int64(np.floor(low)) - 1, np.int64(np.floor(high)) - 1


@kernel
def extent(matrix, boxes, i, j):  # type: ignore[no-untyped-def]
    """First and last cells: across low, high, along low, high. The drift (i, j) is steady, so its
    ends bound it.
    """
    low_i = low_j = np.int64(1 << 62)
    high_i = high_j = -low_i
    for n in range(boxes.shape[0]):
        for r in range(boxes.shape[1]):
            t, last = r * RUN, min((r + 1) * RUN, i.size) - 1
            a, b = _cells(matrix[0], matrix[1], boxes[n, r], i[t], i[last])
            c, d = _cells(matrix[2], matrix[3], boxes[n, r], j[t], j[last])
            low_i, high_i, low_j, high_j = (
                min(low_i, a),
                max(high_i, b),
                min(low_j, c),
                max(high_j, d),
            )
    return low_i, high_i, low_j, high_j


@kernel
def mark(  # type: ignore[no-untyped-def]
    matrix, boxes, i, j, side_i, side_j, first_i, first_j, wanted
):
    """Set 1 where a tile is wanted; (first_i, first_j) is the first tile."""
    for n in range(boxes.shape[0]):
        for r in range(boxes.shape[1]):
            t, last = r * RUN, min((r + 1) * RUN, i.size) - 1
            a, b = _cells(matrix[0], matrix[1], boxes[n, r], i[t], i[last])
            c, d = _cells(matrix[2], matrix[3], boxes[n, r], j[t], j[last])
            for k in range(a >> side_i, (b >> side_i) + 1):
                for m in range(c >> side_j, (d >> side_j) + 1):
                    wanted[k - first_i, m - first_j] = 1


@kernel
def interpolate(  # type: ignore[no-untyped-def]
    matrix, x, y, i, j, side_i, side_j, low_i, low_j, width, addresses, constants, bands, out
):
    """out[band] += amplitude * the cubic B-spline of the band's coefficients, for each of the
    ``bands`` (a tuple).

    ``addresses``: (tiles across, tiles along) uint64, of tiles in which the coefficients of the
    bands alternate. (low_i, low_j): the first cell of the first tile; ``width``: cells in a row of
    a tile. ``constants``: 1/6, 2/3, 1/2, 1 and the amplitude, of the type that the spline is summed
    in.
    """
    m0, m1, m2, m3 = matrix[0], matrix[1], matrix[2], matrix[3]
    inside_i, inside_j = nb.int32((1 << side_i) - 1), nb.int32((1 << side_j) - 1)
    n_bands = nb.uint64(len(bands))
    stride, width, columns_of_tiles = (
        nb.uint64(width) * n_bands,
        nb.int32(width),
        nb.int32(addresses.shape[1]),
    )
    shift_i, shift_j = nb.int32(side_i), nb.int32(side_j)
    # Cells are counted from the first tile's, in 32 bits: what the box of one call holds fits.
    origin_i, origin_j = float(low_i), float(low_j)
    flat = addresses.reshape(-1)
    sixth, two_thirds, half, one, amplitude = (
        constants[0],
        constants[1],
        constants[2],
        constants[3],
        constants[4],
    )
    tile, inside = np.empty(CHUNK, np.int32), np.empty(CHUNK, np.int32)
    kind, size = constants.dtype, nb.uint64(4) * n_bands  # numbers of a point, and bytes of a cell
    u, v, sums = (
        np.empty(CHUNK, kind),
        np.empty(CHUNK, kind),
        np.empty(4 * len(bands) * CHUNK, kind),
    )
    w0, w1, w2, w3 = (
        np.empty(CHUNK, kind),
        np.empty(CHUNK, kind),
        np.empty(CHUNK, kind),
        np.empty(CHUNK, kind),
    )
    for n in range(x.shape[0]):
        for start in range(0, x.shape[1], CHUNK):
            count = nb.uint64(min(CHUNK, x.shape[1] - start))
            px, py, pi, pj = x[n][start:], y[n][start:], i[start:], j[start:]
            for t in range(count):
                p, q = m0 * px[t] + m1 * py[t] + pi[t], m2 * px[t] + m3 * py[t] + pj[t]
                fp, fq = np.floor(p), np.floor(q)
                u[t], v[t] = p - fp, q - fq
                k, m = nb.int32(fp - 1 - origin_i), nb.int32(fq - 1 - origin_j)
                tile[t] = nb.int32(nb.int32((k >> shift_i) * columns_of_tiles) + (m >> shift_j))
                inside[t] = nb.int32(nb.int32((k & inside_i) * width) + (m & inside_j))
            for t in range(count):
                p = u[t]
                q = one - p
                w0[t], w1[t] = (
                    amplitude * (q * q * q * sixth),
                    amplitude * (two_thirds - p * p * (one - p * half)),
                )
                w2[t], w3[t] = (
                    amplitude * (two_thirds - q * q * (one - q * half)),
                    amplitude * (p * p * p * sixth),
                )
            for t in range(count):
                where = flat[nb.uint64(tile[t])] + size * nb.uint64(inside[t])
                four_columns_at(where, stride, w0[t], w1[t], w2[t], w3[t], bands, sums, size * t)
            for t in range(count):
                p = v[t]
                q = one - p
                w0[t], w1[t] = q * q * q * sixth, two_thirds - p * p * (one - p * half)
                w2[t], w3[t] = two_thirds - q * q * (one - q * half), p * p * p * sixth
            for b in range(n_bands):
                row = out[bands[b], n][start:]
                for t in range(count):
                    k, m, p, q = size * t + b, n_bands, 2 * n_bands, 3 * n_bands
                    row[t] += (
                        w0[t] * sums[k]
                        + w1[t] * sums[k + m]
                        + w2[t] * sums[k + p]
                        + w3[t] * sums[k + q]
                    )
