"""The whole T_scan, mean emission included, goes through a file bit by bit."""

from typing import Any

import numpy as np
import pytest

import zonda
from zonda.operators.io.save_tod import load_tod


@pytest.mark.parametrize("precision", ["float32", "float64"])
@pytest.mark.parametrize("format", ["hdf5", "fits"])
def test_a_scan_through_the_air_comes_back(tmp_path: Any, format: str, precision: Any) -> None:
    steps = [
        zonda.PointingDaisy(scan_duration="30 s", radius="1 arcmin"),
        zonda.AtmosphereLayers(pwv="7.7 mm"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.SaveTOD(format=format, streams=["signal", "atmosphere", "white"]),
    ]
    camera = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d"
    ).instrument
    few = camera.model_copy(update={"detectors": 37})
    scene = zonda.Scene(
        site="green_bank", instrument=few, time="2024-11-25T07:00", target="05h +20d", seed=2
    )
    keep = ("signal", "atmosphere", "white")
    data = zonda.Pipeline(steps, precision=precision).run(
        scene, output=tmp_path, keep=keep, memory=12_000_000
    )
    (path,) = data.products["tod_file"]
    tod, observation = load_tod(path), data.observations[0]
    for name in keep:
        assert tod.streams[name].dtype == np.float64
        np.testing.assert_array_equal(tod.streams[name], observation.detdata[name], err_msg=name)
    signal = tod.streams["signal"]
    assert signal.min() > 20  # kelvin: epsilon T_atm / (zeta e^-tau) is in it
    zeta, epsilon = (
        observation.focalplane.main_beam_efficiency,
        observation.focalplane.illumination_efficiency,
    )
    everything = slice(0, signal.shape[0]), slice(0, signal.shape[1])
    emission, transmission = (
        observation.smooth[n].evaluate(*everything) for n in ("atmosphere", "transmission")
    )
    above = epsilon[:, None] * (emission + tod.streams["atmosphere"]) + tod.streams["white"]
    # float32 streams of 0.3 K are exact to 2e-8 K, M to 1e-7 of its 20 to 60 K (`MEAN_ERROR`)
    np.testing.assert_allclose(signal, above / (zeta[:, None] * transmission), rtol=0, atol=1e-5)
    np.testing.assert_array_equal(tod.seconds, observation.seconds)
    np.testing.assert_array_equal(tod.boresight_radec, observation.boresight_radec)
    np.testing.assert_array_equal(tod.boresight_azel, observation.boresight_azel)
