"""The atmosphere above a site: profiles from the ground up, made from the levels of a weather
source.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from functools import cached_property
from statistics import NormalDist
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from zonda.core.errors import InputError
from zonda.core.site import Site
from zonda.core.types import Floats
from zonda.core.weather import PWV_MAX as PWV_MAX
from zonda.core.weather import Column

from .air import (
    DRY_AIR_GAS_CONSTANT,
    STRATOSPHERIC_WATER,
    ozone,
    saturation_pressure,
    upper_levels,
)
from .radiative_transfer import GRAVITY, VAPOUR_GAS_CONSTANT, Layers

LEVELS = 61
"""Heights of a profile."""
TOP = 46e3
"""m above the site: the highest of them."""
EXTRAPOLATION_MAX = 500.0
"""m that a site may lie below the lowest level of its climatology."""

HELD = ("wind_east", "wind_north", "log_vapour_spread", "wind_east_spread", "wind_north_spread")
"""Quantities of a `Column` that are what they are at its top above it."""
STACKING = 0.77
"""Levels do not vary together: the column's ln(PWV) scatters this much of what the levels'
quantiles, stacked, would give. This is the mean of the sites where ERA5's own columns tell (0.6 to
0.96, `Column.column_spread`), for the others."""
INVERSION_DEPTH = 100.0
"""m in which an inversion on the ground falls to 1/e. Over the South Pole it is a few hundred
metres deep, steepest below (Hudson & Brandt 2005, J. Climate 18, 1673)."""
STRATOSPHERE_LAPSE = 2.8e-3
"""K / m above the highest climatological level, 10 hPa, as in the US Standard Atmosphere 1976 ...
"""
STRATOPAUSE_TEMPERATURE = 270.65
"""... up to this temperature, K."""


@dataclass(frozen=True)
class Conditions:
    """Conditions at given heights, arrays of the shape asked for: m above the site, Pa, K, kg/m3,
    m/s, m/s.
    """

    height: Floats
    pressure: Floats
    temperature: Floats
    vapour_density: Floats
    wind_east: Floats
    wind_north: Floats


@dataclass(frozen=True)
class PwvDistribution:
    """Law of the PWV: its logarithm is normal with one width below the median and another above,
    cut at `PWV_MAX`.

    Attributes
    ----------
    median
        m.
    below, above
        Standard deviation of ln(PWV) of the two halves; ``above`` None: the same, which is the
        log-normal law.
    """

    median: float
    below: float
    above: float | None = None

    @property
    def sigma(self) -> float:
        """Mean of the two widths."""
        return (self.below + (self.below if self.above is None else self.above)) / 2

    def at(self, quantile: float) -> float:
        """PWV [m] at a quantile between 0 and 1."""
        normal = NormalDist()
        centre = math.log(self.median)
        above = self.below if self.above is None else self.above
        reach = math.log(PWV_MAX) - centre
        most = normal.cdf(reach / (above if reach > 0 else self.below))
        deviate = normal.inv_cdf(
            min(max(quantile * most, 1e-300), 1 - 1e-16)
        )  # a quantile of 0 or 1 is 37 or 8 sigma away
        return min(math.exp(centre + deviate * (above if deviate > 0 else self.below)), PWV_MAX)


@dataclass(frozen=True)
class Profile:
    """The atmosphere above a site, arrays (61,) from the ground up.

    Attributes
    ----------
    height
        m above the site.
    pressure, temperature
        Pa, K.
    h2o, o3
        Volume mixing ratio.
    wind_east, wind_north
        Velocity of the air towards east and north, m/s (medians of the components).
    altitude
        m above sea level of the site.
    wind_east_spread, wind_north_spread
        Standard deviations of the winds [m/s] over the weather of the season and hour; None: not
        known.
    distribution
        How the PWV of that season and hour is distributed, whatever the PWV is scaled to; None: not
        known.
    stated
        (what, text): where this profile comes from, for the reports.
    """

    height: Floats
    pressure: Floats
    temperature: Floats
    h2o: Floats
    o3: Floats
    wind_east: Floats
    wind_north: Floats
    altitude: float
    wind_east_spread: Floats | None = None
    wind_north_spread: Floats | None = None
    distribution: PwvDistribution | None = None
    stated: tuple[tuple[str, str], ...] = ()

    @property
    def vapour_density(self) -> Floats:
        """Mass of water vapour, kg/m3."""
        return self.h2o * self.pressure / (VAPOUR_GAS_CONSTANT * self.temperature)

    @cached_property
    def layers(self) -> Layers:
        """The layers between the heights, and one more up to zero pressure, for radiative
        transfer.
        """
        return Layers(
            pressure=np.append(self.pressure, 0.0),
            temperature=np.append(self.temperature, self.temperature[-1]),
            h2o=np.append(_layer_mean(self.pressure, self.h2o), self.h2o[-1]),
            o3=np.append(_layer_mean(self.pressure, self.o3), self.o3[-1]),
            height=self.altitude + np.append(self.height, self.height[-1] + 14e3),
        )

    @property
    def pwv(self) -> float:
        """Precipitable water vapour above the site, m."""
        return self.layers.pwv

    def scaled(self, pwv: float) -> Profile:
        """The same profile with all its vapour multiplied so that the PWV is ``pwv`` [m].

        Raises
        ------
        InputError
            A PWV that is negative or above 60 mm, or any of a profile without vapour.
        """
        check_pwv(pwv)
        if pwv > 0 and not self.pwv > 0:
            raise InputError(
                "the profile has no vapour at all, so there is nothing to scale",
                cure="give a profile with vapour",
            )
        profile = self
        for _ in range(8):  # as in Layers.scaled
            profile = (
                replace(profile, h2o=profile.h2o * (pwv / profile.pwv))
                if pwv > 0
                else replace(self, h2o=0 * self.h2o)
            )
        return profile

    @property
    def typical_wind(self) -> Profile:
        """The same profile with the median speed along the median direction.

        Of a wind whose components are normal with means (u, v) and spreads su, sv, the median speed
        is within 3 % of

            V^2 = u^2 + v^2 + s^2 (1 + 0.386 exp(-(u^2 + v^2) / (2 s^2))),
            s^2 = (su^2 + sv^2) / 2                (2)

        which the vector of medians understates. Without spreads the profile itself.
        """
        if self.wind_east_spread is None or self.wind_north_spread is None:
            return self
        squared = self.wind_east**2 + self.wind_north**2
        # (1 um/s)^2 where there is no spread, and none of the wind: adds nothing, divides
        variance = np.maximum((self.wind_east_spread**2 + self.wind_north_spread**2) / 2, 1e-12)
        speed = np.sqrt(squared + variance * (1 + 0.386 * np.exp(-squared / (2 * variance))))
        median = np.sqrt(squared)
        east = np.where(median > 0, self.wind_east, 1.0) / np.where(median > 0, median, 1.0)
        north = np.where(median > 0, self.wind_north, 0.0) / np.where(median > 0, median, 1.0)
        return replace(self, wind_east=speed * east, wind_north=speed * north)

    def at(self, height: ArrayLike) -> Conditions:
        """Conditions at heights above the site [m], any shape: winds as vectors, pressure and
        vapour as logarithms, linearly.

        Raises
        ------
        InputError
            A height below the site or above the profile.
        """
        wanted = np.asarray(height, np.float64)
        if wanted.size and not (wanted.min() >= 0 and wanted.max() <= self.height[-1]):
            given = f"{wanted.min():g} to {wanted.max():g} m"
            limits = f"0 to {self.height[-1]:g} m"
            raise InputError(f"heights of {given} above the site are outside the profile, {limits}")

        def linear(values: Floats) -> Floats:
            return np.asarray(np.interp(wanted, self.height, values))

        tiny = np.finfo(np.float64).tiny
        vapour = np.exp(linear(np.log(np.maximum(self.vapour_density, tiny))))
        return Conditions(
            height=wanted,
            pressure=np.exp(linear(np.log(self.pressure))),
            temperature=linear(self.temperature),
            vapour_density=np.where(vapour > 2 * tiny, vapour, 0.0),
            wind_east=linear(self.wind_east),
            wind_north=linear(self.wind_north),
        )


def check_pwv(pwv: float) -> None:
    """Refuse a precipitable water vapour [m] that does not occur on Earth (`InputError`)."""
    if not 0 <= pwv <= PWV_MAX:
        raise InputError(
            f"a precipitable water vapour of {pwv * 1e3:g} mm is outside the limits, 0 to"
            f" {PWV_MAX * 1e3:g} mm",
            cure="give the PWV above the site, for example 7.7 mm",
        )


def on_heights(column: Column, site: Site) -> Profile:
    """A column from its levels to heights above the site; above it the stratosphere of the US
    Standard Atmosphere.

    Raises
    ------
    InputError
        A site far below the column's lowest level, or above its highest.
    """
    _check_altitude(column := _continued(column), site)
    height = TOP * np.expm1(2.5 * np.linspace(0, 1, LEVELS)) / np.expm1(2.5)
    z = site.altitude + height
    inside = np.clip(z, column.height[0], column.height[-1])
    above = np.maximum(z - column.height[-1], 0.0)
    below = np.minimum(z - column.height[0], 0.0)

    def linear(values: Floats) -> Floats:
        return np.asarray(np.interp(inside, column.height, values))

    lapse = (column.temperature[1] - column.temperature[0]) / (column.height[1] - column.height[0])
    top = column.temperature[-1]
    warming = np.minimum(STRATOSPHERE_LAPSE * above, max(STRATOPAUSE_TEMPERATURE - top, 0.0))
    temperature = linear(column.temperature) + lapse * below + warming
    h2o = np.exp(
        linear(np.log(np.maximum(column.h2o, 1e-12)))
    )  # a logarithm of dry air: 6e-9 mm of water in the whole column
    mean = np.where(
        above > 0,
        (temperature + top) / 2,
        temperature,
    )  # of the air between the outermost level and z
    log_pressure = linear(np.log(column.pressure)) - GRAVITY * (above + below) / (
        DRY_AIR_GAS_CONSTANT * mean
    )
    spreads = [
        None if s is None else linear(s)
        for s in (column.wind_east_spread, column.wind_north_spread)
    ]
    made = Profile(
        height=height,
        pressure=np.exp(log_pressure),
        temperature=temperature,
        h2o=h2o,
        o3=_ozone(column, log_pressure),
        wind_east=linear(column.wind_east),
        wind_north=linear(column.wind_north),
        altitude=site.altitude,
        wind_east_spread=spreads[0],
        wind_north_spread=spreads[1],
        stated=(("weather", column.stated),) if column.stated else (),
    )
    if column.ground_temperature is not None:
        made = _inverted(made, column.ground_temperature)
    if column.log_vapour_spread is None:
        return made
    wide = linear(column.log_vapour_spread)
    low, high = (replace(made, h2o=made.h2o * np.exp(sign * wide)).pwv for sign in (-1, 1))
    stacked = math.log(high / low) / 2
    shares = column.column_spread or (STACKING, STACKING)
    return replace(
        made,
        distribution=PwvDistribution(made.pwv, shares[0] * stacked, shares[1] * stacked),
    )


def _check_altitude(column: Column, site: Site) -> None:
    lowest = column.height[0]
    highest = column.height[-1]
    if lowest - EXTRAPOLATION_MAX <= site.altitude < highest:
        return
    low = site.altitude < lowest
    who = column.stated or "its weather"
    where = f"more than {EXTRAPOLATION_MAX:g} m below the lowest" if low else "above the highest"
    raise InputError(
        f"lies at {site.altitude:g} m, {where} level of {who}, {lowest if low else highest:.0f} m",
        place=f"site '{site.name}'",
        cure="check the site's altitude, or choose another climatology or source of weather",
    )


def _ozone(column: Column, log_pressure: Floats) -> Floats:
    if column.ozone_pressure is None or column.ozone is None:
        return ozone(np.exp(log_pressure))
    rising = np.argsort(column.ozone_pressure)
    return np.interp(log_pressure, np.log(column.ozone_pressure[rising]), column.ozone[rising])


def _inverted(profile: Profile, ground_temperature: float) -> Profile:
    """The profile with the inversion that a temperature on the ground implies; vapour is limited to
    saturation.
    """
    temperature = profile.temperature + (ground_temperature - profile.temperature[0]) * np.exp(
        -profile.height / INVERSION_DEPTH
    )
    saturated = saturation_pressure(temperature) / profile.pressure
    cold = (profile.height < 5 * INVERSION_DEPTH) & (profile.h2o > saturated)
    whole = replace(profile, temperature=temperature)
    if not cold.any():
        return whole
    cut = replace(whole, h2o=np.where(cold, saturated, profile.h2o))
    lost = 1 - cut.pwv / whole.pwv
    text = (
        f"cut to saturation at {np.count_nonzero(cold)} levels of the inversion, which takes"
        f" {lost:.2%} of the column"
    )
    return replace(cut, stated=(*cut.stated, ("vapour near the ground", text)))


def _continued(column: Column) -> Column:
    """A column that ends below 15 hPa, continued to 31 km: standard lapse rates, a dry
    stratosphere, the topmost wind.
    """
    height, pressure, temperature = upper_levels(
        *(float(a[-1]) for a in (column.height, column.pressure, column.temperature))
    )
    if not height.size:
        return column

    levels = {"pressure": pressure, "height": height, "temperature": temperature}
    levels["h2o"] = np.full(height.size, min(float(column.h2o[-1]), STRATOSPHERIC_WATER))
    for name in HELD:
        if getattr(column, name) is not None:
            levels[name] = np.full(height.size, getattr(column, name)[-1])
    more: dict[str, Any] = {
        name: np.append(getattr(column, name), values) for name, values in levels.items()
    }
    return replace(column, **more)


def _layer_mean(pressure: Floats, mixing_ratio: Floats) -> Floats:
    """Mean over each layer's mass of a mixing ratio that is a power of the pressure between its
    boundaries. (n - 1,).
    """
    low = mixing_ratio[:-1]
    high = mixing_ratio[1:]
    if not mixing_ratio.all():
        return (low + high) / 2
    thickness = np.log(pressure[:-1] / pressure[1:])
    x = thickness + np.log(
        low / high
    )  # (1 + power) x thickness; 0 where the vapour pressure does not change
    share = np.where(x == 0, 1.0, -np.expm1(-x) / np.where(x == 0, 1.0, x))
    return np.asarray(low * pressure[:-1] * thickness * share / (pressure[:-1] - pressure[1:]))


def pwv_steps(profile: Profile) -> list[float]:
    """PWVs [m] at which spectra are shown: the profile's own, among round values from very dry to
    very wet there.
    """
    law = profile.distribution
    if not profile.pwv > 0:
        return [0.0, 1e-3]
    low = profile.pwv / 3
    high = min(3 * profile.pwv, PWV_MAX)
    if law is not None:
        low = law.at(0.05)
        high = law.at(0.95)
    rounded = {float(f"{low * (high / low) ** (k / 3):.1g}") for k in range(4)}
    return sorted({profile.pwv, *(p for p in rounded if abs(p / profile.pwv - 1) > 0.2)})
