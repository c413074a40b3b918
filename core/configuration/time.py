"""Exact instants: integer nanoseconds since 1970-01-01T00:00 UTC, written and read as ISO 8601
text.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta, timezone
from typing import Any, ClassVar

from .diagnostics import TextValue, mistake

SECOND = 1_000_000_000
"""Nanoseconds in a second."""

_EXAMPLES = ["2024-11-25T07:00:00Z", "2024-11-25T02:00-05:00", "2024-11-25 07:00:00.5"]
_FARTHEST_ZONE = 14 * 60
"""min."""
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)
_ISO = re.compile(
    r"(?P<date>\d{4}-\d{2}-\d{2})"
    r"(?:[Tt"
    r" ]\s*(?P<hour>\d{2}):(?P<minute>\d{2})(?::(?P<second>\d{2})(?:[.,](?P<fraction>\d+))?)?)?"
    r"\s*(?P<zone>[Zz]|UTC|(?P<sign>[-+])(?P<zone_hour>\d{2}):?(?P<zone_minute>\d{2})?)?"
)


@dataclass(frozen=True, order=True, repr=False)
class Instant(TextValue):
    """An instant of UTC, exact to the nanosecond. Ordered and hashable.

    POSIX time: every day has 86400 seconds, so differences across a leap second (the last one ended
    2016) are one second short, and the leap second itself (23:59:60) has no name.
    """

    json_schema: ClassVar[dict[str, Any]] = {
        "type": "string",
        "pattern": r"^\d{4}-\d{2}-\d{2}",
        "examples": _EXAMPLES,
    }

    nanoseconds: int
    """Nanoseconds since 1970-01-01T00:00:00 UTC."""

    @classmethod
    def parse(cls, value: Any) -> Instant:
        """From ISO 8601 text (UTC unless it carries Z or an offset), a datetime (naive: UTC), an
        astropy Time or an Instant.
        """
        if isinstance(value, Instant):
            return value
        if isinstance(value, datetime):
            return cls._from_datetime(value)
        if isinstance(value, str):
            return cls._from_text(value)
        if hasattr(value, "utc") and hasattr(value, "jd1"):
            return cls._from_astropy(value)
        raise mistake(f"expected a time such as '{_EXAMPLES[0]}', got {value!r}")

    @classmethod
    def _from_datetime(cls, value: datetime) -> Instant:
        aware = value.replace(tzinfo=UTC) if value.tzinfo is None else value
        since = aware - _EPOCH
        return cls((since.days * 86400 + since.seconds) * SECOND + since.microseconds * 1000)

    @classmethod
    def _from_text(cls, text: str) -> Instant:
        match = _ISO.fullmatch(text.strip())
        if match is None:
            message = (
                f"cannot read {text!r} as a time; write ISO 8601 text such as '{_EXAMPLES[0]}'"
            )
            raise mistake(message, "expected YYYY-MM-DDThh:mm[:ss][Z or an offset such as -05:00]")
        part = match.groupdict()
        seconds = int(part["second"] or 0)
        if seconds == 60:
            raise mistake(
                f"{text!r} is a leap second, which POSIX time cannot name",
                "add one second",
            )
        fraction = part["fraction"] or ""
        if len(fraction.rstrip("0")) > 9:
            raise mistake(
                f"{text!r} has more than nine decimals of a second",
                "times are exact to 1 ns",
            )
        try:
            zone: timezone = UTC
            if part["sign"]:
                minutes = int(part["zone_hour"]) * 60 + int(part["zone_minute"] or 0)
                if minutes > _FARTHEST_ZONE or int(part["zone_minute"] or 0) >= 60:
                    zone_text = part["zone"]
                    raise ValueError(
                        f"no time zone is {zone_text} from UTC; offsets go from -14:00 to +14:00,"
                        " e.g. -05:00"
                    )
                zone = timezone(timedelta(minutes=-minutes if part["sign"] == "-" else minutes))
            day = datetime.fromisoformat(part["date"])
            local = day.replace(
                hour=int(part["hour"] or 0),
                minute=int(part["minute"] or 0),
                second=seconds,
                tzinfo=zone,
            )
            if not 2 <= local.year <= 9998:  # a scan, or another time zone, may end in another year
                raise ValueError("the year is not between 2 and 9998")
        except ValueError as err:
            raise mistake(f"{text!r} is no time: {err}") from None
        return cls(cls._from_datetime(local).nanoseconds + int(fraction[:9].ljust(9, "0")))

    @classmethod
    def _from_astropy(cls, value: Any) -> Instant:
        utc = value.utc
        if not getattr(utc, "isscalar", True):
            raise mistake(f"expected one time, got an array of {utc.size}")
        utc.precision = 9
        return cls._from_text(str(utc.isot))

    @property
    def datetime(self) -> datetime:
        """Aware UTC datetime, rounded down to its microsecond."""
        return _EPOCH + timedelta(microseconds=self.nanoseconds // 1000)

    @property
    def posix(self) -> float:
        """Seconds since 1970-01-01T00:00:00 UTC: a float64, which resolves 0.24 us today."""
        whole, rest = divmod(self.nanoseconds, SECOND)
        return whole + rest / SECOND

    def seconds_since(self, other: Instant) -> float:
        """``self - other`` in s; the difference is taken exactly and rounded once."""
        return (self.nanoseconds - other.nanoseconds) / SECOND

    def shifted(self, seconds: float) -> Instant:
        """The instant ``seconds`` later; the shift is rounded to the nearest nanosecond, the sum is
        exact.
        """
        whole = int(seconds)
        return Instant(self.nanoseconds + whole * SECOND + round((seconds - whole) * SECOND))

    def isoformat(self) -> str:
        """ISO 8601 text that parses back to the same nanosecond, e.g. ``2024-11-25T07:00:00Z``."""
        whole, rest = divmod(self.nanoseconds, SECOND)
        text = (_EPOCH + timedelta(seconds=whole)).replace(tzinfo=None).isoformat()
        return text + (f".{rest:09d}".rstrip("0") if rest else "") + "Z"

    def __str__(self) -> str:
        return self.isoformat()

    def __repr__(self) -> str:
        return f"Instant.parse({self.isoformat()!r})"
