"""Planning of the optics: bounds and memory (`core.plan`)."""

from __future__ import annotations

from typing import Any

import numpy as np

from zonda.core.observation import Observation
from zonda.core.plan.bounds import Context, Estimate, Traits, calibration, single
from zonda.core.plan.planning import Planning

from .efficiency import Efficiency
from .field_ratio import AT_ONCE


class EfficiencyPlanning(Planning[Efficiency]):
    """Exact: it has no coarser form."""

    of = Efficiency

    def traits(self, observation: Observation) -> Traits:
        """Gains that the calibration does not know."""
        return Traits(gain_error=self.operator.calibration_error)

    def memory(self, observation: Observation) -> int:
        """Means at their nodes, and the parts that `field_ratio` works on at a time."""
        at_once = min(AT_ONCE, observation.n_detectors)
        return 700 * observation.n_detectors + 64 * at_once * (observation.n_samples // 512 + 3)


class GroundPlanning(Planning[Any]):
    """It has no coarser form."""

    of = "zonda.operators.optics.ground_pickup:GroundPickup"
    per_sample, per_detector = 64, 8
    """The profile, and what it is made of."""

    def traits(self, observation: Observation) -> Traits:
        """Rms of what the step adds to a stream."""
        return Traits(rms=self._rms(observation))

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out.

        A filter that removes what detectors have in common removes most of it: that is not counted.
        """
        rms = max(self._rms(o) for o in context.observations)
        size = context.bound(rms, context.first.duration, common=True)
        text = "rms (e / 45 deg)^power at the lowest elevation, at the detector, over zeta e^-tau"
        return single("ground pickup", size, text, without=size)

    def _rms(self, observation: Observation) -> float:
        step = self.operator
        elevation = observation.elevation
        ends = np.array([elevation.min(), elevation.max()]) / (np.pi / 4)
        return float(
            step.rms * (1 + 3 * step.scatter) * np.max(ends**step.power) * calibration(observation)
        )


class HalfWavePlatePlanning(Planning[Any]):
    """Planning of `HalfWavePlate`: memory of its angles, and the error of leaving it out."""

    of = "zonda.operators.optics.polarizers:HalfWavePlate"
    per_sample = 8
    """The angles."""

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out: polarized detectors see Q and U at other angles, up to
        2 (Q^2 + U^2)^(1/2) apart.
        """
        efficiency = context.first.focalplane.polarization_efficiency
        most = 2 * context.peak * float(efficiency.max(initial=0.0))
        size = {"tod": most, "map_rms": most}
        return single(
            "half-wave plate",
            size | ({"peak": most, "transfer": 2.0} if most else {}),
            "2 p x the sky's brightness, which its polarized one cannot exceed",
            "exact: ideal, of one angle",
        )


class LeakagePlanning(Planning[Any]):
    """Exact: it has no coarser form."""

    of = "zonda.operators.optics.polarizers:Leakage"

    def memory(self, observation: Observation) -> int:
        """The plate's angles."""
        return 8 * observation.n_samples if observation.hwp_angle is not None else 0

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out."""
        efficiency = context.first.focalplane.polarization_efficiency
        share = self.operator.share * float(efficiency.max(initial=0.0))
        text = "p l x (rms of the stream + mean emission); of the sky, p l"
        return single("leakage", context.of_all(share), text)
