"""Times of a NetCDF file as the CF conventions write them: numbers in a unit since a reference, or
days as dates.

The whole text must be understood: a clock, a time zone or a calendar that is passed over is another
time.
"""

from __future__ import annotations

import re
from datetime import date
from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.types import Floats

SECONDS = {
    **dict.fromkeys(("nanosecond", "nsec", "ns"), 1e-9),
    **dict.fromkeys(("microsecond", "microsec", "us"), 1e-6),
    **dict.fromkeys(("millisecond", "millisec", "msec", "ms"), 1e-3),
    **dict.fromkeys(("second", "sec", "s"), 1.0),
    **dict.fromkeys(("minute", "min"), 60.0),
    **dict.fromkeys(("hour", "hr", "h"), 3600.0),
    **dict.fromkeys(("day", "d"), 86400.0),
}
"""Units of time; also with an s behind. Months and years have no fixed length."""
CALENDARS = ("standard", "gregorian", "proleptic_gregorian")
"""Calendars in which a date is that of everyday life."""
RESOLVED = 60.0
"""s: where a number of this type cannot tell times apart that differ by this, the times have been
rounded.
"""
FARTHEST_ZONE = 14 * 60
"""min from UTC."""

_SINCE = re.compile(
    r"(?P<unit>[a-z]+)\s+since\s+"
    r"(?:(?P<year>\d{1,4})-(?P<month>\d{1,2})-(?P<day>\d{1,2})|(?P<packed>\d{8}))"
    r"(?:\s*t\s*(?=\d)|\s+(?=\d)|$|(?=\s*(?:z|utc|gmt|[-+])))"
    r"(?:(?P<hour>\d{1,2})(?::(?P<minute>\d{1,2})(?::(?P<second>\d{1,2}(?:\.\d*)?))?)?)?"
    r"\s*(?P<zone>z|utc|gmt|(?P<sign>[-+])(?P<zone_hour>\d{1,2})(?::?(?P<zone_minute>\d{2}))?)?"
)
_AS_DATE = re.compile(r"days? as %y%m%d(?:\.%f)?")
_EPOCH = date(1970, 1, 1).toordinal()


def posix_times(values: Any, units: str, calendar: str | None, name: str) -> Floats:
    """Seconds since 1970-01-01T00:00 UTC of the numbers ``values`` of a time axis called ``name``.

    Raises
    ------
    InputError
        A unit, a reference or a calendar that is not known, also in part; numbers that are rounded
        to more than a minute.
    """
    raw = np.asarray(values)
    text = " ".join(units.split()).lower()
    if (calendar or "standard").strip().lower() not in CALENDARS:
        raise InputError(
            f"its {name} counts in the calendar '{calendar}', not in that of everyday life",
            cure=(
                f"expected one of {', '.join(CALENDARS)}: this may be a model's output, not a"
                " reanalysis"
            ),
        )
    if _AS_DATE.fullmatch(text):
        return _of_dates(raw, units, name)
    match = _SINCE.fullmatch(text)
    unit = _seconds(match["unit"]) if match else None
    if match is None or unit is None:
        raise InputError(
            f"its {name} has the unit '{units}'",
            cure=(
                "expected nanoseconds to days since a date, with or without a clock and a time"
                " zone, e.g. hours since 2022-08-01 06:00:00 +00:00, or day as %Y%m%d"
            ),
        )
    _check_rounding(raw, unit, units, name)
    try:
        start = _reference(match, (calendar or "standard").strip().lower())
    except ValueError as error:
        raise InputError(
            f"its {name} has the unit '{units}': {error}", cure="mend the reference, a date of UTC"
        ) from None
    return np.asarray(start + raw.astype(np.float64) * unit, np.float64)


def duration(units: str, name: str) -> float:
    """Seconds per unit of a duration (a forecast's step). Raises `InputError` for what is no unit
    of time.
    """
    found = _seconds(units.strip().lower())
    if found is None:
        raise InputError(
            f"its {name} has the unit '{units}'", cure="expected a unit of time, e.g. hours"
        )
    return found


def _seconds(unit: str) -> float | None:
    return SECONDS.get(unit, SECONDS.get(unit.removesuffix("s")))


def _check_rounding(raw: Any, unit: float, units: str, name: str) -> None:
    finite = raw[np.isfinite(raw)]
    if (
        raw.dtype.kind == "f"
        and finite.size
        and float(np.spacing(np.abs(finite).max())) * unit > RESOLVED
    ):
        raise InputError(
            f"its {name}, '{units}', is in {raw.dtype}, which rounds these times by more than"
            f" {RESOLVED:g} s",
            cure="write the time axis in int32, int64 or float64",
        )


def _reference(match: re.Match[str], calendar: str) -> float:
    """The reference in s since 1970. Raises ValueError for what is no time."""
    if match["packed"]:
        year, month, day = (
            int(match["packed"][:4]),
            int(match["packed"][4:6]),
            int(match["packed"][6:]),
        )
    else:
        year, month, day = (int(match[part]) for part in ("year", "month", "day"))
    hour, minute, second = (
        int(match["hour"] or 0),
        int(match["minute"] or 0),
        float(match["second"] or 0),
    )
    zone = int(match["zone_hour"] or 0) * 60 + int(match["zone_minute"] or 0)
    if (
        hour > 24
        or minute > 59
        or second >= 61
        or int(match["zone_minute"] or 0) > 59
        or zone > FARTHEST_ZONE
    ):
        raise ValueError("no such clock or time zone")
    clock = hour * 3600 + minute * 60 + second - (-60 if match["sign"] == "-" else 60) * zone
    return (_ordinal(year, month, day, calendar) - _EPOCH) * 86400.0 + clock


def _ordinal(year: int, month: int, day: int, calendar: str) -> int:
    """Days of a date, as of `date.toordinal`. Before 15 October 1582 the standard calendar is the
    Julian one.
    """
    if year < 1:
        raise ValueError("the year is not between 1 and 9999")
    if calendar == "proleptic_gregorian" or (year, month, day) >= (1582, 10, 15):
        return date(year, month, day).toordinal()
    if (year, month, day) > (1582, 10, 4):
        raise ValueError("the standard calendar has no such date")
    leap = month == 2 and day == 29 and year % 4 == 0  # also where the Gregorian calendar has none
    date(4, month, day) if leap else date(1, month, day)  # raises ValueError for what is no date
    years, months = (year - 1, month + 12) if month < 3 else (year, month)
    return 365 * years + years // 4 + (153 * (months - 3) + 2) // 5 + day - 308


def _of_dates(raw: Any, units: str, name: str) -> Floats:
    """Read dates from numbers such as 20220801.25."""
    numbers = raw.astype(np.float64)
    if (
        raw.dtype.kind == "f"
        and numbers.size
        and float(np.spacing(np.abs(raw).max())) * 86400 > RESOLVED
    ):
        raise InputError(
            f"its {name}, '{units}', is in {raw.dtype}, which rounds these dates",
            cure="write the time axis in float64",
        )
    found = np.empty(numbers.shape)
    for k, number in np.ndenumerate(numbers):
        try:
            whole = int(number)
            day = date(whole // 10000, whole // 100 % 100, whole % 100).toordinal()
        except (ValueError, OverflowError):
            raise InputError(
                f"its {name} holds {number:.12g}, which is no date", cure=f"its unit is '{units}'"
            ) from None
        # A date of eight digits leaves 4e-9 of a day, 0.3 ms.
        found[k] = (day - _EPOCH) * 86400.0 + round((number - whole) * 86400.0, 2)
    return found
