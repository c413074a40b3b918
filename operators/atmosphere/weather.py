"""The air above a site at a time of year and day, from an embedded climatology (see data/README.md).

Per site and pressure level the median temperature, ln(vapour density), wind and height of 15 years of ERA5 are harmonics,

    x(day, hour) = sum_k c_k A_i(2 pi day / 365.25) H_j(2 pi hour / 24),   k = 3 i + j                             (1)

with A = 1, cos a, sin a, cos 2a, sin 2a, cos 3a, sin 3a and H = 1, cos b, sin b; day counts from 1 January, hour is UTC.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from zonda.core.errors import InputError

from .radiative_transfer import GRAVITY, VAPOUR_GAS_CONSTANT, Layers

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.site import Site

Array = NDArray[np.float64]

CLIMATOLOGY = Path(__file__).parent / "data" / "climatology.npz"

PWV_MAX = 60e-3
"""m: more water than any air on Earth holds above a telescope."""
LEVELS = 61
"""Heights of a profile."""
TOP = 46e3
"""m above the site: the highest of them."""
EXTRAPOLATION_MAX = 500.0
"""m that a site may lie below the lowest level of its climatology."""

DRY_AIR_GAS_CONSTANT = 287.05
"""J / (kg K)."""
STRATOSPHERE_LAPSE = 2.8e-3
"""K / m above the highest climatological level, 10 hPa, as in the US Standard Atmosphere 1976 ..."""
STRATOPAUSE_TEMPERATURE = 270.65
"""... up to this temperature, K."""


@dataclass(frozen=True)
class Air:
    """The air at some heights, arrays of the shape asked for: m above the site, Pa, K, kg/m3, m/s, m/s."""

    height: Array
    pressure: Array
    temperature: Array
    vapour_density: Array
    wind_east: Array
    wind_north: Array


@dataclass(frozen=True)
class Profile:
    """The air above a site, arrays (61,) from the ground up.

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
    """

    height: Array
    pressure: Array
    temperature: Array
    h2o: Array
    o3: Array
    wind_east: Array
    wind_north: Array
    altitude: float

    @property
    def vapour_density(self) -> Array:
        """Mass of water vapour, kg/m3."""
        return self.h2o * self.pressure / (VAPOUR_GAS_CONSTANT * self.temperature)

    @cached_property
    def layers(self) -> Layers:
        """The layers between the heights, and one more of the uppermost air up to zero pressure, for radiative transfer."""
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
        """The same air with all its water multiplied so that it amounts to ``pwv`` [m].

        Raises
        ------
        InputError
            A PWV that is negative or above 60 mm.
        """
        check_pwv(pwv)
        profile = self
        for _ in range(8):  # as in Layers.scaled
            profile = replace(profile, h2o=profile.h2o * (pwv / profile.pwv)) if pwv > 0 else replace(self, h2o=0 * self.h2o)
        return profile

    def at(self, height: ArrayLike) -> Air:
        """The air at heights above the site [m], any shape: winds as vectors, pressure and vapour as logarithms, linearly.

        Raises
        ------
        InputError
            A height below the site or above the profile.
        """
        wanted = np.asarray(height, np.float64)
        if wanted.size and not (wanted.min() >= 0 and wanted.max() <= self.height[-1]):
            given, limits = f"{wanted.min():g} to {wanted.max():g} m", f"0 to {self.height[-1]:g} m"
            raise InputError(f"heights of {given} above the site are outside the profile, {limits}")

        def linear(values: Array) -> Array:
            return np.asarray(np.interp(wanted, self.height, values))

        tiny = np.finfo(np.float64).tiny
        vapour = np.exp(linear(np.log(np.maximum(self.vapour_density, tiny))))
        return Air(
            height=wanted,
            pressure=np.exp(linear(np.log(self.pressure))),
            temperature=linear(self.temperature),
            vapour_density=np.where(vapour > 2 * tiny, vapour, 0.0),
            wind_east=linear(self.wind_east),
            wind_north=linear(self.wind_north),
        )


def profile(site: Site, time: Instant, pwv: float | None = None) -> Profile:
    """The median air above a site at a time, its water scaled to ``pwv`` [m] where that is given.

    Raises
    ------
    InputError
        A site without climatology, an unknown one, one whose levels begin far above the site, an unphysical PWV.
    """
    if pwv is not None:
        check_pwv(pwv)
    levels = _levels(site, time)
    height = TOP * np.expm1(2.5 * np.linspace(0, 1, LEVELS)) / np.expm1(2.5)
    median = _on_heights(levels, site.altitude, height)
    return median if pwv is None else median.scaled(pwv)


def check_pwv(pwv: float) -> None:
    """Refuse a precipitable water vapour [m] that no air holds (`InputError`)."""
    if not 0 <= pwv <= PWV_MAX:
        raise InputError(
            f"a precipitable water vapour of {pwv * 1e3:g} mm is outside the limits, 0 to {PWV_MAX * 1e3:g} mm",
            cure="give the PWV above the site, for example 7.7 mm",
        )


@lru_cache(maxsize=1)
def climatologies() -> tuple[str, ...]:
    """Names of the embedded climatologies, sorted."""
    with np.load(CLIMATOLOGY) as file:
        return tuple(sorted({key.split("/")[0] for key in file.files}))


@lru_cache(maxsize=8)
def coefficients(name: str) -> dict[str, NDArray[np.float32]]:
    """The arrays of one embedded climatology by quantity, as data/README.md lists them."""
    with np.load(CLIMATOLOGY) as file:
        return {key.split("/")[1]: file[key] for key in file.files if key.startswith(f"{name}/")}


@dataclass(frozen=True)
class _Levels:
    """Profiles on the climatology's pressure levels, from the lowest up: Pa, m above sea level, K, volume mixing ratio, m/s."""

    pressure: Array
    height: Array
    temperature: Array
    h2o: Array
    wind_east: Array
    wind_north: Array
    ozone_pressure: Array
    ozone: Array


