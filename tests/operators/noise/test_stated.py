"""What a map and a file of time streams state of the noise is what was simulated, whatever the
level follows from.
"""

import h5py
import numpy as np
import pytest

import zonda
from zonda.core.errors import PipelineError
from zonda.core.numerics.smooth import SmoothField
from zonda.core.operator import Operator
from zonda.operators.io.save_tod import load_tod
from zonda.operators.noise.models import rms_of_inverse
from zonda.operators.noise.white import WhiteNoise
from zonda.plugins.checks.scenes import camera

from ...checks.noise import levels, over_stated

DETECTOR = {"net": "1 mK s(1/2)", "reference": "detector"}


def run(
    white,
    *,
    runs=None,
    output=None,
    extra=(),
    pwv="1.5 mm",
    weights="inverse_variance",
    after=(),
    pink=(),
    duration="10 s",
):
    instrument = camera(low="800 GHz", high="900 GHz")
    scene = zonda.Scene(
        site="chajnantor", instrument=instrument, time="2024-07-25T03:00", target="17h -20d", seed=1
    )
    steps = [
        zonda.PointingDaisy(radius="4 arcmin", speed="1 arcmin/s", scan_duration=duration),
        *white,  # before the atmosphere: levels are resolved when every step is configured
        *extra,
        zonda.AtmosphereLayers(pwv=pwv, pwv_rms="0 %"),
        *pink,
        zonda.Efficiency(),
        *after,
        zonda.BinMap(pixel="10 arcsec", weights=weights, half_difference=False),
    ]
    return zonda.Pipeline(steps, runs=runs or {}).run(
        scene, output=output, keep=["white"] if white else []
    )


@pytest.mark.parametrize("kind", levels())
def test_signal_over_noise_has_unit_rms(kind):
    ratio, error = over_stated(levels()[kind], scatter="10 %")
    assert abs(ratio - 1) < 4.5 * error


def test_white_noise_of_two_steps_adds_in_quadrature():
    ratio, error = over_stated(WhiteNoise(**DETECTOR), WhiteNoise(net="20 mK s(1/2)"))
    assert abs(ratio - 1) < 4.5 * error


@pytest.mark.parametrize(
    "level", [DETECTOR, {"model": "background_limited"}], ids=["detector", "background"]
)
def test_detectors_weigh_by_the_noise_they_have(level):
    """With levels that scatter, the optimal weights are 1 / NET_d^2, and a map with them is the
    deeper one.
    """
    data = run(
        [WhiteNoise(**level, scatter="60 %")],
        runs={"quiet": {"without": ["white"], "modes": "full"}},
    )
    net = data.observations[0].focalplane.net
    assert net.std() / net.mean() > 0.2
    product = data.products["map"]
    # each sample adds 1 / (NET_d^2 f_s): its weight; no sample is dropped, so that the total
    # follows
    total = data.observations[0].n_samples * (net**-2.0).sum() / data.observations[0].sample_rate
    assert product.weights.sum() == pytest.approx(
        total, rel=1e-6
    )  # weights are rounded to 2^-30 of the quietest's
    deep = product.hits > 20
    alike = run([WhiteNoise(**level, scatter="60 %")], weights="uniform").products["map"]
    assert np.median(product.noise[deep]) < 0.95 * np.median(alike.noise[deep])


def test_runs_without_noise_have_the_weights_of_the_main_run():
    runs = {"noiseless": {"only": ["atmosphere"], "modes": "own"}}
    products = run([WhiteNoise(**DETECTOR, scatter="50 %")], runs=runs).products
    assert np.array_equal(products["noiseless/map"].weights, products["map"].weights)
    assert np.array_equal(products["noiseless/map"].noise, products["map"].noise, equal_nan=True)


def test_saved_streams_state_the_noise_that_was_simulated(tmp_path):
    """The file's psd_net, knee and psd against the streams: NET is the rms of 1 s, at the knee pink
    noise equals white.
    """
    pink = zonda.PinkNoise(knee="2 Hz", slope=2.0)
    data = run(
        [WhiteNoise(**DETECTOR)],
        output=tmp_path,
        pink=[pink],
        after=[zonda.SaveTOD()],
        duration="60 s",
    )
    o = data.observations[0]
    tod = load_tod(data.products["tod_file"][0])
    assert np.array_equal(tod.columns["net"], o.focalplane.net)
    transmission = o.smooth["transmission"].evaluate(slice(0, o.n_detectors), slice(0, o.n_samples))
    white = o.detdata["white"] / transmission / o.focalplane.main_beam_efficiency[:, None]
    measured = white.std() / np.sqrt(o.sample_rate)
    assert tod.columns["net"].mean() == pytest.approx(
        measured, rel=4.5 / np.sqrt(2 * white.size) + 1e-4
    )  # 1e-4: varies over the field
    np.testing.assert_allclose(tod.columns["knee"], 2.0)
    np.testing.assert_allclose(tod.columns["slope"], 2.0)
    with h5py.File(data.products["tod_file"][0]) as file:
        frequency, psd = file["metadata/noise_model/psds"][:2]
    assert np.interp(2.0, frequency, psd) == pytest.approx(
        2 * tod.columns["net"][0] ** 2, rel=0.02
    )  # 100 frequencies


