"""Schedules: azimuths and times of their rows, turnarounds, boresight rotation, nods, what is wrong
with files.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import numpy as np
import pytest

import zonda
import zonda.testing
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.configuration.parameters import ParameterError
from zonda.core.configuration.pipeline_file import parse
from zonda.core.data import Data
from zonda.core.errors import InputError, PointingError
from zonda.core.flags import IRREGULAR, TURNAROUND, samples_in
from zonda.core.numerics.quaternions import conjugate, from_angles, multiply
from zonda.core.pipeline import Pipeline
from zonda.core.registry import instruments
from zonda.core.scene import Scene
from zonda.operators.pointing.schedule import PointingSchedule, read_schedule
from zonda.operators.pointing.sweep import Nod, Sweep

ROWS = [
    (
        "2025-03-01T06:00:00+00:00",
        "2025-03-01T06:02:00+00:00",
        0.0,
        "patch",
        120.0,
        150.0,
        50.0,
        0,
        0,
    ),
    (
        "2025-03-01T06:02:47+00:00",
        "2025-03-01T06:04:00+00:00",
        45.0,
        "patch",
        345.0,
        15.0,
        55.0,
        0,
        1,
    ),
]
HEAD = """# %ECSV 1.0
# ---
# datatype:
# - {name: start_time, datatype: string}
# - {name: stop_time, datatype: string}
# - {name: boresight_angle, unit: deg, datatype: float64}
# - {name: name, datatype: string}
# - {name: azmin, unit: deg, datatype: float64}
# - {name: azmax, unit: deg, datatype: float64}
# - {name: el, unit: deg, datatype: float64}
# - {name: scan_index, datatype: int64}
# - {name: subscan_index, datatype: int64}
# meta: !!omap
# - {site_name: atacama}
# - site_lat: !astropy.units.Quantity
#     unit: &id001 !astropy.units.Unit {unit: deg}
#     value: -22.96
# schema: astropy-2.0
start_time stop_time boresight_angle name azmin azmax el scan_index subscan_index
"""
SITE_LINE = (
    "# Site | Telescope | Latitude [deg] | Longitude [deg] | Elevation [m]\natacama | LAT | -22.960"
    " | -67.790 | 5200.0\n"
)
FAST = {
    "speed": "1.2 deg/s",
    "acceleration": "0.8 deg/s2",
    "sample_rate": "40 Hz",
    "check_limits": "warn",
}
SITE = {"name": "a", "latitude": "-22.96 deg", "longitude": "-67.79 deg", "altitude": "5200 m"}

pytestmark = pytest.mark.filterwarnings("ignore:.*samples per FWHM")


def version_5(path, rows=ROWS):
    path.write_text(HEAD + "\n".join(" ".join(map(str, row)) for row in rows) + "\n")
    return path


def version_4(path, bar=" | "):
    rows = [
        bar.join([r[0][:19].replace("T", " "), r[1][:19].replace("T", " "), *map(str, r[2:])])
        for r in ROWS
    ]
    path.write_text(SITE_LINE + "\n".join(rows) + "\n")
    return path


def scans(path, **more):
    data = Data(Scene(site=SITE, instrument="act_150ghz", time="2025-03-01T06:00", seed=1))
    PointingSchedule(schedule=path, **{**FAST, **more}).observe(data)
    return data.observations


def test_both_versions_are_the_same(tmp_path):
    five, four = (
        read_schedule(version_5(tmp_path / "a.ecsv"))[0],
        read_schedule(version_4(tmp_path / "a.txt"))[0],
    )
    assert five == four
    assert [row.label for row in five] == ["patch-0-0", "patch-0-1"]
    assert five[1].azimuth == (pytest.approx(np.radians(345)), pytest.approx(np.radians(375)))
    assert five[0].duration == 120


@pytest.mark.parametrize("smooth", [False, True])
def test_turnarounds_are_continuous_and_as_fast_as_asked_for(smooth):
    """Position and speed are continuous; the largest acceleration is the one that is given; the
    reach beyond is `beyond`.
    """
    sweep = Sweep(0.5, 0.03, 0.02, smooth)
    t = np.arange(0, 2.2 * (sweep.leg + sweep.turnaround), 1e-3)
    x = sweep.path(t)
    v, a = np.diff(x) / 1e-3, np.diff(x, 2) / 1e-6
    assert np.abs(a).max() == pytest.approx(0.02, rel=1e-4)
    assert np.abs(v).max() == pytest.approx(0.03, rel=1e-9)
    np.testing.assert_allclose(
        np.abs(v[~sweep.turning(t[:-1]) & ~sweep.turning(t[1:])]), 0.03, rtol=1e-9
    )
    assert x.max() - 0.5 == pytest.approx(sweep.overshoot, rel=1e-5)
    assert -x.min() == pytest.approx(sweep.overshoot, rel=1e-5)


def test_rows_are_scanned_between_their_limits(tmp_path):
    """Times from the start, azimuths of the mount, constant speed on the sky, 345 to 15 deg through
    north.
    """
    one, two = scans(version_5(tmp_path / "a.ecsv"), turnaround="constant_acceleration")
    assert str(one.start) == "2025-03-01T06:00:00Z"
    assert str(two.start) == "2025-03-01T06:02:47Z"
    assert (one.n_samples, two.n_samples) == (4800, 2920)
    for o, (low, high), elevation in ((one, (120, 150), 50), (two, (345, 375), 55)):
        azimuth = np.degrees(np.unwrap(o.azimuth))
        rate = 1.2 / np.cos(np.radians(elevation))
        inside = samples_in(o.intervals["scanning"], o.seconds)
        assert azimuth[0] == pytest.approx(low, abs=1e-9)
        assert azimuth[inside].min() >= low - 1e-9
        assert azimuth[inside].max() <= high + 1e-9
        beyond = rate**2 / (2 * 0.8)
        assert azimuth.max() == pytest.approx(high + beyond, abs=1e-3)
        speed = np.diff(azimuth) * 40
        moving = inside[1:] & inside[:-1]
        np.testing.assert_allclose(np.abs(speed[moving]), rate, rtol=1e-6)
        np.testing.assert_allclose(np.degrees(o.elevation), elevation, atol=1e-9)
        np.testing.assert_array_equal(o.flags == TURNAROUND, ~inside)


def test_intervals_of_either_direction(tmp_path):
    one, _ = scans(version_5(tmp_path / "a.ecsv"))
    right = np.diff(np.unwrap(one.azimuth)) > 0
    for name, going in (("scan_leftright", True), ("scan_rightleft", False)):
        inside = samples_in(one.intervals[name], one.seconds)
        assert (right[inside[1:] & inside[:-1]] == going).all()
    throw = samples_in(one.intervals["throw"], one.seconds)
    assert throw.all()
    for name, going in (("throw_leftright", True), ("throw_rightleft", False)):
        inside = samples_in(one.intervals[name], one.seconds)
        assert (right[inside[1:] & inside[:-1]] == going).all()
        assert len(one.intervals[name]) > 1


def test_the_focal_plane_is_turned_about_the_boresight(tmp_path):
    """TOAST's bore_azel = q(az, el) Rz(angle); celestial ones likewise, and the direction stays."""
    turned, plain = (
        scans(version_5(tmp_path / "a.ecsv"))[1],
        scans(version_5(tmp_path / "b.ecsv", [ROWS[0], (*ROWS[1][:2], 0.0, *ROWS[1][3:])]))[1],
    )
    about = np.array([0, 0, np.sin(np.pi / 8), np.cos(np.pi / 8)])
    np.testing.assert_allclose(
        multiply(conjugate(plain.boresight_azel), turned.boresight_azel),
        np.tile(about, (2920, 1)),
        atol=1e-12,
    )
    np.testing.assert_allclose(
        multiply(conjugate(plain.boresight_radec), turned.boresight_radec),
        np.tile(about, (2920, 1)),
        atol=1e-12,
    )
    upright = from_angles(-turned.azimuth, turned.elevation)
    same = np.abs((upright * plain.boresight_azel).sum(axis=1))
    np.testing.assert_allclose(same, 1, atol=1e-12)


