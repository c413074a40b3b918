import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zonda.core.data import Data
from zonda.core.errors import PointingError
from zonda.core.flags import TURNAROUND
from zonda.core.instrument import hexagonal_packing
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.numerics.sphere import angles, unit_vectors
from zonda.core.registry import instruments
from zonda.core.scene import Scene
from zonda.operators.pointing.raster import PointingRaster, Rows

ARCMIN = math.radians(1 / 60)
SCAN = {
    "width": "10 arcmin",
    "height": "4 arcmin",
    "spacing": "1 arcmin",
    "speed": "1 arcmin/s",
    "acceleration": "1 arcmin/s2",
}
ROWS = Rows(10 * ARCMIN, ARCMIN, ARCMIN, False, -5 * ARCMIN, ARCMIN, 5)


def positive(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(math.log(low), math.log(high)).map(math.exp)


@settings(max_examples=100, deadline=None)
@given(
    positive(1e-4, 0.3),
    positive(1e-5, 0.1),
    st.integers(1, 9),
    positive(1e-5, 0.1),
    positive(1e-6, 0.1),
    st.booleans(),
)
def test_turnarounds_keep_speed_and_acceleration(
    width: float, spacing: float, n: int, speed: float, acceleration: float, smooth: bool
) -> None:
    rows = Rows(width, speed, acceleration, smooth, -width / 2, spacing, n)
    points = 4000
    u = np.linspace(0, 1, points + 1)
    x, y = rows.offsets(rows.leg + rows.turnaround * np.clip(u, 1e-9, 1 - 1e-9))
    step = rows.turnaround / points
    reach = max(abs(x).max(), abs(y).max())
    noise = (
        8 * np.finfo(float).eps * reach + 2e-9 * speed * rows.turnaround
    )  # rounding, and where the first and last point stand
    velocity = np.hypot(np.diff(x), np.diff(y)) / step
    assert velocity.max() <= speed * (1 + 1e-9) + noise / step
    rate = np.hypot(np.diff(x, 2), np.diff(y, 2)) / step**2
    assert rate.max() <= acceleration * (1 + 1e-9) + 4 * noise / step**2
    quick = spacing * (n > 1) * 2 / speed < rows.turnaround * (
        1 - 1e-9
    )  # the acceleration, not the speed, sets T
    if not smooth and quick:  # the shortest such turnaround: the limit is reached
        inside = np.delete(
            rate, [0, points // 2 - 1, points - 2]
        )  # the step is the mean across the reversal there
        assert inside.max() >= acceleration * (1 - 1e-9) - 4 * noise / step**2


def test_rows_are_straight_evenly_spaced_and_crossed_at_constant_speed_in_both_directions() -> None:
    step = ROWS.leg + ROWS.turnaround
    passed = []
    for number in range(20):
        t = number * step + ROWS.leg * np.linspace(1e-6, 1 - 1e-6, 101)
        x, y = ROWS.offsets(t)
        assert not ROWS.turning(t).any()
        assert np.ptp(y) == 0
        velocity = np.diff(x) / np.diff(t)
        assert np.abs(velocity) == pytest.approx(ARCMIN, rel=1e-9)
        assert np.abs(x).max() == pytest.approx(5 * ARCMIN, rel=1e-5)
        passed.append((round(y[0] / ARCMIN, 9), int(np.sign(velocity[0]))))
    up = [(-2, 1), (-1, -1), (0, 1), (1, -1), (2, 1)]
    down = [(place, -way) for place, way in up[::-1]]
    assert passed == (up + down) * 2
    # T^2 = (4 + sqrt(16 + 4 16)) / 2, v = s = a = 1: b v = 2, c s = 4
    assert ROWS.turnaround == pytest.approx(math.sqrt((4 + math.sqrt(80)) / 2), rel=1e-12)
    assert ROWS.pass_time == pytest.approx(5 * 10 + 4 * ROWS.turnaround, rel=1e-12)
    one = replace(ROWS, n=1)
    assert one.turnaround == pytest.approx(2.0)  # 2 v / a
    assert replace(one, smooth=True).turnaround == pytest.approx(4.0)
    assert not one.offsets(np.linspace(0, 50, 500))[1].any()


def offsets(o: Any) -> tuple[Any, Any]:
    """Gnomonic offsets [arcmin] east and north of an observation's centre."""
    ra, dec = o.centre
    d = unit_vectors(o.ra, o.dec)
    east = np.array([-math.sin(ra), math.cos(ra), 0.0])
    north = np.cross(unit_vectors(ra, dec), east)
    ahead = d @ unit_vectors(ra, dec)
    return d @ east / ahead / ARCMIN, d @ north / ahead / ARCMIN


@pytest.mark.parametrize("angle", [0.0, 30.0, 90.0, 135.0])
def test_rows_lie_at_the_position_angle_on_the_sky(
    angle: float, observe: Callable[..., Data]
) -> None:
    (o,) = observe(
        PointingRaster(**SCAN, position_angle=f"{angle} deg", scan_duration="61 s")
    ).observations
    x, y = offsets(o)
    sine, cosine = math.sin(math.radians(angle)), math.cos(math.radians(angle))
    along, across = x * sine + y * cosine, y * sine - x * cosine
    expected = ROWS.offsets(o.seconds)
    assert along == pytest.approx(expected[0] / ARCMIN, abs=1e-6)
    assert across == pytest.approx(expected[1] / ARCMIN, abs=1e-6)


def test_cross_hatch_covers_the_same_field_at_right_angles(observe: Callable[..., Data]) -> None:
    raster = PointingRaster(
        **SCAN, angles="cross_hatch", scans=3, scan_duration="90 s", flag_turnarounds=True
    )
    first, second, third = observe(raster).observations
    for o, height in ((first, 4.0), (second, 4.0), (third, 4.0)):
        x, y = (values[o.good_samples] for values in offsets(o))
        assert abs(x).max() <= 5 + 1e-6
        assert abs(y).max() <= height / 2 + 1e-6
    assert (
        np.unique(np.round(offsets(first)[1][first.good_samples], 5)).size == 5
    )  # rows in right ascension
    x, _ = offsets(second)
    assert np.allclose(
        x[second.good_samples], np.round(x[second.good_samples]), atol=1e-5
    )  # columns, 1 arcmin apart


def test_angles_take_turns(observe: Callable[..., Data]) -> None:
    raster = PointingRaster(**SCAN, angles=["0 deg", "60 deg"], scans=3, scan_duration="61 s")
    found = []
    for o in observe(raster).observations:
        x, y = offsets(o)
        found.append(math.degrees(math.atan2(x[800] - x[0], y[800] - y[0])))
    assert found == pytest.approx([90, 150, 90], abs=1e-4)


def test_horizontal_axes_follow_the_target(observe: Callable[..., Data]) -> None:
    (o,) = observe(PointingRaster(**SCAN, axes="horizontal", scan_duration="100 s")).observations
    track = CelestialTransform(o.site, o.start, 100.0).horizontal(
        unit_vectors(*o.centre), o.seconds
    )
    longitude, elevation = angles(track)
    x, y = ROWS.offsets(o.seconds)
    # the gnomonic projection inverted (Calabretta & Greisen 2002)
    azimuth = np.remainder(o.azimuth + longitude + np.pi, 2 * np.pi) - np.pi
    assert np.tan(azimuth) == pytest.approx(
        x / (np.cos(elevation) - y * np.sin(elevation)), abs=1e-9
    )
    up = (np.sin(elevation) + y * np.cos(elevation)) / np.sqrt(1 + x * x + y * y)
    assert np.sin(o.elevation) == pytest.approx(up, abs=1e-9)


def test_turnarounds_are_flagged_on_request_and_counted(observe: Callable[..., Data]) -> None:
    (o,) = observe(
        PointingRaster(**SCAN, scan_duration="100 s", flag_turnarounds=True)
    ).observations
    turning = ROWS.turning(o.seconds)
    assert np.array_equal(o.flags == TURNAROUND, turning)
    assert ("samples in turnarounds, flagged", int(turning.sum())) in [
        (what, n) for _, what, n in o.log.counts()
    ]
    covered = sum(stop - start for start, stop in o.intervals["scanning"])
    assert covered == pytest.approx((~turning).sum() / o.sample_rate, abs=0.05)
    (o,) = observe(PointingRaster(**SCAN, scan_duration="100 s")).observations
    assert not o.flags.any()


@pytest.mark.parametrize(
    "camera",
    [
        "mustang2",
        "atlast",
        "atlast_full",
        "lmt",
        "act",
        "so_lat",
        "so_sat",
        "spt",
        "ccat",
        "cmb_s4",
        "apex",
        "hexagonal_array",
    ],
)
@pytest.mark.parametrize("axes", ["sky", "horizontal"])
def test_defaults_suit_every_camera(
    camera: str, axes: str, recwarn: pytest.WarningsRecorder
) -> None:
    instrument = instruments.create(camera)
    few = instrument.varied(detectors=min(instrument.detectors, 7))
    where = {
        "site": few.telescope.site or "green_bank",
        "time": "2024-11-25T07:00",
        "target": "az 120 deg el 60 deg",
    }
    data = Data(Scene(instrument=few, **where))
    lines = PointingRaster(axes=axes).check(data)  # raises beyond a limit
    assert not [
        w for w in recwarn if "samples per FWHM" in str(w.message) or "before all" in str(w.message)
    ]
    assert lines[-1].startswith("raster: 5 rows of ")


def test_coverage_is_uniform_inside() -> None:
    """Rows a quarter of a round field apart: the ripple across the rows is 4 J_1(4 pi) / (4 pi) =
    5.1 %, as amplitude.
    """
    x, y = hexagonal_packing(20_000)
    field = 2 * np.hypot(x, y).max()
    x, y = x / field, y / field  # a disc of diameter 1
    turn = math.radians(11)  # the lattice is not aligned with the rows
    across = y * math.cos(turn) + x * math.sin(turn)
    rows = Rows(3.0, 1.0, 1.0, False, -1.5, 0.25, 17)
    middles = (np.arange(rows.n) - (rows.n - 1) / 2) * rows.spacing
    counts, _ = np.histogram(
        (middles[:, None] + across).ravel(), bins=40, range=(-1.0, 1.0)
    )  # 1/5 of the spacing
    bessel = -0.1589  # J_1(4 pi)
    # a bin averages the wave over 1/5 of its period: sin(pi / 5) / (pi / 5) = 0.935
    ripple = abs(4 * bessel / (4 * math.pi)) * 0.935
    # 20 000 points on a lattice in bins of 1/20 of the field: 17 x 1000 each, lattice noise well
    # below 0.5 %
    assert counts.std() / counts.mean() == pytest.approx(ripple / math.sqrt(2), abs=0.005)


def test_beyond_the_telescope_a_slower_one_is_proposed(observe: Callable[..., Data]) -> None:
    limits = {"azimuth_speed_max": "1 arcmin/s", "azimuth_acceleration_max": "2 arcmin/s2"}
    with pytest.raises(
        PointingError, match=r"reaches an? (speed|acceleration) of the azimuth axis"
    ) as err:
        observe(PointingRaster(**SCAN, axes="horizontal", scan_duration="90 s"), telescope=limits)
    assert "this would fit: " in err.value.cure
    slower = SCAN | {"speed": "10 arcsec/s"}
    observe(PointingRaster(**slower, axes="horizontal", scan_duration="400 s"), telescope=limits)


def test_a_limit_of_jerk_makes_turnarounds_smooth(observe: Callable[..., Data]) -> None:
    limits = {"azimuth_jerk_max": "0.2 deg/s3", "elevation_jerk_max": "0.2 deg/s3"}
    observe(PointingRaster(**SCAN, scan_duration="90 s"), telescope=limits)
    with pytest.raises(PointingError, match="jerk"):
        observe(PointingRaster(**SCAN, scan_duration="90 s", smooth=False), telescope=limits)


def test_a_raster_that_is_cut_off_is_told(observe: Callable[..., Data]) -> None:
    with pytest.warns(
        UserWarning,
        match=(
            "scan-000 ends before all 5 rows are crossed: they take 60.18 s, scan_duration is 30 s"
        ),
    ):
        observe(PointingRaster(**SCAN, scan_duration="30 s"))


@pytest.mark.parametrize("smooth", [False, True])
def test_how_far_turnarounds_reach(smooth: bool) -> None:
    rows = replace(ROWS, smooth=smooth)
    x, _ = rows.offsets(rows.leg + rows.turnaround * np.linspace(0, 1, 2001))
    assert x.max() - rows.width / 2 == pytest.approx(
        rows.overshoot, rel=1e-12
    )  # u = 1/2 is one of the points
    single = replace(rows, n=1, speed=replace(rows, n=1).speed_within)  # no step to the side
    assert single.overshoot == pytest.approx(single.width, rel=1e-12)


def test_turnarounds_beyond_a_rows_length_are_told(
    observe: Callable[..., Data], recwarn: pytest.WarningsRecorder
) -> None:
    fast = SCAN | {
        "speed": "4 arcmin/s"
    }  # v^2 / (2 a) = 8 arcmin, of 10: with the step a little more
    observe(PointingRaster(**fast, scan_duration="100 s"))
    assert not [w for w in recwarn if "turnarounds reach" in str(w.message)]
    faster = SCAN | {
        "speed": "5 arcmin/s"
    }  # 12.5 arcmin and the step; T = 10 s, against 2 s for a row
    with pytest.warns(
        UserWarning,
        match=(
            r"reach 0.2085 deg beyond rows of 0.1667 deg and take 83 % .* scan at 268.3 arcsec/s or"
            r" less"
        ),
    ):
        observe(PointingRaster(**faster, scan_duration="100 s"))
