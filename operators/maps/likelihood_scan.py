"""One observation of a maximum-likelihood map: what the readings of its streams add up."""

from __future__ import annotations

import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Block, Observation, Stream
from zonda.core.errors import PipelineError
from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.polarization import PolarizationAngles
from zonda.core.signal import MAIN
from zonda.core.types import AnyFloats, Floats

from .baseline_noise import BaselineNoise, estimate, filled, of_scene, of_table
from .bin_map import Prepared
from .binning import Weights, binnings
from .compressed_scan import Keeps, RunsOfTiles, Tile, add_baselines, add_groups
from .grid import Looking
from .intensity_kernel import VALUE, WEIGHT
from .normal_equations import Compressed
from .parameters import LikelihoodParameters
from .shared_modes import members

if TYPE_CHECKING:
    from zonda.core.detector_files import NoiseTable

STEPS = 3
"""Steps of the search for what detectors have in common, where baselines lack samples."""
FILLED, STILL = 60, 1e-6
"""Searches at most for the mode that fills baselines, and the change below which they end."""
MOST_APART = 1e4
"""Largest ratio of the variances of white noise, as found and by the NET: fixed-point weights hold
no more."""
LOCK = threading.Lock()
"""Held while a thread adds to the sums of a scan."""


@dataclass(frozen=True)
class BandPointing:
    """Pixels and angles of the good detectors ``rows`` (n,) of a band.

    ``first``: number of its first pixel in the scan; ``flagged`` (n_samp,): instants that do not
    count; ``angles``: None for maps of I.
    """

    looking: Looking
    rows: NDArray[np.intp]
    first: int
    flagged: NDArray[np.bool_]
    angles: PolarizationAngles | None

    def pixels(self, which: NDArray[np.intp], start: int, stop: int) -> NDArray[np.int32]:
        """(n, stop - start) pixels of detectors, -1 of samples that do not count."""
        found = self.looking.pixels(which, start, stop)
        if self.first:
            found[found >= 0] += self.first
        found[:, self.flagged[start:stop]] = -1
        return found

    def seen(self, some: slice) -> tuple[NDArray[np.int32], Floats, Floats]:
        """Pixels, c and s of some good detectors."""
        which, observation = self.rows[some], self.looking.observation
        n = 0 if self.angles is None else observation.n_samples
        cosine, sine = np.empty((2, which.size, n))
        if self.angles is not None:
            efficiency = observation.focalplane.polarization_efficiency[which, None]
            self.angles.fill(which, 0, cosine, sine)
            cosine *= efficiency
            sine *= efficiency
        return self.pixels(which, 0, observation.n_samples), cosine, sine


@dataclass(frozen=True)
class ScanPointing:
    """Pixels and angles of the good detectors of all bands; samples ``lost`` (n, 2), detector and
    instant in order, have no value in the streams.
    """

    bands: Sequence[tuple[slice, BandPointing]]
    lost: NDArray[np.intp]

    def __call__(self, some: slice) -> tuple[NDArray[np.int32], Floats, Floats]:
        """See `RunsOfPointing.find`."""
        parts = [
            band.seen(slice(max(some.start - own.start, 0), some.stop - own.start))
            for own, band in self.bands
            if own.start < some.stop and some.start < own.stop
        ]
        pixel, cosine, sine = (np.concatenate(one) for one in zip(*parts, strict=True))
        begin, end = np.searchsorted(self.lost[:, 0], [some.start, some.stop])
        row, t = self.lost[begin:end].T
        pixel[row - some.start, t] = -1
        return pixel, cosine, sine


