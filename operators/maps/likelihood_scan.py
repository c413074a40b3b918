"""One observation of a maximum-likelihood map: what the readings of its streams add up."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Block, Observation, Stream
from zonda.core.errors import PipelineError
from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.signal import MAIN
from zonda.core.types import AnyFloats, Floats

from .baseline_noise import BaselineNoise, estimate, filled, members
from .bin_map import Prepared
from .binning import Weights, binnings
from .compressed_scan import RunsOfTiles, Tile, add_baselines
from .intensity_kernel import VALUE, WEIGHT
from .normal_equations import Compressed
from .parameters import LikelihoodParameters
from .stated_noise import of_scene, of_table

if TYPE_CHECKING:
    from zonda.core.detector_files import NoiseTable

FILLED, STILL = 60, 1e-6
"""Searches at most for the mode that fills baselines, and the change below which they end."""
MOST_APART = 1e4
"""Largest ratio of the variances of white noise, as found and by the NET: fixed-point weights hold
no more."""
LOCK = threading.Lock()
"""Held while a thread adds to the sums of a scan."""


@dataclass
class LikelihoodScan:
    """One observation: what `measure` finds, and the sums that `exec` adds to.

    Attributes
    ----------
    prepared
        Sums in pixels.
    length
        Samples of a baseline.
    rows
        (n,) the good detectors.
    baselines, common
        By signal, fixed-point sums of baselines (n, n_base) and free modes (free, n_samp).
    """

    prepared: Prepared
    length: int
    observation: Observation
    rows: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))
    baselines: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    common: dict[str, NDArray[np.int64]] = field(default_factory=dict)
    found: Any = None
    scan: Any = None
    filler: Any = None
    noise: Any = None

    @property
    def looking(self) -> Any:
        """Pointing of the detectors."""
        return self.prepared.halves[0][0].looking

    @property
    def nowhere(self) -> int:
        """Number of the pixel of samples that do not count."""
        return int(self.looking.grid.n_pixels)

    def pixels(
        self,
        which: NDArray[np.intp],
        start: int,
        stop: int,
        *signals: AnyFloats,
    ) -> NDArray[np.int32]:
        """(n, stop - start) pixels of detectors, -1 of samples that do not count."""
        found: NDArray[np.int32] = self.looking.pixels(which, start, stop)
        found[:, self.prepared.halves[0][0].samples[start:stop] == 0] = -1
        for signal in signals:
            found[~np.isfinite(signal)] = -1
        return found

    def compress(self, stream: Stream, place: str) -> None:
        """Find runs and baselines of the complete signal, in one reading."""
        observation, mean = stream.observation, stream.means.get(MAIN)
        self.rows = np.flatnonzero(observation.good_detectors)
        if not self.rows.size:
            raise PipelineError(
                "no detector is good",
                place=f"{place}, {observation.name}",
                cure="leave this scan out, or look at the flags of its detectors",
            )
        self.found = RunsOfTiles(self.rows.size, observation.n_samples, self.length)
        angles = self.prepared.halves[0][0].angles
        single = observation.hwp_angle is not None
        efficiency = observation.focalplane.polarization_efficiency

        def tiles(detectors: slice, samples: slice, part: AnyFloats) -> list[Any]:
            which = self.rows[(self.rows >= detectors.start) & (self.rows < detectors.stop)]
            made: list[Any] = []
            for start in range(samples.start, samples.stop, TILE_SAMPLES):
                stop = min(start + TILE_SAMPLES, samples.stop)
                here = slice(start - samples.start, stop - samples.start)
                signal = np.asarray(part[which - detectors.start, here], np.float64)
                if mean is not None:
                    whole = mean.evaluate(detectors, slice(start, stop))
                    signal += whole[which - detectors.start]
                cosine, sine = np.zeros((2, which.size, 0 if angles is None else stop - start))
                if angles is not None:
                    angles.fill(which, start, cosine, sine)
                    cosine *= efficiency[which, None]
                    sine *= efficiency[which, None]
                pixel = self.pixels(which, start, stop, signal)
                made.append(
                    Tile.of(signal, pixel, start, self.length, self.nowhere, cosine, sine, single)
                )
            return [np.searchsorted(self.rows, which), *made]

        for _, _, (rows, *made) in stream.sweep(tiles):
            for tile in made:
                self.found.add(rows, tile)
        self.scan = self.found.scan(observation.sample_rate, self.nowhere)

    def white(self, place: str) -> Floats:
        """(n,) variance of white noise; the median of the others for detectors without samples.

        Raises PipelineError where there is none.
        """
        observation, white = self.observation, np.asarray(self.found.scatter)
        place = f"{place}, {observation.name}"
        if np.isnan(white).all():
            raise PipelineError(
                "no sample counts: all are flagged or not finite",
                place=place,
                cure="leave this scan out, or look at the flags of its samples",
            )
        if (white <= 0).any():
            name = observation.focalplane.names[self.rows[np.flatnonzero(white <= 0)[0]]]
            raise PipelineError(
                f"detector {name} has no noise",
                place=place,
                cure="add WhiteNoise, or flag this detector; or make the map with BinMap",
            )
        return np.where(np.isnan(white), np.nanmedian(white), white)

    def estimate(self, white: Floats, step: LikelihoodParameters) -> BaselineNoise:
        """Noise of the baselines, of white levels (n,) [K^2]. Baselines of gaps alone are filled by
        what all see alike, then by the first mode that is found: a fit of more is not stable.
        """
        lacking, self.filler = self.scan.lacking, np.sqrt(1 / white / (1 / white).sum())
        groups, plane = step.groups_of(self.observation)[self.rows], self.observation.focalplane
        for _ in range(FILLED):
            noise = estimate(
                filled(self.found.means, lacking, white, self.filler, step.trend, groups),
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
            if not lacking.any() or np.abs(self.filler - before).max() < STILL:
                break
        return noise

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
            names = [observation.focalplane.names[row] for row in self.rows]
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
        observation.log.state(step.label, "noise model", str(step.noise))
        text = f"{ratio:.4g}"
        observation.log.state(step.label, "its white level over that of the streams, median", text)

    def give_weights(self, reference: float, spare: Any, place: str) -> None:
        """Weigh detectors by the white level that was found, in units of the inverse variance
        ``reference``, K^2. Raises PipelineError for a level that is far from it.
        """
        observation, first = self.observation, self.prepared.halves[0][0]
        weight = np.ones(observation.n_detectors)
        apart = np.abs(np.log(self.noise.white / reference))
        if apart.max() > np.log(MOST_APART):
            k = int(apart.argmax())
            raise PipelineError(
                f"white noise of detector {observation.focalplane.names[self.rows[k]]} is"
                f" {np.sqrt(self.noise.white[k]):.2g} K a sample, and"
                f" {np.sqrt(reference):.2g} K by the NET of the first scan",
                place=f"{place}, {observation.name}",
                cure="add WhiteNoise, or make the map with BinMap; for recorded streams, state"
                " their unit and NET",
            )
        rounded = np.rint(reference / self.noise.white * WEIGHT) / WEIGHT
        weight[self.rows] = rounded
        self.noise = replace(self.noise, white=reference / rounded)
        made = binnings(
            "scans",
            self.looking,
            Weights(weight, weight.copy(), np.zeros(0)),
            first.samples.astype(bool),
            spare,
            signals=first.signals.stop - first.signals.start,
            polarized=first.angles is not None,
        )
        self.prepared = replace(self.prepared, halves=made)
        scan = self.scan
        for name in sorted({*observation.signals} - observation.unfiltered):
            self.baselines[name] = np.zeros(scan.shape, np.int64)
            self.common[name] = np.zeros(
                (len(self.noise.free_modes), observation.n_samples), np.int64
            )

    def add(self, block: Block) -> None:
        """Add a block to the sums of baselines and free modes."""
        begin, end = np.searchsorted(self.rows, [block.detectors.start, block.detectors.stop])
        which = self.rows[begin:end]
        a = self.scale * self.noise.free_modes[:, begin:end]
        signals = self.prepared.signals(block)
        rows = which - block.detectors.start
        for start in range(block.samples.start, block.samples.stop, TILE_SAMPLES):
            stop = min(start + TILE_SAMPLES, block.samples.stop)
            here = slice(start - block.samples.start, stop - block.samples.start)
            parts = [signal[rows, here] for signal in signals]
            pixel = self.pixels(which, start, stop, *parts)
            base = slice(start // self.length, (stop - 1) // self.length + 1)
            for name, part in zip(block.signals, parts, strict=True):
                if name not in self.baselines:
                    continue
                y = np.zeros((which.size, base.stop - base.start), np.int64)
                s = np.zeros((len(a), stop - start), np.int64)
                add_baselines(part, pixel, start, self.length, a, VALUE, y, s)
                with LOCK:
                    self.baselines[name][begin:end, base] += y
                    self.common[name][:, start:stop] += s

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
        return Compressed(scan, self.noise, data)
