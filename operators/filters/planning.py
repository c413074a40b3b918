"""Planning of the filters: bounds, coarser forms and memory (`core.plan`)."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.observation import Observation
from zonda.core.plan.bounds import (
    LEAKS,
    Choice,
    Context,
    Effect,
    Estimate,
    Saving,
    Traits,
    full,
    single,
)
from zonda.core.plan.planning import Knob, Planning

from .common_mode import CommonModeFilter
from .gram import MOST_COPIED
from .highpass import HighpassFilter, amplitude
from .rows import ROWS

COARSE_KNOTS, LEAST_KNOTS = 8, 0.02
"""Knots per cycle of the cut of the coarser form; knots per sample that it must save."""

KNOTS = Saving("atlast_reduced", 0.022)
"""Of a third of the knots. Half of them save 1.5 %."""


class HighpassPlanning(Planning[HighpassFilter]):
    """Knots of the coarse series: the low part errs by (f / f_cut)^4 q^-4 below the cut, q knots
    per cycle of the cut.
    """

    of = HighpassFilter
    per_sample = 120
    """Spline weights; where the full DCT is used, the polynomials and what they are made from."""
    knobs = (Knob("oversampling", (8, 12, 24, 48), "slow part formed on a coarse series in time"),)

    def traits(self, observation: Observation) -> Traits:
        """A brick wall; a scan shorter than one cycle loses only a line. Of the Bessel filter, what
        passes a hundredth counts as passed."""
        frequency = self.operator.frequency
        rate = observation.sample_rate
        if self.operator.response == "bessel" and frequency < rate / 2:
            tried = np.geomspace(1e-3, 1, 200) * frequency
            cut = tried[np.argmax(amplitude(tried, frequency, rate) >= 0.01)]  # the last, 0.7, is
        else:
            cut = frequency if observation.duration * frequency >= 1 else 0.0
        return Traits(response=lambda f: float(f >= cut))

    def estimate(self, context: Context) -> Estimate:
        """The error of fewer knots; the Bessel filter has none."""
        if self.operator.response == "bessel":
            return Estimate()
        o = context.first
        cut = self.operator.frequency
        full_q = self.operator.oversampling
        choices = [full(f"{full_q:g} knots per cycle of the cut")]
        if (q := COARSE_KNOTS) < full_q:
            low = low_part(context, cut)
            both = (q, full_q)
            error = LEAKS * sum(
                math.hypot(low * images(x)[0], aliased(context, cut, x)) for x in both
            )
            share = sum(images(x)[1] for x in both)
            bound = context.bound(error, 1 / cut, common=True)
            bound |= context.sky_error(share) | {"psd": 2 * share + share**2}
            saves = KNOTS if (full_q - q) * cut / o.sample_rate > LEAST_KNOTS else None
            choices.append(Choice("coarse", f"{q:g} knots per cycle", {"oversampling": q},
                                  bound=bound, formula=DECIMATION, saves=saves))  # fmt: skip
        size = context.bound(context.fluctuation, o.duration, common=True)
        text = "rms of the stream: its low part removed wrongly altogether"
        effect = Effect("high-pass decimation", tuple(choices), size, text)
        return Estimate((effect,), without=_left_in(context))


DECIMATION = (
    "1.5 x rms of images of the cosines a_k below the cut, sqrt(sum a_k^2 (k / K)^8) / q^4, and of"
    " what lies at their places"
)


def images(q: float) -> tuple[float, float]:
    """rms and sum of the amplitudes of the two images that a coarse series of ``q`` knots per cycle
    of the cut makes of a cosine at the cut: sinc(k / 2M)^4 at 2M -+ k over that at k is (k / (2M -+
    k))^4 = (q -+ 1)^-4."""
    below = (q - 1) ** -4
    above = (q + 1) ** -4
    return math.hypot(below, above), below + above


def aliased(context: Context, cut: float, q: float) -> float:
    """Rms that the coarse series takes for the low part, K: the stream at the places of the
    images, weighed as they are; the mean of (k / K)^8 over the cosines is 1 / 9."""
    top = 0.5 * context.first.sample_rate
    if (q - 1) * cut >= top:
        return 0.0
    return (
        context.weighted(lambda f: 1.0, (q - 1) * cut, min((q + 1) * cut, top)) * (q - 1) ** -4 / 3
    )


def low_part(context: Context, cut: float) -> float:
    """sqrt(<sum_{k < K} a_k^2 (k / K)^8>), K: cosines below the cut of a scan of T, by their part
    in the error of the low part.

    A wave exp(i w t) has its own cosine, k = w T / pi, and in the others, as a scan has ends,

        a_k^2 <= (8 / pi^2) kappa^2 / (kappa^2 - k^2)^2,   kappa = w T / pi.
    """
    duration = context.first.duration
    last = max(math.ceil(2 * cut * duration), 1)
    k = np.arange(1, last)

    def in_others(f: float) -> float:
        kappa = 2 * f * duration
        apart = np.maximum(np.abs(k - kappa), 0.5) * (k + kappa)
        return math.sqrt(8 / math.pi**2 * float(((kappa / apart) ** 2 * (k / last) ** 8).sum()))

    own = context.weighted(lambda f: min((f / cut) ** 4, 1.0), 0.0, cut)
    return math.hypot(own, context.weighted(in_others, 0.0, 0.5 * context.first.sample_rate))


class DetrendPlanning(Planning[Any]):
    """Exact: it has no coarser form."""

    of = "zonda.operators.filters.polynomial:Detrend"

    def memory(self, observation: Observation) -> int:
        """Bytes: the polynomials, and a row in float64; with a mask, its pointing, and where some
        rows are in it.
        """
        masked = 3 + 2.5 * ROWS if self.operator.mask else 0.0
        order = self.operator.order
        return math.ceil(8 * (float(order) + 5 + masked) * observation.n_samples)


class PolynomialPlanning(DetrendPlanning):
    """Exact: it has no coarser form."""

    of = "zonda.operators.filters.polynomial:PolynomialFilter"

    def estimate(self, context: Context) -> Estimate:
        """Leaving it out leaves the mean and the slow part in."""
        left = _left_in(context)
        what = f"exact, order {self.operator.order}"
        return single("polynomials", left, LEFT_IN, what, without=left)


class GroundPlanning(Planning[Any]):
    """Exact: it has no coarser form."""

    of = "zonda.operators.filters.ground:GroundFilter"

    def memory(self, observation: Observation) -> int:
        """The trend, twice; bins, and what finds them; a row in float64."""
        trend: int = self.operator.trend
        return 8 * (2 * trend + 8) * observation.n_samples

    def estimate(self, context: Context) -> Estimate:
        """Leaving it out leaves the mean and the template in."""
        left = _left_in(context)
        return single("template in azimuth", left, LEFT_IN, without=left)


LEFT_IN = "rms of the stream + mean emission, which no filter before it takes; all of the sky"


def _left_in(context: Context) -> dict[str, float]:
    """Bound on the stream and the map if a filter that removes the mean is left out."""
    size = context.bound(context.fluctuation, context.first.duration, common=True)
    return {m: size[m] + context.mean_emission for m in size} | context.sky_error(1.0)


class DesplinePlanning(Planning[Any]):
    """Exact: it has no coarser form."""

    of = "zonda.operators.filters.polynomial:Despline"
    per_sample = 8 * 12
    """The splines at each sample, and what they are made from; a row in float64."""


class TaperPlanning(Planning[Any]):
    """Exact: it has no coarser form."""

    of = "zonda.operators.filters.taper:Taper"
    per_sample = 8
    """The window."""


class CommonModePlanning(Planning[CommonModeFilter]):
    """Planning of the common mode, which has no coarser form."""

    of = CommonModeFilter
    knobs = (Knob("residual", (1e-2, 1e-4, 1e-6, 1e-8), "singular modes iterated to a residual"),)

    def traits(self, observation: Observation) -> Traits:
        """Traits of a filter that removes the common mode."""
        several = observation.n_detectors > 1
        return Traits(removes_common=several, turns=several and self.operator.method == "svd")

    def memory(self, observation: Observation) -> int:
        """Series over the scan: one for each step of the iteration, or the sums of
        `common_mode.read_mean`.
        """
        n_det = observation.n_detectors
        n_samp = observation.n_samples
        if self.operator.method == "mean":
            return 8 * 8 * n_samp + 100 * n_det
        return 8 * (20 + 8 * self.operator.modes) * n_samp + 200 * n_det

    def per_thread(self, observation: Observation, spilled: int) -> int:
        """The copy of a tile of a stream on disk."""
        if self.operator.method == "mean":
            return 0
        size = spilled * observation.n_detectors * min(TILE_SAMPLES, observation.n_samples)
        return min(size, MOST_COPIED)

    def sweeps(self, observation: Observation) -> int:
        """One reading for the mean; the singular modes need the whole stream."""
        return 1 if self.operator.method == "mean" else 0

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out: what it removes."""
        step = self.operator
        slow = 1 / context.cut if context.cut > 0 else context.first.duration
        size = context.bound(context.passed, slow, common=True)
        without = size | context.sky_error(1.0)
        if step.method != "svd":
            return Estimate(without=without)
        text = "rms of the stream: no common mode removed at all"
        what = f"residual {step.residual:g}"
        return single("common-mode residual", size, text, what, without=without)
