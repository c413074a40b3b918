import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zonda.core.configuration.target import Target
from zonda.core.configuration.time import Instant
from zonda.core.data import Data
from zonda.core.errors import PointingError
from zonda.core.numerics import chunks
from zonda.core.numerics.celestial import CelestialTransform, orientation
from zonda.core.numerics.projection import rotation_matrices
from zonda.core.numerics.quaternions import from_angles
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.site import Site
from zonda.operators.pointing.azimuth_scan import PointingBackAndForth
from zonda.operators.pointing.base import Aim, PointingStare
from zonda.operators.pointing.daisy import PointingDaisy

GREEN_BANK = Site(
    name="Green Bank", latitude="38.4331 deg", longitude="-79.8398 deg", altitude="818 m"
)
POLE = Site(name="South Pole", latitude="-90 deg", longitude="0 deg", altitude="2835 m")
EQUATOR = Site(name="equator", latitude="0 deg", longitude="200 deg")
START = Instant.parse("2024-11-25T07:00:00.123456789Z")
BEAM = math.radians(8.1 / 3600)


def angle(a: Any, b: Any) -> Any:
    return np.arctan2(np.linalg.norm(np.cross(a, b), axis=-1), (a * b).sum(-1))


def random_directions(n: int, seed: int = 0) -> Any:
    rng = np.random.default_rng(seed)
    return unit_vectors(rng.uniform(0, 2 * np.pi, n), np.arcsin(rng.uniform(-1, 1, n)))


@pytest.mark.parametrize("site", [GREEN_BANK, POLE, EQUATOR], ids=lambda s: s.name)
@pytest.mark.parametrize("year", [1985, 2000, 2024])
def test_nodes_are_astropys_full_transformation_over_a_day(
    site: Site, year: int, reference: Any
) -> None:
    start = Instant.parse(f"{year}-11-25T07:00:00.123456789Z")
    transform = CelestialTransform(site, start, 86400.0)
    nodes = np.arange(0, 86401, 6 * transform.spacing)
    sky = random_directions(len(nodes))
    assert (
        angle(transform.horizontal(sky, nodes), reference.horizontal(sky, start, nodes, site)).max()
        < 1e-12
    )
    assert angle(transform.icrs(sky, nodes), reference.icrs(sky, start, nodes, site)).max() < 1e-12


def test_between_nodes_the_error_is_the_stated_one(reference: Any) -> None:
    transform = CelestialTransform(GREEN_BANK, START, 86400.0)
    anywhere = np.random.default_rng(1).uniform(0, 86400, 200)
    sky = random_directions(200)
    error = angle(
        transform.horizontal(sky, anywhere), reference.horizontal(sky, START, anywhere)
    ).max()
    # halfway between nodes is where a spline's error peaks; 1e-13 is astropy's own rounding
    assert error < 2 * transform.error + 1e-13
    assert transform.error < 1e-3 * BEAM / 1000


def test_nodes_are_refined_until_the_tolerance_is_met() -> None:
    loose = CelestialTransform(GREEN_BANK, START, 516.0)
    tight = CelestialTransform(GREEN_BANK, START, 516.0, tolerance=loose.error / 4)
    assert tight.error <= loose.error / 4
    assert tight.spacing < loose.spacing
    with pytest.raises(PointingError, match=r"cannot reach 1\.0e-30 rad"):
        CelestialTransform(GREEN_BANK, START, 516.0, tolerance=1e-30)


@pytest.mark.parametrize("site", [GREEN_BANK, POLE, EQUATOR], ids=lambda s: s.name)
def test_there_and_back(site: Site) -> None:
    transform = CelestialTransform(site, START, 86400.0)
    seconds = np.linspace(0, 86400, 40000)  # more than two chunks
    sky = random_directions(len(seconds))
    assert np.abs(transform.icrs(transform.horizontal(sky, seconds), seconds) - sky).max() < 2e-15