def _levels(site: Site, time: Instant) -> _Levels:
    """Equation (1)."""
    name, place = site.climatology, f"site '{site.name}'"
    known = climatologies()
    if name is None:
        raise InputError(
            "has no climatology, so the air above it is unknown",
            place=place,
            cure=f"choose a site that has one (see `zonda plugins`), or set its climatology to one of: {', '.join(known)}",
        )
    if name not in known:
        raise InputError(f"climatology '{name}' does not exist", place=place, cure=f"choose one of: {', '.join(known)}")
    basis, arrays = harmonics(*_day_and_hour(time)), coefficients(name)

    def median(quantity: str) -> Array:
        return np.asarray(basis @ arrays[quantity].astype(np.float64))

    every_pressure, ozone = (arrays[quantity].astype(np.float64) for quantity in ("pressure", "ozone"))
    height, temperature = median("height"), median("temperature")
    pressure = every_pressure[: len(height)]  # the highest levels have ozone only
    if site.altitude < height[0] - EXTRAPOLATION_MAX:
        raise InputError(
            f"lies at {site.altitude:g} m, more than {EXTRAPOLATION_MAX:g} m below the lowest level of climatology "
            f"'{name}', {height[0]:.0f} m",
            place=place,
            cure="check the site's altitude, or choose another climatology",
        )
    h2o = np.exp(median("log_vapour_density")) * VAPOUR_GAS_CONSTANT * temperature / pressure
    return _Levels(pressure, height, temperature, h2o, median("wind_east"), median("wind_north"), every_pressure, ozone)


def _day_and_hour(time: Instant) -> tuple[float, float]:
    """Days since 1 January, and the hour of the day, UTC."""
    moment = time.datetime
    hour = moment.hour + moment.minute / 60 + moment.second / 3600
    return moment.timetuple().tm_yday - 1 + hour / 24, hour


def harmonics(day: float, hour: float) -> Array:
    """(21,) the products A_i H_j of equation (1)."""
    a, b = 2 * np.pi * day / 365.25, 2 * np.pi * hour / 24
    annual = np.concatenate([[1.0], *([np.cos(k * a), np.sin(k * a)] for k in (1, 2, 3))])
    return np.outer(annual, [1.0, np.cos(b), np.sin(b)]).ravel()


def _on_heights(levels: _Levels, altitude: float, height: Array) -> Profile:
    """From pressure levels to heights above the site; above 10 hPa the stratosphere of the US Standard Atmosphere."""
    z = altitude + height
    inside = np.clip(z, levels.height[0], levels.height[-1])
    above, below = np.maximum(z - levels.height[-1], 0.0), np.minimum(z - levels.height[0], 0.0)

    def linear(values: Array) -> Array:
        return np.asarray(np.interp(inside, levels.height, values))

    lapse = (levels.temperature[1] - levels.temperature[0]) / (levels.height[1] - levels.height[0])
    top = levels.temperature[-1]
    warming = np.minimum(STRATOSPHERE_LAPSE * above, max(STRATOPAUSE_TEMPERATURE - top, 0.0))
    temperature = linear(levels.temperature) + lapse * below + warming
    mean = np.where(above > 0, (temperature + top) / 2, temperature)  # of the air between the outermost level and z
    log_pressure = linear(np.log(levels.pressure)) - GRAVITY * (above + below) / (DRY_AIR_GAS_CONSTANT * mean)
    rising = np.argsort(levels.ozone_pressure)
    return Profile(
        height=height,
        pressure=np.exp(log_pressure),
        temperature=temperature,
        h2o=np.exp(linear(np.log(levels.h2o))),
        o3=np.interp(log_pressure, np.log(levels.ozone_pressure[rising]), levels.ozone[rising]),
        wind_east=linear(levels.wind_east),
        wind_north=linear(levels.wind_north),
        altitude=altitude,
    )


def _layer_mean(pressure: Array, mixing_ratio: Array) -> Array:
    """Mean over each layer's mass of a mixing ratio that is a power of the pressure between its boundaries. (n - 1,)."""
    low, high = mixing_ratio[:-1], mixing_ratio[1:]
    if not mixing_ratio.all():
        return (low + high) / 2
    slope = np.log(low / high) / np.log(pressure[:-1] / pressure[1:])
    return np.asarray((low * pressure[:-1] - high * pressure[1:]) / ((1 + slope) * (pressure[:-1] - pressure[1:])))
