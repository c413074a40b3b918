"""The embedded climatology (see data/README.md).

Per site and pressure level the median temperature, ln(vapour density), wind and height of 15 years
of ERA5 are harmonics,

    x(day, hour) = sum_k c_k A_i(2 pi day / 365.25) H_j(2 pi hour / 24),
    k = 5 i + j                             (1)

with A = 1, cos a, sin a, ... cos 4a, sin 4a and H = 1, cos b, sin b, cos 2b, sin 2b; day counts
from 1 January, hour is UTC.
"""

from __future__ import annotations

from calendar import isleap
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.site import Site
from zonda.core.storage.files import own_data
from zonda.core.types import Floats
from zonda.core.weather import Column

from .air import standard_column
from .profiles import Profile, check_pwv, on_heights
from .radiative_transfer import VAPOUR_GAS_CONSTANT

CLIMATOLOGY = Path(__file__).parent.parent / "data" / "climatology.npz"

YEARS = (1940, 2100)
"""Years for which the climatology, of 15 recent ones, is taken: ERA5 begins with the first."""
HOURS = tuple(range(0, 24, 3))
"""Hours (UTC) of `pwv_by_month`."""
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)
"""Quantiles of the PWV in `PwvByMonth`."""
MONTHS = ("Jan", "Feb", "Mar", "Apr", "May", "Jun", "Jul", "Aug", "Sep", "Oct", "Nov", "Dec")


def profile(site: Site, time: Instant, pwv: float | None = None) -> Profile:
    """The median profile above a site at a time, scaled to ``pwv`` [m] where that is given.

    A site without climatology has the US Standard Atmosphere where ``pwv`` is given.

    Raises
    ------
    InputError
        Neither climatology nor PWV, an unknown climatology, one whose levels begin far above the
        site, an unphysical PWV, a time outside `YEARS`.
    """
    if pwv is not None:
        check_pwv(pwv)
    column = (
        standard_column(site)
        if site.climatology is None and pwv is not None
        else climatology_column(site, time)
    )
    median = on_heights(column, site)
    return median if pwv is None else median.scaled(pwv)


@lru_cache(maxsize=1)
def climatologies() -> tuple[str, ...]:
    """Names of the embedded climatologies, sorted."""
    with own_data(CLIMATOLOGY) as file:
        return tuple(sorted({key.split("/")[0] for key in file.files}))


@lru_cache(maxsize=8)
def coefficients(name: str) -> dict[str, NDArray[np.float32]]:
    """The arrays of one embedded climatology by quantity, as data/README.md lists them."""
    with own_data(CLIMATOLOGY) as file:
        return {key.split("/")[1]: file[key] for key in file.files if key.startswith(f"{name}/")}


def climatology_column(site: Site, time: Instant) -> Column:
    """Equation (1), with its spreads. Raises `InputError` as `profile`."""
    name = site.climatology
    place = f"site '{site.name}'"
    known = climatologies()
    if name is None:
        raise InputError(
            "has no climatology, so the atmosphere above it is unknown",
            place=place,
            cure=(
                "give its PWV, e.g. weather: {pwv: 3 mm}, or an ERA5 file, weather: {file:"
                " era5.nc}, which `zonda weather fetch` gets; or choose a site that has a"
                " climatology (see `zonda plugins`), or set the site's climatology to one of:"
                f" {', '.join(known)}"
            ),
        )
    if name not in known:
        raise InputError(
            f"climatology '{name}' does not exist",
            place=place,
            cure=f"choose one of: {', '.join(known)}",
        )
    if not YEARS[0] <= time.datetime.year < YEARS[1]:
        raise InputError(
            f"{time} is outside what the climatology stands for, {YEARS[0]} to {YEARS[1]}",
            place=place,
            cure="choose a time in these years: the climatology is that of ERA5's recent ones",
        )
    basis, arrays = harmonics(*_day_and_hour(time)), coefficients(name)

    def median(quantity: str) -> Floats:
        return basis @ arrays[quantity].astype(np.float64)

    every_pressure = arrays["pressure"].astype(np.float64)
    height = median("height")
    temperature = median("temperature")
    pressure = every_pressure[: len(height)]  # the highest levels have ozone only
    h2o = np.exp(median("log_vapour_density")) * VAPOUR_GAS_CONSTANT * temperature / pressure
    annual = basis[::5]  # 1, cos a, sin a, ...
    spread = {
        name: annual[:3] @ arrays[f"{name}_spread"]
        for name in ("log_vapour_density", "wind_east", "wind_north")
    }
    shares = arrays.get("column_spread")
    return Column(
        pressure=pressure,
        height=height,
        temperature=temperature,
        h2o=h2o,
        wind_east=median("wind_east"),
        wind_north=median("wind_north"),
        ozone_pressure=every_pressure,
        ozone=np.exp(annual @ arrays["log_ozone"].astype(np.float64)),
        log_vapour_spread=spread["log_vapour_density"],
        wind_east_spread=spread["wind_east"],
        wind_north_spread=spread["wind_north"],
        column_spread=(
            None
            if shares is None
            else (float(shares[0] @ annual[:3]), float(shares[1] @ annual[:3]))
        ),
        ground_temperature=(
            float(median("ground_temperature")) if "ground_temperature" in arrays else None
        ),
        stated=f"climatology '{name}' (ERA5), {time}",
    )


def _day_and_hour(time: Instant) -> tuple[float, float]:
    """Days since 1 January, stretched so that every year has 365.25 and closes, and the hour of the
    day, UTC.
    """
    moment = time.datetime
    hour = moment.hour + moment.minute / 60 + moment.second / 3600
    return (moment.timetuple().tm_yday - 1 + hour / 24) * 365.25 / (365 + isleap(moment.year)), hour


def harmonics(day: float, hour: float) -> Floats:
    """(45,) the products A_i H_j of equation (1)."""
    a = 2 * np.pi * day / 365.25
    b = 2 * np.pi * hour / 24
    annual, diurnal = (
        np.concatenate([[1.0], *([np.cos(k * x), np.sin(k * x)] for k in range(1, n + 1))])
        for x, n in ((a, 4), (b, 2))
    )
    return np.outer(annual, diurnal).ravel()


@dataclass(frozen=True)
class PwvByMonth:
    """PWV [m] on the 15th of each month: ``median`` (12, n_hour), and the mean over the hours of
    ``quantiles`` (12, 5).
    """

    median: Floats
    quantiles: Floats


def pwv_by_month(site: Site, year: int = 2023) -> PwvByMonth:
    """PWV by month, from the site's climatology. Raises `InputError` where there is none."""
    median = np.empty((12, len(HOURS)))
    quantiles = np.zeros((12, len(QUANTILES)))
    for month in range(12):
        for k, hour in enumerate(HOURS):
            law = profile(
                site,
                Instant.parse(f"{year}-{month + 1:02d}-15T{hour:02d}:00Z"),
            ).distribution
            assert law is not None  # the climatology has spreads
            median[month, k] = law.median
            quantiles[month] += np.array([law.at(q) for q in QUANTILES]) / len(HOURS)
    return PwvByMonth(median, quantiles)
