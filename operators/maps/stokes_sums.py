"""Sums of samples in pixels for maps of I, Q and U, in fixed point.

A sample of a detector of polarization efficiency p whose axis is at the angle psi from the meridian
sees (1, c, s) of (I, Q, U), with c = p cos 2 psi and s = p sin 2 psi (`core.polarization`). The map
m that fits the samples d of a pixel best, with weights w:

    A m = b,   A = sum_i w_i (1, c_i, s_i)^T (1, c_i, s_i),
    b = sum_i w_i d_i (1, c_i, s_i).                    (1)

A window W that multiplied the signals multiplies w in A (`bin_map`, equation 2). The covariance of
m is

    A^-1 N A^-1,   N = sum_i w_i^2 W_i^2 sigma_i^2 (1, c_i, s_i)^T (1, c_i, s_i),   (2)

which is A^-1 where weights are inverse variances and there is no window: then N is not added up.

c and s are rounded to 2^-30 once, and all sums take the rounded ones. The terms of A and N are
rounded to 2^-30 of the reference weight, those of b to 2^-36 K: as int64 the sums are exact, and
their bits depend neither on the order of blocks nor on the number of threads or workers.
"""

from __future__ import annotations

import threading
from collections.abc import Hashable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.numerics.projection import frame_rotation
from zonda.core.polarization import PolarizationAngles
from zonda.core.types import AnyFloats, Floats

from .halves import Split, halves_of
from .pixels import Cells, Looking, fingerprint, tiles
from .stokes_kernel import DATA, FIRST, HIT, add_stokes
from .sums import FLAGGED, Sums

MATRIX = slice(FIRST, DATA)
"""Columns of A: w, wc, ws, wcc, wcs, wss; the data follow (wd, wdc, wds of each signal), then N."""
PLACES = (1, 2, 3, 2, 4, 5, 3, 5, 6)
"""Columns of A as a matrix, row by row."""


@dataclass
class StokesBinning:
    """Samples of one observation that count, their weights, and the sums of each thread.

    Attributes
    ----------
    looking, angles
        The same of both halves of an observation.
    use, good, window
        (n_det,), (n_samp,) uint8: which detectors and samples count; (n_samp,):
        `Observation.window`, or (0,).
    weight, noise
        (n_det,): w, and w^2 times the variance of one sample, in units of the reference variance.
    signals
        Number of signals.
    own_noise
        Whether N is not A, and is added up.
    spare
        Arrays of zeros that served the scans before.
    key
        The same for all bands whose samples fall in the same pixels at the same angles, whatever
        their weights; None where there is no other band.
    """

    looking: Looking
    angles: PolarizationAngles
    use: NDArray[np.bool_]
    good: NDArray[np.uint8]
    window: Floats
    weight: Floats
    noise: Floats
    signals: int
    own_noise: bool
    spare: list[Sums] = field(default_factory=list)
    key: Hashable = None
    parts: dict[int, tuple[Sums, Sums, Floats]] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    @property
    def columns(self) -> int:
        return DATA + 3 * self.signals + (6 if self.own_noise else 0)

    def of_thread(self) -> tuple[Sums, Sums, Floats]:
        """(sums (n_pixels, columns), dropped (4,), largest (2,): of A and N, of b)."""
        mine = threading.get_ident()
        with self.lock:
            if mine not in self.parts:
                shape = self.looking.grid.n_pixels, self.columns
                kept = [k for k, sums in enumerate(self.spare) if sums.shape == shape]
                sums = self.spare.pop(kept[-1]) if kept else np.zeros(shape, np.int64)
                self.parts[mine] = sums, np.zeros(4, np.int64), np.zeros(2)
            return self.parts[mine]

    def taken(self) -> Iterator[tuple[NDArray[np.int64], Sums, Sums, Floats]]:
        """Of each thread: numbers of the pixels with hits, their sums, dropped (4,), largest (2,).
        They are zero afterwards.
        """
        for sums, dropped, largest in self.parts.values():
            pixels = np.flatnonzero(sums[:, HIT])
            found = sums.take(pixels, axis=0)
            sums[pixels] = 0
            self.spare.append(sums)
            yield pixels, found, dropped, largest
        self.parts.clear()


