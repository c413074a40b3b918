"""Mistakes in Python are ZondaErrors as good as those of a file: the place in the call, the cause,
the cure, the right name.
"""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path
from typing import Any

import astropy.units as u
import numpy as np
import pytest

import zonda
from zonda.core.configuration.parameters import ParameterError
from zonda.core.errors import ZondaError

SCENE = {
    "site": "green_bank",
    "instrument": "mustang2",
    "time": "2024-11-25T07:00",
    "target": "05h +20d",
}


def scene(**changes: Any) -> zonda.Scene:
    return zonda.Scene(**{**SCENE, **changes})


@pytest.mark.parametrize(
    ("call", "message", "words"),
    [
        (
            lambda: zonda.BinMap(pixle="2 arcsec"),
            "unknown parameter 'pixle' for BinMap",
            "did you mean 'pixel'?",
        ),
        (lambda: zonda.BinMap(pixel=2), "BinMap, pixel: 2 has no unit", "add a unit"),
        (lambda: zonda.BinMap(pixel="2 K"), "'K' is a unit of temperature", "not an angle"),
        (lambda: zonda.BinMap(pixel=2 * u.K), "'K' is a unit of temperature", "not an angle"),
        (
            lambda: zonda.BinMap(pixel="-2 arcsec"),
            "must be greater than 0 arcsec, got -2 arcsec",
            "Side of a pixel",
        ),
        (lambda: zonda.BinMap(pixel=np.zeros(3)), "expected an angle such as", ""),
        (
            lambda: zonda.BinMap("2 arcsec"),
            "takes its parameters by their names",
            "as in pixel='2 arcsec'",
        ),
        (
            lambda: zonda.PointingDaisy("4 arcmin"),
            "takes its parameters by their names",
            "as in radius='4 arcmin'",
        ),
        (
            lambda: zonda.BinMap(projection="tan"),
            "must be 'TAN' or 'CAR', got 'tan'",
            "did you mean 'TAN'?",
        ),
        (lambda: zonda.BinMap(half_difference="maybe"), "expected True or False, got 'maybe'", ""),
        (
            lambda: zonda.PointingDaisy(scans=1.5),
            "scans: expected a whole number, got 1.5",
            "Number of scans",
        ),
        (lambda: zonda.PointingDaisy(scans=0), "scans: must be at least 1, got 0", ""),
        (
            lambda: zonda.PointingDaisy(radius="1 furlong"),
            "unknown unit 'furlong'",
            "e.g. '4 arcmin'",
        ),
        (
            lambda: zonda.PointingDaisy(offsets=[("1 arcmin", "2 K")]),
            "offsets.0.1: expected an angle",
            "not an angle",
        ),
        (
            lambda: zonda.PointingDaisy(target="M31"),
            "target: cannot read 'M31' as a position",
            "e.g. 05h00m00s",
        ),
        (lambda: zonda.PointingRecorded(), "PointingRecorded needs 'file'", "add file=..."),
        (
            lambda: zonda.SkyMap(),
            "give either file, the path of a FITS map, or in Python map, an array",
            "",
        ),
        (lambda: zonda.WhiteNoise(model="foo"), "model: unknown noise model 'foo'", "fixed_net"),
        (
            lambda: zonda.WhiteNoise(model={"name": "background_limited", "mods": 1}),
            "model: unknown parameter 'mods' for BackgroundLimited",
            "did you mean 'modes'?",
        ),
        (lambda: zonda.AtmosphereLayers(spectra="x"), "unknown spectra 'x'", "installed: am"),
        (
            lambda: zonda.Scene(),
            "Scene needs 'site', 'instrument', 'time'",
            "time: Start of the first scan",
        ),
        (lambda: scene(site="lmt"), "site: unknown site 'lmt'", "did you mean 'sierra_negra'?"),
        (
            lambda: scene(instrument="mustng2"),
            "instrument: unknown instrument 'mustng2'",
            "did you mean 'mustang2'?",
        ),
        (
            lambda: scene(intrument="mustang2"),
            "unknown parameter 'intrument' for Scene",
            "did you mean 'instrument'?",
        ),
        (lambda: scene(time="yesterday"), "time: cannot read 'yesterday' as a time", "YYYY-MM-DD"),
        (lambda: scene(seed=-1), "seed: must be at least 0, got -1", ""),
        (lambda: scene(site=3), "site: expected a dict, got 3", "a registered name"),
        (
            lambda: scene(weather="1.2 mm"),
            "'1.2 mm' is no source of weather",
            "weather: {pwv: 1.2 mm}",
        ),
        (
            lambda: scene(weather={"pvw": "1 mm"}),
            "unknown parameter 'pvw' for Scene, weather",
            "did you mean 'pwv'?",
        ),
        (
            lambda: scene(site={"name": "x", "latitude": "95 deg", "longitude": "0 deg"}),
            "site.latitude: must be",
            "90 deg",
        ),
        (lambda: zonda.Band(name="x", low="90 GHz"), "a band needs 0 < low < high", ""),
        (
            lambda: zonda.Telescope(name="x", diameter="0 m"),
            "diameter: must be greater than 0 m",
            "",
        ),
    ],
)
def test_a_mistake_in_a_call(call: Callable[[], Any], message: str, words: str) -> None:
    with pytest.raises(ParameterError) as caught:
        call()
    (found,) = caught.value.diagnostics
    assert message in found.message
    assert words in str(caught.value)
    for jargon in ("pydantic", "validation error", "input_value", "Input should"):
        assert jargon not in str(caught.value)


