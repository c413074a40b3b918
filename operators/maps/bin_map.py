"""Averages samples into pixels.

    m_p = sum_i w_i d_i / sum_i w_i over the samples i in pixel p                                        (1)

The sums are kept in fixed point (`sums`), so that they are exact; each sample is rounded to 2^-36 K (1.5e-11 K).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, field_validator, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle
from zonda.core.data import Block, Data, Observation, percent
from zonda.core.errors import InputError, PipelineError
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.chunks import empty
from zonda.core.numerics.projection import pixel_matrix, share_outside
from zonda.core.numerics.tiles import TILE_SAMPLES
from zonda.core.operator import Operator

from .grid import MOST_PIXELS, Grid, HealpixGrid, TangentGrid, covered_healpix, covering_extent, in_frame
from .sums import (
    DATA,
    FLAGGED,
    HITS,
    NOISE,
    NOT_FINITE,
    OUTSIDE,
    TOO_LARGE,
    VALUE,
    WEIGHT,
    WEIGHTS,
    Binning,
    Halves,
    Sums,
    add_image,
    add_list,
)

STRETCH = 1 << 15
"""Pixels whose maps are made at a time: what is only used for a moment stays in the cache."""


class _Requires:
    """What a `BinMap` reads: no signal where only the hits are wanted."""

    def __get__(self, operator: BinMap | None, owner: type) -> frozenset[str]:
        return frozenset({"boresight"} if operator is not None and operator.contents == "hits" else {"signal", "boresight"})


WIDEST_SMOOTH = 0.1
"""FWHM of a map's smoothing, rad."""
NO_WHITE = "what the detectors' NET would make; this run has no white noise"
"""Said of the noise that the map of such a run states."""


