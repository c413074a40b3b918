"""Runs of samples in one pixel, as pointing and flags tell them (`compressed_scan`)."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel
from zonda.core.numerics.chunks import TILE_SAMPLES, chunks
from zonda.core.stream import in_order
from zonda.core.types import Floats

FOUND = 1 << 22
"""Bytes of pixels and runs that are found at a time: they stay in the cache."""
Runs = tuple[NDArray[np.int64], NDArray[np.int32], NDArray[np.uint16], Floats]
"""The first run of each baseline, and pixel, samples and angles of each run."""


@dataclass(frozen=True)
class RunsOfPointing:
    """Finds the runs of detectors, with the same bits each time.

    Attributes
    ----------
    find
        Of some detectors (a slice) pixels (n, n_samp) int32, -1 where a sample does not count, and
        c and s (n, n_samp), or (n, 0) for maps of I.
    length
        Samples of a baseline.
    have
        (n_samp,) instants at which a sample of some detector counts.
    gap
        (n_det,) first gap of each detector; -1 for detectors without samples.
    n_pixels, left_out
        Pixel of the first gap, and of samples that are left out.
    single
        Each sample is a run.
    """

    find: Callable[[slice], tuple[NDArray[np.int32], Floats, Floats]]
    length: int
    have: NDArray[np.bool_]
    gap: NDArray[np.int64]
    n_pixels: int
    left_out: int
    single: bool

    def parts(self, threads: int = 1) -> Iterator[tuple[slice, Runs]]:
        """Detectors and their runs, some at a time."""
        rows = max(FOUND // (10 * self.have.size), 1)
        yield from in_order(self._part, ((some,) for some in chunks(self.gap.size, rows)), threads)

    def _part(self, some: slice) -> tuple[slice, Runs]:
        return some, self.of(*self.find(some), self.gap[some])

    def of(
        self, pixel: NDArray[np.int32], cosine: Floats, sine: Floats, gap: NDArray[np.int64]
    ) -> Runs:
        """Runs of detectors with these pixels and angles."""
        first = np.empty(len(gap) * -(-self.have.size // self.length) + 1, np.int64)
        found, size = np.empty(pixel.size, np.int32), np.empty(pixel.size, np.uint16)
        angles = np.empty((2, cosine.size))
        k = _find_runs(
            pixel, cosine, sine, self.length, self.have, gap, self.n_pixels, self.left_out,
            self.single, found, size, angles, first,
        )  # fmt: skip
        return first, found[:k], size[:k], angles[:, :k]

    def left(self) -> tuple[int, int]:
        """Runs that are left out of a detector with samples, and of one without."""
        nothing, none = np.full((1, self.have.size), -1, np.int32), np.zeros((1, 0))
        some, without = (len(self.of(nothing, none, none, np.array([gap]))[1]) for gap in (0, -1))
        return some - int(np.count_nonzero(self.have)), without


@kernel
def _find_runs(  # type: ignore[no-untyped-def]
    pixel, cosine, sine, length, have, gap, nowhere, left_out, single, found, size, angles, first
):
    """Find runs, in which each gap has a run of its own; returns their number."""
    n, k, b = pixel.shape[1], 0, 0
    for d in range(pixel.shape[0]):
        g, begin, base = gap[d], 0, 0
        while begin < n:
            if begin == base:
                first[b] = k
                b += 1
                base += length
            end = min(base, begin // TILE_SAMPLES * TILE_SAMPLES + TILE_SAMPLES, n)
            last, since = -2, begin
            for t in range(begin, end):
                p = pixel[d, t]
                if p == last and (not single if p >= 0 else g < 0 or not have[t]):
                    continue
                if t > since:
                    size[k - 1] = t - since
                last, since = p, t
                found[k] = p
                if p < 0:
                    found[k] = left_out
                    if g >= 0 and have[t]:
                        found[k], last = nowhere + g, -2
                        g += 1
                k += 1
            size[k - 1] = end - since
            begin = end
    first[b] = k
    if cosine.shape[1] > 0:
        _find_angles(cosine, sine, nowhere, found, size, k, angles)
    return k


@kernel
def _find_angles(cosine, sine, nowhere, found, size, k, angles):  # type: ignore[no-untyped-def]
    """Means of c and s over each of k runs; 0 for gaps."""
    d, t = 0, 0
    for r in range(k):
        c, s = 0.0, 0.0
        for i in range(t, t + size[r] if found[r] < nowhere else t):
            c += cosine[d, i]
            s += sine[d, i]
        angles[0, r], angles[1, r] = c / size[r], s / size[r]
        t += size[r]
        if t == cosine.shape[1]:
            d, t = d + 1, 0
