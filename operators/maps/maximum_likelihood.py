"""Maximum-likelihood maps: nothing is filtered, and noise is weighed by its spectrum.

    m = (P^T Q P)^-1 P^T Q d                                                                 (1)

is unbiased for any Q; the one of `baseline_noise` is the inverse covariance of the noise. A first
reading of each scan compresses it (`compressed_scan`) and estimates its noise, a second one adds up
what free modes take. `normal_equations` are then solved without the streams.

After the first solution the noise is estimated anew from baselines minus those of the map
(`refine`); free modes stay what they are, so that no reading is needed.
"""

from __future__ import annotations

import threading
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Seconds
from zonda.core.data import Block, Data, Observation, Stream
from zonda.core.errors import PipelineError
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.signal import MAIN
from zonda.core.types import AnyFloats, Floats

from .baseline_noise import estimate
from .bin_map import BinMap, Prepared
from .binning import Weights, binnings
from .compressed_scan import CompressedScan, RunsOfTiles, Tile, add_baselines
from .intensity_kernel import VALUE, WEIGHT
from .map_from_sums import MapFromSums
from .map_layout import MapLayout
from .map_sums import MapSums
from .normal_equations import (
    Compressed,
    CompressedScans,
    NormalEquations,
    Solution,
    WeighedScan,
)

LEAST_POWER, FREEDOM = 0.2, 40
"""Of slow baselines, in units of white noise: less is left where a filter has removed slow noise.
It is found from so many degrees of freedom at least: white noise has less once in 1e8."""
SHORTEST = 16
"""Baselines of a scan."""
MOST_OUTSIDE = 1e-3
"""Share of the samples: what detectors share cannot be told where some of them see no pixel."""
STEADY, WHITE_LEVELS = 0.75, 3
"""Where fast baselines have less than this share of the power that the scatter within them tells,
modes that detectors share have a part in that scatter: what baselines tell is taken, and modes are
sought again, so often at most."""
MOST_ITERATIONS = 1000
"""Of conjugate gradients."""
LOCK = threading.Lock()
"""Held while a thread adds to the sums of a scan."""


