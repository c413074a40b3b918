"""Glitches: short pulses in single detectors, such as cosmic rays make.

    g(t) = sum_i A_i exp(-(t - t_i) / tau)   for t >= t_i,   (1)

arrivals t_i of a Poisson process of rate lambda in each detector, amplitudes A_i exponentially
distributed with mean A: shot noise of mean lambda A tau and variance lambda A^2 tau (Campbell 1909;
Planck 2013 results X has such pulses and their rates). A sample is the value at its time; what
arrives between two samples is seen from the next one on, decayed. After `REACH` tau a pulse is
over.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Hertz, Kelvin, Seconds
from zonda.core.data import Block, Data, Observation
from zonda.core.kernels import kernel
from zonda.core.numerics.random import uniforms
from zonda.core.operator import Operator
from zonda.core.signal import Component
from zonda.core.types import Floats

REACH = 23
"""Decay times after which a pulse counts no more: e^-23 = 1e-10."""

Pulses = list[tuple[Floats, Floats]]
"""Times (n,) [s since the start], rising, and amplitudes (n,) [K] for each detector of a scan."""


class Glitches(Operator):
    """Pulses A exp(-(t - t_i) / decay) at random times t_i in each detector: the component
    ``glitches`` at the detector.

    Samples in which pulses exceed `flag_above` are lost, as if a glitch finder had found them: they
    become NaN, filters bridge them in every signal, and no map uses them. The log counts pulses and
    samples.
    """

    requires = frozenset({"boresight"})
    provides = frozenset({Component("glitches", "at the detector")})

    rate: Hertz = quantity("2 mHz", ge=0, le=1e3)
    """Mean number of pulses per second in each detector."""
    amplitude: Kelvin = quantity("0.1 K", gt=0)
    """Mean amplitude, K_RJ at the detector."""
    decay: Seconds = quantity("10 ms", gt=0, le=60)
    """Decay time."""
    flag_above: Kelvin | None = Field(None, ge=0)
    """Samples above this (K_RJ at the detector) are lost; where absent, none are."""

    def prepare(self, observation: Observation) -> Pulses:
        """Draw the pulses of all detectors from `REACH` decay times before the scan to its end."""
        begin = -REACH * self.decay
        end = float(observation.seconds[-1])
        found = []
        for d in range(observation.n_detectors):
            when, u = self._of_detector(observation, d, end - begin)
            found.append((begin + when, -self.amplitude * np.log(u)))
        inside = sum(int(np.count_nonzero(times >= 0)) for times, _ in found)
        observation.log.count(self.label, "glitches", inside)
        return found

    def exec(self, block: Block, state: Pulses) -> None:
        """Add the pulses of the block's detectors."""
        stream = block.new("glitches")
        observation = block.observation
        threshold = math.inf if self.flag_above is None else self.flag_above
        lost = 0
        for row, (times, sizes) in zip(stream, state[block.detectors], strict=True):
            if times.size:
                seconds = observation.seconds[block.samples]
                lost += _add_pulses(times, sizes, self.decay, seconds, threshold, row)
        if self.flag_above is not None:
            size = block.shape[0] * block.shape[1]
            observation.log.count(self.label, "samples lost to glitches", lost, size)

    def collect(self, data: Data, observation: Observation, state: Pulses) -> None:
        """State how many detectors had one."""
        hit = sum(times.size > 0 for times, _ in state)
        observation.log.count(self.label, "detectors with glitches", hit, observation.n_detectors)

    def _of_detector(
        self,
        observation: Observation,
        detector: int,
        span: float,
    ) -> tuple[Floats, Floats]:
        """(arrival times within ``span``, uniform deviates of the amplitudes): waiting times are
        exponential.
        """
        if self.rate == 0:
            return np.zeros(0), np.zeros(0)
        key = observation.detector_key(self.label)
        mean = self.rate * span
        number = int(mean + 6 * math.sqrt(mean) + 16)
        while True:
            u = uniforms(key, 0, 2 * number, stream=detector).reshape(
                -1,
                2,
            )  # pairs, so that more of them begin with the same
            when = np.cumsum(-np.log(u[:, 0])) / self.rate
            if when[-1] > span:
                kept = int(np.searchsorted(when, span))
                return when[:kept], u[:kept, 1]
            number *= 2


@kernel
def _add_pulses(times, amplitudes, decay, seconds, threshold, out):  # type: ignore[no-untyped-def]
    """Add equation (1) at ``seconds`` (n,) to ``out`` (n,); NaN where it is above the threshold.
    Returns how many are.

    Each sample is the sum over the pulses in their order, whatever the block.
    """
    lost, first = 0, 0
    for t in range(seconds.size):
        while first < times.size and times[first] < seconds[t] - REACH * decay:
            first += 1
        total, k = 0.0, first
        while k < times.size and times[k] <= seconds[t]:
            total += amplitudes[k] * np.exp((times[k] - seconds[t]) / decay)
            k += 1
        if total > threshold:
            out[t] = np.nan
            lost += 1
        elif total > 0.0:
            out[t] += total
    return lost
