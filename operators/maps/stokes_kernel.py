"""The loops behind `binning` for maps of I, Q and U: the sums of a tile's samples in their pixels.

Successive samples of a detector often fall in the same pixel. Their terms are added up along the
row, all columns side by side (`running_terms`), and each run of samples in one pixel goes to the
map at once: what its last sample's sums have more than those of the run before. Sums are integers
modulo 2^64, so that this is exact, and how samples are cut in runs is not seen in the map. Angles
and runs are found once for all bands that see the same pixels, and the terms of A where their
weights are equal.
"""

from __future__ import annotations

import numpy as np

from zonda.core.kernels import kernel
from zonda.core.numerics.columns import (
    add_change,
    bits_of,
    lanes_of,
    of_bits,
    prefetch,
    running_terms,
)
from zonda.core.polarization import fill_row

from .intensity_kernel import (
    FLAGGED,
    LARGEST,
    MAGIC,
    MAGIC_BITS,
    NOT_FINITE,
    OUTSIDE,
    TOO_LARGE,
    VALUE,
    WEIGHT,
)

HIT = 0
FIRST = 1
"""Column of the sum of w, from which on A follows: w, wc, ws, wcc, wcs, wss."""
DATA = 7
"""First column of the data: wd, wdc, wds of each signal, then N."""

MATRIX = slice(FIRST, DATA)
"""Columns of A."""
PLACES = (0, 1, 2, 1, 3, 4, 2, 4, 5)
"""Columns of A as a matrix, row by row, counted from the first of them."""

AT_ONCE = 512
"""Samples of a detector whose terms are in the first cache together."""
LAST = 5
"""Of the terms that are made at a time: how many come from weights; w d, w d c, w d s of each
signal follow.
"""


