import math
import re
from collections.abc import Callable

import numpy as np
import pytest

from zonda.core.configuration.time import Instant
from zonda.core.data import Data
from zonda.core.errors import PointingError
from zonda.core.instrument import Telescope
from zonda.operators.pointing.base import PointingStare
from zonda.operators.pointing.daisy import PointingDaisy
from zonda.operators.pointing.limits import LargestMotion
from zonda.operators.pointing.motion import LargestDerivative


def test_target_below_the_horizon_says_when_it_is_up(observe: Callable[..., Data]) -> None:
    daisy = PointingDaisy(scan_duration="60 s")
    with pytest.raises(PointingError) as caught:
        observe(daisy, time="2024-11-25T18:00Z")
    error = caught.value
    assert "PointingDaisy, scan 0 from 2024-11-25T18:00:00Z" in error.place
    assert "target 'icrs 75 deg 20 deg' goes down to elevation -31.6" in error.message
    assert "GBT reaches 5 deg to 90 deg" in error.message
    times = re.findall(r"\d{4}-\d\d-\d\dT[\d:]+Z", error.cure)
    assert len(times) == 2
    rise, set_ = (Instant.parse(t) for t in times)
    # the advice is right: all is well from the first to (60 s before) the last, and not two minutes
    # outside
    for good in (rise, set_.shifted(-60)):
        (o,) = observe(daisy, time=good).observations
        assert o.elevation.min() >= math.radians(5)
    for bad in (rise.shifted(-120), set_.shifted(120)):
        with pytest.raises(PointingError):
            observe(daisy, time=bad)


def test_target_that_never_rises(observe: Callable[..., Data]) -> None:
    with pytest.raises(PointingError) as caught:
        observe(PointingDaisy(), target="05h00m00s -80d00m00s")
    # culminates at 90 - 38.43 - 80 deg, apart from precession
    assert re.search(
        r"at Green Bank it never rises far enough above 5 deg \(highest -28\.\d+ deg\)",
        caught.value.cure,
    )


def test_target_never_low_enough(observe: Callable[..., Data]) -> None:
    with pytest.raises(PointingError, match="within the limits at no time of the next 24 h"):
        observe(
            PointingStare(scan_duration="1 s"),
            target="0 deg 90 deg",
            telescope={"elevation_max": "30 deg"},
        )


def test_above_the_upper_limit(observe: Callable[..., Data]) -> None:
    with pytest.raises(
        PointingError, match=r"goes up to elevation 6\d\.\d+ deg; GBT reaches 5 deg to 60 deg"
    ) as caught:
        observe(PointingStare(), telescope={"elevation_max": "60 deg"})
    assert caught.value.cure.count("from 2024-11-2") == 2  # before and after culmination


def test_fixed_direction_outside_the_limits(observe: Callable[..., Data]) -> None:
    with pytest.raises(
        PointingError,
        match=r"down to elevation 2.00 deg.*\n.*choose an elevation from 5 deg to 90 deg",
    ):
        observe(PointingStare(), target="az 10 deg el 2 deg")


def test_a_scan_that_leaves_the_limits_on_its_way(observe: Callable[..., Data]) -> None:
    """The target itself is inside; the daisy's petals are not."""
    observe(PointingStare(scan_duration="60 s"), target="az 0 deg el 5.01 deg")
    with pytest.raises(PointingError, match=r"down to elevation 4.9\d deg"):
        observe(PointingDaisy(scan_duration="60 s"), target="az 0 deg el 5.01 deg")


def test_no_target_at_all(observe: Callable[..., Data]) -> None:
    with pytest.raises(
        PointingError, match=r"there is no target\n  = give the scene or this operator a target"
    ):
        observe(PointingDaisy(), target=None)


def test_scan_faster_than_the_telescope(observe: Callable[..., Data]) -> None:
    with pytest.raises(
        PointingError,
        match=(
            r"reaches a speed on the sky of \d\d(\.\d+)? arcsec/s .*largest speed on the sky is 30"
            r" arcsec/s"
        ),
    ):
        observe(PointingDaisy(scan_duration="60 s"), telescope={"speed_max": "30 arcsec/s"})
    with pytest.raises(
        PointingError,
        match=(
            r"reaches an acceleration on the sky of .*; GBT's largest acceleration on the sky is 1"
            r" arcsec/s2"
        ),
    ):
        observe(PointingDaisy(scan_duration="60 s"), telescope={"acceleration_max": "1 arcsec/s2"})
    # 53.4 arcsec/s of daisy and 15 arcsec/s of sky
    observe(
        PointingDaisy(scan_duration="60 s"),
        telescope={"speed_max": "70 arcsec/s", "acceleration_max": "40 arcsec/s2"},
    )


def test_tracking_counts_as_motion(observe: Callable[..., Data]) -> None:
    with pytest.raises(PointingError, match="largest speed on the sky is 10 arcsec/s"):
        observe(PointingStare(scan_duration="10 s"), telescope={"speed_max": "10 arcsec/s"})
    (o,) = observe(
        PointingStare(scan_duration="10 s"),
        target="az 0 deg el 45 deg",
        telescope={"speed_max": "1 arcsec/s"},
    ).observations
    assert np.ptp(o.azimuth) == 0


def test_an_axis_that_stands_still_is_not_said_to_move():
    """What rounding leaves of an elevation that is constant is no speed."""
    moved = LargestMotion(Telescope(name="dish", diameter="6 m", elevation_speed_max="1 deg/s"))
    moved.add(
        "scan",
        {
            ("azimuth", 1): LargestDerivative(0.02, 0, 1, 0),
            ("elevation", 1): LargestDerivative(3e-14, 0, 1, 0),
        },
    )
    assert moved.statements() == [
        ("largest speed of the axes", "azimuth 1.146 deg/s, elevation 0 arcsec/s (0 % of 1 deg/s)"),
    ]
