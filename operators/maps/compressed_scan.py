"""A scan as a maximum-likelihood map needs it: baselines, runs of samples in one pixel, and what
detectors have in common at the full rate.

Samples d_i of a detector are cut into baselines b of L samples, which begin at multiples of L. Of
those that count (not flagged, finite, inside the map) a scan keeps

    y_b = mean of d in a baseline,               (Y m)_b of a map m,                         (1)
    s_k(t) = sum_d a_kd (d_d(t) - y_b),          (S m)_k of a map m,                         (2)

and the *runs*: successive samples of one detector in one pixel p, n at a time. A run adds n m_p to
its baseline, and a step up at its first sample and down behind its last to s; the adjoint takes
differences of running sums of s. Of a map, (1) and (2) therefore cost a few operations for each
run, not for each sample.

A sample that does not count while those of other detectors do is a *gap*: a run in a pixel of its
own beyond the map, of I alone, and so an unknown of infinite variance. Streams have the mean of
their baseline there. Samples of instants that no detector has, and of detectors that have none,
lie in one further pixel, and add nothing.

A polarized run sees v = I + c Q + s U with the means of c and s (`core.polarization`) over it;
where the angle turns within a run (a half-wave plate), each sample is a run of its own.

Runs end at baselines and at multiples of `TILE_SAMPLES`: they depend on no block. They follow from
pointing and flags, and from samples that are not finite, of which a list is kept. They are found
once, and kept in memory or in files; or anew whenever they are needed, with the same bits.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel
from zonda.core.numerics.chunks import chunks
from zonda.core.run.streams import in_file
from zonda.core.stream import forget_pages
from zonda.core.types import Floats

from .runs_of_pointing import RunsOfPointing

PART = 1 << 25
"""Bytes of runs in files that are worked on at a time."""


class Keeps(IntEnum):
    """A place of runs: memory, files, or none, where they are found anew."""

    MEMORY = 0
    FILES = 1
    AGAIN = 2


@dataclass
class CompressedScan:
    """Runs and baselines of the good detectors of a scan.

    Attributes
    ----------
    length, rate
        Samples of a baseline, and the sample rate [Hz].
    n_pixels, gaps
        Of the map; then pixels of gaps follow, then that of samples that are left out.
    pixel, samples
        (n_runs,) int32 and uint16: pixel of each run, and its samples; one detector after the
        other, in order of time.
    first
        (n_det n_base + 1,) int64: the first run of each baseline.
    counted
        (n_det, n_base) int32: samples of each baseline that count, and gaps.
    known
        (n_det, n_base) int32: those of them that are no gaps.
    angles
        (2, n_runs) means of c and s over each run; (2, 0) for maps of I.
    within
        (n_det,) sum of the squares of the complete signal's samples about the means of their
        baselines, K^2.
    again
        Finds runs that are not kept.
    """

    length: int
    rate: float
    n_samples: int
    n_pixels: int
    gaps: int
    pixel: NDArray[np.int32]
    samples: NDArray[np.uint16]
    first: NDArray[np.int64]
    counted: NDArray[np.int32]
    known: NDArray[np.int32]
    angles: Floats = field(default_factory=lambda: np.zeros((2, 0)))
    within: Floats = field(default_factory=lambda: np.zeros(0))
    again: RunsOfPointing | None = None

    @property
    def shape(self) -> tuple[int, int]:
        """(n_det, n_base)."""
        return self.counted.shape[0], self.counted.shape[1]

    @property
    def width(self) -> int:
        """Pixels of the map, and gaps: columns of the maps below."""
        return self.n_pixels + self.gaps

    @property
    def lacking(self) -> NDArray[np.bool_]:
        """(n_det, n_base) baselines of gaps alone."""
        return np.asarray((self.known == 0) & (self.counted > 0))

    @property
    def nbytes(self) -> int:
        """Bytes that it holds."""
        every = self.pixel, self.samples, self.first, self.counted, self.angles
        more = self.known.nbytes if self.gaps else 0
        return sum(array.nbytes for array in every) + more

    def seen(self, m: Floats, a: Floats) -> tuple[Floats, Floats]:
        """(Y m (n_det, n_base), S m (k, n_samp)) of a map m (1 or 3, width), equations (1) and
        (2); ``a`` (k, n_det).
        """
        y, m = np.empty(self.shape), np.ascontiguousarray(m)
        modes = a if len(a) else np.zeros((1, len(y)))
        steps = np.zeros((len(modes), self.n_samples + 1))
        for some, runs in self.parts():
            for k, (mode, row) in enumerate(zip(modes, steps, strict=True)):
                _see(*runs, m, mode[some], k > 0, y[some], row)
        return y, np.cumsum(steps[: len(a)], axis=1)[:, :-1]

    def spread(self, y: Floats, s: Floats, a: Floats, out: Floats) -> None:
        """Add Y^T y + S^T s to a map ``out`` (1 or 3, width): the adjoint of `seen`."""
        modes = a if len(a) else np.zeros((1, len(y)))
        running = np.zeros((len(modes), self.n_samples + 1))
        np.cumsum(s, axis=1, out=running[: len(a), 1:])
        for k, (mode, row) in enumerate(zip(modes, running, strict=True)):
            own = np.zeros_like(y) if k else np.ascontiguousarray(y)
            for some, runs in self.parts():
                _spread(*runs, self.length, mode[some], k > 0, own[some], row, out)

    def about_means(self, s: Floats, y: Floats, a: Floats) -> Floats:
        """Equation (2) from s' = sum_d a_kd d_d(t) (k, n_samp) of the samples that count."""
        steps = np.zeros((len(a), self.n_samples + 1))
        for some, (first, pixel, samples, _, counted) in self.parts():
            lowered = np.ascontiguousarray(a[:, some]), np.ascontiguousarray(y[some])
            _lower(first, pixel, samples, counted, self.n_pixels, *lowered, steps)
        return np.asarray(s + np.cumsum(steps, axis=1)[:, :-1])

    def over(self, c: Floats) -> Floats:
        """(n_det, n_base) sums of a stream (n_samp,) over the samples of each detector that are
        there.
        """
        running, out = np.concatenate([[0.0], np.cumsum(c)]), np.zeros(self.shape)
        for some, (first, pixel, samples, *_) in self.parts():
            _over(first, pixel, samples, self.n_pixels, running, out[some])
        return out

    def weigh(self, weight: Floats, out: Floats) -> None:
        """Add each detector's ``weight`` (n_det,) at its samples to the weights ``out`` (1 or 6,
        width) of I, or of I, Q and U: ii, iq, iu, qq, qu, uu.
        """
        for some, runs in self.parts():
            _weigh(*runs, weight[some], out)

    def in_gaps(self, y: Floats) -> Floats:
        """(gaps,) of each gap its baseline's value of y (n_det, n_base)."""
        out = np.empty(self.gaps)
        for some, (first, pixel, *_) in self.parts() if self.gaps else ():
            _in_gaps(first, pixel, self.n_pixels, y[some], out)
        return out

    def parts(self) -> Iterator[tuple[slice, tuple[Any, ...]]]:
        """Detectors and their runs, as kernels take them: all of them; some at a time of runs in
        files, whose pages are given back, and of those that are found anew. Sums over detectors go
        on from part to part.
        """
        if self.again is not None:
            for some, runs in self.again.parts():
                yield some, (*runs, self.counted[some])
            return
        every = self.first, self.pixel, self.samples, self.angles, self.counted
        n_det, n_base = self.shape
        in_files = isinstance(self.pixel, np.memmap)
        rows = max(PART * n_det // self.nbytes, 1) if in_files else max(n_det, 1)
        first, pixel, samples, angles, counted = map(np.asarray, every)
        for some in chunks(n_det, rows):
            part = first[some.start * n_base : some.stop * n_base + 1]
            yield some, (part, pixel, samples, angles, counted[some])
            for array in every:
                forget_pages(array)


class RunsOfTiles:
    """Adds up tiles as they are found, in baselines, and counts their runs.

    Parameters
    ----------
    n_det, n_samples, length
        Good detectors and samples of the scan, samples of a baseline.
    """

    def __init__(self, n_det: int, n_samples: int, length: int) -> None:
        self.length, self.n_samples, self.number = length, n_samples, 0
        n_base = -(-n_samples // length)
        self.counted = np.zeros((n_det, n_base), np.int32)
        self.sums = np.zeros((n_det, n_base))
        self.squares = np.zeros((n_det, n_base))
        self.have = np.zeros(n_samples, np.bool_)
        self._lost = [np.zeros((0, 2), np.intp)]

    def add(self, rows: NDArray[np.intp], tile: Tile) -> None:
        """Add a tile of the good detectors ``rows``."""
        here = slice(tile.base, tile.base + tile.counted.shape[1])
        self.counted[rows, here] += tile.counted
        self.sums[rows, here] += tile.sums
        self.squares[rows, here] += tile.squares
        self.have[tile.start : tile.start + tile.have.size] |= tile.have
        self.number += tile.number
        self._lost.append(tile.lost)

    @property
    def lost(self) -> NDArray[np.intp]:
        """(n, 2) detector and instant of samples without a value, in order."""
        found = np.concatenate(self._lost)
        return found[np.lexsort(found.T[::-1])]

    def scan(
        self,
        rate: float,
        n_pixels: int,
        find: Callable[[slice], tuple[NDArray[np.int32], Floats, Floats]],
        *,
        polarized: bool = False,
        single: bool = False,
        keeps: Keeps = Keeps.MEMORY,
        threads: int = 1,
    ) -> CompressedScan:
        """The scan; ``find``, ``single`` as of `RunsOfPointing`."""
        keep, empty = keeps is not Keeps.AGAIN, in_file if keeps is Keeps.FILES else np.empty
        known = self.counted.sum(axis=1)
        lacking = np.where(known > 0, np.count_nonzero(self.have) - known, 0)
        gaps, counted = int(lacking.sum()), self.counted
        if gaps:
            have = np.add.reduceat(self.have, np.arange(0, self.n_samples, self.length), dtype=int)
            counted = np.where(known[:, None] > 0, have, 0).astype(np.int32)
        runs = RunsOfPointing(
            find,
            self.length,
            self.have,
            np.where(known > 0, np.cumsum(lacking) - lacking, -1),
            n_pixels,
            n_pixels + gaps,
            single,
        )
        out, without = runs.left()
        number = self.number + gaps + np.where(known > 0, out, without).sum() if keep else 0
        pixel: Any = empty(number, np.int32)
        samples: Any = empty(number, np.uint16)
        angles: Any = empty((2, number if polarized else 0), np.float64)
        first = np.zeros(counted.size + 1 if keep else 0, np.int64)
        begin = 0
        for some, (ends, found, size, seen) in runs.parts(threads) if keep else ():
            to = slice(begin, begin + found.size)
            first[some.start * counted.shape[1] :][: ends.size] = begin + ends
            pixel[to], samples[to] = found, size
            if polarized:
                angles[:, to] = seen
            for array in (pixel, samples, angles):
                forget_pages(array)
            begin = to.stop
        sizes = self.length, rate, self.n_samples, n_pixels, gaps
        within, again = self.about.sum(axis=1), None if keep else runs
        return CompressedScan(
            *sizes, pixel, samples, first, counted, self.counted, angles, within, again
        )

    @property
    def about(self) -> Floats:
        """(n_det, n_base) sums of squares about the means of baselines."""
        return np.maximum(self.squares - self.sums**2 / np.maximum(self.counted, 1), 0.0)

    @property
    def means(self) -> Floats:
        """(n_det, n_base) y of equation (1); 0 where no sample counts."""
        return self.sums / np.maximum(self.counted, 1)

    @property
    def scatter(self) -> Floats:
        """(n_det,) variance of the samples about the means of their baselines: of white noise, from
        the median over baselines of which at least half as many samples count as of any. A source
        that few baselines see does not change it; NaN where no two samples do. The median of chi^2
        with k degrees of freedom is k (1 - 2 / (9 k))^3 (Wilson & Hilferty 1931).
        """
        freedom = np.maximum(self.counted - 1, 1)
        median = freedom * (1 - 2 / (9 * freedom)) ** 3
        most = self.counted.max(axis=1, keepdims=True)
        enough = (2 * self.counted >= most) & (self.counted > 1)
        return np.array(
            [
                np.median(row[some] / middle[some]) if some.any() else np.nan
                for row, middle, some in zip(self.about, median, enough, strict=True)
            ]
        )


@dataclass(frozen=True)
class Tile:
    """Some detectors in one tile: samples that count, their sum and their squares (n_det, n_base)
    in the baselines from ``base`` on; instants (n,) from ``start`` on at which a sample counts; the
    number of runs; and samples ``lost`` (k, 2), detector of the scan and instant, without a value.
    """

    base: int
    start: int
    counted: NDArray[np.int32]
    sums: Floats
    squares: Floats
    have: NDArray[np.bool_]
    number: int
    lost: NDArray[np.intp]

    @classmethod
    def of(
        cls,
        signal: Floats,
        pixel: NDArray[np.int32],
        start: int,
        length: int,
        single: bool,
        lost: NDArray[np.intp],
    ) -> Tile:
        """Add up samples ``signal`` (n_det, n) [K] from ``start`` on, in ``pixel`` (n_det, n), -1
        where a sample does not count; ``single``: each sample is a run.
        """
        n_det, n = pixel.shape
        base = start // length
        n_base = (start + n - 1) // length - base + 1
        counted, have = np.zeros((n_det, n_base), np.int32), np.zeros(n, np.bool_)
        sums, squares = np.zeros((2, n_det, n_base))
        k = _add_up(signal, pixel, start, length, single, counted, sums, squares, have)
        return cls(base, start, counted, sums, squares, have, k, lost)


@kernel
def _add_up(  # type: ignore[no-untyped-def]
    signal, pixel, start, length, single, counted, sums, squares, have
):
    """Add samples to baselines; returns the number of runs that count."""
    k = 0
    for d in range(pixel.shape[0]):
        last, before = -1, -1
        for i in range(pixel.shape[1]):
            p, b = pixel[d, i], (start + i) // length - start // length
            if p >= 0:
                k += p != last or b != before or single
                v = np.float64(signal[d, i])
                counted[d, b] += 1
                sums[d, b] += v
                squares[d, b] += v * v
                have[i] = True
            last, before = p, b
    return k


@kernel
def _in_gaps(first, pixel, n_pixels, y, out):  # type: ignore[no-untyped-def]
    """Values of baselines at gaps."""
    n_det, n_base = y.shape
    for d in range(n_det):
        for b in range(n_base):
            for r in range(first[d * n_base + b], first[d * n_base + b + 1]):
                if n_pixels <= pixel[r] < n_pixels + out.size:
                    out[pixel[r] - n_pixels] = y[d, b]


@kernel(inline="always")
def _step(steps, t, a, d, height):  # type: ignore[no-untyped-def]
    """Add what a step of detector d at t makes of s."""
    for k in range(a.shape[0]):
        steps[k, t] += a[k, d] * height


@kernel
def _see(  # type: ignore[no-untyped-def]
    first, pixel, samples, angles, counted, m, a, further, y, steps
):
    """Equations (1) and (2) of a map, the latter as steps (n_samp + 1,) of one mode ``a`` (n_det,);
    of a ``further`` mode, for the detectors that have a part in it. Indices without sign need no
    test for negative ones: twice as fast.
    """
    n_det, n_base = counted.shape
    polarized, nowhere = angles.shape[1] > 0, np.uint64(m.shape[1])
    for d in range(n_det):
        w, t, before, lower = a[d], np.uint64(0), 0.0, 0.0
        if further and w == 0.0:
            continue
        for b in range(n_base):
            begin, end = first[d * n_base + b], first[d * n_base + b + 1]
            total, start = 0.0, t
            for r in range(np.uint64(begin), np.uint64(end)):
                p, v = np.uint64(pixel[r]), 0.0
                if p < nowhere:
                    v = m[0, p]
                    if polarized:
                        v += angles[0, r] * m[1, p] + angles[1, r] * m[2, p]
                    total += samples[r] * v
                steps[t] += w * (v - before)
                before = v
                t += np.uint64(samples[r])
            mean = total / counted[d, b] if counted[d, b] else 0.0
            y[d, b] = mean
            if counted[d, b] == np.int64(t - start):
                steps[start] += w * (lower - mean)
                lower = mean
                continue
            now = start
            for r in range(np.uint64(begin), np.uint64(end)):
                level = mean if np.uint64(pixel[r]) < nowhere else 0.0
                steps[now] += w * (lower - level)
                lower = level
                now += np.uint64(samples[r])
        steps[t] += w * (lower - before)


@kernel
def _spread(  # type: ignore[no-untyped-def]
    first, pixel, samples, angles, counted, length, a, further, y, running, m
):
    """The adjoint of `_see`, from running sums (n_samp + 1,) of one mode."""
    n_det, n_base = counted.shape
    polarized, nowhere = angles.shape[1] > 0, np.uint64(m.shape[1])
    last = np.uint64(running.size - 1)
    for d in range(n_det):
        w, t = a[d], np.uint64(0)
        if further and w == 0.0:
            continue
        for b in range(n_base):
            begin, end = first[d * n_base + b], first[d * n_base + b + 1]
            then = min(t + np.uint64(length), last)
            total, now = running[then] - running[t], t
            if counted[d, b] < np.int64(then - t):
                total = 0.0
                for r in range(np.uint64(begin), np.uint64(end)):
                    then = now + np.uint64(samples[r])
                    if np.uint64(pixel[r]) < nowhere:
                        total += running[then] - running[now]
                    now = then
            mean = (y[d, b] - w * total) / counted[d, b] if counted[d, b] else 0.0
            for r in range(np.uint64(begin), np.uint64(end)):
                p, then = np.uint64(pixel[r]), t + np.uint64(samples[r])
                if p < nowhere:
                    x = samples[r] * mean + w * (running[then] - running[t])
                    m[0, p] += x
                    if polarized:
                        m[1, p] += angles[0, r] * x
                        m[2, p] += angles[1, r] * x
                t = then


@kernel
def _over(first, pixel, samples, nowhere, running, out):  # type: ignore[no-untyped-def]
    """Sums over samples in pixels of the map, of running sums (n_samp + 1,)."""
    n_det, n_base = out.shape
    for d in range(n_det):
        t = 0
        for b in range(n_base):
            for r in range(first[d * n_base + b], first[d * n_base + b + 1]):
                then = t + samples[r]
                if pixel[r] < nowhere:
                    out[d, b] += running[then] - running[t]
                t = then


@kernel
def _lower(first, pixel, samples, counted, nowhere, a, y, steps):  # type: ignore[no-untyped-def]
    """Take the means y of baselines off s, as steps."""
    n_det, n_base = counted.shape
    for d in range(n_det):
        t, before = 0, 0.0
        for b in range(n_base):
            for r in range(first[d * n_base + b], first[d * n_base + b + 1]):
                v = -y[d, b] if pixel[r] < nowhere else 0.0
                if v != before:
                    _step(steps, t, a, d, v - before)
                    before = v
                t += samples[r]
        if before != 0.0:
            _step(steps, t, a, d, -before)


@kernel
def _weigh(first, pixel, samples, angles, counted, weight, out):  # type: ignore[no-untyped-def]
    """Add weights to pixels."""
    n_det, n_base = counted.shape
    nowhere = out.shape[1]
    for d in range(n_det):
        for r in range(first[d * n_base], first[(d + 1) * n_base]):
            p = pixel[r]
            if p < nowhere:
                n = samples[r] * weight[d]
                out[0, p] += n
                if out.shape[0] > 1:
                    c, s = angles[0, r], angles[1, r]
                    out[1, p] += n * c
                    out[2, p] += n * s
                    out[3, p] += n * c * c
                    out[4, p] += n * c * s
                    out[5, p] += n * s * s


@kernel
def add_groups(signal, pixel, groups, scale, out):  # type: ignore[no-untyped-def]
    """Add the samples of a tile to fixed-point sums (n_groups, n) over detectors; ``pixel`` as in
    `Tile.of`.
    """
    for d in range(pixel.shape[0]):
        total = out[groups[d]]
        for i in range(pixel.shape[1]):
            if pixel[d, i] >= 0:
                total[i] += np.int64(np.rint(signal[d, i] * scale))


@kernel
def add_baselines(signal, pixel, start, length, a, scale, y, s):  # type: ignore[no-untyped-def]
    """Add the samples of a tile to fixed-point sums: y (n_det, n_base of the tile) rint(d scale)
    over baselines, s (k, n) rint(a d scale) over detectors; ``pixel`` as in `Tile.of`.
    """
    for d in range(pixel.shape[0]):
        for i in range(pixel.shape[1]):
            if pixel[d, i] >= 0:
                v = np.float64(signal[d, i]) * scale
                y[d, (start + i) // length - start // length] += np.int64(np.rint(v))
                for k in range(a.shape[0]):
                    s[k, i] += np.int64(np.rint(a[k, d] * v))
