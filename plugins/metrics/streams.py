"""Figures of time streams: equations (1) to (4).

``psd_slope``, the least-squares slope of ln P over ln f between two frequencies, x = ln f:

    b = sum (x - <x>) (ln P - <ln P>) / sum (x - <x>)^2,
    sigma_b^2 = c s^2 / sum (x - <x>)^2             (1)

s^2 is the variance of the residuals, c = 1 + 2 (4/9 + 1/36) = 35/18 for the correlation of
neighbouring frequencies through Welch's Hann window. ``crossing``, the highest frequency f_x at
which one spectrum exceeds another, or a level 2 NET^2, between neighbouring bins of `BINS` equal
ones in ln f, with the residuals s and the slope d of ln(P_1 / P_2) within a factor `NEAR`:

    ln f_x: zero of the line through both bins,
    sigma_ln f = (c / n)^(1/2) s / |d|                        (2)

``first_component``, the largest share of the variance that `ModeSpectrum` found,

    sigma_1^2 / sum sigma_i^2,   (3)

``mean_t_scan``, from the levels that the run resolved, mean over detectors, instants and scans,

    T_scan = < epsilon T_atm / (zeta e^-tau) >.                                                  (4)

``anderson_darling`` tests two parts of a stream for the same distribution. The p-value is that of
the k-sample test (Scholz & Stephens 1987, JASA 82, 918) between the first and the second half of
one detector's stream, as scipy tabulates it: from 0.001 to 0.25. A small p
*rejects* that both halves have one distribution. The test takes samples as independent; those of
red noise are not, so that two halves of one law fail it. High-passed, and thinned to samples that
are independent, they pass it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import Literal, Self

import numpy as np
from pydantic import Field, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Hertz, KelvinRootSecond
from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.figures import FigureMetric
from zonda.core.types import Floats
from zonda.operators.diagnostics.series import Modes, Spectrum, TimeStream, crossing, slope

from .common import product_of

LEAST = 10
"""Samples that each half must have."""


class AndersonDarling(FigureMetric):
    """p-value of the Anderson-Darling test between the two halves of the first detector's stream;
    0.001 to 0.25.

    It is measured on a `TimeStreams`. A small value rejects that the halves have the same
    distribution.
    """

    reads = frozenset({"time_streams"})

    stream: str = "signal"
    """Which stream."""
    above: Hertz | None = Field(None, gt=0)
    """Remove all below this frequency first."""
    every: int = Field(1, ge=1)
    """Take every so many samples."""

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """The p-value."""
        what = "product of streams, TimeStreams"
        found = product_of(data, "time_streams", TimeStream, "anderson_darling", what)
        if self.stream not in found.streams:
            raise InputError(
                f"there is no stream {self.stream!r}",
                place="anderson_darling",
                cure=f"streams of this run: {', '.join(found.streams)}",
            )
        rate = (found.seconds.size - 1) / (found.seconds[-1] - found.seconds[0])
        return p_value(found.streams[self.stream][0], rate, self.above, self.every), math.nan


def p_value(stream: Floats, rate: float, above: float | None, every: int) -> float:
    """The test between the halves of a stream (n_samp,), high-passed ``above`` a frequency, thinned
    to ``every`` samples.
    """
    from scipy.stats import anderson_ksamp

    values = stream - stream.mean()
    if above is not None:
        spectrum = np.fft.rfft(values)
        spectrum[np.fft.rfftfreq(values.size, 1 / rate) < above] = 0
        values = np.fft.irfft(spectrum, values.size)
    values = values[::every]
    half = values.size // 2
    if half < LEAST or not np.ptp(values) > 0:
        cure = "lengthen the scan, or make `every` smaller; the stream must not be constant"
        raise InputError(
            f"the halves of the stream have {half} samples",
            place="anderson_darling",
            cure=cure,
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that p lies beyond the table
        return float(anderson_ksamp([values[:half], values[half:]]).pvalue)


class _OfSpectrum(FigureMetric):
    """A figure of a power spectrum."""

    reads = frozenset({"spectrum"})

    spectrum: str = Field("spectrum", pattern=r"^[A-Za-z0-9_.]+$")
    """Which one, by its name among the products: that of a `PowerSpectrum` with a name of its own.
    """

    def spectrum_of(self, data: Data, metric: str) -> Spectrum:
        """The product. Raises InputError where there is none."""
        return product_of(data, self.spectrum, Spectrum, metric, "spectrum, PowerSpectrum")


def stream_in(spectrum: Spectrum, stream: str, metric: str) -> Floats:
    """The spectrum of one stream. Raises InputError where it was not measured."""
    if stream not in spectrum.psd:
        cure = f"choose from: {', '.join(spectrum.psd)}; or add it to PowerSpectrum.streams"
        raise InputError(f"the spectrum has no stream {stream!r}", place=metric, cure=cure)
    return spectrum.psd[stream]


class PsdSlope(_OfSpectrum):
    """Logarithmic slope of a stream's power spectrum between two frequencies, equation (1)."""

    stream: str = "signal"
    """Which stream."""
    low: Hertz = quantity("16 mHz", gt=0)
    """Lowest frequency."""
    high: Hertz = quantity("50 mHz", gt=0)
    """Highest frequency."""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if self.high <= self.low:
            raise ValueError("high must be larger than low")
        return self

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Slope of the spectrum between two frequencies, equation (1), and its error."""
        spectrum = self.spectrum_of(data, "psd_slope")
        psd = stream_in(spectrum, self.stream, "psd_slope")
        use = (spectrum.frequency >= self.low) & (spectrum.frequency <= self.high) & (psd > 0)
        if np.count_nonzero(use) < 3:
            resolution = "its inverse is the distance of frequencies"
            raise InputError(
                f"fewer than 3 frequencies lie from {self.low:g} to {self.high:g} Hz",
                place="psd_slope",
                cure=f"widen low and high, or lengthen PowerSpectrum.segment: {resolution}",
            )
        return slope(np.log(spectrum.frequency[use]), np.log(psd[use]))

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        return f"d ln P / d ln f of {self.stream} from {self.low:g} to {self.high:g} Hz"


class Crossing(_OfSpectrum):
    """Highest frequency at which a stream's spectrum exceeds another's, or a level, equation (2),
    Hz.
    """

    @property
    def unit(self) -> str:
        """Unit of a frequency."""
        return "Hz"

    stream: str = "atmosphere"
    """The stream that dominates at low frequencies."""
    other: str = "white"
    """The stream that dominates at high frequencies."""
    net: KelvinRootSecond | None = Field(None, gt=0)
    """In place of `other`: the level 2 NET^2."""

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Frequency at which two spectra cross, equation (2), and its error."""
        spectrum = self.spectrum_of(data, "crossing")
        psd = stream_in(spectrum, self.stream, "crossing")
        if self.net:
            level = np.full(psd.shape, 2 * self.net**2)
        else:
            level = stream_in(spectrum, self.other, "crossing")
        found = crossing(spectrum.frequency, psd, level)
        if isinstance(found, str):
            raise InputError(
                f"the first spectrum {found} the second",
                place="crossing",
                cure="choose other streams or another level",
            )
        return found

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        other = f"2 NET^2 with {self.net:.4g} K sqrt(s)" if self.net else self.other
        return f"highest frequency at which {self.stream} exceeds {other}"


