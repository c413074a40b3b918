"""Plots of instruments, bands, scans, atmospheres, streams and maps in Python."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

import zonda
from zonda.core.data import Data

SCENE = zonda.Scene(
    site="green_bank",
    instrument={"like": "mustang2", "detectors": 7},
    time="2024-11-25T07:00",
    target="05h +20d",
    seed=1,
)
DAISY = zonda.PointingDaisy(scan_duration="20 s", scans=2)


@pytest.fixture(autouse=True)
def no_figure_stays() -> Any:
    from matplotlib import pyplot as plt

    plt.switch_backend("Agg")
    yield
    plt.close("all")


@pytest.fixture(scope="module")
def data() -> Data:
    steps = [DAISY, zonda.AtmosphereLayers(pwv="5 mm"), zonda.WhiteNoise(), zonda.Efficiency()]
    pipeline = zonda.Pipeline([*steps, zonda.BinMap(pixel="8 arcsec")])
    return pipeline.run(SCENE, keep=["signal"])


def test_a_focal_plane() -> None:
    whole = SCENE.instrument.plot()
    assert len(whole.figure.axes) == 2
    ax = Figure().subplots()
    assert SCENE.instrument.plot(ax) is ax
    plane = SCENE.instrument.focalplane()
    centres = np.radians(ax.collections[0].get_offsets() / 60)  # arcmin
    np.testing.assert_allclose(centres, np.stack([plane.xi, plane.eta], axis=1), rtol=1e-6)


def test_a_passband() -> None:
    """A triangle from 90 to 110 GHz: centre 100 GHz, equivalent width 10 GHz."""
    band = zonda.Band(name="b", low="90 GHz", high="110 GHz")
    nu = np.linspace(90e9, 110e9, 201)
    band._table = nu, 1 - np.abs(nu / 1e9 - 100) / 10
    texts = [t.get_text() for t in band.plot().get_legend().get_texts()]
    assert texts == ["centre 100 GHz", "width 10 GHz"]


def test_the_scans_of_a_pointing_step_alone(data: Data) -> None:
    sky = DAISY.plot(SCENE)
    above = sky.figure.axes[1]
    assert [line.get_label() for line in above.lines] == ["scan-000", "scan-001"]
    for line, scan in zip(above.lines, data.observations, strict=True):
        azimuth, elevation = np.radians(line.get_data())
        np.testing.assert_allclose(np.angle(np.exp(1j * (azimuth - scan.azimuth))), 0, atol=1e-9)
        np.testing.assert_allclose(elevation, scan.elevation, atol=1e-9)
    ax = Figure().subplots()
    assert data.observations[0].plot(ax) is ax
    np.testing.assert_allclose(ax.lines[0].get_data(), sky.lines[0].get_data(), atol=1e-9)


def test_a_layer_of_the_atmosphere() -> None:
    """The layer that `AtmosphereScreens` shows of the run."""
    layers, screens = zonda.AtmosphereLayers(pwv="5 mm"), zonda.AtmosphereScreens(moments=1)
    run = zonda.Pipeline([DAISY, layers, screens]).run(SCENE)["screens"]
    drawn = layers.plot(SCENE, DAISY).images[0].get_array()
    np.testing.assert_array_equal(drawn, run.layers[0].values * 1e6)
    with pytest.raises(zonda.ZondaError, match="there is no layer 99") as err:
        layers.plot(SCENE, DAISY, layer=99)
    assert "choose 0 (the lowest)" in str(err.value)


def test_a_stream(data: Data) -> None:
    signal = data.tod("signal", 1)
    ax = signal.plot(detectors=[2, -1])
    names = data.observations[1].focalplane.names
    found = {line.get_label(): line for line in ax.lines if not line.get_label().startswith("_")}
    assert list(found) == [names[2], names[6]]
    pale = [line.get_ydata() for line in ax.lines if line.get_label().startswith("_")]
    np.testing.assert_array_equal(pale, np.asarray(signal)[[2, 6]])  # tens of kelvin: in K
    assert len(signal.plot(detectors=3).lines) == 6
    for part in (signal[0], signal - 1, signal.mean(axis=1)):
        assert type(part) is np.ndarray
    assert isinstance(signal.std(), np.float64)
    with pytest.raises(zonda.ZondaError, match="there is no detector 7"):
        signal.plot(detectors=[7])
    with pytest.raises(zonda.ZondaError, match="does not know its scan"):
        signal.copy().plot()


def test_a_map_in_plain_axes(data: Data) -> None:
    """They are replaced by axes with sky coordinates, in the same place."""
    figure = Figure()
    first, second = figure.subplots(1, 2)
    place = second.get_position().bounds
    drawn = data["map"].plot(ax=second)
    assert figure.axes[:2] == [first, drawn]
    assert second not in figure.axes
    np.testing.assert_allclose(drawn.get_position(original=True).x1, place[0] + place[2], rtol=0.2)
    assert drawn.coords[0].coord_type == "longitude"
    apart = figure.add_axes((0.2, 0.3, 0.4, 0.5))
    assert data["map"].plot(ax=apart).get_position(original=True).y0 >= 0.3 - 1e-9