class MaximumLikelihoodMap(BinMap):
    """Map of least noise from unfiltered streams: slow noise and modes that detectors share are
    weighed down by their spectra, equation (1), and no scale is filtered away.
    """

    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "all"
    all_bands: ClassVar[bool] = False
    linear: ClassVar[bool] = False
    averages: ClassVar[bool] = False

    baseline: Seconds = quantity("0.2 s", gt=0)
    """Length of a baseline: noise is white within it, but for the free modes."""
    modes: int = Field(3, ge=0, le=20)
    """Modes that detectors share, each with a spectrum of its own. 0: baselines of independent
    detectors (destriping with a noise prior)."""
    free: int = Field(1, ge=0, le=20)
    """How many of the modes have no weight at any frequency, within baselines too."""
    trend: int = Field(1, ge=0, le=10)
    """Degree of the polynomial of each detector's scan that is taken off."""
    refine: int = Field(1, ge=0, le=5)
    """How often noise is estimated again, from data minus the map."""
    tolerance: float = Field(1e-4, gt=0, lt=0.1)
    """Norm of the residual at which the iteration ends, over that of the right side."""
    undetermined: Literal["none", "mean", "plane"] | None = None
    """What is taken off the map of I, weighted by its hits, since the data hardly determine it;
    where absent, a plane of a TAN image, the mean of other maps."""

    _samples: tuple[int, int] = PrivateAttr((0, 0))

    @model_validator(mode="after")
    def _of_likelihood(self) -> MaximumLikelihoodMap:
        if self.free > self.modes:
            raise ValueError(f"free: {self.free} of {self.modes} modes; set modes to {self.free}")
        if self.contents == "hits" or self.weights == "uniform" or self.noise == "scatter":
            raise ValueError(
                "contents: hits, weights: uniform and noise: scatter belong to BinMap: these maps"
                " are weighted by the noise that is found in the streams"
            )
        if self.split != "scans":
            raise ValueError("half_difference is that of even and odd scans; write true or scans")
        if self.undetermined == "plane" and self.kind != "TAN":
            raise ValueError("undetermined: plane is for TAN images; choose none or mean")
        return self

    @property
    def taken_off(self) -> Literal["none", "mean", "plane"]:
        """The name of the pattern that is taken off the map of I."""
        return self.undetermined or ("plane" if self.kind == "TAN" else "mean")

    def observe(self, data: Data) -> None:
        """Lay out one grid for all observations, and count their samples."""
        super().observe(data)
        every = [(o.n_detectors * o.n_samples, o.n_samples) for o in data.observations]
        self._samples = sum(n for n, _ in every), sum(n for _, n in every)

    def check(self, data: Data) -> list[str]:
        """See `BinMap.check`. Raises PipelineError for a width that leaves samples outside, and for
        too few or too short baselines.
        """
        found = super().check(data)
        for observation in data.observations:
            self._length(observation)
        if self.width is not None and data.observations:
            self._need_all(MapLayout(self).outside(data.observations), self.label)
        return found

    def _length(self, observation: Observation) -> int:
        """Samples of a baseline. Raises PipelineError for too few or too short baselines."""
        length = max(round(self.baseline * observation.sample_rate), 1)
        number, place = -(-observation.n_samples // length), f"{self.label}, {observation.name}"
        if length < 2:
            raise PipelineError(
                f"a baseline of {self.baseline:g} s has one sample, at"
                f" {observation.sample_rate:g} Hz",
                place=place,
                cure=f"set baseline: {4 / observation.sample_rate:.2g} s, or longer",
            )
        if number < SHORTEST + self.trend:
            raise PipelineError(
                f"the scan has {number} baselines of {self.baseline:g} s, too few to find its noise"
                " from",
                place=place,
                cure=f"set a shorter baseline, of which a scan has {SHORTEST + self.trend} or more;"
                " or make the map with BinMap",
            )
        return length

    def _need_all(self, outside: float, place: str) -> None:
        if outside > MOST_OUTSIDE:
            raise PipelineError(
                f"{100 * outside:.2g} % of the samples are outside the map, and noise that"
                " detectors share cannot be told there",
                place=place,
                cure="leave width out, or make the map with BinMap",
            )

    def prepare(self, observation: Observation) -> LikelihoodScan:  # type: ignore[override]
        """Pixels and baselines of one observation, before its samples are read.

        Raises PipelineError where a window has changed the samples, for samples outside the map,
        and for too few or too short baselines.
        """
        place = f"{self.label}, {observation.name}"
        length = self._length(observation)
        if observation.window is not None:
            raise PipelineError(
                f"{' and '.join(observation.windows)} changed the weight of samples",
                place=place,
                cure="leave the window out: slow noise needs none here",
            )
        self._need_all(MapLayout(self).outside([observation], self.grid), place)
        prepared = super().prepare(observation)
        return LikelihoodScan(prepared, length, observation)

    def measure(self, stream: Stream, model: Any = None) -> LikelihoodScan:
        """Compress a scan and estimate its noise, in one reading."""
        scan: LikelihoodScan = stream.state
        scan.compress(stream, self.label)
        observation, white = stream.observation, scan.white(self.label)
        for _ in range(WHITE_LEVELS):
            scan.noise = estimate(
                scan.found.means,
                scan.found.counted,
                white,
                scan.length,
                observation.sample_rate,
                modes=self.modes,
                free=self.free,
                trend=self.trend,
            )
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
                place=f"{self.label}, {observation.name}",
                cure=f"put {type(self).__name__} before filters, or leave these out",
            )
        scan.give_weights(self._layout["variance"], self._spare)
        return scan

    def exec(self, block: Block, state: LikelihoodScan) -> None:  # type: ignore[override]
        """Add one block to the sums in pixels, baselines and free modes."""
        super().exec(block, state.prepared)
        state.add(block)

    def collect(  # type: ignore[override]
        self,
        data: Data,
        observation: Observation,
        state: LikelihoodScan,
    ) -> None:
        """Hand over sums in pixels, and the compressed scan."""
        super().collect(data, observation, state.prepared)
        data.partial[self.label].unknown_variance = False  # type: ignore[attr-defined]
        data.add(f"{self.label} scans", CompressedScans([state.compressed()]))
        log, noise = observation.log, state.noise
        lost = observation.n_samples % state.length
        if lost:
            log.state(self.label, "samples of the last baseline, which is shorter", str(lost))
        powers = ", ".join(f"{value:.3g}" for value in noise.values)
        log.state(self.label, "power of modes over white noise", powers or "no modes")

    def finalize(self, data: Data) -> None:
        """Solve for the map of each signal."""
        self._spare.clear()
        sums: MapSums | None = data.take(self.label)
        scans: CompressedScans | None = data.take(f"{self.label} scans")
        if sums is not None and scans is not None:
            LikelihoodMaps(self, self.grid, self._layout, sums, scans, data).finish(data)

    def _weights(self, observation: Observation) -> tuple[Weights, NDArray[np.bool_]]:
        """Equal weights, until `measure` knows those of the detectors."""
        equal = np.ones(observation.n_detectors)
        return Weights(equal, equal, np.zeros(0)), observation.good_samples


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
                "no detector is good", place=f"{place}, {observation.name}", cure="look at the log"
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

    def white(self, place: str) -> Floats:
        """(n,) variance of white noise; the median of the others for detectors without samples.

        Raises PipelineError where there is none. Warns of detectors that lack samples which others
        have.
        """
        observation, white = self.observation, np.asarray(self.found.scatter)
        place = f"{place}, {observation.name}"
        if np.isnan(white).all():
            raise PipelineError("no samples count", place=place, cure="look at the log")
        if (white <= 0).any():
            name = observation.focalplane.names[self.rows[np.flatnonzero(white <= 0)[0]]]
            raise PipelineError(
                f"detector {name} has no noise",
                place=place,
                cure="add WhiteNoise, or make the map with BinMap",
            )
        number = self.found.counted.sum(axis=1)
        less = (number > 0) & (number < 0.99 * number.max())
        if less.any():
            warnings.warn(
                f"{place}: {int(less.sum())} detectors lack up to"
                f" {100 * (1 - number[less].min() / number.max()):.2g} % of the samples that others"
                " have: what detectors share stays in the map there; fill these gaps, or flag these"
                " detectors",
                stacklevel=4,
            )
        return np.where(np.isnan(white), np.nanmedian(white), white)

    def give_weights(self, reference: float, spare: Any) -> None:
        """Weigh detectors by the white level that was found, in units of the inverse variance
        ``reference``, K^2.
        """
        observation, first = self.observation, self.prepared.halves[0][0]
        weight = np.ones(observation.n_detectors)
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
        scan: CompressedScan = self.found.scan(observation.sample_rate)
        self.found = scan
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
        scan, a = self.found, self.noise.free_modes
        for name, sums in self.baselines.items():
            y = sums / VALUE / np.maximum(scan.counted, 1)
            s = self.common[name] / (VALUE * self.scale)
            data[name] = (y, scan.about_means(s, y, a, self.nowhere))
        return Compressed(scan, self.noise, data)


