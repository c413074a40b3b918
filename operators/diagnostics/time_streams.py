"""Keep a few detectors' time streams for a picture."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from zonda.core.data import Block, Data, Observation
from zonda.core.stream_names import StreamName
from zonda.core.types import Floats

from .series import OfStreams, TimeStream


class TimeStreams(OfStreams):
    """Streams of a few detectors of one scan at this step, for a picture: product ``time_streams``.

    Components (`sky`, `white`, those of plugins ...) are at the detector, before the calibration;
    `signal` is the calibrated sum. `signal` holds the mean emission of the atmosphere, `atmosphere`
    is the fluctuation about it. Further streams are those that a step above makes, e.g. `pwv`,
    `opacity` and `path_delay` (`AtmosphereLayers.outputs`).
    """

    provides: ClassVar[frozenset[str]] = frozenset({"time_streams"})
    knows_means: ClassVar[bool] = True

    streams: list[StreamName] = Field(["signal"], min_length=1)
    """Streams to keep; components that are absent at this step are skipped and counted."""
    detectors: int = Field(3, ge=1, le=64)
    """Number of detectors, chosen evenly."""
    observation: int = Field(0, ge=0)
    """Which scan, counted from 0."""

    def asked(self) -> list[str]:
        """The list."""
        return self.streams

    def check(self, data: Data) -> list[str]:
        """Refuse a scan that is not there, once the telescope is pointed."""
        if data.observations:
            data.check_scan(self.observation, self.label)
        return []

    def observe(self, data: Data) -> None:
        self.check(data)

    def prepare(self, observation: Observation) -> TimeStream | None:
        if observation.index != self.observation:
            return None
        n = observation.n_detectors
        shape = min(n, self.detectors), observation.n_samples
        chosen = np.linspace(0, n - 1, shape[0]).round().astype(int)
        names = [observation.focalplane.names[d] for d in chosen]
        streams: dict[str, Floats] = {name: np.full(shape, np.nan) for name in self.streams}
        return TimeStream(observation.seconds, streams, names, observation.name, self.label)

    def exec(self, block: Block, state: TimeStream | None) -> None:
        if state is None:
            return
        for k, detector in enumerate(state.names):
            d = block.observation.focalplane.names.index(detector)
            if block.detectors.start <= d < block.detectors.stop:
                for name in state.streams.keys() & block.detdata.keys():
                    values = block.detdata[name][d - block.detectors.start].astype(np.float64)
                    if name in block.means:
                        values += block.means[name].evaluate(slice(d, d + 1), block.samples)[0]
                    state.streams[name][k, block.samples] = values

    def collect(self, data: Data, observation: Observation, state: TimeStream | None) -> None:
        if state is None:
            return
        for name in [s for s, values in state.streams.items() if np.isnan(values).all()]:
            del state.streams[name]
            observation.log.count(self.label, f"stream {name} is absent at this step", 1)
        data.add(self.label, state)
