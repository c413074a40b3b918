"""On-the-fly maps: rows of any position angle, in both directions in turn.

A row of length w is crossed at constant speed v. Outside of it the telescope turns round within T
as equations (1) and (2) of `sweep` say, and steps by s to the next row. With u the fraction of T
that has passed, at constant or with continuous acceleration,

    y = s (2 u^2; from u = 1/2 on 1 - 2 (1 - u)^2),                                        (1)
    y = s [u - sin(2 pi u) / (2 pi)].                                                      (2)

The largest accelerations of x and y are b v / T and c s / T^2, (b, c) = (2, 4) or (4, 2 pi). T is
the shortest with (b v / T)^2 + (c s / T^2)^2 <= a^2 and a largest speed of y, 2 s / T, of at most
v:

    T^2 = [b^2 v^2 + sqrt(b^4 v^4 + 4 a^2 c^2 s^2)] / (2 a^2),
    T >= 2 s / v.                                                                          (3)

The last row is crossed twice, and the rows are then gone back: 1, 2, ..., n, n, ..., 2, 1, 1, 2,
...; every second pass of a row has the other direction.
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Discriminator, Field, Tag

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, AngularAcceleration, AngularSpeed
from zonda.core.data import Data, Observation
from zonda.core.flags import Intervals, intervals_of
from zonda.core.instrument import Instrument
from zonda.core.numerics.celestial import Boresight
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.quaternions import series
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.types import Floats

from .base import Aim, Pointing, kind
from .motion import rate_text
from .observed import mark_turnarounds
from .sweep import Sweep

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


Angles = Annotated[
    Annotated[Literal["same", "cross_hatch"], Tag("name")]
    | Annotated[list[Angle], Tag("list"), Field(min_length=1)],
    Discriminator(kind),
]
"""By how much the raster is turned from scan to scan."""


RASTER = ": raster"
"""End of the log entry that states the raster of a scan."""

AXES = ("", "azimuth_", "elevation_")
"""Beginnings of the names of a telescope's limits."""


@dataclass(frozen=True)
class Rows(Sweep):
    """A raster: ``n`` rows, ``spacing`` [rad] apart."""

    spacing: float = 0.0
    n: int = 1

    @property
    def turnaround(self) -> float:
        """T of equation (3), s."""
        b, c = (4.0, 2 * math.pi) if self.smooth else (2.0, 4.0)
        step = self.spacing if self.n > 1 else 0.0
        along = (b * self.speed) ** 2
        across = 2 * self.acceleration * c * step
        needed = math.sqrt((along + math.hypot(along, across)) / 2) / self.acceleration
        return max(needed, 2 * step / self.speed)

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

    def offsets(self, seconds: Floats) -> tuple[Floats, Floats]:
        """(x, y) [rad] along the rows and across them, from the middle; each (n,)."""
        number, _, u = self.passages(seconds)
        step = np.where(u < 0.5, 2 * u * u, 1 - 2 * (1 - u) ** 2)
        if self.smooth:
            step = u - np.sin(2 * np.pi * u) / (2 * np.pi)
        now = self.row(number)
        then = self.row(number + 1)
        y = (now + (then - now) * step - (self.n - 1) / 2) * self.spacing
        return self.path(seconds), np.asarray(y)

    def row(self, number: Floats) -> Floats:
        """Number of the row, from 0, that is crossed in the passage ``number``."""
        within = np.mod(number, 2 * self.n)
        return np.asarray(np.minimum(within, 2 * self.n - 1 - within))


