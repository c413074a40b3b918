"""No parameter of a scene, site, instrument, telescope, band or noise model is accepted and then
ignored: each is changed alone, and what a short run makes changes with it, or the run is refused.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

import zonda
from zonda.core.errors import ZondaError
from zonda.core.registry import noise_models
from zonda.core.site import Site

from .parameters import SCAN, SHORT, instrument, make, outcome, same, scene

REFUSED = "refused"

WHOLE = ["AtmosphereLayers", "WhiteNoise", "PinkNoise", "Efficiency", "BinMap"]
SAID = {"name", "description", "provenance"}
"""Texts that name and explain: shown by `zonda plugins` and in products."""
SITE = {
    "name": "s",
    "latitude": "38.4 deg",
    "longitude": "-79.8 deg",
    "altitude": "825 m",
    "climatology": "green_bank",
}

SETTINGS: dict[str, dict[str, Any]] = {
    "scene": {
        "site": {"site": Site(**(SITE | {"latitude": "39 deg"}))},
        "instrument": {"instrument": instrument(detectors=7)},
        "time": {"time": "2024-11-25T07:30"},
        "target": {"target": "05h00m10s +20d"},
        "seed": {"seed": 4},
        "weather": {"weather": {"wind": "median"}},
    },
    "site": {
        "latitude": {"latitude": "39 deg"},
        "longitude": {"longitude": "-70 deg"},
        "altitude": {"altitude": "1500 m"},
        "climatology": {"climatology": "meerkat"},
    },
    "instrument": {
        "telescope": {"telescope": {"diameter": "50 m"}},
        "band": {"band": {"high": "112 GHz"}},
        "bands": {
            "bands": [
                {"name": "b", "low": "78 GHz", "high": "108 GHz"},
                {"name": "c", "low": "130 GHz", "high": "170 GHz"},
            ]
        },
        "pixels": {
            "pixels": "separate",
            "bands": [
                {"name": "b", "low": "78 GHz", "high": "108 GHz", "detectors": 7},
                "so_93ghz",
            ],
        },
        "polarization": {"polarization": "pairs", "detectors": 20},
        "detectors": {"detectors": 7},
        "yield": {"yield": "50 %"},
        "field_of_view": {"field_of_view": "3 arcmin"},
        "layout": {"layout": "rings"},
        "wafers": {"layout": "wafers", "detectors": 21, "wafers": 3},
        "focalplane": {"focalplane": "array.csv", "detectors": None, "field_of_view": None},
        "fwhm": {"fwhm": None},
        "main_beam_efficiency": {"main_beam_efficiency": 0.4},
        "illumination_efficiency": {"illumination_efficiency": 0.7},
        "net": {"net": "1 mK s(1/2)"},
        "knee": {"knee": "1 Hz"},
        "slope": {"slope": 1.4},
        "pink_minimum_frequency": {"pink_minimum_frequency": "20 mHz"},
        "sample_rate": {"sample_rate": "40 Hz"},
    },
    "telescope": {
        "diameter": {"diameter": "50 m"},
        "elevation_min": {"elevation_min": "80 deg"},
        "elevation_max": {"elevation_max": "20 deg"},
        "speed_max": {"speed_max": "10 arcsec/s"},
        "acceleration_max": {"acceleration_max": "1 arcsec/s2"},
        "azimuth_speed_max": {"azimuth_speed_max": "10 arcsec/s"},
        "azimuth_acceleration_max": {"azimuth_acceleration_max": "1 arcsec/s2"},
        "azimuth_jerk_max": {"azimuth_jerk_max": "1 arcsec/s3"},
        "elevation_speed_max": {"elevation_speed_max": "10 arcsec/s"},
        "elevation_acceleration_max": {"elevation_acceleration_max": "1 arcsec/s2"},
        "elevation_jerk_max": {"elevation_jerk_max": "1 arcsec/s3"},
    },
    "band": {
        "low": {"low": "80 GHz"},
        "high": {"high": "112 GHz"},
        "file": {"low": None, "high": None, "file": "band.txt"},
    },
    "background_limited": {
        "reference": {"reference": REFUSED},
        "optical_efficiency": {"optical_efficiency": 0.5},
        "polarizations": {"polarizations": 1},
        "modes": {"modes": 2},
        "telescope_temperature": {"telescope_temperature": "20 K"},
        "receiver_temperature": {"receiver_temperature": "20 K"},
    },
    "fixed_net": {
        "reference": {"reference": "detector", "level": "1 mK s(1/2)"},
        "level": {"level": "1 mK s(1/2)"},
    },
}


LIMITS = {
    ("telescope", "elevation_min"): "reaches 80 deg to 88 deg",
    ("telescope", "elevation_max"): "reaches 5 deg to 20 deg",
    ("telescope", "speed_max"): "largest speed on the sky is 10 arcsec/s",
    ("telescope", "acceleration_max"): "largest acceleration on the sky is 1 arcsec/s2",
    ("telescope", "azimuth_speed_max"): "largest speed of the azimuth axis is 10 arcsec/s",
    (
        "telescope",
        "azimuth_acceleration_max",
    ): "largest acceleration of the azimuth axis is 1 arcsec/s2",
    ("telescope", "azimuth_jerk_max"): "largest jerk of the azimuth axis is 1 arcsec/s3",
    ("telescope", "elevation_speed_max"): "largest speed of the elevation axis is 10 arcsec/s",
    (
        "telescope",
        "elevation_acceleration_max",
    ): "largest acceleration of the elevation axis is 1 arcsec/s2",
    ("telescope", "elevation_jerk_max"): "largest jerk of the elevation axis is 1 arcsec/s3",
    ("background_limited", "reference"): "'detector'",
}
"""What is refused with which message."""


def described(what: str, change: dict[str, Any], maps: Path) -> tuple[Any, dict[str, Any]]:
    """(scene, parameters of WhiteNoise)."""
    if what == "scene":
        return scene(**change), {}
    if what == "site":
        return scene(site=Site(**(SITE | change))), {}
    if what == "instrument":
        table = {"focalplane": maps / change["focalplane"]} if "focalplane" in change else {}
        return scene(instrument=instrument(**(change | table))), {}
    if what == "telescope":
        return scene(instrument=instrument(telescope=change)), {}
    if what == "band":
        return (
            scene(
                instrument=instrument(
                    band=change | ({"file": maps / change["file"]} if "file" in change else {})
                )
            ),
            {},
        )
    return scene(), {"model": {"name": what, **change}}


def whole(noise: dict[str, Any], maps: Path) -> list[Any]:
    pointing = {k: v for k, v in SCAN.items() if k != "sample_rate"} | {"scans": 1}
    steps = [make("PointingDaisy", **pointing), make("SkyMap", file=maps / "map.fits")]
    return steps + [
        make(n, **(SHORT.get(n, {}) | (noise if n == "WhiteNoise" else {}))) for n in WHOLE
    ]


@pytest.fixture(scope="module")
def unchanged(maps: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """The run before the change; where the default depends on what it is of, by its name."""
    found = {}
    for what in SETTINGS:
        where, noise = described(what, {}, maps)
        found[what] = outcome(whole(noise, maps), where, tmp_path_factory.mktemp("out"))
    return found


@pytest.mark.parametrize(
    ("what", "field"), [(w, f) for w, fields in SETTINGS.items() for f in fields]
)
def test_every_parameter_of_the_scene(
    what: str, field: str, maps: Path, tmp_path: Path, unchanged: dict[str, Any]
) -> None:
    def run() -> dict[str, Any]:
        where, noise = described(what, SETTINGS[what][field], maps)
        return outcome(whole(noise, maps), where, tmp_path)

    if (what, field) in LIMITS:
        with pytest.raises(ZondaError, match=LIMITS[what, field]):
            run()
    else:
        assert not same(unchanged[what], run())


def test_no_parameter_of_the_scene_is_left_out() -> None:
    classes = {
        "scene": zonda.Scene,
        "site": Site,
        "instrument": zonda.Instrument,
        "telescope": zonda.Telescope,
        "band": zonda.Band,
        "background_limited": noise_models.get("background_limited"),
        "fixed_net": noise_models.get("fixed_net"),
    }
    assert set(classes) == set(SETTINGS)
    for what, cls in classes.items():
        said = SAID | (
            {"site"} if what == "telescope" else set()
        )  # where it stands: `zonda check` compares, nothing is computed
        assert {field.alias or name for name, field in cls.model_fields.items()} - said == set(
            SETTINGS[what]
        ), what