@kernel
def add_stokes(  # type: ignore[no-untyped-def]
    signals, first, rows, at, cells, angles, which, start, good, window, own, bands
):
    """Add samples first .. of ``rows`` of all ``signals`` (a tuple) to their pixels.

    Parameters
    ----------
    signals
        Those of the first band, then as many of the next.
    at
        (n_row,) of each, its row in ``cells`` (n, m): pixels, or -1 outside.
    angles, which, start
        Poles, axes, plate and gamma (`PolarizationAngles`), p; (n_row,) numbers of the detectors
        there; the first sample there.
    good, window
        (m,); (m,), or (0,): none.
    own
        N is added up.
    bands
        Of each band weight (n_row,), noise (n_row,), sums, dropped, largest. What is dropped is
        counted, the largest terms are noted. What one band drops is of no matter to the others.
    """
    n_bands, n = len(bands), cells.shape[1]
    m = len(signals) // n_bands
    values, size, kept = (
        np.empty((len(signals) + 2, AT_ONCE)),
        np.empty(AT_ONCE),
        np.empty(AT_ONCE, np.int32),
    )  # signals; w; N's
    c, s, share = np.empty(AT_ONCE), np.empty(AT_ONCE), np.empty(AT_ONCE if window.size else 0)
    run, begins, places = (
        np.empty(AT_ONCE, np.int32),
        np.empty(AT_ONCE + 1, np.int64),
        np.empty(AT_ONCE + 1, np.int32),
    )
    terms, tops = (
        np.zeros(lanes_of(len(signals)) * (AT_ONCE + 1), np.int64),
        np.empty(n_bands, np.int64),
    )
    few = np.zeros(lanes_of(1) * (AT_ONCE + 1), np.int64)
    for begin in range(0, n, AT_ONCE):
        length, low = min(AT_ONCE, n - begin), first + begin
        fine, n_fine = good[begin : begin + length], np.int64(0)
        for t in range(length):
            n_fine += np.int64(fine[t] != 0)
        if not n_fine:
            for b in range(n_bands):
                bands[b][3][FLAGGED] += length * rows.size
            continue
        for k in range(rows.size):
            d, cell = which[k], cells[at[k], begin : begin + length]
            spoilt = n_fine < length or _least(cell) < 0
            for b in range(n_bands):
                tops[b] = 0
                for i in range(b * m, b * m + m):
                    tops[b] = max(
                        tops[b],
                        _scaled(
                            signals[i][rows[k], low : low + length],
                            bands[b][0][k] * VALUE,
                            values[i],
                        ),
                    )
                spoilt = spoilt or tops[b] >= bits_of(_limit(bands[b][0][k]))
            for lot in range(n_bands if spoilt else 1):  # each for itself, or all together
                b0, b1, number, pixels = (
                    (lot, lot + 1, length, cell) if spoilt else (0, n_bands, length, cell)
                )
                fill_row(
                    angles[0],
                    angles[1][d],
                    angles[2],
                    angles[3][d],
                    start + begin,
                    c[:length],
                    s[:length],
                )
                _round(angles[4][d], c[:length])
                _round(angles[4][d], s[:length])
                for t in range(length if window.size else 0):
                    share[t] = window[begin + t]
                if spoilt:
                    limit, dropped = _limit(bands[lot][0][k]), bands[lot][3]
                    where = rows[k], low, lot * m, m
                    number, top = _without(
                        signals,
                        where,
                        cell,
                        fine,
                        limit,
                        size,
                        c,
                        s,
                        share,
                        values,
                        kept,
                        dropped,
                    )
                    pixels, tops[lot] = kept[:number], top
                n_runs, alike = _runs(pixels, run, begins, places), n_bands == 1 or not spoilt
                for b in range(b0 + 1, b1):
                    alike = alike and bands[b][0][k] == bands[b0][0][k]
                for b in range(b0, b1):
                    w0, noise, sums, largest = (
                        bands[b][0][k],
                        bands[b][1][k],
                        bands[b][2],
                        bands[b][4],
                    )
                    largest[0] = max(largest[0], max(w0, noise) * WEIGHT)
                    largest[1] = max(largest[1], of_bits(tops[b]) * w0 * VALUE + 1.0)
                    _fetch(sums, places, n_runs)
                    _scale(w0, noise, share, values[-2, :number], values[-1])
                    every_w = 0 if window.size else np.int64((w0 * WEIGHT + MAGIC) - MAGIC)
                    if alike:  # weights, so that the terms of A are made once
                        if b == b0:
                            running_terms(
                                c,
                                s,
                                values[-2],
                                values,
                                np.uint64(0),
                                signals,
                                MAGIC,
                                run,
                                number,
                                terms,
                            )
                        _add(sums, terms, signals, b * m, places, begins, n_runs, every_w)
                        for i in range(1, m):
                            _add_lanes(
                                sums,
                                DATA + 3 * i,
                                terms,
                                signals,
                                LAST + 3 * (b * m + i),
                                3,
                                places,
                                begins,
                                n_runs,
                            )
                    for i in range(m if alike else 0, m + 2):  # other signals, w, N
                        if (i == m and not window.size) or (i == m + 1 and not own):
                            continue
                        x, line = (
                            values[-1] if i == m + 1 else values[-2],
                            b * m + i if i < m else (n_bands - 1) * m + i,
                        )
                        running_terms(
                            c,
                            s,
                            x,
                            values,
                            np.uint64(line),
                            signals[:1],
                            MAGIC,
                            run,
                            number,
                            few,
                        )
                        if i == 0:
                            _add(sums, few, signals[:1], 0, places, begins, n_runs, every_w)
                            continue
                        column, lanes = (
                            (FIRST, 1) if i == m else (DATA + 3 * min(i, m), 3 if i < m else 1)
                        )
                        _add_lanes(
                            sums,
                            column,
                            few,
                            signals[:1],
                            LAST,
                            lanes,
                            places,
                            begins,
                            n_runs,
                        )
                        if i > m:
                            _add_lanes(
                                sums,
                                column + 1,
                                few,
                                signals[:1],
                                0,
                                LAST,
                                places,
                                begins,
                                n_runs,
                            )


@kernel
def _limit(weight):  # type: ignore[no-untyped-def]
    """The size of a sample that is too large."""
    return LARGEST / VALUE / max(weight, 1.0)


@kernel
def _scaled(row, factor, out):  # type: ignore[no-untyped-def]
    """Samples times ``factor``, and the bits of the largest, which are in the order of sizes:
    infinity and NaN are above all.
    """
    top = np.int64(0)
    for t in range(row.size):
        one = np.float64(row[t])
        out[t] = one * factor
        top = max(top, bits_of(abs(one)))
    return top


@kernel
def _round(factor, values):  # type: ignore[no-untyped-def]
    """Cosines or sines times ``factor``, in steps of 2^-30."""
    for t in range(values.size):
        values[t] = ((factor * values[t] * WEIGHT + MAGIC) - MAGIC) / WEIGHT