class RasterParameters(Pointing):
    """Parameters of `PointingRaster`. One that is absent follows from the instrument, and stands in
    the log of the run.
    """

    width: Angle | None = Field(None, gt=0, le=0.5)
    """Length of a row; where absent, the field of view (at least 6 beams, at most 5 deg)."""
    height: Angle | None = Field(None, ge=0, le=0.5)
    """Distance between the first and the last row, at most; where absent, the `width`."""
    spacing: Angle | None = Field(None, gt=0, le=0.5, examples=["10 arcsec"])
    """Distance between rows; where absent, a quarter of the field of view, or half a beam where
    that is more.
    """
    speed: AngularSpeed | None = Field(None, gt=0)
    """Constant speed along a row, on the sky; where absent, a row takes 5 s, with at least 4
    samples per beam and at most 0.3 of the telescope's limits of speed."""
    acceleration: AngularAcceleration | None = Field(None, gt=0)
    """Largest acceleration in a turnaround, on the sky; where absent, a turnaround takes 2 s, with
    at most 0.3 of the telescope's limits of acceleration."""
    smooth: bool | None = None
    """Whether the acceleration in turnarounds is continuous (they take twice as long) or constant;
    where absent, it is continuous for a telescope with a limit of jerk."""
    position_angle: Angle = quantity("90 deg")
    """Position angle of the rows, from north through east: 90 deg is along right ascension. In
    horizontal axes from the zenith through larger azimuth: 90 deg is along azimuth."""
    angles: Angles = Field("same", examples=["45 deg"])
    """What is added to `position_angle` in the scans in turn: nothing; `cross_hatch`, every second
    scan crosses the same field at right angles; or a list of angles."""
    axes: Literal["sky", "horizontal"] = "sky"
    """`sky`: the raster is fixed on the sky, or on the ground for an az/el target. `horizontal`:
    about a celestial target it follows azimuth and elevation."""
    flag_turnarounds: bool = False
    """Flag the samples in turnarounds (bit value 4), so that no map uses them; without it they are
    used like all others.
    """

    slows: ClassVar[dict[str, tuple[int, int]]] = {"speed": (-1, 1), "acceleration": (-1, 2)}

    def of_scan(self, number: int, instrument: Instrument) -> Pointing:
        """The raster of a scan with every value filled in.

        The coverage of a disc of diameter D along rows s apart ripples by 4 J_1(pi D / s) / (pi D /
        s), relative: 5 % at s = D / 4.
        """
        telescope = instrument.telescope
        beam = instrument.beam_fwhm

        def otherwise(name: str, *values: float) -> float:
            """The parameter, or the least of the values and `SHARE` of the telescope's limits."""
            given: float | None = getattr(self, name)
            limits = [getattr(telescope, f"{axis}{name}_max", None) for axis in AXES]
            share = (SHARE * limit for limit in limits if limit is not None)
            return min(*values, *share) if given is None else given

        field = min(instrument.field_of_view, WIDEST)
        width = otherwise("width", max(instrument.field_of_view, BEAMS * beam), WIDEST)
        height = otherwise("height", width, width)
        added = self.angles[number % len(self.angles)] if isinstance(self.angles, list) else 0.0
        if self.angles == "cross_hatch" and number % 2 == 1:
            added = math.pi / 2
            if height > 0:
                width, height = height, width
        speed = otherwise("speed", beam * instrument.sample_rate / 4, width / ROW_TIME)
        jerk = telescope.azimuth_jerk_max is not None or telescope.elevation_jerk_max is not None
        found = {
            "width": width,
            "height": height,
            "spacing": max(field / 4, beam / 2) if self.spacing is None else self.spacing,
            "speed": speed,
            "acceleration": otherwise("acceleration", 2 * speed / TURN_TIME, math.inf),
            "smooth": jerk if self.smooth is None else self.smooth,
            "position_angle": self.position_angle + added,
        }
        return self.model_copy(update=found)


