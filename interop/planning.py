"""Planning of the bridges' operators."""

from __future__ import annotations

from zonda.core.observation import Observation
from zonda.core.plan.planning import Planning

from .toast_operator import ToastOperator


class ToastPlanning(Planning[ToastOperator]):
    """Planning of an operator of TOAST, whose cost and effect are not known."""

    of = ToastOperator
    smaller = "make the scan shorter: TOAST holds all of it in float64"

    def memory(self, observation: Observation) -> int:
        """For TOAST the signal in float64, its flags and as much again to work with; what it made
        of each signal.
        """
        return (
            (8 + 2 + 1 + 8 + 8 * len(observation.signals))
            * observation.n_detectors
            * observation.n_samples
        )
