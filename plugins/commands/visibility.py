"""When targets, the Sun, the Moon and planets are above an elevation at a site
(`core.numerics.bodies`).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.numerics.bodies import BODIES as BODIES
from zonda.core.numerics.bodies import LIGHT as LIGHT
from zonda.core.numerics.bodies import Track, tracks
from zonda.core.types import Floats

if TYPE_CHECKING:
    from zonda.core.configuration.target import Target
    from zonda.core.site import Site

HORIZON = math.radians(-50 / 60)
"""Elevation of the Sun's centre below which it is night: its radius, and the refraction that is
usual at the horizon.
"""
MINUTE, HOUR, DAY = 60.0, 3600.0, 86400.0


def spans_above(times: Floats, values: Floats) -> list[tuple[float | None, float | None]]:
    """Intervals (begin, end) in which ``values`` (n,) at ``times`` (n,) are above 0, linear in
    between; None for an end beyond the first or last time.
    """
    up = values > 0
    edges = np.flatnonzero(up[1:] != up[:-1])
    cross: list[float | None] = [
        float(times[k] + (times[k + 1] - times[k]) * values[k] / (values[k] - values[k + 1]))
        for k in edges
    ]
    ends = ([None] if up[0] else []) + cross + ([None] if up[-1] else [])
    return list(zip(ends[::2], ends[1::2], strict=True))


def share_above(*values: Floats) -> Floats:
    """(..., n - 1) share of each step over which all of ``values`` (..., n) are above 0, linear
    within it.
    """
    low, high = np.zeros_like(values[0][..., 1:]), np.ones_like(values[0][..., 1:])
    for value in values:
        a, b = value[..., :-1], value[..., 1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = np.where(a == b, 0.0, a / (a - b))
        low = np.maximum(low, np.where(a > 0, 0.0, np.where(b > 0, cross, 1.0)))
        high = np.minimum(high, np.where(b > 0, 1.0, np.where(a > 0, cross, 0.0)))
    return np.asarray(np.clip(high - low, 0.0, None))


@dataclass(frozen=True)
class Night:
    """A day from local noon to noon, in minutes.

    Attributes
    ----------
    times
        (1441,) POSIX seconds.
    target, sun, moon
        Tracks at these.
    above
        Elevation limit, rad.
    """

    times: Floats
    target: Track
    sun: Track
    moon: Track
    above: float

    @property
    def spans(self) -> list[tuple[float | None, float | None]]:
        """(rise, set) above the limit, POSIX seconds; None where it is up already, or still."""
        return spans_above(self.times, self.target.elevation - self.above)

    @property
    def dark(self) -> list[tuple[float | None, float | None]]:
        """(sunset, sunrise), POSIX seconds."""
        return spans_above(self.times, HORIZON - self.sun.elevation)

    @property
    def highest(self) -> tuple[float, float]:
        """When the target is highest and its elevation: the parabola through three minutes."""
        elevation = self.target.elevation
        k = int(elevation.argmax())
        if (
            0 < k < len(elevation) - 1
            and (bend := 2 * elevation[k] - elevation[k - 1] - elevation[k + 1]) > 1e-12
        ):
            off = float(elevation[k + 1] - elevation[k - 1]) / (2 * float(bend))
            return float(self.times[k]) + off * MINUTE, float(elevation[k]) + float(
                bend
            ) * off * off / 2
        return float(self.times[k]), float(elevation[k])

    @property
    def hours(self) -> tuple[float, float]:
        """Hours above the limit: in all, and at night."""
        high, dark = self.target.elevation - self.above, HORIZON - self.sun.elevation
        return float(share_above(high).sum()) / 60, float(share_above(high, dark).sum()) / 60

    @property
    def moon_lit(self) -> float:
        """Share of the Moon's disc that is lit, at midnight."""
        return float((1 - np.cos(self.moon.distance(self.sun)[len(self.times) // 2])) / 2)


def solar_offset(site: Site) -> float:
    """Local mean solar time minus UTC, s."""
    return math.remainder(site.longitude, 2 * math.pi) / (2 * math.pi) * DAY


def night_of(site: Site, when: Instant, target: Target | str, above: float) -> Night:
    """The night that ``when`` lies in, or the next one where it is a morning: from local mean solar
    noon to noon.
    """
    since_noon = (when.posix + solar_offset(site) - DAY / 2) % DAY
    begin = when.posix - since_noon
    (now,) = tracks(site, np.array([when.posix]), "sun")
    if since_noon >= DAY / 2 and now.elevation[0] > HORIZON:
        begin += DAY
    times = np.asarray(begin + MINUTE * np.arange(1441), np.float64)
    at, sun, moon = tracks(site, times, target, "sun", "moon")
    return Night(times, at, sun, moon, above)


@dataclass(frozen=True)
class Month:
    """A target in one month.

    Attributes
    ----------
    days
        Of the month.
    hours, hours_at_night
        Above the limit in the whole month; and while it is night.
    by_hour
        (24,) share of each hour of the day (UTC) above the limit at night; by day where it never is
        at night.
    highest
        Elevation, rad.
    sun
        Least and largest distance of the Sun, rad.
    place
        (n,) the days that were looked at, as shares of the month.
    elevation
        (n, 49) elevation on these days every half hour from 0 h UTC on, rad.
    depth
        (n, 49) how far the Sun is below the horizon then, rad.
    """

    days: int
    hours: float
    hours_at_night: float
    by_hour: Floats
    highest: float
    sun: tuple[float, float]
    place: Floats
    elevation: Floats
    depth: Floats


EVERY, STEP = 3, 1800.0
"""Of a month every third day is looked at, every half hour; elevations are linear in between
(within 0.12 deg).
"""


def months(site: Site, year: int, target: Target | str, above: float) -> Iterator[Month]:
    """The target in the twelve months of a year."""
    from calendar import monthrange

    for month in range(1, 13):
        days = monthrange(year, month)[1]
        dates = np.arange(2, days + 1, EVERY)
        starts = np.array(
            [Instant.parse(f"{year:04d}-{month:02d}-{day:02d}").posix for day in dates]
        )
        times = starts[:, None] + STEP * np.arange(round(DAY / STEP) + 1)
        at, sun = tracks(site, times.ravel(), target, "sun")
        elevation, depth = (
            at.elevation.reshape(times.shape),
            HORIZON - sun.elevation.reshape(times.shape),
        )
        everything, night = share_above(elevation - above), share_above(elevation - above, depth)
        taken = (night if night.any() else everything).mean(axis=0).reshape(24, -1).mean(axis=1)
        distance = at.distance(sun)
        yield Month(
            days=days,
            hours=float(everything.mean()) * 24 * days,
            hours_at_night=float(night.mean()) * 24 * days,
            by_hour=taken,
            highest=float(elevation.max()),
            sun=(float(distance.min()), float(distance.max())),
            place=(dates - 0.5) / days,
            elevation=elevation,
            depth=depth,
        )
