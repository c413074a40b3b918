"""Pointing by an observing schedule."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from functools import partial
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field, field_validator

from zonda.core.configuration.files import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import (
    Angle,
    AngularAcceleration,
    AngularSpeed,
    Fraction,
    SampleRate,
)
from zonda.core.errors import PointingError
from zonda.core.flags import IRREGULAR
from zonda.core.intervals import runs
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.numerics.quaternions import multiply
from zonda.core.numerics.sphere import angles, separation, unit_vectors
from zonda.core.types import Floats

from .base import Scans
from .limits import LargestMotion, check_elevation
from .motion import POINTS, LargestDerivative, Quantity, motion
from .observed import mark_turnarounds, observed, transform_of
from .schedule_files import Row, SchedulesSite, read_schedule
from .sun_and_moon import sunlit
from .sweep import Nod, Sweep

if TYPE_CHECKING:
    from zonda.core.data import Data, Observation
    from zonda.core.scene import Scene

EARTH, NEAR, FAR = 6.371e6, 5e3, 1e5
"""m: the Earth's radius; how far from the scene a schedule's site is another one, and how far its
azimuths make no sense.
"""

ANOTHER_DAY = 86400.0
"""s between the schedule and the scene's time from which a run warns: the weather is the scene's.
"""

MOST_LOOKED_AT = 64
"""Rows of a schedule that `zonda check` looks at."""

Track = Callable[[Floats], Floats]
"""Directions (n, 3) at seconds (n,)."""


class ScheduleParameters(Scans):
    """Parameters that all scans of a schedule share."""

    schedule: InputPath
    """Version 5 (ECSV) or versions 4 to 1 (text) of TOAST's schedules."""
    speed: AngularSpeed = quantity("1 deg/s", gt=0)
    """Constant speed on the sky between the limits."""
    acceleration: AngularAcceleration = quantity("1 deg/s2", gt=0)
    """Acceleration of the mount's azimuth in turnarounds (the largest, where they are smooth)."""
    turnaround: Literal["smooth", "constant_acceleration"] = "constant_acceleration"
    """Constant acceleration as in TOAST, or a continuous one (twice as long)."""
    flag_turnarounds: bool = True
    """Flag the samples in turnarounds, so that no map uses them."""
    sun_close: Angle = quantity("45 deg", gt=0, le=math.pi)
    """Distance of the Sun below which samples are flagged *sun close*. They are used all the same,
    as are those while the Sun is up: both are flags and intervals of files."""
    elevation_nods: list[Angle] = Field(default_factory=list, max_length=100)
    """Offsets in elevation to which the telescope goes in turn before each scan, the last of them
    0, e.g. [1 deg, -1 deg, 0 deg]; flagged irregular."""
    elevation_speed: AngularSpeed = quantity("1 deg/s", gt=0)
    """Largest speed of nods."""
    elevation_acceleration: AngularAcceleration = quantity("1 deg/s2", gt=0)
    """Acceleration of nods."""
    sample_rate: SampleRate | None = Field(None, gt=0, le=1e6)
    """Read-out rate; the instrument's where absent."""
    check_limits: Literal["error", "warn"] = "error"
    """Whether a scan beyond the telescope's largest speed, acceleration or jerk is an error, or a
    warning.
    """
    interpolation_error: Fraction = Field(1e-3, gt=0, le=0.1)
    """Largest error of interpolating the celestial transformation in time, as a fraction of the
    smallest beam's FWHM.
    """

    @field_validator("elevation_nods")
    @classmethod
    def _to_the_scan(cls, value: list[float]) -> list[float]:
        if value and value[-1] != 0:
            raise ValueError(
                "nods end at the elevation of the scan: write 0 deg as the last of them"
            )
        return value


