"""`zonda.map`: the maps of kept streams have the bits of those of one run."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import zonda
from zonda.core.data import Data
from zonda.plugins.checks.scenes import camera, scene

SKY = zonda.SkyMap(
    map=np.pad(np.full((5, 5), 0.1), 18), pixel_size="10 arcsec", unit="K_RJ", centre="target"
)
STEPS = [
    zonda.PointingDaisy(scan_duration="20 s", scans=2),
    SKY,
    zonda.AtmosphereLayers(pwv="5 mm"),
    zonda.WhiteNoise(),
    zonda.Efficiency(),
]
RUNS = {
    "noiseless": {"only": ["sky"], "modes": "full"},
    "source_free": {"without": ["sky"], "modes": "full"},
}
AGAIN = [
    zonda.HighpassFilter(frequency="0.2 Hz"),
    zonda.CommonModeFilter(modes=1),
    zonda.BinMap(pixel="20 arcsec", half_difference=True),
]
FIRST = zonda.PolynomialFilter(order=1)


def same(one: Any, other: Any) -> None:
    assert one.planes.keys() == other.planes.keys()
    for name, plane in one.planes.items():
        np.testing.assert_array_equal(plane.values, other.planes[name].values, err_msg=name)


def compare(where: Any, first: list[Any], keep: list[str]) -> tuple[Data, Data]:
    """Data of one run, and those of kept streams."""
    whole = zonda.Pipeline([*first, *AGAIN], runs=RUNS).run(where)
    data = zonda.Pipeline([*first, zonda.BinMap(pixel="1 arcmin")], runs=RUNS).run(where, keep=keep)
    return whole, zonda.map(data, AGAIN)


@pytest.mark.parametrize("more", [[], [FIRST]], ids=["", "behind a filter"])
def test_the_bits_are_those_of_one_run(more: list[Any]) -> None:
    keep = ["signal", "signal/noiseless"]
    whole, again = compare(scene(camera(19)), [*STEPS, *more], keep)
    names = {"map", "noiseless/map", "source_free/map"}  # the last is what the others leave
    assert names <= set(whole) & set(again)
    for name in names:
        same(whole[name], again[name])
    labels = [row[0] for row in again.provenance["operators"]]
    assert labels == [row[0] for row in whole.provenance["operators"]]


def test_bits_where_signals_have_modes_of_their_own() -> None:
    """Behind a step that is not linear nothing is a remainder: each signal is kept."""
    square = zonda.operator(lambda b: b.detdata["signal"] + b.detdata["signal"] ** 2, name="square")
    keep = ["signal", "signal/noiseless", "signal/source_free"]
    whole, again = compare(scene(camera(7)), [*STEPS, square], keep)
    for name in ("map", "noiseless/map", "source_free/map"):
        same(whole[name], again[name])


def test_bits_of_a_camera_of_two_bands() -> None:
    low, high = ({"name": n, "low": f"{f} GHz", "high": f"{f + 20} GHz"} for n, f in BANDS)
    two = scene(camera(7).varied(band=None, bands=[low, high]))
    whole, again = compare(two, STEPS, ["signal", "signal/noiseless"])
    assert {"map_f090", "noiseless/map_f150"} <= set(again)
    for name in ("map_f090", "map_f150", "noiseless/map_f150"):
        same(whole[name], again[name])


BANDS = (("f090", 80), ("f150", 140))


def test_recorded_streams(tmp_path: Path) -> None:
    """Maps of a file are those of a pipeline that begins with it, read again or kept."""
    pipeline = zonda.Pipeline([*STEPS, zonda.SaveTOD()])
    files = pipeline.run(scene(camera(7)), output=tmp_path)["tod_file"]
    load = zonda.LoadTOD(file=[str(path) for path in files])
    given = {name: load.own_scene(None)[name] for name in ("site", "instrument", "time")}
    own = zonda.Scene(**given)
    whole = zonda.Pipeline([load, *AGAIN]).run(own)["map"]
    same(whole, zonda.map(load, AGAIN)["map"])
    kept = zonda.Pipeline([load]).run(own, keep=["signal"])
    same(whole, zonda.map(kept, AGAIN)["map"])


def test_many_maps_of_one_run() -> None:
    """Nothing that one map does is left for the next; a kept stream is as it was."""
    data = zonda.Pipeline(STEPS, runs=RUNS).run(scene(camera(7)), keep=["signal"])
    before = data.tod("signal", 0)
    one = zonda.map(data, AGAIN, keep=["signal"])
    zonda.map(data, [zonda.HighpassFilter(frequency="2 Hz"), zonda.BinMap(pixel="30 arcsec")])
    same(one["map"], zonda.map(data, AGAIN)["map"])
    np.testing.assert_array_equal(before, data.tod("signal", 0))
    assert np.ptp(one.tod("signal", 0)) < np.ptp(before)
    assert "noiseless/map" not in one  # its stream was not kept
    twice = zonda.map(one, [zonda.BinMap(pixel="20 arcsec", half_difference=True)])
    same(one["map"], twice["map"])


def test_mistakes() -> None:
    data = zonda.Pipeline(STEPS, runs=RUNS).run(scene(camera(7)), keep=["white"])
    with pytest.raises(zonda.ZondaError, match="'signal' was not kept") as err:
        zonda.map(data, AGAIN)
    assert "keep=['signal', 'white']" in str(err.value)
    kept = zonda.Pipeline(STEPS).run(scene(camera(7)), keep=["signal"])
    with pytest.raises(zonda.ZondaError, match=r"WhiteNoise.* makes what the kept signal"):
        zonda.map(kept, [zonda.WhiteNoise(), *AGAIN])
    with pytest.raises(zonda.ZondaError, match="Path has no streams") as err:
        zonda.map(Path("night.h5"), AGAIN)
    assert "the step that reads recorded data" in str(err.value)
