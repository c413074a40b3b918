"""Knobs of a pipeline file, shorter scans, and settings as YAML."""

import re

import pytest

import zonda
from zonda.core.accuracy.report import arguments, fragment
from zonda.core.accuracy.settings import knobs_of, overrides, shortened
from zonda.core.configuration import yaml_places
from zonda.core.errors import InputError

TWICE = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
precision: float64
operators:
  - PointingDaisy: {scan_duration: 5 min, scans: 3}
  - WhiteNoise
  - PinkNoise: {poles: 7}
  - PinkNoise: {name: drift, knee: 10 mHz}
  - PinkNoise
  - Efficiency
  - HighpassFilter: {oversampling: 48}
"""


@pytest.fixture
def twice(tmp_path):
    path = tmp_path / "twice.yaml"
    path.write_text(TWICE)
    return path


def test_keys_are_those_of_set(twice):
    file = zonda.load(twice)
    knobs = {k.key: k for k in knobs_of(file)}
    assert {"PinkNoise.1.poles", "drift.poles", "PinkNoise.3.poles"} <= set(knobs)
    assert [knobs[k].step for k in ("PinkNoise.1.poles", "drift.poles", "PinkNoise.3.poles")] == [
        "PinkNoise",
        "drift",
        "PinkNoise.2",
    ]
    assert (knobs["PinkNoise.1.poles"].present, knobs["PinkNoise.1.poles"].given) == ("7", True)
    assert (knobs["drift.poles"].present, knobs["drift.poles"].given) == ("8", False)
    assert (knobs["HighpassFilter.oversampling"].present, knobs["precision"].present) == (
        "48",
        "float64",
    )
    for knob in knobs.values():
        changed = zonda.load(twice, overrides=overrides({knob.key: knob.tightest}))
        again = {k.key: k for k in knobs_of(changed)}
        assert again[knob.key].present == knob.tightest
        assert all(again[k].present == knobs[k].present for k in knobs if k != knob.key)


def test_only_some_knobs(twice):
    file = zonda.load(twice)
    assert [k.key for k in knobs_of(file, ["oversampling", "drift"])] == [
        "HighpassFilter.oversampling",
        "drift.poles",
    ]
    with pytest.raises(InputError, match="did you mean 'oversampling'"):
        knobs_of(file, ["oversamplin"])


def test_shorter_scans(twice):
    file = zonda.load(twice)
    assert shortened(file, None, False) == {}
    assert shortened(file, None, True) == {
        "PointingDaisy.scan_duration": "30 s",
        "PointingDaisy.scans": "2",
    }
    assert shortened(file, "20 s", False) == {"PointingDaisy.scan_duration": "20 s"}
    quick = zonda.load(twice, overrides=overrides(shortened(file, None, True)))
    assert shortened(quick, None, True) == {}


@pytest.mark.parametrize(
    ("name", "seconds"),
    [("mustang2_cluster", "30 s"), ("atlast_reduced", "5 s"), ("atlast_full", "5 s")],
)
def test_quick_scans_of_many_detectors_are_shorter(name, seconds):
    """223 detectors at 100 Hz, 2 x 30 s: 1.3e6 samples. 3000 at 225 Hz: 6e6 samples are 2 x 4.4 s,
    and 5 s is the least.
    """
    assert shortened(zonda.load(name), None, True)["PointingDaisy.scan_duration"] == seconds


def test_a_fragment_is_yaml_and_set_arguments_in_one(twice):
    setting = {"drift.poles": "12", "HighpassFilter.oversampling": "12", "precision": "float32"}
    text = fragment(setting, "a heading")
    value = yaml_places.load(yaml_places.Source("fragment", text)).value
    assert value == {
        "precision": "float32",
        "operators": [{"drift": {"poles": 12}}, {"HighpassFilter": {"oversampling": 12}}],
    }
    line = next(x for x in text.splitlines() if "--set" in x)
    assert re.findall(r"--set (\S+)", line) == list(overrides(setting))
    assert arguments({"A.b": "3 %"}) == "--set 'A.b=3 %'"