def test_pink_noise_of_a_level_of_its_own_moves_the_stated_knee(tmp_path):
    """Pink noise of 4 times the white level with slope 2: its power equals the white noise's at 4
    times the knee.
    """
    pink = zonda.PinkNoise(net="4 mK s(1/2)", reference="detector", knee="0.5 Hz", slope=2.0)
    data = run([WhiteNoise(**DETECTOR)], output=tmp_path, pink=[pink], after=[zonda.SaveTOD()])
    np.testing.assert_allclose(load_tod(data.products["tod_file"][0]).columns["knee"], 2.0)


def test_without_pink_noise_no_knee_is_stated(tmp_path):
    data = run([WhiteNoise(**DETECTOR)], output=tmp_path, after=[zonda.SaveTOD()])
    assert camera().knee > 0
    assert (load_tod(data.products["tod_file"][0]).columns["knee"] == 0).all()


class Cloud(Operator):
    """Adds to the load, where a level that follows from it has been resolved."""

    requires = frozenset({"boresight"})

    def prepare(self, observation):
        n = observation.n_detectors
        observation.smooth["atmosphere"] = SmoothField.constant(
            np.full(n, 300.0), observation.n_samples
        )


def test_a_load_that_is_set_too_late_is_refused():
    with pytest.raises(
        PipelineError, match=r"(?s)WhiteNoise.*mean atmosphere after the noise level.*configure"
    ):
        run([WhiteNoise(model="background_limited")], extra=[Cloud()])
    run([WhiteNoise()], extra=[Cloud()])  # a NET on the sky does not follow from it


def test_noise_grows_with_the_transmission_at_every_moment():
    """rms over a scan of 1 / <e^-tau> for a transmission that falls to a third, against the mean of
    its samples.
    """
    n = 4096
    t = 0.6 - 0.4 * np.arange(-12 * 128, n + 15 * 128, 128) / n
    field = SmoothField.from_values(np.ones((3, 1)), t[None], 128, n)
    exact = np.sqrt(np.mean(field.evaluate(slice(0, 3), slice(0, n)) ** -2.0, axis=1))
    np.testing.assert_allclose(
        rms_of_inverse(field, 3), exact, rtol=1e-3
    )  # midpoints of 32 cells: h^2 f'' / 24


def test_each_scan_has_a_level_of_its_own():
    """Two scans an hour apart: the load differs, and so does the NET that is told of each."""
    instrument = camera(low="800 GHz", high="900 GHz")
    scene = zonda.Scene(
        site="chajnantor", instrument=instrument, time="2024-07-25T03:00", target="17h -20d", seed=1
    )
    steps = [
        zonda.PointingDaisy(
            radius="4 arcmin", speed="1 arcmin/s", scan_duration="5 s", scans=2, gap="1 h"
        ),
        zonda.AtmosphereLayers(pwv="1.5 mm", pwv_rms="0 %"),
        WhiteNoise(model="background_limited"),
        zonda.Efficiency(),
    ]
    data = zonda.Pipeline(steps).run(scene)
    told = {what: text for who, what, text in data.log if who == "WhiteNoise"}
    for o in data.observations:
        net = 1e3 * float(np.median(o.focalplane.net))
        assert float(
            told[f"{o.name}: NET on the sky, median (range), mK s^1/2"].split()[0]
        ) == pytest.approx(net, rel=1e-3)
    first, second = (float(o.focalplane.net.mean()) for o in data.observations)
    assert abs(second / first - 1) > 0.01


@pytest.mark.parametrize("white", [[], [WhiteNoise()]], ids=["none", "white"])
def test_a_run_without_white_noise_says_so(white, tmp_path):
    data = run(white, output=tmp_path, after=[zonda.SaveTOD(), zonda.PowerSpectrum(segment="2 s")])
    told = [who for who, _, text in data.log if text.endswith("no white noise")]
    assert told == ([] if white else ["BinMap", "SaveTOD"])
    assert (data.products["spectrum"].white_level > 0) == bool(white)