def test_scans_are_called_by_their_rows(tmp_path):
    rows = [(*row[:3], "patch/a", *row[4:]) for row in ROWS]
    assert [o.name for o in scans(version_5(tmp_path / "a.ecsv"))] == [
        "scan-000-patch-0-0",
        "scan-001-patch-0-1",
    ]
    assert scans(version_5(tmp_path / "b.ecsv", rows))[0].name == "scan-000-patch_a-0-0"


@pytest.mark.parametrize("version", [4, 5])
def test_the_site_of_the_schedule_is_compared(tmp_path, version, recwarn):
    """The head has latitude -22.96 deg; version 4 has the longitude too."""
    path = version_4(tmp_path / "a.txt") if version == 4 else version_5(tmp_path / "a.ecsv")
    if version == 5:
        text = path.read_text().replace(
            "# schema",
            "# - site_lon: !astropy.units.Quantity {unit: *id001, value: -67.79}\n# schema",
        )
        path.write_text(text)
    stated = read_schedule(path)[1]
    assert (stated.name, stated.latitude) == ("atacama", pytest.approx(np.radians(-22.96)))
    assert stated.longitude == pytest.approx(np.radians(-67.79))
    scans(path)
    assert not [w for w in recwarn if "was made for" in str(w.message)]

    def elsewhere(latitude):
        scene = Scene(
            site=SITE | {"latitude": latitude},
            instrument="act_150ghz",
            time="2025-03-01T06:00",
            seed=1,
        )
        PointingSchedule(schedule=path, **FAST).observe(Data(scene))

    with pytest.warns(UserWarning, match=r"made for atacama .*, 11\.12 km from the scene's site"):
        elsewhere("-22.86 deg")
    with pytest.raises(PointingError, match="its azimuths look elsewhere") as caught:
        elsewhere("-21 deg")
    assert str(path) in str(caught.value)
    assert "set the scene's site" in str(caught.value)


