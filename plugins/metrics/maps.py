"""Figures of maps: equations (1) to (10).

With the map m, its weights w and the angle r of a pixel from the map's centre, after smoothing with
the beam:

    central_rms      sqrt( sum w m^2 / sum w ),
    r <= radius                                             (1)
    peak_ratio       p(b) / p(a)                                                                 (2)
    peak_snr         max |m| / s,   s = n f,
    f = rms(noise map) / rms(n) within the radius              (3)
    coverage         median of hits x (seconds per sample and beam),
    r <= radius                        (4)
                     or the solid angle of the pixels with at least a share of it                (5)

p is the extreme value over pixels with at least `COVERED` of the usual samples: of a, the sky alone
without filters, the one of largest absolute value; of b, the sky alone behind the filters, the one
of the same sign. n is the standard deviation by NET and samples; a noise map with the factor f
takes what 1/f noise and the atmosphere add into account.

With a the map of the sky alone without filters, b the same behind them, and the ring of wavenumbers
|ln(k scale)| <= width / 2 under the window of `TransferFunction`, ``transfer_at`` is T or S:

    T = Re sum b a* / sum |a|^2,
    S = (sum |b|^2 / sum |a|^2)^(1/2).                                                           (6)

With a reference A, a map B and the threshold t of `CompareMaps`,

    fidelity    median of F = |A| / max(|B - A|, t rms(B - A)),
    |A| >= least max |A|                        (7)

With the power P_i of a map's rings i, their independent modes N_i, and the level W_i of white noise
in independent pixels,

    map_power   sum N_i P_i / sum N_i W_i,   smallest <= 1/k_i <= largest      (8)

    relative error   (sum N_i W_i^2)^1/2 / sum N_i W_i,
    of smoothed maps from draws of noise (radial)         (9)

With the matrix A = P^T Q P of a maximum-likelihood map and a signal t without noise,

    template_snr     (t^T A t)^1/2,   or the amplitude of t in the map m
                     (A t)^T m / t^T A t, to within (t^T A t)^-1/2                              (10)
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, Literal, Self

import numpy as np
from pydantic import Field, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, Fraction
from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.figures import FigureMetric
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.noise_figures import matched
from zonda.core.maps.planes import WHITE, central_diameter
from zonda.core.numerics.sphere import ARCMIN, angle_text
from zonda.core.signal import Signal
from zonda.core.types import Floats
from zonda.operators.diagnostics.comparison.statistics import Comparison
from zonda.operators.diagnostics.map_spectra import MapSpectra
from zonda.operators.diagnostics.transfer_function import compare, window_of

from .common import (
    as_seen,
    at_beam,
    covered,
    extreme,
    input_of,
    map_of,
    needs_signal,
    needs_tan,
    product_of,
    relative_error_of_rms,
    sky_alone,
)


class Fidelity(FigureMetric):
    """Median fidelity of a map where its reference is bright, equation (7).

    It is measured by a `CompareMaps`. Of a map that is g times its reference everywhere it is 1 /
    |1 - g|, below the limit that the threshold sets.
    """

    reads = frozenset({"comparison"})

    comparison: str = Field("comparison", pattern=r"^[A-Za-z0-9_.]+$")
    """Which one, by its name among the products: that of a `CompareMaps` with a name of its own."""
    least: Fraction = quantity("10 %", gt=0, le=1)
    """Share of the reference's peak from which a pixel counts; 100 %: the peak alone."""

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (7). Raises InputError where there is no comparison, or the reference is
        empty.
        """
        found = product_of(data, self.comparison, Comparison, "fidelity", "comparison, CompareMaps")
        size = np.abs(found.planes["reference"])
        peak = float(np.nanmax(size, initial=0.0))
        if peak == 0:
            raise InputError(
                "the reference is empty",
                place="fidelity",
                cure="compare with a sky with a source",
            )
        return float(np.median(found.planes["fidelity"][size >= self.least * peak])), math.nan

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        where = f"where the reference has {100 * self.least:g} % of its peak"
        if self.least == 1:
            where = "at the reference's peak"
        return f"median of |reference| / max(|difference|, threshold) {where}"


class MapPower(FigureMetric):
    """Power spectral density of a map over that of white noise in its pixels, in a range of angular
    scales, equation (8).

    It is measured by a `MapSpectrum`. White noise has 1 on all scales; 1/f noise and the atmosphere
    add on large ones.
    """

    reads = frozenset({"map_spectra"})

    spectra: str = Field("map_spectra", pattern=r"^[A-Za-z0-9_.]+$")
    """Which ones, by their name among the products: that of a `MapSpectrum` with a name of its own.
    """
    of: str = Field("source_free/map", pattern=r"^[A-Za-z0-9_/]+$")
    """Which map."""
    smallest: Angle = quantity("10 arcsec", gt=0)
    """Smallest angular scale, 1/k."""
    largest: Angle = quantity("20 arcsec", gt=0)
    """Largest angular scale."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.largest <= self.smallest:
            raise ValueError("largest must be larger than smallest")
        return self

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (8). Raises InputError where the map, its white level or modes of these scales
        are missing.
        """
        found = product_of(
            data,
            self.spectra,
            MapSpectra,
            "map_power",
            "product of map spectra, MapSpectrum",
        )
        rings = found.spectra
        if self.of not in rings.power or self.of not in rings.white:
            there = ", ".join(sorted(rings.power.keys() & rings.white.keys())) or "none"
            raise InputError(
                f"no spectrum and white level of the map {self.of!r} are known",
                place="map_power",
                cure=f"maps with a known level: {there}; name others in MapSpectrum.maps",
            )
        power = rings.power[self.of]
        level = rings.white[self.of]
        used = (rings.scale >= self.smallest) & (rings.scale <= self.largest) & np.isfinite(power)
        number = rings.modes[used]
        power = power[used]
        level = level[used]
        if not number.sum() > 0:
            cure = "choose scales between two pixels and the map's size, or a wider range"
            raise InputError(f"no ring lies {self._range()}", place="map_power", cure=cure)
        value = float(number @ power) / float(number @ level)
        if rings.draws is not None:
            together = rings.draws[:, used] @ (number * level)
            return value, value * float(together.std(ddof=1) / together.mean())
        return value, value * math.sqrt(float(number @ level**2)) / float(number @ level)

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        white = "that of white noise by NET and samples"
        return f"power of {self.of} over {white}, scales {self._range()}"

    def _range(self) -> str:
        return f"from {angle_text(self.smallest)} to {angle_text(self.largest)}"


class TransferAt(FigureMetric):
    """Share of the sky that the filters leave at one angular scale, equation (6). A claim about it
    must state its window.
    """

    scale: Angle = quantity("60 arcsec", gt=0)
    """Angular scale 1/k."""
    width: float = Field(0.5, gt=0, le=3)
    """Width of the ring in ln k."""
    kind: Literal["in_phase", "amplitude"] = "in_phase"
    """T, the share that is left in phase; or S, the definition of the paper, which counts what
    comes from elsewhere, too.
    """
    modes: Literal["sky", "full"] = "sky"
    """Singular modes of the sky alone, or of the complete data."""
    radius: Angle | None = Field(None, gt=0)
    """Window: use only what lies this near to the map's centre."""
    taper: Angle | None = Field(None, gt=0)
    """Width of the window's cosine edge; where absent, it reaches to the middle."""
    least_coverage: float = Field(0.1, ge=0, lt=1)
    """Where the samples per pixel are below this share of their 99th percentile, the window is
    zero.
    """
    map: str = Field("map", pattern=r"^[A-Za-z0-9_]+$")
    """Which map, by its name among the products."""

    def needs(self) -> tuple[Signal, ...]:
        """The sky alone, with filters and without."""
        return sky_alone(self.modes)

    def named_signals(self) -> tuple[str, ...]:
        """No signals but those of `needs`."""
        return ()

    def look(self, kinds: Mapping[str, str]) -> None:
        """A TAN map of the signal."""
        needs_signal(kinds, "transfer_at", self.map)
        needs_tan(kinds.get(self.map, "TAN"), "transfer_at")

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (6); the standard error is that from the scatter of the ring's modes, for T
        alone.
        """
        after, before = (map_of(data, "transfer_at", name, self.map) for name in names)
        needs_tan(before.projection, "transfer_at")
        window = window_of(before, self.radius, self.taper, self.least_coverage)
        edges = np.exp(np.array([-0.5, 0.5]) * self.width) / self.scale
        rings = compare(before.signal, after.signal, window, before.pixel, edges)
        value = float((rings.transfer if self.kind == "in_phase" else rings.amplitude)[0])
        if not math.isfinite(value):
            cure = "choose a scale between two pixels and the window's diameter, or a larger width"
            raise InputError(
                f"no mode of {angle_text(self.scale)} has power in the window",
                place="transfer_at",
                cure=cure,
            )
        return value, float(rings.error[0]) if self.kind == "in_phase" else math.nan

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        window = (
            f"window within {angle_text(self.radius)}" if self.radius else "window of the coverage"
        )
        what = "share left in phase" if self.kind == "in_phase" else "root of the ratio of power"
        ring = f"transfer function at {angle_text(self.scale)}, ring of {self.width:g} in ln k"
        return f"{ring}: {what}, {window}, modes: {self.modes}"


Smoothing = Annotated[Angle, Field(ge=0, le=0.1)] | Literal["beam", "none"]
NAME = r"^[A-Za-z0-9_]+$"


class _OfMap(FigureMetric):
    """A figure of one map."""

    map: str = Field("map", pattern=NAME)
    """Which map, by its name among the products."""


class _OfSmoothMap(_OfMap):
    """A figure of one smoothed map."""

    smooth: Smoothing = Field("beam", examples=["9 arcsec"])
    """Smooth a map that is not smoothed yet: with the beam, with a Gaussian of this FWHM, or not.
    """

    def look(self, kinds: Mapping[str, str]) -> None:
        """A map of the signal."""
        needs_signal(kinds, self.own_name(), self.map)

    def smoothed(self, product: MapProduct) -> MapProduct:
        """The map as it is judged."""
        width: Any = {"beam": None, "none": 0.0}.get(str(self.smooth), self.smooth)
        return at_beam(product, width)

    def how(self) -> str:
        """The smoothing in words."""
        if isinstance(self.smooth, str):
            return {"beam": "smoothed with the beam", "none": "not smoothed"}[self.smooth]
        return f"smoothed with a Gaussian of FWHM {angle_text(self.smooth)}"


class CentralRms(_OfSmoothMap):
    """Weighted rms of the smoothed map about zero, near the map's centre, equation (7).

    The standard error is that of white noise in the pixels, which the smoothing correlates.
    """

    radius: Angle = quantity("1 arcmin", gt=0)
    """Pixels whose centres are this near to the map's centre count. (`Report` and `Plots` state a
    diameter.)
    """
    signal: str = Field("", pattern=r"^[A-Za-z0-9_]*$")
    """Of which signal of the pipeline, e.g. source_free; empty: the complete one."""
    of: Literal["signal", "half_difference"] = "signal"
    """The map itself, or half the difference of two halves of its samples
    (`BinMap.half_difference`).
    """

    @property
    def unit(self) -> str:
        """Unit of a brightness."""
        return "K_RJ"

    def named_signals(self) -> tuple[str, ...]:
        """The one that is chosen."""
        return (self.signal,)

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Rms of the map about its centre, equation (7), and its error."""
        product = map_of(data, "central_rms", self.signal, self.map)
        return central_rms(self.smoothed(product), self.radius, self.of)

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        what = self.signal or "the map"
        if self.of == "half_difference":
            product = map_of(data, "central_rms", self.signal, self.map)
            what = f"half the difference, {product.difference},"
        return f"rms of {what} within {angle_text(self.radius)} of the centre, {self.how()}"


