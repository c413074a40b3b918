"""Planning of functions as steps."""

from __future__ import annotations

from ..function_operator import FunctionOperator
from ..observation import Observation
from .planning import Planning


class FunctionPlanning(Planning[FunctionOperator]):
    """Planning of a function, whose cost and effect are not known."""

    of = FunctionOperator
    smaller = "make the scan shorter, or couple less: couples='all' holds a whole scan in float64"

    def memory(self, observation: Observation) -> int:
        """With ``couples="all"`` the scan in float64, what the function makes of it, and that of
        each signal.
        """
        if self.operator.couples != "all":
            return 0
        return 8 * (2 + len(observation.signals)) * observation.n_detectors * observation.n_samples
