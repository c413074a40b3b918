"""The background-limited NET against closed forms and by hand."""

from types import SimpleNamespace

import numpy as np
import pytest

from zonda.core.assembly.checks import run_checks
from zonda.core.configuration.pipeline_file import parse
from zonda.core.configuration.time import Instant
from zonda.core.errors import ZondaError
from zonda.core.instrument import Band
from zonda.core.numerics.radiation import BOLTZMANN, PLANCK, T_CMB, rayleigh_jeans
from zonda.core.numerics.smooth import SmoothField
from zonda.core.observation import LoadSpectra
from zonda.core.registry import sites
from zonda.operators.atmosphere.weather.bands import BandAtmosphere
from zonda.operators.atmosphere.weather.climatology import profile
from zonda.operators.atmosphere.weather.radiative_transfer import spectrum
from zonda.plugins.noise_models import BackgroundLimited

NARROW = Band(name="narrow", low="149.9 GHz", high="150.1 GHz")


def scan(n_det, efficiency=1.0, **means):
    """What the model reads of an observation of 100 samples."""
    smooth = {
        name: SmoothField.constant(np.full(n_det, value), 100) for name, value in means.items()
    }
    plane = SimpleNamespace(
        illumination_efficiency=np.full(n_det, efficiency), polarization_efficiency=np.zeros(n_det)
    )
    band = SimpleNamespace(band=NARROW)
    return SimpleNamespace(
        n_detectors=n_det, focalplane=plane, smooth=smooth, instrument=band, load_spectra=None
    )


@pytest.mark.parametrize(("polarizations", "modes"), [(1, 1), (2, 1), (2, 5)])
@pytest.mark.parametrize("load", [0.1, 10.0, 200.0])
def test_narrow_band_formula(polarizations, modes, load):
    """For a narrow band (3) is NET^2 = (T^2 + h nu T / (k eta)) / (N width): the radiometer
    equation and the shot noise.
    """
    model = BackgroundLimited(optical_efficiency=0.4, polarizations=polarizations, modes=modes)
    net = model.net_of_load(NARROW, np.array([load]), np.zeros(1))
    shot = PLANCK * 150e9 / BOLTZMANN / 0.4
    expected = np.sqrt((load**2 + shot * load) / (polarizations * modes * 0.2e9))
    np.testing.assert_allclose(
        net, expected, rtol=1e-6
    )  # the band is 0.13 % wide: the mean of nu is exact


def test_wide_band_by_hand():
    band = Band(name="wide", low="80 GHz", high="160 GHz")
    model = BackgroundLimited(optical_efficiency=0.5)
    nu = np.linspace(80e9, 160e9, 20_001)
    temperature = 20.0 + 0.9 * rayleigh_jeans(nu, T_CMB)
    power = 0.5 * 2 * BOLTZMANN * temperature
    nep2 = 2 * np.trapezoid(PLANCK * nu * power, nu) + np.trapezoid(power**2, nu)
    expected = np.sqrt(nep2 / 2) / (0.5 * 2 * BOLTZMANN * 80e9)
    # 61 tabulated points integrate this smooth curve by trapezoids to better than 1e-4.
    np.testing.assert_allclose(
        model.net_of_load(band, np.full(3, 20.0), np.full(3, 0.9)), expected, rtol=1e-4
    )


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
    expected = BackgroundLimited().net_of_load(
        NARROW, np.full(2, 0.8 * 30.0), np.full(2, 0.8 * 0.9)
    )
    net = BackgroundLimited().net(scan(2, efficiency=0.8, atmosphere=30.0, transmission=0.9))
    np.testing.assert_allclose(net, expected, rtol=1e-12)


# --------------------------------------------------------------------------------------------------
# polarization


def test_a_polarized_detector_accepts_one_polarization():
    """Half the power and half the noise's variance of two: sqrt(2) times the NET. Mixed focal
    planes: each detector its own.
    """
    model, load = BackgroundLimited(), np.full(3, 20.0)
    both = model.net_of_load(NARROW, load, np.zeros(3))
    net = model.net_of_load(NARROW, load, np.zeros(3), np.array([0.0, 1.0, 0.0]))
    np.testing.assert_allclose(net / both, [1, np.sqrt(2), 1], rtol=1e-12)
    one = BackgroundLimited(polarizations=1)
    np.testing.assert_allclose(
        one.net_of_load(NARROW, load, np.zeros(3)), np.sqrt(2) * both, rtol=1e-12
    )


