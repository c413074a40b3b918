"""A half-wave plate modulates polarization at four times its frequency; optics that polarize make
intensity seem polarized.
"""

import numpy as np
import pytest

import zonda
import zonda.testing
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.optics.polarizers import HalfWavePlate, Leakage
from zonda.operators.sky.skymap import SkyMap
from zonda.plugins.checks.scenes import run, scan

HEADER = {
    "CTYPE1": "RA---TAN",
    "CTYPE2": "DEC--TAN",
    "CUNIT1": "deg",
    "CUNIT2": "deg",
    "RADESYS": "ICRS",
    "CRPIX1": 256.5,
    "CRPIX2": 256.5,
    "CRVAL1": 75.0,
    "CRVAL2": 20.0,
    "CDELT1": -3 / 3600,
    "CDELT2": 3 / 3600,
}


def pairs(n_det=8, n=4000, radius=1.0, efficiency=0.8):
    o = scan(n_det, n, radius=radius)
    o.focalplane.polarization_angle[:] = np.resize(np.radians([0.0, 90.0, 45.0, 135.0]), n_det)
    o.focalplane.polarization_efficiency[:] = efficiency
    return o


def uniform_sky(i, q, u):
    values = np.stack([np.full((512, 512), v) for v in (i, q, u)])
    return SkyMap(map=values, wcs=HEADER, unit="K_RJ", polarization_convention="cosmo", beam="none")


@pytest.mark.parametrize(
    "operator", [HalfWavePlate(frequency="2 Hz"), Leakage(share="1 %", angle="20 deg")]
)
def test_it_keeps_the_contract(operator):
    zonda.testing.check_operator(operator)


def test_what_a_staring_detector_sees_is_modulated_at_four_times_the_frequency():
    o = pairs(4, 4000, radius=0.0)
    data = run(
        [uniform_sky(1.0, 0.3, -0.2), HalfWavePlate(frequency="2 Hz", angle="11 deg")],
        o,
        keep=("sky",),
    )
    found = data.observations[0].detdata["sky"]
    spectrum = np.abs(np.fft.rfft(found, axis=1)) / 2000
    at = 8 * 40  # 8 Hz in 40 s
    np.testing.assert_allclose(spectrum[:, at], 0.8 * np.hypot(0.3, 0.2), rtol=1e-9)
    spectrum[:, [0, at]] = 0
    assert spectrum.max() < 1e-9
    np.testing.assert_allclose(found.mean(axis=1), 1.0, rtol=1e-12)


def test_one_detector_with_a_plate_makes_a_map_of_i_q_u():
    """Without it every pixel of a stare has one angle."""
    sky = uniform_sky(1.0, 0.3, -0.2)
    for steps, solved in (([HalfWavePlate(frequency="2 Hz")], True), ([], False)):
        data = run(
            [sky, *steps, BinMap(stokes="IQU", pixel="20 arcsec")], pairs(1, 2000, radius=0.0)
        )
        product = data.products["map"]
        seen = product.known
        assert seen.any() == solved
        if solved:  # cosines and weights are rounded to 2^-31
            np.testing.assert_allclose(product.polarization.q[seen], 0.3, rtol=0, atol=1e-8)
            np.testing.assert_allclose(product.polarization.u[seen], -0.2, rtol=0, atol=1e-8)


@pytest.mark.parametrize("plate", [False, True])
def test_leakage_of_an_unpolarized_sky_is_polarization_of_its_share(plate):
    """A roll of the boresight of zero: the instrument's direction is fixed on the sky, Q + i U = l
    I exp(2 i beta').
    """
    steps = [HalfWavePlate(frequency="2 Hz")] if plate else []
    leakage = Leakage(share="3 %", angle="20 deg")
    data = run(
        [uniform_sky(2.0, 0.0, 0.0), *steps, leakage, BinMap(stokes="IQU", pixel="20 arcsec")],
        pairs(16, 8000),
    )
    product = data.products["map"]
    seen = product.known
    q, u = product.polarization.q[seen], product.polarization.u[seen]
    # within a pixel meridians turn by up to 4e-4 rad
    np.testing.assert_allclose(np.hypot(q, u), 0.06, rtol=1e-3)
    np.testing.assert_allclose(product.signal[seen], 2.0, rtol=0, atol=1e-4)
    # the focal plane's +X axis points south on the sky here, but for the convergence of meridians
    # over 4 arcmin, 4e-4 rad
    np.testing.assert_allclose(np.arctan2(u, q) / 2, np.radians(20.0), rtol=0, atol=2e-3)


