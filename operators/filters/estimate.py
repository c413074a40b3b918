"""Bounds and costs of the filters, see `core.plan`."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

from zonda.core.plan.context import LEAKS
from zonda.core.plan.estimate import Choice, Cost, Effect, Estimate, Traits, full

if TYPE_CHECKING:
    from zonda.core.data import Observation
    from zonda.core.plan.context import Context

    from .common_mode import CommonModeFilter
    from .highpass import HighpassFilter


def highpass_traits(operator: HighpassFilter, observation: Observation) -> Traits:
    """A brick wall; a scan shorter than one cycle loses only a line."""
    cut = operator.frequency if observation.duration * operator.frequency >= 1 else 0.0
    return Traits(response=lambda f: float(f >= cut))


def highpass_estimate(operator: HighpassFilter, context: Context) -> Estimate:
    """Knots of the coarse series: the low part errs by (f / f_cut)^4 q^-4 below the cut, q knots per cycle of the cut."""
    o = context.first
    knots = operator.oversampling * operator.frequency * o.duration
    cost = Cost(fixed=0.01, per_time=5e-8, per_sample=2e-9 + 2e-8 * knots / o.n_samples, bytes=64.0 * o.n_samples)
    choices = [full(f"{operator.oversampling:g} knots per cycle of the cut")]
    cut = operator.frequency
    near = LEAKS * context.weighted(lambda f: min((f / cut) ** 4, 1.0), 0.0, cut)
    for q in (16.0, 12.0, 8.0):
        if q < operator.oversampling:
            share = q**-4 + operator.oversampling**-4
            bound = context.bound(near * share, 1 / cut, common=True)
            bound |= context.sky_error(share) | {"psd": 2 * share + share**2}
            saved = 2e-8 * (knots - q * cut * o.duration) * o.n_detectors * len(context.observations)
            text = "1.5 sqrt(int_0^f_cut S (f / f_cut)^8 df) x (q^-4 + q_full^-4), q knots per cycle of the cut"
            choices.append(
                Choice("coarse", f"{q:g} knots per cycle", {"oversampling": q}, bound=bound, formula=text, seconds=saved)
            )
    size = context.bound(context.fluctuation, o.duration, common=True)
    effect = Effect("high-pass decimation", tuple(choices), size, "rms of the stream: its low part removed wrongly altogether")
    left_in = {m: size[m] + context.mean_emission for m in size}
    return Estimate((effect,), cost, left_in | context.sky_error(1.0))


LANCZOS = 0.5e-9
"""Seconds per sample of one step of the iteration, which reads the stream once."""


START = 1e-3
"""Residual of the first vector, the detectors' mean."""


def steps(residual: float, modes: int, context: Context) -> int:
    """Steps that a residual takes: each lessens it by the square of the ratio of the noise's singular values to the mode's."""
    n_det, noise = context.first.n_detectors, max(context.noise, 1e-12)
    common = max((context.passed / LEAKS) ** 2 - noise**2, 0.0) if context.cut > 0 else context.fluctuation**2
    shrink = min(noise**2 * (1 / n_det + 1e-4) / max(common, 1e-30), 0.5)
    return modes + max(1, math.ceil(math.log(residual / START) / math.log(shrink)))


def common_mode_estimate(operator: CommonModeFilter, context: Context) -> Estimate:
    """Residual of the modes.

    A residual r turns the mode by at most r sigma_1^2 / (sigma_1^2 - sigma_2^2) <= r / (1 - gap^2), a mode that is determined
    having sigma_2 <= gap sigma_1: equation (2) of `common_mode`, Davis & Kahan (1970).
    """
    count = steps(operator.residual, operator.modes, context) if operator.method == "svd" else 1.0
    cost = Cost(fixed=0.01, per_sample=0.4e-9 + LANCZOS * count)
    size = context.bound(context.passed, _slow(context), common=True)
    without = size | context.sky_error(1.0)
    if operator.method == "mean":
        return Estimate((), cost, without)
    choices = [full(f"residual {operator.residual:g}")]
    for residual in (1e-4, 1e-3, 1e-2):
        if residual > operator.residual:
            share = math.sqrt(operator.modes) * (residual + operator.residual) / (1 - operator.gap**2)
            bound = context.bound(share * context.passed, _slow(context), common=True) | {"psd": 2 * share + share**2}
            saved = LANCZOS * (count - steps(residual, operator.modes, context)) * context.samples
            choices.append(
                Choice(
                    "coarse",
                    f"residual {residual:g}",
                    {"residual": residual},
                    bound=bound | context.sky_error(share),
                    formula="rms of the stream behind the high-pass filter x residual / (1 - gap^2)",
                    seconds=saved,
                )
            )
    effect = Effect("common-mode residual", tuple(choices), size, "rms of the stream: no common mode removed at all")
    return Estimate((effect,), cost, without)


def _slow(context: Context) -> float:
    return 1 / context.cut if context.cut > 0 else context.first.duration
