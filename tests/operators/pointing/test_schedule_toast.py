"""TOAST's own scans of a schedule: times, azimuths, elevations and rotations are ours within 1
arcsec.

`.ci/toast` runs this in an environment with TOAST (the extra ``toast``), where it may not be
skipped (ZONDA_TOAST=required).
"""

from __future__ import annotations

import datetime as dt

import numpy as np
import pytest

from zonda.core.data import Data
from zonda.core.flags import SUN_CLOSE, SUN_UP
from zonda.core.numerics.quaternions import conjugate, multiply
from zonda.core.scene import Scene
from zonda.operators.pointing.schedule import PointingSchedule

from ...scenes import skip_without

pytestmark = [pytest.mark.toast, pytest.mark.filterwarnings("ignore")]

skip_without("toast")

import astropy.units as u
import toast
import toast.instrument
import toast.instrument_sim
import toast.ops
import toast.schedule

ARCSEC = np.radians(1 / 3600)
ROWS = [  # duration, azimuths, elevation, rotation
    (420, 120, 150, 50, 0),
    (300, 125, 160, 48, 45),
    (247, 345, 375, 55, -45),
    (333, 200, 240, 60, 0),
    (181, 40, 75, 40, 90),
    (260, 100, 130, 50, 30),
    (301, -30, 10, 45, 0),
    (299, 179.5, 186, 52, -60),
]


def schedule(hour):
    start, rows = dt.datetime(2025, 3, 1, hour, 10, tzinfo=dt.UTC), []
    for k, (duration, low, high, elevation, rotation) in enumerate(ROWS):
        stop = start + dt.timedelta(seconds=duration)
        angles = (angle * u.deg for angle in (rotation, low, high, elevation))
        rows.append(toast.schedule.GroundScan(f"patch{k % 3}", start, stop, *angles, k // 3, k % 3))
        start = stop + dt.timedelta(seconds=47)
    return toast.schedule.GroundSchedule(
        rows, "atacama", "LAT", -22.96 * u.deg, -67.79 * u.deg, 5200 * u.m
    )


@pytest.mark.parametrize("name", ["night.ecsv", "night.txt"])
@pytest.mark.parametrize(("nods", "hour"), [((), 6), ((1.0, -1.0, 0.0), 10)])
def test_scans_are_toasts(tmp_path, name, nods, hour):
    """At 10:10 UTC the Sun is about to rise in the east."""
    made = schedule(hour)
    made.write(str(tmp_path / name))
    site = toast.instrument.GroundSite("atacama", made.site_lat, made.site_lon, made.site_alt)
    plane = toast.instrument_sim.fake_hexagon_focalplane(
        n_pix=1, sample_rate=40 * u.Hz, psd_net=1 * u.K * u.s**0.5
    )
    theirs = toast.Data(toast.Comm())
    toast.ops.SimGround(
        telescope=toast.instrument.Telescope("LAT", focalplane=plane, site=site),
        schedule=made,
        scan_rate_az=1.2 * u.deg / u.s,
        scan_accel_az=0.8 * u.deg / u.s**2,
        elnods=[n * u.deg for n in nods],
        elnod_start=bool(nods),
    ).apply(theirs)
    place = {"name": "a", "latitude": "-22.96 deg", "longitude": "-67.79 deg", "altitude": "5200 m"}
    ours = Data(Scene(site=place, instrument="act_150ghz", time="2025-03-01T06:00", seed=1))
    PointingSchedule(
        schedule=tmp_path / name,
        speed="1.2 deg/s",
        acceleration="0.8 deg/s2",
        turnaround="constant_acceleration",
        sample_rate="40 Hz",
        elevation_nods=[f"{n} deg" for n in nods],
        check_limits="warn",
    ).observe(ours)
    assert len(theirs.obs) == len(ours.observations) == 8
    suns = [np.unique(o.flags & (SUN_UP | SUN_CLOSE)) for o in ours.observations]
    assert (set(np.concatenate(suns)) > {0}) == (hour == 10)
    for a, b in zip(theirs.obs, ours.observations, strict=True):
        n = min(b.n_samples, a.n_local_samples)
        assert abs(b.n_samples - a.n_local_samples) <= 1
        times = b.start.posix + b.seconds
        assert (
            np.abs(times[:n] - a.shared["times"].data[:n]).max() < 1e-6
        )  # 0.24 us is a float64's step today
        azimuth = np.angle(np.exp(1j * (b.azimuth[:n] - a.shared["azimuth"].data[:n])))
        assert np.abs(azimuth).max() < ARCSEC
        assert np.abs(b.elevation[:n] - a.shared["elevation"].data[:n]).max() < ARCSEC
        differ = (b.flags[:n] ^ a.shared["flags"].data[:n]) & (SUN_UP | SUN_CLOSE) != 0
        assert (
            np.count_nonzero(differ) < 0.005 * n
        )  # pyephem's Sun: some arcsec, or half a second of its way
        apart = multiply(conjugate(b.boresight_azel[:n]), a.shared["boresight_azel"].data[:n])
        assert 2 * np.linalg.norm(apart[:, :3], axis=1).max() < ARCSEC
        for interval in ("throw_leftright", "scan_rightleft", "turn_leftright", "turn_rightleft"):
            begins = np.array([s for s, _ in b.intervals[interval]]) + b.start.posix
            expected = np.array(
                [
                    i.start.item() if hasattr(i.start, "item") else i.start
                    for i in a.intervals[interval]
                ]
            )
            assert len(begins) == len(expected)
            # ours begin with a sample; TOAST lets its first throw begin before the first sample
            assert np.abs(begins - expected)[1:].max() < 0.0251
