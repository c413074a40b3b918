"""Pointing by an observing schedule."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from .limits import LargestMotion
from .observed import report
from .samples_per_beam import SamplesPerBeam
from .schedule_files import read_schedule
from .scheduled import ScheduleParameters, scan_of
from .sun_and_moon import distances

if TYPE_CHECKING:
    from zonda.core.data import Data

CHECKED = 1 << 14
"""Samples of all scans together that `zonda check` looks at."""

ANOTHER_DAY = 86400.0
"""s between the schedule and the scene's time from which a run warns: the weather is the scene's."""


class PointingSchedule(ScheduleParameters):
    """Constant-elevation scans of an observing schedule in TOAST's formats, one observation a row.

    Azimuth limits and `acceleration` are those of the mount, `speed` is on the sky (the mount turns 1 / cos(elevation) as fast):
    as in TOAST's `SimGround`. A scan begins at the lesser azimuth, towards larger ones, and has as many whole samples as fit.
    """

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})

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
        for row in rows:
            observation = scan_of(self, data, row, rate, moved)
            sampled.add(observation, self.sample_rate or scene.instrument.sample_rate)
            data.observations.append(observation)
        report(self.label, data.observations[before:], moved, sampled)
