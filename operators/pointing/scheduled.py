"""Scans of an observing schedule: what a pointing step knows of them, and the observation of each
row.
"""

from __future__ import annotations

import math
from collections.abc import Callable
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
from zonda.core.flags import IRREGULAR, TURNAROUND
from zonda.core.intervals import runs
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.numerics.quaternions import multiply
from zonda.core.numerics.sphere import angles, unit_vectors
from zonda.core.operator import Operator
from zonda.core.types import Floats

from .constant_elevation import Nod, Sweep
from .limits import LargestMotion, excess
from .motion import POINTS, motion
from .observed import Samples, observed
from .schedule_files import Row
from .sun_and_moon import sunlit

if TYPE_CHECKING:
    from zonda.core.data import Data, Observation
    from zonda.core.instrument import Telescope

Track = Callable[[Floats], Floats]
"""Directions (n, 3) at seconds (n,)."""


class ScheduleParameters(Operator):
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

    @property
    def nod(self) -> Nod:
        """The motion before each scan."""
        return Nod(tuple(self.elevation_nods), self.elevation_speed, self.elevation_acceleration)

    def _observation(self, data: Data, row: Row, rate: float, moved: LargestMotion) -> Observation:
        """The observation of a row, sampled at ``rate`` [Hz]."""
        scene, place = data.scene, f"{self.label}, {self.schedule}, {row.label}"
        mount = self.speed / math.cos(row.elevation)
        sweep = Sweep(
            row.azimuth[1] - row.azimuth[0], mount, self.acceleration, self.turnaround == "smooth"
        )
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
        _check_elevation(horizontal, scene.instrument.telescope, place)
        beam = float(scene.instrument.focalplane().fwhm.min())
        transform = CelestialTransform(
            scene.site, start, seconds[-1], self.interpolation_error * beam
        )
        _, azel, radec = transform.boresight(horizontal, seconds)
        boresight = (_turned(azel, row.rotation), _turned(radec, row.rotation))
        scanning = seconds >= delay
        intervals = sweep.intervals(seconds - delay, scanning)
        intervals = {
            name: [(a + delay, b + delay) for a, b in spans] for name, spans in intervals.items()
        }
        flags = np.where(scanning, 0, IRREGULAR).astype(np.uint8)
        if ahead:
            intervals["elnod"] = runs(~scanning, seconds)
        turning = sweep.turning(seconds - delay) & scanning
        if self.flag_turnarounds:
            flags |= np.where(turning, TURNAROUND, 0).astype(np.uint8)
        lit, suns = sunlit(scene.site, start, seconds, azel, self.sun_close)
        centre = _centre(data, row, transform, delay)
        samples = Samples(seconds, rate, boresight, flags | lit, intervals | suns)
        observation = observed(
            self.label, scene, len(data.observations), transform, centre, samples, row.label
        )
        refused = place if self.check_limits == "error" else None
        end = len(seconds) / rate
        _check_motion(moved, observation.name, track, (0.0, delay), False, refused)
        _check_motion(moved, observation.name, track, (delay, end), sweep.smooth, refused)
        observation.tally.state(self.label, f"{observation.name}: row of the schedule", row.label)
        what = "samples in turnarounds" + (", flagged" if self.flag_turnarounds else ", used")
        observation.tally.count(self.label, what, int(turning.sum()), len(seconds))
        if ahead:
            observation.tally.count(
                self.label, "samples in elevation nods, flagged", ahead, len(seconds)
            )
        return observation


def _centre(
    data: Data, row: Row, transform: CelestialTransform, delay: float
) -> tuple[float, float]:
    """ICRS (ra, dec) of the scene's target; of the middle of the scan where it has none, or one
    fixed on the ground.
    """
    target = data.scene.target
    if target is not None and target.frame != "horizontal":
        return target.icrs()
    middle = unit_vectors([-sum(row.azimuth) / 2], [row.elevation])
    ra, dec = angles(transform.icrs(middle, np.array([delay + row.duration / 2]))[0])
    return float(ra % (2 * math.pi)), float(dec)


def _check_elevation(horizontal: Floats, telescope: Telescope, place: str) -> None:
    """Refuse directions (n, 3) that the telescope cannot reach."""
    low, high = telescope.elevation_min, telescope.elevation_max
    _, elevation = angles(horizontal[[horizontal[:, 2].argmin(), horizontal[:, 2].argmax()]])
    if elevation.min() < low - 1e-9 or elevation.max() > high + 1e-9:
        worst = elevation.min() if elevation.min() < low - 1e-9 else elevation.max()
        raise PointingError(
            f"the scan goes to elevation {np.degrees(worst):.2f} deg; {telescope.name} reaches "
            f"{np.degrees(low):g} deg to {np.degrees(high):g} deg",
            place=place,
            cure="change the row of the schedule, the elevation_nods, or the telescope's limits",
        )


def _check_motion(
    moved: LargestMotion,
    name: str,
    track: Track,
    part: tuple[float, float],
    smooth: bool,
    place: str | None,
) -> None:
    """Compare a part of the track, from begin to end [s], with the telescope's limits.

    A scan begins at full speed: from the nod to the scan there is no motion to compare. Not
    ``smooth``: its jerk has no bound. Raises PointingError at ``place`` for a scan beyond a limit;
    None: that is a warning.
    """
    begin, end = part
    if end <= begin:
        return
    limits = {q: limit for q, limit in moved.limits.items() if smooth or q[1] < 3}

    def at(interval: float) -> Floats:
        number = max(round((end - begin) / interval), 1)
        return track(begin + np.arange(number, dtype=np.float64) * interval)

    coarse = POINTS / (end - begin)
    found = motion(at(1 / coarse), coarse, limits, at)
    found = {
        q: peak._replace(second=begin + peak.second)
        for q, peak in found.items()
        if smooth or q[1] < 3
    }
    over = excess(found, limits)
    if over and place is not None:
        cure = "lower speed or acceleration, or set check_limits: warn"
        raise PointingError(moved.too_fast(next(iter(over)), found), place=place, cure=cure)
    moved.add(name, found)


def _turned(quaternions: Floats, angle: float) -> Floats:
    """Boresights (n, 4) with the focal plane turned about them."""
    if angle == 0:
        return quaternions
    about = np.array([[0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)]])
    return multiply(quaternions, about)
