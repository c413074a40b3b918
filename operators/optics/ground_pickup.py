"""Ground pickup: radiation of the ground through the far sidelobes, which repeats with the azimuth.

At the detector d the boresight's azimuth A and elevation e give

    T = G_d rms (e / 45 deg)^power sum_(m = 1) sqrt(p_m) (a_m cos m A + b_m sin m A),
    p_m ~ exp(-m^2 s^2),   (1)

sum_m p_m = 1, a_m and b_m standard normal deviates: a Gaussian process on the horizon whose
correlation falls as a Gaussian of the angle, that of sidelobes of a given FWHM (s = FWHM / sqrt(8
ln 2)). TOAST's `SimScanSynchronousSignal` smooths a random map of the ground with such a lobe and
has the same dependence on elevation. G_d scatters about 1.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, Fraction, Kelvin
from zonda.core.data import Block, Observation
from zonda.core.numerics.random import Key, normals, stream_key
from zonda.core.operator import Operator
from zonda.core.signal import Component
from zonda.core.types import Floats


class GroundPickup(Operator):
    """Radiation of the ground that depends on the boresight's azimuth and elevation: the component
    ``ground``.

    A Gaussian process of the azimuth, smoothed by sidelobes of `fwhm`, times (elevation / 45
    deg)^power. It enters at the detector (K_RJ, before calibration). The ground is the same in all
    scans of one seed.
    """

    requires = frozenset({"boresight"})
    provides = frozenset({Component("ground", "at the detector")})

    rms: Kelvin = quantity("1 mK", ge=0)
    """Rms over azimuths and over realizations of the ground, at an elevation of 45 deg."""
    fwhm: Angle = quantity("10 deg", ge=0.002, le=3.2)
    """FWHM of the sidelobes that smooth the ground."""
    power: float = Field(-1.0, ge=-6, le=6)
    """Exponent of the dependence on elevation."""
    scatter: Fraction = quantity("0 %", ge=0, le=1, examples=["5 %"])
    """Relative rms of the pickup between detectors (normal, the same in all scans)."""
    realization: int | None = Field(None, ge=0)
    """Number of the ground: the same for every seed. Where absent the seed draws it, and in a
    campaign every entry has another."""

    def prepare(self, observation: Observation) -> tuple[Floats, Floats]:
        """Gains (n_det,), and equation (1) over the scan (n_samp,) [K_RJ]."""
        seed = observation.seed if self.realization is None else self.realization
        profile = self.rms * horizon(
            np.asarray(observation.azimuth, np.float64),
            self.fwhm,
            stream_key(seed, "ground", self.label),
        )
        profile *= (observation.elevation / (math.pi / 4)) ** self.power
        observation.log.state(
            self.label,
            f"{observation.name}: rms at the detector",
            f"{1e3 * profile.std():.3g} mK_RJ",
        )
        gains = np.ones(observation.n_detectors)
        if self.scatter > 0:
            gains += self.scatter * normals(
                observation.camera_key(self.label),
                0,
                len(gains),
            ).astype(np.float64)
        return gains, profile

    def exec(self, block: Block, state: tuple[Floats, Floats]) -> None:
        """Add it to ``ground``."""
        stream = block.new("ground")
        gains, profile = state
        stream += np.outer(gains[block.detectors], profile[block.samples]).astype(stream.dtype)


def horizon(azimuth: Floats, fwhm: float, key: Key) -> Floats:
    """The sum of equation (1) at ``azimuth`` (n,) [rad]: of unit variance over grounds, 0 on
    average over azimuths.
    """
    s = fwhm / math.sqrt(8 * math.log(2))
    waves = np.arange(1, math.ceil(6 / s) + 1)
    power = np.exp(-((waves * s) ** 2))
    power /= power.sum()
    a, b = normals(key, 0, 2 * len(waves)).astype(np.float64).reshape(2, -1) * np.sqrt(power)
    turn = np.exp(1j * azimuth)
    found = np.zeros(len(azimuth))
    wave = np.ones(len(azimuth), np.complex128)
    for c, d in zip(a, b, strict=True):
        wave *= turn
        found += c * wave.real + d * wave.imag
    return found
