import math
from collections.abc import Callable

import numpy as np
import pytest

from zonda.core.configuration.target import Target
from zonda.core.data import Data
from zonda.core.errors import ZondaError
from zonda.operators.pointing.base import PointingStare
from zonda.operators.pointing.daisy import PointingDaisy

ARCMIN = math.radians(1 / 60)
ARCSEC = ARCMIN / 60


def tangent_offsets(ra: np.ndarray, dec: np.ndarray, ra0: float, dec0: float) -> np.ndarray:
    """Gnomonic offsets (n,) complex, east + i north (Calabretta & Greisen 2002, equations 54 and
    12).
    """
    cos_c = math.sin(dec0) * np.sin(dec) + math.cos(dec0) * np.cos(dec) * np.cos(ra - ra0)
    x = np.cos(dec) * np.sin(ra - ra0) / cos_c
    y = (math.cos(dec0) * np.sin(dec) - math.sin(dec0) * np.cos(dec) * np.cos(ra - ra0)) / cos_c
    return x + 1j * y


def closed_form(t: np.ndarray, r: float, v: float) -> np.ndarray:
    """The paper's equations, as they stand there."""
    phi, n = v * t / r, 10 / math.pi
    outer = r * np.sin(phi) * np.exp(1j * phi / n)
    inner = 0.15 * r * np.sin(phi + math.pi / 2) * np.exp(1j * math.sqrt(2) * phi / n)
    return outer + inner


@pytest.mark.parametrize(
    "target", ["05h00m00s +20d00m00s", "galactic 120.5 deg 30 deg", "10 deg 88 deg"]
)
def test_offsets_are_the_papers_closed_form(target: str, observe: Callable[..., Data]) -> None:
    (o,) = observe(
        PointingDaisy(scan_duration="516 s", sample_rate="10 Hz"), target=target
    ).observations
    found = tangent_offsets(o.ra, o.dec, *Target.parse(target).icrs())
    expected = closed_form(o.seconds, 4 * ARCMIN, 50 * ARCSEC)
    # 1e-15 rad of rounding, amplified by 1 / cos(dec) = 30 where right ascension is compared
    assert np.abs(found - expected).max() < 1e-13
    assert o.centre == Target.parse(target).icrs()


def test_speed_and_radius() -> None:
    r, v = 4 * ARCMIN, 50 * ARCSEC
    daisy = PointingDaisy()
    k = np.arange(200)
    t, dt = k * math.pi * r / v, 1e-3
    x, y = daisy.path(t)
    # at phi = k pi the outer term is at the centre
    assert np.abs(np.hypot(x, y) / r - 0.15).max() < 1e-12
    (xa, ya), (xb, yb) = daisy.path(t - dt), daisy.path(t + dt)
    speed = np.hypot(xb - xa, yb - ya) / (2 * dt) / v
    # |1 + 0.15 sqrt(2)/n i exp(...)|: between 1 - 0.0666 and 1 + 0.0666
    assert 0.933 < speed.min() < 0.94
    assert 1.06 < speed.max() < 1.067
    # the outer term alone passes the centre at exactly v
    alone = PointingDaisy(inner=0)
    (xa, ya), (xb, yb) = alone.path(t - dt), alone.path(t + dt)
    assert np.hypot(xb - xa, yb - ya) / (2 * dt) / v == pytest.approx(np.ones(200), abs=1e-6)


def test_largest_radius_and_coverage() -> None:
    r = 4 * ARCMIN
    t = np.arange(0, 40_000, 0.05)
    x, y = PointingDaisy().path(t)
    reach = np.hypot(x, y).max() / r
    # sqrt(1 + 0.15^2) = 1.0112 where both daisies are at right angles
    assert 1.010 < reach <= math.hypot(1, 0.15) + 1e-12
    # after one 8.6 min scan every cell of 1 arcmin within the radius that a 4.2 arcmin field adds
    # to has been visited
    first = t < 516
    u, w = x[first][:, None] / ARCMIN, y[first][:, None] / ARCMIN
    cells = [(a, b) for a in range(-3, 4) for b in range(-3, 4) if math.hypot(a, b) <= 3]
    for a, b in cells:
        assert np.hypot(u - a, w - b).min() < 2.1


