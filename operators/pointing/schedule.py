"""Pointing by an observing schedule."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from zonda.core.errors import PointingError
from zonda.core.numerics.sphere import separation

from .limits import LargestMotion
from .observed import report
from .samples_per_beam import SamplesPerBeam
from .schedule_files import Row, SchedulesSite, read_schedule
from .scheduled import ScheduleParameters
from .sun_and_moon import distances

if TYPE_CHECKING:
    from zonda.core.data import Data

EARTH, NEAR, FAR = 6.371e6, 5e3, 1e5
"""m: the Earth's radius; how far from the scene a schedule's site is another one, and how far its
azimuths make no sense.
"""

CHECKED = 1 << 14
"""Samples of all scans together that `zonda check` looks at."""

ANOTHER_DAY = 86400.0
"""s between the schedule and the scene's time from which a run warns: the weather is the scene's.
"""


MOST_LOOKED_AT = 64
"""Rows of a schedule that `zonda check` looks at."""


def _some(rows: Sequence[Row]) -> list[Row]:
    """Rows evenly over a schedule, with the lowest and the highest (where the mount turns fastest),
    the widest and the narrowest throw, and the longest and the shortest scan: a limit of the
    telescope that any row exceeds, one of these does."""
    if len(rows) <= MOST_LOOKED_AT:
        return list(rows)
    found = {round(k) for k in np.linspace(0, len(rows) - 1, MOST_LOOKED_AT - 6)}
    for values in (
        [row.elevation for row in rows],
        [row.azimuth[1] - row.azimuth[0] for row in rows],
        [row.duration for row in rows],
    ):
        found |= {int(np.argmin(values)), int(np.argmax(values))}
    return [rows[k] for k in sorted(found)]


class PointingSchedule(ScheduleParameters):
    """Constant-elevation scans of an observing schedule in TOAST's formats, one observation a row.

    Azimuth limits and `acceleration` are those of the mount, `speed` is on the sky (the mount turns
    1 / cos(elevation) as fast): as in TOAST's `SimGround`, whose turnarounds, flags and intervals
    are the default. A scan begins at the lesser azimuth, towards larger ones, and has as many whole
    samples as fit. Its name ends with the patch, scan and subscan of the row. A schedule that
    states its site is compared with the scene's: 5 km apart are a warning, 100 km an error.
    """

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})

    def observe(self, data: Data) -> None:
        """Append an observation for each row."""
        self._observe(data, self.sample_rate or data.scene.instrument.sample_rate)

    def check(self, data: Data) -> list[str]:
        """Number of scans, their places and speeds, and distances from Sun and Moon."""
        first, rate = len(data.observations), self.sample_rate or data.scene.instrument.sample_rate
        rows, _ = read_schedule(self.schedule, self.nod.duration)
        looked = _some(rows)
        self._observe(data, min(rate, CHECKED / sum(row.duration for row in looked)), looked)
        made = data.observations[first:]
        for observation in made:
            observation.seen_of = max(round(observation.duration * rate), 1), rate
        elevations = np.degrees([(o.elevation.min(), o.elevation.max()) for o in made])
        end = max(row.start.shifted(row.duration) for row in rows)
        total = sum(row.duration for row in rows) / 3600
        part = "" if len(looked) == len(rows) else f" ({len(looked)} of them looked at)"
        lines = [
            f"{len(rows)} scan{'s' if len(rows) > 1 else ''} from {rows[0].start} to {end},"
            f" {total:.3g} h in all{part}"
        ]
        lines.append(f"elevation: {elevations.min():.2f} to {elevations.max():.2f} deg")
        lines += distances(made)
        topics = LargestMotion.TOPICS + SamplesPerBeam.TOPICS
        return lines + [
            f"{what}: {text}" for _, what, text in made[0].tally if what.startswith(topics)
        ]

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

    def _observe(self, data: Data, rate: float, some: Sequence[Row] = ()) -> None:
        """Append the scans of all rows, or of ``some``, sampled at ``rate`` [Hz]."""
        scene, before = data.scene, len(data.observations)
        rows, site = read_schedule(self.schedule, self.nod.duration)
        rows = list(some) or rows
        self._compare_sites(data, site)
        if abs(scene.time.seconds_since(rows[0].start)) > ANOTHER_DAY:
            text = (
                f"the schedule begins {rows[0].start}, the weather is that of {scene.time}: set the"
                " scene's time"
            )
            warnings.warn(f"{self.label}: {text}", stacklevel=3)
        moved, sampled = LargestMotion(scene.instrument.telescope), SamplesPerBeam()
        for row in rows:
            observation = self._observation(data, row, rate, moved)
            sampled.add(observation, self.sample_rate or scene.instrument.sample_rate)
            data.observations.append(observation)
        report(self.label, data.observations[before:], moved, sampled)
