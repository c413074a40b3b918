"""Rows back and forth and up and down: the path of a raster, and the values that suit a camera and
its telescope.

A row of length w is crossed at constant speed v. Outside of it the telescope turns round within T
and steps by s to the next row. With u the fraction of T that has passed, at constant acceleration

    x = w/2 + v T (u - u^2),   y = s (2 u^2; from u = 1/2 on 1 - 2 (1 - u)^2)          (1)

or, with continuous acceleration,

    x = w/2 + v T [u - u^2 + (1 - cos(2 pi u)) / (2 pi^2)],
    y = s [u - sin(2 pi u) / (2 pi)].                        (2)

The largest accelerations of x and y are b v / T and c s / T^2, (b, c) = (2, 4) or (4, 2 pi). T is
the shortest with (b v / T)^2 + (c s / T^2)^2 <= a^2 and a largest speed of y, 2 s / T, of at most
v:

    T^2 = [b^2 v^2 + sqrt(b^4 v^4 + 4 a^2 c^2 s^2)] / (2 a^2),
    T >= 2 s / v.                                         (3)

The last row is crossed twice, and the rows are then gone back: 1, 2, ..., n, n, ..., 2, 1, 1, 2,
...; every second pass of a row has the other direction.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zonda.core.types import Floats

if TYPE_CHECKING:
    from zonda.core.instrument import Instrument, Telescope

WIDEST = math.radians(5.0)
"""Largest side of a raster that follows from the field of view."""
BEAMS = 6
"""Smallest side of such a raster, in beams."""
SHARE = 0.3
"""Fraction of the telescope's limits that it uses: the azimuth axis turns 1 / cos(elevation) times
as fast as the beam.
"""
ROW_TIME, TURN_TIME = 5.0, 2.0
"""Shortest time for a row and a turnaround whose speed and acceleration are not given, s."""


class Rows(NamedTuple):
    """A raster: ``n`` rows of length ``width`` [rad], ``spacing`` [rad] apart, at ``speed``
    [rad/s].
    """

    width: float
    spacing: float
    n: int
    speed: float
    acceleration: float
    """Largest in turnarounds, rad/s^2."""
    smooth: bool
    """Equation (2) instead of (1)."""

    @property
    def leg(self) -> float:
        """Duration of a row, s."""
        return self.width / self.speed

    @property
    def turnaround(self) -> float:
        """T of equation (3), s."""
        b, c = (4.0, 2 * math.pi) if self.smooth else (2.0, 4.0)
        step = self.spacing if self.n > 1 else 0.0
        along, across = (b * self.speed) ** 2, 2 * self.acceleration * c * step
        needed = math.sqrt((along + math.hypot(along, across)) / 2) / self.acceleration
        return max(needed, 2 * step / self.speed)

    @property
    def overshoot(self) -> float:
        """Reach of a turnaround beyond the end of a row, rad: equations (1) and (2) at u = 1/2."""
        return self.speed * self.turnaround * (0.25 + 1 / math.pi**2 if self.smooth else 0.25)

    @property
    def speed_within(self) -> float:
        """The speed, rad/s, whose turnarounds reach a row's length beyond its ends at this
        acceleration; steps apart.
        """
        b, reach = (4.0, 0.25 + 1 / math.pi**2) if self.smooth else (2.0, 0.25)
        return math.sqrt(self.acceleration * self.width / (b * reach))

    @property
    def pass_time(self) -> float:
        """Duration of all rows once, and the turnarounds between them, s."""
        return self.n * (self.leg + self.turnaround) - self.turnaround

    def path(self, seconds: Floats) -> tuple[Floats, Floats]:
        """(x, y) [rad] along the rows and across them, from the middle; each (n,) at ``seconds``
        (n,).
        """
        turn = self.turnaround
        number, within = np.divmod(seconds, self.leg + turn)
        u = np.clip((within - self.leg) / turn, 0.0, 1.0)
        beyond, step = u - u * u, np.where(u < 0.5, 2 * u * u, 1 - 2 * (1 - u) ** 2)
        if self.smooth:
            beyond += (1 - np.cos(2 * np.pi * u)) / (2 * np.pi**2)
            step = u - np.sin(2 * np.pi * u) / (2 * np.pi)
        x = self.speed * np.minimum(within, self.leg) - self.width / 2 + self.speed * turn * beyond
        now, then = self.row(number), self.row(number + 1)
        y = (now + (then - now) * step - (self.n - 1) / 2) * self.spacing
        return np.where(number % 2 == 0, x, -x), y

    def row(self, number: Floats) -> Floats:
        """Number of the row, from 0, that is crossed in the passage ``number``."""
        within = np.mod(number, 2 * self.n)
        return np.asarray(np.minimum(within, 2 * self.n - 1 - within))

    def turning(self, seconds: Floats) -> NDArray[np.bool_]:
        """(n,) True in turnarounds."""
        return np.asarray(np.mod(seconds, self.leg + self.turnaround) > self.leg)


def side_of(instrument: Instrument) -> float:
    """Side [rad] of a raster for a camera: its field of view; at least some beams, at most
    `WIDEST`.
    """
    return min(max(instrument.field_of_view, BEAMS * instrument.beam_fwhm), WIDEST)


def spacing_of(instrument: Instrument) -> float:
    """Spacing [rad] of rows: a quarter of the field of view, half a beam where that is more.

    The coverage of a disc of diameter D along rows s apart ripples by 4 J_1(pi D / s) / (pi D / s),
    relative: 5 % at s = D / 4.
    """
    return max(min(instrument.field_of_view, WIDEST) / 4, instrument.beam_fwhm / 2)


def speed_of(width: float, instrument: Instrument) -> float:
    """Speed [rad/s] for rows of ``width`` [rad]: four samples per beam, `ROW_TIME`, `SHARE` of the
    telescope's limits.
    """
    sampled = instrument.beam_fwhm * instrument.sample_rate / 4
    return min([sampled, width / ROW_TIME, *_share(instrument.telescope, "speed")])


def acceleration_of(speed: float, telescope: Telescope) -> float:
    """Acceleration [rad/s^2] of turnarounds from ``speed`` [rad/s]: `TURN_TIME`, `SHARE` of the
    telescope's limits.
    """
    return min([2 * speed / TURN_TIME, *_share(telescope, "acceleration")])


def _share(telescope: Telescope, what: str) -> list[float]:
    limits = [getattr(telescope, f"{axis}{what}_max") for axis in ("", "azimuth_", "elevation_")]
    return [SHARE * limit for limit in limits if limit is not None]
