"""On-the-fly maps: rows of any position angle, in both directions in turn."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, AngularAcceleration, AngularSpeed
from zonda.core.flags import TURNAROUND
from zonda.core.intervals import Intervals, runs
from zonda.core.numerics.celestial import Boresight
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.quaternions import series
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.types import Floats

from .base import Aim, Pointing
from .motion import rate_text
from .rows import Rows, acceleration_of, side_of, spacing_of, speed_of

if TYPE_CHECKING:
    from zonda.core.data import Data, Observation
    from zonda.core.instrument import Instrument


def _kind(value: Any) -> str:
    return "name" if isinstance(value, str) else "list"


Angles = Annotated[
    Annotated[Literal["same", "cross_hatch"], Tag("name")]
    | Annotated[list[Angle], Tag("list"), Field(min_length=1)],
    Discriminator(_kind),
]
"""By how much the raster is turned from scan to scan."""


RASTER = ": raster"
"""End of the log entry that states the raster of a scan."""


class RasterParameters(Pointing):
    """Parameters of `PointingRaster`. One that is absent follows from the instrument, and stands in
    the log of the run.
    """

    width: Angle | None = Field(None, gt=0, le=0.5)
    """Length of a row; where absent, the field of view (at least 6 beams, at most 5 deg)."""
    height: Angle | None = Field(None, ge=0, le=0.5)
    """Distance between the first and the last row, at most; where absent, the `width`."""
    spacing: Angle | None = Field(None, gt=0, le=0.5)
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
    angles: Angles = "same"
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
        """The raster of a scan with every value filled in."""
        width = self.width if self.width is not None else side_of(instrument)
        height = self.height if self.height is not None else width
        crossed = self.angles == "cross_hatch" and number % 2 == 1
        added = (
            math.pi / 2
            if crossed
            else self.angles[number % len(self.angles)]
            if isinstance(self.angles, list)
            else 0.0
        )
        if crossed and height > 0:
            width, height = height, width
        speed = self.speed if self.speed is not None else speed_of(width, instrument)
        telescope = instrument.telescope
        jerk = telescope.azimuth_jerk_max is not None or telescope.elevation_jerk_max is not None
        found = {
            "width": width,
            "height": height,
            "spacing": self.spacing if self.spacing is not None else spacing_of(instrument),
            "speed": speed,
            "acceleration": (
                self.acceleration
                if self.acceleration is not None
                else acceleration_of(speed, telescope)
            ),
            "smooth": jerk if self.smooth is None else self.smooth,
            "position_angle": self.position_angle + added,
        }
        return self.model_copy(update=found)


class PointingRaster(RasterParameters):
    """Rows on the sky, `spacing` apart, back and forth and up and down again for as long as the
    scan lasts.

    Each row is crossed at constant `speed`; the telescope turns round outside of it within the time
    T that `acceleration` allows, stepping to the next row (equations 1 to 3 of
    `operators/pointing/rows.py`). All rows once take rows (width / speed + T) - T.
    """

    @property
    def rows(self) -> Rows:
        """The rows, where every value is known (`of_scan`)."""
        width, height, spacing, speed, acceleration = (
            float(value or 0.0)
            for value in (self.width, self.height, self.spacing, self.speed, self.acceleration)
        )
        return Rows(
            width,
            spacing,
            math.floor(height / spacing + 1e-9) + 1,
            speed,
            acceleration,
            bool(self.smooth),
        )

    def path(self, seconds: Floats) -> tuple[Floats, Floats]:
        along, across = self.rows.path(seconds)
        sine, cosine = math.sin(self.position_angle), math.cos(self.position_angle)
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

    def flag(self, seconds: Floats) -> NDArray[np.uint8]:
        return np.where(self.flag_turnarounds & self.rows.turning(seconds), TURNAROUND, 0).astype(
            np.uint8
        )

    def intervals(self, seconds: Floats) -> Intervals:
        turning = self.rows.turning(seconds)
        return {"scanning": runs(~turning, seconds), "turnaround": runs(turning, seconds)}

    def check(self, data: Data) -> list[str]:
        first, lines = len(data.observations), super().check(data)
        return [
            *lines,
            *(
                f"raster: {text}"
                for _, what, text in data.observations[first].tally
                if what.endswith(RASTER)
            ),
        ]

    def describe(self, observation: Observation) -> None:
        rows, tally = self.rows, observation.tally
        tally.state(
            self.label,
            observation.name + RASTER,
            _stated(rows, self.position_angle, self.scan_duration),
        )
        what = "samples in turnarounds" + (", flagged" if self.flag_turnarounds else ", used")
        tally.count(
            self.label, what, int(rows.turning(observation.seconds).sum()), observation.n_samples
        )
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
        took, lasts = f"{rows.pass_time:.4g} s", f"scan_duration is {duration:.4g} s"
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