@pytest.mark.parametrize("frame", ["field", "whole sky"])
def test_a_track_is_there_and_back_at_once(frame: str) -> None:
    transform = CelestialTransform(GREEN_BANK, START, 3600.0)
    seconds = np.linspace(0, 3600, 40000)  # more than two chunks
    sky = (
        unit_vectors(1.3 + 0.01 * np.sin(seconds), 0.3 + 0.01 * np.cos(1.7 * seconds))
        if frame == "field"
        else random_directions(40000)
    )
    track = transform.follow(lambda some: sky[np.searchsorted(seconds, some)], seconds)
    assert np.array_equal(track.horizontal, transform.horizontal(sky, seconds))
    _, azel, radec = transform.boresight(track.horizontal, seconds)
    assert np.array_equal(track.azel, azel)
    assert np.abs(track.radec - radec).max() < 5e-15
    rounding = (
        2e-15 if frame == "field" else 1e-12
    )  # longitudes of random directions are unwrapped to 1e3 rad
    assert angle(rotation_matrices(track.radec)[:, :, 2], sky).max() < rounding


@pytest.mark.parametrize("scan", [PointingDaisy(), PointingBackAndForth()])
@pytest.mark.parametrize("target", ["05h +20d", "az 180d el 45d"])
def test_bits_do_not_depend_on_the_chunk(
    scan: Any, target: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    parsed, seconds = Target.parse(target), np.arange(5000) / 20.0
    transform = CelestialTransform(GREEN_BANK, START, 250.0)
    whole = scan.boresight(Aim(transform, parsed, (1e-4, 2e-4)), seconds)
    monkeypatch.setattr(chunks.chunks, "__defaults__", (777,))
    parts = scan.boresight(Aim(transform, parsed, (1e-4, 2e-4)), seconds)
    assert np.array_equal(whole.horizontal, parts.horizontal)
    assert np.array_equal(whole.azel, parts.azel)
    # bent light is inverted by steps that begin at the mean of a chunk
    assert np.abs(whole.radec - parts.radec).max() <= (
        0.0 if isinstance(scan, PointingDaisy) and "az" not in target else 1e-15
    )


def test_near_the_sun(reference: Any) -> None:
    """Half a degree from the Sun light is bent by 1 arcsec, 5e-6 rad, which is followed and
    inverted.
    """
    from astropy.coordinates import get_sun

    sun = get_sun(reference.frame(START, np.zeros(1)).obstime).icrs
    sky = unit_vectors(sun.ra.rad + 0.008, sun.dec.rad)
    transform = CelestialTransform(GREEN_BANK, START, 0.0)
    up = transform.horizontal(sky, np.zeros(1))
    assert angle(up, reference.horizontal(sky, START, np.zeros(1))).max() < 1e-12
    assert np.abs(transform.icrs(up, np.zeros(1)) - sky).max() < 1e-14


def test_poles_of_the_sky(reference: Any) -> None:
    transform = CelestialTransform(GREEN_BANK, START, 86400.0)
    seconds = np.linspace(0, 86400, 25)
    for declination in (90.0, -90.0, 89.9999999, -89.9999999):
        sky = unit_vectors(np.full(25, 1.0), np.full(25, math.radians(declination)))
        up = transform.horizontal(sky, seconds)
        assert angle(up, reference.horizontal(sky, START, seconds)).max() < 1e-12
        *_, radec = transform.boresight(up, seconds)
        assert np.isfinite(radec).all()
        assert angle(rotation_matrices(radec)[:, :, 2], sky).max() < 1e-14


@pytest.mark.parametrize(
    "target",
    [
        "05h00m00s +20d00m00s",
        "galactic 120.5 deg -30 deg",
        "0 deg 89 deg",
        "az 10 deg el 5.1 deg",
        "az 0 deg el 89.999 deg",
    ],
)
def test_position_angle(target: str, observe: Callable[..., Data], reference: Any) -> None:
    """The whole focal plane, not only the boresight, lands where astropy puts it.

    A rigid focal plane cannot follow aberration's change of scale, 1.03e-4 at most; its rotation
    must be right, so the error is along the offset: the part across it stays below 1e-6 of the
    offset (light deflection's shear, the second order).
    """
    telescope = {"elevation_min": "0 deg"}
    (o,) = observe(
        PointingDaisy(scan_duration="60 s", sample_rate="5 Hz"), target=target, telescope=telescope
    ).observations
    offset = math.radians(1 / 60)
    for xi, eta in ((0, offset), (offset, 0), (-offset, offset)):
        ray = np.array([-eta, -xi, 1.0]) / math.sqrt(1 + xi * xi + eta * eta)
        azel, radec = (rotation_matrices(q) for q in (o.boresight_azel, o.boresight_radec))
        truth = reference.icrs(azel @ ray, o.start, o.seconds)
        ours = radec @ ray
        centre = radec[:, :, 2]
        along = truth - centre * (truth * centre).sum(1)[:, None]
        along /= np.linalg.norm(along, axis=1)[:, None]
        across = np.cross(centre, along)
        assert np.abs(((ours - truth) * across).sum(1)).max() < 1e-6 * offset
        assert np.abs(((ours - truth) * along).sum(1)).max() < 1.1e-4 * math.hypot(xi, eta)


def test_psi_of_azel_is_zero_and_angles_are_toasts(observe: Callable[..., Data]) -> None:
    (o,) = observe(PointingDaisy(scan_duration="20 s")).observations
    psi = o.derotate("boresight_azel")[2]
    assert np.abs(np.sin(psi)).max() < 1e-14
    same = np.abs(
        (o.boresight_azel * from_angles(-o.azimuth, o.elevation)).sum(1)
    )  # q and -q are one rotation
    assert np.abs(same - 1).max() < 1e-15
    for q in (o.boresight_azel, o.boresight_radec):
        assert q.dtype == np.float64
        assert q.shape == (o.n_samples, 4)
        assert np.abs(np.linalg.norm(q, axis=1) - 1).max() < 1e-15


def test_parallactic_angle_is_the_textbook_one(observe: Callable[..., Data]) -> None:
    """From the triangle pole, zenith, star (Smart 1977, section 12); precession since 2000 turns
    the pole by 0.14 deg.
    """
    (o,) = observe(PointingStare(scan_duration="10 s", sample_rate="1 Hz")).observations
    latitude = GREEN_BANK.latitude
    # direction of the zenith seen from the star, east of north
    sin_q = -np.sin(o.azimuth) * math.cos(latitude) / np.cos(o.dec)
    cos_q = (math.sin(latitude) - np.sin(o.dec) * np.sin(o.elevation)) / (
        np.cos(o.dec) * np.cos(o.elevation)
    )
    expected = np.arctan2(sin_q, cos_q)
    # focal-plane up, (-1, 0, 0) in the boresight frame, on the sky
    up = -rotation_matrices(o.boresight_radec)[:, :, 0]
    north = np.stack(
        [-np.sin(o.dec) * np.cos(o.ra), -np.sin(o.dec) * np.sin(o.ra), np.cos(o.dec)], axis=1
    )
    east = np.stack([-np.sin(o.ra), np.cos(o.ra), 0 * o.ra], axis=1)
    found = np.arctan2((up * east).sum(1), (up * north).sum(1))
    assert np.abs(np.sin(found - expected)).max() < math.radians(0.5)
    assert np.cos(found - expected).min() > 0


def test_scan_across_right_ascension_zero_due_north_and_due_south_is_smooth(
    observe: Callable[..., Data],
) -> None:
    daisy = PointingDaisy(scan_duration="60 s", speed="1 arcmin/s")
    for target in ("0 deg 20 deg", "az 180 deg el 40 deg", "az 0 deg el 40 deg"):
        (o,) = observe(daisy, target=target, time="2024-11-25T00:30Z").observations
        for q in (o.boresight_azel, o.boresight_radec):
            # 1.15 arcmin/s at 100 Hz: 1.7e-6 rad of half angle per sample, some azimuth on top
            assert np.abs(np.diff(q, axis=0)).max() < 1e-5
    assert o.azimuth.min() < 0.01
    assert o.azimuth.max() > 2 * math.pi - 0.01


def test_pass_near_the_zenith(observe: Callable[..., Data], reference: Any) -> None:
    """A star that culminates 1 arcsec from the zenith: azimuth turns by 180 deg within a second;
    directions stay right.
    """
    overhead = CelestialTransform(GREEN_BANK, START, 0.0).icrs(
        np.array([0.0, 0.0, 1.0]), np.zeros(1)
    )[0]
    ra, dec = math.atan2(overhead[1], overhead[0]), math.asin(overhead[2]) + math.radians(1 / 3600)
    target = f"{ra!r} rad {dec!r} rad"
    (o,) = observe(
        PointingStare(scan_duration="60 s"), target=target, time=START.shifted(-30)
    ).observations
    assert o.elevation.max() > math.radians(90 - 1.1 / 3600)
    sky = unit_vectors(np.full(o.n_samples, ra), np.full(o.n_samples, dec))
    some = slice(None, None, 50)
    assert angle(rotation_matrices(o.boresight_radec)[:, :, 2], sky).max() < 1e-14
    up = rotation_matrices(o.boresight_azel)[some, :, 2]
    assert angle(up, reference.horizontal(sky[some], o.start, o.seconds[some])).max() < 1e-12
    # psi of radec follows: focal-plane up is the direction to the zenith as astropy sees it
    ray = np.array([-1e-4, 0, 1.0])
    ours = rotation_matrices(o.boresight_radec)[some] @ ray
    truth = reference.icrs(
        rotation_matrices(o.boresight_azel)[some] @ ray, o.start, o.seconds[some]
    )
    assert angle(ours, truth).max() < 1.2e-4 * 1e-4


def test_elevation_five_degrees(observe: Callable[..., Data], reference: Any) -> None:
    (o,) = observe(
        PointingStare(scan_duration="10 s", sample_rate="1 Hz"), target="az 123 deg el 5 deg"
    ).observations
    assert o.elevation == pytest.approx(math.radians(5), abs=1e-15)
    truth = reference.icrs(rotation_matrices(o.boresight_azel)[:, :, 2], o.start, o.seconds)
    assert angle(rotation_matrices(o.boresight_radec)[:, :, 2], truth).max() < 1e-12


def test_one_sample(observe: Callable[..., Data]) -> None:
    (o,) = observe(PointingStare(scan_duration="1 us")).observations
    assert (o.n_samples, o.seconds[0]) == (1, 0.0)
    assert [o.ra[0], o.dec[0]] == pytest.approx([math.radians(75), math.radians(20)], abs=1e-15)


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 86_399_999_999_999), st.integers(1, 500_000_000_000))
def test_only_the_instant_matters(since_midnight: int, shift: int) -> None:
    """The same instant, reached as start + dt from two starts: times near 1.8e9 s lose nothing."""
    early = Instant(Instant.parse("2027-01-15").nanoseconds + since_midnight)
    late = Instant(early.nanoseconds + shift)
    sky = random_directions(1, seed=5)
    one = CelestialTransform(GREEN_BANK, early, 500.0).horizontal(sky, np.array([shift / 1e9]))
    two = CelestialTransform(GREEN_BANK, late, 0.0).horizontal(sky, np.zeros(1))
    # 2e-12 rad of interpolation; a time rounded to the 0.24 us of a float64 POSIX second would move
    # it by 9e-12 rad
    assert angle(one, two).max() < 2e-12


