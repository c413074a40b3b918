"""Sums of samples in pixels, in fixed point.

    D_p = sum_i rint(2^36 w_i d_i),   H_p = sum_i 1,   W_p = sum_i rint(2^30 w_i),
    N_p = sum_i rint(2^30 n_i)         (1)

over the samples i in pixel p, as int64: exact, so that their bits depend neither on the order of
blocks nor on the number of threads. Where all detectors weigh the same, W and N follow from H.

A thread's sums have a border for what falls outside of the map: a pixel all around an image, row 0
before a list of pixels. What is flagged, not finite or too large goes to row 0 too.

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

AT_ONCE = 256
"""Samples of `TOGETHER` detectors whose pixels, values and pointing are in the first cache
together.
"""

DATA, HITS, WEIGHTS, NOISE = range(4)
OUTSIDE, FLAGGED, NOT_FINITE, TOO_LARGE = range(4)


@kernel
def add_image(  # type: ignore[no-untyped-def]
    signals,
    h,
    start,
    xi,
    eta,
    ny,
    nx,
    use,
    good,
    window,
    weight,
    noise,
    scatter,
    per_var,
    sums,
    dropped,
    largest,
):
    """Add a block that begins at sample ``start`` to an image of (ny, nx) pixels; the rest as in
    `_add`.
    """
    n = signals[0].shape[1]
    space = np.empty(xi.size * AT_ONCE, np.int32)
    for low in range(0, n, AT_ONCE):
        high = min(low + AT_ONCE, n)
        cells = space[: xi.size * (high - low)].reshape(xi.size, high - low)
        for d in range(xi.size):
            if use[d]:
                _cells(h, start + low, xi[d], eta[d], ny, nx, cells[d])
        _add(
            signals,
            low,
            cells,
            nx + 2,
            use,
            good,
            window,
            weight,
            noise,
            scatter,
            per_var,
            sums,
            dropped,
            largest,
        )


@kernel(fastmath={"contract", "nsz"})
def _cells(h, start, a, b, ny, nx, cells):  # type: ignore[no-untyped-def]
    """Place (y + 1) (nx + 2) + x + 1 of the pixel that holds each sample of a detector at (a, b);
    beyond the edge, the border's.

    ``h`` (9, n_samp): homographies. ``start``: sample of the first of ``cells`` (n,).
    """
    stop = start + cells.size
    h0, h1, h2 = h[0, start:stop], h[1, start:stop], h[2, start:stop]
    h3, h4, h5 = h[3, start:stop], h[4, start:stop], h[5, start:stop]
    h6, h7, h8 = h[6, start:stop], h[7, start:stop], h[8, start:stop]
    right, top, row_length = nx + 1.0, ny + 1.0, np.int32(nx + 2)
    for t in range(cells.size):
        w = h6[t] * a + h7[t] * b + h8[t]
        scale = 1.0 / (w if w > 0.0 else np.nan)
        x = (h0[t] * a + h1[t] * b + h2[t]) * scale + 1.5
        y = (h3[t] * a + h4[t] * b + h5[t]) * scale + 1.5
        x = x if x > 0.0 else 0.0
        y = y if y > 0.0 else 0.0
        x = x if x < right else right
        y = y if y < top else top
        cells[t] = np.int32(np.int32(y) * row_length + np.int32(x))


@kernel
def add_list(  # type: ignore[no-untyped-def]
    signals,
    first,
    index,
    use,
    good,
    window,
    weight,
    noise,
    scatter,
    per_variance,
    sums,
    dropped,
    largest,
):
    """Add samples first .. of a block to the pixels ``index`` (n_det, n) of a list, -1 outside; the
    rest as in `_add`.
    """
    places = index + np.int32(1)  # other bands may need the pixels as they are
    _add(
        signals,
        first,
        places,
        0,
        use,
        good,
        window,
        weight,
        noise,
        scatter,
        per_variance,
        sums,
        dropped,
        largest,
    )


@kernel
def _add(  # type: ignore[no-untyped-def]
    signals,
    first,
    cells,
    stride,
    use,
    good,
    window,
    weight,
    noise,
    scatter,
    per_variance,
    sums,
    dropped,
    largest,
):
    """Add samples of all ``signals`` (a tuple) to their places in ``sums`` (n, 4 and one for each
    further signal; or 2: all detectors weigh the same); count what is dropped; note the largest
    terms, those of the data to the next power of two.

    ``cells`` (n_det, n): places of the samples first .. first + n - 1 of the block, like ``good``.
    ``stride``: places in a row of an image, 0 for a list. What is dropped for another reason is
    counted out of those outside: all of the border will be added.
    """
    n, m = cells.shape[1], len(signals)
    flat, columns = sums.reshape(-1), np.uintp(sums.shape[1])
    base = sums.shape[1] - (m - 1)
    fine = good[first : first + n]
    n_fine = np.int64(0)
    for t in range(n):  # numpy's all() and flatnonzero() would take a second more to compile
        n_fine += np.int64(fine[t] != 0)
    rows, n_rows = np.empty(use.size, np.int64), 0
    for d in range(use.size):
        if use[d]:
            rows[n_rows] = d
            n_rows += 1
    rows = rows[: n_rows if n_fine else 0]
    dropped[FLAGGED] += n * (use.size - rows.size)
    shifted, highest = np.empty((m, TOGETHER, n)), np.empty(m)
    units = shifted.view(np.int64)
    for begin in range(0, rows.size, TOGETHER):
        group = rows[begin : begin + TOGETHER]
        for k in range(group.size):
            d = group[k]
            limit, factor, square = _scales(weight[d], per_variance, scatter)
            drop = n_fine < n
            for s in range(m):
                high = _units(signals[s][d, first : first + n], factor, shifted[s, k], units[s, k])
                highest[s] = float(high + 1)
                drop |= high >= limit * factor
            if drop:
                _drop(
                    signals,
                    d,
                    first,
                    fine,
                    limit,
                    cells[d],
                    units[:, k],
                    stride,
                    sums.shape[0] // max(stride, 1),
                    dropped,
                )
                for s in range(m):
                    high = 0
                    for t in range(n):
                        high |= units[s, k, t] if units[s, k, t] >= 0 else ~units[s, k, t]
                    highest[s] = float(high + 1)
            largest[DATA] = max(largest[DATA], highest[0])
            for s in range(1, m):
                largest[NOISE + s] = max(largest[NOISE + s], highest[s])
            if base == 4:
                unit, places = units[0, k], cells[d]
                w, term = (
                    np.int64(np.rint(weight[d] * WEIGHT)),
                    np.int64(np.rint(noise[d] * WEIGHT)),
                )
                largest[WEIGHTS], largest[NOISE] = (
                    max(largest[WEIGHTS], float(w)),
                    max(largest[NOISE], float(term)),
                )
                for t in range(n):
                    if window.size:
                        share = window[first + t]
                        w = np.int64(np.rint(weight[d] * share * WEIGHT))
                        term = np.int64(np.rint(noise[d] * share * share * WEIGHT))
                    if scatter:
                        y = np.float64(unit[t]) / factor
                        term = np.int64(np.rint(square * y * y))
                        largest[NOISE] = max(largest[NOISE], float(term))
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
def _scales(weight, per_variance, scatter):  # type: ignore[no-untyped-def]
    """Scales of one detector: the largest |d| [K] that is accepted, units of w d per K, and units
    of the scatter per K^2.
    """
    limit, square = LARGEST / VALUE / max(weight, 1.0), weight * per_variance * WEIGHT
    if scatter:
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
def _drop(  # type: ignore[no-untyped-def]
    signals, d, first, fine, limit, places, units, stride, n_rows, dropped
):
    """Send what is flagged, or in one signal not finite or too large, to place 0 with no value, and
    count it once.
    """
    for t in range(places.size):
        place, size = places[t], 0.0
        for s in range(len(signals)):
            one = abs(np.float64(signals[s][d, first + t]))
            size = one if not one <= size else size  # NaN stays: nothing is <= NaN, nor is NaN
            if not one < np.inf:
                size = np.nan
                break
        outside = place == 0
        if stride:
            x, y = place % stride, place // stride
            outside = (x == 0) | (x == stride - 1) | (y == 0) | (y == n_rows - 1)
        why = OUTSIDE
        if not fine[t]:
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
