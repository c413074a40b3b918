"""The atmosphere's power spectrum in closed form: its integral and its limits; that of pink noise beside simulated streams."""

import numpy as np
import pytest

import zonda
from zonda.operators.atmosphere.closed_form import layer_spectrum
from zonda.operators.atmosphere.turbulence.beams import Aperture
from zonda.operators.atmosphere.turbulence.covariance import beam_correlation
from zonda.operators.atmosphere.turbulence.nodes import Layer
from zonda.operators.diagnostics.series import Spectrum
from zonda.plugins.checks import scenes

F = np.geomspace(1e-6, 30, 6000)


def layer(sigma=40.0, aperture=None):
    return Layer(1.0, 1000.0, 1200.0, 500.0, sigma, aperture)


@pytest.mark.parametrize("speeds", [[10.0], [2.0, 20.0]])
def test_its_integral_is_the_variance_behind_the_beam(speeds):
    found = layer_spectrum(layer(), F, np.array(speeds))
    below = F[0] * found[0]  # level at low frequencies
    assert np.trapezoid(found, F) + below == pytest.approx(float(beam_correlation(0.0, 500.0, 40.0)[0]), rel=1e-4)


@pytest.mark.parametrize("taper", [0.0, 10.0])
def test_behind_an_aperture(taper):
    dish = Aperture(100.0, taper)
    found = layer_spectrum(layer(dish.sigma, dish), F, np.array([10.0]))
    assert np.trapezoid(found, F) + F[0] * found[0] == pytest.approx(dish.variance(500.0), rel=2e-3)
    # scales that a dish does not resolve look as behind the Gaussian of the same second moment
    low = F < 0.005
    assert found[low] == pytest.approx(layer_spectrum(layer(dish.sigma), F[low], np.array([10.0])), rel=0.01)


def test_faster_winds_move_it_to_higher_frequencies():
    """S(f; V) = S(f / c; V / c) / c."""
    slow, fast = layer_spectrum(layer(), F, np.array([5.0])), layer_spectrum(layer(), 3 * F, np.array([15.0]))
    assert fast == pytest.approx(slow / 3, rel=1e-12)


def test_pink_noise_and_the_mean_over_scans():
    scan = scenes.scan(37, 8000, radius=0.0)
    steps = [
        zonda.WhiteNoise(),
        zonda.PinkNoise(shared=0),
        zonda.Efficiency(),
        zonda.PowerSpectrum(segment="20 s", detectors=37),
    ]
    spectrum = scenes.run(steps, scan).products["spectrum"]
    use = (spectrum.frequency > 0.3) & (spectrum.frequency < 5)
    ratio = (spectrum.psd["pink"] / spectrum.closed_forms["pink"])[use]
    # 94 frequencies, half of them independent, 5 averages of 37 detectors: 1 %
    assert ratio.mean() == pytest.approx(1, abs=0.03)
    assert [name for name, _, _ in spectrum.regimes()] == ["pink", "white"]
    assert spectrum.regimes()[0][2] == pytest.approx(0.5, rel=0.1)  # the camera's knee
    again = Spectrum.of(spectrum.arrays())
    once = again.closed_forms["pink"].copy()
    again += Spectrum.of(spectrum.arrays())
    assert again.closed_forms["pink"] == pytest.approx(once)


def test_log_normal_fluctuations_have_none():
    steps = [zonda.AtmosphereLayers(pwv="2 mm", pwv_rms="25 %"), zonda.Efficiency(), zonda.PowerSpectrum()]
    assert scenes.run(steps, scenes.scan(3, 2000)).products["spectrum"].closed_forms == {}


def test_regimes_of_three_laws():
    f = np.geomspace(0.01, 50, 2000)
    laws = {"atmosphere": 1e-8 * f**-4, "pink": 2e-6 / f}
    made = Spectrum(f, {"signal": laws["pink"]}, 1.0, 2e-6, "P", 1, closed_forms=laws)
    (one, _, first), (two, _, second), (three, _, _) = made.regimes()
    assert [one, two, three] == ["atmosphere", "pink", "white"]
    assert (first, second) == pytest.approx((0.005 ** (1 / 3), 1.0), rel=0.01)
    assert Spectrum(f, {"signal": f}, 1.0, 0.0, "P", 1, closed_forms={"pink": f}).regimes() == []
