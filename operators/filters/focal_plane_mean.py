"""The detectors' mean at each instant, found in one reading of a stream of any size, or two.

    m_t = (1 / n) sum_d x_dt  over the n good detectors                                          (1)

With a source mask the sum is over the detectors outside of it at that instant, and so is n; the
mean is 0 where there is none.

The sum runs over the `TILE_DETECTORS` detectors of a tile, then over the tiles in order, in
float64: it has the same bits however the stream is cut. A second reading is made only where the
first finds detectors that must not take part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel
from zonda.core.numerics.chunks import TILE_DETECTORS, TILE_SAMPLES, chunks
from zonda.core.stream import Stream
from zonda.core.types import Floats

from .source_mask import Inside

Mask = NDArray[np.bool_]


@dataclass
class Reading:
    """Sums of one reading of a stream.

    Attributes
    ----------
    total
        (n_samp,): sum over the detectors in use; 0 at flagged samples.
    low, high
        (n_samp,): the least and the largest value among them.
    sums, squares
        (n_det,): of each detector's good samples.
    """

    total: Floats
    low: Floats
    high: Floats
    sums: Floats
    squares: Floats

    @property
    def least_left(self) -> float:
        """Lower bound of the energy that is left without the mean: sum_t (high - low)^2 / 2, no
        cancellation in it.
        """
        seen = self.high > self.low
        return float(0.5 * ((self.high[seen] - self.low[seen]) ** 2).sum())


def read(stream: Stream, use: Mask, good: Mask, inside: Inside | None = None) -> Reading:
    """One sweep over a stream. ``use`` (n_det,), ``good`` (n_samp,): which detectors and samples
    take part; ``inside``: a source mask, for which `Reading.total` is n times the mean of the
    others."""
    n_det, n_samp = stream.shape
    reading = Reading(
        np.zeros(n_samp),
        np.full(n_samp, np.inf),
        np.full(n_samp, -np.inf),
        np.zeros(n_det),
        np.zeros(n_det),
    )
    field = stream.means.get(stream.name)

    taking = np.zeros(n_samp)  # detectors outside of the mask

    def look(detectors: slice, samples: slice, part: NDArray[np.floating]) -> tuple[Floats, ...]:
        rows, n = part.shape
        sums = np.zeros((-(-rows // TILE_DETECTORS), n))
        range_of = np.empty((2, n))
        range_of[0], range_of[1] = np.inf, -np.inf
        count = np.zeros(n)
        moments = np.zeros((-(-n // TILE_SAMPLES), 2, rows))
        for here, added in zip(chunks(n, TILE_SAMPLES), moments, strict=True):
            at = slice(samples.start + here.start, samples.start + here.stop)
            tile, begin, end = part, here.start, here.stop
            if field is not None or inside is not None or not good[at].all():
                tile, begin, end = part[:, here].astype(np.float64), 0, here.stop - here.start
                if field is not None:
                    tile += field.evaluate(detectors, at)
                tile[:, ~good[at]] = 0
            if inside is None:
                _look(tile, begin, end, use[detectors], sums[:, here], range_of[:, here], added)
                continue
            _look(
                tile, begin, end, np.zeros(rows, np.bool_), sums[:, here], range_of[:, here], added
            )
            seen = use[detectors, None] & ~inside.at(detectors, at)
            for k in range(0, rows, TILE_DETECTORS):
                few = slice(k, k + TILE_DETECTORS)
                sums[k // TILE_DETECTORS, here] = np.where(seen[few], tile[few], 0.0).sum(axis=0)
            range_of[0, here] = np.where(seen, tile, np.inf).min(axis=0)
            range_of[1, here] = np.where(seen, tile, -np.inf).max(axis=0)
            count[here] = seen.sum(axis=0)
        return sums, range_of, moments, count

    for detectors, samples, (sums, range_of, moments, count) in stream.sweep(look):
        taking[samples] += count
        for tile in sums:
            reading.total[samples] += tile
        np.minimum(reading.low[samples], range_of[0], out=reading.low[samples])
        np.maximum(reading.high[samples], range_of[1], out=reading.high[samples])
        for first, second in moments:
            reading.sums[detectors] += first
            reading.squares[detectors] += second
    if inside is not None:
        reading.total *= int(use.sum()) / np.maximum(taking, 1)
    return reading


LANES = 32
"""Partial sums of a detector's moments: fixed, so that bits do not depend on the machine's vectors.
"""


@kernel(fastmath={"contract", "nsz"})
def add_moments(row, lanes, out):  # type: ignore[no-untyped-def]
    """Add the sum and the sum of squares of ``row`` (n,) to ``out`` (2,). ``lanes`` (2, LANES):
    scratch.
    """
    n = row.size
    whole = n // LANES * LANES
    first, second = lanes[0], lanes[1]
    first[:] = 0.0
    second[:] = 0.0
    for base in range(0, whole, LANES):
        x = row[base : base + LANES]
        for i in range(LANES):
            y = np.float64(x[i])
            first[i] += y
            second[i] += y * y
    for t in range(whole, n):
        first[0] += row[t]
        second[0] += np.float64(row[t]) ** 2
    for i in range(LANES):
        out[0] += first[i]
        out[1] += second[i]


@kernel(fastmath={"contract", "nsz"})
def _look(part, start, stop, use, sums, range_of, moments):  # type: ignore[no-untyped-def]
    """Add samples start .. stop - 1 of ``part`` to ``sums`` (tiles, n), ``range_of`` (2, n) and
    ``moments`` (2, n_det).
    """
    n = stop - start
    lanes = np.empty((2, LANES))
    low, high = range_of[0], range_of[1]
    for d in range(part.shape[0]):
        row = part[d, start:stop]
        if use[d]:
            total = sums[d // TILE_DETECTORS]
            for t in range(n):
                x = np.float64(row[t])
                total[t] += x
                low[t] = min(low[t], x)
                high[t] = max(high[t], x)
        add_moments(row, lanes, moments[:, d])
