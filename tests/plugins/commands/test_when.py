"""`zonda when`: against astropy, and where the answer is known."""

from __future__ import annotations

import json
import math
from calendar import monthrange
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from zonda.core.configuration.target import Target
from zonda.core.configuration.time import Instant
from zonda.core.errors import OutputError
from zonda.core.numerics.bodies import BODIES
from zonda.core.registry import sites
from zonda.core.site import Site
from zonda.plugins.commands.visibility import (
    DAY,
    HORIZON,
    Track,
    months,
    night_of,
    share_above,
    solar_offset,
    spans_above,
    tracks,
)
from zonda.plugins.commands.when import target_of, when

GREEN_BANK: Site = sites.create("green_bank")
SOUTH_POLE: Site = sites.create("south_pole")
EVENING = Instant.parse("2024-11-25T02:00")
THIRTY = math.radians(30)
MINUTE = 60.0


@pytest.fixture(scope="module")
def offline() -> Any:
    from astropy.utils import iers

    with (
        iers.conf.set_temp("auto_download", False),
        iers.earth_orientation_table.set(iers.IERS_B.open()),
    ):
        yield


def of_astropy(what: str, times: Any, site: Site = GREEN_BANK) -> Track:
    """astropy's own way, with its built-in ephemeris and no refraction."""
    import astropy.units as u
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord, get_body
    from astropy.time import Time

    place = EarthLocation.from_geodetic(
        site.longitude * u.rad, site.latitude * u.rad, site.altitude * u.m
    )
    time = Time(times, format="unix")
    source = (
        get_body(what, time, place, ephemeris="builtin")
        if what in BODIES
        else SkyCoord(what, frame="icrs")
    )
    there = source.transform_to(AltAz(obstime=time, location=place))
    az, el = there.az.rad, there.alt.rad
    return Track(np.stack([np.cos(el) * np.cos(az), np.cos(el) * np.sin(az), np.sin(el)], axis=1))


@pytest.mark.parametrize("what", [*BODIES, "05h00m00s +20d00m00s"])
def test_directions_are_astropys(what: str, offline: None) -> None:
    times = EVENING.posix + np.arange(0, 30 * DAY, 1.37 * DAY)
    (found,) = tracks(GREEN_BANK, times, what if what in BODIES else Target.parse(what))
    # 2 arcsec: light that the Sun bends is not in, and the Moon's way is that of one second
    assert np.degrees(found.distance(of_astropy(what, times)).max()) * 3600 < 2.0


@pytest.mark.parametrize("what", ["05h00m00s +20d00m00s", "moon", "mars"])
def test_rise_and_set_within_a_minute_of_astropy(what: str, offline: None) -> None:
    night = night_of(GREEN_BANK, EVENING, what if what in BODIES else Target.parse(what), THIRTY)
    minutes = night.times[0] + np.arange(0, DAY + 1, MINUTE)
    there = of_astropy(what, minutes)
    spans = spans_above(minutes, there.elevation - THIRTY)
    assert len(night.spans) == len(spans) > 0
    for mine, other in zip(night.spans, spans, strict=True):
        for a, b in zip(mine, other, strict=True):
            assert (a is None) == (b is None)
            assert a is None or b is None or abs(a - b) < MINUTE
    time, elevation = night.highest
    assert abs(time - minutes[there.elevation.argmax()]) <= MINUTE
    assert elevation == pytest.approx(there.elevation.max(), abs=1e-4)
    ((sunset, sunrise),) = spans_above(minutes, HORIZON - of_astropy("sun", minutes).elevation)
    assert np.array(night.dark[0]) == pytest.approx(np.array([sunset, sunrise]), abs=MINUTE)


def test_at_the_pole_a_star_keeps_its_elevation(recwarn: pytest.WarningsRecorder) -> None:
    """At latitude -90 deg the elevation is minus the declination, but for precession (0.14 deg in
    2024) and aberration.
    """
    winter, summer = Instant.parse("2024-06-21"), Instant.parse("2024-12-21")
    up = night_of(SOUTH_POLE, winter, Target.parse("05h -40d"), THIRTY)
    assert up.spans == [(None, None)]
    assert up.dark == [(None, None)]
    assert up.hours == pytest.approx((24, 24))
    assert math.degrees(up.highest[1]) == pytest.approx(40, abs=0.15)
    below = night_of(SOUTH_POLE, summer, Target.parse("05h +40d"), THIRTY)
    assert below.spans == []
    assert below.dark == []
    assert below.hours == (0, 0)
    year = list(months(SOUTH_POLE, 2024, Target.parse("05h -40d"), THIRTY))
    days = [monthrange(2024, k)[1] for k in range(1, 13)]
    assert [month.hours for month in year] == pytest.approx([24 * n for n in days])
    assert year[5].hours_at_night == pytest.approx(24 * 30)
    assert year[11].hours_at_night == 0