@pytest.mark.parametrize(
    ("parameter", "changed"),
    [("petals", 5.0), ("inner", 0.3), ("phase", "1 rad"), ("speed", "20 arcsec/s")],
)
def test_every_parameter_has_its_effect(parameter: str, changed: object) -> None:
    t = np.linspace(0, 60, 50)
    there = PointingDaisy(**{parameter: changed}).path(t)  # type: ignore[arg-type]
    assert np.hypot(*np.subtract(there, PointingDaisy().path(t))).max() > 1 * ARCSEC


def test_phase_is_a_later_start() -> None:
    t, later = np.linspace(0, 60, 50), PointingDaisy(phase="2 rad")
    shift = 2 * later.radius / later.speed
    assert np.allclose(later.path(t), PointingDaisy().path(t + shift), rtol=0, atol=1e-15)


def test_box_moves_by_its_side(observe: Callable[..., Data]) -> None:
    operator = PointingDaisy(
        scans=5, offsets="box", offset_size="1 arcmin", scan_duration="10 s", gap="20 s"
    )
    data = observe(operator)
    scans = data.observations
    centres = [
        tangent_offsets(o.ra, o.dec, *o.centre)
        - closed_form(o.seconds, operator.radius, operator.speed)
        for o in scans
    ]
    middle = np.array([c.mean() for c in centres])
    assert max(np.abs(c - m).max() for c, m in zip(centres, middle, strict=True)) < 1e-14
    assert np.abs(np.diff(middle)) == pytest.approx(np.full(4, ARCMIN), abs=1e-13)
    assert np.abs(middle[:4].mean()) < 1e-13
    assert middle[4] == pytest.approx(middle[0], abs=1e-13)
    assert [o.name for o in data.observations] == [f"scan-{k:03d}" for k in range(5)]
    assert [o.start.seconds_since(data.scene.time) for o in data.observations] == [
        30.0 * k for k in range(5)
    ]
    assert {o.centre for o in data.observations} == {Target.parse("75 deg 20 deg").icrs()}


def test_list_of_offsets_is_taken_in_turn(observe: Callable[..., Data]) -> None:
    offsets = [("1 arcmin", "0 arcsec"), ("0 arcsec", "-30 arcsec")]
    data = observe(PointingStare(scans=3, offsets=offsets, scan_duration="1 s"))
    found = [tangent_offsets(o.ra, o.dec, *o.centre)[0] for o in data.observations]
    assert found == pytest.approx([ARCMIN, -0.5j * ARCMIN, ARCMIN], abs=1e-14)


def test_horizontal_target(observe: Callable[..., Data]) -> None:
    """Offsets towards azimuth and zenith; the ICRS position follows."""
    (o,) = observe(PointingDaisy(scan_duration="60 s"), target="az 200 deg el 50 deg").observations
    found = tangent_offsets(o.azimuth, o.elevation, math.radians(200), math.radians(50))
    assert np.abs(found - closed_form(o.seconds, 4 * ARCMIN, 50 * ARCSEC)).max() < 1e-14
    drift = tangent_offsets(o.ra, o.dec, *o.centre)
    # the sky turns by 15 arcsec/s cos(dec): half of 60 s each way, and the daisy
    assert np.abs(drift).max() < (30 * 15.05 + 4.05 * 60) * ARCSEC
    assert np.abs(drift).max() > 300 * ARCSEC


def test_galactic_and_icrs_names_of_one_place_are_one_pointing(
    observe: Callable[..., Data],
) -> None:
    galactic = Target.parse("galactic 120.5 deg 30 deg")
    ra, dec = galactic.icrs()
    (a,), (b,) = (
        observe(PointingDaisy(scan_duration="5 s"), target=t).observations
        for t in (galactic, f"{ra!r} rad {dec!r} rad")
    )
    assert np.array_equal(a.boresight_radec, b.boresight_radec)