class PointingRaster(RasterParameters):
    """Rows on the sky, `spacing` apart, back and forth and up and down again for as long as the
    scan lasts.

    Each row is crossed at constant `speed`; the telescope turns round outside of it within the time
    T that `acceleration` allows, stepping to the next row (equations 1 to 3 of
    `operators/pointing/raster.py`). All rows once take rows (width / speed + T) - T.
    """

    @property
    def rows(self) -> Rows:
        """The rows, where every value is known (`of_scan`)."""
        width, height, spacing, speed, acceleration = (
            float(value or 0.0)
            for value in (self.width, self.height, self.spacing, self.speed, self.acceleration)
        )
        n = math.floor(height / spacing + 1e-9) + 1
        smooth = bool(self.smooth)
        return Rows(width, speed, acceleration, smooth, -width / 2, spacing, n)

    def path(self, seconds: Floats) -> tuple[Floats, Floats]:
        along, across = self.rows.offsets(seconds)
        sine = math.sin(self.position_angle)
        cosine = math.cos(self.position_angle)
        return along * sine - across * cosine, along * cosine + across * sine

    def boresight(self, aim: Aim, seconds: Floats) -> Boresight:
        if self.axes == "horizontal" or aim.target.frame == "horizontal":
            return super().boresight(aim, seconds)
        return aim.transform.follow(lambda chunk: self._on_the_sky(aim, chunk), seconds)

    def directions(self, aim: Aim, seconds: Floats) -> Floats:
        if self.axes == "sky" or aim.target.frame == "horizontal":
            return super().directions(aim, seconds)
        found = series(3, len(seconds))
        for chunk in chunks(len(seconds)):
            centre = aim.transform.horizontal(unit_vectors(*aim.target.icrs()), seconds[chunk])
            x, y = self.path(seconds[chunk])
            found[chunk] = _beside(centre, x + aim.offset[0], y + aim.offset[1])
        return found

    def intervals(self, seconds: Floats) -> Intervals:
        turning = self.rows.turning(seconds)
        return {
            "scanning": intervals_of(~turning, seconds),
            "turnaround": intervals_of(turning, seconds),
        }

    def check(self, data: Data) -> list[str]:
        first = len(data.observations)
        lines = super().check(data)
        return [
            *lines,
            *(
                f"raster: {text}"
                for _, what, text in data.observations[first].log
                if what.endswith(RASTER)
            ),
        ]

    def describe(self, observation: Observation) -> None:
        rows = self.rows
        observation.log.state(
            self.label,
            observation.name + RASTER,
            _stated(rows, self.position_angle, self.scan_duration),
        )
        turning = rows.turning(observation.seconds)
        mark_turnarounds(self.label, observation, turning, self.flag_turnarounds)
        for text in _doubts(rows, self.scan_duration, 1 / observation.sample_rate):
            warnings.warn(f"{self.label}: {observation.name}{text}", stacklevel=2)


def _doubts(rows: Rows, duration: float, interval: float) -> list[str]:
    """Warnings about a raster's scans of ``duration`` [s], sampled at an ``interval`` [s]; each
    follows the scan's name.
    """
    found = []
    if rows.overshoot > rows.width:
        share = rows.turnaround / (rows.leg + rows.turnaround)
        found.append(
            f": turnarounds reach {rate_text(rows.overshoot, 0)} beyond rows of"
            f" {rate_text(rows.width, 0)} and take {100 * share:.0f} % of the time, and the map is"
            f" as wide: the speed is high for an acceleration of {rate_text(rows.acceleration, 2)};"
            f" scan at {rate_text(rows.speed_within, 1)} or less, make rows longer, or give the map"
            " a width"
        )
    if duration < rows.pass_time - interval:
        took = f"{rows.pass_time:.4g} s"
        lasts = f"scan_duration is {duration:.4g} s"
        found.append(f" ends before all {rows.n} rows are crossed: they take {took}, {lasts}")
    return found


def _beside(centre: Floats, x: Floats, y: Floats) -> Floats:
    """Unit vectors (n, 3) north, west, up at gnomonic offsets x (increasing azimuth) and y (zenith)
    [rad] from others (n, 3).
    """
    level = np.hypot(centre[:, 0], centre[:, 1])
    north, west, up = centre.T
    azimuth = np.stack([west, -north, np.zeros(len(x))], axis=1) / level[:, None]
    zenith = np.stack([-up * north / level, -up * west / level, level], axis=1)
    vectors = centre + x[:, None] * azimuth + y[:, None] * zenith
    return np.asarray(vectors / np.sqrt(1 + x * x + y * y)[:, None])


def _stated(rows: Rows, angle: float, duration: float) -> str:
    """A raster in words."""
    count = f"{rows.n} row{'s' if rows.n > 1 else ''} of {rate_text(rows.width, 0)}"
    apart = f", {rate_text(rows.spacing, 0)} apart" if rows.n > 1 else ""
    where = f" at position angle {math.degrees(angle) % 180:.4g} deg, at {rate_text(rows.speed, 1)}"
    turn = (
        f"; turnarounds of {rows.turnaround:.3g} s, up to {rate_text(rows.overshoot, 0)} beyond"
        " a row"
    )
    turn += f"; all rows take {rows.pass_time:.4g} s"
    return f"{count}{apart}{where}{turn}, {duration / rows.pass_time:.3g} times in a scan"
