"""Sums of samples in pixels, in fixed point.

    D_p = sum_i rint(2^36 w_i d_i),   H_p = sum_i 1,   W_p = sum_i rint(2^30 w_i),   N_p = sum_i rint(2^30 n_i)         (1)

over the samples i in pixel p, as int64: exact, so that their bits depend neither on the order of blocks nor on the number of
threads. Where all detectors weigh the same, W and N follow from H.

A thread's sums have a border for what falls outside of the map: a pixel all around an image, row 0 before a list of pixels.
What is flagged, not finite or too large goes to row 0 too.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.compilation.columns import prefetch
from zonda.core.compilation.jit import nb
from zonda.core.errors import PipelineError
from zonda.core.numerics.chunks import empty
from zonda.core.types import Floats

from .grid import Grid, TangentGrid

if TYPE_CHECKING:
    from zonda.core.data import Observation

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
"""Detectors that are scattered side by side: successive samples of one often fall in the same pixel and would wait for it."""

AHEAD = 16
"""Samples by which pixels are fetched beforehand: those of a map larger than the cache come from memory."""

AT_ONCE = 256
"""Samples of `TOGETHER` detectors whose pixels, values and pointing are in the first cache together."""

DATA, HITS, WEIGHTS, NOISE = range(4)
OUTSIDE, FLAGGED, NOT_FINITE, TOO_LARGE = range(4)


@dataclass
class Binning:
    """One observation's pointing and weights, and the sums of each thread.

    Attributes
    ----------
    pointing
        What `Grid.pointing` gives.
    good
        (n_samp,) uint8: 1 where not flagged.
    weight, noise
        (n_det,): w, and w^2 times the variance of one sample, in units of the reference variance.
    alike
        All detectors weigh the same: the sums of weights and noise follow from the hits.
    not_finite, kept_out
        (n, 3) detector, first sample, end: what was not finite, in several arrays; what the main run dropped for that reason.
    spare
        Arrays of zeros that served the scans before: touching fresh memory costs more than the sums.
    """

    grid: Grid
    pointing: Floats
    good: NDArray[np.uint8]
    weight: Floats
    noise: Floats
    alike: bool
    spare: list[Sums] = field(default_factory=list)
    parts: dict[int, tuple[Sums, Sums, Floats]] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)
    not_finite: list[NDArray[np.int64]] = field(default_factory=list)
    kept_out: NDArray[np.int64] | None = None

    def note_not_finite(self, signal: NDArray[np.floating], rows: slice, begin: int) -> None:
        """Remember which samples of a block of detectors ``rows``, from sample ``begin`` on, are not finite."""
        n_det, n = signal.shape
        bad = np.zeros((n_det, n + 2), np.int8)
        np.logical_not(np.isfinite(signal), out=bad[:, 1:-1])
        detector, edge = np.nonzero(np.diff(bad, axis=1))
        found = np.stack([rows.start + detector[::2], begin + edge[::2], begin + edge[1::2]], axis=1)
        with self.lock:
            self.not_finite.append(found.astype(np.int64))

    def without_kept_out(self, signal: NDArray[Any], rows: slice, samples: slice) -> NDArray[Any]:
        """The block's signal with NaN where `kept_out` says so; itself where that is nowhere."""
        if self.kept_out is None:
            return signal
        detector, first, end = self.kept_out.T
        here = (detector >= rows.start) & (detector < rows.stop) & (first < samples.stop) & (end > samples.start)
        if not here.any():
            return signal
        signal = signal.copy()
        for d, low, high in self.kept_out[here]:
            signal[d - rows.start, max(low - samples.start, 0) : high - samples.start] = np.nan
        return signal

    def of_thread(self) -> tuple[Sums, Sums, Floats]:
        """(sums with their border (n, 4, or 2 where alike), dropped (4,), largest (4,))."""
        mine = threading.get_ident()
        with self.lock:
            if mine not in self.parts:
                self.parts[mine] = self._zeros(), np.zeros(4, np.int64), np.zeros(4)
            return self.parts[mine]

    def _zeros(self) -> Sums:
        n = self.grid.n_pixels + 1
        if isinstance(self.grid, TangentGrid):
            n = (self.grid.shape[0] + 2) * (self.grid.shape[1] + 2)
        shape = n, 2 if self.alike else 4
        try:
            while (sums := self.spare.pop()).shape != shape:
                pass
        except IndexError:
            return np.zeros(shape, np.int64)
        return sums

    def fold(self, half: Sums) -> tuple[int, int, Sums, Floats]:
        """Add all threads' sums to ``half`` (n_pixels, 4): (samples binned, most in a pixel, dropped (4,), largest (4,))."""
        dropped, largest, inside, deepest = np.zeros(4, np.int64), np.zeros(4), 0, 0
        rows, columns = self.grid.shape if isinstance(self.grid, TangentGrid) else (0, 0)
        weight, noise = (np.int64(np.rint(x[0] * WEIGHT)) if x.size else np.int64(0) for x in (self.weight, self.noise))
        for sums, part_dropped, part_largest in self.parts.values():
            binned, outside, most = _fold(sums, rows, columns, weight, noise, half)
            inside, deepest = inside + binned, max(deepest, most)
            dropped += part_dropped
            dropped[OUTSIDE] += outside
            largest = np.maximum(largest, part_largest)
            self.spare.append(sums)
        self.parts.clear()
        return inside, deepest, dropped, largest


