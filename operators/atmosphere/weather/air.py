"""Air: measures of humidity, the US Standard Atmosphere 1976, and levels that no air has.

Pressures are in Pa, temperatures in K; mixing ratios are by volume unless said otherwise. The
standard atmosphere is used where nothing better is known, and above what a source reaches.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import ArrayLike

from zonda.core.site import Site
from zonda.core.types import Bools, Floats
from zonda.core.weather import Column

from .radiative_transfer import (
    GRAVITY,
    MOLAR_MASS_DRY_AIR,
    MOLAR_MASS_WATER,
    VAPOUR_GAS_CONSTANT,
)

DRY_AIR_GAS_CONSTANT = 287.05
"""J / (kg K)."""
EPSILON = MOLAR_MASS_WATER / MOLAR_MASS_DRY_AIR
MOLAR_MASS_OZONE = 47.998e-3
"""kg / mol."""

HEIGHT = np.array([-1e3, 0, 11e3, 20e3, 32e3, 47e3])
"""Geopotential metres above sea level of the corners of the temperature profile."""
TEMPERATURE = np.array([294.65, 288.15, 216.65, 216.65, 228.65, 270.65])
"""K at these heights (US Standard Atmosphere 1976, table 4)."""
SEA_LEVEL_PRESSURE = 101325.0
"""Pa."""

OZONE_HEIGHT = 1e3 * np.array(
    [0, 2, 4, 6, 8, 10, 12, 14, 16, 18, 20, 22, 24, 27.5, 30, 32.5, 35, 37.5, 40, 45, 50]
)
"""m above sea level."""
OZONE = 1e-6 * np.array(
    [
        0.027,
        0.032,
        0.034,
        0.041,
        0.06,
        0.13,
        0.31,
        0.50,
        0.87,
        1.6,
        2.6,
        3.6,
        4.6,
        5.8,
        6.6,
        7.4,
        7.8,
        7.8,
        7.3,
        5.3,
        3.1,
    ]
)
"""Volume mixing ratio (AFGL-TR-86-0110, US standard, rounded)."""

VAPOUR_SCALE_HEIGHT = 2e3
"""m: vapour density falls as exp(-height / this), a round value for clear days."""
STRATOSPHERIC_WATER = 5e-6
"""Volume mixing ratio above the tropopause."""
LIMITS = {
    "temperature": (150.0, 340.0, "K"),
    "h2o": (0.0, 0.1, "of the air"),
    "wind_east": (-200.0, 200.0, "m/s"),
    "wind_north": (-200.0, 200.0, "m/s"),
}
"""Of any air below 50 km."""
OFF = 2000.0, 0.1
"""m, and share of its height, that a pressure may lie off its height in the standard atmosphere."""
EXTEND_BELOW = 1500.0
"""Pa: a source whose highest level has more than this is continued upwards."""


def saturation_pressure(temperature: Floats) -> Floats:
    """Saturation pressure [Pa] over water above 0 C, ice below -23 C, both between (IFS
    documentation cy41r2, IV, eq. 7.93).
    """
    t = np.asarray(temperature, np.float64)
    liquid = 611.21 * np.exp(17.502 * (t - 273.16) / (t - 32.19))
    ice = 611.21 * np.exp(22.587 * (t - 273.16) / (t + 0.7))
    share = np.clip((t - 250.16) / (273.16 - 250.16), 0, 1) ** 2
    return share * liquid + (1 - share) * ice


def from_relative(relative: Floats, pressure: Floats, temperature: Floats) -> Floats:
    """From relative humidity, 0 to 1, of the mixed-phase saturation pressure."""
    return relative * saturation_pressure(temperature) / pressure


def from_specific(specific: Floats) -> Floats:
    """From specific humidity, kg of vapour per kg of moist air."""
    return specific / (EPSILON + (1 - EPSILON) * specific)


def from_density(density: Floats, pressure: Floats, temperature: Floats) -> Floats:
    """From the mass of vapour, kg/m3."""
    return density * VAPOUR_GAS_CONSTANT * temperature / pressure


def ozone_from_mass(mass_mixing_ratio: Floats) -> Floats:
    """From kg of ozone per kg of air."""
    return mass_mixing_ratio * MOLAR_MASS_DRY_AIR / MOLAR_MASS_OZONE


def temperature(height: ArrayLike) -> Floats:
    """K at geopotential heights [m above sea level]; constant above 47 km."""
    return np.asarray(np.interp(np.asarray(height, np.float64), HEIGHT, TEMPERATURE))


def pressure(height: ArrayLike) -> Floats:
    """Pa at geopotential heights [m above sea level], hydrostatic."""
    fine = np.linspace(HEIGHT[0], 80e3, 1621)
    step = np.diff(fine) * GRAVITY / DRY_AIR_GAS_CONSTANT / temperature((fine[1:] + fine[:-1]) / 2)
    logarithm = np.concatenate([[0.0], -np.cumsum(step)])
    at_sea_level = np.interp(0.0, fine, logarithm)
    return np.asarray(
        SEA_LEVEL_PRESSURE
        * np.exp(np.interp(np.asarray(height, np.float64), fine, logarithm) - at_sea_level)
    )


def impossible(column: Column) -> Iterator[tuple[Bools, str]]:
    """Levels (n,) that no air has, and why: a unit is another one than stated, or there is none.

    Weather moves a level by less than half of `OFF`.
    """
    heights = np.linspace(-2000.0, 80e3, 4001)
    usual = np.interp(-column.pressure, -pressure(heights), heights)
    off = np.abs(column.height - usual) > OFF[0] + OFF[1] * np.abs(usual)
    yield off, "its pressure does not belong to its height"
    for name, (low, high, unit) in LIMITS.items():
        values = getattr(column, name)
        limits = f"between {low:g} and {high:g} {unit}".rstrip()
        what = "share of water vapour" if name == "h2o" else name.replace("_", " ")
        yield ~((values >= low) & (values <= high)), f"the {what} is not {limits}"


def wind_speed(above_ground: ArrayLike) -> Floats:
    """Wind where there is none in the profile, m/s: 8 + 30 exp(-((h - 9400 m) / 4800 m)^2), h above
    the ground.
    """
    return 8 + 30 * np.exp(-(((np.asarray(above_ground, np.float64) - 9400) / 4800) ** 2))


def ozone(pressures: ArrayLike) -> Floats:
    """Volume mixing ratio at pressures [Pa]."""
    at = np.log(pressure(OZONE_HEIGHT))
    return np.interp(-np.log(pressures), -at, OZONE)


def standard_column(site: Site) -> Column:
    """The standard atmosphere above a site, a west wind, and 10 mm of water at sea level: to be
    scaled to the PWV wanted.
    """
    low = site.altitude + np.array([-100.0, 0, 250, 500, 1000, 1500])
    height = np.concatenate([low, np.arange(site.altitude + 2e3, 47e3, 1e3)])
    t = temperature(height)
    p = pressure(height)
    density = 5e-3 * np.exp(-height / VAPOUR_SCALE_HEIGHT)
    return Column(
        pressure=p,
        height=height,
        temperature=t,
        h2o=np.maximum(density * VAPOUR_GAS_CONSTANT * t / p, STRATOSPHERIC_WATER),
        wind_east=wind_speed(np.maximum(height - site.altitude, 0.0)),
        wind_north=np.zeros_like(height),
        stated=(
            "US Standard Atmosphere 1976: temperatures may be 30 K off at the poles, the wind is a"
            " guess"
        ),
    )


def upper_levels(
    top_height: float,
    top_pressure: float,
    top_temperature: float,
) -> tuple[Floats, Floats, Floats]:
    """(height, pressure, temperature) above a source's highest level up to 31 km, with the standard
    lapse rates.
    """
    height = np.arange(top_height + 1e3, 31.5e3, 1e3)
    if top_pressure < EXTEND_BELOW or not height.size:
        height = height[:0]
    t = top_temperature + temperature(height) - temperature(top_height)
    edges = np.append(top_temperature, t)
    step = np.diff(height, prepend=top_height) * GRAVITY / DRY_AIR_GAS_CONSTANT
    step /= (edges[1:] + edges[:-1]) / 2
    return height, top_pressure * np.exp(-np.cumsum(step)), t
