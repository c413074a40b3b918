"""Text of ``zonda when``: the night hour by hour, the year by month, and both as plain values."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.tables import aligned
from zonda.core.types import Floats
from zonda.operators.atmosphere.weather import climatology
from zonda.operators.atmosphere.weather.bands import BandAtmosphere
from zonda.operators.atmosphere.weather.profiles import PWV_MAX
from zonda.operators.atmosphere.weather.radiative_transfer import ELEVATION_MIN
from zonda.operators.atmosphere.weather.summary import MONTHS

from .visibility import HOUR, Month, Night, solar_offset

if TYPE_CHECKING:
    from zonda.core.instrument import Band
    from zonda.core.site import Site
    from zonda.operators.atmosphere.weather.profiles import Profile

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
        year = self.when.datetime.year
        found = np.empty((12, 24 // CELL, 3))
        for month in range(12):
            for k in range(24 // CELL):
                found[month, k] = pwv_at(
                    self.site, Instant.parse(f"{year:04d}-{month + 1:02d}-15T{CELL * k:02d}:00Z")
                )
        closed = np.concatenate(
            [found, found[:, :1]], axis=1
        )  # periodic and smooth: two harmonics of the day
        cell, rest = np.divmod(np.arange(24), CELL)
        weight = (rest / CELL)[None, :, None]
        return np.asarray(closed[:, cell] * (1 - weight) + closed[:, cell + 1] * weight)

    def pwv_of_month(self, number: int, month: Month) -> Floats | None:
        """(3,) quantiles of the PWV [m] in the hours in which the target is up at night; None where
        it never is up.
        """
        if not self.known or not month.by_hour.any():
            return None
        return np.asarray(np.average(self.pwv_by_month[number], axis=0, weights=month.by_hour))

    @cached_property
    def _atmospheres(self) -> dict[str, BandAtmosphere]:
        profile = self._middle
        return {name: BandAtmosphere(band, profile, PWV_MAX) for name, band in self.bands.items()}

    @cached_property
    def _middle(self) -> Profile:
        return climatology.profile(
            self.site, _instant(self.night.times[len(self.night.times) // 2])
        )

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
    site, night = seen.site, seen.night
    where = (
        f"{math.degrees(site.latitude):.4f} deg, {math.degrees(site.longitude):.4f} deg,"
        f" {site.altitude:g} m"
    )
    begin, end = night.times[0], night.times[-1]
    offset = solar_offset(site)
    found = [
        f"{seen.name} from {site.name} ({where})",
        (
            f"night of {_iso(begin)} to {_iso(end)} (local noon to noon); local mean solar time is"
            f" UTC {_shift(offset)}"
        ),
        f"above {_deg(night.above)}: {_when_up(seen)}",
        f"night (Sun below the horizon): {_spans(night.dark, offset, 'the whole day', 'never')}",
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
    night, offset = seen.night, solar_offset(seen.site)
    time, elevation = night.highest
    moves = math.degrees(np.ptp(night.target.elevation)) > 0.1
    at = f" at {clock(time)} UTC ({clock(time + offset)} solar)" if moves else ""
    top = f"highest {math.degrees(elevation):.1f} deg{at}"
    if not night.spans:
        return f"never; {top}"
    total, dark = night.hours
    spans = _spans(night.spans, offset, "the whole day", "never")
    return f"{spans}; {top}; {total:.1f} h, of which {dark:.1f} h at night"


def _spans(
    spans: Sequence[tuple[float | None, float | None]], offset: float, always: str, never: str
) -> str:
    """Spans with their clock times in UTC and solar time."""

    def text(time: float) -> str:
        return f"{clock(time)} UTC ({clock(time + offset)} solar)"

    if not spans:
        return never
    found = []
    for begin, end in spans:
        if begin is None and end is None:
            return always
        found.append(f"until {text(end)}" if begin is None and end is not None else "")
        if begin is not None:
            found[-1] = f"from {text(begin)}" + (f" to {text(end)}" if end is not None else " on")
    return ", ".join(found)


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
    night, site = seen.night, seen.site
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
