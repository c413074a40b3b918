"""Errors of the pointing: where the telescope looks is not where it says that it looks.

The true boresight lies beside the recorded one by (x, y) on the sky, towards increasing azimuth and
elevation,

    (x, y) = offset + scan + jitter,   (1)

`offset` constant, `scan` one pair of normal deviates per scan, `jitter` a Gauss-Markov
(Ornstein-Uhlenbeck) process in either direction, of correlation exp(-|t| / tau) from sample to
sample:

    j_n = rho j_(n-1) + sqrt(1 - rho^2) sigma g_n,   rho = e^(-1 / (tau f_s)),   j_0 = sigma g_0,
    (2)

stationary from the first sample on (Uhlenbeck & Ornstein 1930). All rms values are of each
direction.
"""

from __future__ import annotations

import math

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, Seconds
from zonda.core.data import Data, Observation
from zonda.core.numerics.quaternions import multiply
from zonda.core.numerics.random import normals
from zonda.core.operator import Operator
from zonda.core.types import Floats


class Mispointing(Operator):
    """The true boresight differs from the recorded one by an offset, an error per scan and a
    jitter.

    The sky is seen where the telescope looks in fact; maps, filters and files take the recorded
    pointing. Atmosphere and ground, whose statistics do not change, stay where the recorded
    pointing is. It stands behind the pointing step.
    """

    requires = frozenset({"boresight"})
    provides = frozenset({"boresight"})

    offset: tuple[Angle, Angle] | None = Field(None, examples=["3 arcsec"])
    """Constant error towards increasing azimuth (on the sky) and elevation; none where absent."""
    scan_rms: Angle = quantity("0 arcsec", ge=0, le=0.1, examples=["2 arcsec"])
    """Rms of an error that is constant in each scan."""
    jitter_rms: Angle = quantity("0 arcsec", ge=0, le=0.1, examples=["1 arcsec"])
    """Rms of the jitter."""
    jitter_time: Seconds = quantity("1 s", gt=0, le=1e6)
    """Correlation time of the jitter."""

    def observe(self, data: Data) -> None:
        """Note the true boresight of every scan that there is."""
        for observation in data.observations:
            x, y = self.errors(observation)
            turned = observation.derotate("boresight_azel")[
                2
            ]  # of the focal plane: xi is not along the azimuth then
            cosine = np.cos(turned)
            sine = np.sin(turned)
            observation.pointed_radec = beside(
                observation.sky_boresight,
                x * cosine - y * sine,
                y * cosine + x * sine,
            )
            rms = np.degrees([np.sqrt(np.mean(x * x)), np.sqrt(np.mean(y * y))]) * 3600
            what = f"{observation.name}: rms error towards azimuth and elevation"
            observation.log.state(self.label, what, f"{rms[0]:.3g} and {rms[1]:.3g} arcsec")

    def errors(self, observation: Observation) -> tuple[Floats, Floats]:
        """(x, y), (n_samp,) each, rad."""
        key = observation.key(self.label)
        n = observation.n_samples
        whole = self.scan_rms * normals(key, 0, 2, stream=0).astype(np.float64)
        offset = self.offset or (0.0, 0.0)
        found = [np.full(n, offset[k] + whole[k]) for k in (0, 1)]
        if self.jitter_rms > 0:
            rho = math.exp(-1 / (self.jitter_time * observation.sample_rate))
            for k in (0, 1):
                found[k] += self.jitter_rms * _markov(
                    rho,
                    normals(key, 0, n, stream=1 + k).astype(np.float64),
                )
        return found[0], found[1]


def _markov(rho: float, drawn: Floats) -> Floats:
    """Equation (2) of unit variance."""
    from scipy.signal import lfilter

    step = math.sqrt(1 - rho * rho)
    scaled = step * drawn
    scaled[0] = drawn[0]
    return lfilter([1.0], [1.0, -rho], scaled)


def beside(quaternions: Floats, x: Floats, y: Floats) -> Floats:
    """Boresights (n, 4) turned by ``x`` and ``y`` (n,) [rad] in their own frames towards xi and
    eta.

    The frame's direction (-eta, -xi, 1) is that of a detector at (xi, eta): the turn that takes (0,
    0, 1) there along a great circle.
    """
    angle = np.hypot(x, y)
    half = np.sinc(angle / (2 * np.pi)) / 2  # sin(angle / 2) / angle
    # the axis is (0, 0, 1) x (-y, -x, 0) / angle = (x, -y, 0) / angle
    turn = np.stack([x * half, -y * half, np.zeros(len(x)), np.cos(angle / 2)], axis=1)
    return multiply(quaternions, turn)
