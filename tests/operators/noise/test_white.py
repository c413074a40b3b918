import numpy as np
import pytest

import zonda
from zonda.core.errors import ZondaError
from zonda.core.numerics.smooth import SmoothField
from zonda.operators.noise.models import FixedNet, NoiseModel
from zonda.operators.noise.white import WhiteNoise
from zonda.plugins.noise_models import BackgroundLimited

NET = 1.7e-3


def test_net_is_the_rms_of_one_second(make_observation, simulate):
    white = simulate(make_observation(n_samp=100 * 2000), WhiteNoise())["white"]
    seconds = white.reshape(16, 2000, 100).astype(np.float64).mean(2)
    assert seconds.std() == pytest.approx(
        NET, rel=4.5 / np.sqrt(2 * seconds.size)
    )  # standard error of an rms
    assert white.std() == pytest.approx(NET * np.sqrt(100), rel=4.5 / np.sqrt(2 * white.size))


@pytest.mark.parametrize("rate", [50.0, 400.0])
def test_spectrum_is_flat_at_twice_net_squared_at_any_rate(make_observation, simulate, rate):
    white = simulate(make_observation(n_samp=1 << 15, rate=rate), WhiteNoise())["white"].astype(
        np.float64
    )
    psd = 2 / (rate * white.shape[1]) * abs(np.fft.rfft(white, axis=1)[:, 1:-1]) ** 2
    bands = psd.mean(0)[: 16 * 1023].reshape(16, 1023).mean(1)
    # Each of the 16 x 1023 values of a band is exponentially distributed: relative standard error 1
    # / sqrt(number).
    np.testing.assert_allclose(bands, 2 * NET**2, rtol=4.5 / np.sqrt(16 * 1023))


def test_noise_on_the_sky_passes_beam_and_atmosphere(make_observation, simulate):
    observation = make_observation(n_det=2, n_samp=1 << 16, zeta=0.3)
    observation.smooth["transmission"] = SmoothField.constant(
        np.array([0.5, 0.8]), observation.n_samples
    )
    white = simulate(observation, WhiteNoise())["white"]
    rms = NET * np.sqrt(100) * 0.3 * np.array([0.5, 0.8])
    np.testing.assert_allclose(
        white.std(1, dtype=np.float64), rms, rtol=4.5 / np.sqrt(2 * observation.n_samples)
    )
    at_unity = simulate(make_observation(n_det=2, n_samp=1 << 16), WhiteNoise())["white"]
    np.testing.assert_allclose(white, at_unity * (0.3 * np.array([[0.5], [0.8]])), rtol=1e-5)
    np.testing.assert_allclose(observation.focalplane.net, NET)


def test_noise_at_the_detector_ignores_beam_and_atmosphere(make_observation, simulate):
    observation = make_observation(n_det=2, zeta=0.3)
    observation.smooth["transmission"] = SmoothField.constant(
        np.array([0.5, 0.8]), observation.n_samples
    )
    white = simulate(observation, WhiteNoise(net="1.7 mK s(1/2)", reference="detector"))["white"]
    np.testing.assert_allclose(
        white, simulate(make_observation(n_det=2), WhiteNoise())["white"], rtol=1e-6
    )
    np.testing.assert_allclose(observation.focalplane.net, NET / (0.3 * np.array([0.5, 0.8])))


def test_efficiency_may_be_resolved_later(make_observation, simulate):
    class Late(WhiteNoise):
        def prepare(self, observation):
            observation.focalplane.main_beam_efficiency = np.full(observation.n_detectors, 0.3)
            return super().prepare(observation)

    whole, late = (
        simulate(make_observation(n_det=2), kind())["white"]
        for kind in (WhiteNoise, lambda: Late(name="WhiteNoise"))
    )
    np.testing.assert_allclose(late, 0.3 * whole, rtol=1e-6)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_blocks_never_change_a_bit(make_observation, simulate, dtype):
    whole = simulate(make_observation(n_det=37, n_samp=10_000), WhiteNoise(), dtype=dtype)["white"]
    blocks = [
        (slice(d, min(d + 16, 37)), slice(t, min(t + 4096, 10_000)))
        for t in (8192, 0, 4096)
        for d in (32, 0, 16)
    ]
    assert np.array_equal(
        simulate(
            make_observation(n_det=37, n_samp=10_000), WhiteNoise(), blocks=blocks, dtype=dtype
        )["white"],
        whole,
    )
    fewer = simulate(make_observation(n_det=5, n_samp=3000), WhiteNoise(), dtype=dtype)["white"]
    assert np.array_equal(fewer, whole[:5, :3000])
    assert whole.dtype == dtype


