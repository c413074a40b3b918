"""The atmosphere's power spectrum in closed form: its integral and its limits; that of pink noise
beside simulated streams.
"""

import numpy as np
import pytest

import zonda
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.operators.atmosphere.layers import KNOTS, WAVE_NUMBERS, between_knots, layer_spectrum
from zonda.operators.atmosphere.turbulence.beams import Aperture
from zonda.operators.atmosphere.turbulence.covariance import beam_correlation, mixture
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
    assert np.trapezoid(found, F) + below == pytest.approx(
        float(beam_correlation(0.0, 500.0, 40.0)[0]), rel=1e-4
    )


@pytest.mark.parametrize("taper", [0.0, 10.0])
def test_behind_an_aperture(taper):
    dish = Aperture(100.0, taper)
    found = layer_spectrum(layer(dish.sigma, dish), F, np.array([10.0]))
    assert np.trapezoid(found, F) + F[0] * found[0] == pytest.approx(dish.variance(500.0), rel=2e-3)
    # scales that a dish does not resolve look as behind the Gaussian of the same second moment
    low = F < 0.005
    assert found[low] == pytest.approx(
        layer_spectrum(layer(dish.sigma), F[low], np.array([10.0])), rel=0.01
    )


def test_faster_winds_move_it_to_higher_frequencies():
    """S(f; V) = S(f / c; V / c) / c."""
    slow, fast = (
        layer_spectrum(layer(), F, np.array([5.0])),
        layer_spectrum(layer(), 3 * F, np.array([15.0])),
    )
    assert fast == pytest.approx(slow / 3, rel=1e-12)


def test_its_sum_of_gaussians_is_fine_enough():
    """The shorter sum agrees with the one of 1e-14 until the power is 1e-12 of the largest."""
    f, speed = np.geomspace(1e-4, 0.3, 200), 10.0
    e, w = mixture(500.0, 40.0)
    fine = (
        2
        / speed
        * np.exp(-np.multiply.outer((2 * np.pi * f / speed) ** 2, e))
        @ (w * np.sqrt(4 * np.pi * e))
    )
    seen = fine > 1e-12 * fine[0]
    assert f[seen].max() > 0.15
    np.testing.assert_allclose(
        layer_spectrum(layer(), f[seen], np.array([speed])), fine[seen], rtol=1e-6
    )


def test_many_speeds_share_one_table():
    """Against the sum over the speeds; the error is that of
    `test_between_knots_it_is_the_law_itself` times (h / 0.059)^2.
    """
    f, speeds = np.geomspace(0.004, 50, 100), np.geomspace(5.0, 20.0, 64)
    found = layer_spectrum(layer(), f, speeds)
    direct = np.mean([layer_spectrum(layer(), f, np.array([v])) for v in speeds], axis=0)
    assert f.size * speeds.size > WAVE_NUMBERS
    seen = direct > 1e-6 * direct[0]
    # h = ln(50 / 0.004 x 4) / 640 = 0.017: 0.012 times 0.083
    np.testing.assert_allclose(found[seen], direct[seen], rtol=1e-3)
    assert not np.array_equal(found, direct)


# ---- between knots


def law_of(f):
    """A layer behind a 100 m beam: it falls by more than any power."""
    return layer_spectrum(layer(), f, np.array([8.0, 20.0]))


