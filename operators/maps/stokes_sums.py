"""Sums of samples in pixels for maps of I, Q and U, in fixed point.

A sample of a detector of polarization efficiency p whose axis is at the angle psi from the meridian sees (1, c, s) of (I, Q, U),
with c = p cos 2 psi and s = p sin 2 psi (`core.polarization`). The map m that fits the samples d of a pixel best, with weights w:

    A m = b,   A = sum_i w_i (1, c_i, s_i)^T (1, c_i, s_i),   b = sum_i w_i d_i (1, c_i, s_i).                    (1)

A window W that multiplied the signals multiplies w in A (`bin_map`, equation 2). The covariance of m is

    A^-1 N A^-1,   N = sum_i w_i^2 W_i^2 sigma_i^2 (1, c_i, s_i)^T (1, c_i, s_i),                                  (2)

which is A^-1 where weights are inverse variances and there is no window: then N is not added up.

c and s are rounded to 2^-30 once, and all sums take the rounded ones. The terms of A and N are rounded to 2^-30 of the reference
weight, those of b to 2^-36 K: as int64 the sums are exact, and their bits depend neither on the order of blocks nor on the number
of threads or workers.
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.compilation.jit import nb
from zonda.core.numerics.tiles import TILE_DETECTORS, TILE_SAMPLES
from zonda.core.polarization import PolarizationAngles
from zonda.core.types import Floats

from .grid import Grid
from .sums import FLAGGED, LARGEST, MAGIC, NOT_FINITE, OUTSIDE, TOO_LARGE, VALUE, WEIGHT, Sums

HIT = 0
MATRIX = slice(1, 7)
"""Columns of A: w, wc, ws, wcc, wcs, wss; the data follow (wd, wdc, wds of each signal), then N."""
DATA = 7
PLACES = (1, 2, 3, 2, 4, 5, 3, 5, 6)
"""Columns of A as a matrix, row by row."""


@dataclass
class StokesBinning:
    """One observation's pointing, angles and weights, and the sums of each thread.

    Attributes
    ----------
    pointing
        What `Grid.pointing` gives.
    use, good, window
        (n_det,), (n_samp,) uint8: which detectors and samples count; (n_samp,): `Observation.window`, or (0,).
    weight, noise
        (n_det,): w, and w^2 times the variance of one sample, in units of the reference variance.
    efficiency
        (n_det,) p.
    signals
        Number of signals.
    own_noise
        Whether N is not A, and is added up.
    spare
        Arrays of zeros that served the scans before.
    """

    grid: Grid
    pointing: Floats
    angles: PolarizationAngles
    use: NDArray[np.bool_]
    good: NDArray[np.uint8]
    window: Floats
    weight: Floats
    noise: Floats
    efficiency: Floats
    signals: int
    own_noise: bool
    spare: list[Sums] = field(default_factory=list)
    parts: dict[int, tuple[Sums, Sums, Floats]] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def columns(self) -> int:
        return DATA + 3 * self.signals + (6 if self.own_noise else 0)

    def add(self, signals: tuple[Any, ...], block: Block) -> None:
        """Add a block's ``signals``, each (n_det, n), to this thread's sums."""
        sums, dropped, largest = self._of_thread()
        detectors, samples, plane = block.detectors, block.samples, block.observation.focalplane
        used = self.use[detectors] & block.observation.good_detectors[detectors]
        dropped[FLAGGED] += (samples.stop - samples.start) * int(np.count_nonzero(~used))
        for rows, start, stop in tiles(block, used):
            which, first = rows + detectors.start, start - samples.start
            index = np.empty((rows.size, stop - start), np.int32)
            turn = np.empty((2, *index.shape))
            self.grid.pixels(self.pointing, start, stop, plane.xi[which], plane.eta[which], index)
            self.angles.fill(which, start, turn[0], turn[1])
            of_rows = self.weight[which], self.noise[which], self.efficiency[which]
            which_ones = self.good[start:stop], self.window[start:stop], *of_rows
            add_stokes(signals, first, rows, index, turn[0], turn[1], *which_ones, self.own_noise, sums, dropped, largest)

    def _of_thread(self) -> tuple[Sums, Sums, Floats]:
        """(sums (n_pixels, columns), dropped (4,), largest (2,): of A and N, of b)."""
        mine = threading.get_ident()
        with self.lock:
            if mine not in self.parts:
                shape = self.grid.n_pixels, self.columns
                kept = [k for k, sums in enumerate(self.spare) if sums.shape == shape]
                sums = self.spare.pop(kept[-1]) if kept else np.zeros(shape, np.int64)
                self.parts[mine] = sums, np.zeros(4, np.int64), np.zeros(2)
            return self.parts[mine]

    def taken(self) -> Iterator[tuple[NDArray[np.int64], Sums, Sums, Floats]]:
        """Of each thread: numbers of the pixels with hits, their sums, dropped (4,), largest (2,). They are zero afterwards."""
        for sums, dropped, largest in self.parts.values():
            pixels = np.flatnonzero(sums[:, HIT])
            found = sums.take(pixels, axis=0)
            sums[pixels] = 0
            self.spare.append(sums)
            yield pixels, found, dropped, largest
        self.parts.clear()


def tiles(block: Block, used: NDArray[np.bool_]) -> Iterator[tuple[NDArray[np.int64], int, int]]:
    """Of a block, in pieces that stay in the cache: rows of the detectors that are ``used`` (n_det,), first and last sample."""
    rows = np.flatnonzero(used)
    for some in np.split(rows, range(TILE_DETECTORS, rows.size, TILE_DETECTORS)):
        for start in range(block.samples.start, block.samples.stop, TILE_SAMPLES):
            yield some, start, min(start + TILE_SAMPLES, block.samples.stop)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def add_stokes(signals, first, rows, cells, cosine, sine, good, window, weight, noise, p, own, sums, dropped, largest):  # type: ignore[no-untyped-def]
    """Add samples first .. of ``rows`` of all ``signals`` (a tuple) to their pixels ``cells`` (n_row, n), -1 outside.

    ``cosine``, ``sine`` (n_row, n) of 2 psi; ``weight``, ``noise`` and the efficiency ``p`` (n_row,); ``good`` (n,);
    ``window`` (n,), or (0,): none. Count what is dropped, note the largest terms.
    """
    m, end = len(signals), DATA + 3 * len(signals)
    for k in range(rows.size):
        d, w0 = rows[k], weight[k]
        factor = w0 * VALUE
        limit = LARGEST / VALUE / max(w0, 1.0)
        high = 0.0
        largest[0] = max(largest[0], max(w0, noise[k]) * WEIGHT)
        for t in range(cells.shape[1]):
            size = 0.0
            for s in range(m):
                one = abs(np.float64(signals[s][d, first + t]))
                size = max(size, one) if one < np.inf else np.inf  # NaN is not below anything
                if not one < np.inf:
                    break
            pixel = cells[k, t]
            if not good[t] or not size < np.inf or pixel < 0 or size >= limit:
                why = FLAGGED if not good[t] else NOT_FINITE if not size < np.inf else OUTSIDE if pixel < 0 else TOO_LARGE
                dropped[why] += 1
                continue
            high = max(high, size)
            row = sums[pixel]
            c = ((p[k] * cosine[k, t] * WEIGHT + MAGIC) - MAGIC) / WEIGHT
            q = ((p[k] * sine[k, t] * WEIGHT + MAGIC) - MAGIC) / WEIGHT
            share = window[t] if window.size else 1.0
            w = w0 * share * WEIGHT
            row[HIT] += 1
            row[1] += np.int64((w + MAGIC) - MAGIC)
            row[2] += np.int64((w * c + MAGIC) - MAGIC)
            row[3] += np.int64((w * q + MAGIC) - MAGIC)
            row[4] += np.int64((w * c * c + MAGIC) - MAGIC)
            row[5] += np.int64((w * c * q + MAGIC) - MAGIC)
            row[6] += np.int64((w * q * q + MAGIC) - MAGIC)
            for s in range(m):
                value = np.float64(signals[s][d, first + t]) * factor
                at = DATA + 3 * s
                row[at] += np.int64((value + MAGIC) - MAGIC)
                row[at + 1] += np.int64((value * c + MAGIC) - MAGIC)
                row[at + 2] += np.int64((value * q + MAGIC) - MAGIC)
            if own:
                w = noise[k] * share * share * WEIGHT
                row[end] += np.int64((w + MAGIC) - MAGIC)
                row[end + 1] += np.int64((w * c + MAGIC) - MAGIC)
                row[end + 2] += np.int64((w * q + MAGIC) - MAGIC)
                row[end + 3] += np.int64((w * c * c + MAGIC) - MAGIC)
                row[end + 4] += np.int64((w * c * q + MAGIC) - MAGIC)
                row[end + 5] += np.int64((w * q * q + MAGIC) - MAGIC)
        largest[1] = max(largest[1], high * factor + 1.0)