def test_a_schedule_without_a_site_and_a_wrong_one(tmp_path):
    path = version_5(tmp_path / "a.ecsv")
    assert read_schedule(path)[1] is None  # no longitude
    text = path.read_text()
    for wrong in ("!other.Tag {a: 1}", "north"):
        path.write_text(text.replace("# schema", f"# - site_lon: {wrong}\n# schema"))
        with pytest.raises(InputError, match="latitude"):
            read_schedule(path)
    unknown = (
        version_4(tmp_path / "a.txt")
        .read_text()
        .replace("atacama | LAT | -22.960 | -67.790", "Unknown | LAT | 0.0 | 0.0")
    )
    (tmp_path / "b.txt").write_text(unknown)
    assert read_schedule(tmp_path / "b.txt")[1] is None


def test_nods_come_before_the_scan(tmp_path):
    nods = {
        "elevation_nods": ["1 deg", "-1 deg", "0 deg"],
        "elevation_speed": "0.5 deg/s",
        "elevation_acceleration": "1 deg/s2",
    }
    one, _ = scans(version_5(tmp_path / "a.ecsv"), **nods)
    # from rest to rest over d at most v: d / v + v / a
    ahead = int((2.5 + 4.5 + 2.5) * 40)
    assert one.n_samples == 4800 + ahead
    assert one.start.seconds_since(scans(tmp_path / "a.ecsv")[0].start) == pytest.approx(
        -ahead / 40
    )
    elevation = np.degrees(one.elevation)
    np.testing.assert_array_equal(one.flags[:ahead], IRREGULAR)
    assert not (one.flags[ahead:] & IRREGULAR).any()
    np.testing.assert_allclose(elevation[ahead:], 50, atol=1e-9)
    assert elevation[:ahead].max() == pytest.approx(51, abs=1e-6)
    assert elevation[:ahead].min() == pytest.approx(49, abs=1e-6)
    assert np.abs(np.diff(elevation)).max() * 40 <= 0.5 * (1 + 1e-9)
    assert samples_in(one.intervals["elnod"], one.seconds)[: ahead - 1].all()
    assert not samples_in(one.intervals["scanning"], one.seconds)[:ahead].any()


