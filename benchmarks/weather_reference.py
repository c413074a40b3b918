"""The climatology against ERA5's quantiles and TOAST's MERRA-2 statistics, at the sites of the
reference data.

python benchmarks/weather_reference.py FOLDER_OF_REFERENCE
"""

from __future__ import annotations

import sys
from pathlib import Path
from statistics import NormalDist
from typing import Any

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.registry import sites
from zonda.operators.atmosphere.weather.climatology import climatology_column, profile
from zonda.operators.atmosphere.weather.profiles import on_heights


def instant(day: float, hour: float) -> Instant:
    return Instant.parse("2023-01-01T00:00Z").shifted(int(day) * 86400 + hour * 3600)


def rms(values: Any) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def era5(folder: Path, name: str) -> None:
    file, site = np.load(folder / f"weathergen_{name}.npz"), sites.create(name)
    width = NormalDist().inv_cdf(float(file["quantile"][-1])) - NormalDist().inv_cdf(
        float(file["quantile"][0])
    )
    error: dict[str, list[Any]] = {
        key: [] for key in ("temperature", "east", "north", "water", "spread")
    }
    for i, day in enumerate(file["year_day"]):
        for j, hour in enumerate(file["utc_hour"]):
            got = climatology_column(site, instant(day, hour))
            n = len(got.pressure)
            low = got.pressure > 15000
            error["temperature"].append((got.temperature - file["temperature_K"][i, j, :n, 2])[low])
            error["east"].append((got.wind_east - file["wind_east_ms"][i, j, :n, 2])[low])
            error["north"].append((got.wind_north - file["wind_north_ms"][i, j, :n, 2])[low])
            above = np.linspace(site.altitude, site.altitude + 15e3, 400)
            vapour = (
                file["water_vapor_raw_kg_m3"][i, j, :, 2]
                * file["rh_water_to_mixed_correction"][i, j]
            )[:n]
            ours = got.h2o * got.pressure / (461.52 * got.temperature)
            columns = [
                np.trapezoid(np.exp(np.interp(above, h, np.log(rho))), above)
                for h, rho in ((got.height, ours), (file["height_m"][i, j, :n], vapour))
            ]
            error["water"].append(np.log(columns[0] / columns[1]))
            law = on_heights(got, site).distribution
            assert law is not None
            error["spread"].append(
                law.sigma / (np.log(file["tcwv_mm"][i, j, -1] / file["tcwv_mm"][i, j, 0]) / width)
            )
    t, u, v = (rms(np.concatenate(error[key])) for key in ("temperature", "east", "north"))
    print(
        f"| {name} | {100 * rms(error['water']):.1f} % | {t:.2f} K | {u:.2f}, {v:.2f} m/s |"
        f" {np.mean(error['spread']):.2f} |"
    )


def merra2(folder: Path, name: str, place: str) -> None:
    file, site = np.load(folder / "toast_merra2_weather.npz"), sites.create(place)
    half, ratio, warm = (
        int(np.argmin(abs(file["probability"] - 0.5))),
        np.empty((12, 8)),
        np.empty((12, 8)),
    )
    for month in range(12):
        for k, hour in enumerate(range(0, 24, 3)):
            when = Instant.parse(f"2023-{month + 1:02d}-15T{hour:02d}:00Z")
            column = climatology_column(site, when)
            ground = np.interp(
                -np.log(file[f"{name}_PS_Pa"][month, hour]), -np.log(column.pressure), column.height
            )
            air = profile(site.model_copy(update={"altitude": float(ground)}), when)
            ratio[month, k] = np.log(air.pwv * 1e3 / file[f"{name}_pwv_mm"][month, hour, half])
            warm[month, k] = air.temperature[0] - file[f"{name}_T10M_K"][month, hour, half]
    by_month = np.exp(ratio.mean(1))
    print(
        f"{name}: PWV / MERRA-2 {np.exp(ratio.mean()):.2f} (months {by_month.min():.2f} to"
        f" {by_month.max():.2f}),",
        end=" ",
    )
    print(
        f"temperature {warm.mean():+.1f} K (months {warm.mean(1).min():+.1f} to"
        f" {warm.mean(1).max():+.1f})"
    )


if __name__ == "__main__":
    reference = Path(sys.argv[1])
    print("| site | PWV | temperature | wind (east, north) | spread of ln PWV / ERA5's |")
    print("|---|---|---|---|---|")
    for where in ("green_bank", "chajnantor", "south_pole"):
        era5(reference, where)
    merra2(reference, "atacama", "chajnantor")
    merra2(reference, "south_pole", "south_pole")
