"""Atmosphere that filters leave in a map: an indicative figure, without drawing any turbulence.

Layer l of the frozen atmosphere is a sum of plane waves q with the spectrum P_l (behind the
telescope's beam in that layer). The boresight crosses it along the path X(t), a detector at
focal-plane offset d beside it, at X(t) + J d. With K the beam on the map about a point x, delta(t)
the offset in the focal plane at which x is at time t, g(t) = sum_d K(x - x_dt) ~ the density of
detectors at delta(t), and A(q) = <exp(i q J d)>_d what the common mode removes,

    variance = sum_l K_l^2 int d2q/(2 pi)^2 P_l(q)
               |sum_t g (exp(i q J delta) - A) (1 - P) exp(i q X)|^2 / (sum_t g)^2       (1)

with K_l the kelvin of calibrated signal per unit of the layer's field. Waves are drawn from what
(1) leads to expect of them, so that few are needed; their scatter is part of the error that is
stated. It holds for weak fluctuations and equal gains. Scans see different parts of the atmosphere,
so their contributions add up in quadrature: the wind carries it farther between them than the size
of what the filters leave.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.ndimage import gaussian_filter, map_coordinates

from zonda.core.types import AnyFloats, Floats, Indices
from zonda.operators.atmosphere.planning import Calibrated, calibrated
from zonda.operators.atmosphere.turbulence.geometry import (
    ScanPlane,
    axes,
    crossing,
    rays,
    scan_planes,
)
from zonda.operators.atmosphere.turbulence.nodes import Layer

from .survey import Noise, Survey, Track, subset

WAVES = 320
"""Number of waves: with 96 the rms is wrong by half where the atmosphere is a small part of the
noise (AtLAST); 1280 change it by 8 %."""
POINTS, DETECTORS = 8, 64
"""Number of probes, and of the detectors that A is averaged over."""
TEMPLATE, GROUPS = 1e7, 9
"""Samples of a scan of which a template is made, and groups of detectors across the focal plane."""
MOST = 12
"""Number of scans that are followed, the first ones. The variance of later ones is taken to fall as
1 / time.
"""
PER_CUT, LEAST, LARGEST = 4.0, 3.0, 30.0
"""Instants per cycle of the cut, and per second, at least and at most."""
WAVE_NUMBERS = np.linspace(math.log(2e-4), math.log(3.0), 240)
"""ln of the wave numbers [rad/m] that waves are drawn from."""
ENDS = 0.01
"""Share of the power below the cut that the ends of a scan let pass, for the choice of waves."""
GOLDEN = 0.618034
NEGLIGIBLE = 1e-4
"""Share of the expected variance below which a layer is left out."""


@dataclass(frozen=True)
class Mode:
    """A singular mode of a scan that is found in the data, in place of the detectors' mean of
    equation (1).

    Attributes
    ----------
    independent
        Number of independent values of the common mode in a scan. Of few, the rest of the
        atmosphere varies with it by chance, and goes with it: equation (1) is too high, by a half
        where there are nine.
    turned
        Variance [K^2] of the common mode that stays in a sample, in each detector by itself,
        because noise turns the mode.
    """

    independent: float
    turned: float
    noise: Noise
    """It as noise of the detectors."""


@dataclass(frozen=True)
class Left:
    """Atmospheric noise that is left in a map: its variance [K^2] after each scan, (n_scan,), and
    the relative standard error of the last value from the scatter of the waves.
    """

    variance: Floats
    error: float
    mode: Mode | None = None


class Template(NamedTuple):
    """A source in place of the beam in equation (1): sum_d s_dt (exp(i q J d) - A) replaces
    g (exp(i q J delta) - A), and (sum a s F s)^2 replaces (sum_t g)^2.

    Attributes
    ----------
    rows
        Makes (n_det, n) s of some detectors (numbers) along a track.
    signal
        (n_scan,) sum a s F s after each scan.
    """

    rows: Callable[[Track, Indices], AnyFloats]
    signal: Floats


def step_of_modes(survey: Survey) -> bool:
    """True if the common signal of the detectors is found in the data: equation (1), which takes
    their mean off, need not hold.
    """
    return survey.common and survey.steps.common is not None and survey.steps.common.method == "svd"


@dataclass(frozen=True)
class _Scan:
    """A scan as equation (1) needs it: instants at which some probe is seen, g (n_probe, n), delta
    (n_probe, n, 2).
    """

    track: Track
    plane: ScanPlane
    crossings: Floats
    jacobian: Floats
    density: Floats
    offsets: Floats

    def waves(self, survey: Survey, model: Layer, waves: Floats) -> tuple[AnyFloats, Floats]:
        """Filtered cosines and sines (2 n_wave, n) of waves along the boresight's path in a layer,
        and the phases' slopes (n_wave, 2) over the focal plane.
        """
        matrix, start, velocity = self.plane.affine(model.height, model.wind)
        seconds = self.track.observation.seconds[self.track.index]
        path = matrix @ self.crossings + start[:, None] + velocity[:, None] * seconds
        phase = waves @ path
        series = np.concatenate([np.cos(phase), np.sin(phase)]).astype(np.float32)
        survey.filter(self.track, series)
        return series, waves @ (matrix @ self.jacobian)


def variance(
    survey: Survey,
    radius: float,
    waves: int = WAVES,
    template: Template | None = None,
) -> Left:
    """Equation (1) from about so many waves, averaged over probes in a circle of ``radius`` [rad]
    about the map's centre; of a ``template`` the variance is relative to its signal.
    """
    step = survey.atmosphere
    number = len(survey.observations)
    if step is None or step.pwv_rms == 0:
        return Left(np.zeros(number), 0.0)
    found = calibrated(step.model(survey.observations[survey.configured[0]]))
    scans = _scans(survey, radius)
    shares = _expected(survey, found)
    share = np.array([s.sum() for s in shares]) * [k not in step.omit for k in range(len(shares))]
    some = survey.offsets[:: max(1, len(survey.offsets) // DETECTORS)]  # they stand for all
    total = np.zeros(len(scans))
    spread = 0.0
    modes = []
    rows = [] if template is None else _rows(survey, scans, template)
    rng = np.random.default_rng(3)
    for k in np.flatnonzero(share > NEGLIGIBLE * share.sum()).tolist():
        each = max(8, round(waves * share[k] / share.sum()))
        drawn, weights = _drawn(found, k, shares[k], each, rng)
        model = found.layers[k]
        weights = weights * (found.kelvin * model.amplitude) ** 2
        if template is None:
            added = _of_waves(survey, scans, some, model, drawn) * weights
        else:
            added = _of_template(survey, scans, rows, model, drawn) * weights
            added /= template.signal[: len(scans), None] ** 2
        if template is None and step_of_modes(survey):
            modes.append(_covariance(survey, scans[0], some, model, drawn, weights))
        total += added.sum(axis=1)
        spread += float(added[-1].size * added[-1].var())
    last = np.arange(len(scans), number)
    total = np.r_[total, total[-1] * survey.seconds[len(scans) - 1] / survey.seconds[last]]
    if not total[-1] > 0:
        return Left(total, 0.0)
    mode = None
    if modes:
        covariance, spectrum = (np.sum(each, axis=0) for each in zip(*modes, strict=True))
        mode = _mode(survey, covariance, spectrum)
    return Left(total, math.sqrt(spread) / total[-1], mode)


def _scans(survey: Survey, radius: float) -> list[_Scan]:
    """The first scans, at instants that resolve the beam's passages over the probes where there is
    time for that.
    """
    rate = _rate(survey)
    width = max(survey.sigma, 1.5 * survey.speed / rate / survey.fwhm * survey.sigma)
    density, reach, cell = _footprint(survey.offsets, width)
    angle = 2 * np.pi * (GOLDEN * np.arange(POINTS) % 1)
    distance = radius * np.sqrt((np.arange(POINTS) + 0.5) / POINTS)[:, None]
    probes = distance * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    little = 1e-4 * np.eye(3)[1:]
    zero = np.zeros(1)
    found = []
    for k, plane in enumerate(scan_planes(survey.observations[:MOST])):
        track = survey.track(k, rate)
        apart = probes[:, None] - track.centre[None]
        offsets = np.einsum("tij,ptj->pti", np.linalg.inv(track.turn), apart)
        at = ((offsets + reach) / cell - 0.5).reshape(-1, 2).T
        seen = map_coordinates(density, at, order=1, mode="constant").reshape(apart.shape[:-1])
        frame = axes(track.observation.boresight_azel[track.index])
        own = plane.unroll(crossing(rays(frame, zero, zero)))[:, 0]
        middle = len(frame) // 2
        corners = plane.unroll(crossing(rays(frame[middle : middle + 1], *little)))[:, :, 0]
        jacobian = (corners[:, 1:] - corners[:, :1]) / 1e-4
        found.append(_Scan(track, plane, own, jacobian, seen * track.step, offsets))
    return found


def _rate(survey: Survey) -> float:
    """Instants per second at which scans are followed, Hz."""
    return min(
        max(PER_CUT * survey.cut, min(survey.rate, LARGEST), LEAST),
        survey.observations[0].sample_rate,
    )


def _footprint(offsets: Floats, sigma: float) -> tuple[Floats, float, float]:
    """(grid, reach, cell): detectors per solid angle of the focal plane, smoothed with a Gaussian
    of ``sigma`` [rad].
    """
    reach = float(np.abs(offsets).max()) + 4 * sigma
    cell = max(sigma / 1.5, reach / 250)
    number = int(2 * reach / cell) + 2
    half = number * cell / 2
    counts, _, _ = np.histogram2d(offsets[:, 0], offsets[:, 1], number, [[-half, half]] * 2)
    return np.asarray(gaussian_filter(counts, sigma / cell)), half, cell


def _spectrum(found: Calibrated, layer: int, number: Floats) -> Floats:
    """P_l at wave numbers [rad/m], m2, of unit variance before the beam."""
    e, w = found.components[layer]
    return (4 * np.pi * e * w) @ np.exp(-np.multiply.outer(e, number**2))


def _expected(survey: Survey, found: Calibrated) -> list[Floats]:
    """For each layer what each of `WAVE_NUMBERS` is expected to add: spectrum x the array's
    response x share of time above the cut, where fast waves average down over a passage."""
    number = np.exp(WAVE_NUMBERS)
    field = max(float(np.hypot(*survey.offsets.T).max()), survey.sigma)
    shares = []
    for k, layer in enumerate(found.layers):
        speed = np.hypot(*found.velocities[k])
        across = np.maximum(np.outer(number, speed) / (2 * np.pi * max(survey.cut, 1e-6)), 1e-9)
        above = (1 - 2 / np.pi * np.arcsin(1 / np.maximum(across, 1))).mean(axis=1)
        above += ENDS * np.minimum(1, across.max(axis=1)) ** 2
        phase = number * field * layer.distance
        form = phase**2 / (phase**2 + 4) if survey.common else 1.0
        power = (found.kelvin * layer.amplitude) ** 2 * number**2 * _spectrum(found, k, number)
        each = power / (2 * np.pi) * above * form
        slow = each / (1 + phase**2)
        fast = each / (1 + phase)
        shares.append(slow / max(slow.sum(), 1e-300) * fast.sum() + fast)
    return shares


def _drawn(
    found: Calibrated,
    layer: int,
    share: Floats,
    number: int,
    rng: np.random.Generator,
) -> tuple[Floats, Floats]:
    """Waves (n, 2) [rad/m], and the weight of each in the integral of equation (1)."""
    chance = share / share.sum()
    at = (rng.permutation(number) + 0.5) / number
    drawn = np.interp(at, np.cumsum(chance) - 0.5 * chance, WAVE_NUMBERS)
    density = np.interp(drawn, WAVE_NUMBERS, chance) / (WAVE_NUMBERS[1] - WAVE_NUMBERS[0])
    angle = 2 * np.pi * ((GOLDEN * np.arange(number) + rng.random()) % 1)
    k = np.exp(drawn)
    waves = k[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return waves, k**2 * _spectrum(found, layer, k) / (2 * np.pi) / density / number


def _of_waves(
    survey: Survey,
    scans: list[_Scan],
    some: Floats,
    model: Layer,
    waves: Floats,
) -> Floats:
    """(n_scan, n_wave) the square in equation (1) over (sum g)^2, after each scan, averaged over
    probes.
    """
    squares = np.zeros((POINTS, len(waves)))
    amount = np.zeros(POINTS)
    n = len(waves)
    rows = []
    for scan, weight in zip(scans, survey.weights, strict=False):
        both, across = scan.waves(survey, model, waves)
        series = both[:n] + 1j * both[n:]
        mean = np.zeros(n)
        if survey.common:
            mean = np.exp(1j * (across @ some.T)).mean(axis=1)
        for i, seen in enumerate(scan.density):
            near = np.flatnonzero(seen > 1e-2 * seen.max(initial=0.0))
            if near.size:
                angle = (across @ scan.offsets[i, near].T).astype(np.float32)
                value = ((np.exp(1j * angle) - mean[:, None]) * series[:, near]) @ seen[near]
                squares[i] += weight**2 * abs(value) ** 2
            amount[i] += weight * seen.sum()
        weighted = np.where(amount > 0, amount, np.inf)
        rows.append((squares / weighted[:, None]).sum(axis=0) / max(amount.sum(), 1e-300))
    return np.array(rows)


def _rows(
    survey: Survey,
    scans: list[_Scan],
    template: Template,
) -> list[tuple[Floats, Floats, AnyFloats]]:
    """For each scan the series of a template, added up over groups of detectors that are near to
    each other; the groups' offsets, and their shares of the detectors.
    """
    every = len(survey.offsets)
    most = max(len(scan.track.index) for scan in scans)
    few = subset(every, max(DETECTORS, round(TEMPLATE / most)), seed=6)
    offsets = survey.offsets[few]
    cell = np.ptp(offsets, axis=0).max() / GROUPS + 1e-12
    places = np.floor((offsets - offsets.min(axis=0)) / cell)
    _, which = np.unique(places, axis=0, return_inverse=True)
    adds = np.zeros((which.max() + 1, len(few)), np.float32)
    adds[which.ravel(), np.arange(len(few))] = 1
    size = adds.sum(axis=1)
    found = []
    for scan, weight in zip(scans, survey.weights, strict=False):
        rows = adds @ template.rows(scan.track, few)
        rows *= weight * scan.track.step * every / len(few)
        found.append((adds @ offsets / size[:, None], size / len(few), rows))
    return found


def _of_template(
    survey: Survey,
    scans: list[_Scan],
    rows: list[tuple[Floats, Floats, AnyFloats]],
    model: Layer,
    waves: Floats,
) -> Floats:
    """(n_scan, n_wave) the square in equation (1) of a template (`Template`), after each scan."""
    squares = []
    n = len(waves)
    for scan, (offsets, share, seen) in zip(scans, rows, strict=True):
        both, across = scan.waves(survey, model, waves)
        phases = np.exp(1j * (across @ offsets.T)).astype(np.complex64)
        if survey.common:
            phases -= (phases @ share)[:, None]
        value = ((phases @ seen) * (both[:n] + 1j * both[n:])).sum(axis=1)
        squares.append(abs(value) ** 2)
    return np.cumsum(squares, axis=0)


def _covariance(
    survey: Survey,
    scan: _Scan,
    some: Floats,
    model: Layer,
    waves: Floats,
    weights: Floats,
) -> tuple[Floats, Floats]:
    """(n, n) covariance [K^2] of a layer in the filtered samples of some detectors over a scan;
    spectrum of what they have in common."""
    series, across = scan.waves(survey, model, waves)
    energy, squares = (
        each.reshape(2, len(waves), -1).sum(axis=0)
        for each in (np.abs(np.fft.rfft(series)) ** 2, series.astype(np.float64) ** 2)
    )
    seen = np.exp(1j * (across @ some.T))
    shared = weights * abs(seen.mean(axis=1)) ** 2
    return ((seen.conj().T * (squares.mean(axis=1) * weights)) @ seen).real, shared @ energy


def _mode(survey: Survey, covariance: Floats, spectrum: Floats) -> Mode:
    """See `Mode`.

    Noise of variance s^2, and of the spectrum R f_s / 2 at the frequencies of the common mode (on
    average over its power), turns the mode of n detectors with the eigenvalue L in a scan of N
    samples by

        <|du|^2> = (n - 1) R f_s / 2 (L + s^2) / L^2 / N                                         (2)

    (Anderson 1963 where it is white); that share of the common mode, which is L / n a sample,
    stays.
    """
    independent = 2 * float(spectrum.sum()) ** 2 / max(float((spectrum**2).sum()), 1e-300)
    number = len(survey.offsets)
    few = len(covariance)
    o = survey.observations[0]
    f = np.linspace(max(survey.cut, 1 / o.duration), o.sample_rate / 2, 4000)
    own = np.zeros_like(f)
    shared = 0.0
    for noise in survey.levels[0]:
        power = np.ones_like(f) if noise.spectrum is None else noise.spectrum(f)
        each = noise.sample**2 / (o.sample_rate / 2) * power
        own += (1 - noise.shared) * each
        shared += noise.shared * float(np.trapezoid(each, f))
    variance = float(np.trapezoid(own, f))
    if not variance > 0:
        return Mode(independent, 0.0, Noise(0.0))
    values = 2 * o.duration * variance**2 / float(np.trapezoid(own**2, f))
    eigenvalues, vectors = np.linalg.eigh(covariance + shared)
    u = vectors[:, -1]
    first = max(float(eigenvalues[-1]), 1e-300) * number / few
    step = survey.steps.common
    second = variance * (1 + math.sqrt(number / values)) ** 2
    if step is not None and step.on_undetermined == "mean" and second > first + variance:
        # it is lost in the noise, far from determined: the detectors' mean is removed
        return Mode(independent, 0.0, Noise(0.0))
    track = survey.track(0, _rate(survey))
    grid = np.fft.rfftfreq(len(track.index), 1 / track.rate)
    frequency = np.maximum(grid, f[0])
    along = float(spectrum @ (np.interp(frequency, f, own) * o.sample_rate / 2) / spectrum.sum())
    turned = (number - 1) * (first + variance) * along / first**2 / o.n_samples
    stays = turned * float(u @ covariance @ u) / few
    power = stays * spectrum / spectrum.sum() / (frequency[1] - grid[0])
    density = power * o.sample_rate / 2
    return Mode(
        independent,
        stays,
        Noise(1.0, lambda at: np.interp(at, frequency, density, right=0.0)),
    )
