import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from zonda.core.data import Data
from zonda.core.errors import PointingError
from zonda.core.flags import TURNAROUND, samples_in
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.numerics.sphere import unit_vectors
from zonda.operators.pointing.azimuth_scan import PointingBackAndForth

speeds = st.floats(1e-5, 1.0)
SCAN = {"throw": "2 deg", "speed": "0.5 deg/s", "acceleration": "1 deg/s2"}


def operator(throw: float, speed: float, acceleration: float) -> PointingBackAndForth:
    return PointingBackAndForth(
        throw=f"{throw!r} rad", speed=f"{speed!r} rad/s", acceleration=f"{acceleration!r} rad/s2"
    )


@settings(max_examples=50, deadline=None)
@given(st.floats(1e-4, 3.0), speeds, st.floats(1e-5, 1.0))
def test_acceleration_is_bounded_and_everything_is_smooth(
    throw: float, speed: float, acceleration: float
) -> None:
    scan = operator(throw, speed, acceleration)
    leg, turn = throw / speed, scan.sweep.turnaround
    # one leg's end, the whole turnaround, the next leg's beginning, in steps of a 1/4000 of the
    # turnaround
    t = leg + turn * np.linspace(-0.2, 1.2, 5601)
    t = t[(t > 0) & (t < 2 * leg + turn)]
    x, dt = scan.path(t)[0], turn * 1.4 / 5600
    velocity = np.diff(x) / dt
    a = np.diff(velocity) / dt
    scale = max(abs(x).max(), 1e-300)
    rounding = (
        8 * np.finfo(float).eps * scale / dt**2 + 4 * np.finfo(float).eps * t.max() * speed / dt**2
    )
    assert np.abs(a).max() <= acceleration * (1 + 1e-9) + rounding
    assert np.abs(a).max() >= acceleration * (1 - 1e-5) - rounding
    assert np.abs(velocity).max() <= speed * (1 + 1e-9) + rounding * dt
    # acceleration is continuous: sin^2(pi u) changes by at most pi per unit u
    assert np.abs(np.diff(a)).max() <= acceleration * math.pi * (dt / turn) * 1.01 + 2 * rounding
    assert np.abs(x).max() == pytest.approx(
        throw / 2 + speed**2 / acceleration * (1 + 4 / math.pi**2), rel=1e-6
    )


def test_legs_cross_the_throw_at_constant_speed() -> None:
    scan = PointingBackAndForth(**SCAN)
    t = np.arange(0.003, 60, 0.01)  # none where a leg ends: there a last bit decides
    x, y = scan.path(t)
    assert not y.any()
    steady = ~scan.sweep.turning(t)
    inside = np.abs(x) <= scan.throw / 2 * (1 + 1e-12)
    assert np.array_equal(steady, inside)
    both = steady[1:] & steady[:-1]
    assert np.abs(np.diff(x))[both] / 0.01 == pytest.approx(scan.speed, rel=1e-10)
    # period: two legs of 4 s and two turnarounds of 2 s
    assert scan.path(t + 12.0)[0] == pytest.approx(x, abs=1e-14)
    assert steady.mean() == pytest.approx(2 / 3, abs=2e-3)


@pytest.mark.parametrize("target", ["az 200 deg el 50 deg", "az 0 deg el 50 deg"])
def test_constant_elevation_about_the_target(target: str, observe: Callable[..., Data]) -> None:
    (o,) = observe(PointingBackAndForth(**SCAN, scan_duration="24 s"), target=target).observations
    assert np.ptp(o.elevation) < 1e-14
    azimuth = np.unwrap(-o.derotate("boresight_azel")[0])
    on_sky = np.diff(azimuth) * 100 * math.cos(math.radians(50))
    assert np.abs(on_sky).max() == pytest.approx(math.radians(0.5), rel=1e-9)
    middle = (azimuth.max() + azimuth.min()) / 2
    expected = math.radians(float(target.split()[1]))
    assert math.remainder(middle - expected, 2 * math.pi) == pytest.approx(0, abs=1e-5)
    assert azimuth[1] > azimuth[0]


def test_celestial_target_is_met_in_the_middle_of_the_scan(observe: Callable[..., Data]) -> None:
    (o,) = observe(PointingBackAndForth(**SCAN, scan_duration="100 s")).observations
    transform = CelestialTransform(o.site, o.start, 100.0)
    at = np.array([(o.seconds[0] + o.seconds[-1]) / 2])
    up = transform.horizontal(unit_vectors(*o.centre), at)[0]
    assert o.elevation == pytest.approx(math.asin(up[2]), abs=1e-12)
    azimuth = math.atan2(-up[1], up[0]) % (2 * math.pi)
    assert (o.azimuth.min() + o.azimuth.max()) / 2 == pytest.approx(azimuth, abs=1e-5)


