"""The level that white and pink noise share: NET per detector and its amplitude at the detector."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zonda.core.numerics.random import normals, stream_key
from zonda.core.numerics.smooth import SmoothField

from .models import FixedNet, NoiseModel, time_mean

if TYPE_CHECKING:
    from zonda.core.data import Observation

Array = NDArray[np.float64]


@dataclass
class NoiseLevel:
    """NET of one observation's detectors, resolved when first asked for.

    A model may need the atmosphere's loading, which is known only when every operator is prepared; so nothing is computed
    before the first block, whatever the order of operators. Thread-safe.
    """

    model: NoiseModel
    factors: Array
    """(n_det,) scatter factors, mean 1."""
    _net: Array | None = None
    _lock: threading.RLock = field(default_factory=threading.RLock, repr=False)

    def net(self, observation: Observation) -> Array:
        """(n_det,) K_RJ sqrt(s) referred to ``model.reference``; the value of the first call holds for all runs."""
        with self._lock:
            if self._net is None:
                self._net = self.model.net(observation) * self.factors
            return self._net

    def sky_net(self, observation: Observation) -> Array:
        """(n_det,) K_RJ sqrt(s) on the sky: a level at the detector divided by zeta <e^-tau>, averaged over the scan."""
        if self.model.reference == "sky":
            return self.net(observation)
        transmission = time_mean(observation.smooth.get("transmission"), observation.n_detectors, 1.0)
        return self.net(observation) / (observation.focalplane.main_beam_efficiency * transmission)

    def amplitude(self, observation: Observation) -> SmoothField:
        """rms of one sample at the detector, NET sqrt(f_s), times zeta <e^-tau> where NET is quoted on the sky; K_RJ."""
        sigma = self.net(observation) * np.sqrt(observation.sample_rate)
        if self.model.reference == "sky":
            sigma = sigma * observation.focalplane.main_beam_efficiency
            if transmission := observation.smooth.get("transmission"):
                return transmission.scaled(sigma)
        return SmoothField.constant(sigma, observation.n_samples)


def scatter_factors(scatter: float, observation: Observation, label: str) -> Array:
    """Log-normal factors (n_det,) of mean 1 and relative standard deviation ``scatter``; the same in every observation with this
    seed, instrument and band."""
    if scatter == 0:
        return np.ones(observation.n_detectors)
    width = np.sqrt(np.log1p(scatter**2))
    key = stream_key(observation.seed, "noise scatter", *observation.instrument.identity, label)
    deviates = normals(key, 0, observation.n_detectors).astype(np.float64)
    return np.asarray(np.exp(width * deviates - width**2 / 2))


def announce(observation: Observation, level: NoiseLevel) -> None:
    """Make white noise's level known to pink noise."""
    observation.resolved["white noise level"] = level


def announced(observation: Observation) -> NoiseLevel:
    """The level of the white noise; the instrument's NET where the pipeline makes none.

    It outlives the main run, so that a companion run without white noise has the same pink noise.
    """
    level: NoiseLevel | None = observation.resolved.get("white noise level")
    return level or NoiseLevel(FixedNet(), np.ones(observation.n_detectors))