def test_between_knots_it_is_the_law_itself():
    f = np.geomspace(0.004, 50, 4000)
    direct, found = law_of(f), between_knots(law_of, f)
    # P = exp(-x^2), x proportional to f: h^2 / 8 |d^2 ln P / d(ln f)^2| = h^2 x^2 / 2 = 0.8, 1.6,
    # 2.4 % at most with h = 0.059; half of that, since the Kolmogorov spectrum in front of it falls
    # without a curvature
    for depth, error in ((1e-2, 0.004), (1e-4, 0.008), (1e-6, 0.012)):
        seen = direct > depth * direct[0]
        np.testing.assert_allclose(found[seen], direct[seen], rtol=error)
    assert not np.array_equal(found, direct)
    few = f[:: f.size // KNOTS + 1]
    assert np.array_equal(between_knots(law_of, few), law_of(few))


def test_between_knots_the_frequency_zero_and_the_order_do_not_matter():
    f = np.linspace(0.0, 2.0, 801)
    found = between_knots(law_of, f)
    assert np.isfinite(found).all()
    assert found[0] == law_of(np.zeros(1))[0]
    assert found[1:] == pytest.approx(between_knots(law_of, f[1:]))
    assert np.array_equal(between_knots(law_of, f[::-1]), found[::-1])


# ---- beside simulated streams


def through_hann(law, number, step):
    """Expectation of Welch's periodogram at k ``step``, k = 1 ... ``number`` - 1: the law convolved
    with the window's |W|^2.
    """
    fine, length = 4, 2 * number
    window = 0.5 - 0.5 * np.cos(2 * np.pi * np.arange(length) / length)
    kernel = np.abs(np.fft.fft(window, fine * length)) ** 2
    at = law(np.arange(fine * number + 1) * step / fine)
    both = np.concatenate([at, at[-2:0:-1]])  # of negative frequencies, too
    smooth = np.fft.ifft(np.fft.fft(both) * np.fft.fft(kernel / kernel.sum())).real
    return smooth[fine : fine * number : fine]


@pytest.mark.parametrize("radius", [0.0, 4.0])
def test_an_ensemble_of_streams_has_it(radius):
    """Ten layers, a stare and a scan, 12 atmospheres. Each band's mean is within 4 standard errors,
    as they scatter (t of 11 degrees of freedom exceeds 4 once in 500)."""
    camera = Instrument(
        name="camera",
        telescope=Telescope(name="dish", diameter="6 m"),
        band=Band(name="band", low="78 GHz", high="108 GHz"),
        detectors=1,
        field_of_view="0 deg",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1 mK s(1/2)",
        knee="0.5 Hz",
        sample_rate="100 Hz",
    )
    steps = [
        zonda.AtmosphereLayers(pwv="5 mm", pwv_rms="1 %"),
        zonda.Efficiency(),
        zonda.PowerSpectrum(segment="20 s", streams=["atmosphere"]),
    ]
    ratios = []
    for seed in range(12):
        scan = scenes.scan(1, 10_000, radius=radius, instrument=camera)
        scan.seed = seed
        spectrum = scenes.run(steps, scan).products["spectrum"]
        if not ratios:
            f = spectrum.frequency
            expected = through_hann(
                lambda x, scan=scan: scan.closed_forms["atmosphere"][0](x), f.size, f[0]
            )
        ratios.append(spectrum.psd["atmosphere"][:31] / expected[:31])
    for low, high in (
        (4, 8),
        (8, 16),
        (16, 32),
    ):  # 0.2 to 1.6 Hz, where the power falls by a factor of 2000
        band = np.array(ratios)[:, low - 1 : high - 1].mean(axis=1)
        error = band.std(ddof=1) / np.sqrt(band.size)
        assert error < 0.15
        assert band.mean() == pytest.approx(1, abs=4 * error)
    assert expected[3] > 100 * expected[31]


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
    steps = [
        zonda.AtmosphereLayers(pwv="2 mm", pwv_rms="25 %"),
        zonda.Efficiency(),
        zonda.PowerSpectrum(),
    ]
    assert scenes.run(steps, scenes.scan(3, 2000)).products["spectrum"].closed_forms == {}


def test_regimes_of_three_laws():
    f = np.geomspace(0.01, 50, 2000)
    laws = {"atmosphere": 1e-8 * f**-4, "pink": 2e-6 / f}
    made = Spectrum(f, {"signal": laws["pink"]}, 1.0, 2e-6, "P", 1, closed_forms=laws)
    (one, _, first), (two, _, second), (three, _, _) = made.regimes()
    assert [one, two, three] == ["atmosphere", "pink", "white"]
    assert (first, second) == pytest.approx((0.005 ** (1 / 3), 1.0), rel=0.01)
    assert Spectrum(f, {"signal": f}, 1.0, 0.0, "P", 1, closed_forms={"pink": f}).regimes() == []


@pytest.mark.parametrize("how", ["column", "layer"])
def test_waves_across_the_focal_plane_add_up_to_the_spectrum(how):
    """Equation (3) cut into parts, and a layer's waves of a frequency f are those above
    2 pi f distance / V."""
    steps = [zonda.AtmosphereLayers(pwv="5 mm", layer_response=how), zonda.Efficiency()]
    scan = scenes.scan(5, 2000, radius=4.0)
    scenes.run([*steps, zonda.PowerSpectrum(segment="5 s")], scan)
    (law,) = scan.closed_forms["atmosphere"]
    f, edges = np.geomspace(0.05, 2, 12), np.concatenate([[0], np.geomspace(10, 1e5, 20), [np.inf]])
    parts = law.across(f, edges)
    assert (parts >= 0).all()
    # 300 nodes of the integral over q, 16 speeds of 64: 2 % each
    np.testing.assert_allclose(parts.sum(axis=1), law(f), rtol=0.05, atol=1e-9 * law(f[:1])[0])
    first = (np.cumsum(parts, axis=1) > 0.01 * parts.sum(axis=1, keepdims=True)).argmax(axis=1)
    assert (np.diff(first) >= 0).all()
    assert first[-1] > first[0]