def test_hours_of_a_year_follow_from_the_hour_angle() -> None:
    """cos H = (sin a - sin phi sin delta) / (cos phi cos delta): 2 H per turn of the Earth is above
    a.
    """
    ra, dec, phi = math.radians(75), math.radians(20), GREEN_BANK.latitude
    hour_angle = math.acos(
        (math.sin(THIRTY) - math.sin(phi) * math.sin(dec)) / (math.cos(phi) * math.cos(dec))
    )
    year = list(months(GREEN_BANK, 2023, Target("icrs", ra, dec), THIRTY))
    total = sum(month.hours for month in year)
    # steps of half an hour cut 0.3 % off a curved rise and set; every third day, precession: less
    assert total == pytest.approx(hour_angle / math.pi * 24 * 365, rel=0.01)
    assert [month.highest for month in year] == pytest.approx(
        [math.pi / 2 - phi + dec] * 12, abs=math.radians(0.3)
    )
    # in mid June the Sun stands at 5.6 h: the target is up by day; in December at night
    assert year[5].hours_at_night < 5 < 200 < year[11].hours_at_night
    assert min(month.sun[0] for month in year) == year[5].sun[0] < math.radians(15)


def test_spans_and_shares() -> None:
    times = np.arange(6.0)
    values = np.array([1.0, -1, -1, 3, 1, -1])
    assert spans_above(times, values) == [(None, 0.5), (2.25, 4.5)]
    assert spans_above(times, values + 5) == [(None, None)]
    assert spans_above(times, values - 5) == []
    assert share_above(values) == pytest.approx([0.5, 0, 0.75, 1, 0.5])
    assert share_above(np.array([-1.0, 1.0]), np.array([1.0, -3.0])) == pytest.approx([0.0])
    assert share_above(np.array([-1.0, 3.0]), np.array([1.0, -1.0])) == pytest.approx([0.25])
    assert share_above(np.array([0.0, 0.0])) == pytest.approx([0.0])


@pytest.mark.parametrize(
    ("time", "begin"),
    [
        ("2024-11-25T02:00", "2024-11-24"),  # 21 h solar: this night
        ("2024-11-25T10:00", "2024-11-24"),  # 5 h, dark: still this night
        ("2024-11-25T15:00", "2024-11-25"),  # 10 h in the morning: the next
        ("2024-11-25T18:00", "2024-11-25"),  # afternoon: the next
    ],
)
def test_which_night_is_meant(time: str, begin: str) -> None:
    night = night_of(GREEN_BANK, Instant.parse(time), "mars", THIRTY)
    assert (night.times[0] + solar_offset(GREEN_BANK)) % DAY == pytest.approx(DAY / 2, abs=1e-3)
    assert Instant(round(night.times[0]) * 10**9).isoformat().startswith(begin)


@pytest.mark.parametrize(
    ("text", "target"),
    [
        ("75 deg 20 deg", Target.parse("05h +20d")),
        ("05:00:00 +20:00:00", Target.parse("05h +20d")),
        ("galactic 179.9 deg -13.3 deg", Target.parse({"l": "179.9 deg", "b": "-13.3 deg"})),
        ("az 180 deg el 60 deg", Target.parse({"az": "180 deg", "el": "60 deg"})),
        ("Mars", "mars"),
        ("MOON", "moon"),
    ],
)
def test_every_form_of_a_target(text: str, target: Target | str) -> None:
    assert target_of(text) == target


def test_a_target_fixed_on_the_ground_stays_there() -> None:
    (track,) = tracks(
        GREEN_BANK, EVENING.posix + np.arange(3), Target.parse("az 200 deg el 60 deg")
    )
    assert np.degrees([track.azimuth, track.elevation]) == pytest.approx(
        np.array([[200.0] * 3, [60.0] * 3])
    )


