"""Bounds behind filters that find what they remove in the data: their modes turn where a part of
the data is left out.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

import zonda
from zonda.core.plan.audit import audit

SCENE = """
name: modes
seed: {seed}
site: mauna_kea
time: 2022-08-09T16:00
target: az 49 deg el 75 deg
weather: {{pwv: 1 mm}}
budget: 30 %
instrument: {{name: cam, telescope: {{name: dish, diameter: 12 m}}, detectors: 61, field_of_view: 12 arcmin,
  main_beam_efficiency: 0.6, illumination_efficiency: 0.9, net: 0.2 mK s(1/2), knee: {knee}, sample_rate: 50 Hz,
  band: {{name: b80, low: 80 GHz, high: 105 GHz}}}}
runs: {{noiseless: {{only: [sky], modes: full}}}}
operators:
  - PointingDaisy: {{radius: 8 arcmin, speed: 300 arcsec/s, scan_duration: 40 s}}
  - SkyMap: {{file: sky.fits, centre: target}}
{air}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - HighpassFilter: {{frequency: 0.1 Hz}}
  - CommonModeFilter: {common}
  - BinMap: {{pixel: 30 arcsec}}
  - SaveMap
"""
AIR = "  - AtmosphereLayers: {pwv_rms: %s, layers: 5}"


@pytest.fixture
def load(tmp_path):
    def make(
        common="{}", rms="0.3 %", knee="0.1 Hz", seed=13, peak=5e-3, width=120.0, overrides=()
    ):
        from astropy.io import fits

        y, x = np.indices((121, 121)) * 20.0 - 1200.0
        cards = {
            "CTYPE1": "RA---TAN",
            "CRVAL1": 0.0,
            "CRPIX1": 61.0,
            "CDELT1": -20 / 3600,
            "CUNIT1": "deg",
            "CTYPE2": "DEC--TAN",
            "CRVAL2": 0.0,
            "CRPIX2": 61.0,
            "CDELT2": 20 / 3600,
            "CUNIT2": "deg",
            "BUNIT": "K_RJ",
        }
        fits.PrimaryHDU(peak * np.exp(-(x**2 + y**2) / 2 / width**2), fits.Header(cards)).writeto(
            tmp_path / "sky.fits", overwrite=True
        )
        air = AIR % rms if rms else ""
        (tmp_path / "modes.yaml").write_text(
            SCENE.format(common=common, air=air, knee=knee, seed=seed)
        )
        return zonda.load(tmp_path / "modes.yaml", overrides=overrides)

    return make


def rows(file, *drop):
    made = zonda.plan(file, drop=drop, threads=1)
    found = audit(file, made, threads=1, seconds=40.0)
    assert not found.violated, str(found)
    return {(r.effect, r.metric): r for r in found.rows}


def bound(file, effect, metric="tod"):
    plan = zonda.plan(file, drop=[effect], threads=1)
    return next(d.choice.bound[metric] for d in plan.decided if d.effect.name == effect)


def test_a_layer_left_out_behind_a_mode_of_the_noise(load):
    """The noise turns the mode where it is larger than what the detectors have in common: more
    changes than the detectors' mean would leave of the layer, which was the bound (163 uK of 39.8
    were found)."""
    found = rows(load("{on_undetermined: remove}", peak=1e-5), "layer 0")[
        "AtmosphereLayers.layer 0", "tod"
    ]
    assert found.actual > bound(load("{method: mean}", peak=1e-5), "layer 0")


def test_a_layer_left_out_behind_the_mean_is_bounded_by_what_the_mean_leaves(load):
    file = load("{method: mean}")
    found = rows(file, "layer 0")["AtmosphereLayers.layer 0", "tod"]
    assert found.bound < 1e-4 < bound(load(), "layer 0")


def test_nothing_before_such_a_filter_is_dropped_of_itself(load):
    """The poles of the pink noise, below the budget, were: a noiseless map with the complete data's
    modes changed with them.
    """
    file = load(rms="", knee="0.02 Hz", peak=0.3, width=240.0)
    assert not {d.name for d in zonda.plan(file, threads=1).decided if d.chosen} & {
        "PinkNoise.poles"
    }
    found = rows(file, "poles")["PinkNoise.poles", "peak"]
    assert found.actual > 1e-6, "it is the noiseless map that turns"


def test_a_whole_operator_left_out_turns_the_modes(load):
    """The sky is bounded by its peak; what the detectors have in common is its mode here, and
    without it noise.
    """
    file = load(rms="", peak=0.3)
    plan = zonda.plan(file, drop=["SkyMap"], threads=1)
    (whole,) = [d for d in plan.decided if d.effect.name == "everything"]
    assert "other modes are removed" in whole.choice.formula
    assert whole.choice.bound["map_rms"] > bound_of_whole(load("{method: mean}", rms="", peak=0.3))


def bound_of_whole(file):
    plan = zonda.plan(file, drop=["SkyMap"], threads=1)
    return next(d.choice.bound["map_rms"] for d in plan.decided if d.effect.name == "everything")


def test_a_filter_of_ones_own_without_planning_may_turn(load):
    """A function that couples all it is given, or is not linear, may find what it removes in the
    data.
    """
    file = load("{method: mean}")
    steps = list(file.steps)
    own = zonda.operator(lambda block: None, name="Own", couples="detectors")
    place = next(k for k, s in enumerate(steps) if s.key == "BinMap")
    with_own = dataclasses.replace(
        file, steps=(*steps[:place], type(steps[0])("Own", own), *steps[place:])
    )
    assert bound(with_own, "layer 0") > 10 * bound(file, "layer 0")


@pytest.mark.parametrize("cut", ["0.1 Hz", "0.3 Hz"])
def test_decimation_of_a_scan_of_few_cycles(load, cut):
    """What a scan's ends make of slow waves, and noise at the places of the images, is in the low
    part too (299 nK of 192).
    """
    overrides = [f"HighpassFilter.frequency={cut}", "PointingDaisy.scan_duration=20 s"]
    file = load("{method: mean}", rms="10 %", overrides=overrides)
    assert (
        rows(file, "high-pass decimation")["HighpassFilter.high-pass decimation", "tod"].actual > 0
    )
