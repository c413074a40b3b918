"""Bounds and costs of the detectors' noise, see `core.plan`."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import ZondaError
from zonda.core.plan.context import LEAKS
from zonda.core.plan.estimate import Choice, Cost, Effect, Estimate, Traits, add, full

from .level import NoiseLevel, announced
from .models import FixedNet
from .one_over_f import PowerLawFilter, power_law_filter

if TYPE_CHECKING:
    from zonda.core.data import Observation
    from zonda.core.plan.context import Context

    from .pink import PinkNoise

WHITE = Cost(per_sample=2e-9, kernel="random")


def pink_cost(poles: int) -> Cost:
    """The kernel takes poles four at a time."""
    return Cost(fixed=0.01, per_sample=1.7e-9 + 0.75e-9 * math.ceil(poles / 4), kernel="random")


def white_traits(level: NoiseLevel, observation: Observation) -> Traits:
    """rms of one calibrated sample of each detector, under the load that ``observation.smooth`` says."""
    each = calibrated(level, observation)
    return Traits(noise=float(each.min(initial=np.inf)) if each.size else 0.0, each=each)


def calibrated(level: NoiseLevel, observation: Observation) -> NDArray[np.float64]:
    """(n_det,) rms of one calibrated sample over the scan, K, under the load of its smooth means."""
    return np.asarray(level.sky_net(observation) * math.sqrt(observation.sample_rate), np.float64)


def pink_traits(pink: PinkNoise, observation: Observation) -> Traits:
    """rms of one calibrated sample, and of what of it is faster than a frequency."""
    law, sigma, factor = _law(pink, observation, pink.poles)
    if law is None:
        return Traits()
    rate, rms = observation.sample_rate, sigma * factor * math.sqrt(law.gain * law.variance)
    grid = np.geomspace(1e-9, 0.5, 600)
    power = np.abs(_amplitude(law, grid)) ** 2
    above = np.append(np.cumsum((np.diff(grid) * (power[1:] + power[:-1]))[::-1])[::-1], 0.0)  # 2 int_f^(1/2) g |H|^2 df

    def faster(frequency: float) -> float:
        share = float(np.interp(math.log(max(frequency / rate, 1e-9)), np.log(grid), above))
        return min(sigma * factor * math.sqrt(share), rms)

    return Traits(rms=rms, faster=faster)


def pink_estimate(pink: PinkNoise, context: Context) -> Estimate:
    """Poles of the recursive filter, and the noise altogether."""
    o = context.lowest
    law, sigma, factor = _law(pink, o, pink.poles)
    cost = pink_cost(pink.poles)
    if law is None:
        return Estimate((), Cost(per_sample=0.3e-9))
    level = (sigma * factor) ** 2 / max(context.noise, 1e-30) ** 2
    common = pink.shared > 0 and not context.removes_common
    choices = [full(f"{pink.poles} poles")]
    for poles in (12, 8, 4):
        if poles >= pink.poles:
            continue
        try:
            coarse, _, _ = _law(pink, o, poles)
        except ZondaError:
            break
        assert coarse is not None
        power = difference(law, coarse, context, o.sample_rate, o.duration)
        bound = context.bound(sigma * factor * math.sqrt(power), correlated=_correlated(law, context), common=common)
        if context.before_filters:
            free = difference(law, coarse, replace(context, traits={}), o.sample_rate, o.duration)
            bound["tod"] = sigma * factor * math.sqrt(free)
        bound["psd"] = psd_error(law, coarse, level)
        text = "2 NET^2 (f_knee/f_min)^slope int |H - H_coarse|^2 R^2 df, same innovations; R: high-pass filter"
        saved = cost.seconds(context.times, o.n_detectors) - pink_cost(poles).seconds(context.times, o.n_detectors)
        choices.append(Choice("coarse", f"{poles} poles", {"poles": poles}, bound=bound, formula=text, seconds=saved))
    rms = pink_traits(pink, o).rms
    passed = rms
    if context.cut > 0:
        traits = pink_traits(pink, o)
        assert traits.faster is not None
        passed = LEAKS * traits.faster(context.cut)
    size = context.bound(passed, correlated=_correlated(law, context), common=common)
    if context.before_filters:
        size["tod"] = rms
    size["psd"] = level * float(law.response(np.array([0.1 / (o.duration * o.sample_rate)]))[0])
    text = "1.5 (2 NET^2 int (f_knee/f)^slope R^2 df)^(1/2), correlated for int |rho| dt; R: high-pass filter"
    if pink.shared == 0 and not context.kept_streams & pink.provides:
        # a common part would be what a singular mode consists of: it is not dropped
        saved = cost.seconds(context.times, o.n_detectors) + 0.5e-9 * context.samples
        choices.append(Choice("dropped", "none", leave_out=True, bound=size, formula=text, seconds=saved))
    without = dict(size)
    if pink.shared > 0 and context.removes_common:
        without = add(size, context.other_modes(pink.label))
    return Estimate((Effect("poles", tuple(choices), size, text),), cost, without)


def difference(a: PowerLawFilter, b: PowerLawFilter, context: Context, rate: float, duration: float) -> float:
    """Variance of the difference of two filters' outputs for the same white noise of unit variance, after the filters R.

    2 int_0^(1/2) |sqrt(g_a) H_a - sqrt(g_b) H_b|^2 R^2 df, in logarithmic steps. The stationary first states are drawn
    independently: what they differ by dies out within 1 / (2 pi f) at a frequency f, which adds
    2 S(f) R^2 / (2 pi f T) to the integrand's spectrum S.
    """
    f = np.geomspace(1e-3 / (duration * rate), 0.5, 4000)
    delta = np.abs(_amplitude(a, f) - _amplitude(b, f)) ** 2
    start = 2 * np.abs(_amplitude(a, f)) ** 2 * np.minimum(1.0, 1 / (2 * np.pi * f * rate * duration))
    passed = np.array([context.response(float(x * rate)) ** 2 for x in f])
    return float(2 * np.trapezoid((delta + start) * passed, f))


def psd_error(a: PowerLawFilter, b: PowerLawFilter, level: float) -> float:
    """Largest relative error of the spectrum of pink plus white noise; ``level``: of unit responses over white noise."""
    f = np.geomspace(1e-8, 0.5, 4000)
    first, second = level * a.response(f), level * b.response(f)
    return float((np.abs(second - first) / (1 + first)).max())


def _amplitude(law: PowerLawFilter, f: Any) -> Any:
    """sqrt(g) H, complex, of equation (1) of `one_over_f`."""
    back = np.exp(-2j * np.pi * f)
    top = np.prod(1 - (1 - law.zeros[:, None]) * back, axis=0)
    return math.sqrt(law.gain) * top / np.prod(1 - (1 - law.poles[:, None]) * back, axis=0)


def _correlated(law: PowerLawFilter, context: Context) -> float:
    """int |rho| dt over all lags, s, of noise that the high-pass filter has freed of what is slower than its cut.

    rho from the power above the cut f_c, on a grid of f_c / 16 up to 256 f_c: what is faster correlates less.
    """
    if context.cut <= 0:
        return context.first.duration
    cut, rate = context.cut, context.first.sample_rate
    n = 4096
    f = np.arange(n + 1) * cut / 16
    power = np.where((f >= cut) & (f <= rate / 2), law.response(np.maximum(f, cut) / rate), 0.0)
    if not power.sum() > 0:
        return 1 / cut
    rho = np.fft.irfft(power)
    return float(np.abs(rho / rho[0]).sum() / (2 * f[-1]))


def _law(pink: PinkNoise, observation: Observation, poles: int) -> tuple[PowerLawFilter | None, float, float]:
    """(filter, white rms of one calibrated sample [K], (f_knee / f_min)^(slope / 2)); no filter where the knee is 0."""
    instrument, rate = observation.instrument, observation.sample_rate
    knee = instrument.knee if pink.knee is None else pink.knee
    slope = pink.slope or instrument.slope
    f_min = pink.minimum_frequency or instrument.pink_minimum_frequency
    if knee == 0:
        return None, 0.0, 0.0
    level = announced(observation)
    if pink.net is not None:
        level = NoiseLevel(FixedNet.of(pink.net, pink.reference), np.ones(observation.n_detectors))
    sigma = float(np.max(calibrated(level, observation)))
    return power_law_filter(f_min / rate, slope, poles), sigma, (knee / f_min) ** (slope / 2)