@pytest.mark.parametrize("efficiency", [1.0, 0.9, 0.5, 1e-6])
def test_polarization_efficiency_shares_a_mode(efficiency):
    """Each of two modes bunches by itself: NEP^2 = 2 h nu P + 2 (P_1^2 + P_2^2) / dnu, P_1,2 = P (1
    +- p) / 2.
    """
    load, width, eta = 50.0, 0.2e9, 0.3
    power = eta * BOLTZMANN * load * width
    parts = power * np.array([1 + efficiency, 1 - efficiency]) / 2
    nep2 = 2 * PLANCK * 150e9 * power + 2 * (parts**2).sum() / width
    expected = np.sqrt(nep2 / 2) / (eta * BOLTZMANN * width)
    net = BackgroundLimited().net_of_load(
        NARROW, np.array([load]), np.zeros(1), np.array([efficiency])
    )
    np.testing.assert_allclose(net, expected, rtol=1e-6)  # of the band's 0.13 %


PAIRS = """
site: chajnantor
time: 2024-06-01T03:00
target: az 40 deg el 50 deg
seed: 1
instrument:
  {name: cam, telescope: {name: d, diameter: 6 m}, detectors: 38, field_of_view: 30 arcmin, main_beam_efficiency: 0.7,
   illumination_efficiency: 0.9, net: 300 uK s(1/2), knee: 0 Hz, sample_rate: 50 Hz, polarization: POLARIZATION, fwhm: 1.4 arcmin,
   band: {name: b150, low: 140 GHz, high: 160 GHz}}
operators:
  - PointingDaisy: {radius: 20 arcmin, speed: 5 arcmin/s, scan_duration: 60 s}
  - AtmosphereLayers: {pwv: 1 mm, pwv_rms: 0 %, layers: 1}
  - WhiteNoise: {model: MODEL}
  - Efficiency
  - HighpassFilter: {frequency: 0.1 Hz}
  - BinMap: {pixel: 1 arcmin}
"""


WARM = "{name: background_limited, telescope_temperature: 13 K}"


def pairs(polarization="pairs", model=WARM):
    return parse(PAIRS.replace("POLARIZATION", polarization).replace("MODEL", model))


def net_of(file):
    data = file.pipeline().run(file.scene())
    return data.observations[0].focalplane.net * 1e6


def test_pairs_at_150_ghz():
    """319.0 uK s^1/2 by hand for a flat load; over this band the atmosphere's slope adds 0.1 %. Two
    polarizations gave 225.6.
    """
    net = net_of(pairs())
    np.testing.assert_allclose(net, 319.0, rtol=5e-3)
    # Pairs lie elsewhere in the field than single detectors, up to 0.25 deg of elevation apart: 0.2
    # % each, less of their median.
    assert np.median(net) / np.median(net_of(pairs("none"))) == pytest.approx(np.sqrt(2), rel=1e-3)
    # The map's NOISE follows: std(signal / NOISE) of its own white noise is 1 within 4.5 / sqrt(2 x
    # 3000 pixels).
    file = pairs()
    data = file.pipeline().run(file.scene())
    found = data.products["map"]
    good = found.hits > 3
    spread = float(np.std((found.signal / found.noise)[good]))
    assert spread == pytest.approx(1, abs=4.5 / np.sqrt(2 * np.count_nonzero(good))), spread


def test_two_polarizations_of_a_polarized_detector_are_refused():
    file = pairs(model="{name: background_limited, polarizations: 2}")
    for refused in (
        lambda: run_checks(file.pipeline(), file.scene(), saved=False),
        lambda: net_of(file),
    ):
        with pytest.raises(
            ZondaError, match="has polarized detectors, each of which accepts one"
        ) as caught:
            refused()
        assert "WhiteNoise" in str(caught.value)
    assert net_of(pairs("none", "{name: background_limited, polarizations: 2}")).min() > 0


# -------------------------------------------------------------------------------------------------
# over the passband


