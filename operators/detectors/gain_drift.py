"""Slow drift of the detectors' gains.

The signal of each detector is multiplied by

    g(t) = 1 + rms sum_k sqrt(p_k) (a_k cos 2 pi f_k t + b_k sin 2 pi f_k t),   f_k = k / P,
    (1)

P at least twice the scan's duration, a_k and b_k standard normal deviates, p_k ~ f_k^-slope for f_k
up to `fastest` and sum_k p_k = 1: a stationary Gaussian process (Rice 1944) of variance rms^2 at
any instant, whose spectrum falls as f^-slope. Slope 1 is 1/f noise, slope 2 the spectrum of a
random walk. (`GainDrifter` of TOAST, ``slow_drift``.)

The sum is formed at nodes that lie `NODES` to a cycle of `fastest`, and interpolated by cubic
B-splines: their coefficients for a wave at nodes h apart are the wave over (2 + cos 2 pi f h) / 3,
exactly; between nodes the error is below (2 pi / `NODES`)^4 / 384 of the fastest waves.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Fraction, Hertz
from zonda.core.data import Block, Observation
from zonda.core.numerics.chunks import TILE_DETECTORS, TILE_SAMPLES, chunks
from zonda.core.numerics.random import normals
from zonda.core.numerics.smooth import DetectorField
from zonda.core.operator import Operator
from zonda.core.types import Floats

NODES = 16
"""Nodes to a cycle of the fastest wave, at least: an error of 6e-5 of it."""

AT_ONCE = 256
"""Detectors whose series are formed at a time."""


class GainDrift(Operator):
    """Multiply the signal of each detector by a gain that drifts slowly about 1, a Gaussian process
    of spectrum f^-slope.

    The drifts of detectors and of scans are independent; the calibration does not know them. The
    gain multiplies the mean emission of the atmosphere too, and most of the effect comes from
    there.
    """

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})
    linear = True

    rms: Fraction = quantity("0.1 %", ge=0, le=0.3)
    """Rms deviation of the gain from 1."""
    slope: float = Field(2.0, ge=0, le=6)
    """Exponent of the fall of the drift's spectrum (1: 1/f noise, 2: as of a random walk)."""
    fastest: Hertz = quantity("10 mHz", gt=0)
    """Highest frequency of the drift; where the scan is shorter than half a cycle of it, half a
    cycle per scan.
    """

    def prepare(self, observation: Observation) -> DetectorField:
        """The gains, less 1."""
        step, nodes, waves = grid(observation, self.fastest)
        length = nodes * step / observation.sample_rate
        frequency = np.arange(1, waves + 1) / length
        power = frequency**-self.slope
        turn = 2 * np.pi * frequency * step / observation.sample_rate
        amplitude = self.rms * np.sqrt(power / power.sum()) * 3 / (2 + np.cos(turn))
        field = drifts(observation, self.label, amplitude, (step, nodes))
        text = f"rms {self.rms:.3g}, {frequency[0]:.3g} to {frequency[-1]:.3g} Hz"
        observation.log.state(self.label, f"{observation.name}: drift of the gains", text)
        return field

    def exec(self, block: Block, state: DetectorField) -> None:
        """Multiply the block's rows in place."""
        for part in chunks(block.shape[0], TILE_DETECTORS):
            detectors = slice(block.detectors.start + part.start, block.detectors.start + part.stop)
            block.detdata["signal"][part] *= 1 + state.evaluate(detectors, block.samples)


def grid(observation: Observation, fastest: float) -> tuple[int, int, int]:
    """(samples between nodes, nodes of the period P, number of waves) for a scan."""
    rate = observation.sample_rate
    n = observation.n_samples
    step = min(max(rate / (NODES * fastest), 1.0), TILE_SAMPLES)
    step = 1 << int(math.log2(step))
    nodes = max(2 * -(-n // step), NODES)
    return step, nodes, min(max(1, int(fastest * nodes * step / rate)), nodes // 2 - 1)


def drifts(
    observation: Observation,
    label: str,
    amplitude: Floats,
    layout: tuple[int, int],
) -> DetectorField:
    """Equation (1), less 1: ``amplitude`` (K,) of the waves' spline coefficients; ``layout``: step
    and nodes of `grid`.
    """
    (step, nodes), n_det = layout, observation.n_detectors
    key = observation.detector_key(label)
    waves = len(amplitude)
    wanted = -(-observation.n_samples // step) + 3
    at = np.arange(-1, wanted - 1) % nodes
    coefficients = np.empty((n_det, wanted))
    for part in chunks(n_det, AT_ONCE):
        drawn = np.stack(
            [normals(key, 0, 2 * waves, stream=d) for d in range(part.start, part.stop)]
        ).astype(np.float64)
        spectrum = np.zeros((len(drawn), nodes // 2 + 1), np.complex128)
        spectrum[:, 1 : waves + 1] = 0.5 * amplitude * (drawn[:, :waves] - 1j * drawn[:, waves:])
        coefficients[part] = np.fft.irfft(spectrum, nodes, norm="forward")[:, at]
    return DetectorField(coefficients, step, observation.n_samples)
