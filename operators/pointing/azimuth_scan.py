"""Back and forth in azimuth at constant elevation."""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, AngularAcceleration, AngularSpeed
from zonda.core.data import Observation
from zonda.core.errors import PointingError
from zonda.core.flags import Intervals
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.quaternions import series
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.types import Floats

from .base import Aim, Pointing
from .observed import mark_sun, mark_turnarounds
from .sweep import Sweep


class PointingBackAndForth(Pointing):
    """Constant-elevation scan back and forth in azimuth, with smooth turnarounds.

    It is centred on an az/el target, or on where a celestial target stands in the middle of the
    scan. Each leg crosses `throw` at constant `speed`, both measured on the sky (azimuth angle
    times the cosine of the elevation); then the telescope turns round outside `throw` within T = 4
    speed / acceleration. With u the fraction of T that has passed

        x'' = -acceleration sin^2(pi u),
        x - throw/2 = speed T [u - u^2 + (1 - cos(2 pi u)) / (2 pi^2)]      (1)

    so position to jerk are continuous; it ends 1.41 speed^2 / acceleration beyond. Flags tell while
    the Sun is up or near.
    """

    throw: Angle = quantity("30 arcmin", gt=0, le=2 * math.pi)
    """Length on the sky of the part at constant speed."""
    speed: AngularSpeed = quantity("1 arcmin/s", gt=0)
    """Constant speed on the sky."""
    acceleration: AngularAcceleration = quantity("1 arcmin/s2", gt=0)
    """Largest acceleration on the sky in a turnaround."""
    flag_turnarounds: bool = False
    """Flag the samples in turnarounds (bit value 4), so that no map uses them; without it they are
    used like all others.
    """

    slows: ClassVar[dict[str, tuple[int, int]]] = {"speed": (-1, 1), "acceleration": (-1, 2)}

    @property
    def sweep(self) -> Sweep:
        """The way back and forth."""
        return Sweep(self.throw, self.speed, self.acceleration, begin=-self.throw / 2)

    def path(self, seconds: Floats) -> tuple[Floats, Floats]:
        return self.sweep.path(seconds), np.zeros(len(seconds))

    def directions(self, aim: Aim, seconds: Floats) -> Floats:
        longitude, elevation = _middle(aim, seconds)
        elevation += aim.offset[1]
        if elevation >= math.pi / 2 or (
            self.throw / 2 + self.sweep.overshoot > math.pi * math.cos(elevation)
        ):
            raise PointingError(
                "the scan spans more than a whole turn of azimuth at elevation"
                f" {math.degrees(elevation):.2f} deg",
                place=self.label,
                cure="lower throw, or choose a lower elevation",
            )
        found = series(3, len(seconds))
        for chunk in chunks(len(seconds)):
            x, _ = self.path(seconds[chunk])
            found[chunk] = unit_vectors(
                longitude - (x + aim.offset[0]) / math.cos(elevation),
                np.full(len(x), elevation),
            )
        return found

    def intervals(self, seconds: Floats) -> Intervals:
        return self.sweep.intervals(seconds)

    def describe(self, observation: Observation) -> None:
        mark_sun(observation)
        turning = self.sweep.turning(observation.seconds)
        mark_turnarounds(self.label, observation, turning, self.flag_turnarounds)


def _middle(aim: Aim, seconds: Floats) -> tuple[float, float]:
    """Horizontal (longitude, latitude) of the target in the middle of the scan."""
    if aim.target.frame == "horizontal":
        return -aim.target.longitude, aim.target.latitude
    middle = np.array([(seconds[0] + seconds[-1]) / 2])
    north, west, up = aim.transform.horizontal(unit_vectors(*aim.target.icrs()), middle)[0]
    return math.atan2(west, north), math.atan2(up, math.hypot(north, west))