@dataclass(frozen=True)
class LikelihoodMaps(MapFromSums):
    """Maps of the signals, from sums in pixels and compressed scans."""

    parameters: MaximumLikelihoodMap
    scans: CompressedScans
    data: Data

    def map_of(self, stream: str) -> MapProduct:
        """The map of a signal; its weights and its noise are those of white noise. Without filters
        it is the mean of the samples, of which the same is taken off.
        """
        product, equations = super().map_of(stream), self.equations
        mean = stream not in self.scans.scans[0].data
        if mean:
            rows = np.nan_to_num(product.planes["signal"].values)
            values = np.zeros((len(rows), self.grid.n_pixels))
            values[:, self._seen] = rows.reshape(len(rows), -1)
            signal = self._determined(values, equations, product)
            return replace(
                product.with_planes(signal=self._rows(product, signal)), taken_off=self._taken
            )
        solution = self._solved(equations, stream)
        planes = {
            "signal": self._rows(product, self._determined(solution.values, equations, product))
        }
        if self.halves:
            (one, first), (two, second) = (self._half(stream, k, product) for k in range(2))
            with np.errstate(divide="ignore", invalid="ignore"):
                share = np.sqrt(equations.spread / (first.spread + second.spread))
                values = np.where(
                    (first.spread > 0) & (second.spread > 0), (one - two) * share, np.nan
                )
            planes["half_difference"] = self._rows(product, values)
        if stream == MAIN:
            self._tell(solution)
        made = product.with_planes(**planes)
        return replace(made, noise_from="streams", taken_off=self._taken)

    @cached_property
    def equations(self) -> NormalEquations:
        """Normal equations of all scans, with the noise of data minus the map."""
        found = self._of([WeighedScan(one.scan, one.noise) for one in self.scans.scans])
        step = self.parameters
        for _ in range(step.refine):
            m = self._solved(found, self.sums.first).values
            scans = []
            for one, (scan, noise) in zip(self.scans.scans, found.scans, strict=True):
                y = one.data[self.sums.first][0] - scan.seen(m, np.zeros((0, len(noise.white))))[0]
                new = estimate(
                    y,
                    scan.counted,
                    noise.white,
                    scan.length,
                    scan.rate,
                    modes=step.modes,
                    free=step.free,
                    trend=step.trend,
                    fixed=noise.modes[: noise.free],
                )
                scans.append(WeighedScan(scan, new))
            found = self._of(scans)
        return found

    def _of(self, scans: Sequence[WeighedScan]) -> NormalEquations:
        n_stokes = 3 if self.sums.polarized else 1
        return NormalEquations(scans, n_stokes, self.grid.n_pixels, self.data.threads)

    def _solved(
        self,
        equations: NormalEquations,
        stream: str,
        half: int | None = None,
    ) -> Solution:
        """The solution for a signal, of all scans or of half of them."""
        binned = self.sums.in_pixels(stream, slice(None), half).data.T / VALUE
        scans = self.scans.scans if half is None else self.scans.scans[half::2]
        data = [one.data[stream] for one in scans]
        right = equations.right_side(binned / self.layout["variance"], data)
        return equations.solve(right, self.parameters.tolerance, MOST_ITERATIONS)

    def _half(self, stream: str, half: int, product: MapProduct) -> tuple[Floats, NormalEquations]:
        """The map of the even or odd scans, and their equations."""
        equations = self._of(self.equations.scans[half::2])
        values = self._solved(equations, stream, half).values
        return self._determined(values, equations, product), equations

    @property
    def _seen(self) -> Any:
        """Places of the pixels that the product has."""
        return self.grid.seen(self.sums.hits.any(axis=0))

    @property
    def _taken(self) -> str:
        """`taken_off`, as products state it."""
        return self.parameters.taken_off.removeprefix("none")

    def _determined(
        self,
        values: Floats,
        equations: NormalEquations,
        product: MapProduct,
    ) -> Floats:
        """A map without what the data hardly determine, as fitted to pixels with values."""
        values, weight = values.copy(), np.zeros(self.grid.n_pixels)
        weight[self._seen] = np.where(
            product.known, equations.weights[0][self._seen].reshape(product.hits.shape), 0.0
        ).ravel()
        if self.parameters.taken_off == "none":
            return values
        patterns = [np.ones(self.grid.n_pixels)]
        if self.parameters.taken_off == "plane":
            rows, columns = np.indices(self.grid.shape)
            patterns += [rows.ravel() - rows.mean(), columns.ravel() - columns.mean()]
        basis = np.array(patterns) * np.sqrt(weight)
        matrix = np.einsum("ip,jp->ij", basis, basis)
        right = np.einsum("ip,p->i", basis, values[0] * np.sqrt(weight))
        values[0] -= np.einsum("i,ip->p", np.linalg.lstsq(matrix, right)[0], np.array(patterns))
        return values

    def _rows(self, product: MapProduct, values: Floats) -> Floats:
        """Rows in the shape of the map, NaN where there is no value."""
        shaped = values[:, self._seen].reshape(len(values), *product.hits.shape)
        return np.where(product.known, shaped, np.nan)

    def _tell(self, solution: Solution) -> None:
        """Log how the solution was found."""
        log, label, step = self.data.log, self.parameters.label, self.parameters
        log.state(label, "iterations", str(len(solution.history)))
        if solution.history:
            least = min(solution.history)
            log.state(label, "residual over right side", f"{least:.1e}")
            log.state(label, "smallest Ritz value", f"{solution.ritz[0]:.1e}")
            if least >= step.tolerance:
                warnings.warn(
                    f"{label}: after {len(solution.history)} iterations the residual is"
                    f" {least:.1e} of the right side, not {step.tolerance:g}",
                    stacklevel=4,
                )
        if step.taken_off != "none":
            log.state(label, "taken off the map of I", f"its weighted {step.taken_off}")
        log.state(label, "noise of a pixel", "white noise alone, as found in the streams")