@kernel
def _least(pixels):  # type: ignore[no-untyped-def]
    least = np.int32(0)
    for t in range(pixels.size):
        least = min(least, pixels[t])
    return least


@kernel
def _scale(weight, noise, share, w, n):  # type: ignore[no-untyped-def]
    """The weight and the noise term of each sample, whose share the window leaves, in units of
    2^-30.
    """
    for t in range(w.size):
        one = share[t] if share.size else 1.0
        w[t], n[t] = weight * one * WEIGHT, noise * one * one * WEIGHT


@kernel
def _without(  # type: ignore[no-untyped-def]
    signals, where, pixels, fine, limit, size, c, s, share, values, kept, dropped
):
    """Drop samples of a band from ``c``, ``s``, ``share`` and ``values`` (m, n), and from
    ``pixels`` into ``kept``.

    How many are left, and the bits of the largest. ``where``: row and first sample, first signal
    and number of signals; ``limit``: the size that is too large; ``size``: space.
    """
    d, first, begin, m = where
    number, high = 0, 0.0
    for i in range(begin, begin + m):
        row = signals[i][d, first : first + pixels.size]
        for t in range(row.size):
            one = abs(np.float64(row[t]))
            size[t] = max(
                size[t] if i > begin else 0.0,
                one if one < np.inf else np.inf,
            )  # NaN is not below anything
    for t in range(pixels.size):
        if not fine[t] or not size[t] < np.inf or pixels[t] < 0 or size[t] >= limit:
            why = (
                FLAGGED
                if not fine[t]
                else NOT_FINITE
                if not size[t] < np.inf
                else OUTSIDE
                if pixels[t] < 0
                else TOO_LARGE
            )
            dropped[why] += 1
            continue
        high = max(high, size[t])
        kept[number], c[number], s[number] = pixels[t], c[t], s[t]
        if share.size:
            share[number] = share[t]
        for i in range(begin, begin + m):
            values[i, number] = values[i, t]
        number += 1
    return number, bits_of(high)


@kernel
def _runs(pixels, run, begins, places):  # type: ignore[no-untyped-def]
    """Number of runs of samples in one pixel; where each begins, and its pixel. ``run``: of each
    sample, counted from 1.
    """
    found, last = np.uint64(0), np.int32(-1)
    for t in range(
        np.uint64(pixels.size)
    ):  # without branches: what is written where no run begins is written over
        pixel = pixels[t]
        begins[found], places[found] = t, pixel
        found += np.uint64(pixel != last)
        run[t] = found
        last = pixel
    begins[found] = pixels.size
    return np.int64(found)


@kernel
def _fetch(sums, places, n_runs):  # type: ignore[no-untyped-def]
    """Fetch the sums of some pixels, which are in memory, while their terms are made."""
    columns = np.uint64(sums.shape[1])
    for r in range(n_runs):
        place = np.uint64(places[r]) * columns
        for column in range(np.uint64(0), columns, np.uint64(8)):
            prefetch(sums, place + column)
        prefetch(sums, place + columns - np.uint64(1))


@kernel
def _add(sums, terms, fields, of, places, begins, n_runs, every_w):  # type: ignore[no-untyped-def]
    """Add hits, A, and the data of the first signal of a band, which is number ``of`` of the
    ``fields``, to the pixels of runs.

    ``every_w``: the weight of each sample, or 0.
    """
    columns, data = np.uint64(sums.shape[1]), np.uint64(LAST + 3 * of)
    for r in range(n_runs):
        pixel, count = np.uint64(places[r]), begins[r + 1] - begins[r]
        sums[pixel, HIT] += count
        sums[pixel, FIRST] += count * every_w
        add_change(
            sums,
            pixel * columns + np.uint64(FIRST + 1),
            terms,
            np.uint64(r + 1),
            data,
            fields,
            count * MAGIC_BITS,
        )


@kernel
def _add_lanes(  # type: ignore[no-untyped-def]
    sums, column, terms, fields, lane, lanes, places, begins, n_runs
):
    """Add some of the `running_terms` of runs, from ``lane`` on, to columns from ``column`` on."""
    back = lanes_of(len(fields))
    for r in range(n_runs):
        pixel, less = np.uint64(places[r]), (begins[r + 1] - begins[r]) * MAGIC_BITS
        last = back * (r + 1) + lane
        for k in range(lanes):
            sums[pixel, np.uint64(column + k)] += (
                terms[np.uint64(last + k)] - terms[np.uint64(last + k - back)] - less
            )
