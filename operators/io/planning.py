"""Planning of the steps that read and write files: what they read and what they cost."""

from __future__ import annotations

import numpy as np

from zonda.core.observation import Observation
from zonda.core.plan.context import Context
from zonda.core.plan.estimate import Cost, Estimate, Traits
from zonda.core.plan.planning import Planning

from .load_tod import LoadTOD
from .recorded_stream import levels
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


class LoadTODPlanning(Planning[LoadTOD]):
    """What the recorded stream brings into the map: the noise that the file states, fluctuations as
    they are in parts of it.
    """

    of = LoadTOD

    def traits(self, observation: Observation) -> Traits:
        """The white noise of the file's NET; the rms of parts of the first scan's stream."""
        stream = self.operator.open(observation)
        if stream is None:
            return Traits()
        try:
            _, spread = levels(stream, observation.n_detectors, observation.n_samples)
        finally:
            stream.file.close()
        use = observation.good_detectors
        each = observation.focalplane.net * np.sqrt(observation.sample_rate)
        rms = float(spread[use].max(initial=0.0))
        if not use.any() or not (each[use] > 0).all():
            return Traits(rms=rms)
        each[~use] = each[use].min()  # they are in no map
        return Traits(noise=float(each.min()), each=each, rms=rms)

    def estimate(self, context: Context) -> Estimate:
        """Its cost: the file is opened, and each sample read once."""
        return Estimate((), Cost(0.3, 0.5e-6, 8e-9 if self.operator.signal is not None else 0.0))

    def memory(self, observation: Observation) -> int:
        """What the library that reads the file holds, and the parts in which it is read."""
        return 40_000_000
