"""Sums of the samples of one observation in the pixels of a map, in fixed point.

Samples d = P m + n see the map m through the pointing matrix P. With weights w on the diagonal of
N^-1, the map that fits them best solves

    (P^T N^-1 P) m = P^T N^-1 d.                                                     (1)

Both sides fall apart into pixels. A sample of a detector of polarization efficiency p whose axis is
at the angle psi from the meridian sees r = (1, c, s) of (I, Q, U), with c = p cos 2 psi and
s = p sin 2 psi (`core.polarization`). Added up over the samples i in a pixel are

    hits = sum_i 1,   A = sum_i w_i r_i^T r_i (weights),   b = sum_i w_i d_i r_i (data),
    N = sum_i w_i^2 sigma_i^2 r_i^T r_i (noise),                                     (2)

of which `map_from_sums` makes m = A^-1 b and its covariance A^-1 N A^-1. A map of I has r = 1: one
weight, and m is a weighted mean. A window W that multiplied the signals multiplies w in A and w^2
in N by itself and its square. Where the weights of a map of I, Q and U are inverse variances and
there is no window, N is A and is not added up; where all detectors of a map of I weigh the same, A
and N follow from the hits.

c and s are rounded to 2^-30 once, and all sums take the rounded ones. The terms of A and N are
rounded to 2^-30 of the reference weight, those of b to 2^-36 K: as int64 the sums are exact, and
their bits depend neither on the order of blocks nor on the number of threads or workers.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.errors import PipelineError
from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.numerics.projection import frame_rotation
from zonda.core.observation import Observation
from zonda.core.polarization import PolarizationAngles
from zonda.core.types import AnyFloats, Floats

from . import intensity_kernel as intensity
from . import stokes_kernel as stokes
from .grid import Cells, Looking, fingerprint, tiles
from .intensity_kernel import FLAGGED, OUTSIDE, WEIGHT, Sums, add_intensity, move
from .parameters import Split, halves_of
from .stokes_kernel import add_stokes

LOCK = threading.Lock()
"""Held while a thread is given sums."""


class Weights(NamedTuple):
    """Weights of an observation's samples, in units of the inverse of a reference variance.

    Attributes
    ----------
    detector
        (n_det,) w.
    noise
        (n_det,) w^2 sigma^2 of one sample.
    window
        (n_samp,): `Observation.window`, or (0,).
    """

    detector: Floats
    noise: Floats
    window: Floats

    @property
    def alike(self) -> bool:
        """True if all detectors weigh the same."""
        return all(bool((values == values[0]).all()) for values in self[:2])


class ThreadSums(NamedTuple):
    """Sums that one thread adds to.

    Attributes
    ----------
    sums
        Sums in pixels; columns as in `intensity_kernel` or `stokes_kernel`.
    dropped
        (4,) samples that were dropped, by the reason.
    largest
        (2,) largest term of weights and noise, and of the data.
    """

    sums: Sums
    dropped: Sums
    largest: Floats


@dataclass
class Binning:
    """Samples of one observation, or of half of it, with their weights, and each thread's sums.

    Attributes
    ----------
    detectors, samples
        (n_det,), (n_samp,) uint8: which of them count.
    signals
        The observation's signals that are added up.
    own_noise
        Of I: weights and noise have sums of their own; False: all detectors weigh the same, and
        both follow from the hits. Of I, Q and U: N is not A, and is added up.
    scatter
        Inverse of the reference variance [K^-2] where the noise is that of the samples' scatter;
        else 0.
    spare
        Arrays of zeros that served the scans before: touching fresh memory costs more than the
        sums.
    angles
        Those of I, Q and U; None: I alone is wanted.
    key
        The same for all bands whose samples fall in the same pixels at the same angles, whatever
        their weights; None where there is no other band.
    """

    looking: Looking
    detectors: NDArray[np.bool_]
    samples: NDArray[np.uint8]
    weights: Weights
    signals: slice
    own_noise: bool = False
    scatter: float = 0.0
    spare: list[Sums] = field(default_factory=list)
    angles: PolarizationAngles | None = None
    key: Hashable = None
    threads: dict[int, ThreadSums] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of a thread's sums; those of I have a row more (`intensity_kernel`)."""
        n, number = self.looking.grid.n_pixels, self.signals.stop - self.signals.start
        if self.angles is None:
            return n + 1, (4 if self.own_noise else 2) + number - 1
        return n, stokes.DATA + 3 * number + (6 if self.own_noise else 0)

    def of_thread(self) -> ThreadSums:
        """Sums of this thread."""
        thread = threading.get_ident()
        with LOCK:
            if thread not in self.threads:
                self.threads[thread] = ThreadSums(self._zeros(), np.zeros(4, np.int64), np.zeros(2))
            return self.threads[thread]

    def _zeros(self) -> Sums:
        while self.spare:
            if (sums := self.spare.pop()).shape == self.shape:
                return sums
        return np.zeros(self.shape, np.int64)

    def columns(self, signals: Sequence[str]) -> dict[str, list[tuple[int, int]]]:
        """Columns of a thread's sums that are added to each of `MapSums.columns`, with factors."""
        n, end = len(signals), self.shape[1]
        if self.angles is None:
            first, hits = end - n + 1, intensity.HITS
            data = [[intensity.DATA], *([k] for k in range(first, end))]
            weights, noise = [(intensity.WEIGHTS, 1)], [(intensity.NOISE, 1)]
            if not self.own_noise:
                weights, noise = (
                    [(hits, int(np.rint(values[0] * WEIGHT)))] for values in self.weights[:2]
                )
        else:
            first, hits = stokes.DATA, stokes.HIT
            data = [list(range(first + 3 * k, first + 3 * k + 3)) for k in range(n)]
            weights = noise = [(k, 1) for k in range(stokes.FIRST, first)]
            if self.own_noise:
                noise = [(k, 1) for k in range(end - 6, end)]
        found = {"hits": [(hits, 1)], "weights": weights, f"noise {signals[0]}": noise}
        for name, some in zip(signals, data, strict=True):
            found[f"data {name}"] = [(k, 1) for k in some]
        return found

    def move(self, out: Sums, moves: Sums) -> tuple[int, int, Sums, Floats]:
        """Move all threads' sums to ``out`` (n_pixels, columns), as `intensity_kernel.move` does:
        (samples moved, most in a pixel, dropped (4,), largest terms (2,)).
        """
        moved, deepest, dropped, largest = 0, 0, np.zeros(4, np.int64), np.zeros(2)
        hits = intensity.HITS if self.angles is None else stokes.HIT
        for sums, lost, high in self.threads.values():
            rows = sums
            if self.angles is None:
                lost[OUTSIDE] += sums[0, hits]
                sums[0], rows = 0, sums[1:]
            number, most = move(rows, hits, out, moves)
            moved, deepest = moved + number, max(deepest, most)
            dropped, largest = dropped + lost, np.maximum(largest, high)
            self.spare.append(sums)
        self.threads.clear()
        return moved, deepest, dropped, largest