@pytest.mark.parametrize("text", ["galactic 179.9 deg -13.3 deg", "Mars"])
def test_json(text: str) -> None:
    done = CliRunner().invoke(
        when, [*text.split(), "--site", "green_bank", "--time", "2024-11-25", "--json"]
    )
    assert done.exit_code == 0, done.output
    found = json.loads(done.output)
    assert found["target"] == text
    assert len(found["year"]["months"]) == 12
    assert found["night"]["hours"] > 0
    row = found["night"]["table"][0]
    assert row["elevation"] >= 30
    low, middle, high = row["pwv_mm"]
    assert low < middle < high


def test_what_is_printed_and_drawn(tmp_path: Path) -> None:
    options = [
        "--site",
        "green_bank",
        "--time",
        "2024-11-25",
        "--instrument",
        "mustang2",
        "--output",
        str(tmp_path / "new"),
    ]
    done = CliRunner().invoke(when, ["05h", "+20d", *options])
    assert done.exit_code == 0, done.output
    lines = done.output.splitlines()
    assert lines[0].startswith("05h +20d from green_bank (38.4331 deg")
    assert any(
        line.startswith("above 30 deg: from ") and "highest 71.6 deg" in line for line in lines
    )
    assert any(line.startswith("Moon: ") and "deg away" in line for line in lines)
    assert (
        sum(
            line[:3] in "JanFebMarAprMayJunJulAugSepOctNovDec"
            for line in lines
            if line[:3].isalpha()
        )
        == 12
    )
    picture = Path(lines[-1])
    assert picture.parent == tmp_path / "new"
    assert picture.read_bytes()[:4] == b"\x89PNG"
    # transmission at the lowest and the highest elevation of the table: exp(-tau / sin(el)) with
    # one tau, within the PWV's change
    rows = [line.split() for line in lines if line[2:3] == ":" and line[:2].isdigit()]
    opacity = [-math.log(float(row[-1])) * math.sin(math.radians(float(row[2]))) for row in rows]
    assert np.ptp(opacity) < 0.1 * np.mean(opacity)


def test_a_site_without_climatology_has_no_pwv() -> None:
    done = CliRunner().invoke(
        when, ["05h", "+20d", "--site", "46.5 deg, 8 deg, 3500 m", "--time", "2024-11-25", "--json"]
    )
    found = json.loads(done.output)
    assert "pwv_mm" not in found["night"]["table"][0]
    assert found["year"]["months"][0]["pwv_mm"] is None


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ["M31", "--site", "green_bank"],
            "names of objects are not looked up, as zonda uses no network: 'M31' is not one of",
        ),
        (["05h", "--site", "green_bank"], "a position needs two"),
        (
            ["05h", "+20d", "--site", "green_bank", "--above", "95 deg"],
            "outside the limits, 0 deg to 90 deg",
        ),
        (["05h", "+20d", "--site", "green_bank", "--abov", "5 deg"], "--abov"),
        (
            ["05h", "+20d", "--site", "green_bank", "--above", "20"],
            "20 has no unit; write an angle such as '30 deg'",
        ),
        (["05h", "+20d"], "Missing option '--site'"),
        (["05h", "+20d", "--site", "green_bank", "--time", "soon"], "cannot read 'soon' as a time"),
    ],
)
def test_mistakes(arguments: list[str], said: str) -> None:
    done = CliRunner().invoke(when, arguments)
    assert done.exit_code == 2
    assert said in done.output


def test_a_folder_that_takes_no_files_is_told_before_anything_is_computed() -> None:
    done = CliRunner().invoke(
        when, ["05h", "+20d", "--site", "green_bank", "--output", "/proc/zonda"]
    )
    assert isinstance(done.exception, OutputError)
    assert (
        str(done.exception)
        == "/proc/zonda: cannot be made: /proc takes no new folders\n  = choose another output"
        " folder"
    )
    assert done.output == ""


def test_an_unknown_option_is_named_where_the_site_is_absent_too() -> None:
    done = CliRunner().invoke(when, ["mars", "--sight", "green_bank"])
    assert (done.exit_code, "'--sight'" in done.output, "--site" in done.output) == (2, True, True)
    done = CliRunner().invoke(when, ["mars"])
    assert (done.exit_code, "Missing option '--site'" in done.output) == (2, True)