def test_all_mistakes_of_a_call_at_once() -> None:
    with pytest.raises(ZondaError) as caught:
        zonda.PointingDaisy(radius="1 K", scans=0, petal=3)
    text = str(caught.value)
    assert all(
        words in text
        for words in (
            "radius: expected an angle",
            "scans: must be at least 1",
            "unknown parameter 'petal'",
        )
    )
    assert pickle.loads(pickle.dumps(caught.value)).diagnostics == caught.value.diagnostics  # type: ignore[attr-defined]


def test_they_are_value_errors_too() -> None:
    with pytest.raises(ValueError, match="no unit"):
        zonda.BinMap(pixel=2)


def test_what_is_made_is_not_changed() -> None:
    step = zonda.BinMap(pixel="2 arcsec")
    with pytest.raises(ZondaError, match="a BinMap is not changed once it is made") as caught:
        step.pixel = 3
    assert "make another: BinMap(pixel=..., ...)" in str(caught.value)


STEPS = [
    zonda.PointingDaisy(scan_duration="2 s"),
    zonda.WhiteNoise(),
    zonda.Efficiency(),
    zonda.BinMap(pixel="2 arcsec"),
]


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (
            lambda: zonda.Pipeline([lambda: 0, zonda.BinMap]),
            ["step 1 is a function (lambda)", "step 2 is the class BinMap", "BinMap(...)"],
        ),
        (
            lambda: zonda.Pipeline(STEPS[0]),
            ["a list of operators, not PointingDaisy(", "write Pipeline(["],
        ),
        (
            lambda: zonda.Pipeline(["BinMap"]),
            ["step 1 is the text 'BinMap'", "write zonda.BinMap(...)"],
        ),
        (lambda: zonda.Pipeline([{"BinMap": {}}]), ["of type dict", "write zonda.BinMap(...)"]),
        (lambda: zonda.Pipeline(None), ["a list of operators, not None"]),
        (
            lambda: zonda.Pipeline([zonda.SkyMap]),
            ["step 1 is the class SkyMap", "make one of the class at step 1: SkyMap(...)"],
        ),
        (
            lambda: zonda.Pipeline(STEPS[::-1]),
            ["step 1: BinMap needs boresight", "move it below PointingDaisy"],
        ),
        (
            lambda: zonda.Pipeline(STEPS, runs={"a": {"onyl": ["sky"]}}),
            ["unknown parameter 'onyl'", "did you mean 'only'?"],
        ),
        (
            lambda: zonda.Pipeline(STEPS, runs={"a": "sky"}),
            ["signal a is a dict, not the text 'sky'"],
        ),
        (lambda: zonda.Pipeline(STEPS, runs=["a"]), ["runs is a dict of signals"]),
        (
            lambda: zonda.Pipeline(STEPS, precision="float23"),
            ["'float32' or 'float64', not 'float23'", "did you mean 'float32'?"],
        ),
        (
            lambda: zonda.Pipeline(STEPS).run("mustang2"),
            ["runs on a Scene, not on the text 'mustang2'"],
        ),
        (lambda: zonda.Pipeline(STEPS).run(zonda.Scene), ["not on the class Scene"]),
        (
            lambda: zonda.Pipeline(STEPS).run(scene(target=None)),
            ["there is no target", "give the scene or this operator a target"],
        ),
        (
            lambda: zonda.Pipeline(STEPS).run(scene(), memory="abc"),
            ["memory is a number of bytes, not 'abc'", "memory=4e9"],
        ),
        (
            lambda: zonda.Pipeline(STEPS).run(scene(), memory=-5),
            ["memory is a number of bytes, not -5"],
        ),
        (
            lambda: zonda.Pipeline(STEPS).run(scene(), ceiling="4GB"),
            ["ceiling is a number of bytes, not '4GB'"],
        ),
        (
            lambda: zonda.Pipeline(STEPS).run(scene(), threads=0),
            ["threads is a number of threads, 1 or more, not 0"],
        ),
        (
            lambda: zonda.Pipeline(STEPS).run(scene(), threads=1.5),
            ["threads is a number of threads, 1 or more, not 1.5"],
        ),
        (
            lambda: zonda.Pipeline(STEPS).run(scene(), output=3),
            ["output is the path of a folder, not 3"],
        ),
        (
            lambda: zonda.Pipeline(STEPS).run(scene(), output=__file__),
            ["there is a file of that name"],
        ),
        (
            lambda: zonda.Pipeline(STEPS).run(scene(), keep="signal"),
            ["keep is a list of streams", "keep=['signal']"],
        ),
        (
            lambda: zonda.Pipeline(STEPS).run(scene(), keep=["sgnal"]),
            ["the stream 'sgnal' cannot be kept: no step makes it"],
        ),
        (lambda: zonda.load(3), ["3: is not a path"]),
        (lambda: zonda.load("mustang2_clustr"), ["did you mean 'mustang2_cluster'?"]),
        (
            lambda: zonda.load("mustang2_cluster", "seed=a"),
            ["seed: expected a whole number, got 'a'", "1 mistake"],
        ),
        (
            lambda: zonda.plan("mustang2_cluster"),
            ["a plan is made of a pipeline file", "zonda.load"],
        ),
        (
            lambda: zonda.plan(zonda.load("mustang2_cluster"), keep="poles"),
            ["keep is a list of names", "keep=['poles']"],
        ),
    ],
)
def test_a_mistake_with_pipelines(call: Callable[[], Any], words: list[str]) -> None:
    with pytest.raises(ZondaError) as caught:
        call()
    for each in words:
        assert each in str(caught.value)


def test_bytes_may_be_written_as_a_float(tmp_path: Path) -> None:
    data = zonda.Pipeline(STEPS).run(scene(), memory=4e9, threads=1)
    assert "map" in data.products
