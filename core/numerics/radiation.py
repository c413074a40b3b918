"""Brightness: Planck's law in Rayleigh-Jeans kelvin, and the conversion of astronomical units to it
over a passband.

A detector that sees one mode per polarization receives k T_RJ(nu) dnu, so the brightness of a band
is

    T_RJ = integral t(nu) T_RJ(nu) dnu / integral t(nu) dnu                                      (1)

with t the transmission per unit of Rayleigh-Jeans temperature. Sky maps and the atmosphere are
averaged with the same t.
"""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import ArrayLike

from ..band import SPEED_OF_LIGHT, Band
from ..errors import InputError
from ..types import Floats

PLANCK = 6.62607015e-34
"""J s (SI, exact)."""
BOLTZMANN = 1.380649e-23
"""J / K (SI, exact)."""
T_CMB = 2.72548
"""K (Fixsen 2009, ApJ 707, 916)."""
ELECTRON_REST_ENERGY = 8.1871057880e-14
"""J, m_e c^2 (CODATA 2018)."""
LEAST_TRANSMISSION = 1e-6
"""Band transmission below which samples are not calibrated: they are flagged as opaque, and say
nothing of the noise.
"""

SURFACE_BRIGHTNESS_UNITS = ("Jy/pixel", "Jy/beam", "MJy/sr")
"""Units of specific intensity: their conversion needs the source's spectral index."""
UNITS = ("K_RJ", "K_CMB", *SURFACE_BRIGHTNESS_UNITS, "y")
"""Units of a sky map that `to_kelvin_rj` knows."""


def rayleigh_jeans(frequency: ArrayLike, temperature: ArrayLike) -> Floats:
    """Rayleigh-Jeans brightness of a black body, J = (h nu / k) / (exp(h nu / k T) - 1). Hz, K ->
    K; shapes broadcast.
    """
    nu = np.asarray(frequency, np.float64)
    temperature = np.asarray(temperature, np.float64)
    x = PLANCK * nu / (BOLTZMANN * temperature)
    with np.errstate(over="ignore"):
        return temperature * x / np.expm1(x)


def cmb_slope(frequency: ArrayLike) -> Floats:
    """dT_RJ / dT_CMB = x^2 e^x / (e^x - 1)^2 at 2.72548 K, with x = h nu / k T. Hz -> K_RJ per
    K_CMB.
    """
    half = PLANCK * np.asarray(frequency, np.float64) / (2 * BOLTZMANN * T_CMB)
    with np.errstate(over="ignore"):
        return (half / np.sinh(half)) ** 2


def thermal_sz(frequency: ArrayLike) -> Floats:
    """Non-relativistic thermal Sunyaev-Zel'dovich effect, T_CMB (x coth(x/2) - 4) dT_RJ/dT_CMB. Hz
    -> K_RJ per Compton-y.

    Sunyaev & Zel'dovich (1972); negative below 217.5 GHz. Of hot gas: `sz_terms`.
    """
    x = PLANCK * np.asarray(frequency, np.float64) / (BOLTZMANN * T_CMB)
    return T_CMB * (x / np.tanh(x / 2) - 4) * cmb_slope(frequency)


SZ_SERIES = (
    (4, 1),
    (10, 47 / 2, 42 / 5, 7 / 10),
    (15 / 2, 1023 / 8, 868 / 5, 329 / 5, 44 / 5, 11 / 30),
    (-15 / 2, 2505 / 8, 7098 / 5, 14253 / 10, 18594 / 35, 12059 / 140, 128 / 21, 16 / 105),
    (
        *(135 / 32, 30375 / 128, 62391 / 10, 614727 / 40, 124389 / 10),
        *(355703 / 80, 16568 / 21, 7516 / 105, 22 / 7, 11 / 210),
    ),
)
"""Coefficients a_jk of `sz_terms`: a row for each power of theta, columns k = 1, 2, ..."""
HOTTEST_GAS = 15e3 * 1.602176634e-19
"""J, k T_e up to which `sz_terms` serve (Itoh et al. 1998): 15 keV."""


def sz_terms(frequency: ArrayLike) -> Floats:
    """Terms of the relativistic thermal Sunyaev-Zel'dovich effect, Hz (...) -> K_RJ per Compton-y
    (5, ...): `sz_per_y` adds them up.

        Delta n / y = sum_j theta^j sum_k a_jk x^k d^k n / dx^k,    theta = k T_e / m_e c^2

    times T_CMB x, with n = 1 / (e^x - 1): the expansion of the Boltzmann equation to theta^5 of
    the optical depth (Itoh, Kohyama & Nozawa 1998, ApJ 502, 7, equations 2.25 to 2.30), written in
    derivatives of n, each a polynomial in n by dn/dx = -n (1 + n).
    """
    x = PLANCK * np.asarray(frequency, np.float64) / (BOLTZMANN * T_CMB)
    with np.errstate(over="ignore"):
        n = 1 / np.expm1(x)
    derivative = np.polynomial.Polynomial([0.0, 1.0])
    slopes = []
    for k in range(1, len(SZ_SERIES[-1]) + 1):
        derivative = derivative.deriv() * np.polynomial.Polynomial([0.0, -1.0, -1.0])
        slopes.append(x**k * derivative(n))
    rows = (sum(a * s for a, s in zip(row, slopes, strict=False)) for row in SZ_SERIES)
    return np.stack([T_CMB * x * np.asarray(row) for row in rows])


