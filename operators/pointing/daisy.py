"""The double Lissajous daisy."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, AngularSpeed, Fraction
from zonda.core.types import Floats

from .base import Pointing


class PointingDaisy(Pointing):
    """Daisy scan around the target, a double Lissajous figure (van Marrewijk et al. 2024).

    With x + iy the tangent-plane offset,

        phi = phase + speed t / radius
        x + iy = radius [sin(phi) exp(i phi / n) + a sin(phi + pi/2) exp(i sqrt(2) phi / n)]     (1)

    towards east and north of an ICRS or Galactic target, towards azimuth and zenith of an az/el
    one. `speed` is that of the outer term through the centre; the boresight is never farther than
    1.011 radius for a = 0.15.
    """

    radius: Angle = quantity("4 arcmin", gt=0, le=0.5)
    """Length of the outer petals."""
    speed: AngularSpeed = quantity("50 arcsec/s", gt=0)
    """Speed of the outer term through the centre."""
    petals: float = Field(10 / math.pi, gt=0, le=1000)
    """n of equation (1): how slowly the petals turn; 10/pi gives 20 petals in one turn, which takes
    20 radius / speed.
    """
    inner: Fraction = Field(0.15, ge=0, lt=1)
    """a of equation (1): amplitude of the inner daisy, as a fraction of `radius`."""
    phase: Angle = quantity("0 rad", examples=["45 deg"])
    """phi at the start of each scan."""

    slows: ClassVar[dict[str, tuple[int, int]]] = {"speed": (-1, 1), "radius": (1, 0)}

    def path(self, seconds: Floats) -> tuple[Floats, Floats]:
        phi = self.phase + self.speed * seconds / self.radius
        outer = np.sin(phi)
        inner = self.inner * np.cos(phi)
        slow = phi / self.petals
        fast = math.sqrt(2) * phi / self.petals
        x = self.radius * (outer * np.cos(slow) + inner * np.cos(fast))
        y = self.radius * (outer * np.sin(slow) + inner * np.sin(fast))
        return x, y