def central_rms(
    product: MapProduct,
    radius: float,
    of: Literal["signal", "half_difference"] = "signal",
) -> tuple[float, float]:
    """Equation (7) of a map as it is, within ``radius`` [rad], and its standard error. InputError
    where no pixel is there.
    """
    value = product.rms(radius, of)
    near = product.distance() <= radius
    if not math.isfinite(value):
        raise InputError(
            f"no pixel has a value within {angle_text(radius)} of the centre",
            place="central_rms",
            cure="choose a larger radius",
        )
    return value, value * relative_error_of_rms(product, near)


class PeakRatio(_OfSmoothMap):
    """Extreme value of the sky alone behind the filters, divided by that without filters, equation
    (2).

    Without filters is the map of the same samples (beam, pixels and coverage are in both), or the
    input map convolved with the beam. It depends on the size of the source: a larger one loses
    more.
    """

    against: Literal["unfiltered", "input"] = "unfiltered"
    """Divide by the map without filters, or by the input map convolved with the beam."""
    modes: Literal["sky", "full"] = "sky"
    """Singular modes of the sky alone (the paper's noiseless map), or of the complete data."""

    def needs(self) -> tuple[Signal, ...]:
        """The sky alone, with filters and without."""
        return sky_alone(self.modes)[: 2 if self.against == "unfiltered" else 1]

    def named_signals(self) -> tuple[str, ...]:
        """No signals but those of `needs`."""
        return ()

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Peak of the source left by filters, equation (8), and its error."""
        after = map_of(data, "peak_ratio", names[0], self.map)
        seen = self.smoothed(after)
        if self.against == "unfiltered":
            before = self.smoothed(map_of(data, "peak_ratio", names[1], self.map)).signal
        else:
            before = without_filters(input_of(data, "peak_ratio"), after, seen.smoothed_by)
        return peak_ratio(before, seen), math.nan

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        other = "the input convolved with the beam"
        if self.against == "unfiltered":
            other = "the map without filters"
        what = f"extreme value of the filtered sky / that of {other}"
        return f"{what}, both {self.how()}, modes: {self.modes}"


def without_filters(image: Image, product: MapProduct, smoothing: float) -> Floats:
    """The input behind the beam in the pixels of a map, smoothed (FWHM [rad]) with the map's own
    weights, as the map is.
    """
    plain = product if product.polarization is None else product.stokes("I")
    signal = as_seen(image, plain)
    seen = replace(plain, smoothed_by=0.0).with_planes(signal=signal, half_difference=None)
    return (seen.smoothed(smoothing) if smoothing > 0 else seen).signal


def peak_ratio(before: Floats, after: MapProduct) -> float:
    """Equation (8) of a brightness without filters, in the pixels of the map behind them."""
    good = covered(after) & np.isfinite(before)
    _, peak = extreme(before, good, "peak_ratio")
    if peak == 0:
        raise InputError("the sky is empty", place="peak_ratio", cure="use a sky with a source")
    same_sign = np.sign(peak) * after.signal
    return float(np.max(same_sign[good])) / abs(peak)


class PeakSnr(_OfSmoothMap):
    """Largest ratio of the smoothed map to its noise, over pixels with enough samples, equation
    (3).
    """

    noise: Literal["source_free", "half_difference", "white"] = "source_free"
    """What scales the noise: the map of everything but the sky (with the modes of the complete
    data), half the difference of even and odd scans, or nothing: white noise by NET and samples."""
    radius: Angle | None = Field(None, gt=0, examples=["1 arcmin"])
    """Where the noise map is compared with the white noise: this near to the map's centre. Default:
    1 arcmin, or 2.5 beams or pixels where these are wider."""
    within: Angle | None = Field(None, gt=0)
    """Look for the peak only this near to the map's centre."""

    def needs(self) -> tuple[Signal, ...]:
        """Signal of all but the sky, if that is the noise."""
        return (Signal(without=["sky"], modes="full"),) if self.noise == "source_free" else ()

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (3); the noise itself scatters the ratio by 1."""
        product = self.smoothed(map_of(data, "peak_snr", "", self.map))
        factor = 1.0
        error = 0.0
        radius = self.radius or central_diameter(product.fwhm, product.pixel) / 2
        if self.radius is None:
            radius = max(ARCMIN, radius)
        if self.noise != "white":
            of: Any = "half_difference" if self.noise == "half_difference" else "signal"
            free = self.smoothed(map_of(data, "peak_snr", names[0], self.map)) if names else product
            found, error = central_rms(free, radius, of)
            near = (product.distance() <= radius) & np.isfinite(product.noise)
            if not near.any():
                raise InputError(
                    "the white noise of the map is not known",
                    place="peak_snr",
                    cure="add a WhiteNoise and leave BinMap.noise at its default",
                )
            if not found > 0:
                raise InputError(
                    "the noise map is zero: the ratio is infinite",
                    place="peak_snr",
                    cure="add a step that makes noise, or choose noise: white",
                )
            w = product.weights[near]
            factor = found / math.sqrt(float((w * product.noise[near] ** 2).sum() / w.sum()))
            error /= found
        good = covered(product) & np.isfinite(product.noise) & (product.noise > 0)
        if self.within is not None:
            good &= product.distance() <= self.within
        with np.errstate(invalid="ignore", divide="ignore"):
            ratio = np.where(good, product.signal / (factor * product.noise), 0.0)
        value = abs(extreme(ratio, good, "peak_snr")[1])
        return value, math.hypot(1.0, value * error)

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        noise = WHITE if self.noise == "white" else self.noise
        return f"largest |map| / noise ({noise}), {self.how()}"


class TemplateSnr(_OfMap):
    """Signal-to-noise ratio of a source of known shape in a maximum-likelihood map, whose noise may
    be correlated in any way; or its amplitude in the map, equation (10).

    The shape is the map of a signal without noise. Scans and scales are weighed by the noise model.
    """

    of: Literal["snr", "amplitude"] = "snr"
    """The ratio, or the amplitude of the source in the map, in units of its own."""
    signal: str = Field("", pattern=r"^[A-Za-z0-9_]*$")
    """Which signal of the pipeline has the shape; empty: the sky alone."""

    def needs(self) -> tuple[Signal, ...]:
        """The sky alone, unless another signal is named."""
        return () if self.signal else sky_alone("sky")[:1]

    def named_signals(self) -> tuple[str, ...]:
        """The one that is named, and the complete one."""
        return ("", self.signal) if self.signal else ("",)

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (10), and the error of an amplitude. Raises InputError for maps of `BinMap`."""
        name = self.own_name()
        template = map_of(data, name, self.signal or names[0], self.map)
        amplitude, error = matched(template, map_of(data, name, "", self.map))
        return (1 / error, math.nan) if self.of == "snr" else (amplitude, error)

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        what = "signal-to-noise ratio" if self.of == "snr" else "amplitude"
        return f"{what} of {self.signal or 'the sky'} as a template, weighed by the noise model"