def test_a_leap_second_is_a_second(reference: Any) -> None:
    """2016 ended with 23:59:60: seconds count on, they do not jump."""
    start = Instant.parse("2016-12-31T23:59:50Z")
    transform = CelestialTransform(GREEN_BANK, start, 20.0)
    seconds = np.array([0.0, 9.5, 10.5, 11.5, 20.0])
    sky = random_directions(5)
    assert (
        angle(transform.horizontal(sky, seconds), reference.horizontal(sky, start, seconds)).max()
        < 1e-11
    )


def test_tables_agree_where_they_overlap() -> None:
    from zonda.core.numerics import celestial

    final, latest = celestial._c04(58000, 60000), celestial._finals(58000, 60000)
    assert final is not None
    # UT1 to 0.1 ms and the pole to 1 mas
    assert final == pytest.approx(latest, abs=1e-3)
    end = next(mjd for mjd in range(60000, 90000) if celestial._c04(mjd, mjd) is None)
    assert celestial._finals(end, end + 30) is not None  # a year of predictions
    assert celestial._c04(end - 1, end) is None
    assert celestial._c04(30000, 30001) is None


def test_a_table_whose_lines_differ_in_length_is_read_whole(tmp_path: Path) -> None:
    from zonda.core.numerics.celestial import _rows

    def rows(lines: list[str], first: int, last: int) -> Any:
        (tmp_path / "table").write_text("# a table\n" + "".join(f"{line}\n" for line in lines))
        return _rows(str(tmp_path / "table"), first, last, bytes.split)

    even = [f"{day}.00 {day % 7}.5" for day in range(57000, 57100)]
    ragged = [line + " " * (k % 3) for k, line in enumerate(even)] + ["57100.00 "]
    for lines in (even, ragged):
        assert rows(lines, 57011, 57013).tolist() == [[3.5], [4.5], [5.5]]
        assert rows(lines, 57000, 57000).tolist() == [[6.5]]
        assert rows(lines, 57098, 57100) is None
        assert rows(lines, 56999, 57001) is None
        assert rows(lines[:20] + lines[21:], 57018, 57022) is None
    assert rows([], 57000, 57001) is None


