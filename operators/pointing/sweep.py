"""Tracks of a mount: sweeps back and forth at constant speed, and nods in elevation.

A sweep crosses the width w at the constant speed v, towards larger values first; outside of it the
telescope turns round within T, at constant acceleration as TOAST's `SimGround` or with continuous
acceleration. With u the fraction of T that has passed,

    x = w + v T (u - u^2),   T = 2 v / a,                                          (1)
    x = w + v T [u - u^2 + (1 - cos(2 pi u)) / (2 pi^2)],   T = 4 v / a.           (2)

A nod goes from one elevation to the next from rest to rest: constant acceleration, constant speed,
constant deceleration.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from zonda.core.flags import Intervals, intervals_of
from zonda.core.types import Bools, Floats


@dataclass(frozen=True)
class Sweep:
    """Back and forth over ``width`` [rad] at ``speed`` [rad/s], turned round with at most
    ``acceleration`` [rad/s^2].

    ``smooth``: equation (2). ``begin``: where the width begins, rad. Width and speed 0: a stare.
    """

    width: float
    speed: float
    acceleration: float
    smooth: bool = True
    begin: float = 0.0

    @property
    def leg(self) -> float:
        """Duration of the part at constant speed, s."""
        return self.width / self.speed if self.width else math.inf

    @property
    def turnaround(self) -> float:
        """T, s."""
        return (4 if self.smooth else 2) * self.speed / self.acceleration

    @property
    def overshoot(self) -> float:
        """Reach of a turnaround beyond the width, rad: equations (1) and (2) at u = 1/2."""
        return self.speed * self.turnaround * (0.25 + 1 / math.pi**2 if self.smooth else 0.25)

    def passages(self, seconds: Floats) -> tuple[Floats, Floats, Floats]:
        """Number of the passage, from 0, seconds since it began, and u: each (n,)."""
        number, within = np.divmod(seconds, self.leg + self.turnaround)
        return number, within, np.clip((within - self.leg) / self.turnaround, 0.0, 1.0)

    def path(self, seconds: Floats) -> Floats:
        """x (n,), rad."""
        number, within, u = self.passages(seconds)
        beyond = u - u * u
        if self.smooth:
            beyond += (1 - np.cos(2 * np.pi * u)) / (2 * np.pi**2)
        x = self.speed * np.minimum(within, self.leg) + self.begin
        x += self.speed * self.turnaround * beyond
        return np.where(number % 2 == 0, x, 2 * self.begin + self.width - x)

    def turning(self, seconds: Floats) -> Bools:
        """(n,) True in turnarounds."""
        return np.mod(seconds, self.leg + self.turnaround) > self.leg

    def intervals(self, seconds: Floats, inside: Bools | bool = True) -> Intervals:
        """TOAST's intervals of the samples ``inside`` (n,). Left to right is towards larger values;
        a turnaround has the direction of the scan before it.

        A throw goes from the middle of a turnaround to that of the next. A stare is one throw, in
        no direction.
        """
        cycle = self.leg + self.turnaround
        turning = self.turning(seconds)
        first, throw = (
            np.floor(t / cycle) % 2 == 0 for t in (seconds, seconds + self.turnaround / 2)
        )
        found: Intervals = {}
        moving = inside & np.full(len(seconds), bool(self.width))
        for way, after, going in (("leftright", first, throw), ("rightleft", ~first, ~throw)):
            found[f"throw_{way}"] = intervals_of(moving & going, seconds)
            found[f"scan_{way}"] = intervals_of(moving & ~turning & after, seconds)
            found[f"turn_{way}"] = intervals_of(inside & turning & after, seconds)
        for name, part in (("throw", "throw"), ("scanning", "scan"), ("turnaround", "turn")):
            found[name] = sorted(found[f"{part}_leftright"] + found[f"{part}_rightleft"])
        if not self.width:
            found["throw"] = found["scanning"] = intervals_of(inside & first, seconds)
        return found


@dataclass(frozen=True)
class Nod:
    """From 0 to the ``stops`` [rad] in turn, at most at ``rate`` [rad/s], with ``acceleration``
    [rad/s^2].
    """

    stops: tuple[float, ...]
    rate: float
    acceleration: float

    @property
    def duration(self) -> float:
        """s."""
        return sum(2 * ramp + coast for _, _, ramp, coast in self._moves())

    def path(self, seconds: Floats) -> Floats:
        """Elevation (n,) above the first stop [rad] at ``seconds`` (n,); the last stop is kept."""
        found = np.zeros(len(seconds))
        begin = 0.0
        for start, way, ramp, coast in self._moves():
            u = np.clip(seconds - begin, 0.0, 2 * ramp + coast)
            v = self.acceleration * ramp
            up = np.minimum(u, ramp)
            down = np.maximum(u - ramp - coast, 0.0)
            gone = (
                self.acceleration * up**2 / 2
                + v * np.clip(u - ramp, 0.0, coast)
                + v * down
                - self.acceleration * down**2 / 2
            )
            found = np.where(seconds >= begin, start + way * gone, found)
            begin += 2 * ramp + coast
        return found

    def _moves(self) -> list[tuple[float, float, float, float]]:
        """(from, direction, time of acceleration, time at constant speed) of each move."""
        moves = []
        at = 0.0
        for stop in self.stops:
            far = abs(stop - at)
            ramp = min(self.rate / self.acceleration, math.sqrt(far / self.acceleration))
            coast = (
                max(far / self.rate - ramp, 0.0)
                if ramp * self.acceleration >= self.rate * (1 - 1e-12)
                else 0.0
            )
            moves.append((at, math.copysign(1.0, stop - at), ramp, coast))
            at = stop
        return moves