def test_nods_end_where_the_scan_is(tmp_path):
    """Whatever the rate, the elevation of the scan is reached before it begins; a list that ends
    elsewhere is refused.
    """
    nods = {
        "elevation_speed": "0.5 deg/s",
        "elevation_acceleration": "1 deg/s2",
        "sample_rate": "7.3 Hz",
    }
    one, _ = scans(version_5(tmp_path / "a.ecsv"), elevation_nods=["1 deg", "0 deg"], **nods)
    steps = np.abs(np.diff(one.elevation))
    assert np.degrees(steps).max() <= 0.5 / 7.3 * (1 + 1e-9)
    last = int(np.flatnonzero(one.flags & IRREGULAR)[-1])
    assert (
        np.degrees(steps[last]) <= 1 / 7.3**2 / 2
    )  # from rest to rest: no more than the last sample's way
    assert np.degrees(steps[last - 1]) > 0
    with pytest.raises(ParameterError, match="write 0 deg as the last"):
        PointingSchedule(schedule=tmp_path / "a.ecsv", elevation_nods=["1 deg", "-1 deg"])


@pytest.mark.parametrize("turnaround", ["smooth", "constant_acceleration"])
def test_limits_hold_for_nods_and_scans_not_for_what_lies_between_them(tmp_path, turnaround):
    """The scan begins at full speed, as in TOAST: that step is none that the mount makes; too fast
    a nod is told.
    """
    act = instruments.create("act_150ghz")
    limits = {
        "azimuth_speed_max": "5 deg/s",
        "azimuth_acceleration_max": "5 deg/s2",
        "elevation_acceleration_max": "0.9 deg/s2",
        "elevation_jerk_max": "9 deg/s3",
    }
    scene = Scene(site=SITE, instrument=act.varied(telescope=limits), time="2025-03-01T06:00")
    given = {
        **FAST,
        "check_limits": "error",
        "turnaround": turnaround,
        "elevation_nods": ["1 deg", "0 deg"],
    }
    path = version_5(tmp_path / "a.ecsv")
    data = Data(scene)
    PointingSchedule(schedule=path, elevation_acceleration="0.8 deg/s2", **given).observe(data)
    said = {what: text for _, what, text in data.observations[0].log}[
        "largest acceleration of the axes"
    ]
    assert "azimuth 0.8 deg/s2 (16 %" in said
    assert "elevation 0.8 deg/s2 (88.9 %" in said
    with pytest.raises(PointingError, match="acceleration of the elevation axis of 1 deg/s2"):
        PointingSchedule(schedule=path, elevation_acceleration="1 deg/s2", **given).observe(
            Data(scene)
        )


def test_a_nod_that_never_reaches_its_speed():
    nod = Nod((0.01,), 1.0, 0.04)
    assert nod.duration == pytest.approx(1.0)  # 2 sqrt(d / a)
    t = np.linspace(0, 1.2, 25)
    np.testing.assert_allclose(nod.path(t)[t >= 1], 0.01, rtol=1e-12)
    assert nod.path(np.array([0.5]))[0] == pytest.approx(0.005)


def test_it_keeps_the_contract(tmp_path):
    rows = [("2024-11-25T07:00:00", "2024-11-25T07:01:00", 10.0, "patch", 120.0, 124.0, 50.0, 0, 0)]
    zonda.testing.check_operator(
        PointingSchedule(schedule=version_5(tmp_path / "a.ecsv", rows), speed="0.2 deg/s")
    )


def change(number, **values):
    names = HEAD.splitlines()[-1].split()
    rows = [list(row) for row in ROWS]
    for name, value in values.items():
        rows[number][names.index(name)] = value
    return rows


@pytest.mark.parametrize(
    ("rows", "match"),
    [
        (
            change(1, stop_time=ROWS[0][1]),
            "line 21: patch-0-1: stop_time is earlier than start_time",
        ),
        (change(0, el=91.0), "el is 91 deg, not between 0 and 90 deg"),
        (change(0, azmax=600.0), "more than a turn apart"),
        (
            change(1, azmin=82.0, azmax=73.0),
            "line 21: patch-0-1: azmin is 82 deg and azmax 73 deg: that is a sweep of 351 deg",
        ),
        (
            change(1, start_time="2025-03-01T06:01:30+00:00"),
            r"line 21: patch-0-1: begins 30 s before patch-0-0 \(line 20\) stops",
        ),
        (
            change(1, start_time="2025-03-01T05:59:00+00:00"),
            r"line 20: patch-0-0: begins 240 s before patch-0-1 \(line 21\) stops",
        ),
        (change(0, azmin="nan"), "line 20: azmin is 'nan', not a finite number"),
        (
            change(0, start_time="yesterday"),
            "line 20: start_time: cannot read 'yesterday' as a time",
        ),
        (
            change(0, azmin="nan", start_time="now"),
            r"2 mistakes\n  = line 20: azmin is 'nan'.*\n  = line 20: start_time: cannot",
        ),
        ([], "has no rows"),
    ],
)
def test_bad_rows(tmp_path, rows, match):
    with pytest.raises(InputError, match=match) as caught:
        read_schedule(version_5(tmp_path / "bad.ecsv", rows))
    assert "bad.ecsv" in str(caught.value)


