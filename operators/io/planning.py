"""Planning of the steps that write files: what they read and what they cost."""

from __future__ import annotations

from zonda.core.plan.context import Context
from zonda.core.plan.estimate import Cost, Estimate
from zonda.core.plan.planning import Planning

from .save_map import SaveMap
from .save_tod import SaveTOD


class SaveMapPlanning(Planning[SaveMap]):
    """A cost for every map."""

    of = SaveMap
    holds = 20_000_000
    """A map and its copy in the file's units."""

    def estimate(self, context: Context) -> Estimate:
        """Its cost."""
        return Estimate((), Cost(once=0.02 * (1 + len(context.work.signals)), kernel="python"))


class SaveTODPlanning(Planning[SaveTOD]):
    """It reads the streams; its cost is that of writing them."""

    of = SaveTOD
    reads_streams = True

    def estimate(self, context: Context) -> Estimate:
        """Its cost."""
        return Estimate((), Cost(0.1, 0.0, 6e-9 * len(self.operator.streams)))
