"""Flags and intervals of the Sun: against astropy, at its rising, at the edge of its
neighbourhood.
"""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, get_sun
from astropy.time import Time

from zonda.core.data import Data
from zonda.core.flags import EXCLUDE_SAMPLE, SUN_CLOSE, SUN_UP, samples_in
from zonda.core.scene import Scene
from zonda.operators.pointing.azimuth_scan import PointingBackAndForth

SITE = {"name": "a", "latitude": "-22.96 deg", "longitude": "-67.79 deg", "altitude": "5200 m"}
SCAN = {
    "throw": "20 deg",
    "speed": "1 deg/s",
    "acceleration": "1 deg/s2",
    "sample_rate": "1 Hz",
    "check_limits": "warn",
}

pytestmark = pytest.mark.filterwarnings("ignore:.*samples per FWHM")


def scan(time, target, duration="40 min"):
    scene = Scene(site=SITE, instrument="act_150ghz", time=time, target=target, seed=1)
    data = Data(scene)
    PointingBackAndForth(scan_duration=duration, **SCAN).observe(data)
    return data.observations[0]


def sun(observation):
    """(n,) elevation and distance from the boresight [deg] by astropy."""
    place = EarthLocation(lat=-22.96 * u.deg, lon=-67.79 * u.deg, height=5200 * u.m)
    when = Time(observation.start.posix + observation.seconds, format="unix")
    frame = AltAz(obstime=when, location=place)
    found = get_sun(when).transform_to(frame)
    x, y, z, w = observation.boresight_azel.T
    north, west, up = 2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)
    towards = np.stack([north, -west, up])
    alt, az = found.alt.rad, found.az.rad
    there = np.stack([np.cos(alt) * np.cos(az), np.cos(alt) * np.sin(az), np.sin(alt)])
    return np.degrees(alt), np.degrees(np.arccos(np.clip((towards * there).sum(axis=0), -1, 1)))


@pytest.mark.parametrize(
    ("target", "close"), [("az 118 deg el 45 deg", True), ("az 270 deg el 50 deg", False)]
)
def test_it_rises_and_is_near_as_astropy_says(target, close):
    """2025-01-10 at 5200 m: it rises between 9:20 and 10:00 UTC. One sample of 1 s is 15 arcsec of
    the Sun's way.
    """
    observation = scan(
        "2025-01-10T09:25", {"az": target.split()[1] + " deg", "el": target.split()[4] + " deg"}
    )
    elevation, distance = sun(observation)
    up, near = (observation.flags & bit != 0 for bit in (SUN_UP, SUN_CLOSE))
    assert 0 < up.mean() < 1
    unsure = abs(elevation) < 0.01  # TOAST's rule, and astropy's iers tables, to some arcsec
    np.testing.assert_array_equal(up[~unsure], (elevation > 0)[~unsure])
    unsure = abs(distance - 45) < 0.01
    np.testing.assert_array_equal(near[~unsure], (distance < 45)[~unsure])
    assert (0 < near.mean() < 1) == close
    for name, inside in (("sun_up", up), ("sun_close", near)):
        found = samples_in(observation.intervals.get(name, []), observation.seconds)
        assert np.count_nonzero(found != inside) <= 1  # the last sample (see core.flags)
    assert not (observation.flags & EXCLUDE_SAMPLE).any()
    assert observation.good_samples.all()


def test_at_night_there_is_nothing():
    observation = scan("2025-01-10T04:00", {"az": "0 deg", "el": "50 deg"}, "1 min")
    assert not observation.flags.any()
    assert not {"sun_up", "sun_close"} & observation.intervals.keys()
