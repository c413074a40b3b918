"""Back and forth in azimuth at constant elevation."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, AngularAcceleration, AngularSpeed
from zonda.core.errors import PointingError
from zonda.core.flags import TURNAROUND
from zonda.core.intervals import Intervals, runs
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.quaternions import series
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.types import Floats

from .base import Aim, Pointing
from .sun_and_moon import mark_sun

if TYPE_CHECKING:
    from zonda.core.data import Observation


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
    def turnaround(self) -> float:
        """Duration T of a turnaround, s."""
        return 4 * self.speed / self.acceleration

    def path(self, seconds: Floats) -> tuple[Floats, Floats]:
        leg, turn = self.throw / self.speed, self.turnaround
        count, within = np.divmod(seconds, leg + turn)
        u = np.clip((within - leg) / turn, 0.0, 1.0)
        beyond = self.speed * turn * (u - u * u + (1 - np.cos(2 * np.pi * u)) / (2 * np.pi**2))
        x = self.speed * np.minimum(within, leg) - self.throw / 2 + beyond
        return np.where(count % 2 == 0, x, -x), np.zeros(len(seconds))

    def in_turnaround(self, seconds: Floats) -> NDArray[np.bool_]:
        """(n,) True in turnarounds."""
        return np.asarray(
            np.mod(seconds, self.throw / self.speed + self.turnaround) > self.throw / self.speed
        )

    def directions(self, aim: Aim, seconds: Floats) -> Floats:
        longitude, elevation = _middle(aim, seconds)
        elevation += aim.offset[1]
        _check_turn(
            self.throw / 2 + self.speed**2 / self.acceleration * (1 + 4 / np.pi**2),
            elevation,
            self.label,
        )
        found = series(3, len(seconds))
        for chunk in chunks(len(seconds)):
            x, _ = self.path(seconds[chunk])
            found[chunk] = unit_vectors(
                longitude - (x + aim.offset[0]) / math.cos(elevation), np.full(len(x), elevation)
            )
        return found

    def flag(self, seconds: Floats) -> NDArray[np.uint8]:
        return np.where(self.flag_turnarounds & self.in_turnaround(seconds), TURNAROUND, 0).astype(
            np.uint8
        )

    def intervals(self, seconds: Floats) -> Intervals:
        return _intervals(
            seconds, self.throw / self.speed, self.turnaround, self.in_turnaround(seconds)
        )

    def describe(self, observation: Observation) -> None:
        mark_sun(observation)
        what = "samples in turnarounds" + (", flagged" if self.flag_turnarounds else ", used")
        observation.tally.count(
            self.label,
            what,
            int(self.in_turnaround(observation.seconds).sum()),
            observation.n_samples,
        )


def _middle(aim: Aim, seconds: Floats) -> tuple[float, float]:
    """Horizontal (longitude, latitude) of the target in the middle of the scan."""
    if aim.target.frame == "horizontal":
        return -aim.target.longitude, aim.target.latitude
    middle = np.array([(seconds[0] + seconds[-1]) / 2])
    north, west, up = aim.transform.horizontal(unit_vectors(*aim.target.icrs()), middle)[0]
    return math.atan2(west, north), math.atan2(up, math.hypot(north, west))


def _check_turn(widest: float, elevation: float, place: str) -> None:
    """Refuse a scan that reaches ``widest`` [rad] from its middle, half a turn of azimuth or more
    at its elevation.
    """
    if elevation >= math.pi / 2 or widest > math.pi * math.cos(elevation):
        raise PointingError(
            "the scan spans more than a whole turn of azimuth at elevation"
            f" {math.degrees(elevation):.2f} deg",
            place=place,
            cure="lower throw, or choose a lower elevation",
        )


def _intervals(
    seconds: Floats, leg: float, turnaround: float, turning: NDArray[np.bool_]
) -> Intervals:
    """TOAST's intervals. Left to right is towards larger azimuth; a turnaround has the direction of
    the scan before it.

    A throw goes from the middle of a turnaround to that of the next (the parameter `throw` is the
    length of a *scan*).
    """
    cycle = leg + turnaround
    first, throw = (np.floor(t / cycle) % 2 == 0 for t in (seconds, seconds + turnaround / 2))
    found: Intervals = {}
    for way, after, going in (("leftright", first, throw), ("rightleft", ~first, ~throw)):
        found[f"throw_{way}"] = runs(going, seconds)
        found[f"scan_{way}"] = runs(~turning & after, seconds)
        found[f"turn_{way}"] = runs(turning & after, seconds)
    for name, part in (("throw", "throw"), ("scanning", "scan"), ("turnaround", "turn")):
        found[name] = sorted(found[f"{part}_leftright"] + found[f"{part}_rightleft"])
    return found
