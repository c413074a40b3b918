"""Sums of samples in the pixels of maps of I, in fixed point, and the kernel that moves the sums of
threads, also of I, Q and U, to those of the run.

    D_p = sum_i rint(2^36 w_i d_i),   H_p = sum_i 1,   W_p = sum_i rint(2^30 w_i),
    N_p = sum_i rint(2^30 n_i)         (1)

over the samples i in pixel p, as int64: exact, so that their bits depend neither on the order of
blocks nor on the number of threads. Where all detectors weigh the same, W and N follow from H.

Row 0 of a thread's sums is for what falls outside of the map, is flagged, not finite or too large;
those of pixel p are in row p + 1.

Several signals share pixels, hits, weights and noise: the data of those beside the first follow its
columns. What one of them lacks is dropped from all.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel
from zonda.core.numerics.columns import prefetch

Sums = NDArray[np.int64]

VALUE = 2.0**36
"""Fixed-point units per K in the sum of w d."""
WEIGHT = 2.0**30
"""Fixed-point units per reference weight in the sums of w and of the noise terms."""
LARGEST = 2.0**50
"""Largest w d that is accepted, in fixed-point units: 2^14 K at the reference weight."""
MAGIC = 1.5 * 2.0**52
"""A float64 q + MAGIC has the integer q in its low bits."""
MAGIC_BITS = 0x4338000000000000

TOGETHER = 4
"""Detectors that are scattered side by side: successive samples of one often fall in the same pixel
and would wait for it.
"""

AHEAD = 16
"""Samples by which pixels are fetched beforehand: those of a map larger than the cache come from
memory.
"""

DATA, HITS, WEIGHTS, NOISE = range(4)
OUTSIDE, FLAGGED, NOT_FINITE, TOO_LARGE = range(4)


@kernel
def add_intensity(  # type: ignore[no-untyped-def]
    signals, first, index, use, good, window, weight, noise, per_variance, sums, dropped, largest
):
    """Add samples of all ``signals`` (a tuple) to their pixels.

    Parameters
    ----------
    first
        The first sample of each row of ``signals``.
    index
        (n_det, n) pixels, -1 outside.
    use, good, window
        (n_det,); (n,); (n,), or (0,): none.
    weight, noise
        (n_det,), in reference weights and variances.
    per_variance
        Inverse of the reference variance where the noise is that of the samples' scatter; else 0.
    sums
        (n_pixels + 1, 4 and one for each further signal; or 2: all detectors weigh the same).
    dropped
        (4,). What is dropped for another reason is counted out of those outside: all of row 0 will
        be added.
    largest
        (2,): the largest term of weights and noise, and that of the data to the next power of two.
    """
    cells = index + np.int32(1)  # other bands may need the pixels as they are
    n, m = cells.shape[1], len(signals)
    flat, columns = sums.reshape(-1), np.uintp(sums.shape[1])
    base = sums.shape[1] - (m - 1)
    n_fine = np.int64(0)
    for t in range(n):  # numpy's all() and flatnonzero() would take a second more to compile
        n_fine += np.int64(good[t] != 0)
    rows, n_rows = np.empty(use.size, np.int64), 0
    for d in range(use.size):
        if use[d]:
            rows[n_rows] = d
            n_rows += 1
    rows = rows[: n_rows if n_fine else 0]
    dropped[FLAGGED] += n * (use.size - rows.size)
    shifted = np.empty((m, TOGETHER, n))
    units = shifted.view(np.int64)
    for begin in range(0, rows.size, TOGETHER):
        group = rows[begin : begin + TOGETHER]
        for k in range(group.size):
            d = group[k]
            limit, factor, square = _scales(weight[d], per_variance)
            drop, highest = n_fine < n, np.int64(0)
            for i in range(m):
                high = _units(signals[i][d, first : first + n], factor, shifted[i, k], units[i, k])
                highest = max(highest, high)
                drop |= high >= limit * factor
            if drop:
                _drop(signals, d, first, good, limit, cells[d], units[:, k], dropped)
                highest = np.int64(0)
                for i in range(m):
                    for t in range(n):
                        highest |= units[i, k, t] if units[i, k, t] >= 0 else ~units[i, k, t]
            w, term = np.int64(np.rint(weight[d] * WEIGHT)), np.int64(np.rint(noise[d] * WEIGHT))
            largest[0] = max(largest[0], max(weight[d], noise[d]) * WEIGHT)
            largest[1] = max(largest[1], float(highest + 1))
            if base == 4:
                unit, places = units[0, k], cells[d]
                for t in range(n):
                    if window.size:
                        share = window[t]
                        w = np.int64(np.rint(weight[d] * share * WEIGHT))
                        term = np.int64(np.rint(noise[d] * share * share * WEIGHT))
                    if per_variance:
                        y = np.float64(unit[t]) / factor
                        term = np.int64(np.rint(square * y * y))
                        largest[0] = max(largest[0], float(term))
                    at = np.uintp(places[t]) * columns
                    flat[at + np.uintp(WEIGHTS)] += w
                    flat[at + np.uintp(NOISE)] += term
        if rows.size - begin < TOGETHER or m > 2:
            _scatter_any(flat, columns, np.uintp(base), cells, group, units)
        elif m == 2 and columns == 3:  # constants make shorter code
            _scatter_two(flat, np.uintp(3), np.uintp(2), cells, group, units)
        elif m == 2:
            _scatter_two(flat, columns, np.uintp(base), cells, group, units)
        elif columns == 2:
            _scatter(flat, np.uintp(2), cells, group, units[0])
        else:
            _scatter(flat, columns, cells, group, units[0])


@kernel
def _scales(weight, per_variance):  # type: ignore[no-untyped-def]
    """Scales of one detector: the largest |d| [K] that is accepted, units of w d per K, and units
    of the scatter per K^2.
    """
    limit, square = LARGEST / VALUE / max(weight, 1.0), weight * per_variance * WEIGHT
    if per_variance:
        limit = min(limit, math.sqrt(2.0**60 / square))
    return limit, weight * VALUE, square


@kernel(fastmath={"contract", "nsz"})
def _units(row, factor, shifted, units):  # type: ignore[no-untyped-def]
    """w d in fixed point, and all their bits together (of ~q where q < 0): an upper bound of |q|
    below the next power of two.

    ``units`` are the bits of ``shifted``: adding `MAGIC` rounds to an integer in the low bits. What
    is not finite or beyond 2^51 gives a bound above that.
    """
    for t in range(row.size):
        shifted[t] = np.float64(row[t]) * factor + MAGIC
    together = np.int64(0)
    for t in range(row.size):
        q = units[t] - MAGIC_BITS
        units[t] = q
        together |= ~q if q < 0 else q
    return together


@kernel
def _drop(signals, d, first, good, limit, places, units, dropped):  # type: ignore[no-untyped-def]
    """Send what is flagged, or in one signal not finite or too large, to place 0 with no value, and
    count it once.
    """
    for t in range(places.size):
        size = 0.0
        for i in range(len(signals)):
            one = abs(np.float64(signals[i][d, first + t]))
            size = one if not one <= size else size  # NaN stays: nothing is <= NaN, nor is NaN
            if not one < np.inf:
                size = np.nan
                break
        outside = places[t] == 0
        why = OUTSIDE
        if not good[t]:
            why = FLAGGED
        elif not size < np.inf:
            why = NOT_FINITE
        elif not outside and not size < limit:
            why = TOO_LARGE
        if outside or why != OUTSIDE:
            places[t] = 0
            units[:, t] = 0
        if why != OUTSIDE:
            dropped[why] += 1
            dropped[OUTSIDE] -= 1


@kernel
def _scatter(flat, columns, cells, rows, units):  # type: ignore[no-untyped-def]
    """Add fixed-point values (`TOGETHER`, n) and hits to the places of the detectors ``rows``, side
    by side.
    """
    hit, last = np.uintp(HITS), np.uintp(cells.shape[1] - 1)
    a, b, c, d = cells[rows[0]], cells[rows[1]], cells[rows[2]], cells[rows[3]]
    p, q, r, s = units
    for t in range(np.uintp(cells.shape[1])):
        ahead = min(t + np.uintp(AHEAD), last)
        prefetch(flat, np.uintp(a[ahead]) * columns)
        prefetch(flat, np.uintp(b[ahead]) * columns)
        prefetch(flat, np.uintp(c[ahead]) * columns)
        prefetch(flat, np.uintp(d[ahead]) * columns)
        at = np.uintp(a[t]) * columns
        flat[at] += p[t]
        flat[at + hit] += 1
        at = np.uintp(b[t]) * columns
        flat[at] += q[t]
        flat[at + hit] += 1
        at = np.uintp(c[t]) * columns
        flat[at] += r[t]
        flat[at + hit] += 1
        at = np.uintp(d[t]) * columns
        flat[at] += s[t]
        flat[at + hit] += 1


@kernel
def _scatter_two(flat, columns, base, cells, rows, units):  # type: ignore[no-untyped-def]
    """`_scatter` of two signals (2, `TOGETHER`, n); the second one's data are in the column
    ``base``.
    """
    hit, last = np.uintp(HITS), np.uintp(cells.shape[1] - 1)
    a, b, c, d = cells[rows[0]], cells[rows[1]], cells[rows[2]], cells[rows[3]]
    p, q, r, s = units[0]
    e, f, g, h = units[1]
    for t in range(np.uintp(cells.shape[1])):
        ahead = min(t + np.uintp(AHEAD), last)
        prefetch(flat, np.uintp(a[ahead]) * columns)
        prefetch(flat, np.uintp(a[ahead]) * columns + base)
        prefetch(flat, np.uintp(b[ahead]) * columns)
        prefetch(flat, np.uintp(b[ahead]) * columns + base)
        prefetch(flat, np.uintp(c[ahead]) * columns)
        prefetch(flat, np.uintp(c[ahead]) * columns + base)
        prefetch(flat, np.uintp(d[ahead]) * columns)
        prefetch(flat, np.uintp(d[ahead]) * columns + base)
        at = np.uintp(a[t]) * columns
        flat[at] += p[t]
        flat[at + hit] += 1
        flat[at + base] += e[t]
        at = np.uintp(b[t]) * columns
        flat[at] += q[t]
        flat[at + hit] += 1
        flat[at + base] += f[t]
        at = np.uintp(c[t]) * columns
        flat[at] += r[t]
        flat[at + hit] += 1
        flat[at + base] += g[t]
        at = np.uintp(d[t]) * columns
        flat[at] += s[t]
        flat[at + hit] += 1
        flat[at + base] += h[t]


@kernel
def _scatter_any(flat, columns, base, cells, rows, units):  # type: ignore[no-untyped-def]
    """`_scatter` of any number of signals (m, n_row, n) and detectors."""
    for k in range(rows.size):
        places = cells[rows[k]]
        for t in range(np.uintp(places.size)):
            at = np.uintp(places[t]) * columns
            flat[at] += units[0, k, t]
            flat[at + np.uintp(HITS)] += 1
            for s in range(1, units.shape[0]):
                flat[at + base + np.uintp(s - 1)] += units[s, k, t]


@kernel
def move(sums, hits, out, moves):  # type: ignore[no-untyped-def]
    """Add the sums of all pixels with ``hits`` (a column) to those of ``out``, and set them to
    zero: how many hits these are, and the most that a pixel of ``out`` has.

    ``moves`` (n, 3): a column of ``out``, that of ``sums`` which is added there, and its factor.
    """
    moved, deepest = np.int64(0), np.int64(0)
    for p in range(np.uintp(sums.shape[0])):
        if not sums[p, hits]:
            continue
        moved += sums[p, hits]
        for k in range(moves.shape[0]):
            out[p, np.uintp(moves[k, 0])] += sums[p, np.uintp(moves[k, 1])] * moves[k, 2]
        deepest = max(deepest, out[p, 0])
        for column in range(np.uintp(sums.shape[1])):
            sums[p, column] = 0
    return moved, deepest
