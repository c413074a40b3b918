"""Scans of an observing schedule."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
from pydantic import Field

from zonda.core.configuration.files import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle, AngularAcceleration, AngularSpeed, Fraction, Hertz
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
from .observed import Samples, observed, report
from .samples_per_beam import SamplesPerBeam
from .schedule_files import Row, read_schedule
from .sun_and_moon import distances

if TYPE_CHECKING:
    from zonda.core.data import Data, Observation
    from zonda.core.instrument import Telescope

Track = Callable[[Floats], Floats]
"""Directions (n, 3) at seconds (n,)."""

CHECKED = 1 << 14
"""Samples of all scans together that `zonda check` looks at."""

ANOTHER_DAY = 86400.0
"""s between the schedule and the scene's time from which a run warns: the weather is the scene's."""


class PointingSchedule(Operator):
    """Constant-elevation scans of an observing schedule in TOAST's formats, one observation a row.

    Azimuth limits and `acceleration` are those of the mount, `speed` is on the sky (the mount turns 1 / cos(elevation) as fast):
    as in TOAST's `SimGround`. A scan begins at the lesser azimuth, towards larger ones, and has as many whole samples as fit.
    """

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})

    schedule: InputPath
    """Version 5 (ECSV) or version 4 (text) of TOAST's schedules."""
    speed: AngularSpeed = quantity("1 deg/s", gt=0)
    """Constant speed on the sky between the limits."""
    acceleration: AngularAcceleration = quantity("1 deg/s2", gt=0)
    """Acceleration of the mount's azimuth in turnarounds (the largest, where they are smooth)."""
    turnaround: Literal["smooth", "constant_acceleration"] = "smooth"
    """Continuous acceleration (4 speed / acceleration long), or a constant one as in TOAST (half as long)."""
    flag_turnarounds: bool = True
    """Flag the samples in turnarounds, so that no map uses them."""
    elevation_nods: list[Angle] = Field(default_factory=list, max_length=100)
    """Offsets in elevation to which the telescope goes in turn before each scan, e.g. [1 deg, -1 deg, 0 deg]; flagged
    irregular."""
    elevation_speed: AngularSpeed = quantity("1 deg/s", gt=0)
    """Largest speed of nods."""
    elevation_acceleration: AngularAcceleration = quantity("1 deg/s2", gt=0)
    """Acceleration of nods."""
    sample_rate: Hertz | None = Field(None, gt=0, le=1e6)
    """Read-out rate; the instrument's where absent."""
    check_limits: Literal["error", "warn"] = "error"
    """Whether a scan beyond the telescope's largest speed, acceleration or jerk is an error, or a warning."""
    interpolation_error: Fraction = Field(1e-3, gt=0, le=0.1)
    """Largest error of interpolating the celestial transformation in time, as a fraction of the smallest beam's FWHM."""

    def observe(self, data: Data) -> None:
        """Append an observation for each row."""
        self._observe(data, self.sample_rate or data.scene.instrument.sample_rate)

    def check(self, data: Data) -> list[str]:
        """How many scans there are, where they look, how fast, and how near to Sun and Moon."""
        first, rate = len(data.observations), self.sample_rate or data.scene.instrument.sample_rate
        rows = read_schedule(self.schedule)
        total = sum(row.duration for row in rows)
        self._observe(data, min(rate, CHECKED / total))
        made = data.observations[first:]
        elevations = np.degrees([(o.elevation.min(), o.elevation.max()) for o in made])
        end = max(row.start.shifted(row.duration) for row in rows)
        lines = [f"{len(rows)} scan{'s' if len(rows) > 1 else ''} from {rows[0].start} to {end}, {total / 3600:.3g} h in all"]
        lines.append(f"elevation: {elevations.min():.2f} to {elevations.max():.2f} deg")
        lines += distances(made)
        topics = LargestMotion.TOPICS + SamplesPerBeam.TOPICS
        return lines + [f"{what}: {text}" for _, what, text in made[0].tally if what.startswith(topics)]

    def _observe(self, data: Data, rate: float) -> None:
        scene, before = data.scene, len(data.observations)
        rows = read_schedule(self.schedule)
        if abs(scene.time.seconds_since(rows[0].start)) > ANOTHER_DAY:
            text = f"the schedule begins {rows[0].start}, the weather is that of {scene.time}: set the scene's time"
            warnings.warn(f"{self.label}: {text}", stacklevel=3)
        moved, sampled = LargestMotion(scene.instrument.telescope), SamplesPerBeam()
        if self.turnaround == "constant_acceleration":  # its jerk has no bound
            moved.limits = {q: limit for q, limit in moved.limits.items() if q[1] < 3}
        for row in rows:
            observation = self._scan(data, row, rate, moved)
            sampled.add(observation, self.sample_rate or scene.instrument.sample_rate)
            data.observations.append(observation)
        report(self.label, data.observations[before:], moved, sampled)

    def _scan(self, data: Data, row: Row, rate: float, moved: LargestMotion) -> Observation:
        """The observation of a row, sampled at ``rate`` [Hz]."""
        scene, place = data.scene, f"{self.label}, {self.schedule}, {row.label}"
        mount = self.speed / math.cos(row.elevation)
        sweep = Sweep(row.azimuth[1] - row.azimuth[0], mount, self.acceleration, self.turnaround == "smooth")
        nod = Nod(tuple(self.elevation_nods), self.elevation_speed, self.elevation_acceleration)
        ahead = int(nod.duration * rate)
        seconds = np.arange(ahead + max(int(row.duration * rate * (1 + 1e-12)), 1)) / rate
        delay = ahead / rate
        start = row.start.shifted(-delay)

        def track(at: Floats) -> Floats:
            azimuth = row.azimuth[0] + np.where(at >= delay, sweep.path(np.maximum(at - delay, 0.0)), 0.0)
            elevation = row.elevation + np.where(at < delay, nod.path(at), 0.0)
            return unit_vectors(-azimuth, elevation)

        horizontal = track(seconds)
        self._check_elevation(horizontal, scene.instrument.telescope, place)
        beam = float(scene.instrument.focalplane().fwhm.min())
        transform = CelestialTransform(scene.site, start, seconds[-1], self.interpolation_error * beam)
        _, azel, radec = transform.boresight(horizontal, seconds)
        boresight = (_turned(azel, row.rotation), _turned(radec, row.rotation))
        scanning = seconds >= delay
        intervals = sweep.intervals(seconds - delay, scanning)
        intervals = {name: [(a + delay, b + delay) for a, b in spans] for name, spans in intervals.items()}
        flags = np.where(scanning, 0, IRREGULAR).astype(np.uint8)
        if ahead:
            intervals["elnod"] = runs(~scanning, seconds)
        turning = sweep.turning(seconds - delay) & scanning
        if self.flag_turnarounds:
            flags |= np.where(turning, TURNAROUND, 0).astype(np.uint8)
        centre = self._centre(data, row, transform, delay)
        samples = Samples(seconds, rate, boresight, flags, intervals)
        observation = observed(self.label, scene, len(data.observations), transform, centre, samples)
        self._check_motion(observation, track, place, moved)
        observation.tally.state(self.label, f"{observation.name}: row of the schedule", row.label)
        what = "samples in turnarounds" + (", flagged" if self.flag_turnarounds else ", used")
        observation.tally.count(self.label, what, int(turning.sum()), len(seconds))
        if ahead:
            observation.tally.count(self.label, "samples in elevation nods, flagged", ahead, len(seconds))
        return observation

    def _centre(self, data: Data, row: Row, transform: CelestialTransform, delay: float) -> tuple[float, float]:
        """ICRS (ra, dec) of the scene's target; of the middle of the scan where it has none, or one fixed on the ground."""
        target = data.scene.target
        if target is not None and target.frame != "horizontal":
            return target.icrs()
        middle = unit_vectors([-sum(row.azimuth) / 2], [row.elevation])
        ra, dec = angles(transform.icrs(middle, np.array([delay + row.duration / 2]))[0])
        return float(ra % (2 * math.pi)), float(dec)

    def _check_elevation(self, horizontal: Floats, telescope: Telescope, place: str) -> None:
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

    def _check_motion(self, observation: Observation, track: Track, place: str, moved: LargestMotion) -> None:
        """Compare the track with the telescope's limits."""
        length = observation.n_samples / observation.sample_rate
        coarse = min(observation.sample_rate, POINTS / length)

        def at(step: float) -> Floats:
            return track(np.arange(max(round(length / step), 1), dtype=np.float64) * step)

        found = motion(at(1 / coarse), coarse, moved.limits, at)
        over = excess(found, moved.limits)
        if over and self.check_limits == "error":
            cure = "lower speed or acceleration, or set check_limits: warn"
            raise PointingError(moved.too_fast(next(iter(over)), found), place=place, cure=cure)
        moved.add(observation.name, found)


def _turned(quaternions: Floats, angle: float) -> Floats:
    """Boresights (n, 4) with the focal plane turned about them."""
    if angle == 0:
        return quaternions
    about = np.array([[0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)]])
    return multiply(quaternions, about)
