"""Maximum-likelihood maps: nothing is filtered, and noise is weighed by its spectrum.

    m = (P^T Q P)^-1 P^T Q d                                                                 (1)

is unbiased for any Q that does not depend on d; the one of `baseline_noise` is the inverse
covariance of the noise. A first reading of each scan compresses it (`compressed_scan`) and
estimates its noise, a second one adds up what free modes take. `normal_equations` are then solved
without the streams.

After the first solution the noise is estimated anew from baselines minus those of the map
(`refine`), of which a map of a draw of the noise tells how much is left; free modes stay what they
are, so that no reading is needed.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr

from zonda.core.data import Block, Data, Observation, Stream
from zonda.core.errors import PipelineError
from zonda.core.plan.planning import planning_of

from .bin_map import BinMap
from .binning import Weights
from .compressed_scan import Keeps
from .likelihood_maps import LikelihoodMaps, LikelihoodSystem
from .likelihood_scan import BandScan, LikelihoodScan
from .map_layout import MapLayout
from .normal_equations import CompressedScans
from .parameters import LikelihoodParameters

if TYPE_CHECKING:
    from zonda.core.detector_files import NoiseTable

LEAST_POWER, FREEDOM = 0.2, 40
"""Least power of slow baselines, in units of white noise, without a filter before the map; degrees
of freedom from which it is measured. White noise alone has less once in 1e8."""
FEWEST = 16
"""Baselines that the noise of a scan is estimated from, at least."""
STEADY, WHITE_LEVELS = 0.75, 3
"""Shared modes add to the scatter within baselines. A detector whose fast baselines have less than
this share of the power that this scatter predicts gets the white level of its baselines, and modes
are sought again, so many times at most."""


class MaximumLikelihoodMap(LikelihoodParameters, BinMap):
    """Map of least noise from unfiltered streams: slow noise and modes that detectors share are
    weighed down by their spectra, equation (1), and no scale is filtered away.
    """

    provides = frozenset({"map", "noise_model"})
    couples = "all"
    linear = False
    averages = False
    unfiltered = True

    _samples: tuple[int, int] = PrivateAttr((0, 0))
    _at_once: int = PrivateAttr(1)
    _keeps: Keeps = PrivateAttr(Keeps.MEMORY)
    _in_files: bool = PrivateAttr(False)
    _bands: int = PrivateAttr(1)

    @property
    def all_bands(self) -> bool:  # type: ignore[override]
        """True where the modes are those of all bands' detectors."""
        return self.group == "all"

    def observe(self, data: Data) -> None:
        """Lay out one grid for all observations, and count their samples and threads."""
        super().observe(data)
        every = [(o.n_detectors * o.n_samples, o.n_samples) for o in data.observations]
        self._samples = sum(n for n, _ in every), sum(n for _, n in every)
        self._at_once = min(data.threads, len(every))
        self._bands = data.n_bands if self.all_bands else 1
        if data.files is not None and every:
            planning: Any = planning_of(self)
            longest = max(data.observations, key=lambda o: o.n_detectors * o.n_samples)
            if not (data.laid_out or data.files.fits(planning.compressed(longest))):
                self._keeps = Keeps.AGAIN  # partial products of a campaign hold their runs
            size, place = planning.compressed(longest), f"{self.label}, compressed scans"
            self._in_files = data.files.needed(size, place, planning.smaller)
            self._keeps = max(self._keeps, Keeps(self._in_files))

    def check(self, data: Data) -> list[str]:
        """See `BinMap.check`. Raises PipelineError for too few or too short baselines."""
        found = super().check(data)
        for observation in data.observations:
            self._length(observation)
            if self._table is not None:
                names = np.array(observation.focalplane.names)[observation.good_detectors]
                self._table.of(names.tolist(), f"{self.label}, {observation.name}")
        return found

    @cached_property
    def _table(self) -> NoiseTable | None:
        """The table of ``noise``."""
        from zonda.core.detector_files import read_noise  # it imports h5py

        return read_noise(self.noise) if isinstance(self.noise, Path) else None

    def _length(self, observation: Observation) -> int:
        """Samples of a baseline. Raises PipelineError for too few or too short baselines."""
        seconds = self.baseline_of(observation)
        length = max(round(seconds * observation.sample_rate), 1)
        place = f"{self.label}, {observation.name}"
        if length < 2:
            raise PipelineError(
                f"a baseline of {seconds:.3g} s has one sample, at {observation.sample_rate:g} Hz",
                place=place,
                cure=f"set baseline: {4 / observation.sample_rate:.2g} s, or longer",
            )
        n_samples = observation.n_samples
        self._need_baselines(-(-n_samples // length), n_samples, seconds, place)
        return length

    def _need_baselines(self, number: int, n_samples: int, seconds: float, place: str) -> None:
        needed, cure = FEWEST + self.trend, "make the map with BinMap"
        if number < needed:
            if n_samples >= 2 * needed:  # of two samples each
                cure = f"set a shorter baseline, of which a scan has {needed} or more; or {cure}"
            raise PipelineError(
                f"the scan has samples in {number} of the {needed} baselines of {seconds:.3g} s"
                " that its noise is found from",
                place=place,
                cure=cure,
            )

    def prepare(self, observation: Observation) -> BandScan:  # type: ignore[override]
        """Pixels and baselines of one observation, before its samples are read.

        Raises PipelineError where a window has changed the samples, and for too few or too short
        baselines.
        """
        self._length(observation)
        if observation.window is not None:
            raise PipelineError(
                f"{' and '.join(observation.windows)} changed the weight of samples",
                place=f"{self.label}, {observation.name}",
                cure="leave the window out: slow noise needs none here",
            )
        prepared = super().prepare(observation)
        more = self._layout["variance"], self._spare, self._keeps
        return BandScan(prepared, observation, *more)

    def measure(self, stream: Stream, model: Any = None) -> BandScan | LikelihoodScan:
        """Compress a scan and estimate its noise, in one reading; with `group: all` that of all
        bands. A sample that one band flags is a gap of this band.
        """
        bands: Sequence[BandScan] = stream.states or [stream.state]
        observation = stream.observation
        if len(bands) > 1:
            flags = [band.observation.flags for band in bands]
            observation.flags = np.bitwise_and.reduce(flags)
        scan = LikelihoodScan(bands, self._length(observation), observation)
        scan.compress(stream, self)
        white = scan.white(self.label)
        place = f"{self.label}, {observation.name}"
        number = int(np.count_nonzero(scan.found.counted.any(axis=0)))
        seconds = self.baseline_of(observation)
        self._need_baselines(number, observation.n_samples, seconds, place)
        for _ in range(WHITE_LEVELS):
            scan.noise = scan.estimate(white, self)
            white = np.where(scan.noise.fast < STEADY, white * scan.noise.fast, white)
            if (white == scan.noise.white).all():
                break
        freedom = np.cumsum(scan.noise.freedom)
        power = np.cumsum(scan.noise.least * scan.noise.freedom) / np.maximum(freedom, 1)
        power = power[freedom >= FREEDOM]
        if (power < LEAST_POWER).any():
            raise PipelineError(
                f"slow noise has {power.min():.2g} of the power of white noise: a"
                " filter has removed it, and the signal with it",
                place=place,
                cure=f"put {type(self).__name__} before filters, or leave these out",
            )
        if self.noise != "estimated":
            scan.state_noise(self, self._table)
        scan.give_weights(self.label)
        return scan if len(bands) > 1 else bands[0]

    def of_rows(self, measured: LikelihoodScan, rows: slice) -> BandScan:
        """The part of one band, whose detectors these are."""
        return next(band for band in measured.bands if band.of_stream == rows)

    def exec_bands(self, blocks: Sequence[Block], states: Sequence[Any]) -> None:
        """Add blocks to the sums in pixels, baselines and free modes."""
        super().exec_bands(blocks, [state.prepared for state in states])
        for block, state in zip(blocks, states, strict=True):
            state.add(block)

    def collect(  # type: ignore[override]
        self,
        data: Data,
        observation: Observation,
        state: BandScan,
    ) -> None:
        """Hand over sums in pixels, and the compressed scan, that of all bands with the first."""
        super().collect(data, observation, state.prepared)
        data.partial[self.label].unknown_variance = False  # type: ignore[attr-defined]
        scan: LikelihoodScan = state.scan
        if state is scan.bands[0]:
            scans = CompressedScans([scan.compressed()])
            if self._in_files:
                scans = CompressedScans.of(data.files.put(scans.arrays()))
                scans.scans[0].scan.again = scan.scan.again
            if where := self._where:
                observation.log.state(self.label, "compressed scans", where)
            data.add(f"{self.label} scans", scans)
        log, noise = observation.log, scan.noise
        seconds = scan.length / observation.sample_rate
        log.state(self.label, "noise model", self.model)
        log.state(self.label, "length of a baseline", f"{seconds:.3g} s, {scan.length} samples")
        lost = observation.n_samples % scan.length
        if lost:
            log.state(self.label, "samples of the last baseline, which is shorter", str(lost))
        powers = ", ".join(f"{value:.3g}" for value in noise.values)
        log.state(
            self.label, "power of modes over white noise, first estimate", powers or "no modes"
        )

    @property
    def _where(self) -> str:
        """Place of compressed scans, in words; empty for memory."""
        files = "in temporary files" if self._in_files else ""
        if self._keeps is not Keeps.AGAIN:
            return files
        return f"runs are found anew in each iteration, baselines {files or 'in memory'}"

    def finalize(self, data: Data) -> None:
        """Solve for the map of each signal."""
        self.finalize_bands([data])

    def finalize_bands(self, every: Sequence[Data]) -> None:
        """Solve for the maps of all bands that share modes."""
        for made, data in zip(self.maps(every), every, strict=False):
            made.finish(data)

    def maps(self, every: Sequence[Data]) -> list[LikelihoodMaps]:
        """Equations and sums for the maps of all signals, of each band; none without a scan."""
        self._spare.clear()
        sums = [data.take(self.label) for data in every]
        scans: CompressedScans | None = every[0].take(f"{self.label} scans")
        if scans is None:
            return []
        layouts = [data.layouts[self.label] for data in every] if len(every) > 1 else [self._layout]
        grids = [MapLayout(self).grid(layout) for layout in layouts[1:]]
        parts = list(zip([self.grid, *grids], layouts, sums, strict=True))
        system = LikelihoodSystem(self, parts, scans, every[0])
        return [
            LikelihoodMaps(self, *part, system, band, data)
            for band, (part, data) in enumerate(zip(parts, every, strict=True))
        ]

    def _weights(self, observation: Observation) -> tuple[Weights, NDArray[np.bool_]]:
        """Equal weights, until `measure` knows those of the detectors."""
        equal = np.ones(observation.n_detectors)
        return Weights(equal, equal, np.zeros(0)), observation.good_samples
