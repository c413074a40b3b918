"""`CommonModeFilter: {group: all}` in plans, accuracy and forecasts: what holds for each band alone
need not hold for all.
"""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

import zonda
from zonda.core.accuracy.metrics import metric_of
from zonda.core.configuration.pipeline_file import parse
from zonda.core.errors import PipelineError
from zonda.core.experiment.variant import Variant
from zonda.core.plan.audit import Audit, audit_of_bands
from zonda.core.plan.result import Plan

TEXT = """
name: joined
seed: 3
site: llano_de_chajnantor
time: 2022-08-01T23:00
target: 260d -10d
instrument:
  name: camera
  telescope: {name: dish, diameter: 6 m}
  bands:
    - {name: f090, low: 77 GHz, high: 106 GHz, net: 300 uK s(1/2)}
    - {name: f280, low: 250 GHz, high: 310 GHz, net: 600 uK s(1/2)}
  detectors: 19
  knee: 1 Hz
  pink_minimum_frequency: 10 mHz
  field_of_view: 20 arcmin
  main_beam_efficiency: 0.8
  illumination_efficiency: 0.9
  sample_rate: 50 Hz
operators:
  - PointingDaisy: {radius: 15 arcmin, speed: 10 arcmin/s, scan_duration: 10 s}
  - AtmosphereLayers: {pwv: 1 mm, pwv_rms: 5 %}
  - WhiteNoise
  - PinkNoise: {shared: 0.9}
  - Efficiency
  - HighpassFilter: {frequency: 0.2 Hz}
  - CommonModeFilter: {group: all, method: mean}
  - BinMap: {pixel: 1 arcmin, width: 1 deg}
"""
LARGE = "instrument.detectors=919", "PointingDaisy.scan_duration=5 min", "budget=0.3"
BY_BAND = "CommonModeFilter.group=band"


def coarse(made: Plan) -> set[str]:
    return {d.name for one in made.bands.values() for d in one.decided if d.chosen}


def test_a_plan_coarsens_nothing_where_bands_are_joined() -> None:
    """With 919 detectors a coarser form changed the map of f090 by 1.5 times the bound of that band
    alone.
    """
    by_band, joined = (
        zonda.plan(parse(TEXT, overrides=[*LARGE, *more]), threads=1) for more in ([BY_BAND], [])
    )
    assert "HighpassFilter.high-pass decimation" in coarse(by_band)
    assert coarse(joined) == set()
    assert joined.summary.settings == {}
    assert (
        " ".join(str(joined).split()).count(
            "CommonModeFilter joins the bands: the bounds are of this band alone and need not hold"
        )
        == 2
    )
    assert "joins" not in str(by_band)
    reasons = {d.name: d.reason for d in joined.bands["f090"].decided}
    assert reasons["HighpassFilter.high-pass decimation"] == "CommonModeFilter joins the bands"
    assert [one["joins_bands"] for one in joined.as_dict()["bands"].values()] == [
        "CommonModeFilter"
    ] * 2


def test_a_plan_that_drops_what_joins_the_bands_says_that_bounds_need_not_hold() -> None:
    made = zonda.plan(parse(TEXT), drop=["CommonModeFilter"], threads=1)
    assert "CommonModeFilter" not in made.operators
    assert [one["joins_bands"] for one in made.as_dict()["bands"].values()] == [
        "CommonModeFilter"
    ] * 2
    assert str(made).count("CommonModeFilter joins the bands: the bounds are of this band") == 2


def test_what_is_dropped_all_the_same_is_audited_of_each_band_alone() -> None:
    file = parse(TEXT)
    made = zonda.plan(file, drop=["high-pass decimation"], threads=1)
    assert coarse(made) == {"HighpassFilter.high-pass decimation"}
    found = audit_of_bands(file, made, threads=1)
    for one in found.bands.values():
        assert isinstance(one, Audit)
        assert one.slice.endswith(
            "this band alone: with the others, which CommonModeFilter joins, the bounds need not"
            " hold"
        )


def test_a_camera_of_one_band_is_planned_as_before() -> None:
    file = parse(TEXT)
    scene = file.scene()
    one = dataclasses.replace(
        file, _scene=scene.model_copy(update={"instrument": scene.instrument.cameras["f090"]})
    )
    assert "joins" not in str(zonda.plan(one, threads=1))


def test_accuracy_is_measured_of_the_bands_together() -> None:
    """What is measured is the map of a run, which is that of the joined bands."""
    file = parse(TEXT)
    metric = metric_of(file, "map_rms")
    data = Variant(file.pipeline(), file.scene()).run([metric], threads=1)
    run, by_band = (
        f.pipeline().run(f.scene(), output=Path(), threads=1).products
        for f in (file, parse(TEXT, overrides=[BY_BAND]))
    )
    for band, found in metric.measure(data).items():
        np.testing.assert_array_equal(found["I"]["signal"], run[f"map_{band}"].signal)
        assert not np.array_equal(
            found["I"]["signal"], by_band[f"map_{band}"].signal, equal_nan=True
        )


def test_a_forecast_refuses_them() -> None:
    with pytest.raises(
        PipelineError, match="CommonModeFilter: the forecast does not cover group: all"
    ):
        zonda.sensitivity(parse(TEXT))