def test_rows_that_cannot_be_are_told_together(tmp_path):
    """A short row within a long one does not hide that the next one overlaps the long one, too."""
    rows = [
        ("2025-03-01T06:00:00", "2025-03-01T06:10:00", 0.0, "a", 120.0, 150.0, 50.0, 0, 0),
        ("2025-03-01T06:01:00", "2025-03-01T06:02:00", 0.0, "b", 120.0, 150.0, 50.0, 0, 0),
        ("2025-03-01T06:05:00", "2025-03-01T06:12:00", 0.0, "c", 82.0, 73.0, 50.0, 0, 0),
        ("2025-03-01T06:12:00", "2025-03-01T06:13:00", 0.0, "d", 82.0, 83.0, 92.0, 0, 0),
    ]
    with pytest.raises(InputError) as caught:
        read_schedule(version_5(tmp_path / "bad.ecsv", rows))
    message = str(caught.value)
    assert "4 mistakes" in message
    assert "line 21: b-0-0: begins 540 s before a-0-0 (line 20) stops" in message
    assert "sweep of 351 deg through north; exchange them, or write azmax: 433 deg" in message
    assert "line 22: c-0-0: begins 300 s before a-0-0 (line 20) stops" in message
    assert "line 23: d-0-0: el is 92 deg" in message


@pytest.mark.parametrize(
    "change_of_the_second",
    [
        {"start_time": "2025-03-01T06:02:00+00:00"},
        {"start_time": "2025-03-01T06:01:59+00:00"},
        {"azmin": 350.0, "azmax": 10.0},
        {"azmin": 270.0, "azmax": 90.0},
        {"azmin": 82.0, "azmax": 433.0},
        {"azmin": 0.0, "azmax": 360.0},
        {"start_time": "2025-03-01T05:00:00+00:00", "stop_time": "2025-03-01T06:00:00+00:00"},
    ],
)
def test_rows_that_can_be(tmp_path, change_of_the_second):
    """Rows that touch, or overlap by the second to which times are rounded, sweeps through north,
    and wide ones that say so.
    """
    path = version_5(tmp_path / "a.ecsv", change(1, **change_of_the_second))
    assert len(read_schedule(path)[0]) == 2


def test_nods_that_begin_before_the_row_before_stops(tmp_path):
    """They last 2 x (1 s + 1 s): with the second to which times are rounded, a gap of 3 s is enough
    and one of 2.9 s is not.
    """
    nods = {
        "elevation_nods": ["1 deg", "0 deg"],
        "elevation_speed": "1 deg/s",
        "elevation_acceleration": "1 deg/s2",
    }
    first = ("2025-03-01T06:00:00", "2025-03-01T06:02:00", 0.0, "a", 120.0, 150.0, 50.0, 0, 0)
    for begins, fits in (("06:02:03", True), ("06:02:02.9", False)):
        path = version_5(
            tmp_path / "a.ecsv",
            [first, (f"2025-03-01T{begins}", "2025-03-01T06:04:00", *first[2:8], 1)],
        )
        assert len(scans(path)) == 2
        if fits:
            assert len(scans(path, **nods)) == 2
            continue
        with pytest.raises(
            InputError,
            match=r"its elevation nods of 4 s begin 1.1 s before a-0-0 \(line 20\) stops",
        ):
            scans(path, **nods)
        data = Data(Scene(site=SITE, instrument="act_150ghz", time="2025-03-01T06:00"))
        with pytest.raises(InputError, match="leave 4 s between the rows"):
            PointingSchedule(schedule=path, **{**FAST, **nods}).check(data)