CAMERA = {
    "name": "pairs",
    "telescope": {"name": "dish", "diameter": "6 m"},
    "detectors": 12,
    "field_of_view": "6 arcmin",
    "band": {"name": "b", "low": "130 GHz", "high": "170 GHz"},
    "fwhm": "1.4 arcmin",
    "polarization": "pairs",
    "net": "1 mK s(1/2)",
    "main_beam_efficiency": 0.7,
    "illumination_efficiency": 0.9,
    "sample_rate": "20 Hz",
}


@pytest.mark.parametrize("plate", [False, True])
@pytest.mark.parametrize("calibration", ["mean", "instantaneous"])
def test_what_comes_through_the_optics_leaks_and_noise_does_not(plate, calibration):
    """Equation (1) on sky and atmosphere, its mean emission of 15 K included, in each signal; noise
    keeps its bits.
    """
    scene = zonda.Scene(
        site="green_bank",
        instrument=CAMERA,
        time="2024-11-25T07:00",
        target="75 deg 20 deg",
        seed=3,
    )
    leakage = [zonda.Leakage(share="5 %", angle="10 deg")]
    runs = {
        "noise": {"only": ["white"]},
        "noiseless": {"only": ["sky"]},
        "rest": {"without": ["white"]},
    }
    keep = ["signal", *(f"signal/{name}" for name in runs)]

    def streams(more):
        steps = [
            zonda.PointingDaisy(radius="5 arcmin", speed="60 arcsec/s", scan_duration="20 s"),
            *([zonda.HalfWavePlate(frequency="1 Hz")] if plate else []),
            uniform_sky(1.0, 0.0, 0.0),
            zonda.AtmosphereLayers(pwv="5 mm"),
            zonda.WhiteNoise(),
            *more,
            zonda.Efficiency(calibration=calibration),
        ]
        data = zonda.Pipeline(steps, precision="float64", runs=runs).run(scene, keep=keep)
        return data.observations[0], {name: data.observations[0].detdata[name] for name in keep}

    (o, clean), (_, leaked) = streams([]), streams(leakage)
    gamma = o.focalplane.polarization_angle[:, None]
    turned = (
        2 * (gamma - np.radians(10.0))
        if not plate
        else 4 * o.hwp_angle - 2 * gamma - 2 * np.radians(10.0)
    )
    gain = 1 + 0.05 * np.cos(turned)
    assert np.ptp(gain) > 0.08
    assert clean["signal/rest"].mean() > 10
    np.testing.assert_array_equal(leaked["signal/noise"], clean["signal/noise"])
    np.testing.assert_allclose(
        leaked["signal/noiseless"], gain * clean["signal/noiseless"], rtol=1e-12
    )
    if (
        calibration == "mean"
    ):  # what leaks of the mean is divided by e^-tau itself, the mean by splines: 1.2e-12
        np.testing.assert_allclose(leaked["signal/rest"], gain * clean["signal/rest"], rtol=1e-11)
        np.testing.assert_allclose(
            leaked["signal"], leaked["signal/rest"] + leaked["signal/noise"], rtol=1e-12
        )
    else:
        # the mean emission's part that follows the transmission is subtracted as it is calibrated,
        # without the leak
        np.testing.assert_allclose(leaked["signal/rest"], gain * clean["signal/rest"], rtol=1e-3)