def test_it_follows_astropy() -> None:
    from astropy.utils import iers

    mjd = np.array([57753.0, 57753.9, 57754.2, 60639.29])  # across the leap second of 2016
    ours = orientation(mjd)
    table = iers.IERS_B.open()
    assert ours.ut1_utc == pytest.approx(table.ut1_utc(mjd + 2400000.5).to_value("s"), abs=1e-9)
    assert ours.x == pytest.approx(table.pm_xy(mjd + 2400000.5)[0].to_value("rad"), abs=1e-13)
    assert ours.y == pytest.approx(table.pm_xy(mjd + 2400000.5)[1].to_value("rad"), abs=1e-13)


@pytest.mark.filterwarnings("ignore")  # astropy's own, of the same limits
@pytest.mark.parametrize("year", [1950, 2060])
def test_dates_beyond_every_table_work_and_say_so(
    year: int, observe: Callable[..., Data], reference: Any
) -> None:
    (o,) = observe(
        PointingStare(scan_duration="1 s"), time=f"{year}-11-25T12:00Z", target="az 0 deg el 45 deg"
    ).observations
    statement = {what: value for _, what, value in o.log}["Earth orientation"]
    assert statement == "none for this date: UT1 = UTC (within 0.9 s) and the mean pole assumed"
    truth = reference.icrs(rotation_matrices(o.boresight_azel)[:2, :, 2], o.start, o.seconds[:2])
    assert angle(rotation_matrices(o.boresight_radec)[:2, :, 2], truth).max() < 1e-9


def test_offline_with_every_socket_blocked() -> None:
    """A fresh interpreter in which any use of a socket fails."""
    code = """
import socket, sys
def refuse(*a, **k): raise SystemExit("network used")
socket.socket.connect = socket.getaddrinfo = socket.create_connection = refuse
from zonda.core.configuration.target import Target
from zonda.core.configuration.time import Instant
from zonda.core.site import Site
from zonda.core.numerics.celestial import CelestialTransform
import numpy as np
site = Site(name="s", latitude="38 deg", longitude="-79 deg")
for when in ("2024-11-25", "2027-06-01", "2050-01-01"):
    t = CelestialTransform(site, Instant.parse(when), 100.0)
    assert np.isfinite(t.horizontal(np.array([1.0, 0, 0]), np.arange(100.0))).all()
assert not [m for m in sys.modules if m.startswith(("astropy.coordinates", "astropy.time"))]
print("done")
"""
    run = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert run.stdout.strip() == "done", run.stderr