@pytest.mark.parametrize("text", ["", "hello\n", SITE_LINE, SITE_LINE + "2025 | 2026 | 0\n"])
def test_files_that_are_no_schedule(tmp_path, text):
    path = tmp_path / "bad.txt"
    path.write_text(text)
    with pytest.raises(InputError, match=r"is no schedule|fields, not 9"):
        read_schedule(path)


def test_an_elevation_that_the_telescope_cannot_reach(tmp_path):
    with pytest.raises(PointingError, match=r"goes down to elevation 2.00 deg; .* reaches"):
        scans(version_5(tmp_path / "a.ecsv", change(0, el=2.0)))


FILE = """\
site: atacama
instrument: {{like: act_150ghz, detectors: 7}}
time: 2025-03-01T06:00
seed: 1
operators:
  - {pointing}
  - WhiteNoise
  - Efficiency
  - BinMap: {{pixel: 6 arcmin}}
  - SaveMap
campaign: {{schedule: a.ecsv, engine: serial}}
"""


def test_the_schedule_of_a_campaign_is_that_of_its_pointing_step(tmp_path):
    path = version_5(tmp_path / "a.ecsv")
    file = parse(FILE.format(pointing="PointingSchedule: {speed: 1.2 deg/s}"), folder=tmp_path)
    assert file.operators[0].schedule == path
    again = parse(file.resolved_yaml(tmp_path), folder=tmp_path)
    assert again.operators[0] == file.operators[0]
    with pytest.raises(ConfigurationError, match="no step takes the schedule"):
        parse(FILE.format(pointing="PointingStare"), folder=tmp_path)
    with pytest.raises(ConfigurationError, match=r"no such file: .none\.ecsv"):
        parse(
            FILE.format(pointing="PointingSchedule").replace("a.ecsv", "none.ecsv"), folder=tmp_path
        )


def test_a_schedule_has_its_own_nights(tmp_path):
    version_5(tmp_path / "a.ecsv")
    text = FILE.format(pointing="PointingSchedule").replace("a.ecsv,", "a.ecsv, nights: 3,")
    with pytest.raises(ConfigurationError, match="nights would repeat the same scans"):
        parse(text, folder=tmp_path)
    assert (
        parse(text.replace("nights", "realizations"), folder=tmp_path).header.campaign.realizations
        == 3
    )


def test_files_begin_when_the_first_scan_does(tmp_path):
    """DATE-OBS is not the scene's time, which the schedule need not share."""
    from astropy.io import fits

    scene = Scene(
        site=SITE,
        instrument={"like": "act_150ghz", "detectors": 7},
        time="2025-03-01T05:00",
        seed=1,
    )
    step = PointingSchedule(schedule=version_5(tmp_path / "a.ecsv", ROWS[:1]), **FAST)
    Pipeline([step, zonda.BinMap(contents="hits", pixel="6 arcmin"), zonda.SaveMap()]).run(
        scene, output=tmp_path / "out"
    )
    assert fits.getheader(tmp_path / "out" / "map.fits")["DATE-OBS"] == "2025-03-01T06:00:00"


def test_check_says_where_sun_and_moon_are(tmp_path):
    """Against astropy's positions of the Sun and the Moon at the first sample, to the 0.1 deg that
    is printed.
    """
    import astropy.units as u
    from astropy.coordinates import AltAz, EarthLocation, get_body
    from astropy.time import Time
    from astropy.utils import iers

    step = PointingSchedule(schedule=version_5(tmp_path / "a.ecsv", [ROWS[0]]), **FAST)
    data = Data(Scene(site=SITE, instrument="act_150ghz", time="2025-03-01T06:00", seed=1))
    lines = step.check(data)
    assert lines[0].startswith("1 scan from 2025-03-01T06:00:00Z to 2025-03-01T06:02:00")
    found = {
        line.split()[3].rstrip(":"): line for line in lines if line.startswith("distance of the")
    }
    place = EarthLocation.from_geodetic(-67.79 * u.deg, -22.96 * u.deg, 5200 * u.m)
    o = data.observations[0]
    with iers.conf.set_temp("auto_download", False):
        when = Time(o.start.posix + o.seconds[[0, -1]], format="unix")
        frame = AltAz(obstime=when, location=place)
        for body in ("sun", "moon"):
            there = get_body(body, when, place).transform_to(frame)
            look = AltAz(
                az=o.azimuth[[0, -1]] * u.rad,
                alt=o.elevation[[0, -1]] * u.rad,
                obstime=when,
                location=place,
            )
            apart = there.separation(look).deg
            low, high = (
                float(x) for x in (found[body.title()].split()[4], found[body.title()].split()[6])
            )
            assert low - 0.06 <= apart.min()
            assert apart.max() <= high + 0.06
    assert "below the horizon" in found["Sun"]