def test_independent_between_detectors_observations_seeds_and_steps(make_observation, simulate):
    n = 1 << 16
    first = simulate(make_observation(n_samp=n), WhiteNoise())["white"].astype(np.float64)
    bound = 5 / np.sqrt(
        n
    )  # standard error of a correlation coefficient; 120 + 3 x 16 of them are tried
    correlation = np.corrcoef(first)
    assert abs(correlation - np.eye(16)).max() < bound
    others = [
        ({"seed": 2}, WhiteNoise()),
        ({"index": 1}, WhiteNoise()),
        ({}, WhiteNoise(name="other")),
    ]
    for arguments, operator in others:
        other = simulate(make_observation(n_samp=n, **arguments), operator)["white"]
        assert abs((first * other).mean(1)).max() < bound * NET**2 * 100
    assert np.array_equal(
        simulate(make_observation(n_samp=n), WhiteNoise())["white"], first.astype(np.float32)
    )


def test_scatter(make_observation, simulate):
    def net(**arguments):
        observation = make_observation(n_det=4000, n_samp=1, **arguments)
        simulate(observation, WhiteNoise(scatter="20 %"))
        return observation.focalplane.net

    n = 4000
    first = net()
    assert first.mean() == pytest.approx(NET, rel=4.5 * 0.2 / np.sqrt(n))
    # Relative variance of a sample rms is (kurtosis - 1) / 4 n; the kurtosis of this log-normal is
    # 3.7.
    assert first.std() == pytest.approx(0.2 * NET, rel=4.5 * np.sqrt(2.7 / 4 / n))
    assert first.min() > 0
    assert np.array_equal(first, net(index=3))
    assert not np.array_equal(first, net(seed=3))


def test_scatter_enters_the_stream(make_observation, simulate):
    observation = make_observation(n_det=8, n_samp=1 << 15)
    white = simulate(observation, WhiteNoise(scatter=0.5))["white"]
    np.testing.assert_allclose(
        white.std(1, dtype=float) / 10, observation.focalplane.net, rtol=4.5 / np.sqrt(1 << 16)
    )
    assert np.ptp(observation.focalplane.net) > 0.2 * NET


def test_background_limited_follows_the_load(make_observation, simulate):
    rms = []
    for kelvin in (5.0, 50.0):
        observation = make_observation(
            n_det=2, n_samp=1 << 14, zeta=0.5, illumination_efficiency=0.8
        )
        observation.smooth["atmosphere"] = SmoothField.constant(
            np.full(2, kelvin), observation.n_samples
        )
        observation.smooth["transmission"] = SmoothField.constant(
            np.full(2, 0.9), observation.n_samples
        )
        model = BackgroundLimited(telescope_temperature="4 K")
        white = simulate(observation, WhiteNoise(model=model))["white"]
        expected = model.net_of_load(
            observation.instrument.band, np.full(2, 0.8 * kelvin + 4), np.full(2, 0.8 * 0.9)
        )
        np.testing.assert_allclose(
            white.std(1, dtype=float), 10 * expected, rtol=4.5 / np.sqrt(1 << 15)
        )
        np.testing.assert_allclose(observation.focalplane.net, expected / (0.5 * 0.9))
        rms.append(expected[0])
    assert rms[1] > 3 * rms[0]


def test_third_party_model(make_observation, simulate):
    class Ramp(NoiseModel):
        per_detector: float = 1e-3

        def net(self, observation):
            return self.per_detector * (1 + np.arange(observation.n_detectors))

    observation = make_observation(n_det=4)
    simulate(observation, WhiteNoise(model=Ramp()))
    np.testing.assert_allclose(observation.focalplane.net, 1e-3 * np.arange(1, 5))


def test_the_level_is_stated(make_observation, simulate):
    observation = make_observation()
    simulate(observation, WhiteNoise())
    assert ("WhiteNoise", "NET on the sky, median (range), mK s^1/2", "1.7") in list(
        observation.log
    )


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"net": "1 mK s(1/2)", "model": FixedNet()}, "either net"),
        ({"reference": "detector", "model": FixedNet()}, "either net"),
        ({"reference": "detector"}, "needs net"),
        ({"net": "-1 mK s(1/2)"}, "at least 0"),
        ({"net": "1 mK"}, "noise level"),
        ({"scatter": -0.1}, "at least 0"),
        ({"model": "no_such_model"}, "unknown noise model 'no_such_model'"),
        ({"model": {"level": "1 mK s(1/2)"}}, "name a noise model"),
    ],
)
def test_bad_parameters(arguments, message):
    with pytest.raises(ZondaError, match=message):
        WhiteNoise(**arguments)


@pytest.mark.parametrize("nets", [(None, "0.3 mK s(1/2)"), ("0.3 mK s(1/2)", None)])
def test_a_level_that_is_stated_is_not_that_of_another_step(nets):
    """Variances add up: the instrument's NET and 0.3 mK s^1/2. Of 446 000 samples the rms errs by
    0.1 %; four times that.
    """
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d", seed=1
    )
    noise = [zonda.WhiteNoise(net=net) if net else zonda.WhiteNoise() for net in nets]
    steps = [zonda.PointingDaisy(scan_duration="20 s"), *noise, zonda.Efficiency()]
    (scan,) = zonda.Pipeline(steps).run(scene, threads=1, keep=["signal"]).observations
    expected = np.hypot(scene.instrument.net, 3e-4) * np.sqrt(scan.sample_rate)
    assert scan.detdata["signal"].std() == pytest.approx(expected, rel=4.3e-3)
