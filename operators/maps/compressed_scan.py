"""A scan as a maximum-likelihood map needs it: baselines, runs of samples in one pixel, and what
detectors have in common at the full rate.

Samples d_i of a detector are cut into baselines b of L samples, which begin at multiples of L. Of
those that count (not flagged, finite, inside the map) a scan keeps

    y_b = mean of d in a baseline,               (Y m)_b of a map m,                         (1)
    s_k(t) = sum_d a_kd (d_d(t) - y_b),          (S m)_k of a map m,                         (2)

and the *runs*: successive samples of one detector in one pixel p, n at a time. A run adds n m_p to
its baseline, and a step up at its first sample and down behind its last to s; the adjoint takes
differences of running sums of s. Of a map, (1) and (2) therefore cost a few operations for each
run, not for each sample. Samples that do not count lie in one further pixel, and add nothing.

A polarized run sees v = I + c Q + s U with the means of c and s (`core.polarization`) over it;
where the angle turns within a run (a half-wave plate), each sample is a run of its own.

Runs end at baselines and at multiples of `TILE_SAMPLES`: they depend on no block.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel
from zonda.core.types import Floats


@dataclass
class CompressedScan:
    """Runs and baselines of the good detectors of a scan.

    Attributes
    ----------
    length, rate
        Samples of a baseline, and the sample rate [Hz].
    n_pixels
        Of the map; also the number of the pixel of samples that do not count.
    pixel, samples
        (n_runs,) int32 and uint16: pixel of each run, and its samples; one detector after the
        other, in order of time.
    first
        (n_det n_base + 1,) int64: the first run of each baseline.
    counted
        (n_det, n_base) int32: samples of each baseline that count.
    angles
        (2, n_runs) means of c and s over each run; (2, 0) for maps of I.
    within
        (n_det,) sum of the squares of the complete signal's samples about the means of their
        baselines, K^2.
    """

    length: int
    rate: float
    n_samples: int
    n_pixels: int
    pixel: NDArray[np.int32]
    samples: NDArray[np.uint16]
    first: NDArray[np.int64]
    counted: NDArray[np.int32]
    angles: Floats = field(default_factory=lambda: np.zeros((2, 0)))
    within: Floats = field(default_factory=lambda: np.zeros(0))

    @property
    def shape(self) -> tuple[int, int]:
        """(n_det, n_base)."""
        return self.counted.shape[0], self.counted.shape[1]

    @property
    def nbytes(self) -> int:
        """Bytes that it holds."""
        every = self.pixel, self.samples, self.first, self.counted, self.angles
        return sum(array.nbytes for array in every)

    def seen(self, m: Floats, a: Floats) -> tuple[Floats, Floats]:
        """(Y m (n_det, n_base), S m (k, n_samp)) of a map m (1 or 3, n_pixels), equations (1) and
        (2); ``a`` (k, n_det).
        """
        y, steps = np.empty(self.shape), np.zeros((len(a), self.n_samples + 1))
        _see(*self._runs, np.ascontiguousarray(m), a, y, steps)
        return y, np.cumsum(steps, axis=1)[:, :-1]

    def spread(self, y: Floats, s: Floats, a: Floats, out: Floats) -> None:
        """Add Y^T y + S^T s to a map ``out`` (1 or 3, n_pixels): the adjoint of `seen`."""
        running = np.zeros((len(a), self.n_samples + 1))
        np.cumsum(s, axis=1, out=running[:, 1:])
        _spread(*self._runs, a, np.ascontiguousarray(y), running, out)

    def about_means(self, s: Floats, y: Floats, a: Floats) -> Floats:
        """Equation (2) from s' = sum_d a_kd d_d(t) (k, n_samp) of the samples that count."""
        steps = np.zeros((len(a), self.n_samples + 1))
        _lower(self.first, self.pixel, self.samples, self.counted, self.n_pixels, a, y, steps)
        return np.asarray(s + np.cumsum(steps, axis=1)[:, :-1])

    def weigh(self, weight: Floats, out: Floats) -> None:
        """Add each detector's ``weight`` (n_det,) at its samples to the weights ``out`` (1 or 6,
        n_pixels) of I, or of I, Q and U: ii, iq, iu, qq, qu, uu.
        """
        _weigh(*self._runs, weight, out)

    @property
    def _runs(self) -> tuple[Any, ...]:
        return self.first, self.pixel, self.samples, self.angles, self.counted