def long_schedule(path, number, **odd):
    """Rows of 2 min, one after the other; ``odd``: azmax or el of one row in the middle."""
    begin = datetime(2025, 3, 1, tzinfo=UTC)
    rows = []
    for k in range(number):
        start = begin + timedelta(minutes=3 * k)
        mine = odd if k == 977 else {}
        end = start + timedelta(minutes=2)
        rows.append(
            (
                start.isoformat(),
                end.isoformat(),
                0.0,
                "patch",
                120.0,
                mine.get("azmax", 150.0),
                mine.get("el", 50.0),
                k,
                0,
            )
        )
    return version_5(path, rows)


def check(path, **more):
    data = Data(scene=Scene(site=SITE, instrument="so_lat_mf", time="2025-03-01T06:00"))
    return PointingSchedule(schedule=path, **FAST | more).check(data), data


def test_a_check_looks_at_some_rows_of_a_long_schedule(tmp_path):
    """Half an hour for the 26 000 rows of a survey, once. All rows are read, and counted."""
    lines, data = check(long_schedule(tmp_path / "a.ecsv", 2000, el=61.0))
    assert "2000 scans" in lines[0]
    assert f"({len(data.observations)} of them looked at)" in lines[0]
    assert len(data.observations) <= 64
    assert "50.00 to 61.00 deg" in lines[1], "the highest row is one of them"
    short, data = check(long_schedule(tmp_path / "b.ecsv", 20))
    assert len(data.observations) == 20
    assert "looked at" not in short[0]


def test_a_row_that_the_telescope_cannot_do_is_found_among_many(tmp_path):
    """The lowest, and the highest, where the mount turns fastest, are always looked at."""
    with pytest.raises(PointingError, match="patch-977-0"):
        check(long_schedule(tmp_path / "low.ecsv", 2000, el=1.0))
    with pytest.raises(PointingError, match="patch-977-0"):
        check(long_schedule(tmp_path / "fast.ecsv", 2000, el=80.0), check_limits="error")


HEAD_OF_TEXT = "#Site Telescope Latitude Longitude Elevation\nATACAMA SAT -22.958 -67.786 5200.0\n"
SKY = "10.0 120.0 12.0 121.0 30.0 200.0 31.0 201.0 0.25"
TEXTS = {
    "version 4": (
        "2027-06-23 08:01:00 | 2027-06-23 08:11:00 | 45.0 | field_a | 110.0 | 142.0 | 50.0 | 21 | 3"
    ),
    "version 3": " 2027-06-23 08:01:00  2027-06-23 08:11:00 45.0 field_a 110.00 142.00 50.00 21 3",
    "version 2": "|".join(
        [
            "2027-06-23 08:01:00",
            "2027-06-23 08:11:00",
            *["61579.3", "61579.4", "45", "field_a", "110", "142", "50", "R"],
            *SKY.split(),
            "21",
            "3",
            "0.5",
        ]
    ),
    "version 1": (
        f"2027-06-23 08:01:00 2027-06-23 08:11:00 61579.3 61579.4 45.0 field_a 110 142 50 R {SKY}"
        " 21 3 0.5"
    ),
    "23 words": (
        f"2027-06-23 08:01:00 2027-06-23 08:11:00 61579.3 61579.4 45.0 field_a 110 142 50 R {SKY}"
        " 21 3"
    ),
}


@pytest.mark.parametrize("version", TEXTS)
def test_every_version_of_text(version, tmp_path):
    """As TOAST reads them: dates and times are one field between bars, two words between blanks."""
    path = tmp_path / "s.txt"
    path.write_text(HEAD_OF_TEXT + TEXTS[version] + "\n")
    (row,), _ = read_schedule(path)
    assert (row.name, row.number) == ("field_a", ("21", "3"))
    assert row.start.isoformat().startswith("2027-06-23T08:01:00")
    assert row.duration == 600
    assert np.degrees([*row.azimuth, row.elevation, row.rotation]) == pytest.approx(
        [110, 142, 50, 45]
    )


