"""A noise model: detectors at the edge of the field are noisier."""

import numpy as np

from zonda import Fraction, NoiseModel


class ExampleRings(NoiseModel):
    """NET that grows with the distance from the boresight."""

    growth: Fraction = 0.2
    """Relative increase at the edge of the field."""

    def net(self, observation):
        plane = observation.focalplane
        return plane.net * (1 + self.growth * np.hypot(plane.xi, plane.eta) / plane.radius)
