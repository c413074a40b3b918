"""Sums of the samples of one observation in the pixels of a map, in fixed point.

A map of I has one weight in each pixel (`sums`). For maps of I, Q and U, a sample of a detector of
polarization efficiency p whose axis is at the angle psi from the meridian sees (1, c, s) of (I, Q,
U), with c = p cos 2 psi and s = p sin 2 psi (`core.polarization`). The map m that fits the samples
d of a pixel best, with weights w:

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
from zonda.core.errors import PipelineError
from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.numerics.projection import frame_rotation
from zonda.core.observation import Observation
from zonda.core.polarization import PolarizationAngles
from zonda.core.types import AnyFloats, Floats

from . import stokes_kernel
from .grid import TangentGrid
from .halves import Split, halves_of
from .pixels import Cells, Looking, fingerprint, tiles
from .stokes_kernel import MATRIX, add_stokes
from .sums import DATA, FLAGGED, HITS, NOISE, OUTSIDE, WEIGHT, WEIGHTS, Sums, add_image, add_list

IN_CACHE = 1 << 14
"""Pixels of an image that are added to the sums of a run at a time."""
LOCK = threading.Lock()
"""Held while a thread is given sums."""


class Folded(NamedTuple):
    """Sums of one thread in the pixels with samples.

    Attributes
    ----------
    pixels, hits
        (n,): numbers of the pixels (or a slice of these), and samples there.
    weights, right, noise
        (n, 1 or 6); (n, 1 or 3) of each signal; (n, 1 or 6), or None: as the weights.
    dropped
        (4,) samples by the reason.
    largest
        Term of the weights and the noise, and terms of the data of each signal.
    """

    pixels: NDArray[np.int64] | slice
    hits: Sums
    weights: Sums
    right: list[Sums]
    noise: Sums | None
    dropped: Sums
    largest: tuple[float, list[float]]


@dataclass
class Binning:
    """Samples of one observation (or of half of it) that count, their weights, and the sums of each
    thread.

    Attributes
    ----------
    use, good, window
        (n_det,), (n_samp,) uint8: which detectors and samples count; (n_samp,):
        `Observation.window`, or (0,).
    weight, noise
        (n_det,): w, and w^2 times the variance of one sample, in units of the reference variance.
    signals
        Number of signals.
    own
        Of I: weights and noise have sums, where detectors differ; else they follow from the hits.
        Of I, Q and U: N is not A, and is added up.
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
    use: NDArray[np.bool_]
    good: NDArray[np.uint8]
    window: Floats
    weight: Floats
    noise: Floats
    signals: int = 1
    own: bool = False
    scatter: float = 0.0
    spare: list[Sums] = field(default_factory=list)
    angles: PolarizationAngles | None = None
    key: Hashable = None
    parts: dict[int, tuple[Sums, Sums, Floats]] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, int]:
        """Shape of the sums; those of I have a border for samples outside of the map (`sums`)."""
        grid = self.looking.grid
        if self.angles is not None:
            more = 6 if self.own else 0
            return grid.n_pixels, stokes_kernel.DATA + 3 * self.signals + more
        columns = (4 if self.own else 2) + self.signals - 1
        if isinstance(grid, TangentGrid):
            return (grid.shape[0] + 2) * (grid.shape[1] + 2), columns
        return grid.n_pixels + 1, columns

    def of_thread(self) -> tuple[Sums, Sums, Floats]:
        """(sums, dropped (4,), largest terms (3 + signals,)) of this thread."""
        mine = threading.get_ident()
        with LOCK:
            if mine not in self.parts:
                self.parts[mine] = self._zeros(), np.zeros(4, np.int64), np.zeros(3 + self.signals)
            return self.parts[mine]

    def _zeros(self) -> Sums:
        while self.spare:
            if (sums := self.spare.pop()).shape == self.shape:
                return sums
        return np.zeros(self.shape, np.int64)

    def folded(self) -> Iterator[Folded]:
        """Sums of each thread, which are zero afterwards."""
        polarized, n = self.angles is not None, self.signals
        top = float(max(self.weight.max(initial=0.0), self.noise.max(initial=0.0))) * WEIGHT
        alike = [np.rint(x[:1] * WEIGHT).astype(np.int64) for x in (self.weight, self.noise)]
        for sums, dropped, largest in self.parts.values():
            for pixels, found, outside in self._in_pixels(sums):
                dropped[OUTSIDE] += outside
                if polarized:
                    first = stokes_kernel.DATA
                    right = [found[:, first + 3 * k : first + 3 * k + 3] for k in range(n)]
                    noise = found[:, -6:] if self.own else None
                    high = float(largest[0]), [float(largest[1])] * n
                    hits = found[:, stokes_kernel.HIT]
                    yield Folded(pixels, hits, found[:, MATRIX], right, noise, dropped, high)
                else:
                    hits = found[:, HITS]
                    weights, noise = (
                        found[:, [column]] if self.own else hits[:, None] * each
                        for column, each in zip((WEIGHTS, NOISE), alike, strict=True)
                    )
                    others = range(found.shape[1] - n + 1, found.shape[1])
                    right = [found[:, [k]] for k in (DATA, *others)]
                    every = max(top, *largest[WEIGHTS : NOISE + 1])
                    ends = [float(largest[k]) for k in (DATA, *range(NOISE + 1, NOISE + n))]
                    yield Folded(pixels, hits, weights, right, noise, dropped, (every, ends))
                dropped = np.zeros_like(dropped)
            self.spare.append(sums)
        self.parts.clear()

    def _in_pixels(self, sums: Sums) -> Iterator[tuple[NDArray[np.int64] | slice, Sums, int]]:
        """Pixels with samples, their sums (n, columns), which are zero in ``sums`` afterwards, and
        samples outside of the map. Of a TAN image: all pixels, some rows at a time.
        """
        grid = self.looking.grid
        if self.angles is None and isinstance(grid, TangentGrid):
            ny, nx = grid.shape
            image = sums.reshape(ny + 2, nx + 2, -1)
            step = max(1, IN_CACHE // nx)
            for first in range(0, ny, step):
                last = min(first + step, ny)
                rows = image[first + (first > 0) : last + 1 + (last == ny)]  # with the border
                hits = int(rows[:, :, HITS].sum())
                if hits or not first:
                    found = image[first + 1 : last + 1, 1:-1].copy().reshape(-1, image.shape[2])
                    rows[...] = 0
                    outside = hits - int(found[:, HITS].sum())
                    yield slice(first * nx, last * nx), found, outside
            return
        pixels = np.flatnonzero(sums[:, HITS if self.angles is None else stokes_kernel.HIT])
        found = sums.take(pixels, axis=0)
        sums[pixels] = 0
        border = int(self.angles is None and pixels.size > 0 and pixels[0] == 0)
        outside = int(found[:border, HITS].sum())
        pixels = pixels if self.angles is not None else pixels - 1
        yield pixels[border:], found[border:], outside


def binnings(
    split: Split,
    looking: Looking,
    levels: tuple[Floats, Floats, Floats],
    good: NDArray[np.bool_],
    spare: list[Sums],
    *,
    signals: int,
    polarized: bool = False,
    scatter: float = 0.0,
) -> list[list[Binning]]:
    """Empty sums for one observation, of each half of its samples: one for all ``signals``, or one
    for each if their noise is that of their ``scatter``.

    ``levels``: weights and noise of the detectors (`detector_weights`), and the window (n_samp,) or
    (0,); ``good`` (n_samp,): which samples count.
    """
    observation, (weight, noise, window) = looking.observation, levels
    halves = [(use, (good & some).astype(np.uint8)) for use, some in halves_of(split, observation)]
    key, angles, own = None, None, bool(scatter or window.size)
    if polarized:
        pole = frame_rotation(looking.grid.frame)[2]
        angles = PolarizationAngles.of(observation, observation.boresight_radec, pole)
        own |= not np.allclose(weight, noise, rtol=1e-6, atol=0)
    else:
        own |= bool((weight != weight[0]).any() or (noise != noise[0]).any())
    if angles is not None and looking.key is not None:
        seen = angles.poles, angles.axes, angles.plate, angles.gamma, window
        efficiency = observation.focalplane.polarization_efficiency
        masks = (mask for half in halves for mask in half)
        key = looking.key, own, fingerprint(*seen, efficiency, *masks)
    count, each = (signals, 1) if scatter else (1, signals)
    more: Any = each, own, scatter, spare, angles, key
    return [
        [Binning(looking, *half, window, weight, noise, *more) for _ in range(count)]
        for half in halves
    ]


def detector_weights(
    observation: Observation, reference: float, inverse: bool, place: str
) -> tuple[Any, Any]:
    """(w, w^2 times the variance of one sample) of each detector, in units of the variance
    ``reference`` [K^2]; ``inverse``: w is the inverse variance, else 1.

    Raises PipelineError where they differ by too much, or are not known.
    """
    usable, net = observation.good_detectors, observation.focalplane.net.copy()
    if not usable.any():
        return np.ones(len(net)), np.ones(len(net))
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
    return weight, weight**2 * variance


class Part(NamedTuple):
    """A block of one band: ``signals`` (n_det, n) each, ``halves`` as `binnings` makes them."""

    signals: tuple[AnyFloats, ...]
    block: Block
    halves: Sequence[Sequence[Binning]]

    def used(self) -> list[NDArray[np.bool_]]:
        """Detectors of the block (n_det,) that count in each half."""
        rows = self.block.detectors
        good = self.block.observation.good_detectors[rows]
        return [half[0].use[rows] & good for half in self.halves]


def add_blocks(parts: Sequence[Part], cells: Cells) -> None:
    """Add the blocks of one band, or of several, to this thread's sums. What bands whose samples
    fall in the same pixels have in common is found once.
    """
    if parts[0].halves[0][0].angles is None:
        _add_intensity(parts)
        return
    alike: dict[Hashable, list[Part]] = {}
    for part in parts:
        key = part.halves[0][0].key, len(part.signals), part.signals[0].dtype.str
        alike.setdefault(key, []).append(part)
    for together in alike.values():
        _add_polarized(together, cells)


def _add_intensity(parts: Sequence[Part]) -> None:
    """Add blocks to the sums of I."""
    todo: list[tuple[Any, ...]] = []
    block = parts[0].block
    begin, rows = block.samples.start, block.detectors
    for part in parts:
        plane = part.block.observation.focalplane
        for half, use in zip(part.halves, part.used(), strict=True):
            left = part.signals
            for one in half:
                signals, left, looking = left[: one.signals], left[one.signals :], one.looking
                good, window = one.good[block.samples], one.window[block.samples]
                how = one.weight[rows], one.noise[rows], one.scatter > 0, one.scatter
                mine = use, good, window, *how, *one.of_thread()
                if isinstance(looking.grid, TangentGrid):
                    where = looking.pointing, begin, plane.xi[rows], plane.eta[rows]
                    add_image(signals, *where, *looking.grid.shape, *mine)
                else:
                    todo.append((signals, looking, mine))
    which = np.arange(rows.start, rows.stop)
    for start in range(begin, block.samples.stop if todo else begin, TILE_SAMPLES):
        stop, cells = min(start + TILE_SAMPLES, block.samples.stop), Cells()
        for signals, looking, mine in todo:
            if mine[1][start - begin : stop - begin].any():
                add_list(signals, start - begin, cells.of(looking, which, start, stop), *mine)
            else:
                mine[-2][FLAGGED] += (stop - start) * which.size


def _add_polarized(parts: Sequence[Part], cells: Cells) -> None:
    """Add the blocks of bands that have the same key to the sums of I, Q and U."""
    used = [part.used() for part in parts]
    if any(not np.array_equal(some, used[0]) for some in used):  # detectors that a filter flagged
        for part in parts:
            _add_polarized([part], cells)
        return
    block, looking = parts[0].block, parts[0].halves[0][0].looking
    a: Any = parts[0].halves[0][0].angles
    detectors, samples = block.detectors, block.samples
    angles = a.poles, a.axes, a.plate, a.gamma, block.observation.focalplane.polarization_efficiency
    signals = tuple(signal for part in parts for signal in part.signals)
    halves = [[half[0] for half in some] for some in zip(*(p.halves for p in parts), strict=True)]
    sums = [[band.of_thread() for band in half] for half in halves]

    def flag(mine: Sequence[Any], number: int) -> None:
        for _, dropped, _ in mine:
            dropped[FLAGGED] += number

    for of_half, mine in zip(used[0], sums, strict=True):
        flag(mine, (samples.stop - samples.start) * int(np.count_nonzero(~of_half)))
    for rows, start, stop in tiles(block, np.any(used[0], axis=0)):
        for half, of_half, mine in zip(halves, used[0], sums, strict=True):
            at, good = np.flatnonzero(of_half[rows]), half[0].good[start:stop]
            if not good.any():
                flag(mine, (stop - start) * at.size)
            elif at.size:
                index = cells.of(looking, rows + detectors.start, start, stop)
                which = rows[at] + detectors.start
                where = start - samples.start, rows[at], at, index, angles, which, start
                bands = tuple(
                    (band.weight[which], band.noise[which], *own)
                    for band, own in zip(half, mine, strict=True)
                )
                add_stokes(signals, *where, good, half[0].window[start:stop], half[0].own, bands)
