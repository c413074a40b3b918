"""Scenes of astropy's objects, and loops over seeds."""

from __future__ import annotations

import sys
from datetime import UTC, datetime, timedelta, timezone

import astropy.units as u
import numpy as np
import pytest
from astropy.coordinates import AltAz, EarthLocation, SkyCoord
from astropy.io import fits
from astropy.time import Time

import zonda
from zonda.core.configuration.parameters import ParameterError
from zonda.plugins.checks.scenes import TARGET, camera, scene

BASE = {
    "site": "green_bank",
    "instrument": "mustang2",
    "time": "2024-11-25T07:00",
    "target": "75 deg 20 deg",
}


def test_targets_and_times_of_astropy():
    plain = zonda.Scene(**BASE)
    assert zonda.Scene(**BASE | {"target": SkyCoord(75 * u.deg, 20 * u.deg)}) == plain
    assert zonda.Scene(**BASE | {"time": Time("2024-11-25T07:00:00")}) == plain
    assert zonda.Scene(**BASE | {"time": Time("2024-11-25T07:00:00").tai}) == plain
    for moment in (
        datetime(2024, 11, 25, 7, tzinfo=UTC),
        datetime(2024, 11, 25, 2, tzinfo=timezone(timedelta(hours=-5))),
    ):
        assert zonda.Scene(**BASE | {"time": moment}) == plain
    galactic = zonda.Scene(
        **BASE | {"target": SkyCoord(75 * u.deg, 20 * u.deg).galactic}
    ).target.icrs()
    np.testing.assert_allclose(np.degrees(galactic), (75, 20), rtol=1e-12)
    horizontal = zonda.Scene(
        **BASE | {"target": SkyCoord(AltAz(az=180 * u.deg, alt=60 * u.deg))}
    ).target
    assert str(horizontal) == "az 180 deg el 60 deg"


def test_what_they_mean_comes_back_from_its_text():
    from zonda.core.configuration.target import Target
    from zonda.core.configuration.time import Instant

    made = zonda.Scene(
        **BASE | {"target": SkyCoord(75.123456789 * u.deg, 20 * u.deg), "time": Time.now()}
    )
    assert Target.parse(str(made.target)) == made.target
    assert Instant.parse(str(made.time)) == made.time


def test_a_place_on_the_earth():
    home = zonda.Scene(**BASE).site
    near = EarthLocation.from_geodetic(
        np.degrees(home.longitude) * u.deg, np.degrees(home.latitude) * u.deg, home.altitude * u.m
    )
    made = zonda.Scene(**BASE | {"site": near}).site
    assert made.latitude == pytest.approx(home.latitude, abs=1e-12)
    assert made.longitude == pytest.approx(home.longitude, abs=1e-12)
    assert made.altitude == pytest.approx(home.altitude, abs=1e-6)
    assert made.climatology == "green_bank"
    assert made.provenance == "astropy EarthLocation"
    again = type(made)(**made.model_dump(mode="json"))
    assert again == made
    higher = EarthLocation.from_geodetic(near.lon, near.lat, near.height + 300 * u.m)
    assert zonda.Scene(**BASE | {"site": higher}).site.climatology is None
    assert (
        zonda.Scene(
            **BASE | {"site": EarthLocation.from_geodetic(10 * u.deg, 46 * u.deg)}
        ).site.climatology
        is None
    )
    with pytest.raises(ParameterError, match="expected one place, got 2"):
        zonda.Scene(**BASE | {"site": EarthLocation.from_geodetic([1, 2] * u.deg, [3, 4] * u.deg)})


def test_another_scene_is_checked():
    first = zonda.Scene(**BASE, seed=7)
    other = first.replace(seed=8, target=SkyCoord(80 * u.deg, 10 * u.deg))
    assert (other.seed, first.seed, other.site, other.time) == (8, 7, first.site, first.time)
    np.testing.assert_allclose(np.degrees(other.target.icrs()), (80, 10))
    with pytest.raises(ParameterError, match="seed"):
        first.replace(seed=-1)
    with pytest.raises(ParameterError, match="sede"):
        first.replace(sede=1)


def test_a_loop_over_seeds_reads_convolves_and_compiles_once(tmp_path, monkeypatch):
    """Counted: calls that read or convolve the map or integrate the atmosphere's spectrum,
    compilations, and files opened.
    """
    from numba.core import event

    from zonda.operators.sky import convolved, sky_input

    path = tmp_path / "sky.fits"
    cards = {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CRPIX1": 32.5,
        "CRPIX2": 32.5,
        "CRVAL1": TARGET[0],
        "CRVAL2": TARGET[1],
    }
    header = fits.Header(
        cards | {"CDELT1": -2 / 3600, "CDELT2": 2 / 3600, "BUNIT": "K", "TEMPSCAL": "K_RJ"}
    )
    fits.PrimaryHDU(np.random.default_rng(3).normal(0, 1e-3, (64, 64)), header).writeto(path)
    calls = {"read_map": 0, "convolve": 0, "_on_own_pixels": 0}

    def counted(name):
        owners = {"read_map": sky_input, "_on_own_pixels": convolved.ConvolvedSky}
        owner = owners.get(name, convolved)
        original = getattr(owner, name)

        def call(*args, **kwargs):
            calls[name] += 1
            return original(*args, **kwargs)

        monkeypatch.setattr(owner, name, call)

    for name in calls:
        counted(name)
    compiled, opened, listening = event.RecordingListener(), [], []

    def hook(what, args):
        if listening and what == "open" and not str(args[0]).startswith("/proc"):
            opened.append(str(args[0]))

    sys.addaudithook(hook)  # for good: it can only be silenced
    steps = [
        zonda.PointingDaisy(scan_duration="4 s", scans=2),
        zonda.SkyMap(file=path),
        zonda.AtmosphereLayers(pwv="5 mm"),
        zonda.WhiteNoise(),
        zonda.PinkNoise(),
        zonda.Efficiency(),
        zonda.HighpassFilter(frequency="1 Hz"),
        zonda.CommonModeFilter(),
        zonda.BinMap(pixel="4 arcsec"),
    ]
    pipeline, where = (
        zonda.Pipeline(steps, runs={"noiseless": {"only": ["sky"]}}),
        scene(camera(19)),
    )
    maps = [pipeline.run(where.replace(seed=0), threads=1)["map"].signal]
    assert calls == {"read_map": 1, "convolve": 1, "_on_own_pixels": 1}
    event.register("numba:compile", compiled)
    listening.append(True)
    try:
        maps += [
            pipeline.run(where.replace(seed=seed), threads=1)["map"].signal for seed in (1, 2, 0)
        ]
    finally:
        listening.clear()
        event.unregister("numba:compile", compiled)
    assert calls == {"read_map": 1, "convolve": 1, "_on_own_pixels": 1}
    assert compiled.buffer == []
    assert [
        name for name in opened if "iers" not in name.lower()
    ] == []  # the Earth's orientation is looked up for each scan
    np.testing.assert_array_equal(maps[3], maps[0])
    assert not np.array_equal(maps[1], maps[0], equal_nan=True)