class FirstComponent(FigureMetric):
    """Share of the variance in the first principal component of the detectors' streams, equation
    (3).

    It is measured by a `ModeSpectrum`; with delays there, it is the time-lagged one.
    """

    reads = frozenset({"modes"})

    modes: str = Field("modes", pattern=r"^[A-Za-z0-9_.]+$")
    """Which product: that of a `ModeSpectrum` with a name of its own."""

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (3); the standard error is that from the scatter over scans."""
        found = self._product(data)
        return float(found.shares[0]), float(found.error[0])

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        found = self._product(data)
        lags = (
            f"with {found.delays} delays of {found.delay:g} s" if found.delays else "instantaneous"
        )
        what = f"share of the variance of {found.detectors} detectors in the first component"
        return f"{what}, {lags}"

    def _product(self, data: Data) -> Modes:
        what = "mode spectrum, ModeSpectrum"
        return product_of(data, self.modes, Modes, "first_component", what)


class MeanTScan(FigureMetric):
    """Mean emission of the atmosphere on the calibrated scale, T_scan, equation (4), or as it is,
    T_atm.
    """

    @property
    def unit(self) -> str:
        """Unit of a brightness."""
        return "K_RJ"

    reads = frozenset({"atmosphere", "signal"})

    of: Literal["scan", "atmosphere"] = "scan"
    """T_scan: the atmosphere's share of the calibrated stream; or T_atm: its brightness, before any
    efficiency.
    """

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """Equation (4), every scan weighted by its duration."""
        means = [o.mean_emission for o in data.observations]
        if not means or not all(means):
            text = "the levels of the atmosphere are not known here"
            raise InputError(text, place="mean_t_scan", cure="add AtmosphereLayers and Efficiency")
        weights = [o.duration for o in data.observations]
        return float(np.average([m[self.of] for m in means], weights=weights)), math.nan

    def describe(self, data: Data, names: Sequence[str]) -> str:
        """Describe the figure in words."""
        what = "epsilon T_atm / (zeta e^-tau)" if self.of == "scan" else "T_atm"
        return f"mean of {what} over detectors and time"