class PointingSchedule(ScheduleParameters):
    """Constant-elevation scans of an observing schedule in TOAST's formats, one observation a row.

    Azimuth limits and `acceleration` are those of the mount, `speed` is on the sky (the mount turns
    1 / cos(elevation) as fast): as in TOAST's `SimGround`, whose turnarounds, flags and intervals
    are the default. A scan begins at the lesser azimuth, towards larger ones, and has as many whole
    samples as fit. Its name ends with the patch, scan and subscan of the row. A schedule that
    states its site is compared with the scene's: 5 km apart are a warning, 100 km an error.
    """

    def every(self) -> Sequence[Row]:
        return self._read()[0]

    def some(self, scans: Sequence[Row]) -> list[Row]:
        """Rows evenly over the schedule, with the lowest and the highest (where the mount turns
        fastest), the widest and the narrowest throw, and the longest and the shortest scan: a limit
        of the telescope that any row exceeds, one of these does.
        """
        if len(scans) <= MOST_LOOKED_AT:
            return list(scans)
        found = {round(k) for k in np.linspace(0, len(scans) - 1, MOST_LOOKED_AT - 6)}
        sizes = [(row.elevation, row.azimuth[1] - row.azimuth[0], row.duration) for row in scans]
        found.update(np.argmin(sizes, axis=0).tolist(), np.argmax(sizes, axis=0).tolist())
        return [scans[k] for k in sorted(found)]

    def length(self, scan: Row) -> float:
        return scan.duration + self.nod.duration

    def summary(self, scans: Sequence[Row], made: Sequence[Observation]) -> str:
        end = max(row.start.shifted(row.duration) for row in scans)
        total = sum(row.duration for row in scans) / 3600
        several = f"{len(scans)} scan{'s' if len(scans) > 1 else ''}"
        return f"{several} from {scans[0].start} to {end}, {total:.3g} h in all"

    def maker(self, data: Data) -> Callable[[Row, float, LargestMotion], Observation]:
        rows, site = self._read()
        self._compare_sites(data, site)
        if abs(data.scene.time.seconds_since(rows[0].start)) > ANOTHER_DAY:
            text = (
                f"the schedule begins {rows[0].start}, the weather is that of {data.scene.time}:"
                " set the scene's time"
            )
            warnings.warn(f"{self.label}: {text}", stacklevel=3)
        return partial(self._observation, data)

    @property
    def nod(self) -> Nod:
        """The motion before each scan."""
        return Nod(tuple(self.elevation_nods), self.elevation_speed, self.elevation_acceleration)

    def _read(self) -> tuple[list[Row], SchedulesSite | None]:
        return read_schedule(self.schedule, self.nod.duration)

    def _compare_sites(self, data: Data, stated: SchedulesSite | None) -> None:
        """Warn where the schedule was made for another site; PointingError where that is far
        away.
        """
        site = data.scene.site
        if stated is None:
            return
        there = np.array([stated.longitude]), np.array([stated.latitude])
        apart = EARTH * float(separation(*there, (site.longitude, site.latitude))[0])
        if apart > NEAR:
            place = f"{np.degrees(stated.latitude):.4f} deg, {np.degrees(stated.longitude):.4f} deg"
            text = (
                f"the schedule was made for {stated.name} ({place}), {apart / 1e3:.4g} km from the"
                f" scene's site {site.name}"
            )
            cure = (
                "set the scene's site, or give a schedule of this site (or remove the site from its"
                " header)"
            )
            if apart > FAR:
                raise PointingError(
                    f"{text}: its azimuths look elsewhere from here",
                    place=f"{self.label}, {self.schedule}",
                    cure=cure,
                )
            warnings.warn(f"{self.label}: {text}: {cure}", stacklevel=4)

    def _observation(self, data: Data, row: Row, rate: float, moved: LargestMotion) -> Observation:
        """The observation of a row, sampled at ``rate`` [Hz]."""
        scene, place = data.scene, f"{self.label}, {self.schedule}, {row.label}"
        mount, width = self.speed / math.cos(row.elevation), row.azimuth[1] - row.azimuth[0]
        smooth = self.turnaround == "smooth"
        sweep = Sweep(width, mount, self.acceleration, smooth)
        nod = self.nod
        ahead = math.ceil(nod.duration * rate * (1 - 1e-12))
        seconds = np.arange(ahead + max(int(row.duration * rate * (1 + 1e-12)), 1)) / rate
        delay = ahead / rate
        start = row.start.shifted(-delay)

        def track(at: Floats) -> Floats:
            azimuth = row.azimuth[0] + np.where(
                at >= delay, sweep.path(np.maximum(at - delay, 0.0)), 0.0
            )
            elevation = row.elevation + np.where(at < delay, nod.path(at), 0.0)
            return unit_vectors(-azimuth, elevation)

        horizontal = track(seconds)
        check_elevation(
            "the scan",
            horizontal,
            scene.instrument.telescope,
            place,
            lambda: "change the row, the elevation_nods, or the telescope's limits",
        )
        transform = transform_of(scene, start, seconds[-1], self.interpolation_error)
        _, azel, radec = transform.boresight(horizontal, seconds)
        lit, suns = sunlit(scene.site, start, seconds, azel, self.sun_close)
        turned = np.array([[0, 0, math.sin(row.rotation / 2), math.cos(row.rotation / 2)]])
        if row.rotation:
            azel, radec = multiply(azel, turned), multiply(radec, turned)
        scanning = seconds >= delay
        intervals = {
            name: [(a + delay, b + delay) for a, b in spans]
            for name, spans in sweep.intervals(seconds - delay, scanning).items()
        }
        if ahead:
            intervals["elnod"] = runs(~scanning, seconds)
        observation = observed(
            self.label,
            scene,
            len(data.observations),
            transform,
            row.label,
            seconds=seconds,
            sample_rate=rate,
            boresight_azel=azel,
            boresight_radec=radec,
            centre=_centre(scene, row, transform, delay),
            flags=np.where(scanning, 0, IRREGULAR).astype(np.uint8) | lit,
            intervals=intervals | suns,
        )
        refused = place if self.check_limits == "error" else ""
        for begin, end, bounded in ((0.0, delay, False), (delay, len(seconds) / rate, smooth)):
            if end > begin:
                limits = {q: v for q, v in moved.limits.items() if bounded or q[1] < 3}
                found = _motion(track, begin, end, limits)
                known = {q: peak for q, peak in found.items() if bounded or q[1] < 3}
                moved.add(observation.name, known, refused)
        log = observation.log
        log.state(self.label, f"{observation.name}: row of the schedule", row.label)
        turning = sweep.turning(seconds - delay) & scanning
        mark_turnarounds(self.label, observation, turning, self.flag_turnarounds)
        if ahead:
            what = "samples in elevation nods, flagged"
            log.count(self.label, what, ahead, len(seconds))
        return observation


def _centre(
    scene: Scene, row: Row, transform: CelestialTransform, delay: float
) -> tuple[float, float]:
    """ICRS (ra, dec) of the scene's target; of the middle of the scan where it has none, or one
    fixed on the ground.
    """
    if scene.target is not None and scene.target.frame != "horizontal":
        return scene.target.icrs()
    middle = unit_vectors([-sum(row.azimuth) / 2], [row.elevation])
    ra, dec = angles(transform.icrs(middle, np.array([delay + row.duration / 2]))[0])
    return float(ra % (2 * math.pi)), float(dec)


def _motion(
    track: Track, begin: float, end: float, limits: dict[Quantity, float]
) -> dict[Quantity, LargestDerivative]:
    """The largest derivatives of a part of the track, from begin to end [s].

    A scan begins at full speed: from the nod to the scan there is no motion to compare.
    """

    def at(interval: float) -> Floats:
        number = max(round((end - begin) / interval), 1)
        return track(begin + np.arange(number, dtype=np.float64) * interval)

    coarse = POINTS / (end - begin)
    found = motion(at(1 / coarse), coarse, limits, at)
    return {q: peak._replace(second=begin + peak.second) for q, peak in found.items()}
