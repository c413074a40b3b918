"""The background-limited NET against closed forms and by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from zonda.core.instrument import Band
from zonda.core.numerics.radiation import BOLTZMANN, PLANCK, T_CMB, rayleigh_jeans
from zonda.core.numerics.smooth import SmoothField
from zonda.plugins.noise_models import BackgroundLimited

NARROW = Band(name="narrow", low="149.9 GHz", high="150.1 GHz")


def scan(n_det, efficiency=1.0, **means):
    """What the model reads of an observation of 100 samples."""
    smooth = {name: SmoothField.constant(np.full(n_det, value), 100) for name, value in means.items()}
    plane = SimpleNamespace(illumination_efficiency=np.full(n_det, efficiency))
    return SimpleNamespace(n_detectors=n_det, focalplane=plane, smooth=smooth, instrument=SimpleNamespace(band=NARROW))


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


def test_background_without_atmosphere_is_the_cmb():
    model = BackgroundLimited()
    expected = model.net_of_load(NARROW, np.zeros(3), np.ones(3))
    np.testing.assert_allclose(model.net(scan(3)), expected)
    assert (expected > 0).all()


def test_load_comes_through_the_illuminated_aperture():
    expected = BackgroundLimited().net_of_load(NARROW, np.full(2, 0.8 * 30.0), np.full(2, 0.8 * 0.9))
    net = BackgroundLimited().net(scan(2, efficiency=0.8, atmosphere=30.0, transmission=0.9))
    np.testing.assert_allclose(net, expected, rtol=1e-12)