def test_leakage_behind_what_forms_the_signal_is_refused():
    steps = [
        zonda.PointingStare(scan_duration="5 s"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        Leakage(),
    ]
    scene = zonda.Scene(
        site="green_bank",
        instrument=CAMERA,
        time="2024-11-25T07:00",
        target="75 deg 20 deg",
        seed=3,
    )
    with pytest.raises(
        zonda.ZondaError,
        match=r"Leakage provides atmosphere and sky only after Efficiency has used them",
    ) as caught:
        zonda.Pipeline(steps).run(scene, keep=["signal"])
    assert str(caught.value).count("Leakage provides") == 1


def test_without_polarized_detectors_neither_has_an_effect_and_the_log_says_so():
    steps = [uniform_sky(1.0, 0.3, -0.2), HalfWavePlate(frequency="2 Hz"), Leakage(share="5 %")]
    data = run(steps, scan(7, 1000), keep=("sky",))
    np.testing.assert_allclose(data.observations[0].detdata["sky"], 1.0, rtol=1e-12)
    said = {
        who
        for who, what, value in data.log
        if (what, value) == ("no effect", "no detector is polarized")
    }
    assert said == {"HalfWavePlate", "Leakage"}


def test_modulation_beyond_half_the_sample_rate_is_told():
    data = run([HalfWavePlate(frequency="20 Hz")], pairs(2, 500), np.zeros((2, 500)))
    assert any(what == "modulation aliased" for _, what, _ in data.log)


def test_a_plate_goes_to_files_and_back(tmp_path):
    from zonda.operators.io.save_tod import SaveTOD, load_tod

    for kind in ("hdf5", "fits"):
        o = pairs(4, 700)
        steps = [HalfWavePlate(frequency="2 Hz", angle="30 deg"), SaveTOD(format=kind)]
        data = run(steps, o, np.zeros((4, 700)), output=tmp_path / kind)
        (path,) = data.products["tod_file"]
        tod = load_tod(path)
        expected = np.mod(4 * np.pi * o.seconds + np.radians(30), 2 * np.pi)
        np.testing.assert_array_equal(tod.hwp_angle, o.hwp_angle)
        np.testing.assert_allclose(tod.hwp_angle, expected, atol=1e-12)
        np.testing.assert_array_equal(tod.columns["polarization_efficiency"], 0.8)


def test_recorded_polarized_data_make_the_map_of_the_run_that_saved_them(tmp_path):
    camera = zonda.Instrument(
        name="pairs",
        telescope=zonda.Telescope(name="dish", diameter="6 m"),
        detectors=12,
        field_of_view="6 arcmin",
        band=zonda.Band(name="b", low="130 GHz", high="170 GHz"),
        fwhm="1.4 arcmin",
        polarization="pairs",
        net="1 mK s(1/2)",
        main_beam_efficiency=0.7,
        illumination_efficiency=0.9,
        sample_rate="20 Hz",
    )
    scene = zonda.Scene(
        site="green_bank",
        instrument=camera,
        time="2024-11-25T07:00",
        target="75 deg 20 deg",
        seed=3,
    )
    how = {"pixel": "60 arcsec", "width": "15 arcmin", "stokes": "IQU"}
    steps = [
        zonda.PointingDaisy(radius="5 arcmin", speed="60 arcsec/s", scan_duration="20 s"),
        zonda.HalfWavePlate(frequency="1 Hz"),
        uniform_sky(1.0, 0.3, -0.2),
        zonda.BinMap(**how),
        zonda.SaveTOD(),
    ]
    saved = zonda.Pipeline(steps, precision="float64").run(scene, output=tmp_path)
    (path,) = saved.products["tod_file"]
    again = zonda.Pipeline(
        [zonda.LoadTOD(file=path), zonda.BinMap(**how)], precision="float64"
    ).run(scene)
    one, other = saved.products["map"], again.products["map"]
    np.testing.assert_array_equal(one.polarization.hits, other.polarization.hits)
    assert (one.known).sum() > 20
    np.testing.assert_allclose(other.polarization.q, one.polarization.q, rtol=0, atol=1e-8)
    np.testing.assert_allclose(other.signal, one.signal, rtol=0, atol=1e-8)