def stokes_binnings(
    split: Split,
    looking: Looking,
    levels: tuple[Floats, Floats, Floats],
    good: Any,
    spare: list[Sums],
) -> list[StokesBinning]:
    """Empty sums for one observation, one for each half of its samples.

    ``levels``: weights and noise of the detectors (`bin_map.detector_weights`), and the window
    (n_samp,) or (0,); ``good`` (n_samp,): which samples count.
    """
    observation, (weight, noise, window) = looking.observation, levels
    own = bool(window.size) or not np.allclose(weight, noise, rtol=1e-6, atol=0)
    angles = PolarizationAngles.of(
        observation, observation.boresight_radec, frame_rotation(looking.grid.frame)[2]
    )
    signals, key = len(observation.signals), None
    halves = [
        (use, (good & samples).astype(np.uint8)) for use, samples in halves_of(split, observation)
    ]
    if looking.key is not None:
        seen = (
            angles.poles,
            angles.axes,
            angles.plate,
            angles.gamma,
            observation.focalplane.polarization_efficiency,
            window,
        )
        key = looking.key, own, fingerprint(*seen, *(mask for half in halves for mask in half))
    return [
        StokesBinning(looking, angles, *half, window, weight, noise, signals, own, spare, key)
        for half in halves
    ]


class Part(NamedTuple):
    """A block of one band: ``signals`` (n_det, n) each, ``binnings`` of the halves of its
    observation.
    """

    binnings: Sequence[StokesBinning]
    signals: tuple[AnyFloats, ...]
    block: Block

    def used(self) -> list[NDArray[np.bool_]]:
        """Of each half, which of the block's detectors count (n_det,)."""
        rows = self.block.detectors
        return [
            one.use[rows] & self.block.observation.good_detectors[rows] for one in self.binnings
        ]


def add_blocks(parts: Sequence[Part], cells: Cells) -> None:
    """Add the blocks of one band, or of several, to this thread's sums: together those of bands
    whose samples fall in the same pixels at the same angles (`StokesBinning.key`).
    """
    alike: dict[Hashable, list[Part]] = {}
    for part in parts:
        key = part.binnings[0].key, len(part.signals), part.signals[0].dtype.str
        alike.setdefault(key, []).append(part)
    for together in alike.values():
        add_parts(together, cells)


def add_parts(parts: Sequence[Part], cells: Cells) -> None:
    """Add the parts of bands that have the same key."""
    used = [part.used() for part in parts]
    for k in range(1, len(parts)):
        if not np.array_equal(used[k], used[0]):  # detectors that a filter has flagged
            for part in parts:
                add_parts([part], cells)
            return
    block, looking, a = parts[0].block, parts[0].binnings[0].looking, parts[0].binnings[0].angles
    detectors, samples, halves = (
        block.detectors,
        block.samples,
        list(zip(*(part.binnings for part in parts), strict=True)),
    )
    angles = a.poles, a.axes, a.plate, a.gamma, block.observation.focalplane.polarization_efficiency
    signals = tuple(signal for part in parts for signal in part.signals)
    sums = [[band.of_thread() for band in half] for half in halves]
    for of_half, mine in zip(used[0], sums, strict=True):
        for _, dropped, _ in mine:
            dropped[FLAGGED] += (samples.stop - samples.start) * int(np.count_nonzero(~of_half))
    for rows, start, stop in tiles(block, np.any(used[0], axis=0)):
        index = None
        for half, of_half, mine in zip(halves, used[0], sums, strict=True):
            at, good = np.flatnonzero(of_half[rows]), half[0].good[start:stop]
            if not good.any():
                for _, dropped, _ in mine:
                    dropped[FLAGGED] += (stop - start) * at.size
            elif at.size:
                if index is None:
                    index = cells.of(looking, rows + detectors.start, start, stop)
                which = rows[at] + detectors.start
                where = start - samples.start, rows[at], at, index, angles, which, start
                bands = tuple(
                    (band.weight[which], band.noise[which], *own)
                    for band, own in zip(half, mine, strict=True)
                )
                add_stokes(
                    signals, *where, good, half[0].window[start:stop], half[0].own_noise, bands
                )
