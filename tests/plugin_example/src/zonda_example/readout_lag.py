"""An operator: a read-out that lags behind the detectors."""

from typing import ClassVar

import numpy as np

from zonda import Operator, Seconds, quantity


class ReadoutLag(Operator):
    """Blur each time stream with exp(-t / tau) / tau for t >= 0, cut off after 8 tau (3e-4 of the
    response).
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})

    tau: Seconds = quantity("40 ms", gt=0, le=10)
    """Time constant."""

    def halo(self, observation):
        return int(np.ceil(8 * self.tau * observation.sample_rate))

    def prepare(self, observation):
        taps = np.exp(-np.arange(self.halo(observation) + 1) / (self.tau * observation.sample_rate))
        return taps / taps.sum()

    def exec(self, block, taps):
        signal = block.detdata["signal"]
        padded = np.concatenate([np.repeat(signal[:, :1], len(taps) - 1, axis=1), signal], axis=1)
        n = signal.shape[1]
        signal[...] = 0
        for delay, tap in enumerate(taps):
            first = len(taps) - 1 - delay
            signal += signal.dtype.type(tap) * padded[:, first : first + n]
