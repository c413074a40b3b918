"""`TimeStreams` and `PowerSpectrum` of any stream: what the atmosphere makes on request, components
of plugins; and mistakes.
"""

import numpy as np
import pytest

import zonda
from zonda.core.errors import ZondaError
from zonda.operators.diagnostics.plot_operators import Plots, pictures
from zonda.operators.io.save_tod import load_tod
from zonda.plugins.checks import scenes

EVERY = ["pwv", "opacity", "path_delay"]


class Ground(zonda.Operator):
    """A wave of 1 mK at the detector."""

    requires = frozenset({"boresight"})
    provides = frozenset({zonda.Component("ground", "at the detector")})

    def exec(self, block, state):
        block.new("ground")[...] = 1e-3 * np.sin(
            2 * np.pi * block.observation.seconds[block.samples]
        )


class Warm(Ground):
    """The same on the calibrated sky."""

    provides = frozenset({zonda.Component("warm", "calibrated")})

    def exec(self, block, state):
        block.new("warm")[...] = 1e-3 * np.sin(2 * np.pi * block.observation.seconds[block.samples])


def ran(*steps, **settings):
    return scenes.run(list(steps), scenes.scan(7, 2000), precision="float64", **settings)


def atmosphere(**more):
    return zonda.AtmosphereLayers(pwv="5 mm", **more)


def test_streams_that_the_atmosphere_makes_on_request():
    """Path delay is 6.1 to 6.7 m per m of PWV; opacity and PWV go together; the streams that there
    were keep their bits.
    """
    asked = zonda.TimeStreams(streams=["atmosphere", "transmission", *EVERY])
    data = ran(atmosphere(outputs=EVERY), zonda.Efficiency(), asked)
    streams = data.products["time_streams"].streams
    assert set(streams) == {"atmosphere", "transmission", *EVERY}
    ratio = streams["path_delay"] / streams["pwv"]
    assert np.ptp(ratio) < 1e-3
    assert 6.1 < ratio.mean() < 6.7
    # e^-tau = t (1 + x): the opacity's change is -ln(1 + x)
    assert streams["opacity"] == pytest.approx(-np.log1p(streams["transmission"]), abs=1e-9)
    assert 0 < streams["pwv"].std() < 1e-3
    before = ran(
        atmosphere(), zonda.Efficiency(), zonda.TimeStreams(streams=["atmosphere", "transmission"])
    )
    for name, values in before.products["time_streams"].streams.items():
        assert scenes.differing(values, streams[name]) == 0


def test_the_mean_emission_is_in_the_signal_and_not_in_the_atmosphere(tmp_path):
    """One rule for `TimeStreams`, spectra and files; `data.tod` adds it (docs/pipelines.md, The
    mean emission).
    """
    steps = [
        zonda.PointingDaisy(
            radius="1 deg", speed="0.2 deg/s", scan_duration="20 s", check_limits="warn"
        ),
        atmosphere(layers=1),
        zonda.Efficiency(),
        zonda.TimeStreams(streams=["signal", "atmosphere"], detectors=3),
        zonda.SaveTOD(streams=["signal", "atmosphere"]),
        zonda.CompareStreams(stream="signal", reference="atmosphere", segment="5 s"),
    ]
    data = zonda.Pipeline(steps).run(
        scenes.scene(scenes.camera(3)), keep=["signal", "atmosphere"], output=tmp_path, threads=1
    )
    shown, o = data["time_streams"].streams, data.observations[0]
    saved = load_tod(next(tmp_path.glob("tod_*.h5"))).streams
    mean = o.smooth["atmosphere"].evaluate(slice(0, 3), slice(0, o.n_samples))
    assert mean.min() > 10
    assert np.ptp(mean) > 0.1  # it changes with elevation
    np.testing.assert_allclose(
        shown["atmosphere"], data.tod("atmosphere") - mean, rtol=0, atol=1e-9
    )
    np.testing.assert_allclose(saved["atmosphere"], shown["atmosphere"], rtol=0, atol=1e-9)
    assert np.abs(shown["atmosphere"].mean()) < 5
    for signal in (shown["signal"], saved["signal"]):
        np.testing.assert_allclose(signal, data.tod("signal"), rtol=0, atol=1e-9)
        assert signal.min() > 10
    # the signal has what changes with elevation besides, which is correlated with nothing in the
    # fluctuations
    found = data["stream_comparison"]
    assert found.power[0].sum() > found.power[1].sum()


def test_spectra_keep_the_unit_of_the_stream():
    """PSD of the delay / PSD of the PWV is the square of the ratio; each unit has a picture of its
    own.
    """
    steps = (
        atmosphere(outputs=EVERY),
        zonda.Efficiency(),
        zonda.PowerSpectrum(streams=["signal", *EVERY], segment="5 s"),
    )
    data = ran(*steps, zonda.TimeStreams(streams=EVERY))
    psd, streams = data.products["spectrum"].psd, data.products["time_streams"].streams
    ratio = float((streams["path_delay"] / streams["pwv"]).mean())
    assert psd["path_delay"] / psd["pwv"] == pytest.approx(ratio**2, rel=1e-3)
    names = [p.name for p in pictures(data, Plots())]
    assert {
        "power_spectra",
        "power_spectra_path_delay_pwv",
        "power_spectra_opacity",
        "tod_pwv",
        "tod_opacity",
    } <= {*names}


def test_components_of_plugins_are_referred_to_the_sky():
    """At the detector 1 mK is 1 mK / zeta on the sky; what enters calibrated is as it is."""
    data = ran(
        Ground(),
        Warm(),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.PowerSpectrum(streams=["ground", "warm"], segment="10 s"),
    )
    psd = data.products["spectrum"].psd
    assert psd["ground"].max() / psd["warm"].max() == pytest.approx(1 / 0.3**2, rel=1e-6)


@pytest.mark.parametrize("step", [zonda.TimeStreams, zonda.PowerSpectrum, zonda.SaveTOD])
def test_what_nobody_makes_is_an_error_that_names_what_there_is(step):
    with pytest.raises(
        ZondaError,
        match=(
            r"needs pwv, which no step provides(.|\n)*AtmosphereLayers makes it if its parameters"
        ),
    ):
        ran(atmosphere(), zonda.Efficiency(), step(streams=["pwv"]))
    with pytest.raises(
        ZondaError, match=r"needs groud, which no step provides(.|\n)*did you mean 'ground'"
    ):
        ran(Ground(), zonda.WhiteNoise(), zonda.Efficiency(), step(streams=["groud"]))
    with pytest.raises(ZondaError, match=r"streams"):
        step(streams=["../pwv"])
