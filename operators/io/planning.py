"""Planning of the steps that read and write files: their streams and memory."""

from __future__ import annotations

import numpy as np

from zonda.core.observation import Observation
from zonda.core.plan.bounds import Traits
from zonda.core.plan.planning import Planning

from .load_tod import LoadTOD
from .recorded_stream import levels
from .save_map import SaveMap
from .save_tod import SaveTOD


class SaveMapPlanning(Planning[SaveMap]):
    """It holds a map while it is written."""

    of = SaveMap
    holds, per_pixel = 5_000_000, 54
    """Copies of planes in the file's units and byte order, `MOST_AT_ONCE` files."""


class SaveTODPlanning(Planning[SaveTOD]):
    """It reads the streams."""

    of = SaveTOD
    reads_streams = True


class LoadTODPlanning(Planning[LoadTOD]):
    """A recorded stream: the noise that the file states, fluctuations measured in parts of it."""

    of = LoadTOD
    holds = 40_000_000
    """The library that reads the file, and the parts in which it is read."""

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
