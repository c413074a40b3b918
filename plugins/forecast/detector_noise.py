"""White and 1/f noise of a filtered, binned and beam-smoothed map, without its time streams.

Samples i = (detector d, time t) at x_i have weights a_i in the map and noise of rms sigma_i; K is
the beam. At a point x of the map that is smoothed with K, the sample i has the weight

    w_i = a_i K(x - x_i) / sum_j a_j K(x - x_j)                                                  (1)

The filters are F = (1 - u u^T) (1 - P), P the low part that the high-pass filter removes and u =
n_det^(-1/2) what the common mode takes. With W_d(f) the spectrum of the series (1 - P) w_d, and
R(f) the power of the noise over that of white noise,

    variance = (1 - 1 / n_det) (1 - shared) sum_i sigma_i^2 w_i^2
               <sum_df sigma^2 |W_d|^2 R> / <sum_dt sigma^2 w_d^2>     (2)

R = 1 of white noise. What detectors share is gone behind the common mode. The factor <> / <> needs
few detectors, which stand for all; w and the sum before it need all of them (few would bias it).
Where the few are all, the common mode is taken from their series, and 1 - 1 / n_det is left out.
The variance is averaged over probes in a circle about the map's centre, weighted like the samples
of the map; in the factor all probes of a comb are in one series, with random signs. Maps of I, Q
and U: `stokes_noise`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy.fft import next_fast_len, rfft

from zonda.core.kernels import kernel
from zonda.core.types import AnyFloats, Bools, Floats, Indices

from .survey import Noise, Survey, Track, sparse, subset

NEAR = 8.0
"""Least distance of probes, in the beam's standard deviations."""
FAR = 12.0
"""-ln K up to which a sample counts."""
STEP = (0.7548776662466927, 0.5698402909980532)
"""Steps of a low-discrepancy sequence in the plane (Roberts 2018)."""
MOST_COMBS = 8


@dataclass(frozen=True)
class Comb:
    """Probes in a circle about the map's centre.

    Attributes
    ----------
    origin, spacing
        Of the first probe and between probes, rad.
    inside
        (n, n) whether a probe is in the circle.
    """

    origin: Floats
    spacing: float
    inside: Bools


