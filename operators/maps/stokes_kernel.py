"""The loops behind `stokes_sums`: the sums of a tile's samples in their pixels.

Successive samples of a detector often fall in the same pixel. Their terms are added up along the row, all columns side by side
(`running_terms`), and each run of samples in one pixel goes to the map at once: what its last sample's sums have more than those
of the run before. Sums are integers modulo 2^64, so that this is exact, and how samples are cut in runs is not seen in the map.
"""

from __future__ import annotations

import numpy as np

from zonda.core.compilation.columns import add_change, bits_of, of_bits, prefetch, running_terms
from zonda.core.compilation.jit import nb
from zonda.core.polarization import fill_row

from .sums import FLAGGED, LARGEST, MAGIC, MAGIC_BITS, NOT_FINITE, OUTSIDE, TOO_LARGE, VALUE, WEIGHT

HIT = 0
FIRST = 1
"""Column of the sum of w, from which on A follows: w, wc, ws, wcc, wcs, wss."""
DATA = 7
"""First column of the data: wd, wdc, wds of each signal, then N."""

AT_ONCE = 512
"""Samples of a detector whose terms are in the first cache together."""
LAST = 5
"""Of the eight terms that are made at a time: how many come from weights; the others are w d, w d c, w d s."""


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def add_stokes(signals, first, rows, at, cells, angles, which, start, good, window, weight, noise, own, sums, dropped, largest):  # type: ignore[no-untyped-def]
    """Add samples first .. of ``rows`` of all ``signals`` (a tuple) to their pixels.

    Parameters
    ----------
    at
        (n_row,) of each, its row in ``cells`` (n, m): pixels, or -1 outside.
    angles, which, start
        Poles, axes, plate and gamma (`PolarizationAngles`), p; (n_row,) numbers of the detectors there; the first sample there.
    good, window, weight, noise
        (m,); (m,), or (0,): none; (n_row,) each.
    own
        N is added up.
    dropped, largest
        What is dropped is counted, the largest terms are noted.
    """
    m, n, columns = len(signals), cells.shape[1], np.uint64(sums.shape[1])
    values, size, kept = np.empty((m + 2, AT_ONCE)), np.empty(AT_ONCE), np.empty(AT_ONCE, np.int32)  # of the signals; w; N's
    c, s, share = np.empty(AT_ONCE), np.empty(AT_ONCE), np.empty(AT_ONCE if window.size else 0)
    run, begins, places = np.empty(AT_ONCE, np.int32), np.empty(AT_ONCE + 1, np.int64), np.empty(AT_ONCE + 1, np.int32)
    terms = np.zeros(8 * (AT_ONCE + 1), np.int64)
    for begin in range(0, n, AT_ONCE):
        number = min(AT_ONCE, n - begin)
        fine, n_fine = good[begin : begin + number], np.int64(0)
        for t in range(number):
            n_fine += np.int64(fine[t] != 0)
        if not n_fine:
            dropped[FLAGGED] += number * rows.size
            continue
        for k in range(rows.size):
            w0, row, low = weight[k], at[k], first + begin
            limit = LARGEST / VALUE / max(w0, 1.0)
            number, top = min(AT_ONCE, n - begin), np.int64(0)
            pixels = cells[row, begin : begin + number]
            for i in range(m):
                top = max(top, _scaled(signals[i][rows[k], low : low + number], w0 * VALUE, values[i]))
            d = which[k]
            fill_row(angles[0], angles[1][d], angles[2], angles[3][d], start + begin, c[:number], s[:number])
            _round(angles[4][d], c[:number])
            _round(angles[4][d], s[:number])
            for t in range(number if window.size else 0):
                share[t] = window[begin + t]
            if n_fine < number or top >= bits_of(limit) or _least(pixels) < 0:
                number, top = _without(signals, rows[k], low, pixels, fine, limit, size, c, s, share, values, kept, dropped)
                pixels = kept[:number]
            largest[0] = max(largest[0], max(w0, noise[k]) * WEIGHT)
            largest[1] = max(largest[1], of_bits(top) * w0 * VALUE + 1.0)
            n_runs = _runs(pixels, run, begins, places)
            _fetch(sums, columns, places, n_runs)
            _scale(w0, noise[k], share, values[m, :number], values[m + 1])
            running_terms(c, s, values[m], values[0], MAGIC, run, number, terms)
            all_alike = 0 if window.size else np.int64((w0 * WEIGHT + MAGIC) - MAGIC)
            for r in range(n_runs):
                pixel, count = np.uint64(places[r]), begins[r + 1] - begins[r]
                sums[pixel, HIT] += count
                sums[pixel, FIRST] += count * all_alike
                add_change(sums, pixel * columns + np.uint64(FIRST + 1), terms, np.uint64(r + 1), count * MAGIC_BITS)
            for i in range(1, m + 2):
                if (i == m and not window.size) or (i == m + 1 and not own):
                    continue
                column, lanes = (DATA + 3 * i, 3) if i < m else (FIRST if i == m else DATA + 3 * m, 1)
                running_terms(c, s, values[i], values[i], MAGIC, run, number, terms)
                _add(sums, column, terms, LAST, lanes, places, begins, n_runs)
                if i > m:
                    _add(sums, column + 1, terms, 0, LAST, places, begins, n_runs)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _scaled(row, factor, out):  # type: ignore[no-untyped-def]
    """Samples times ``factor``, and the bits of the largest, which are in the order of sizes: infinity and NaN are above all."""
    top = np.int64(0)
    for t in range(row.size):
        one = np.float64(row[t])
        out[t] = one * factor
        top = max(top, bits_of(abs(one)))
    return top


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _round(factor, values):  # type: ignore[no-untyped-def]
    """Cosines or sines times ``factor``, in steps of 2^-30."""
    for t in range(values.size):
        values[t] = ((factor * values[t] * WEIGHT + MAGIC) - MAGIC) / WEIGHT


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _least(pixels):  # type: ignore[no-untyped-def]
    least = np.int32(0)
    for t in range(pixels.size):
        least = min(least, pixels[t])
    return least


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _scale(weight, noise, share, w, n):  # type: ignore[no-untyped-def]
    """The weight and the noise term of each sample, whose share the window leaves, in units of 2^-30."""
    for t in range(w.size):
        one = share[t] if share.size else 1.0
        w[t], n[t] = weight * one * WEIGHT, noise * one * one * WEIGHT


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _without(signals, d, first, pixels, fine, limit, size, c, s, share, values, kept, dropped):  # type: ignore[no-untyped-def]
    """Drop samples from ``c``, ``s``, ``share`` and ``values`` (m, n), and from ``pixels`` into ``kept``.

    How many are left, and the bits of the largest. ``limit``: the size that is too large; ``size``: space.
    """
    number, high = 0, 0.0
    for i in range(len(signals)):
        row = signals[i][d, first : first + pixels.size]
        for t in range(row.size):
            one = abs(np.float64(row[t]))
            size[t] = max(size[t] if i else 0.0, one if one < np.inf else np.inf)  # NaN is not below anything
    for t in range(pixels.size):
        if not fine[t] or not size[t] < np.inf or pixels[t] < 0 or size[t] >= limit:
            why = FLAGGED if not fine[t] else NOT_FINITE if not size[t] < np.inf else OUTSIDE if pixels[t] < 0 else TOO_LARGE
            dropped[why] += 1
            continue
        high = max(high, size[t])
        kept[number], c[number], s[number] = pixels[t], c[t], s[t]
        if share.size:
            share[number] = share[t]
        for i in range(len(signals)):
            values[i, number] = values[i, t]
        number += 1
    return number, bits_of(high)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _runs(pixels, run, begins, places):  # type: ignore[no-untyped-def]
    """Number of runs of samples in one pixel; where each begins, and its pixel. ``run``: of each sample, counted from 1."""
    found, last = np.uint64(0), np.int32(-1)
    for t in range(np.uint64(pixels.size)):  # without branches: what is written where no run begins is written over
        pixel = pixels[t]
        begins[found], places[found] = t, pixel
        found += np.uint64(pixel != last)
        run[t] = found
        last = pixel
    begins[found] = pixels.size
    return np.int64(found)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _fetch(sums, columns, places, n_runs):  # type: ignore[no-untyped-def]
    """Fetch the sums of some pixels, which are in memory, while their terms are made."""
    for r in range(n_runs):
        place = np.uint64(places[r]) * columns
        for column in range(np.uint64(0), columns, np.uint64(8)):
            prefetch(sums, place + column)
        prefetch(sums, place + columns - np.uint64(1))


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _add(sums, column, terms, lane, lanes, places, begins, n_runs):  # type: ignore[no-untyped-def]
    """Add lanes of the runs' terms to columns from ``column`` on."""
    for r in range(n_runs):
        pixel, less = np.uint64(places[r]), (begins[r + 1] - begins[r]) * MAGIC_BITS
        last = 8 * (r + 1) + lane
        for k in range(lanes):
            sums[pixel, np.uint64(column + k)] += terms[np.uint64(last + k)] - terms[np.uint64(last + k - 8)] - less
