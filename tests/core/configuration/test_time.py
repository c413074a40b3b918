from datetime import UTC, datetime, timedelta, timezone

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import BaseModel, ValidationError

from zonda.core.configuration.time import SECOND, Instant

# years 1700 to 2250
nanoseconds = st.integers(-8_520_000_000 * SECOND, 8_830_000_000 * SECOND)


class Model(BaseModel):
    time: Instant


@pytest.mark.parametrize(
    ("text", "iso"),
    [
        ("2024-11-25T07:00", "2024-11-25T07:00:00Z"),
        ("2024-11-25T02:00-05:00", "2024-11-25T07:00:00Z"),
        ("2024-11-25 02:00:00 -0500", "2024-11-25T07:00:00Z"),
        ("2024-11-25", "2024-11-25T00:00:00Z"),
        ("2024-11-25T07:00:00.000000001Z", "2024-11-25T07:00:00.000000001Z"),
        ("2024-02-29T23:59:59,5 UTC", "2024-02-29T23:59:59.5Z"),
        ("1969-12-31T23:59:59.75Z", "1969-12-31T23:59:59.75Z"),
    ],
)
def test_iso_text(text: str, iso: str) -> None:
    assert Instant.parse(text).isoformat() == iso


def test_known_posix_second() -> None:
    assert Instant.parse("2024-11-25T07:00:00Z").nanoseconds == 1_732_518_000 * SECOND
    assert Instant.parse("1970-01-01").nanoseconds == 0


def test_datetime_naive_is_utc_and_aware_is_converted() -> None:
    assert Instant.parse(datetime(2024, 11, 25, 7)) == Instant.parse("2024-11-25T07:00Z")
    local = datetime(2024, 11, 25, 2, 0, 0, 250, timezone(timedelta(hours=-5)))
    assert Instant.parse(local).isoformat() == "2024-11-25T07:00:00.00025Z"
    assert Instant.parse(local).datetime == local


def test_astropy_time_of_any_scale() -> None:
    from astropy.time import Time

    assert Instant.parse(Time("2024-11-25T07:00:37", scale="tai")) == Instant.parse(
        "2024-11-25T07:00:00Z"
    )
    with pytest.raises(ValueError, match="one time, got an array of 2"):
        Instant.parse(Time(["2024-11-25", "2024-11-26"]))


@given(nanoseconds)
def test_text_round_trip_is_exact(ns: int) -> None:
    instant = Instant(ns)
    assert Instant.parse(str(instant)) == instant
    assert eval(repr(instant)) == instant
    assert Model.model_validate_json(Model(time=instant).model_dump_json()).time == instant


@given(nanoseconds, st.integers(-(10**15), 10**15))
def test_shift_is_exact_to_the_nanosecond(ns: int, shift: int) -> None:
    moved = Instant(ns).shifted(shift / SECOND)
    # the argument itself is a float64 number of seconds, below 1e6 here: rounded by < 6e-11 s
    assert moved.nanoseconds - ns == shift
    assert moved.seconds_since(Instant(ns)) == shift / SECOND


def test_differences_are_finer_than_posix_floats() -> None:
    late = Instant.parse("2027-01-15T08:00:00.000000001Z")
    assert late.nanoseconds / SECOND > 1.79e9
    assert late.seconds_since(Instant.parse("2027-01-15T08:00:00Z")) == 1e-9
    assert np.spacing(late.posix) > 2e-7


def test_order_and_hash() -> None:
    a, b = Instant.parse("2024-11-25"), Instant.parse("2024-11-26")
    assert a < b
    assert len({a, b, Instant.parse("2024-11-25T00:00Z")}) == 2
    assert a.datetime.tzinfo is UTC


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        ("tomorrow", "cannot read 'tomorrow' as a time; write ISO 8601 text such as"),
        ("2024-11", "cannot read"),
        ("2024-11-25T25:00", "is no time: hour must be in"),
        ("2024-02-30", "is no time: day"),
        ("2024-11-25T07:00+99:00", "is no time"),
        ("2016-12-31T23:59:60Z", "is a leap second"),
        ("2024-11-25T07:00:00.0000000001Z", "more than nine decimals"),
        ("9999-12-31T23:59", "the year is not between 2 and 9998"),
        ("0001-01-01", "the year is not between 2 and 9998"),
        (20241125, "expected a time such as"),
        (True, "expected a time such as"),
        (None, "expected a time such as"),
    ],
)
def test_bad_times_say_what_is_expected(bad: object, message: str) -> None:
    with pytest.raises(ValidationError) as caught:
        Model(time=bad)  # type: ignore[arg-type]
    (error,) = caught.value.errors()
    assert error["loc"] == ("time",)
    assert message in error["msg"]


def test_schema_gives_examples() -> None:
    field = Model.model_json_schema()["properties"]["time"]
    assert field["type"] == "string"
    assert all(Instant.parse(example) for example in field["examples"])
