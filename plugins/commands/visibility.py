"""Where targets, the Sun, the Moon and planets stand above the horizon of a site; when they are above an elevation.

Directions are ERFA's, without refraction: aberration, precession-nutation (IAU 2006/2000A), Earth rotation, polar motion. Planets
are those of Simon et al. 1994 (plan94), the Moon that of Meeus 1998 (moon98), as in astropy's built-in ephemeris: nothing is
downloaded. Topocentric: the Moon's parallax is in. Light is not bent by the Sun (below 2 arcsec).
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.numerics.earth_orientation import orientation
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.types import Floats

if TYPE_CHECKING:
    from zonda.core.configuration.target import Target
    from zonda.core.site import Site

PLANETS = {"mercury": 1, "venus": 2, "mars": 4, "jupiter": 5, "saturn": 6, "uranus": 7, "neptune": 8}
"""Planets, with their numbers in ERFA's plan94."""
BODIES = ("sun", "moon", *PLANETS)
LIGHT = 173.14463267424
"""Speed of light, au/day (IAU 2012)."""
HORIZON = math.radians(-50 / 60)
"""Elevation of the Sun's centre below which it is night: its radius, and the refraction that is usual at the horizon."""
MINUTE, HOUR, DAY = 60.0, 3600.0, 86400.0


@dataclass(frozen=True)
class Track:
    """Where something stands at n instants.

    Attributes
    ----------
    direction
        (n, 3) unit vectors north, east, up.
    azimuth, elevation
        (n,) rad, north through east.
    """

    direction: Floats

    @property
    def azimuth(self) -> Floats:
        return np.asarray(np.arctan2(self.direction[:, 1], self.direction[:, 0]) % (2 * np.pi))

    @property
    def elevation(self) -> Floats:
        return np.asarray(np.arctan2(self.direction[:, 2], np.hypot(self.direction[:, 0], self.direction[:, 1])))

    def distance(self, other: Track) -> Floats:
        """(n,) angle to another track, rad."""
        apart = np.linalg.norm(np.cross(self.direction, other.direction), axis=1)
        return np.asarray(np.arctan2(apart, (self.direction * other.direction).sum(axis=1)))


def tracks(site: Site, times: Floats, *what: Target | str) -> list[Track]:
    """Tracks of targets and bodies (`BODIES`) at ``times`` (n,), POSIX seconds, from a site."""
    import erfa

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", erfa.ErfaWarning)  # "dubious year": leap seconds to come are unknown
        jd, days = np.full(len(times), 2440587.5), times / DAY
        earth = orientation(jd - 2400000.5 + days)
        place = (site.longitude, site.latitude, site.altitude, earth.x, earth.y)
        star, _ = erfa.apco13(jd, days, earth.ut1_utc, *place, 0.0, 0.0, 0.0, 1.0)
        when = erfa.taitt(*erfa.utctai(jd, days))
        return [_track(one, star, when, len(times)) for one in what]


def _track(one: Target | str, star: Any, when: Any, n: int) -> Track:
    import erfa

    if not isinstance(one, str) and one.frame == "horizontal":
        c = math.cos(one.latitude)
        fixed = [c * math.cos(one.longitude), c * math.sin(one.longitude), math.sin(one.latitude)]
        return Track(np.tile(fixed, (n, 1)))
    natural = _of_body(one, star, when) if isinstance(one, str) else np.tile(unit_vectors(*one.icrs()), (n, 1))
    distance = np.ascontiguousarray(star["em"])
    seen = erfa.ab(natural, np.ascontiguousarray(star["v"]), distance, np.ascontiguousarray(star["bm1"]))
    azimuth, zenith, *_ = erfa.atioq(*erfa.c2s(erfa.rxp(np.ascontiguousarray(star["bpn"]), seen)), star)
    sine = np.sin(zenith)
    return Track(np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=1))


def _of_body(name: str, star: Any, when: Any) -> Floats:
    """(n, 3) unit vectors from the observer to a body, BCRS axes."""
    import erfa

    from_sun = star["eh"] * star["em"][:, None]  # of the observer, au
    if name == "moon":
        _, earth = erfa.epv00(*when)
        vector = erfa.moon98(*when)["p"] - (star["eb"] - earth["p"])
        vector -= np.linalg.norm(vector, axis=1)[:, None] * star["v"]  # it moves with the Earth while its light is on the way
    elif name == "sun":
        vector = -from_sun
    else:
        late = np.zeros(len(from_sun))
        for _ in range(2):  # the light's way
            vector = erfa.plan94(when[0], when[1] - late, PLANETS[name])["p"] - from_sun
            late = np.linalg.norm(vector, axis=1) / LIGHT
    return np.ascontiguousarray(vector / np.linalg.norm(vector, axis=1)[:, None])


def spans_above(times: Floats, values: Floats) -> list[tuple[float | None, float | None]]:
    """Where ``values`` (n,) at ``times`` (n,) are above 0, linear in between: (begin, end), None where it goes on beyond."""
    up = values > 0
    edges = np.flatnonzero(up[1:] != up[:-1])
    cross: list[float | None] = [
        float(times[k] + (times[k + 1] - times[k]) * values[k] / (values[k] - values[k + 1])) for k in edges
    ]
    ends = ([None] if up[0] else []) + cross + ([None] if up[-1] else [])
    return list(zip(ends[::2], ends[1::2], strict=True))


def share_above(*values: Floats) -> Floats:
    """(..., n - 1) share of each step over which all of ``values`` (..., n) are above 0, linear within it."""
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
        if 0 < k < len(elevation) - 1 and (bend := 2 * elevation[k] - elevation[k - 1] - elevation[k + 1]) > 1e-12:
            off = float(elevation[k + 1] - elevation[k - 1]) / (2 * float(bend))
            return float(self.times[k]) + off * MINUTE, float(elevation[k]) + float(bend) * off * off / 2
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
    """The night that ``when`` lies in, or the next one where it is a morning: from local mean solar noon to noon."""
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
        (24,) share of each hour of the day (UTC) above the limit at night; by day where it never is at night.
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
"""Of a month every third day is looked at, every half hour; elevations are linear in between (within 0.12 deg)."""


def months(site: Site, year: int, target: Target | str, above: float) -> Iterator[Month]:
    """The target in the twelve months of a year."""
    from calendar import monthrange

    for month in range(1, 13):
        days = monthrange(year, month)[1]
        dates = np.arange(2, days + 1, EVERY)
        starts = np.array([Instant.parse(f"{year:04d}-{month:02d}-{day:02d}").posix for day in dates])
        times = starts[:, None] + STEP * np.arange(round(DAY / STEP) + 1)
        at, sun = tracks(site, times.ravel(), target, "sun")
        elevation, depth = at.elevation.reshape(times.shape), HORIZON - sun.elevation.reshape(times.shape)
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