@pytest.mark.parametrize(
    ("low", "high", "warm", "flat"),
    [(66, 118, 0.0, 1.46), (66, 118, 13.0, 1.25), (394, 428, 13.0, 1.05)],
)
def test_the_load_is_resolved_over_the_passband(low, high, warm, flat):
    """Against equations (1) to (3) integrated here, by radiative transfer in the cells of the
    absorption table, and beside what a flat load of the same mean gives: at 66 and 118 GHz oxygen,
    at 425 GHz water and oxygen."""
    band = Band(name="b", low=f"{low} GHz", high=f"{high} GHz")
    pwv, elevation = 0.84e-3, np.radians(45)
    air = profile(sites.create("llano_de_chajnantor"), Instant.parse("2022-08-01T23:00"))
    atmosphere = BandAtmosphere(band, air, 2e-3)
    seen = spectrum(air.scaled(pwv).layers, elevation, low=low * 1e9, high=high * 1e9)
    edges = np.clip(
        np.append(seen.frequency - 0.25e9, seen.frequency[-1] + 0.25e9), low * 1e9, high * 1e9
    )
    width, nu = np.diff(edges), (edges[1:] + edges[:-1]) / 2
    load = seen.brightness + seen.cmb + warm
    power = 0.3 * 2 * BOLTZMANN * load
    nep2 = 2 * (PLANCK * nu * power * width).sum() + (power**2 * width).sum()
    expected = np.sqrt(nep2 / 2) / (0.3 * 2 * BOLTZMANN * width.sum())

    means = {
        "atmosphere": atmosphere.emission(pwv, elevation),
        "transmission": atmosphere.transmission(pwv, elevation),
    }
    observation = scan(2, 1.0, **{k: float(v) for k, v in means.items()})
    observation.instrument = SimpleNamespace(band=band)
    model = BackgroundLimited(telescope_temperature=f"{warm} K")
    today = model.net(observation)
    observation.load_spectra = lambda: atmosphere.transfer.spectra(
        pwv, [elevation * 0.99, elevation * 1.01]
    )
    net = model.net(observation)
    # The half-cells at the edges have the brightness of the whole cell here, 0.125 GHz beside their
    # middle in the product: at 66 GHz 15 % of their load, 1.4 % of the bunching.
    np.testing.assert_allclose(net, expected, rtol=1e-2)
    np.testing.assert_allclose(net / today, flat, atol=0.01)


def test_steep_passbands_weigh_the_noise_with_their_square(tmp_path):
    """A triangle: int t^2 = 2/3 int t, exact between its corners."""
    path = tmp_path / "band.txt"
    path.write_text("149.9 0\n150 1\n150.1 0\n")
    band, load, eta = Band(name="b", file=path), 100.0, 0.3
    expected = np.sqrt(load**2 * 2 / 3 + PLANCK * 150e9 * load / (BOLTZMANN * eta)) / np.sqrt(
        2 * 0.1e9
    )
    net = BackgroundLimited().net_of_load(band, np.array([load]), np.zeros(1))
    np.testing.assert_allclose(net, expected, rtol=1e-3)  # 0.13 % wide


@pytest.mark.parametrize("rows", ["80 0\n90 1\n130 0\n", "80 1\n130 1\n", "80 1\n130 0.2\n"])
@pytest.mark.parametrize("efficiency", [0.0, 0.9])
def test_passbands_of_few_rows(tmp_path, rows, efficiency):
    """The photons' energy changes along a straight line of the table: equations (1) to (3) on 40
    001 points.
    """
    path = tmp_path / "band.txt"
    path.write_text(rows)
    band, eta = Band(name="b", file=path), 0.05
    nu = np.linspace(80e9, 130e9, 40_001)
    t, load = np.interp(nu, band.frequency, band.transmission), 12 + 0.8 * rayleigh_jeans(nu, T_CMB)
    n, bunching = (1, (1 + efficiency**2) / 2) if efficiency else (2, 1)
    power = eta * n * t * BOLTZMANN * load
    nep2 = 2 * np.trapezoid(PLANCK * nu * power, nu) + 2 * bunching / n * np.trapezoid(power**2, nu)
    expected = np.sqrt(nep2 / 2) / (eta * n * BOLTZMANN * np.trapezoid(t, nu))
    model = BackgroundLimited(optical_efficiency=eta)
    net = model.net_of_load(band, np.array([12.0]), np.array([0.8]), np.array([efficiency]))
    np.testing.assert_allclose(
        net, expected, rtol=5e-5
    )  # 1 / 12 n^2 of 40 / 110, n = 32, in the square


def test_what_another_step_emits_is_taken_to_be_flat():
    band = Band(name="b", low="140 GHz", high="160 GHz")
    spectra = LoadSpectra(
        np.array([145e9, 155e9]),
        np.full(2, 10e9),
        np.full(2, 10e9),
        np.array([[10.0, 30.0]]),
        np.zeros((1, 2)),
    )
    observation = scan(2, 1.0, atmosphere=25.0, transmission=0.0)
    observation.instrument, observation.load_spectra = SimpleNamespace(band=band), lambda: spectra
    flat = LoadSpectra(
        *(getattr(spectra, k) for k in ("frequency", "width", "square")),
        np.array([[15.0, 35.0]]),
        np.zeros((1, 2)),
    )
    net = BackgroundLimited().net(observation)
    observation.load_spectra = lambda: flat
    np.testing.assert_allclose(net, BackgroundLimited().net(observation), rtol=1e-12)