def binnings(
    split: Split,
    looking: Looking,
    weights: Weights,
    good: NDArray[np.bool_],
    spare: list[Sums],
    *,
    signals: int,
    polarized: bool = False,
    scatter: float = 0.0,
) -> list[list[Binning]]:
    """Empty sums for one observation, of each half of its samples: one for all ``signals``, or one
    for each if their noise is that of their ``scatter``.

    ``good`` (n_samp,): which samples count.
    """
    observation = looking.observation
    halves = [(use, (good & some).astype(np.uint8)) for use, some in halves_of(split, observation)]
    key, angles, own = None, None, bool(scatter or weights.window.size)
    if polarized:
        pole = frame_rotation(looking.grid.frame)[2]
        angles = PolarizationAngles.of(observation, observation.boresight_radec, pole)
        own |= not np.allclose(weights.detector, weights.noise, rtol=1e-6, atol=0)
        if looking.key is not None:
            seen = angles.poles, angles.axes, angles.plate, angles.gamma, weights.window
            efficiency = observation.focalplane.polarization_efficiency
            masks = (mask for half in halves for mask in half)
            key = looking.key, own, fingerprint(*seen, efficiency, *masks)
    else:
        own |= not weights.alike
    groups = [slice(k, k + 1) for k in range(signals)] if scatter else [slice(0, signals)]
    more: Any = own, scatter, spare, angles, key
    return [[Binning(looking, *half, weights, some, *more) for some in groups] for half in halves]


def weights_of(
    observation: Observation,
    reference: float,
    inverse: bool,
    window: Floats | None,
    place: str,
) -> Weights:
    """Weights in units of the inverse of the variance ``reference`` [K^2]; ``inverse``: w is the
    inverse variance, else 1.

    Raises PipelineError where they differ by too much, or are not known.
    """
    window = np.zeros(0) if window is None else window
    usable, net = observation.good_detectors, observation.focalplane.net.copy()
    if not usable.any():
        return Weights(np.ones(len(net)), np.ones(len(net)), window)
    net[~usable] = net[usable][0]  # they weigh nothing, whatever their noise
    variance = net**2 * observation.sample_rate / reference
    weight, cure = np.ones(len(net)), "set weights: uniform"
    if inverse:
        if (net > 0).all():
            weight = 1 / variance
        elif (net != net[0]).any():
            bad = observation.focalplane.names[int(np.flatnonzero(net <= 0)[0])]
            text = f"detector {bad} has NET 0, which has no inverse variance"
            raise PipelineError(text, place=place, cure=cure)
    weight = np.rint(weight * WEIGHT) / WEIGHT  # so that the sums of w d and of w use the same w
    if weight.max(initial=0.0) > 2.0**20 or weight.min(initial=1.0) < 2.0**-20:
        text = "the NET is more than 1000 times larger or smaller than that of the first scan"
        if net.max() > 1000 * net.min():
            text = "the detectors' NETs differ by more than a factor of 1000"
        raise PipelineError(text, place=place, cure=cure)
    return Weights(weight, weight**2 * variance, window)