class RunsOfTiles:
    """Collects the runs of tiles as they are found, in order of time for each detector.

    Parameters
    ----------
    n_det, n_samples, length
        Good detectors and samples of the scan, samples of a baseline.
    """

    def __init__(self, n_det: int, n_samples: int, length: int) -> None:
        self.length, self.n_samples = length, n_samples
        n_base = -(-n_samples // length)
        self.number = np.zeros((n_det, n_base), np.int32)
        self.counted = np.zeros((n_det, n_base), np.int32)
        self.sums = np.zeros((n_det, n_base))
        self.squares = np.zeros((n_det, n_base))
        self._tiles: list[tuple[NDArray[np.intp], Tile]] = []

    def add(self, rows: NDArray[np.intp], tile: Tile) -> None:
        """Add a tile of the good detectors ``rows``."""
        here = slice(tile.base, tile.base + tile.number.shape[1])
        self.number[rows, here] += tile.number
        self.counted[rows, here] += tile.counted
        self.sums[rows, here] += tile.sums
        self.squares[rows, here] += tile.squares
        self._tiles.append((rows, tile))

    def scan(self, rate: float, n_pixels: int) -> CompressedScan:
        """Runs of all tiles, detector by detector; the tiles are used up."""
        first = np.zeros(self.number.size + 1, np.int64)
        np.cumsum(self.number.ravel(), out=first[1:])
        at = first[:-1].reshape(self.number.shape)[:, 0].copy()
        polarized = bool(self._tiles) and self._tiles[0][1].angles.shape[1] > 0
        pixel, samples = np.empty(first[-1], np.int32), np.empty(first[-1], np.uint16)
        angles = np.empty((2, first[-1] if polarized else 0))
        while self._tiles:
            rows, tile = self._tiles.pop(0)
            begin = 0
            for row, number in zip(rows, tile.number.sum(axis=1), strict=True):
                to, of = slice(at[row], at[row] + number), slice(begin, begin + number)
                pixel[to], samples[to] = tile.pixel[of], tile.samples[of]
                if polarized:
                    angles[:, to] = tile.angles[:, of]
                at[row] += number
                begin += number
        return CompressedScan(
            self.length,
            rate,
            self.n_samples,
            n_pixels,
            pixel,
            samples,
            first,
            self.counted,
            angles,
            self.about.sum(axis=1),
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
    """Runs of some detectors in one tile: runs (n,), detector by detector, and the number of runs,
    samples that count, their sum and their squares (n_det, n_base) in the baselines from ``base``
    on.
    """

    base: int
    pixel: NDArray[np.int32]
    samples: NDArray[np.uint16]
    number: NDArray[np.int32]
    counted: NDArray[np.int32]
    sums: Floats
    squares: Floats
    angles: Floats

    @classmethod
    def of(
        cls,
        signal: Floats,
        pixel: NDArray[np.int32],
        start: int,
        length: int,
        nowhere: int,
        cosine: Floats,
        sine: Floats,
        single: bool,
    ) -> Tile:
        """Find the runs of samples from ``start`` on.

        Parameters
        ----------
        signal
            (n_det, n), K.
        pixel
            (n_det, n), -1 where a sample does not count.
        nowhere
            Number of the pixel of those.
        cosine, sine
            (n_det, n) c and s, or (n_det, 0).
        single
            Each sample is a run.
        """
        n_det, n = pixel.shape
        base = start // length
        n_base = (start + n - 1) // length - base + 1
        number, counted = np.zeros((2, n_det, n_base), np.int32)
        sums, squares = np.zeros((2, n_det, n_base))
        found, size = np.empty(pixel.size, np.int32), np.empty(pixel.size, np.uint16)
        angles = np.zeros((2, pixel.size if cosine.shape[1] else 0))
        k = _find(
            signal, pixel, start, length, nowhere, cosine, sine, single, found, size, number,
            counted, sums, squares, angles,
        )  # fmt: skip
        angles = angles[:, :k].copy()
        return cls(base, found[:k].copy(), size[:k].copy(), number, counted, sums, squares, angles)


@kernel
def _find(  # type: ignore[no-untyped-def]
    signal, pixel, start, length, nowhere, cosine, sine, single, found, size, number, counted,
    sums, squares, angles,
):  # fmt: skip
    """Find runs; returns their number."""
    k = -1
    polarized = cosine.shape[1] > 0
    for d in range(pixel.shape[0]):
        last, before = -2, -1
        for i in range(pixel.shape[1]):
            p, b = pixel[d, i], (start + i) // length - start // length
            if p != last or b != before or (single and p >= 0):
                k += 1
                found[k], size[k] = p if p >= 0 else nowhere, 0
                number[d, b] += 1
            size[k] += 1
            if p >= 0:
                v = np.float64(signal[d, i])
                counted[d, b] += 1
                sums[d, b] += v
                squares[d, b] += v * v
                if polarized:
                    angles[0, k] += cosine[d, i]
                    angles[1, k] += sine[d, i]
            last, before = p, b
    if polarized:
        for r in range(k + 1):
            angles[0, r] /= size[r]
            angles[1, r] /= size[r]
    return k + 1


@kernel(inline="always")
def _step(steps, t, a, d, height):  # type: ignore[no-untyped-def]
    """Add what a step of detector d at t makes of s."""
    for k in range(a.shape[0]):
        steps[k, t] += a[k, d] * height


@kernel
def _see(first, pixel, samples, angles, counted, m, a, y, steps):  # type: ignore[no-untyped-def]
    """Equations (1) and (2) of a map, the latter as steps."""
    n_det, n_base = counted.shape
    polarized, nowhere = angles.shape[1] > 0, m.shape[1]
    for d in range(n_det):
        t, before = 0, 0.0
        for b in range(n_base):
            begin, end = first[d * n_base + b], first[d * n_base + b + 1]
            total = 0.0
            for r in range(begin, end):
                p = pixel[r]
                if p < nowhere:
                    v = m[0, p]
                    if polarized:
                        v += angles[0, r] * m[1, p] + angles[1, r] * m[2, p]
                    total += samples[r] * v
            mean = total / counted[d, b] if counted[d, b] else 0.0
            y[d, b] = mean
            if a.shape[0] == 0:
                continue
            for r in range(begin, end):
                p, v = pixel[r], 0.0
                if p < nowhere:
                    v = m[0, p] - mean
                    if polarized:
                        v += angles[0, r] * m[1, p] + angles[1, r] * m[2, p]
                if v != before:
                    _step(steps, t, a, d, v - before)
                    before = v
                t += samples[r]
        if before != 0.0:
            _step(steps, t, a, d, -before)


@kernel
def _spread(  # type: ignore[no-untyped-def]
    first, pixel, samples, angles, counted, a, y, running, m
):
    """The adjoint of `_see`."""
    n_det, n_base = counted.shape
    polarized, nowhere = angles.shape[1] > 0, m.shape[1]
    for d in range(n_det):
        t = 0
        for b in range(n_base):
            begin, end = first[d * n_base + b], first[d * n_base + b + 1]
            total, now = y[d, b], t
            for r in range(begin, end):
                n = samples[r]
                if pixel[r] < nowhere:
                    for k in range(a.shape[0]):
                        total -= a[k, d] * (running[k, now + n] - running[k, now])
                now += n
            mean = total / counted[d, b] if counted[d, b] else 0.0
            for r in range(begin, end):
                n, p = samples[r], pixel[r]
                if p < nowhere:
                    x = n * mean
                    for k in range(a.shape[0]):
                        x += a[k, d] * (running[k, t + n] - running[k, t])
                    m[0, p] += x
                    if polarized:
                        m[1, p] += angles[0, r] * x
                        m[2, p] += angles[1, r] * x
                t += n


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
