"""White level, knee and slope of the noise of a stream, from its power spectrum.

The one-sided power spectral density is taken to be

    P(f) = 2 NET^2 (1 + (f_knee / f)^slope).                                                     (1)

It is estimated by Welch's method (1967, IEEE Trans. Audio Electroacoust. 15, 70) with Hann windows
that overlap by half, a line removed from each; of the K segments without a flagged sample the
*median* is taken, divided by the median of the mean of exponential deviates (Allen et al. 2012,
Phys. Rev. D 85, 122006, appendix B). Segments with a glitch are left out: those whose power in the
upper half of the band is more than `OUTLYING` robust standard deviations from their median.
Frequencies are averaged in logarithmic bins, and ln P is fitted by least squares with the
covariance of the bins. A frequency has the relative variance

    sigma^2 = (1 + 2 c) v / K ,
    v = 1 / ln(2)^2                                                         (2)

v / K that of the median of K independent exponential deviates, in the limit of large K. The powers
of Hann's windows that overlap by half are correlated by 1/36, those of frequencies of one window
that are one or two apart by 4/9 and 1/36; medians of such powers are correlated less, by the
probability q that both lie below their median: c = 4 q - 1, `MEDIANS`. What the window mixes into a
frequency from others, a tenth of the power of the lowest for slope 1, is in the expectation that is
fitted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.types import Bools, Floats, Indices

SEGMENTS = 24
"""Windows without overlap that a scan is cut into, where the length of a segment is not given."""
FEWEST = 8
"""Segments without a flagged sample that an estimate needs."""
BINS = 12
"""Frequency bins per decade."""
OUTLYING = 6.0
"""Robust standard deviations: 1.4826 times the median distance from the median."""
HIGHEST = 0.9
"""Of the Nyquist frequency: what lies above is not fitted (filters before the read-out)."""
LEAST_SLOPE = 0.5
"""A flatter spectrum cannot be told from white noise."""
MEDIANS = 0.2627, 0.0145
"""c of equation (2) for powers that are correlated by 4/9 and 1/36 (of 4e6 pairs of complex normal
deviates).
"""
VARIANCE = (1 + 2 * MEDIANS[1]) / math.log(2) ** 2
"""Of equation (2), times the number of segments."""
MIXED = 32
"""Lowest frequencies whose expectation takes account of the window."""


@dataclass(frozen=True)
class Noise:
    """Equation (1) with standard errors.

    Attributes
    ----------
    net, knee, slope
        K sqrt(s); Hz, 0: none was found, and ``knee_error`` is the lowest frequency that was looked
        at; exponent.
    segments
        Those that were used.
    chi_square
        Of the fit, over its degrees of freedom: far above 1 where equation (1) does not describe
        the spectrum.
    """

    net: float
    net_error: float
    knee: float
    knee_error: float
    slope: float
    slope_error: float
    segments: int
    chi_square: float


def segment_length(n_samples: int, rate: float, seconds: float | None, place: str) -> int:
    """Samples of a segment: those of ``seconds``, or the most of which there are `SEGMENTS`, but
    for a fast transform.

    Raises InputError for a scan that is too short.
    """
    from scipy.fft import next_fast_len

    length = round(seconds * rate) if seconds is not None else n_samples // SEGMENTS
    if seconds is None and length >= 64:
        length = next(n for n in range(length // 2 * 2, 0, -2) if next_fast_len(n, real=True) == n)
    if length < 64 or 2 * n_samples // max(length, 1) - 1 < FEWEST:
        text = f"{n_samples} samples make no {FEWEST} segments of at least 64"
        raise InputError(text, place=place, cure="give a longer scan, or a shorter --segment")
    return length


def median_bias(segments: int) -> float:
    """The expected median of so many exponential deviates, over their mean: 1 - 1/2 + 1/3 ... (odd
    numbers of terms).
    """
    terms = np.arange(1, segments + 1 - (segments + 1) % 2)
    return float(np.sum((-1.0) ** (terms + 1) / terms))


def spectrum(
    row: Floats,
    good: Bools,
    rate: float,
    length: int,
) -> tuple[Floats, Floats, int]:
    """Frequencies [Hz] without zero, one-sided power spectral density [K^2 / Hz], number of
    segments used (0: too few are good).

    ``row`` (n,) K; ``good`` (n,): samples that may be used.
    """
    from scipy.signal import detrend, spectrogram

    good = good & np.isfinite(row)
    found, _, power = spectrogram(
        np.where(good, row, 0.0),
        rate,
        "hann",
        length,
        length // 2,
        detrend=detrend,
    )
    spoilt = np.r_[0, np.cumsum(~good)]
    begins = np.arange(power.shape[1]) * (length // 2)
    whole = spoilt[begins + length] == spoilt[begins]
    frequency = np.asarray(found[1:], np.float64)
    power = power[1:, whole].T
    if len(power) < FEWEST:
        return frequency, np.full(len(frequency), np.nan), 0
    level = power[:, power.shape[1] // 2 :].mean(axis=1)
    away = np.abs(level - np.median(level))
    power = power[away <= OUTLYING * 1.4826 * np.median(away)]
    return (
        frequency,
        np.asarray(np.median(power, axis=0) / median_bias(len(power)), np.float64),
        len(power),
    )


def fit(frequency: Floats, power: Floats, segments: int) -> Noise | None:
    """Equation (1) fitted to a spectrum of `spectrum`; None: there is none to fit, or it is
    zero.
    """
    use = (frequency <= HIGHEST * frequency[-1]) & (
        np.arange(len(frequency)) >= 1
    )  # the line takes the lowest
    if not segments or not (power[use] > 0).all():
        return None
    every = frequency[use]
    bins = _Bins.of(frequency[use])
    f = bins.mean(every)
    p = bins.mean(power[use])
    covariance = bins.covariance() * (VARIANCE / segments)
    log_p = (
        np.log(p) + np.diag(covariance) / 2
    )  # the mean of a logarithm lies below the logarithm of the mean
    alike = np.linalg.solve(covariance, np.ones(len(p)))  # weighs a level that all have in common
    start = math.log(float(np.median(p[f > f[-1] / 3])))
    middle = math.sqrt(f[0] * f[-1])

    log_f = np.log(every / middle)
    near, share = _mixed(every[:MIXED], frequency[0])
    log_near = np.log(near / middle)

    def law(_: Any, white: float, red: float, slope: float) -> Floats:
        power = np.exp(red - slope * log_f)
        power[:MIXED] = np.exp(red - slope * log_near) @ share
        return np.log(bins.mean(np.exp(white) + power))

    def cost(found: Floats) -> float:
        return float((found - log_p) @ np.linalg.solve(covariance, found - log_p))

    from scipy.optimize import curve_fit

    limits = [-np.inf, start - 40, LEAST_SLOPE], [np.inf, np.inf, 4.0]
    tried = []
    for slope in (1.0, 2.0):
        red = max(float(log_p[0]), start - 2.0) - slope * math.log(middle / f[0])
        found = curve_fit(law, f, log_p, [start, red, slope], covariance, True, bounds=limits)
        tried.append((cost(law(f, *found[0])), *found))
    chi, (white, red, slope), errors = min(tried, key=lambda one: one[0])
    level = float(alike @ log_p / alike.sum())
    variance = float(1 / alike.sum())
    of_white = cost(np.full(len(f), level))
    inside = red - white < slope * math.log(f[-1] / middle)  # the knee is below the last frequency
    if of_white - chi < 6.0 or not inside:
        # Two more parameters do as much by chance in one of twenty cases.
        net = math.sqrt(math.exp(level) / 2)
        chi = of_white / max(len(f) - 1, 1)
        return Noise(net, net * math.sqrt(variance) / 2, 0.0, float(f[0]), 1.0, 0.0, segments, chi)
    net = math.sqrt(math.exp(white) / 2)
    knee = middle * math.exp((red - white) / slope)
    gradient = np.array([-1.0, 1.0, -(red - white) / slope]) / slope  # of ln knee
    return Noise(
        net,
        net * math.sqrt(errors[0, 0]) / 2,
        knee,
        knee * math.sqrt(float(gradient @ errors @ gradient)),
        float(slope),
        math.sqrt(errors[2, 2]),
        segments,
        chi / max(len(f) - 3, 1),
    )


def _mixed(frequency: Floats, step: float) -> tuple[Floats, Floats]:
    """Frequencies (n, m) that Hann's window mixes into each, which are ``step`` apart, and the
    share (m,) of each.
    """
    x = np.linspace(-1.9, 1.9, 39)
    pole = np.abs(np.abs(x) - 1) < 1e-9
    window = np.sinc(x) / np.where(pole, np.inf, 1 - x**2)
    window[pole] = 0.5
    share = window**2 / np.sum(window**2)
    return np.maximum(np.abs(frequency[:, None] + step * x), 0.5 * step), share


@dataclass(frozen=True)
class _Bins:
    """Logarithmic bins of frequencies: where each begins, and how many are in it."""

    first: Indices
    number: Floats

    @classmethod
    def of(cls, f: Floats) -> _Bins:
        edge = np.floor(BINS * np.log10(f / f[0]) + 1e-9).astype(int)
        _, first, number = np.unique(edge, return_index=True, return_counts=True)
        return cls(first, number.astype(np.float64))

    def covariance(self) -> Floats:
        """Covariance of the bins' means, if the values have variance 1 and correlations `MEDIANS`
        with the next two.
        """
        which = np.repeat(np.arange(len(self.number)), self.number.astype(int))
        found = np.diag(self.number)
        for apart, common in enumerate(MEDIANS, 1):
            np.add.at(found, (which[apart:], which[:-apart]), common)
            np.add.at(found, (which[:-apart], which[apart:]), common)
        return found / np.outer(self.number, self.number)

    def mean(self, values: Floats) -> Floats:
        """Mean in each bin."""
        return np.asarray(np.add.reduceat(values, self.first) / self.number, np.float64)