class BandBlock(NamedTuple):
    """A block of one band: ``signals`` (n_det, n) each, ``halves`` as `binnings` makes them."""

    signals: tuple[AnyFloats, ...]
    block: Block
    halves: Sequence[Sequence[Binning]]

    def used(self) -> list[NDArray[np.bool_]]:
        """Detectors of the block (n_det,) that count in each half."""
        rows = self.block.detectors
        good = self.block.observation.good_detectors[rows]
        return [half[0].detectors[rows] & good for half in self.halves]


def add_blocks(bands: Sequence[BandBlock], cells: Cells) -> None:
    """Add the blocks of one band, or of several, to this thread's sums. What bands whose samples
    fall in the same pixels have in common is found once.
    """
    if bands[0].halves[0][0].angles is None:
        _add_intensity(bands)
        return
    alike: dict[Hashable, list[BandBlock]] = {}
    for band in bands:
        key = band.halves[0][0].key, len(band.signals), band.signals[0].dtype.str
        alike.setdefault(key, []).append(band)
    for together in alike.values():
        _add_polarized(together, cells)


def _add_intensity(bands: Sequence[BandBlock]) -> None:
    """Add blocks to the sums of I."""
    detectors, samples = bands[0].block.detectors, bands[0].block.samples
    which = np.arange(detectors.start, detectors.stop)
    todo = [
        (band.signals[binning.signals], binning, use, binning.of_thread())
        for band in bands
        for half, use in zip(band.halves, band.used(), strict=True)
        for binning in half
    ]
    for start in range(samples.start, samples.stop, TILE_SAMPLES):
        stop, cells = min(start + TILE_SAMPLES, samples.stop), Cells()
        for signals, binning, use, thread in todo:
            good = binning.samples[start:stop]
            if not good.any():
                thread.dropped[FLAGGED] += good.size * which.size
                continue
            weight, noise, window = binning.weights
            add_intensity(
                signals,
                start - samples.start,
                cells.of(binning.looking, which, start, stop),
                use,
                good,
                window[start:stop],
                weight[detectors],
                noise[detectors],
                binning.scatter,
                *thread,
            )


def _add_polarized(bands: Sequence[BandBlock], cells: Cells) -> None:
    """Add the blocks of bands that have the same key to the sums of I, Q and U."""
    used = [band.used() for band in bands]
    if any(not np.array_equal(some, used[0]) for some in used):  # detectors that a filter flagged
        for band in bands:
            _add_polarized([band], cells)
        return
    block, looking = bands[0].block, bands[0].halves[0][0].looking
    a: Any = bands[0].halves[0][0].angles
    detectors, samples = block.detectors, block.samples
    angles = a.poles, a.axes, a.plate, a.gamma, block.observation.focalplane.polarization_efficiency
    signals = tuple(signal for band in bands for signal in band.signals)
    halves = [
        (use, [(half[0], half[0].of_thread()) for half in of_bands])
        for use, *of_bands in zip(used[0], *(band.halves for band in bands), strict=True)
    ]

    def flag(binnings: Sequence[tuple[Binning, ThreadSums]], number: int) -> None:
        for _, thread in binnings:
            thread.dropped[FLAGGED] += number

    for use, made in halves:
        flag(made, (samples.stop - samples.start) * int(np.count_nonzero(~use)))
    for rows, start, stop in tiles(block, np.any(used[0], axis=0)):
        for use, made in halves:
            at, first = np.flatnonzero(use[rows]), made[0][0]
            good, window = first.samples[start:stop], first.weights.window[start:stop]
            if not good.any():
                flag(made, (stop - start) * at.size)
            elif at.size:
                index = cells.of(looking, rows + detectors.start, start, stop)
                which = rows[at] + detectors.start
                where = start - samples.start, rows[at], at, index, angles, which, start
                each = tuple(
                    (binning.weights.detector[which], binning.weights.noise[which], *thread)
                    for binning, thread in made
                )
                add_stokes(signals, *where, good, window, first.own_noise, each)
