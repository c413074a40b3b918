"""The pipeline that is made for an instrument and a site."""

import math
from pathlib import Path

import numpy as np
import pytest

from zonda.core import registry
from zonda.core.errors import PointingError, ZondaError
from zonda.core.numerics.sphere import ARCMIN, ARCSEC
from zonda.plugins.forecast.default_pipeline import daisy, make, text

M2 = {"instrument": "mustang2", "site": "green_bank", "month": 11}


def operator(file, name):
    return next(o for o in file.operators if type(o).__name__ == name)


def test_daisy_of_mustang2_is_that_of_its_observers():
    scan = daisy(registry.instruments.create("mustang2"), math.radians(60), 8 * ARCMIN, 3600)
    # 0.35 sqrt(0.05 deg/s2 cos 60 deg x 4 arcmin) = 51.4 arcsec/s
    assert scan.speed == pytest.approx(51.4 * ARCSEC, rel=2e-3)
    assert scan.cut == pytest.approx(51.4 / (2.5 * 240), rel=2e-3)
    assert (scan.duration, scan.scans) == (600, 6)


def test_daisies_keep_within_limits():
    atlast = registry.instruments.create("atlast")
    assert daisy(atlast, 1.0, math.radians(0.5), 60).speed == pytest.approx(
        0.35 * math.sqrt(math.radians(1) * math.radians(0.25))
    )
    act = registry.instruments.create("act")
    narrow, wide = (daisy(act, math.radians(60), math.radians(a), 60) for a in (0.5, 10))
    assert narrow.speed == pytest.approx(math.radians(0.25))  # a radius per second
    assert wide.speed == pytest.approx(math.radians(0.5))  # half of 2 deg/s, times cos 60 deg
    apex = registry.instruments.create("apex")
    assert daisy(apex, 1.0, math.radians(0.5), 60).speed == pytest.approx(19 * ARCSEC * 25 / 5)


def test_short_and_long_times():
    camera = registry.instruments.create("mustang2")
    short, long = (daisy(camera, math.radians(60), 8 * ARCMIN, t) for t in (1.0, 1e6))
    assert short.scans == 1
    assert short.duration == pytest.approx(20 * 4 * ARCMIN / short.speed)
    assert (long.scans, long.duration) == (6, 600)


@pytest.mark.parametrize(
    ("site", "elevation"), [("green_bank", 45), ("llano_de_chajnantor", 70), ("south_pole", 50)]
)
def test_the_target_culminates_at_the_elevation(site, elevation):
    file = make(
        instrument="atlast", site=site, month=6, elevation=f"{elevation} deg", integration="10 min"
    )
    pipeline = file.pipeline()
    o = pipeline.point(file.scene(), {}, Path()).observations[0]
    assert np.degrees(o.elevation[o.n_samples // 2]) == pytest.approx(
        elevation, abs=0.3
    )  # the daisy's radius
    azimuth = np.degrees(o.azimuth[o.n_samples // 2])
    towards = {"green_bank": 180, "llano_de_chajnantor": 0}.get(
        site, azimuth
    )  # at the pole there is no culmination
    assert abs((azimuth - towards + 180) % 360 - 180) < 1  # 0.25 deg / cos 70 deg


def test_a_target_is_observed_when_it_culminates():
    file = make(**M2, target="83.633 deg 22.014 deg", integration="20 min")
    first, last = file.pipeline().point(file.scene(), {}, Path()).observations
    # 90 - 38.43 + 22.01 at culmination, found on a grid of 5 min: 0.3 deg
    assert np.degrees(first.elevation.max()) == pytest.approx(73.6, abs=0.5)
    assert np.degrees(last.elevation.min()) == pytest.approx(73.6, abs=0.8)


@pytest.mark.parametrize(("integration", "scans"), [("10 min", 1), ("2 h", 6)])
def test_a_target_near_the_zenith_is_observed_beside_it(integration, scans):
    """At 38.4 deg north a target at +38 deg culminates at 89.6 deg, found on a grid of 5 min."""
    with pytest.warns(UserWarning, match=r"culminates at 89\.5 deg.* earlier, below 79\.9"):
        file = make(**M2, target="83.633 deg 38 deg", integration=integration, area="10 arcmin")
    found = file.pipeline().point(file.scene(), {}, Path()).observations
    highest = max(np.degrees(o.elevation.max()) for o in found)
    # the daisy's radius is left below 80 deg; culminations are found on a grid of 5 min, 1 deg
    assert 78.5 < highest < 80
    assert len(found) == scans


def test_of_a_camera_that_cannot_look_high(monkeypatch):
    camera = registry.instruments.create("mustang2")
    telescope = camera.telescope.model_copy(update={"elevation_max": math.radians(60)})
    camera = camera.model_copy(update={"telescope": telescope})
    monkeypatch.setattr(registry.instruments, "create", lambda *name: camera)
    with pytest.warns(UserWarning, match="--target: the target culminates at 73"):
        file = make(**M2, target="83.633 deg 22.014 deg")
    assert "description: the target culminates at 73" in text(**M2, target="83.633 deg 22.014 deg")
    found = file.pipeline().point(file.scene(), {}, Path()).observations
    assert np.degrees(max(o.elevation.max() for o in found)) < 60


def test_weather():
    dry, wet = (make(**M2, quantile=q).scene().weather.pwv for q in (0.1, 0.9))
    assert (dry.quantile, wet.quantile) == (0.1, 0.9)
    assert make(**M2, pwv="7.7 mm").scene().weather.pwv.metres == pytest.approx(7.7e-3)
    assert make(**M2).scene().weather is None
    assert make(**M2).scene().time.datetime.month == 11


def test_settings_change_it():
    file = make(["PinkNoise.shared=0.8", "PointingDaisy.scans=2"], **M2)
    assert operator(file, "PinkNoise").shared == 0.8
    assert operator(file, "PointingDaisy").scans == 2
    assert operator(file, "BinMap").pixel == pytest.approx(8.5 * ARCSEC / 4, rel=5e-3)


def test_one_detector_has_no_common_mode(monkeypatch):
    single = registry.instruments.create("mustang2").model_copy(update={"detectors": 1})
    monkeypatch.setattr(registry.instruments, "create", lambda name: single)
    assert "CommonModeFilter" not in text(**M2)


@pytest.mark.parametrize(
    ("asked", "words"),
    [
        ({"instrument": "mustang3"}, "mustang"),
        ({"site": "nowhere"}, "nowhere"),
        ({"pwv": "7 mm", "quantile": 0.5}, "given twice"),
        ({"elevation": "50 deg", "target": "5h 20d"}, "of its own"),
        ({"elevation": "95 deg"}, "outside the limits"),
        ({"elevation": "90 deg"}, "azimuth axis"),
        ({"elevation": "89.9999 deg"}, "azimuth axis"),
        ({"elevation": "50"}, "--elevation: .*no unit"),
        ({"quantile": 1.5}, "outside the limits"),
        ({"month": 13}, "no month 13"),
        ({"integration": "-1 h"}, "not positive"),
        ({"area": "10 s"}, "--area: .*an angle"),
        ({"pwv": "100 mm"}, "--pwv"),
        ({"target": "az 180 deg el 60 deg"}, "moves over the sky"),
    ],
)
def test_refusals(asked, words):
    with pytest.raises(ZondaError, match=words):
        make(**{**M2, **asked})


def test_a_target_that_never_rises():
    with pytest.raises(PointingError, match="never rises"):
        make(**M2, target="0 deg -80 deg")