def test_offsets_shift_azimuth_on_the_sky_and_elevation(observe: Callable[..., Data]) -> None:
    scan = {**SCAN, "scan_duration": "1 s", "target": "az 90 deg el 60 deg"}
    ((plain,), (moved,)) = (
        observe(PointingBackAndForth(**scan, offsets=o)).observations
        for o in ("none", [("1 deg", "2 deg")])
    )
    assert moved.elevation - plain.elevation == pytest.approx(math.radians(2), abs=1e-13)
    shift = moved.azimuth * math.cos(math.radians(62)) - plain.azimuth * math.cos(math.radians(60))
    centre = math.pi / 2 * (math.cos(math.radians(62)) - math.cos(math.radians(60)))
    assert shift - centre == pytest.approx(math.radians(1), abs=1e-13)


@pytest.mark.parametrize("jitter", ["0 s", "1 ms"])
def test_intervals_are_toasts(jitter: str, observe: Callable[..., Data]) -> None:
    """Scans and turnarounds share the samples; a throw ends where the azimuth turns; left to right
    is towards larger azimuth.
    """
    step = PointingBackAndForth(
        **SCAN, scan_duration="70.03 s", flag_turnarounds=True, jitter=jitter
    )
    (o,) = observe(step).observations
    inside = {name: samples_in(spans, o.seconds) for name, spans in o.intervals.items()}
    ways = [
        f"{kind}_{way}" for kind in ("scan", "turn", "throw") for way in ("leftright", "rightleft")
    ]
    assert set(inside) == {"scanning", "turnaround", "throw", *ways}
    np.testing.assert_array_equal(inside["turnaround"], (o.flags & TURNAROUND) != 0)
    np.testing.assert_array_equal(inside["scanning"], ~inside["turnaround"])
    assert inside["throw"].all()
    for whole, kind in (("scanning", "scan"), ("turnaround", "turn"), ("throw", "throw")):
        assert o.intervals[whole] == sorted(
            o.intervals[f"{kind}_leftright"] + o.intervals[f"{kind}_rightleft"]
        )
        assert not (inside[f"{kind}_leftright"] & inside[f"{kind}_rightleft"]).any()
    up = np.diff(np.unwrap(o.azimuth)) > 0
    both = inside["throw_leftright"][1:] & inside["throw_leftright"][:-1]
    assert up[both].all()  # between samples of one throw the azimuth does not turn
    assert not up[inside["throw_rightleft"][1:] & inside["throw_rightleft"][:-1]].any()
    assert (inside["scan_leftright"] <= inside["throw_leftright"]).all()
    first, second = o.intervals["turn_leftright"][0], o.intervals["turn_rightleft"][0]
    assert o.intervals["scan_leftright"][0][1] == first[0] < second[0]


def test_turnarounds_are_counted_and_flagged_on_demand(observe: Callable[..., Data]) -> None:
    (used,) = observe(PointingBackAndForth(**SCAN, scan_duration="12 s")).observations
    assert not used.flags.any()
    assert used.log.get("PointingBackAndForth", "samples in turnarounds, used") == pytest.approx(
        400, abs=4
    )
    (flagged,) = observe(
        PointingBackAndForth(**SCAN, scan_duration="12 s", flag_turnarounds=True)
    ).observations
    count = flagged.log.get("PointingBackAndForth", "samples in turnarounds, flagged")
    assert set(np.unique(flagged.flags)) == {0, TURNAROUND}
    assert np.count_nonzero(flagged.flags) == count
    assert flagged.flags.dtype == np.uint8


@pytest.mark.parametrize(
    ("throw", "target"), [("10 deg", "az 10 deg el 89 deg"), ("6 rad", "az 0 deg el 30 deg")]
)
def test_more_than_a_turn_of_azimuth_is_refused(
    throw: str, target: str, observe: Callable[..., Data]
) -> None:
    with pytest.raises(PointingError, match="more than a whole turn of azimuth"):
        observe(PointingBackAndForth(throw=throw), target=target)


@pytest.mark.parametrize(
    ("limit", "value", "message"),
    [
        (
            "speed_max",
            "0.4 deg/s",
            r"speed on the sky of 0.5 deg/s .*; GBT's largest speed on the sky is 0.4 deg/s",
        ),
        (
            "acceleration_max",
            "0.5 deg/s2",
            r"acceleration on the sky of 1 deg/s2 .*largest acceleration on the sky is 0.5 deg/s2",
        ),
    ],
)
def test_faster_than_the_telescope(
    limit: str, value: str, message: str, observe: Callable[..., Data]
) -> None:
    with pytest.raises(PointingError, match=message):
        observe(
            PointingBackAndForth(**SCAN, scan_duration="12 s"),
            target="az 0 deg el 45 deg",
            telescope={limit: value},
        )
    generous = {limit: {"speed_max": "0.51 deg/s", "acceleration_max": "1.01 deg/s2"}[limit]}
    observe(
        PointingBackAndForth(**SCAN, scan_duration="12 s"),
        target="az 0 deg el 45 deg",
        telescope=generous,
    )
