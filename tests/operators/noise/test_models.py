import numpy as np
import pytest

from zonda.core.instrument import Band
from zonda.core.numerics.radiation import BOLTZMANN, PLANCK, T_CMB, rayleigh_jeans
from zonda.core.numerics.smooth import SmoothField
from zonda.core.registry import noise_models
from zonda.operators.noise.models import FixedNet, NoiseModel, noise_model
from zonda.operators.noise.white import WhiteNoise
from zonda.plugins.noise_models import BackgroundLimited

NARROW = Band(name="narrow", low="149.9 GHz", high="150.1 GHz")


@pytest.mark.parametrize(("polarizations", "modes"), [(1, 1), (2, 1), (2, 5)])
@pytest.mark.parametrize("load", [0.1, 10.0, 200.0])
def test_narrow_band_formula(polarizations, modes, load):
    """For a narrow band (3) is NET^2 = (T^2 + h nu T / (k eta)) / (N width): the radiometer equation and the shot noise."""
    model = BackgroundLimited(optical_efficiency=0.4, polarizations=polarizations, modes=modes)
    net = model.net_of_load(NARROW, np.array([load]), np.zeros(1))
    shot = PLANCK * 150e9 / BOLTZMANN / 0.4
    expected = np.sqrt((load**2 + shot * load) / (polarizations * modes * 0.2e9))
    np.testing.assert_allclose(net, expected, rtol=1e-6)  # the band is 0.13 % wide: the mean of nu is exact


def test_wide_band_by_hand():
    band = Band(name="wide", low="80 GHz", high="160 GHz")
    model = BackgroundLimited(optical_efficiency=0.5)
    nu = np.linspace(80e9, 160e9, 20_001)
    temperature = 20.0 + 0.9 * rayleigh_jeans(nu, T_CMB)
    power = 0.5 * 2 * BOLTZMANN * temperature
    nep2 = 2 * np.trapezoid(PLANCK * nu * power, nu) + np.trapezoid(power**2, nu)
    expected = np.sqrt(nep2 / 2) / (0.5 * 2 * BOLTZMANN * 80e9)
    # 61 tabulated points integrate this smooth curve by trapezoids to better than 1e-4.
    np.testing.assert_allclose(model.net_of_load(band, np.full(3, 20.0), np.full(3, 0.9)), expected, rtol=1e-4)


def test_limits_of_load():
    model = BackgroundLimited()
    net = model.net_of_load(NARROW, np.array([0.01, 0.04, 1e3, 4e3]), np.zeros(4))
    assert net[1] / net[0] == pytest.approx(2, rel=0.01)  # photon noise: sqrt of the load
    assert net[3] / net[2] == pytest.approx(4, rel=0.02)  # bunching: the load


def test_background_without_atmosphere_is_the_cmb(make_observation):
    observation = make_observation(n_det=3)
    model = BackgroundLimited()
    expected = model.net_of_load(observation.instrument.band, np.zeros(3), np.ones(3))
    np.testing.assert_allclose(model.net(observation), expected)
    assert (expected > 0).all()


def test_load_comes_through_the_illuminated_aperture(make_observation):
    observation = make_observation(n_det=2, illumination_efficiency=0.8)
    for name, value in (("atmosphere", 30.0), ("transmission", 0.9)):
        observation.smooth[name] = SmoothField.constant(np.full(2, value), observation.n_samples)
    band = observation.instrument.band
    expected = BackgroundLimited().net_of_load(band, np.full(2, 0.8 * 30.0), np.full(2, 0.8 * 0.9))
    np.testing.assert_allclose(BackgroundLimited().net(observation), expected, rtol=1e-12)


def test_fixed(make_observation):
    observation = make_observation(n_det=3)
    np.testing.assert_allclose(FixedNet().net(observation), 1.7e-3)
    np.testing.assert_allclose(FixedNet(level="2 mK s(1/2)").net(observation), 2e-3)


def test_base_class_says_what_is_missing(make_observation):
    with pytest.raises(NotImplementedError, match="net"):
        NoiseModel().net(make_observation())


def test_by_name():
    class Mine(NoiseModel):
        factor: float = 1.0

        def net(self, observation):
            return observation.focalplane.net * self.factor

    noise_models.register(Mine, name="mine_for_test")
    noise_models.register(lambda: Mine(factor=4), name="made_for_test")
    noise_models.register(lambda: 7, name="wrong_for_test")
    assert noise_model("mine_for_test") == Mine(name="mine_for_test")
    assert noise_model({"name": "mine_for_test", "factor": 3}) == Mine(name="mine_for_test", factor=3)
    assert noise_model("made_for_test").factor == 4
    with pytest.raises(ValueError, match="is no NoiseModel"):
        noise_model("wrong_for_test")
    operator = WhiteNoise(model={"name": "mine_for_test", "factor": 3})
    again = WhiteNoise(**operator.model_dump(mode="json", exclude_none=True, exclude={"net", "reference"}))
    assert again.model == operator.model
    WhiteNoise.model_json_schema()
