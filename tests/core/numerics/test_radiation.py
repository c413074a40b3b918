import math

import mpmath
import numpy as np
import pytest
from scipy.integrate import quad

from zonda.core.errors import InputError
from zonda.core.instrument import Band
from zonda.core.numerics.radiation import (
    BOLTZMANN,
    PLANCK,
    T_CMB,
    band_average,
    cmb_slope,
    intensity_to_kelvin,
    rayleigh_jeans,
    thermal_sz,
    to_kelvin_rj,
)


def band(low, high):
    return Band(name="test", low=f"{low} GHz", high=f"{high} GHz")


def narrow(centre):
    return band(centre - 1e-3, centre + 1e-3)


MUSTANG2 = band(78, 108)


def test_planck_in_rayleigh_jeans_kelvin_limits():
    assert rayleigh_jeans(1e6, 2.725) == pytest.approx(2.725, rel=1e-4)  # h nu << k T
    assert rayleigh_jeans(1e15, 2.725) == 0.0  # no overflow
    x = PLANCK * 90e9 / BOLTZMANN
    assert rayleigh_jeans(90e9, 2.725) == pytest.approx(x / (math.exp(x / 2.725) - 1), rel=1e-12)
    assert rayleigh_jeans(90e9, 2.725) == pytest.approx(1.113, abs=1e-3)


def test_intensity_of_one_mjy_per_sr_at_90_ghz():
    # c^2 / (2 k nu^2) * 1e-20 = 8.98755e16 / (2 * 1.380649e-23 * 8.1e21) * 1e-20
    assert to_kelvin_rj("MJy/sr", narrow(90)) == pytest.approx(4.01831e-3, rel=1e-5)


def test_intensity_and_cmb_against_astropy():
    import astropy.units as u

    nu = 150 * u.GHz
    kelvin = (1 * u.MJy / u.sr).to_value(u.K, u.brightness_temperature(nu))
    assert to_kelvin_rj("MJy/sr", narrow(150)) == pytest.approx(kelvin, rel=1e-6)
    per_cmb = (1 * u.K).to_value(
        u.MJy / u.sr, u.thermodynamic_temperature(nu, T_CMB * u.K)
    ) * kelvin
    assert to_kelvin_rj("K_CMB", narrow(150)) == pytest.approx(per_cmb, rel=1e-6)
    assert per_cmb == pytest.approx(0.5764, abs=2e-4)


@pytest.mark.parametrize("ghz", [30, 93, 150, 217.5, 353, 857])
def test_thermal_sz_solves_the_kompaneets_equation(ghz):
    # dn = y x^-2 d/dx (x^4 dn/dx), dT_RJ = h nu / k dn, differentiated numerically in 40 digits
    with mpmath.workdps(40):
        x0 = mpmath.mpf(PLANCK) * ghz * 10**9 / (mpmath.mpf(BOLTZMANN) * mpmath.mpf(T_CMB))
        flux = lambda x: x**4 * mpmath.diff(lambda s: 1 / mpmath.expm1(s), x)  # noqa: E731
        want = float(x0 * mpmath.mpf(T_CMB) * mpmath.diff(flux, x0) / x0**2)
    assert float(thermal_sz(ghz * 1e9)) == pytest.approx(want, rel=1e-9, abs=1e-9)


def test_thermal_sz_is_negative_at_93_ghz_and_changes_sign_at_217_ghz():
    assert to_kelvin_rj("y", narrow(93)) == pytest.approx(
        -3.441, abs=0.003
    )  # x = 1.6376: -4.283 K_CMB x 0.8034
    assert to_kelvin_rj("y", MUSTANG2) < -3.3
    assert to_kelvin_rj("y", narrow(217.0)) < 0 < to_kelvin_rj("y", narrow(218.0))


@pytest.mark.parametrize(("low", "high"), [(78, 108), (66, 118), (30, 950)])
@pytest.mark.parametrize(
    ("unit", "function"), [("K_CMB", cmb_slope), ("y", thermal_sz), ("MJy/sr", intensity_to_kelvin)]
)
def test_band_is_integrated(low, high, unit, function):
    scale = 1e-20 if unit == "MJy/sr" else 1.0
    want = (
        quad(lambda nu: float(function(nu * 1e9)), low, high, epsabs=0, epsrel=1e-12)[0]
        / (high - low)
        * scale
    )
    assert to_kelvin_rj(unit, band(low, high)) == pytest.approx(want, rel=1e-9)


def test_tabulated_band_is_integrated_between_its_points(tmp_path):
    path = tmp_path / "triangle.txt"
    path.write_text("80 0\n90 1\n100 0\n")
    triangle = Band(name="triangle", file=path)
    weight = lambda nu: 1 - abs(nu - 90) / 10  # noqa: E731
    want = (
        quad(
            lambda nu: weight(nu) * float(cmb_slope(nu * 1e9)), 80, 100, points=[90], epsrel=1e-12
        )[0]
        / 10
    )
    assert to_kelvin_rj("K_CMB", triangle) == pytest.approx(want, rel=1e-9)


def test_source_spectrum_matters_and_index_two_is_rayleigh_jeans():
    flat, dust = (to_kelvin_rj("MJy/sr", MUSTANG2, spectral_index=a) for a in (0.0, 3.5))
    assert abs(dust / flat - 1) > 1e-3
    # S ~ nu^2 is one RJ temperature: no band correction at all
    rj = to_kelvin_rj("MJy/sr", MUSTANG2, spectral_index=2.0)
    assert rj == pytest.approx(float(intensity_to_kelvin(MUSTANG2.centre)) * 1e-20, rel=1e-12)


def test_flux_units_divide_by_their_solid_angle():
    pixel, beam = 2.35e-11, 1.9e-9
    intensity = to_kelvin_rj("MJy/sr", MUSTANG2, spectral_index=-0.7)
    per_pixel = to_kelvin_rj("Jy/pixel", MUSTANG2, pixel_solid_angle=pixel, spectral_index=-0.7)
    per_beam = to_kelvin_rj(
        "Jy/beam", MUSTANG2, pixel_solid_angle=pixel, beam_solid_angle=beam, spectral_index=-0.7
    )
    assert per_pixel == pytest.approx(intensity * 1e-6 / pixel, rel=1e-12)
    assert per_beam == pytest.approx(intensity * 1e-6 / beam, rel=1e-12)


def test_brightness_is_already_k_rj():
    assert to_kelvin_rj("K_RJ", MUSTANG2) == 1.0
    assert band_average(MUSTANG2, np.ones_like) == pytest.approx(1.0, rel=1e-14)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"unit": "furlong"},
            "unknown unit 'furlong'.*\n.*K_RJ, K_CMB, Jy/pixel, Jy/beam, MJy/sr, y",
        ),
        ({"unit": "Jy/pixel"}, "needs the solid angle of its pixel, but none is given"),
        (
            {"unit": "Jy/pixel", "pixel_solid_angle": 0.0},
            "solid angle of its pixel, but 0 sr is given",
        ),
        ({"unit": "Jy/beam", "pixel_solid_angle": 1e-11}, "needs the solid angle of its beam"),
        (
            {"unit": "K_CMB", "spectral_index": 2.0},
            "own spectrum, a spectral index of 2 does not apply",
        ),
    ],
)
def test_bad_requests_name_cause_and_cure(arguments, message):
    with pytest.raises(InputError, match=message):
        to_kelvin_rj(band=MUSTANG2, **arguments)
