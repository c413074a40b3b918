import math

import mpmath
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import roots_genlaguerre

from zonda.core.errors import InputError
from zonda.core.instrument import Band
from zonda.core.numerics.radiation import (
    BOLTZMANN,
    ELECTRON_REST_ENERGY,
    PLANCK,
    T_CMB,
    band_average,
    cmb_slope,
    intensity_to_kelvin,
    rayleigh_jeans,
    sz_of_band,
    sz_per_y,
    sz_terms,
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


def scattered(x, temperature):
    """Delta n / tau by direct integration of single scatterings: Thomson scattering in the
    electron's rest frame (Wright 1979, ApJ 232, 348, equation 3) over a relativistic Maxwellian.

    n -> n(x e^s), e^s = (1 + b m') / (1 - b m), with the probability dm dm' phi(m, m') / (2 g^4
    (1 - b m)^3), phi = 3/8 (1 + m^2 m'^2 + (1 - m^2)(1 - m'^2) / 2): Gauss-Legendre in both
    cosines, Gauss-Laguerre in the Lorentz factor g.
    """
    cosine, weight = np.polynomial.legendre.leggauss(40)
    m, after = np.meshgrid(cosine, cosine, indexing="ij")
    phi = (
        3 / 8 * (1 + (m * after) ** 2 + (1 - m**2) * (1 - after**2) / 2) * np.outer(weight, weight)
    )
    theta = temperature / ELECTRON_REST_ENERGY
    energy, share = roots_genlaguerre(40, 0.5)
    lorentz = 1 + theta * energy
    share = share * lorentz * np.sqrt(lorentz + 1)  # p^2 dp = g sqrt(g - 1) sqrt(g + 1) dg
    total = 0.0
    for g, part in zip(lorentz, share / share.sum(), strict=True):
        b = math.sqrt(1 - 1 / g**2)
        ratio = (1 + b * after) / (1 - b * m)
        change = np.exp(-x * ratio) / -np.expm1(-x * ratio) - 1 / math.expm1(x)
        total += part * np.sum(change * phi / (2 * g**4 * (1 - b * m) ** 3))
    return float(total)


KEV = 1.602176634e-16
# The integral's own error is below 1e-9 (40 and 60 nodes agree). What remains is the next term of
# the series, theta^6 of the optical depth: it falls as theta^5 against the leading one, so that 5
# keV is about 32 times better than 10 keV. Absolute at 217 GHz, in K_CMB per y.
SZ_ERRORS = [
    (5, 150, 5e-7),
    (10, 150, 1e-5),
    (15, 150, 3e-5),
    (5, 217, 5e-5),
    (10, 217, 1e-3),
    (5, 280, 5e-5),
    (10, 280, 1e-3),
    (15, 280, 8e-3),
    (10, 860, 1.5e-2),
]


@pytest.mark.parametrize(("kev", "ghz", "error"), SZ_ERRORS)
def test_relativistic_sz_is_that_of_single_scatterings(kev, ghz, error):
    x = PLANCK * ghz * 1e9 / (BOLTZMANN * T_CMB)
    want = T_CMB * x * scattered(x, kev * KEV) * ELECTRON_REST_ENERGY / (kev * KEV)
    got = float(sz_per_y(sz_terms(ghz * 1e9), kev * KEV))
    scale = float(cmb_slope(ghz * 1e9)) if ghz == 217 else abs(want)
    assert abs(got - want) < error * scale


@pytest.mark.parametrize(("ghz", "percent"), [(150, -6.4), (280, -21.2)])
def test_hot_gas_changes_the_sz_effect(ghz, percent):
    hot, cold = (float(sz_per_y(sz_terms(ghz * 1e9), kev * KEV)) for kev in (10, 0))
    assert cold == pytest.approx(float(thermal_sz(ghz * 1e9)), rel=1e-9)
    assert 100 * (hot / cold - 1) == pytest.approx(percent, abs=0.2)
    # of the Rayleigh-Jeans limit, -2 y (1 - 17/10 theta + 123/40 theta^2)
    theta = 10 * KEV / ELECTRON_REST_ENERGY
    low = float(sz_per_y(sz_terms(1e9), 10 * KEV)) / (-2 * T_CMB)
    assert low == pytest.approx(1 - 17 / 10 * theta + 123 / 40 * theta**2, abs=2e-4)


def test_hot_gas_is_averaged_over_the_band():
    wide, te = band(190, 260), 10 * KEV
    per_y = lambda nu: float(sz_per_y(sz_terms(nu * 1e9), te))  # noqa: E731
    want = quad(per_y, 190, 260, epsabs=0, epsrel=1e-10)[0] / 70
    assert float(sz_per_y(sz_of_band(wide), te)) == pytest.approx(want, rel=1e-9)
    assert want != pytest.approx(per_y(225), rel=1e-2)  # the centre is not the band


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