class Halves:
    """Sums of the even and of the odd observations, in their order."""

    def __init__(self, n_pixels: int) -> None:
        self.sums = empty((2 * n_pixels, 4), np.int64).reshape(2, n_pixels, 4)
        self.scans: list[str] = []
        self.rates: set[float] = set()
        """Hz: of the scans."""
        self._largest = np.zeros(4)
        self._deepest = [0, 0]

    def add(self, observation: Observation, state: Binning, label: str) -> tuple[int, Sums]:
        """Add one observation: (samples binned, dropped (4,)). Raises PipelineError where a sum may have overflowed."""
        k = len(self.scans) % 2
        inside, deepest, dropped, largest = state.fold(self.sums[k])
        self.scans.append(observation.name)
        self.rates.add(float(observation.sample_rate))
        self._note(k, deepest, largest)
        self._check(f"{label}, {observation.name}")
        return inside, dropped

    def total(self, pixels: slice) -> Sums:
        """Both halves together of some pixels, (n, 4)."""
        return np.asarray(self.sums[: len(self.scans), pixels].sum(axis=0) if len(self.scans) > 1 else self.sums[0, pixels])

    def packed(self) -> dict[str, Any]:
        """As plain values and arrays: numbers of the pixels with hits, and their sums."""
        used = [np.flatnonzero(half[:, HITS]) for half in self.sums]
        found: dict[str, Any] = {"scans": list(self.scans), "rates": sorted(self.rates), "largest": self._largest}
        for k, pixels in enumerate(used):
            found |= {f"pixels_{k}": pixels, f"sums_{k}": self.sums[k].take(pixels, axis=0)}
        return found

    def merge(self, part: Mapping[str, Any], label: str) -> None:
        """Add what `packed` gave, whose scans follow those that are here. Raises PipelineError as `add`."""
        shift = len(self.scans) % 2
        for k in range(2):
            half, pixels = (k + shift) % 2, part[f"pixels_{k}"]
            merged = part[f"sums_{k}"] + (self.sums[half].take(pixels, axis=0) if self.scans else 0)
            self.sums[half][pixels] = merged
            self._note(half, int(merged[:, HITS].max(initial=0)), part["largest"])
        self.scans += part["scans"]
        self.rates |= set(part["rates"])
        self._check(label)

    def _note(self, half: int, deepest: int, largest: Floats) -> None:
        """Most samples in a pixel of a half, largest terms."""
        self._deepest[half] = max(self._deepest[half], deepest)
        self._largest = np.maximum(self._largest, largest)

    def _check(self, place: str) -> None:
        """No sum can have overflowed."""
        if sum(self._deepest) * self._largest.max() < 2.0**62:
            return
        deepest = float(self.sums[:, :, HITS].sum(axis=0).max(initial=0))
        if deepest * self._largest.max() >= 2.0**62:
            highest = self._largest[DATA] / VALUE
            raise PipelineError(
                f"{deepest:.0f} samples in one pixel, each up to {highest:.3g} K, overflow the map's fixed-point sums",
                place=place,
                cure="make smaller pixels, or put a HighpassFilter before",
            )


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def add_image(signal, h, start, xi, eta, ny, nx, use, good, weight, noise, scatter, per_variance, sums, dropped, largest):  # type: ignore[no-untyped-def]
    """Add a block that begins at sample ``start`` to an image of (ny, nx) pixels; the rest as in `_add`."""
    n = signal.shape[1]
    space = np.empty(xi.size * AT_ONCE, np.int32)
    for low in range(0, n, AT_ONCE):
        high = min(low + AT_ONCE, n)
        cells = space[: xi.size * (high - low)].reshape(xi.size, high - low)
        for d in range(xi.size):
            if use[d]:
                _cells(h, start + low, xi[d], eta[d], ny, nx, cells[d])
        _add(signal, low, cells, nx + 2, use, good, weight, noise, scatter, per_variance, sums, dropped, largest)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _cells(h, start, a, b, ny, nx, cells):  # type: ignore[no-untyped-def]
    """Place (y + 1) (nx + 2) + x + 1 of the pixel that holds each sample of a detector at (a, b); beyond the edge, the border's.

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


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def add_list(signal, first, index, use, good, weight, noise, scatter, per_variance, sums, dropped, largest):  # type: ignore[no-untyped-def]
    """Add samples first .. of a block to the pixels ``index`` (n_det, n) of a list, -1 outside; the rest as in `_add`."""
    index += np.int32(1)
    _add(signal, first, index, 0, use, good, weight, noise, scatter, per_variance, sums, dropped, largest)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _add(signal, first, cells, stride, use, good, weight, noise, scatter, per_variance, sums, dropped, largest):  # type: ignore[no-untyped-def]
    """Add samples to their places in ``sums`` (n, 4; or 2: all detectors weigh the same); count what is dropped; note the
    largest terms, that of the data to the next power of two.

    ``cells`` (n_det, n): places of the samples first .. first + n - 1 of the block, like ``good``. ``stride``: places in a row of
    an image, 0 for a list. What is dropped for another reason is counted out of those outside: all of the border will be added.
    """
    n = cells.shape[1]
    flat, columns = sums.reshape(-1), np.uintp(sums.shape[1])
    fine = good[first : first + n]
    all_fine = True
    for t in range(n):  # numpy's all() and flatnonzero() would take a second more to compile
        all_fine &= fine[t] != 0
    rows, n_rows = np.empty(use.size, np.int64), 0
    for d in range(use.size):
        if use[d]:
            rows[n_rows] = d
            n_rows += 1
    rows = rows[:n_rows]
    dropped[FLAGGED] += n * (use.size - rows.size)
    shifted = np.empty((TOGETHER, n))
    units = shifted.view(np.int64)
    for begin in range(0, rows.size, TOGETHER):
        group = rows[begin : begin + TOGETHER]
        for k in range(group.size):
            d = group[k]
            limit, factor, square = _scales(weight[d], per_variance, scatter)
            row, places, unit = signal[d, first : first + n], cells[d], units[k]
            high = _units(row, factor, shifted[k], unit)
            if not all_fine or high >= limit * factor:
                _drop(row, fine, limit, places, unit, stride, sums.shape[0] // max(stride, 1), dropped)
                high = 0
                for t in range(n):
                    high |= unit[t] if unit[t] >= 0 else ~unit[t]
            largest[DATA] = max(largest[DATA], float(high + 1))
            if columns == 4:
                w, term = np.int64(np.rint(weight[d] * WEIGHT)), np.int64(np.rint(noise[d] * WEIGHT))
                for t in range(n):
                    if scatter:
                        y = np.float64(unit[t]) / factor
                        term = np.int64(np.rint(square * y * y))
                        largest[NOISE] = max(largest[NOISE], float(term))
                    at = np.uintp(places[t]) * columns
                    flat[at + np.uintp(WEIGHTS)] += w
                    flat[at + np.uintp(NOISE)] += term
                largest[WEIGHTS] = max(largest[WEIGHTS], float(w))
                largest[NOISE] = max(largest[NOISE], float(term))
        if columns == 2:  # a constant makes shorter code
            _scatter(flat, np.uintp(2), cells, group, units)
        else:
            _scatter(flat, columns, cells, group, units)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _scales(weight, per_variance, scatter):  # type: ignore[no-untyped-def]
    """Of one detector: the largest |d| [K] that is accepted, units of w d per K, and units of the scatter per K^2."""
    limit, square = LARGEST / VALUE / max(weight, 1.0), weight * per_variance * WEIGHT
    if scatter:
        limit = min(limit, math.sqrt(2.0**60 / square))
    return limit, weight * VALUE, square


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _units(row, factor, shifted, units):  # type: ignore[no-untyped-def]
    """w d in fixed point, and all their bits together (of ~q where q < 0): an upper bound of |q| below the next power of two.

    ``units`` are the bits of ``shifted``: adding `MAGIC` rounds to an integer in the low bits. What is not finite or beyond
    2^51 gives a bound above that.
    """
    for t in range(row.size):
        shifted[t] = np.float64(row[t]) * factor + MAGIC
    together = np.int64(0)
    for t in range(row.size):
        q = units[t] - MAGIC_BITS
        units[t] = q
        together |= ~q if q < 0 else q
    return together


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _drop(row, fine, limit, places, units, stride, n_rows, dropped):  # type: ignore[no-untyped-def]
    """Send what is flagged, not finite or too large to place 0 with no value, and count it."""
    for t in range(row.size):
        size, place = abs(np.float64(row[t])), places[t]
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
            units[t] = 0
        if why != OUTSIDE:
            dropped[why] += 1
            dropped[OUTSIDE] -= 1


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _scatter(flat, columns, cells, rows, units):  # type: ignore[no-untyped-def]
    """Add fixed-point values (n_row, n) and hits to the places of the detectors ``rows`` (n_row,)."""
    hit, last = np.uintp(HITS), np.uintp(cells.shape[1] - 1)
    if rows.size == TOGETHER:
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
        return
    for k in range(rows.size):
        places = cells[rows[k]]
        for t in range(np.uintp(places.size)):
            at = np.uintp(places[t]) * columns
            flat[at] += units[k, t]
            flat[at + hit] += 1


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _fold(sums, ny, nx, weight, noise, out):  # type: ignore[no-untyped-def]
    """Move a thread's sums to ``out`` (n_pixels, 4): hits inside, on the border, and the most in a pixel. ``ny``: 0 for a list.

    ``weight``, ``noise``: of every sample, where ``sums`` has two columns.
    """
    inside, outside, most = np.int64(0), np.int64(0), np.int64(0)
    width = nx + 2 if ny else sums.shape[0]
    for y in range(sums.shape[0] // width):
        for x in range(width):
            at = y * width + x
            hits = sums[at, HITS]
            if not hits:
                continue
            to = (y - 1) * nx + x - 1 if ny else at - 1
            if x == 0 or (ny and (x == nx + 1 or y == 0 or y == ny + 1)):
                outside += hits
                sums[at] = 0
                continue
            inside += hits
            out[to, DATA] += sums[at, DATA]
            out[to, HITS] += hits
            most = max(most, out[to, HITS])
            out[to, WEIGHTS] += sums[at, WEIGHTS] if sums.shape[1] == 4 else hits * weight
            out[to, NOISE] += sums[at, NOISE] if sums.shape[1] == 4 else hits * noise
            sums[at] = 0
    return inside, outside, most