@dataclass
class BandScan:
    """A scan with the detectors of one band: what `prepare` knows, and where they stand in the
    `LikelihoodScan` of all bands that share modes.

    Attributes
    ----------
    prepared
        Sums in pixels.
    reference
        Variance that weights are in units of, K^2.
    spare
        Arrays for sums of threads.
    keeps
        Where runs are kept.
    rows
        (n,) the good detectors.
    of_stream, of_scan
        The band's detectors in the stream that is measured; the good ones in the scan.
    first
        Number of its first pixel in the scan.
    """

    prepared: Prepared
    observation: Observation
    reference: float
    spare: Any
    keeps: Keeps = Keeps.MEMORY
    rows: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    of_stream: slice = field(default_factory=lambda: slice(0))
    of_scan: slice = field(default_factory=lambda: slice(0))
    first: int = 0
    scan: Any = None

    @property
    def pointing(self) -> BandPointing:
        """Pixels and angles of the good detectors."""
        made = self.prepared.halves[0][0]
        return BandPointing(made.looking, self.rows, self.first, made.samples == 0, made.angles)

    def tiles(
        self, detectors: slice, samples: slice, part: AnyFloats, mean: Any
    ) -> Iterator[tuple[NDArray[np.intp], Tile, int, NDArray[np.int64]]]:
        """Rows in the scan, sums, first sample, and sum over detectors of each group (n_groups, n),
        of a block of the stream, tile after tile.
        """
        begin = max(detectors.start, self.of_stream.start)
        end = min(detectors.stop, self.of_stream.stop)
        place = self.of_stream.start + self.rows
        which = self.rows[(place >= begin) & (place < end)]
        if not which.size:
            return
        pointing, single = self.pointing, self.observation.hwp_angle is not None
        rows = self.of_scan.start + np.searchsorted(self.rows, which)
        for start in range(samples.start, samples.stop, TILE_SAMPLES):
            stop = min(start + TILE_SAMPLES, samples.stop)
            here = slice(start - samples.start, stop - samples.start)
            at = which + self.of_stream.start
            signal = np.asarray(part[at - detectors.start, here], np.float64)
            if mean is not None:
                signal += mean.evaluate(slice(begin, end), slice(start, stop))[at - begin]
            pixel = pointing.pixels(which, start, stop)
            lost = np.argwhere((pixel >= 0) & ~np.isfinite(signal))
            pixel[*lost.T] = -1
            lost = np.stack([rows[lost[:, 0]], start + lost[:, 1]], axis=1)
            tile = Tile.of(signal, pixel, start, self.scan.length, single, lost)
            total = np.zeros((len(self.scan.total), stop - start), np.int64)
            add_groups(signal, pixel, self.scan.groups[rows], VALUE, total)
            yield rows, tile, start, total

    def weigh(self, white: Floats) -> Floats:
        """Weigh detectors by the white level (n,) that was found: empty sums in pixels. Returns the
        levels as fixed-point weights have them.
        """
        first, weight = self.prepared.halves[0][0], np.ones(self.observation.n_detectors)
        weight[self.rows] = rounded = np.rint(self.reference / white * WEIGHT) / WEIGHT
        made = binnings(
            "scans",
            first.looking,
            Weights(weight, weight.copy(), np.zeros(0)),
            first.samples.astype(bool),
            self.spare,
            signals=first.signals.stop - first.signals.start,
            polarized=first.angles is not None,
        )
        self.prepared = replace(self.prepared, halves=made)
        return np.asarray(self.reference / rounded)

    def add(self, block: Block) -> None:
        """Add a block to the sums of baselines and free modes."""
        begin, end = np.searchsorted(self.rows, [block.detectors.start, block.detectors.stop])
        which, scan = self.rows[begin:end], self.scan
        at = slice(self.of_scan.start + begin, self.of_scan.start + end)
        a = scan.scale * scan.noise.free_modes[:, at]
        signals = self.prepared.signals(block)
        rows = which - block.detectors.start
        for start in range(block.samples.start, block.samples.stop, TILE_SAMPLES):
            stop = min(start + TILE_SAMPLES, block.samples.stop)
            here = slice(start - block.samples.start, stop - block.samples.start)
            parts = [signal[rows, here] for signal in signals]
            pixel = self.pointing.pixels(which, start, stop)
            for part in parts:
                pixel[~np.isfinite(part)] = -1
            base = slice(start // scan.length, (stop - 1) // scan.length + 1)
            for name, part in zip(block.signals, parts, strict=True):
                if name not in scan.baselines:
                    continue
                y = np.zeros((which.size, base.stop - base.start), np.int64)
                s = np.zeros((len(a), stop - start), np.int64)
                add_baselines(part, pixel, start, scan.length, a, VALUE, y, s)
                with LOCK:
                    scan.baselines[name][at, base] += y
                    scan.common[name][:, start:stop] += s


@dataclass
class LikelihoodScan:
    """One observation: what `measure` finds, and the sums that `exec` adds to.

    Attributes
    ----------
    bands
        Those whose detectors share modes.
    length
        Samples of a baseline.
    observation
        With the detectors of all bands.
    rows
        (n,) the good detectors.
    groups, total
        (n,) of each, and the sum over the detectors of each group (n_groups, n_samp), fixed-point.
    baselines, common
        By signal, fixed-point sums of baselines (n, n_base) and free modes (free, n_samp).
    """

    bands: Sequence[BandScan]
    length: int
    observation: Observation
    rows: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    groups: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    total: NDArray[np.int64] = field(default_factory=lambda: np.zeros((0, 0), np.int64))
    baselines: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    common: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    found: Any = None
    scan: Any = None
    filler: Any = None
    noise: Any = None

    def compress(self, stream: Stream, step: LikelihoodParameters) -> None:
        """Find runs and baselines of the complete signal, in one reading."""
        row, found, nowhere = 0, list[NDArray[np.intp]](), 0
        for band in self.bands:
            own = band.observation
            band.rows, band.scan = np.flatnonzero(own.good_detectors), self
            if not band.rows.size:
                raise PipelineError(
                    "no detector is good",
                    place=f"{step.label}, {own.name}",
                    cure="leave this scan out, or look at the flags of its detectors",
                )
            before = sum(rows.size for rows in found)
            band.of_stream = slice(row, row + own.n_detectors)
            band.of_scan, band.first = slice(before, before + band.rows.size), nowhere
            found.append(row + band.rows)
            row, nowhere = band.of_stream.stop, nowhere + int(band.pointing.looking.grid.n_pixels)
        self.rows, mean = np.concatenate(found), stream.means.get(MAIN)
        self.found = RunsOfTiles(self.rows.size, self.observation.n_samples, self.length)
        groups = np.unique(step.groups_of(self.observation)[self.rows], return_inverse=True)
        self.groups = np.asarray(groups[1], np.intp)
        self.total = np.zeros((len(groups[0]), self.observation.n_samples), np.int64)

        def tiles(detectors: slice, samples: slice, part: AnyFloats) -> list[Any]:
            block = detectors, samples, part, mean
            return [tile for band in self.bands for tile in band.tiles(*block)]

        for _, _, made in stream.sweep(tiles):
            for rows, tile, start, total in made:
                self.found.add(rows, tile)
                self.total[:, start : start + total.shape[1]] += total
        pointing = [(band.of_scan, band.pointing) for band in self.bands]
        self.scan = self.found.scan(
            self.observation.sample_rate,
            nowhere,
            ScanPointing(pointing, self.found.lost),
            polarized=pointing[0][1].angles is not None,
            single=self.observation.hwp_angle is not None,
            keeps=max(band.keeps for band in self.bands),
            threads=stream.threads,
        )

    def steady(self, white: Floats) -> Floats:
        """(n, n_base) means of baselines, K. Where a baseline lacks samples, its mean is corrected
        for what the common mode of the group, with the gains of `filler`, did in them.
        """
        scan, y, gain = self.scan, self.found.means, self.filler * np.sqrt(white)
        starts = np.arange(scan.shape[1]) * self.length
        for _ in range(STEPS if scan.gaps else 0):
            lost = np.zeros(scan.shape)
            for group, total in enumerate(self.total / VALUE):
                share = (self.groups == group).astype(np.float64)
                own = share * gain
                own *= share.sum() / own.sum() if own.any() else 0.0
                one = np.ones(scan.shape)
                there = scan.about_means(np.zeros((1, scan.n_samples)), -one, own[None])
                c = scan.about_means(total[None], y, share[None])
                c = np.divide(c, there, out=np.zeros_like(c), where=there > 0)[0]
                number = np.add.reduceat(there[0] > 0, starts, dtype=np.float64)
                whole = np.add.reduceat(c, starts) / np.maximum(number, 1)
                some = scan.over(c) / np.maximum(scan.known, 1)
                lost += own[:, None] * np.where(scan.known > 0, some - whole, 0.0)
            y = self.found.means - lost
        return np.asarray(y)

    def name(self, k: int) -> str:
        """The name of a good detector."""
        band = next(band for band in self.bands if k < band.of_scan.stop)
        return str(band.observation.focalplane.names[band.rows[k - band.of_scan.start]])

    def white(self, place: str) -> Floats:
        """(n,) variance of white noise; the median of the others for detectors without samples.

        Raises PipelineError where there is none.
        """
        observation, white = self.observation, np.asarray(self.found.scatter)
        place = f"{place}, {observation.name}"
        if np.isnan(white).all():
            raise PipelineError(
                "no sample counts: all are flagged, not finite or beyond the map",
                place=place,
                cure="leave this scan out, or look at the flags of its samples and at width and"
                " centre of the map",
            )
        if (white <= 0).any():
            raise PipelineError(
                f"detector {self.name(int(np.nanargmin(white)))} has no noise",
                place=place,
                cure="add WhiteNoise, or flag this detector; or make the map with BinMap",
            )
        return np.where(np.isnan(white), np.nanmedian(white), white)

    def estimate(self, white: Floats, step: LikelihoodParameters) -> BaselineNoise:
        """Noise of the baselines, of white levels (n,) [K^2]. Baselines of gaps alone are filled by
        what all see alike, then by the first mode that is found: a fit of more is not stable.
        """
        lacking, self.filler = self.scan.lacking, np.sqrt(1 / white / (1 / white).sum())
        groups, plane = self.groups, self.observation.focalplane
        for _ in range(FILLED):
            noise = estimate(
                filled(self.steady(white), lacking, white, self.filler, step.trend, groups),
                self.scan.counted,
                white,
                self.length,
                self.observation.sample_rate,
                modes=step.modes,
                free=step.free,
                trend=step.trend,
                lacking=lacking,
                groups=groups,
                places=np.stack([plane.xi, plane.eta])[:, self.rows],
            )
            before = self.filler
            with_modes = [at for at in members(groups) if noise.modes[:, at].any()]
            if with_modes:
                self.filler = noise.modes[: len(with_modes)].sum(axis=0)
            if not self.scan.gaps or np.abs(self.filler - before).max() < STILL:
                break
        known = np.where(self.scan.known > 0, self.scan.known, np.inf)
        fewer = (self.scan.counted / known).sum(axis=1) / np.maximum(
            (known < np.inf).sum(axis=1), 1
        )
        return replace(noise, fast=noise.fast / np.maximum(fewer, 1))

    def state_noise(self, step: LikelihoodParameters, table: NoiseTable | None) -> None:
        """Take the noise from a table, or from the scene.

        Raises InputError where detectors are not in the table, PipelineError where it or the scene
        tells no noise.
        """
        observation, found = self.observation, self.noise.white
        place = f"{step.label}, {observation.name}"
        if table is None:
            self.noise = of_scene(self.noise, observation, self.rows, place)
        else:
            names = [self.name(k) for k in range(self.rows.size)]
            columns = table.of(names, place)
            white = columns.get("net", np.zeros(1)) ** 2 * observation.sample_rate
            if (white <= 0).any():
                raise PipelineError(
                    f"{table.path} has no net above 0 for {names[int(np.argmin(white))]}",
                    place=place,
                    cure="make the table anew: zonda noise FILE, or flag the detector",
                )
            self.noise = of_table(self.estimate(white, step), columns)
        ratio = np.median(np.sqrt(self.noise.white / found))
        text = f"{ratio:.4g}"
        observation.log.state(step.label, "its white level over that of the streams, median", text)

    def give_weights(self, place: str) -> None:
        """Weigh detectors by the white level that was found, in units of the inverse variance of
        their band, K^2. Raises PipelineError for a level that is far from it.
        """
        white = np.empty(self.rows.size)
        for band in self.bands:
            found = self.noise.white[band.of_scan]
            apart = np.abs(np.log(found / band.reference))
            if apart.max() > np.log(MOST_APART):
                k = int(apart.argmax())
                raise PipelineError(
                    f"white noise of detector {self.name(band.of_scan.start + k)} is"
                    f" {np.sqrt(found[k]):.2g} K a sample, and"
                    f" {np.sqrt(band.reference):.2g} K by the NET of the first scan",
                    place=f"{place}, {band.observation.name}",
                    cure="add WhiteNoise, or make the map with BinMap; for recorded streams, state"
                    " their unit and NET",
                )
            white[band.of_scan] = band.weigh(found)
        self.noise = replace(self.noise, white=white)
        first = self.bands[0].observation
        for name in sorted({*first.signals} - first.unfiltered):
            self.baselines[name] = np.zeros(self.scan.shape, np.int64)
            self.common[name] = np.zeros((len(self.noise.free_modes), first.n_samples), np.int64)

    @property
    def scale(self) -> float:
        """Unit of the sums of free modes, K: they fit in 63 bits."""
        return float(np.sqrt(self.noise.white.min()))

    def compressed(self) -> Compressed:
        """The scan without its observation."""
        data = {}
        scan, noise, a = self.scan, self.noise, self.noise.free_modes
        for name, sums in self.baselines.items():
            y = sums / VALUE / np.maximum(scan.known, 1)
            y = filled(
                y, scan.lacking, noise.white, self.filler, len(noise.lines) - 1, noise.groups
            )
            s = self.common[name] / (VALUE * self.scale)
            data[name] = (y, scan.about_means(s, y, a))
        ends = [0, *(band.of_scan.stop for band in self.bands)]
        return Compressed(scan, self.noise, data, ends)