class BinMap(Operator):
    """Average the samples in each pixel, equation (1), into a FITS image (TAN) or a HEALPix map."""

    requires: ClassVar[Any] = _Requires()
    provides: ClassVar[frozenset[str]] = frozenset({"map"})
    knows_means: ClassVar[bool] = True
    prepares_ahead: ClassVar[bool] = True
    product_only: ClassVar[bool] = True

    pixel: Angle = quantity("2 arcsec", gt=0)
    """Side of a pixel."""
    width: Angle | None = Field(None, gt=0)
    """Width of the map; where absent, it covers the scans."""
    height: Angle | None = Field(None, gt=0)
    """Height of the map; where absent, the width if that is given, else it covers the scans."""
    centre: Target | None = None
    """Centre of the map; where absent, the first scan's target."""
    projection: Literal["TAN"] = "TAN"
    """Projection of the image."""
    frame: Literal["icrs", "galactic"] = "icrs"
    """Celestial frame of the map."""
    nside: int | None = Field(None, ge=1, le=2**20)
    """Make a HEALPix map of this resolution (a power of two) instead of an image."""
    ordering: Literal["ring", "nested"] = "ring"
    """HEALPix pixel order."""
    weights: Literal["uniform", "inverse_variance"] = "inverse_variance"
    """Weigh samples alike, or by the inverse variance that follows from each detector's NET."""
    noise: Literal["net", "scatter"] = "net"
    """Noise of each pixel: from the detectors' NET, or from the scatter of its samples. From the NET also in a run without white
    noise; the tally then says so."""
    contents: Literal["all", "hits"] = "all"
    """`hits`: count the samples in each pixel, no more; a plan then simulates no signal at all."""
    half_difference: bool = True
    """Keep even and odd scans apart and make a noise map of their difference (needs two scans)."""
    smooth: Angle | Literal["beam"] | None = None
    """Smooth the map with a Gaussian of this FWHM, or with the instrument's beam; the resolution is then that of both, added in
    quadrature."""
    product: str = Field("map", pattern=r"^[A-Za-z0-9_]+$")
    """Name of the map among the products."""

    _grid: Grid | None = PrivateAttr(None)
    _variance: float = PrivateAttr(1.0)
    _fwhm: float = PrivateAttr(0.0)
    _variance_unknown: bool = PrivateAttr(False)
    _middle: tuple[float, float] = PrivateAttr((0.0, 0.0))
    _spare: list[Sums] = PrivateAttr(default_factory=list)

    @field_validator("nside")
    @classmethod
    def _power_of_two(cls, value: int | None) -> int | None:
        if value is not None and value & (value - 1):
            raise ValueError(f"nside must be a power of two, got {value}")
        return value

    @field_validator("centre")
    @classmethod
    def _on_the_sky(cls, value: Target | None) -> Target | None:
        if value is not None and value.frame == "horizontal":
            raise ValueError("the centre of a map must be fixed on the sky; give ICRS or galactic coordinates")
        return value

    @field_validator("smooth")
    @classmethod
    def _positive(cls, value: float | str | None) -> float | str | None:
        if isinstance(value, float) and value <= 0:
            raise ValueError("smooth must be positive; leave it out for no smoothing")
        if isinstance(value, float) and value > WIDEST_SMOOTH:
            raise ValueError(f"smooth must be at most {WIDEST_SMOOTH:g} rad (5.7 deg): the kernel would be wider than any map")
        return value

    @model_validator(mode="after")
    def _one_grid(self) -> BinMap:
        image_only = {"pixel", "width", "height", "centre", "projection"} & self.model_fields_set
        if self.nside is not None and image_only:
            raise ValueError(f"{sorted(image_only)[0]} belongs to an image, nside to a HEALPix map; give one of them")
        if self.nside is None and "ordering" in self.model_fields_set:
            raise ValueError("ordering belongs to a HEALPix map; give nside too")
        return self

    def check(self, data: Data) -> list[str]:
        """The share of the samples outside a map of a given width."""
        if self.width is None or not data.observations:
            return []
        middle = in_frame(self.centre.icrs() if self.centre else data.observations[0].centre, self.frame)
        self._middle = (float(middle[0]), float(middle[1]))
        grid = self._image((0.0, 0.0))
        scans = ((o.boresight_radec, o.focalplane.xi, o.focalplane.eta) for o in data.observations)
        return [f"samples outside the map: about {percent(share_outside(scans, pixel_matrix(grid.wcs), grid.shape), 2)}"]

    def observe(self, data: Data) -> None:
        """Lay out one grid for all observations."""
        layout = self.agree(data)
        if layout is not None:
            self.lay_out(layout)

    def agree(self, data: Data, before: Mapping[str, Any] | None = None) -> Mapping[str, Any] | None:
        """Centre, extent and units of the sums: of the first observation, and wide enough for all."""
        if not data.observations:
            return before
        first = data.observations[0]
        instrument = first.instrument
        if before is None:
            levels = first.expected_net() if self.contents == "all" else first.focalplane.net
            # weights about 1 and below: a sample's weight times its value, mean emission included, must fit the sums
            net = float(max(levels.min(), np.median(levels) / 4)) or instrument.net
            found: dict[str, Any] = {
                "variance": 2.0 ** round(math.log2(net**2 * first.sample_rate)) if net > 0 else 2.0**-12,
                "fwhm": instrument.beam_fwhm,
                "frequency": instrument.band.centre,
                "middle": [float(x) for x in in_frame(self.centre.icrs() if self.centre else first.centre, self.frame)],
                "fixed": self.nside is None and self.width is not None,
            }
        else:
            found = dict(before)
            if not math.isclose(found["frequency"], instrument.band.centre, rel_tol=1e-6):
                raise PipelineError(
                    f"maps at {found['frequency'] / 1e9:.4g} GHz and {instrument.band.centre / 1e9:.4g} GHz cannot be added up",
                    place=self.label,
                    cure="leave the axis over which the band changes out of campaign.combine",
                )
        if self.nside:
            nest = self.ordering == "nested"
            pixels = covered_healpix(data.observations, self.nside, nest, self.frame)
            found["pixels"] = np.union1d(found["pixels"], pixels) if "pixels" in found else pixels
        elif not found["fixed"]:
            longitude, latitude = found["middle"]
            reach = covering_extent(data.observations, (longitude, latitude), self.frame)
            half = found.get("half", (0.0, 0.0))
            found["half"] = [max(half[0], reach[0]), max(half[1], reach[1])]
        return found

    def lay_out(self, layout: Mapping[str, Any]) -> None:
        """Make the grid."""
        longitude, latitude = layout["middle"]
        self._variance, self._fwhm, self._middle = layout["variance"], layout["fwhm"], (longitude, latitude)
        if self.nside:
            self._grid = HealpixGrid(self.nside, self.ordering == "nested", np.asarray(layout["pixels"], np.int64), self.frame)
        else:
            self._grid = self._image(layout.get("half", (0.0, 0.0)))

    def _image(self, half: Sequence[float]) -> TangentGrid:
        width, height = self.width, self.height if self.height is not None else self.width
        width = width if width is not None else 2 * half[0] + 2 * self.pixel
        height = height if height is not None else 2 * half[1] + 2 * self.pixel
        nx, ny = (max(1, math.ceil(side / self.pixel - 1e-6)) for side in (width, height))
        if nx * ny > MOST_PIXELS:
            raise InputError(
                f"a map of {nx} x {ny} pixels is too large", place=self.label, cure="choose larger pixels or a smaller width"
            )
        return TangentGrid(self._middle, self.pixel, (ny, nx), self.frame)

    def prepare(self, observation: Observation) -> Binning:
        """Pointing, weights and empty sums for one observation."""
        if self._grid is None:
            raise PipelineError("no grid: observe() was not called", place=self.label, cure="run it in a Pipeline")
        usable, net = observation.good_detectors, observation.focalplane.net.copy()
        net[~usable] = net[usable][0] if usable.any() else 1.0  # they weigh nothing, whatever their noise
        variance = net**2 * observation.sample_rate / self._variance  # of one sample, in reference units
        weight = np.ones(len(net))
        if self.weights == "inverse_variance" and self.contents == "all":
            if (net > 0).all():
                weight = 1 / variance
            elif (net != net[0]).any():
                bad = observation.focalplane.names[int(np.flatnonzero(net <= 0)[0])]
                raise PipelineError(
                    f"detector {bad} has NET 0, which has no inverse variance", place=self.label, cure="set weights: uniform"
                )
            else:
                self._variance_unknown = True
        weight = np.rint(weight * WEIGHT) / WEIGHT  # so that the sums of w d and of w use the same w
        if weight.max(initial=0.0) > 2.0**20 or weight.min(initial=1.0) < 2.0**-20:
            spread = net.max() > 1000 * net.min()
            much = "the detectors' NETs differ by more than a factor of 1000"
            far = "the NET is more than 1000 times larger or smaller than that of the first scan"
            raise PipelineError(much if spread else far, place=self.label, cure="set weights: uniform")
        if "white" not in observation.components and self.noise == "net" and self.contents == "all":
            observation.tally.state(self.label, "noise of a pixel", NO_WHITE)
        noise = weight**2 * variance
        alike = self.noise == "net" and bool((weight == weight[0]).all() and (noise == noise[0]).all())
        good = observation.good_samples.astype(np.uint8)
        return Binning(self._grid, self._grid.pointing(observation), good, weight, noise, alike, self._spare)

    def exec(self, block: Block, state: Binning) -> None:
        """Add one block to this thread's sums."""
        sums, dropped, largest = state.of_thread()
        plane, observation = block.observation.focalplane, block.observation
        if self.contents == "hits":
            signal = block.buffer("nothing", block.shape)
            signal.fill(0)
        else:
            signal = block.total("signal") if "signal" in block.means else block.detdata["signal"]
            signal = state.without_kept_out(signal, block.detectors, block.samples)
        before = int(dropped[NOT_FINITE])
        begin, end, rows = block.samples.start, block.samples.stop, block.detectors
        xi, eta, use = plane.xi[rows], plane.eta[rows], observation.good_detectors[rows]
        how = (
            use, state.good[begin:end], state.weight[rows], state.noise[rows], self.noise == "scatter", 1 / self._variance,
            sums, dropped, largest,
        )  # fmt: skip
        if isinstance(state.grid, TangentGrid):
            add_image(signal, state.pointing, begin, xi, eta, *state.grid.shape, *how)
        else:
            for start in range(begin, end, TILE_SAMPLES):
                stop = min(start + TILE_SAMPLES, end)
                index = np.empty((len(xi), stop - start), np.int32)
                state.grid.pixels(state.pointing, start, stop, xi, eta, index)
                add_list(signal, start - begin, index, *how)
        if dropped[NOT_FINITE] > before:
            state.note_not_finite(signal, rows, begin)

    def keep_out(self, observation: Observation, state: Binning) -> NDArray[np.int64] | None:
        """Where samples were not finite: rows of (detector, first sample, end)."""
        return np.concatenate(state.not_finite) if state.not_finite else None

    def leave_out(self, state: Binning, kept_out: NDArray[np.int64]) -> None:
        """Drop what was not finite in the main run."""
        state.kept_out = kept_out

    def collect(self, data: Data, observation: Observation, state: Binning) -> None:
        """Add this observation to the even or the odd scans' sums."""
        key = data.product(f"{self.label} sums")
        if key not in data.products:
            data.products[key] = Halves(self.n_pixels)
        binned, dropped = data.products[key].add(observation, state, self.label)
        tally = observation.tally
        every = observation.n_detectors * observation.n_samples
        tally.count(self.label, "samples binned", binned, every)
        for what, number in (("outside the map", OUTSIDE), ("flagged", FLAGGED), ("not finite", NOT_FINITE)):
            tally.count(self.label, f"samples dropped: {what}", int(dropped[number]), every)
        if dropped[TOO_LARGE]:
            raise PipelineError(
                f"{int(dropped[TOO_LARGE])} samples are too large for the map's fixed-point sums",
                place=f"{self.label}, {observation.name}",
                cure="look for the operator that makes them; a signal is below 1e4 K",
            )

    def pack(self, data: Data, first: bool) -> Mapping[str, Any] | None:
        """The sums, of pixels with hits only."""
        halves: Halves | None = data.products.pop(data.product(f"{self.label} sums"), None)
        if halves is None:
            return None
        return {**halves.packed(), "variance_unknown": self._variance_unknown}

    def merge(self, data: Data, part: Mapping[str, Any]) -> None:
        """Add sums: exact, so that their order does not matter but for which scans are even."""
        key = data.product(f"{self.label} sums")
        if key not in data.products:
            data.products[key] = Halves(self.n_pixels)
        data.products[key].merge(part, self.label)
        self._variance_unknown |= bool(part["variance_unknown"])

    def subtract(self, whole: Mapping[str, Any], parts: Sequence[Mapping[str, Any]]) -> Mapping[str, Any] | None:
        """The sums of w d, exactly; hits, weights and the noise from the detectors' NET are the main run's. None where the same
        samples are not in all maps, or the noise is that of the samples' scatter."""
        if self.noise == "scatter":
            return None
        found = dict(whole)
        for k in range(2):
            sums = whole[f"sums_{k}"].copy()
            for part in parts:
                if not np.array_equal(part[f"pixels_{k}"], whole[f"pixels_{k}"]):
                    return None
                if not np.array_equal(part[f"sums_{k}"][:, HITS:], whole[f"sums_{k}"][:, HITS:]):
                    return None
                sums[:, DATA] -= part[f"sums_{k}"][:, DATA]
            found[f"sums_{k}"] = sums
        largest = np.array([whole["largest"], *(part["largest"] for part in parts)])
        found["largest"] = np.maximum(largest.sum(axis=0) * (np.arange(largest.shape[1]) == DATA), largest.max(axis=0))
        return found

    @property
    def can_subtract(self) -> bool:
        """Not where the noise is that of the samples' scatter, which is not linear."""
        return self.noise == "net"

    @property
    def n_pixels(self) -> int:
        """Pixels of the grid that `observe` made."""
        assert self._grid is not None
        return self._grid.n_pixels

    def finalize(self, data: Data) -> None:
        """Turn the sums into ``data.products[data.product(product)]``, a `MapProduct`."""
        self._spare.clear()
        halves = data.products.pop(data.product(f"{self.label} sums"), None)
        if halves is None:
            return
        key = data.product(self.product)
        if key in data.products:
            raise PipelineError(
                f"two steps make the product {self.product!r}", place=self.label, cure="give one of them another product name"
            )
        product = self._product_of(halves)
        if self.noise == "scatter":
            alone = int(np.count_nonzero(product.hits == 1))
            data.tally.count(self.label, "pixels with one sample, whose scatter is unknown: noise NaN", alone)
            equal = int(np.count_nonzero((product.hits > 1) & (product.noise == 0)))
            data.tally.count(self.label, "pixels whose samples scatter by less than rounding: noise 0", equal)
            if self.smooth is not None:
                data.tally.count(self.label, "of them left out of the smoothed noise, which is too low around them", alone)
        if self.weights == "inverse_variance" and self._variance_unknown:
            data.tally.state(self.label, "weights", "uniform: every NET is 0")
        if self.smooth is not None:
            product = product.smoothed(self._fwhm if self.smooth == "beam" else float(self.smooth))
        data.products[key] = product
        data.tally.state(self.label, "fixed-point step of the sums", f"{1 / VALUE:.1e} K per sample")
        if self.half_difference and len(halves.scans) < 2:
            data.tally.state(self.label, "half-difference", "not made: it needs two scans")

    def _product_of(self, halves: Halves) -> MapProduct:
        grid = self._grid
        assert grid is not None
        n, unit = grid.n_pixels, self._variance if self.weights == "inverse_variance" else 1.0
        hits, signal, weight, noise = (empty((n, 1), kind).reshape(n) for kind in (np.int64, float, float, float))
        half = (
            empty((n, 1), float).reshape(n)
            if self.half_difference and len(halves.scans) >= 2 and self.contents == "all"
            else None
        )
        for start in range(0, n, STRETCH):
            part = slice(start, start + STRETCH)
            total = halves.total(part)
            hits[part] = total[:, HITS]
            if self.contents == "hits":
                signal[part], noise[part], weight[part] = np.nan, np.nan, hits[part] / unit
                continue
            signal[part], w = _mean(total)
            weight[part], noise[part] = w / unit, self._noise_of(total, signal[part], w)
            if half is not None:
                (even, w_even), (odd, w_odd) = _mean(halves.sums[0, part]), _mean(halves.sums[1, part])
                with np.errstate(invalid="ignore", divide="ignore"):
                    half[part] = (even - odd) * np.sqrt(w_even * w_odd) / (w_even + w_odd)
        shape = grid.shape if isinstance(grid, TangentGrid) else (grid.n_pixels,)
        arrays: list[NDArray[Any]] = [signal, hits, weight, noise] + ([half] if half is not None else [])
        keep = slice(None) if isinstance(grid, TangentGrid) else hits > 0
        arrays = [a[keep].reshape(shape if isinstance(grid, TangentGrid) else -1) for a in arrays]
        common: dict[str, Any] = {
            "frame": self.frame, "weighting": self.weights, "noise_from": self.noise, "fwhm": self._fwhm, "scans": halves.scans,
            "centre": self._middle, "half_difference": arrays[4] if half is not None else None, "contents": self.contents,
            "sample_rate": min(halves.rates) if len(halves.rates) == 1 else 0.0,
        }  # fmt: skip
        if isinstance(grid, TangentGrid):
            header = grid.wcs.to_header(relax=True)
            return MapProduct(arrays[0], arrays[1], arrays[2], arrays[3], header=header, pixel=grid.pixel, **common)
        size = math.sqrt(4 * math.pi / (12 * grid.nside**2))
        return MapProduct(
            arrays[0], arrays[1], arrays[2], arrays[3], header=None, pixel=size, nside=grid.nside, nest=grid.nest,
            pixels=grid.pixels_covered[keep], **common,
        )  # fmt: skip

    def _noise_of(self, total: Sums, signal: NDArray[np.float64], weight: NDArray[np.float64]) -> NDArray[np.float64]:
        """Standard deviation of each pixel's mean."""
        term = total[:, NOISE] / WEIGHT * self._variance
        hits = total[:, HITS]
        with np.errstate(invalid="ignore", divide="ignore"):
            if self.noise == "net":
                return np.where(hits > 0, np.sqrt(term) / weight, np.nan)
            # equal samples leave the rounding of their squares, of either sign: a scatter below it is counted, and 0
            scatter = np.maximum(term / weight - signal**2, 0.0)
            return np.where(hits > 1, np.sqrt(scatter / (hits - 1)), np.nan)


def _mean(sums: Sums) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """(signal, weight) of fixed-point sums (n_pixel, 4); NaN where there are no hits."""
    weight = sums[:, WEIGHTS] / WEIGHT
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(sums[:, HITS] > 0, sums[:, DATA] / VALUE / weight, np.nan), weight
