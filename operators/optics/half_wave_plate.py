"""A half-wave plate that turns in front of the detectors."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, Hertz
from zonda.core.data import Data, Observation
from zonda.core.operator import Operator


class HalfWavePlate(Operator):
    """Continuously rotating half-wave plate: polarization is modulated at four times its frequency
    (`core.polarization`).

    chi = 2 pi frequency t + angle, in the focal plane as the detectors' polarization angles, t
    since the start of the scan; an ideal plate, whose loss and emission are not simulated.
    `SaveTOD` writes chi as TOAST's ``hwp_angle``.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})

    frequency: Hertz = Field(ge=-1e4, le=1e4)
    """Turns per second; negative: the other way. 0 for a plate that is stepped by `angle`."""
    angle: Angle = quantity("0 deg")
    """At the start of each scan."""

    def check(self, data: Data) -> list[str]:
        """Set it for the checks of later steps."""
        for observation in data.observations:
            self.configure(observation)
        return []

    def configure(self, observation: Observation) -> None:
        """Set `Observation.hwp_angle`."""
        observation.hwp_angle = np.mod(
            2 * np.pi * self.frequency * observation.seconds + self.angle, 2 * np.pi
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