def sz_of_band(band: Band) -> Floats:
    """`sz_terms` (5,) averaged over a band."""

    def term(j: int) -> Callable[[Floats], Floats]:
        return lambda nu: sz_terms(nu)[j]

    return np.array([band_average(band, term(j)) for j in range(len(SZ_SERIES))])


def sz_per_y(terms: Floats, temperature: ArrayLike) -> Floats:
    """K_RJ per Compton-y, shape (...), of gas with k T_e = ``temperature`` (...) [J], from the
    ``terms`` (5,) of `sz_terms` or `sz_of_band`.

    Off direct integration over the scattering kernel by 4e-6 at 150 GHz, 9e-4 at 280 GHz, 4e-3 at
    217 and 600 GHz, 1.3e-2 at 860 GHz for 10 keV; 1.3e-5, 7e-3, 2e-2, 6e-2 for 15 keV.
    """
    theta = np.asarray(temperature, np.float64) / ELECTRON_REST_ENERGY
    return np.asarray(np.polynomial.polynomial.polyval(theta, terms))


def intensity_to_kelvin(frequency: ArrayLike) -> Floats:
    """Rayleigh-Jeans kelvin per unit of specific intensity, c^2 / (2 k nu^2). Hz -> K / (W m^-2
    Hz^-1 sr^-1).
    """
    return SPEED_OF_LIGHT**2 / (2 * BOLTZMANN * np.asarray(frequency, np.float64) ** 2)


def band_average(band: Band, function: Callable[[Floats], Floats]) -> float:
    """Equation (1) of ``function`` (Hz array -> array): Gauss-Legendre between the band's tabulated
    points.

    Intervals wider than 1 % of their frequency are divided, so that smooth spectra are integrated
    to 1e-12.
    """
    nu = band.frequency
    transmission = band.transmission
    pieces = np.maximum(np.ceil(np.diff(nu) / (0.01 * nu[:-1])), 1).astype(int)
    inner = [a + h * np.arange(n) / n for a, h, n in zip(nu[:-1], np.diff(nu), pieces, strict=True)]
    edges = np.append(np.concatenate(inner), nu[-1])
    abscissa, weight = np.polynomial.legendre.leggauss(4)
    half = np.diff(edges)[:, None] / 2
    points = (edges[:-1, None] + half * (1 + abscissa)).ravel()
    response = (half * weight).ravel() * np.interp(points, nu, transmission)
    return float(np.sum(response * function(points)) / np.sum(response))


def to_kelvin_rj(
    unit: str,
    band: Band,
    pixel_solid_angle: float | None = None,
    spectral_index: float = 0.0,
    beam_solid_angle: float | None = None,
) -> float:
    """Factor such that K_RJ = factor * value, averaged over the band with the source's spectrum.

    Parameters
    ----------
    unit
        ``K_RJ`` (already the band's brightness: factor 1), ``K_CMB`` (spectrum of CMB anisotropy),
        ``y`` (Compton-y, thermal SZ spectrum), ``Jy/pixel``, ``Jy/beam`` or ``MJy/sr`` (a power
        law, below).
    band
        The passband.
    pixel_solid_angle
        sr; for ``Jy/pixel``.
    spectral_index
        alpha of S(nu) = S0 (nu / nu0)^alpha for ``Jy/pixel``, ``Jy/beam`` and ``MJy/sr``, where the
        map holds S0, the value at the band centre nu0 (`Band.centre`). 0 is a flat spectrum.
    beam_solid_angle
        sr; for ``Jy/beam``.

    Raises
    ------
    InputError
        Unknown unit; a solid angle is missing or not positive; a spectral index with a unit that
        has its own spectrum.
    """
    if unit not in UNITS:
        raise InputError(
            f"unknown unit '{unit}' of a sky map",
            cure=f"give one of {', '.join(UNITS)}",
        )
    if unit in SURFACE_BRIGHTNESS_UNITS:
        centre = band.centre

        def power_law(nu: Floats) -> Floats:
            return (nu / centre) ** spectral_index * intensity_to_kelvin(nu)

        return band_average(band, power_law) * _intensity(unit, pixel_solid_angle, beam_solid_angle)
    if spectral_index != 0.0:
        raise InputError(
            f"a map in {unit} has its own spectrum, a spectral index of {spectral_index:g} does not"
            " apply",
            cure=(
                "remove the spectral index; it serves maps in"
                f" {', '.join(SURFACE_BRIGHTNESS_UNITS)}"
            ),
        )
    if unit == "K_CMB":
        return band_average(band, cmb_slope)
    return band_average(band, thermal_sz) if unit == "y" else 1.0


def _intensity(unit: str, pixel_solid_angle: float | None, beam_solid_angle: float | None) -> float:
    """One of ``unit`` in W m^-2 Hz^-1 sr^-1."""
    if unit == "MJy/sr":
        return 1e-20
    name, solid_angle = (
        ("pixel", pixel_solid_angle) if unit == "Jy/pixel" else ("beam", beam_solid_angle)
    )
    if solid_angle is None or not (math.isfinite(solid_angle) and solid_angle > 0):
        given = "none is given" if solid_angle is None else f"{solid_angle:g} sr is given"
        message = f"a map in {unit} needs the solid angle of its {name}, but {given}"
        raise InputError(message, cure=f"state the size of the {name}")
    return 1e-26 / solid_angle
