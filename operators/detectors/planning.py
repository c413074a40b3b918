"""Planning of the detectors' effects: bounds and memory (`core.plan`)."""

from __future__ import annotations

import math

from zonda.core.observation import Observation
from zonda.core.plan.bounds import Context, Estimate, Traits, calibration, single
from zonda.core.plan.planning import Planning

from .crosstalk import Crosstalk
from .gain_drift import GainDrift, grid
from .glitches import REACH, Glitches
from .time_constant import TimeConstant


class GainPlanning(Planning[GainDrift]):
    """It has no coarser form."""

    of = GainDrift

    def traits(self, observation: Observation) -> Traits:
        """Gains that the calibration does not know."""
        return Traits(gain_error=self.operator.rms)

    def memory(self, observation: Observation) -> int:
        """The gains at their nodes."""
        step, _, _ = grid(observation, self.operator.fastest)
        return 8 * observation.n_detectors * (observation.n_samples // step + 4)

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the drift out: the rms of the gains times all that is in the stream,
        the mean emission included.
        """
        return single(
            "gain drift",
            context.of_all(self.operator.rms, common=False),
            "rms of the gains x (rms of the stream + mean emission); of the sky, rms of the gains",
        )


class TimeConstantPlanning(Planning[TimeConstant]):
    """It has no coarser form."""

    of = TimeConstant

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out, of a point source: 1 - |H| at the highest frequency of a
        beam that passes.
        """
        o = context.first
        tau = self.operator.tau
        speed = context.coverage.speed if context.coverage else 0.0
        # a Gaussian of FWHM passes to 1 % of its power below 0.71 v / FWHM
        frequency = min(0.71 * speed / float(o.focalplane.fwhm.min()), o.sample_rate / 2)
        loss = 1 - 1 / math.hypot(1, 2 * math.pi * frequency * tau)
        return single(
            "time constant",
            context.sky_error(loss),
            "1 - |1 / (1 + 2 pi i f tau)| at f = 0.71 v / FWHM",
            "exact below 0.46 of the sample rate",
        )


class CrosstalkPlanning(Planning[Crosstalk]):
    """Exact: it has no coarser form."""

    of = Crosstalk

    def memory(self, observation: Observation) -> int:
        """The pairs."""
        return 24 * int(self.operator.shares(observation).nnz)

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out: the signals of others, all alike.

        A table may give one detector more than the rest.
        """
        shares = abs(self.operator.shares(context.first))
        largest = float(shares.sum(axis=1).max(initial=0.0))
        return single(
            "crosstalk",
            context.of_all(largest),
            "largest sum of a detector's shares x (rms of the stream + mean emission); of the sky,"
            " that sum",
        )


class GlitchPlanning(Planning[Glitches]):
    """It has no coarser form."""

    of = Glitches

    def traits(self, observation: Observation) -> Traits:
        """Rms of the glitches in a stream (Campbell's theorem)."""
        return Traits(rms=self._rms(observation))

    def memory(self, observation: Observation) -> int:
        """Times and amplitudes, and what they are sorted from."""
        span = observation.duration + REACH * self.operator.decay
        return int(64 * observation.n_detectors * (self.operator.rate * span + 8))

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out."""
        size = context.bound(self._rms(context.first), self.operator.decay)
        text = "sqrt(rate decay) amplitude (Campbell), at the detector, over zeta e^-tau"
        return single("glitches", size, text, without=size)

    def _rms(self, observation: Observation) -> float:
        step = self.operator
        return math.sqrt(step.rate * step.decay) * step.amplitude * calibration(observation)
