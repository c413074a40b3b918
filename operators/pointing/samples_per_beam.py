"""Samples per beam, and what too few of them cost."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.numerics.quaternions import conjugate, multiply
from zonda.core.types import Floats

from .motion import POINTS, rate_text

FEW = 2.0
"""Samples per FWHM below which a scan warns: the beam's transfer at the Nyquist frequency,
exp(-pi^2 N^2 / (16 ln 2)), is then more than 3 % (41 % at one sample), folded to other scales.
Samples are instants: what is simulated stays right."""


class SamplesPerBeam:
    """Samples per FWHM of several scans, where the sky passes fastest.

    The speed is that of the outermost detector on the sky: the boresight's, and the field's
    rotation times its radius.
    """

    TOPICS = ("samples per FWHM",)
    """How its statement begins."""

    def __init__(self) -> None:
        self._fastest, self._usual, self._fwhm, self._rate, self._where = 0.0, 0.0, 0.0, 0.0, ""

    def add(self, observation: Observation, rate: float) -> None:
        """Take a scan into account, read out at ``rate`` [Hz]."""
        speed, turn = on_the_sky(
            observation.boresight_radec, observation.seconds, observation.good_samples
        )
        total = speed + turn * math.atan(observation.focalplane.radius)
        if len(total) and total.max() > self._fastest:
            self._fastest, self._usual = float(total.max()), float(np.median(total))
            self._fwhm, self._rate, self._where = (
                float(observation.focalplane.fwhm.min()),
                rate,
                observation.name,
            )

    @property
    def least(self) -> float:
        """Samples per FWHM at the fastest; infinite where nothing moves."""
        return self._fwhm * self._rate / self._fastest if self._fastest else math.inf

    def statements(self) -> list[tuple[str, str]]:
        """(what, text) for the tally."""
        if not self._fastest:
            return []
        usual = self._fwhm * self._rate / max(self._usual, 1e-3 * self._fastest)
        text = (
            f"{self.least:.3g} at {rate_text(self._fastest, 1)} on the sky, {usual:.3g} in the"
            f" median; {self._lost}"
        )
        return [
            (f"samples per FWHM of {self._beam}", f"{text} (not simulated: samples are instants)")
        ]

    def warnings(self) -> list[str]:
        """Warnings where there are fewer than `FEW`."""
        if self.least >= FEW:
            return []
        folded = math.exp(-((math.pi * self.least) ** 2) / (16 * math.log(2)))
        what = f"only {self.least:.3g} samples per FWHM of {self._beam} in {self._where}"
        cost = (
            f"{self._lost}, and up to {100 * folded:.3g} % of the beam's transfer is folded to"
            " other scales"
        )
        cure = f"scan at {rate_text(self._fwhm * self._rate / FEW, 1)} or less"
        return [
            f"{what}: {cost}; {cure}, or read out at {math.ceil(FEW * self._fastest / self._fwhm)}"
            " Hz or more"
        ]

    @property
    def _beam(self) -> str:
        return f"{math.degrees(self._fwhm) * 3600:.3g} arcsec"

    @property
    def _lost(self) -> str:
        return (
            f"integrating over its interval, a sample loses {100 * peak_lost(self.least):.2g} % of"
            " a point source's peak"
        )


def on_the_sky(boresight: Floats, seconds: Floats, use: NDArray[np.bool_]) -> tuple[Floats, Floats]:
    """Speed of the beam and rate of the field's rotation [rad/s] at up to about `POINTS` pairs of
    neighbouring samples.

    ``boresight``: quaternions (n, 4) at ``seconds`` (n,), of which those to ``use`` (n,) count.
    From the rotation between neighbours, in the focal plane's own axes.
    """
    at = np.arange(0, max(len(boresight) - 1, 0), max(1, len(boresight) // POINTS))
    at = at[use[at] & use[at + 1]]
    x, y, z, _ = multiply(conjugate(boresight[at]), boresight[at + 1]).T
    step = seconds[at + 1] - seconds[at]
    # sines of half angles: at most 1 but for rounding
    return (
        2 * np.arcsin(np.minimum(np.hypot(x, y), 1.0)) / step,
        2 * np.arcsin(np.minimum(abs(z), 1.0)) / step,
    )


def peak_lost(samples_per_fwhm: float) -> float:
    """Share of a point source's peak that a sample loses which integrates over its whole interval,
    along the scan.

    A Gaussian beam averaged over FWHM / N: 1 - sqrt(pi) erf(a) / (2 a), a = sqrt(ln 2) / N.
    """
    a = math.sqrt(math.log(2)) / samples_per_fwhm
    return 1 - math.sqrt(math.pi) * math.erf(a) / (2 * a) if a > 1e-4 else a * a / 3
