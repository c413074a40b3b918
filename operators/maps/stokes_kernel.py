"""The loops behind `stokes_sums`: cosines and sines in fixed point, and the sums of a tile's samples in their pixels.

Successive samples of a detector often fall in the same pixel. Their terms are added up along the row, all columns side by side
(`running_terms`), and each run of samples in one pixel goes to the map at once: what its last sample's sums have more than those
of the run before. Sums are integers modulo 2^64, so that this is exact, and how samples are cut in runs is not seen in the map.
"""

from __future__ import annotations

import numpy as np

from zonda.core.compilation.columns import add_change, prefetch, running_terms
from zonda.core.compilation.jit import nb
from zonda.core.polarization import fill_angles

from .sums import FLAGGED, LARGEST, MAGIC, MAGIC_BITS, NOT_FINITE, OUTSIDE, TOO_LARGE, VALUE, WEIGHT

HIT = 0
FIRST = 1
"""Column of the sum of w, from which on A follows: w, wc, ws, wcc, wcs, wss."""
DATA = 7
"""First column of the data: wd, wdc, wds of each signal, then N."""

AT_ONCE = 512
"""Samples of a detector whose terms are in the first cache together."""


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def rounded_angles(poles, axes, plate, gamma, detectors, start, efficiency, out):  # type: ignore[no-untyped-def]
    """p cos 2 psi and p sin 2 psi in units of 2^-30, into ``out`` (2, n, m) int32; arguments as of `PolarizationAngles`.

    ``detectors`` (n,): numbers; ``efficiency`` (n,): p; ``start``: the first sample.
    """
    n, cosine, sine = out.shape[2], np.empty(AT_ONCE), np.empty(AT_ONCE)
    for k in range(detectors.size):
        for begin in range(0, n, AT_ONCE):
            size = min(AT_ONCE, n - begin)
            c, s = cosine[:size], sine[:size]
            turn = c.reshape(1, size), s.reshape(1, size)  # C arrays: those of a slice would not be worked on in vectors
            fill_angles(poles, axes, plate, gamma, detectors[k : k + 1], start + begin, turn[0], turn[1])
            _rounded(efficiency[k], c, c.view(np.int64), out[0, k, begin : begin + size])
            _rounded(efficiency[k], s, s.view(np.int64), out[1, k, begin : begin + size])


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _rounded(factor, values, bits, out):  # type: ignore[no-untyped-def]
    """Values times ``factor`` in units of 2^-30; ``bits`` are those of ``values``, which are lost."""
    for t in range(out.size):
        values[t] = factor * values[t] * WEIGHT + MAGIC
    for t in range(out.size):
        out[t] = np.int32(bits[t])


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def add_stokes(signals, first, rows, at, cells, turn, good, window, weight, noise, own, sums, dropped, largest):  # type: ignore[no-untyped-def]
    """Add samples first .. of ``rows`` of all ``signals`` (a tuple) to their pixels.

    ``at`` (n_row,): of each, its row in ``cells`` (n, m), pixels or -1 outside, and in ``turn`` (2, n, m), c and s in units of
    2^-30. ``weight``, ``noise`` (n_row,); ``good`` (m,); ``window`` (m,), or (0,): none; ``own``: N is added up. Count what is
    dropped, note the largest terms.
    """
    m, n = len(signals), cells.shape[1]
    flat, columns = sums.reshape(-1), np.uint64(sums.shape[1])
    values, size, limits, kept = np.empty((m, AT_ONCE)), np.empty(AT_ONCE), np.empty(2), np.empty(AT_ONCE, np.int32)
    c, s, share, x = np.empty(AT_ONCE), np.empty(AT_ONCE), np.empty(AT_ONCE if window.size else 0), np.empty(AT_ONCE)
    bits, limit_bits = size.view(np.int64), limits.view(np.int64)
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
            w0, place, low = weight[k], at[k], first + begin
            limits[0] = LARGEST / VALUE / max(w0, 1.0)
            number, top = min(AT_ONCE, n - begin), np.int64(0)
            pixels = cells[place, begin : begin + number]
            for i in range(m):
                top = max(top, _scaled(signals[i][rows[k], low : low + number], w0 * VALUE, values[i], size, bits))
            _unpacked(turn[0, place, begin : begin + number], turn[1, place, begin : begin + number], c, s)
            share[:number] = window[begin : begin + number]
            if n_fine < number or top >= limit_bits[0] or _least(pixels) < 0:
                number = _without(signals, rows[k], low, pixels, fine, limits, size, c, s, share, values, kept, dropped)
                pixels, top = kept[:number], limit_bits[1]
            limit_bits[1] = top
            largest[0], largest[1] = max(largest[0], max(w0, noise[k]) * WEIGHT), max(largest[1], limits[1] * w0 * VALUE + 1.0)
            n_runs = _runs(pixels, run, begins, places)
            _fetch(flat, columns, places, n_runs)
            _scale(w0, share[:number], 1, x[:number])
            running_terms(c, s, x, values[0], MAGIC, run, number, terms)
            all_alike = 0 if window.size else np.int64((w0 * WEIGHT + MAGIC) - MAGIC)
            for r in range(n_runs):
                to, count = np.uint64(places[r]) * columns, begins[r + 1] - begins[r]
                flat[to] += count
                flat[to + np.uint64(FIRST)] += count * all_alike
                add_change(flat, to + np.uint64(FIRST + 1), terms, np.uint64(r + 1), count * MAGIC_BITS)
            for i in range(1, m):
                running_terms(c, s, x, values[i], MAGIC, run, number, terms)
                _add(flat, columns, DATA + 3 * i, terms, 5, 3, places, begins, n_runs)
            if window.size:
                running_terms(c, s, x, x, MAGIC, run, number, terms)
                _add(flat, columns, FIRST, terms, 5, 1, places, begins, n_runs)
            if own:
                _scale(noise[k], share[:number], 2, x[:number])
                running_terms(c, s, x, x, MAGIC, run, number, terms)
                _add(flat, columns, DATA + 3 * m, terms, 5, 1, places, begins, n_runs)
                _add(flat, columns, DATA + 3 * m + 1, terms, 0, 5, places, begins, n_runs)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _scaled(row, factor, out, size, bits):  # type: ignore[no-untyped-def]
    """Samples times ``factor``, and the bits of the largest, which are in the order of sizes: infinity and NaN are above all.

    ``bits`` are those of ``size``.
    """
    for t in range(row.size):
        one = np.float64(row[t])
        out[t], size[t] = one * factor, abs(one)
    top = np.int64(0)
    for t in range(row.size):
        top = max(top, bits[t])
    return top


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _unpacked(cosine, sine, c, s):  # type: ignore[no-untyped-def]
    for t in range(cosine.size):
        c[t], s[t] = cosine[t] / WEIGHT, sine[t] / WEIGHT


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _least(pixels):  # type: ignore[no-untyped-def]
    least = np.int32(0)
    for t in range(pixels.size):
        least = min(least, pixels[t])
    return least


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _scale(level, share, power, out):  # type: ignore[no-untyped-def]
    """The level of each sample in units of 2^-30: w times its share in the window; of the noise, whose power is 2, its square."""
    for t in range(out.size):
        out[t] = level * WEIGHT
    if share.size and power == 1:
        for t in range(out.size):
            out[t] = level * share[t] * WEIGHT
    elif share.size:
        for t in range(out.size):
            out[t] = level * share[t] * share[t] * WEIGHT


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _without(signals, d, first, pixels, fine, limits, size, c, s, share, values, kept, dropped):  # type: ignore[no-untyped-def]
    """Drop samples from ``c``, ``s``, ``share`` and ``values`` (m, n), and from ``pixels`` into ``kept``: how many are left.

    ``limits``: the size that is too large; the largest one that is left is put behind it. ``size``: space.
    """
    number = 0
    limits[1] = 0.0
    size[: pixels.size] = 0.0
    for i in range(len(signals)):
        row = signals[i][d, first : first + pixels.size]
        for t in range(row.size):
            one = abs(np.float64(row[t]))
            size[t] = max(size[t], one if one < np.inf else np.inf)  # NaN is not below anything
    for t in range(pixels.size):
        if not fine[t] or not size[t] < np.inf or pixels[t] < 0 or size[t] >= limits[0]:
            why = FLAGGED if not fine[t] else NOT_FINITE if not size[t] < np.inf else OUTSIDE if pixels[t] < 0 else TOO_LARGE
            dropped[why] += 1
            continue
        limits[1] = max(limits[1], size[t])
        kept[number], c[number], s[number] = pixels[t], c[t], s[t]
        if share.size:
            share[number] = share[t]
        for i in range(len(signals)):
            values[i, number] = values[i, t]
        number += 1
    return number


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
def _fetch(flat, columns, places, n_runs):  # type: ignore[no-untyped-def]
    """Fetch the sums of some pixels, which are in memory, while their terms are made."""
    for r in range(n_runs):
        place = np.uint64(places[r]) * columns
        for column in range(np.uint64(0), columns, np.uint64(8)):
            prefetch(flat, place + column)
        prefetch(flat, place + columns - np.uint64(1))


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _add(flat, columns, column, terms, lane, lanes, places, begins, n_runs):  # type: ignore[no-untyped-def]
    """Add lanes of the runs' terms to columns from ``column`` on."""
    for r in range(n_runs):
        to, less = np.uint64(places[r]) * columns + np.uint64(column), (begins[r + 1] - begins[r]) * MAGIC_BITS
        last = np.uint64(8 * (r + 1) + lane)
        for k in range(np.uint64(lanes)):
            flat[to + k] += terms[last + k] - terms[last + k - np.uint64(8)] - less
