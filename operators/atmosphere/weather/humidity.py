"""Between measures of humidity. Pressures in Pa, temperatures in K; mixing ratios by volume unless
said otherwise.
"""

from __future__ import annotations

import numpy as np

from zonda.core.types import Floats

from .radiative_transfer import MOLAR_MASS_DRY_AIR, MOLAR_MASS_WATER, VAPOUR_GAS_CONSTANT

EPSILON = MOLAR_MASS_WATER / MOLAR_MASS_DRY_AIR
MOLAR_MASS_OZONE = 47.998e-3
"""kg / mol."""


def saturation_pressure(temperature: Floats) -> Floats:
    """Saturation pressure [Pa] over water above 0 C, ice below -23 C, both between (IFS
    documentation cy41r2, IV, eq. 7.93).
    """
    t = np.asarray(temperature, np.float64)
    liquid = 611.21 * np.exp(17.502 * (t - 273.16) / (t - 32.19))
    ice = 611.21 * np.exp(22.587 * (t - 273.16) / (t + 0.7))
    share = np.clip((t - 250.16) / (273.16 - 250.16), 0, 1) ** 2
    return np.asarray(share * liquid + (1 - share) * ice)


def from_relative(relative: Floats, pressure: Floats, temperature: Floats) -> Floats:
    """From relative humidity, 0 to 1, of the mixed-phase saturation pressure."""
    return np.asarray(relative * saturation_pressure(temperature) / pressure)


def from_specific(specific: Floats) -> Floats:
    """From specific humidity, kg of vapour per kg of moist air."""
    return np.asarray(specific / (EPSILON + (1 - EPSILON) * specific))


def from_density(density: Floats, pressure: Floats, temperature: Floats) -> Floats:
    """From the mass of vapour, kg/m3."""
    return np.asarray(density * VAPOUR_GAS_CONSTANT * temperature / pressure)


def ozone_from_mass(mass_mixing_ratio: Floats) -> Floats:
    """From kg of ozone per kg of air."""
    return np.asarray(mass_mixing_ratio * MOLAR_MASS_DRY_AIR / MOLAR_MASS_OZONE)
