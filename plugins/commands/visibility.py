"""When targets, the Sun, the Moon and planets are above an elevation at a site
(`core.numerics.bodies`): the night hour by hour and the year by month, as text and plain values.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.numerics.bodies import Track, tracks
from zonda.core.tables import aligned
from zonda.core.types import Floats
from zonda.operators.atmosphere.weather import climatology
from zonda.operators.atmosphere.weather.bands import BandAtmosphere
from zonda.operators.atmosphere.weather.climatology import MONTHS
from zonda.operators.atmosphere.weather.profiles import PWV_MAX
from zonda.operators.atmosphere.weather.radiative_transfer import ELEVATION_MIN

if TYPE_CHECKING:
    from zonda.core.configuration.target import Target
    from zonda.core.instrument import Band
    from zonda.core.site import Site


QUANTILES = (0.25, 0.5, 0.75)
PWV_HEAD = ["PWV 25 % [mm]", "50 %", "75 %"]
"""Columns of the quantiles of the PWV."""
CELL = 3
"""Hours (UTC) between those at which the PWV is looked up."""


@dataclass(frozen=True)
class Seen:
    """A target from a site: what was asked for, and the night.

    Attributes
    ----------
    name
        The target, as the user wrote it.
    when
        The time that was asked for.
    bands
        By the name of their instrument.
    """

    name: str
    site: Site
    when: Instant
    night: Night
    bands: dict[str, Band]

    @property
    def known(self) -> bool:
        """True if the site has a climatology."""
        return self.site.climatology is not None

    @property
    def night_name(self) -> str:
        """The dates of the night, UTC."""
        return f"{_iso(self.night.times[0])[:10]} to {_iso(self.night.times[-1])[:10]}"

    @cached_property
    def pwv_by_month(self) -> Floats:
        """(12, 24, 3) quantiles of the PWV [m] at each hour (UTC) on the 15th of each month."""
        from scipy.interpolate import make_interp_spline

        year = self.when.datetime.year
        hours = range(0, 24, CELL)
        dates = [f"{year:04d}-{month:02d}-15T" for month in range(1, 13)]
        found = np.array(
            [[pwv_at(self.site, Instant.parse(f"{d}{h:02d}:00Z")) for h in hours] for d in dates]
        )
        # periodic and smooth: two harmonics of the day
        closed = np.concatenate([found, found[:, :1]], axis=1)
        return make_interp_spline([*hours, 24], closed, k=1, axis=1)(np.arange(24))

    def pwv_of_month(self, number: int, month: Month) -> Floats | None:
        """(3,) quantiles of the PWV [m] in the hours in which the target is up at night; None where
        it never is up.
        """
        if not self.known or not month.by_hour.any():
            return None
        return np.average(self.pwv_by_month[number], axis=0, weights=month.by_hour)

    @cached_property
    def _atmospheres(self) -> dict[str, BandAtmosphere]:
        middle = _instant(self.night.times[len(self.night.times) // 2])
        profile = climatology.profile(self.site, middle)
        return {name: BandAtmosphere(band, profile, PWV_MAX) for name, band in self.bands.items()}

    @cached_property
    def hours(self) -> list[dict[str, Any]]:
        """The night's full hours (UTC) in which the target is above the limit; every ten minutes
        where that is short.
        """
        night = self.night
        first = night.times[0]
        every = HOUR if night.hours[0] >= 2 else HOUR / 6
        at = np.arange(math.ceil(first / every) * every, night.times[-1] + 1, every)
        index = np.rint((at - first) / 60).astype(int)
        elevation = night.target.elevation
        return [
            self._hour(float(t), k)
            for t, k in zip(at, index, strict=True)
            if elevation[k] >= night.above
        ]

    def _hour(self, posix: float, k: int) -> dict[str, Any]:
        night = self.night
        degrees = {
            "elevation": night.target.elevation,
            "azimuth": night.target.azimuth,
            "sun elevation": night.sun.elevation,
            "sun distance": night.target.distance(night.sun),
            "moon elevation": night.moon.elevation,
            "moon distance": night.target.distance(night.moon),
        }
        row: dict[str, Any] = {"time": _iso(posix), "solar": clock(posix + solar_offset(self.site))}
        row |= {what: round(math.degrees(values[k]), 2) for what, values in degrees.items()}
        if self.known:
            pwv = pwv_at(self.site, _instant(posix))
            row["pwv_mm"] = [round(1e3 * value, 4) for value in pwv]
            slant = max(float(night.target.elevation[k]), ELEVATION_MIN)
            row |= {
                f"transmission {name}": round(float(seen.transmission(float(pwv[1]), slant)), 4)
                for name, seen in self._atmospheres.items()
            }
        return row


def pwv_at(site: Site, when: Instant) -> Floats:
    """(3,) quantiles of the climatology's PWV, m. Raises `InputError` for a year that it does not
    stand for.
    """
    law = climatology.profile(site, when).distribution
    assert law is not None  # the climatology has spreads
    return np.array([law.at(q) for q in QUANTILES])


def lines(seen: Seen, year: Sequence[Month]) -> list[str]:
    """Lines of the text."""
    return [*_head(seen), "", *_table(seen), "", *_year(seen, year)]


def _head(seen: Seen) -> list[str]:
    site = seen.site
    night = seen.night
    where = (
        f"{math.degrees(site.latitude):.4f} deg, {math.degrees(site.longitude):.4f} deg,"
        f" {site.altitude:g} m"
    )
    begin = night.times[0]
    end = night.times[-1]
    offset = solar_offset(site)
    found = [
        f"{seen.name} from {site.name} ({where})",
        (
            f"night of {_iso(begin)} to {_iso(end)} (local noon to noon); local mean solar time is"
            f" UTC {_shift(offset)}"
        ),
        f"above {_deg(night.above)}: {_when_up(seen)}",
        f"night (Sun below the horizon): {_spans(night.dark, offset)}",
    ]
    moon = np.degrees(night.target.distance(night.moon))
    sun = np.degrees(night.target.distance(night.sun))
    if seen.name.lower() != "sun":
        found.append(f"Sun: {sun.min():.0f} to {sun.max():.0f} deg away")
    if seen.name.lower() != "moon":
        found.append(
            f"Moon: {100 * night.moon_lit:.0f} % lit, {moon.min():.0f} to {moon.max():.0f} deg away"
        )
    return found


def _when_up(seen: Seen) -> str:
    night = seen.night
    offset = solar_offset(seen.site)
    time, elevation = night.highest
    moves = math.degrees(np.ptp(night.target.elevation)) > 0.1
    at = f" at {clock(time)} UTC ({clock(time + offset)} solar)" if moves else ""
    top = f"highest {math.degrees(elevation):.1f} deg{at}"
    if not night.spans:
        return f"never; {top}"
    total, dark = night.hours
    spans = _spans(night.spans, offset)
    return f"{spans}; {top}; {total:.1f} h, of which {dark:.1f} h at night"


def _spans(spans: Sequence[tuple[float | None, float | None]], offset: float) -> str:
    """Spans with their clock times in UTC and solar time."""

    def text(time: float) -> str:
        return f"{clock(time)} UTC ({clock(time + offset)} solar)"

    if not spans:
        return "never"
    if spans == [(None, None)]:
        return "the whole day"
    return ", ".join(
        f"until {text(end)}"
        if begin is None and end is not None
        else f"from {text(begin or 0.0)} {'on' if end is None else f'to {text(end)}'}"
        for begin, end in spans
    )


def _table(seen: Seen) -> list[str]:
    rows = seen.hours
    if not rows:
        return ["it is never above the limit in this night"]
    bands = list(seen.bands) if seen.known else []
    head = ["UTC", "solar", "elevation", "azimuth", "Sun el.", "Sun dist.", "Moon dist."]
    head += PWV_HEAD if seen.known else []
    before = len(aligned([], head)[0])
    degrees = ("elevation", "azimuth", "sun elevation", "sun distance", "moon distance")
    cells = [
        (
            row["time"][11:16],
            row["solar"],
            *(f"{row[name]:.1f}" for name in degrees),
            *(f"{value:.2f}" for value in row.get("pwv_mm", ())),
            *(f"{row[f'transmission {name}']:.3f}" for name in bands),
        )
        for row in rows
    ]
    found = [" " * before + "  transmission of the band"] if bands else []
    found += aligned(cells, [*head, *bands], ">")
    if not seen.known:
        found.append(f"{seen.site.name} has no climatology: no PWV, no transmission")
    return found


def _year(seen: Seen, year: Sequence[Month]) -> list[str]:
    above = _deg(seen.night.above)
    head = [f"{seen.when.datetime.year:04d}", "highest", f"h above {above}", "of them at night"]
    head += ["Sun dist.", *(PWV_HEAD if seen.known else [])]
    rows = []
    for number, (name, month) in enumerate(zip(MONTHS, year, strict=True)):
        quantiles = seen.pwv_of_month(number, month)
        mm = ["-"] * 3 if quantiles is None else [f"{1e3 * q:.2f}" for q in quantiles]
        rows.append(
            (
                name,
                f"{math.degrees(month.highest):.1f}",
                f"{month.hours:.0f}",
                f"{month.hours_at_night:.0f}",
                f"{math.degrees(month.sun[0]):.0f} to {math.degrees(month.sun[1]):.0f}",
                *(mm if seen.known else []),
            )
        )
    note = (
        "hours in the month; PWV in the hours in which it is above the limit at night, or by day"
        " where it never is at night"
    )
    return [*aligned(rows, head, "<>"), note if seen.known else "hours in the month"]


def as_dict(seen: Seen, year: Sequence[Month]) -> dict[str, Any]:
    """Everything as plain values: times are ISO 8601 UTC, angles degrees, the PWV millimetres."""
    night = seen.night
    site = seen.site
    time, elevation = night.highest
    table = []
    for number, (name, month) in enumerate(zip(MONTHS, year, strict=True)):
        quantiles = seen.pwv_of_month(number, month)
        table.append(
            {
                "month": name,
                "hours": round(month.hours, 2),
                "hours at night": round(month.hours_at_night, 2),
                "highest": round(math.degrees(month.highest), 2),
                "sun distance": [round(math.degrees(d), 1) for d in month.sun],
                "pwv_mm": (
                    None if quantiles is None else [round(1e3 * float(q), 4) for q in quantiles]
                ),
            }
        )
    return {
        "target": seen.name,
        "site": {
            "name": site.name,
            "latitude": math.degrees(site.latitude),
            "longitude": math.degrees(site.longitude),
        },
        "above": round(math.degrees(night.above), 6),
        "quantiles": list(QUANTILES),
        "solar minus utc": round(solar_offset(site), 1),
        "night": {
            "begin": _iso(night.times[0]),
            "end": _iso(night.times[-1]),
            "up": [[None if t is None else _iso(t) for t in span] for span in night.spans],
            "dark": [[None if t is None else _iso(t) for t in span] for span in night.dark],
            "highest": {"time": _iso(time), "elevation": round(math.degrees(elevation), 3)},
            "hours": round(night.hours[0], 3),
            "hours at night": round(night.hours[1], 3),
            "moon lit": round(night.moon_lit, 3),
            "table": seen.hours,
        },
        "year": {"year": seen.when.datetime.year, "months": table},
    }


def clock(posix: float) -> str:
    """hh:mm of an instant, to the nearest minute."""
    minutes = math.floor(posix / 60 + 0.5) % 1440
    return f"{minutes // 60:02d}:{minutes % 60:02d}"


def _instant(posix: float) -> Instant:
    return Instant(round(posix) * 1_000_000_000)


def _iso(posix: float) -> str:
    return _instant(posix).isoformat()


def _deg(angle: float) -> str:
    return f"{math.degrees(angle):.6g} deg"


def _shift(seconds: float) -> str:
    minutes = round(abs(seconds) / 60)
    return f"{'-' if seconds < 0 else '+'} {minutes // 60} h {minutes % 60} min"


HORIZON = math.radians(-50 / 60)
"""Elevation of the Sun's centre below which it is night: its radius, and the refraction that is
usual at the horizon.
"""
MINUTE = 60.0
HOUR = 3600.0
DAY = 86400.0


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
    low = np.zeros_like(values[0][..., 1:])
    high = np.ones_like(values[0][..., 1:])
    for value in values:
        a = value[..., :-1]
        b = value[..., 1:]
        with np.errstate(divide="ignore", invalid="ignore"):
            cross = np.where(a == b, 0.0, a / (a - b))
        low = np.maximum(low, np.where(a > 0, 0.0, np.where(b > 0, cross, 1.0)))
        high = np.minimum(high, np.where(b > 0, 1.0, np.where(a > 0, cross, 0.0)))
    return np.clip(high - low, 0.0, None)


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
        off = bend = 0.0
        if 0 < k < len(elevation) - 1:
            before, here, after = elevation[k - 1 : k + 2].tolist()
            bend = max(2 * here - before - after, 1e-12)
            off = (after - before) / (2 * bend)
        return float(self.times[k]) + off * MINUTE, float(elevation[k]) + bend * off * off / 2

    @property
    def hours(self) -> tuple[float, float]:
        """Hours above the limit: in all, and at night."""
        high = self.target.elevation - self.above
        dark = HORIZON - self.sun.elevation
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
        elevation = at.elevation.reshape(times.shape)
        depth = HORIZON - sun.elevation.reshape(times.shape)
        everything = share_above(elevation - above)
        night = share_above(elevation - above, depth)
        taken = (night if night.any() else everything).mean(axis=0).reshape(24, -1).mean(axis=1)
        distance = at.distance(sun)
        yield Month(
            hours=float(everything.mean()) * 24 * days,
            hours_at_night=float(night.mean()) * 24 * days,
            by_hour=taken,
            highest=float(elevation.max()),
            sun=(float(distance.min()), float(distance.max())),
            place=(dates - 0.5) / days,
            elevation=elevation,
            depth=depth,
        )