def combs(survey: Survey, radius: float, probes: int) -> list[Comb]:
    """Combs with about ``probes`` probes in a circle of ``radius`` [rad] together; the first has
    one at its centre.
    """
    spacing = max(NEAR * survey.sigma, radius / 4)
    number = 2 * int(radius / spacing) + 3
    found: list[Comb] = []
    total = 0
    for k in range(64):
        shift = np.zeros(2) if k == 0 else (k * np.array(STEP) + 0.5) % 1 - 0.5
        origin = (shift - number // 2) * spacing
        grid = origin[:, None] + spacing * np.arange(number)
        inside = np.hypot(grid[0][:, None], grid[1][None]) <= radius
        if inside.any():
            found.append(Comb(origin, spacing, inside))
            total += int(inside.sum())
        if total >= probes or len(found) >= MOST_COMBS:
            break
    return found


@kernel
def _near(  # type: ignore[no-untyped-def]
    matrices, offsets, origin, spacing, factors, variance, far, thin, sums, series
):
    """Beam K between detectors at ``offsets`` (n_det, 2) and the nearest probe, at every
    ``thin``-th instant. Probes (n, n) whose factor is 0 do not count, nor do instants whose
    boresight is farther than ``far`` [rad] from all probes.

    ``series`` (n_det, n_instant) is set to the factor times K. If it is empty, K and K^2 are added
    to ``sums`` (n, n, 2).
    """
    number = factors.shape[0]
    low, high = origin - far, origin + far + spacing * (number - 1)
    for t in range(thin // 2, len(matrices), thin):
        h = matrices[t]
        x, y = h[2] / h[8], h[5] / h[8]
        if x < low[0] or x > high[0] or y < low[1] or y > high[1]:
            continue
        for d in range(len(offsets)):
            a, b = offsets[d, 0], offsets[d, 1]
            scale = 1.0 / (h[6] * a + h[7] * b + h[8])
            x = (h[0] * a + h[1] * b + h[2]) * scale - origin[0]
            y = (h[3] * a + h[4] * b + h[5]) * scale - origin[1]
            i, j = math.floor(x / spacing + 0.5), math.floor(y / spacing + 0.5)
            if 0 <= i < number and 0 <= j < number and factors[i, j] != 0.0:
                u, v = x - i * spacing, y - j * spacing
                r = (u * u + v * v) / (2 * variance)
                if len(series):
                    series[d, t] = factors[i, j] * math.exp(-r)
                elif r < FAR:
                    g = math.exp(-r)
                    sums[i, j, 0] += g
                    sums[i, j, 1] += g * g


PROBES, DETECTORS = 16, 24
"""Number of probes in the circle, and of the detectors whose series represent all."""
ALL = 64
"""Detectors up to which the series of all are made, and what they have in common is taken from
them.
"""
SIGNS = 16
"""How often the signs are drawn, all combs together: probes that a detector passes one after the
other have noise in common.
"""
SAMPLES, INSTANTS = 3e7, 4000
"""Samples (of all scans and combs) of which kernels are summed up: where there are more, instants
are left out, and of so few instants detectors."""
STEEP = 8
"""Lowest frequencies whose bins are integrated over."""
FILTERED = 12
"""Scans whose series are filtered: evenly chosen of all."""

Series = Callable[[Track, Indices], AnyFloats]
"""(n_det, n_instant) w of detectors (numbers) along a track."""


def variances(survey: Survey, radius: float) -> dict[str, Floats]:
    """``white`` and ``1/f``: (n_scan,) variance [K^2] after each scan, averaged over a circle of
    ``radius`` [rad].
    """
    chosen = combs(survey, radius, PROBES)
    sums, some = _sums(survey, chosen)
    weighted = sums[..., 0] * survey.weights[:, None]
    total = np.cumsum(weighted, axis=0)
    found = {"white": np.zeros(len(total)), "1/f": np.zeros(len(total))}
    seen = total[-1] > 0
    if not seen.any():
        return {name: np.full(len(total), np.nan) for name in found}
    filtered = Filtered(survey, _signed(survey, chosen, total[-1]), survey.rate)
    for k, noise in enumerate(survey.levels[0]):
        sigma2 = np.array([each[k].sample ** 2 for each in survey.levels])
        squares = np.cumsum(sums[..., 1] * (survey.weights**2 * sigma2)[:, None], axis=0)
        found[noise.part] += filtered.share(k) * _averaged(squares, total, some)
    return found


def _averaged(squares: Floats, total: Floats, some: bool) -> Floats:
    """(n_scan,) sum a^2 sigma^2 K^2 / (sum a K)^2, averaged over probes with the weights sum a K.
    Of ``some`` detectors only, the sums of the numerator and of one factor of the denominator are
    averaged first: the ratio of few samples is biased."""
    if some:
        seen = np.count_nonzero(total, axis=1)
        return np.asarray(seen * squares.sum(axis=1) / total.sum(axis=1) ** 2)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(np.where(total > 0, squares / total, 0.0).sum(axis=1) / total.sum(axis=1))


def _sums(survey: Survey, chosen: list[Comb]) -> tuple[Floats, bool]:
    """(n_scan, n_probe, 2) sums of K and K^2 at the probes of all combs; whether they are from some
    of the detectors.
    """
    rate = survey.rate
    offsets = survey.offsets
    tracks = [survey.track(k, rate) for k in range(len(survey.observations))]
    instants = sum(len(t.index) for t in tracks)
    number = instants * len(offsets) * len(chosen)
    thin = min(max(1, round(number / SAMPLES)), max(1, instants // INSTANTS))
    fewer = min(len(offsets), max(1, round(thin * SAMPLES / number * len(offsets))))
    if fewer < len(offsets):
        offsets = np.ascontiguousarray(offsets[subset(len(offsets), fewer, seed=4)])
    far = 1.05 * float(np.hypot(*survey.offsets.T).max()) + math.sqrt(2 * FAR) * survey.sigma

    def near(t: Track, c: Comb) -> Floats:
        found, series = np.zeros((*c.inside.shape, 2)), np.zeros((0, 0), np.float32)
        place = (c.origin, c.spacing, c.inside.astype(np.float64))
        variance = survey.sigma**2
        _near(t.matrices, offsets, *place, variance, far, thin, found, series)
        return found[c.inside] * (thin * t.step)

    rows = [np.concatenate([near(t, c) for c in chosen]) for t in tracks]
    return np.array(rows) * (len(survey.offsets) / fewer), fewer < len(survey.offsets)


def _signed(survey: Survey, chosen: list[Comb], total: Floats) -> list[Series]:
    """Series of the kernels of all probes of a comb with random signs, for the factor of equation
    (2). ``total``: sum a K.
    """
    rng = np.random.default_rng(2)
    begin = 0
    draws: list[Series] = []
    for comb in chosen:
        there = total[begin : begin + int(comb.inside.sum())]
        begin += len(there)
        for _ in range(max(1, SIGNS // len(chosen))):
            factors = np.zeros(comb.inside.shape)
            signs = rng.choice([-1.0, 1.0], len(there))
            factors[comb.inside] = np.where(
                there > 0,
                signs / np.sqrt(np.where(there > 0, there, 1.0)),
                0.0,
            )
            draws.append(partial(kernels, survey, comb, factors))
    return draws


def kernels(
    survey: Survey,
    comb: Comb,
    factors: Floats,
    track: Track,
    few: Indices,
) -> AnyFloats:
    """(n_det, n_instant): factor times K of the nearest probe."""
    found = np.zeros((len(few), len(track.index)), np.float32)
    place = (comb.origin, comb.spacing)
    variance = survey.sigma**2
    none = np.zeros((0, 0, 2))
    _near(track.matrices, survey.offsets[few], *place, factors, variance, math.inf, 1, none, found)
    return found


class Filtered:
    """Share of each noise that the filters leave, <> / <> of equation (2), and of the noise before
    them.

    Parameters
    ----------
    draws
        Each makes the series w of some detectors along a track.
    rate
        Instants per second that they need, Hz.
    """

    def __init__(self, survey: Survey, draws: Sequence[Series], rate: float) -> None:
        number = len(survey.levels[0])
        self._survey = survey
        self._left = np.zeros(number)
        self._all = np.zeros(number)
        self._every = len(survey.offsets) <= ALL
        every = len(survey.offsets)
        few = subset(every, every if self._every else DETECTORS)
        for scan in sparse(len(survey.observations), FILTERED):
            track = survey.track(scan, rate)
            for series in draws:
                self._add(scan, track, series(track, few))

    def _add(self, scan: int, track: Track, rows: AnyFloats) -> None:
        survey = self._survey
        common = survey.common and self._every
        if not common:
            rows = rows[rows.any(axis=1)]
        if not rows.any():
            return
        weight = survey.weights[scan] ** 2 * track.step
        before = weight * float(np.einsum("dt,dt->", rows, rows, dtype=np.float64))
        survey.filter(track, rows)
        if common:
            rows -= rows.mean(axis=0)
        frequency, energy = energies(rows, track.rate)
        for k, noise in enumerate(survey.levels[scan]):
            self._left[k] += weight * noise.sample**2 * float(energy @ over_white(noise, frequency))
            self._all[k] += before * noise.sample**2

    def share(self, noise: int) -> float:
        """Share of one of the noises that is left."""
        if not self._all[noise] > 0:
            return 0.0
        found = float(self._left[noise] / self._all[noise])
        if self._survey.common:
            found *= 1 - self._survey.levels[0][noise].shared
            found *= 1.0 if self._every else 1 - 1 / len(self._survey.offsets)
        return found


def over_white(noise: Noise, frequency: Floats) -> Floats:
    """R at the frequencies of `energies`; of the lowest, where it is steep, its mean over a bin."""
    if noise.spectrum is None:
        return np.ones_like(frequency)
    found = noise.spectrum(frequency)
    step = frequency[1]
    for k in range(min(STEEP, len(found))):
        fine = np.geomspace(max(k - 0.5, 1e-5), k + 0.5, 200) * step
        below = fine[0] * noise.spectrum(fine[:1])[0] if k == 0 else 0.0
        found[k] = (float(np.trapezoid(noise.spectrum(fine), fine)) + below) / (
            step * (0.5 if k == 0 else 1.0)
        )
    return found


def energies(rows: AnyFloats, rate: float) -> tuple[Floats, Floats]:
    """(f, sum over rows of |W(f)|^2), one-sided, by transforms of twice the length: their sum over
    f is that of the squares.
    """
    n = next_fast_len(2 * rows.shape[-1], real=True)
    spectrum = rfft(rows, n, axis=-1)
    energy = (spectrum.real**2 + spectrum.imag**2).sum(axis=0, dtype=np.float64) / n
    energy[1:] *= 2
    if n % 2 == 0:
        energy[-1] /= 2
    return np.arange(energy.size) * rate / n, energy
