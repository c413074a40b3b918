"""Planning of the optics: costs and memory (`core.plan`)."""

from __future__ import annotations

from zonda.core.observation import Observation
from zonda.core.plan.context import Context
from zonda.core.plan.estimate import Cost, Estimate, Traits
from zonda.core.plan.planning import Planning

from .efficiency import Efficiency
from .quotient import AT_ONCE


class EfficiencyPlanning(Planning[Efficiency]):
    """Exact: it has no coarser form."""

    of = Efficiency

    def traits(self, observation: Observation) -> Traits:
        """Gains that the calibration does not know."""
        return Traits(gain_error=self.operator.calibration_error)

    def memory(self, observation: Observation) -> int:
        """Means at their nodes, and the parts that `quotient` works on at a time."""
        at_once = min(AT_ONCE, observation.n_detectors)
        return 700 * observation.n_detectors + 64 * at_once * (observation.n_samples // 512 + 3)

    def estimate(self, context: Context) -> Estimate:
        """Its cost."""
        return Estimate((), Cost(0.005, 1e-8, 0.9e-9))
