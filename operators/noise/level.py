"""The level that white and pink noise share: NET per detector and its amplitude at the detector.

Levels are announced in ``configure`` and resolved in ``prepare``: by then the mean emission and transmission of the atmosphere
and the efficiencies are known, and no step that reads ``focalplane.net`` has been prepared.
"""

from __future__ import annotations

import copy
import threading
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zonda.core.numerics.random import normals, stream_key
from zonda.core.numerics.smooth import SmoothField

from .models import FixedNet, NoiseModel

if TYPE_CHECKING:
    from zonda.core.data import Observation

Array = NDArray[np.float64]


@dataclass
class NoiseLevel:
    """NET of one observation's detectors, resolved when first asked for: not before every operator is configured. Thread-safe."""

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
        """(n_det,) K_RJ sqrt(s) on the sky: a level at the detector divided by zeta <e^-tau>, rms over the scan."""
        if self.model.reference == "sky":
            return self.net(observation)
        calibration = rms_of_inverse(observation.smooth.get("transmission"), observation.n_detectors)
        return self.net(observation) * calibration / observation.focalplane.main_beam_efficiency

    def expected_sky_net(self, observation: Observation) -> Array:
        """About what `sky_net` will be, from ``observation.expected_load``, before operators are configured."""
        smooth = {}
        if observation.expected_load is not None and (self.model.reference != "sky" or not isinstance(self.model, FixedNet)):
            names, n = ("atmosphere", "transmission"), observation.n_detectors
            for name, value in zip(names, observation.expected_load(), strict=True):
                smooth[name] = SmoothField.constant(np.full(n, value), observation.n_samples)
        rough = copy.copy(observation)
        rough.smooth = smooth
        return NoiseLevel(self.model, self.factors).sky_net(rough)

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


LEVELS, OF_WHITE = "noise levels", "white noise level"
"""Where `Observation.resolved` has the levels of all white noise by step, and the one that pink noise refers to."""

OPAQUE = 1e-6
"""Transmission below which samples are not calibrated (`optics.efficiency`), and say nothing of the noise."""

INSTANTS = 64
"""Times of a scan at which its transmission is looked at, at most."""

AT_ONCE = 4096
"""Detectors that are looked at together."""


def rms_of_inverse(transmission: SmoothField | None, n_detectors: int) -> Array:
    """rms over the scan of 1 / <e^-tau> per detector, where it is not opaque (n_det,): what calibration makes of noise."""
    found = np.ones(n_detectors)
    if transmission is None:
        return found
    cells = transmission.coefficients.shape[1] - 3
    at = 1 + np.unique(np.linspace(0, cells - 1, min(INSTANTS, cells)).round().astype(int))
    middle = (transmission.coefficients[:, at] + transmission.coefficients[:, at + 1]) / 2  # of those cells
    for start in range(0, n_detectors, AT_ONCE):
        rows = slice(start, start + AT_ONCE)
        passed = transmission.weights[rows].astype(np.float64) @ middle
        clear = passed >= OPAQUE
        squares = np.where(clear, 1 / np.maximum(passed, OPAQUE) ** 2, 0.0).sum(axis=1)
        number = clear.sum(axis=1)
        found[rows] = np.where(number > 0, np.sqrt(squares / np.maximum(number, 1)), 1 / OPAQUE)
    return found


def announce(observation: Observation, label: str, level: NoiseLevel) -> None:
    """Make the level of a step's white noise known, to pink noise too. A companion run keeps the main run's level."""
    held: dict[str, NoiseLevel] = observation.resolved.setdefault(LEVELS, {})
    observation.resolved[OF_WHITE] = held.setdefault(label, level)


def resolve(observation: Observation) -> None:
    """Set ``focalplane.net`` to what all white noise comes to on the sky: levels of several steps add in quadrature."""
    levels = [level.sky_net(observation) for level in observation.resolved.get(LEVELS, {}).values()]
    if levels:
        observation.focalplane.net = levels[0].copy() if len(levels) == 1 else np.sqrt(sum(net**2 for net in levels))


def announced(observation: Observation) -> NoiseLevel:
    """The level of the white noise; the instrument's NET where the pipeline makes none.

    It outlives the main run, so that a companion run without white noise has the same pink noise.
    """
    level: NoiseLevel | None = observation.resolved.get(OF_WHITE)
    return level or NoiseLevel(FixedNet(), np.ones(observation.n_detectors))