@pytest.mark.parametrize("mark", [",", ";", "\t", "|"])
def test_every_separator(mark, tmp_path):
    """`toast_ground_schedule --field-separator` puts it in place of each blank of its format."""
    path = tmp_path / "s.txt"
    site, row = ("ATACAMA SAT -22.958 -67.786 5200.0", TEXTS["version 4"].split(" | "))
    path.write_text(f"#Site\n{site.replace(' ', mark)}\n{mark.join(row)}\n")
    (row,), stated = read_schedule(path)
    assert (stated.name, row.label, row.duration) == ("ATACAMA", "field_a-21-3", 600)


@pytest.mark.parametrize("version", [4, 5])
def test_special_rows_are_left_out_and_told(tmp_path, version):
    """Wherever the word stands in the row, as in TOAST; the lines of others keep their numbers."""
    made = (version_4 if version == 4 else version_5)(tmp_path / "s")
    *head, first, second = made.read_text().splitlines()
    special = ["SPECIAL|" + first, first.replace("patch", "SPECIAL_cooler")][version - 4]
    made.write_text("\n".join([*head, first, special, second]))
    with pytest.warns(UserWarning, match=rf"1 row with SPECIAL .* line {len(head) + 2}"):
        assert len(read_schedule(made)[0]) == 2
    made.write_text("\n".join([*head, special, second.replace("55.0", "95.0")]))
    with (
        pytest.warns(UserWarning, match="SPECIAL"),
        pytest.raises(InputError, match=f"line {len(head) + 2}: patch-0-1: el is 95 deg"),
    ):
        read_schedule(made)


@pytest.mark.parametrize("limits", [(15.0, 15.0), (15.0, 15.0 + 4e-9), (360.0, 0.0)])
def test_rows_of_equal_limits_are_stares(tmp_path, limits):
    """TOAST takes limits within 1e-10 rad (5.7e-9 deg) as a stare. It has no turnaround, and is one
    throw for filters."""
    path = version_5(tmp_path / "a.ecsv", change(1, azmin=limits[0], azmax=limits[1]))
    one, two = scans(path, elevation_nods=["1 deg", "0 deg"])
    ahead = 4 * 40
    assert (two.n_samples, one.n_samples) == (2920 + ahead, 4800 + ahead)
    apart = np.angle(np.exp(1j * (two.azimuth - np.radians(limits[0]))))
    np.testing.assert_allclose(apart, 0, atol=1e-12)
    np.testing.assert_allclose(np.degrees(two.elevation[ahead:]), 55, atol=1e-9)
    assert not (two.flags & TURNAROUND).any()
    assert (one.flags & TURNAROUND).any()
    for name in ("throw", "scanning"):
        inside = samples_in(two.intervals[name], two.seconds)
        assert inside[ahead:].all()
        assert not inside[: ahead - 1].any()
    assert two.intervals["throw_leftright"] == two.intervals["turnaround"] == []
    lines, _ = check(path, check_limits="error")
    assert "2 scans, 1 of them stares (azmin is azmax), from" in lines[0]


def test_rows_without_duration_are_left_out_and_told(tmp_path):
    path = version_5(tmp_path / "a.ecsv", change(1, stop_time=ROWS[1][0]))
    with pytest.warns(UserWarning, match=r"stop_time is start_time in patch-0-1 \(line 21\)"):
        assert [row.label for row in read_schedule(path)[0]] == ["patch-0-0"]
    empty = [(*row[:1], row[0], *row[2:]) for row in ROWS]
    with (
        pytest.warns(UserWarning, match="patch-0-0"),
        pytest.raises(InputError, match="has no row that lasts"),
    ):
        read_schedule(version_5(path, empty))


def test_rows_of_no_version(tmp_path):
    path = tmp_path / "s.txt"
    path.write_text(HEAD_OF_TEXT + TEXTS["version 3"] + " 7\n")
    with pytest.raises(InputError, match="has 12 fields, not 9"):
        read_schedule(path)