class Coverage(_OfMap):
    """Time on the centre of the map per beam, equation (4), or solid angle of the field, equation
    (5).
    """

    of: Literal["time", "area"] = "time"
    """Seconds of all detectors per beam near the centre, or the solid angle in arcmin2 with at
    least `least` of that.
    """
    radius: Angle = quantity("1 arcmin", gt=0)
    """What the centre is."""
    least: Fraction = quantity("50 %", gt=0, le=1)
    """Share of the centre's time from which a pixel counts to the area."""

    @property
    def unit(self) -> str:
        """Unit of a time, or of a solid angle."""
        return "s" if self.of == "time" else "arcmin2"

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (4) or (5)."""
        product = product_of(data, self.map, MapProduct, "coverage", "map, BinMap")
        return coverage(product, self.radius, None if self.of == "time" else self.least), math.nan

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        centre = f"within {angle_text(self.radius)} of the centre"
        if self.of == "time":
            return f"seconds of all detectors per beam, median {centre}"
        return f"solid angle with at least {100 * self.least:g} % of the time {centre}"


def coverage(product: MapProduct, radius: float, least: float | None = None) -> float:
    """Equation (4), s; with ``least`` equation (5), arcmin2."""
    factor = product.seconds_per_beam()
    near = product.distance() <= radius
    if factor is None or not near.any():
        cure = "set the instrument's fwhm and one sample rate, or choose a larger radius"
        raise InputError("the time per beam is not known there", place="coverage", cure=cure)
    time = product.hits * np.asarray(factor)
    centre = float(np.median(time[near]))
    if least is None:
        return centre
    sizes = np.broadcast_to(product.areas(), time.shape)
    return float(sizes[(time >= least * centre) & (product.hits > 0)].sum()) / ARCMIN**2
