"""The climatology against the ERA5 quantiles that it was fitted to, at every site: the table in
docs/weather.md.

Needs `pip install weathergen==2.4.0`:

    python benchmarks/weather_era5.py [SITE ...]
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np
from atmosphere_data.fit_climatology import (
    MEDIAN,
    column,
    read,
    saturation_liquid,
    saturation_mixed,
)

from zonda.core.configuration.time import Instant
from zonda.core.registry import sites
from zonda.operators.atmosphere.weather.climatology import climatologies, climatology_column
from zonda.operators.atmosphere.weather.profiles import on_heights

HOURS = range(0, 24, 3)
"""UTC; each stands in the middle of one of weathergen's."""
QUANTILES = (3, 5, 7, 9)
"""Near 5, 29, 71 and 95 %."""


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def compare(path: Path, place: str) -> str:
    """A row of the table: errors over the year, the hours and, of temperature and wind, the levels
    below 150 hPa.
    """
    site = sites.create(place)
    pressure, days, deviations, quantiles = read(path)
    error: dict[str, list[Any]] = {
        key: [] for key in ("water", "temperature", "wind", "median", "quantile", "ground")
    }
    own = quantiles.get("column_water_vapor")
    kept = pressure >= 10
    for i, day in enumerate(days):
        for hour in HOURS:
            when = Instant.parse("2023-01-01T00:00Z").shifted(
                int(day) * 86400 + (hour + 0.5) * 3600
            )
            got = climatology_column(site, when)
            low = got.pressure > 15000
            t, u, v, z = (
                quantiles[k][i, hour, kept, MEDIAN]
                for k in ("temperature", "wind_east", "wind_north", "geopotential")
            )
            error["temperature"].append((got.temperature - t)[low])
            error["wind"].append(np.append((got.wind_east - u)[low], (got.wind_north - v)[low]))
            rho = (
                np.maximum(quantiles["water_vapor"][i, hour, kept, MEDIAN], 1e-10)
                * saturation_mixed(t)
                / saturation_liquid(t)
            )
            ours = np.log(got.h2o * got.pressure / (461.52 * got.temperature))
            truth = column(np.log(rho), z / 9.80665, site.altitude)
            error["water"].append(np.log(column(ours, got.height, site.altitude) / truth))
            air = on_heights(got, site)
            error["median"].append(air.pwv * 1e3)
            if got.column_spread is not None and own is not None and air.distribution is not None:
                law, era5 = air.distribution, own[i, hour, 0]
                for k in QUANTILES:
                    level = NormalDist().cdf(float(deviations[k]))
                    error["quantile"].append(
                        np.log(law.at(level) / law.median) - np.log(era5[k] / era5[MEDIAN])
                    )
            if got.ground_temperature is not None:
                error["ground"].append(
                    air.temperature[0] - quantiles["surface_temperature"][i, hour, 0, MEDIAN]
                )
    t, wind = (rms(np.concatenate(error[key])) for key in ("temperature", "wind"))
    parts = np.reshape(error["quantile"], (-1, len(QUANTILES))) if error["quantile"] else None
    spread = (
        " | ".join(f"{100 * rms(c):.0f} %" for c in parts.T)
        if parts is not None
        else " | ".join("-" * len(QUANTILES))
    )
    ground = f"{rms(error['ground']):.1f} K" if error["ground"] else "-"
    water, median = 100 * rms(error["water"]), np.median(error["median"])
    return (
        f"| {place} | {median:.3g} mm | {water:.1f} % | {t:.2f} K | {wind:.2f} m/s | {spread} |"
        f" {ground} |"
    )


def main() -> None:
    """Print the table."""
    spec = importlib.util.find_spec("weathergen")
    if spec is None or spec.origin is None:
        raise SystemExit("pip install weathergen==2.4.0")
    folder = Path(spec.origin).parent / "region_data"
    print(
        "| site | annual median PWV | PWV | temperature | wind | 5 % | 29 % | 71 % | 95 % |"
        " ground |"
    )
    print("|---|---|---|---|---|---|---|---|---|---|")
    places = sys.argv[1:] or [
        next(n for n in sites if sites.create(n).climatology == c) for c in climatologies()
    ]
    for place in places:
        print(compare(folder / f"{sites.create(place).climatology}.h5", place), flush=True)


if __name__ == "__main__":
    main()