def test_own_target_wins_over_the_scenes(observe: Callable[..., Data]) -> None:
    data = observe(PointingStare(target="80 deg 30 deg", scan_duration="1 s"))
    assert data.observations[0].centre == Target.parse("80 deg 30 deg").icrs()


def test_stare_tracks_or_stands_still(observe: Callable[..., Data]) -> None:
    (tracked,) = observe(PointingStare(scan_duration="100 s")).observations
    assert np.ptp(tracked.ra) < 1e-14
    assert np.ptp(tracked.elevation) > 60 * ARCSEC
    (still,) = observe(
        PointingStare(scan_duration="100 s"), target="az 180 deg el 60 deg"
    ).observations
    assert np.ptp(still.boresight_azel, axis=0).max() == 0
    # at the meridian 100 s of UT1 are 1504.1 arcsec of hour angle
    middle = [(still.ra[0] + still.ra[-1]) / 2, (still.dec[0] + still.dec[-1]) / 2]
    assert still.ra[-1] - still.ra[0] == pytest.approx(99.99 * 15.041 * ARCSEC, rel=1e-3)
    assert still.centre == pytest.approx(middle, abs=1e-8)


def test_read_out_rate_and_number_of_samples(observe: Callable[..., Data]) -> None:
    (own,) = observe(PointingDaisy(scan_duration="0.5 s")).observations
    assert (own.n_samples, own.sample_rate) == (50, 100.0)
    (given,) = observe(PointingDaisy(scan_duration="0.5 s", sample_rate="30 Hz")).observations
    assert (given.n_samples, given.sample_rate) == (15, 30.0)
    assert np.array_equal(given.seconds, np.arange(15) / 30)
    assert given.start == given.start.shifted(0)


def test_a_second_pointing_operator_goes_on_after_the_first(observe: Callable[..., Data]) -> None:
    data = observe(PointingDaisy(scan_duration="10 s"))
    PointingStare(scan_duration="5 s", gap="3 s").observe(data)
    first, second = data.observations
    assert second.start.seconds_since(first.start) == 13.0
    assert (second.index, second.name) == (1, "scan-001")


def test_figures_reach_the_tally(observe: Callable[..., Data]) -> None:
    (o,) = observe(PointingDaisy()).observations
    told = {what: value for _, what, value in o.log}
    assert "of a beam (nodes every 600 s)" in told["interpolation error of the pointing"]
    assert told["Earth orientation"] == "IERS C04"
    (finer,) = observe(
        PointingDaisy(interpolation_error=2e-9)
    ).observations  # 8e-14 rad: 600 s would give 2.7e-13 rad
    told = {what: value for _, what, value in finer.log}
    assert "nodes every 300 s" in told["interpolation error of the pointing"]


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"scan_duration": "-8 min"}, "greater than 0"),
        ({"scan_duration": "0 s"}, "greater than 0"),
        ({"sample_rate": "0 Hz"}, "greater than 0"),
        ({"sample_rate": 100}, "no unit"),
        ({"scans": 0}, "at least 1"),
        ({"radius": "4 s"}, "is a unit of time"),
        ({"offsets": "circle"}, "'none' or 'box'"),
        ({"offsets": []}, "empty"),
        ({"offsets": [("1 rad", "0 rad")]}, "below 0.1 rad"),
        ({"offset_size": "2 arcmin"}, "set offsets: box with it"),
        ({"target": "Crab"}, "names of objects are not looked up"),
        ({"pahse": "1 rad"}, "unknown parameter 'pahse'"),
    ],
)
def test_bad_parameters_are_refused(wrong: dict[str, object], message: str) -> None:
    with pytest.raises(ZondaError, match=message):
        PointingDaisy(**wrong)  # type: ignore[arg-type]


def test_parameters_survive_a_dump() -> None:
    for operator in (
        PointingDaisy(),
        PointingDaisy(offsets=[("1 arcmin", "2 arcsec")], target="galactic 12 deg 3 deg"),
    ):
        assert PointingDaisy.model_validate_json(operator.model_dump_json()) == operator
