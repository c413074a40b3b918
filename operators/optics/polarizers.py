"""A half-wave plate that turns in front of the detectors, and intensity that the telescope's optics
turn into polarization.
"""

from __future__ import annotations

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, Fraction, Hertz
from zonda.core.data import Block, Data, Observation
from zonda.core.operator import Operator
from zonda.core.types import Floats


class Leakage(Operator):
    """Instrumental polarization: optics in front of the detectors and of a half-wave plate polarize
    a share of the intensity.

        d = I + p l I cos(2 (gamma - beta)),
        with a half-wave plate   d = I + p l I cos(4 chi - 2 gamma - 2 beta)        (1)

    with the share l, its direction beta, a detector's angle gamma and the plate's chi, all in the
    focal plane, and the polarization efficiency p. It is the monopole leakage gamma_1 + i gamma_2 =
    l exp(2 i beta) of Hu, Hedman & Zaldarriaga (2003, Phys. Rev. D 67, 043004), constant over the
    field. What comes through the optics leaks: the sky and the atmosphere, its mean too. The
    detectors' noise does not, nor do glitches and what sidelobes pick up of the ground. It changes
    the components: put it behind those, and behind a half-wave plate, before `Efficiency`.
    """

    provides = frozenset({"sky", "atmosphere"})
    optional = frozenset({"sky", "atmosphere"})
    linear = True

    share: Fraction = quantity("1 %", ge=0, le=0.5)
    """l, the share of the intensity that becomes polarized."""
    angle: Angle = quantity("0 deg", examples=["45 deg"])
    """beta, its direction in the focal plane, counted as the detectors' polarization angles."""

    def prepare(self, observation: Observation) -> tuple[Floats, Floats]:
        """p l exp(-2 i (beta - gamma)) of each detector, or with a plate p l exp(-2 i (beta +
        gamma)) and 4 chi.
        """
        plane = observation.focalplane
        chi = observation.hwp_angle
        turn = (
            self.angle - plane.polarization_angle
            if chi is None
            else self.angle + plane.polarization_angle
        )
        size = self.share * plane.polarization_efficiency
        if not plane.polarized:
            observation.log.state(self.label, "no effect", "no detector is polarized")
        return np.stack([size * np.cos(2 * turn), size * np.sin(2 * turn)]), np.zeros(
            0
        ) if chi is None else 4 * chi

    def exec(self, block: Block, state: tuple[Floats, Floats]) -> None:
        """Equation (1): a gain of each detector, which the plate modulates."""
        (cosine, sine), turn = state
        cosine = cosine[block.detectors, None]
        sine = sine[block.detectors, None]
        if turn.size:
            plate = turn[block.samples]
            cosine = cosine * np.cos(plate) + sine * np.sin(plate)
        for stream in self.provides & block.detdata.keys():
            block.detdata[stream] *= (1 + cosine).astype(block.dtype)


class HalfWavePlate(Operator):
    """Continuously rotating half-wave plate: polarization is modulated at four times its frequency
    (`core.polarization`).

    chi = 2 pi frequency t + angle, in the focal plane as the detectors' polarization angles, t
    since the start of the scan; an ideal plate, whose loss and emission are not simulated.
    `SaveTOD` writes chi as TOAST's ``hwp_angle``.
    """

    requires = frozenset({"boresight"})

    frequency: Hertz = Field(ge=-1e4, le=1e4, examples=["2 Hz"])
    """Turns per second; negative: the other way. 0 for a plate that is stepped by `angle`."""
    angle: Angle = quantity("0 deg", examples=["22.5 deg"])
    """At the start of each scan."""

    def check(self, data: Data) -> list[str]:
        """Set it for the checks of later steps."""
        for observation in data.observations:
            self.configure(observation)
        return []

    def configure(self, observation: Observation) -> None:
        """Set `Observation.hwp_angle`."""
        observation.hwp_angle = np.mod(
            2 * np.pi * self.frequency * observation.seconds + self.angle,
            2 * np.pi,
        )

    def prepare(self, observation: Observation) -> None:
        """State it; with detectors that are not polarized it has no effect."""
        modulated = 4 * abs(self.frequency)
        observation.log.state(self.label, "polarization is modulated at", f"{modulated:g} Hz")
        if modulated >= observation.sample_rate / 2:
            what = (
                f"{modulated:g} Hz is not below half the sample rate,"
                f" {observation.sample_rate / 2:g} Hz"
            )
            observation.log.state(self.label, "modulation aliased", what)
        if not observation.focalplane.polarized:
            observation.log.state(self.label, "no effect", "no detector is polarized")
