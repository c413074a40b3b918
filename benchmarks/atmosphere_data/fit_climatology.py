"""Make `operators/atmosphere/data/climatology.npz`: harmonics of ERA5 medians above the sites that
weathergen knows.

Needs `pip install weathergen==2.4.0` (MIT; ERA5 quantiles of 15 years) at development time only:

    python benchmarks/atmosphere_data/fit_climatology.py operators/atmosphere/data/climatology.npz
"""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

Array = NDArray[np.float64]

MEDIAN, LOW, HIGH = 6, 4, 8
"""Of weathergen's 13 quantiles; LOW and HIGH stand 1.04 to 1.10 standard deviations of a normal law
(by site) from the median.
"""
BELOW, ABOVE = slice(3, 6), slice(7, 10)
"""The quantiles from 5 % up to the median, and from it to 95 %: to these the law of the column is
fitted.
"""
ANNUAL, DIURNAL = 4, 2
"""Harmonics of the medians. With 3 and 1 the errors at Sardinia, Sierra Negra and Tibet are half as
large again.
"""
HIGHEST = 10.0
"""hPa: above this level only ozone is kept."""
ICE_SHEETS = ("south_pole", "summit_station")
"""Where ERA5's ground is the telescope's, and an inversion lies on it that is thinner than the
pressure levels resolve.
"""
STRATOSPHERE, STRATOSPHERIC_WATER = 100.0, 5e-6
"""hPa and volume mixing ratio: above this level there is no more water than this. weathergen's
vapour comes from rounded relative humidities, which make 50 to 300 ppm at 10 hPa (5 is known from
satellites) and a hundredth of the column of a dry site."""
COLUMN_EXCESS = 1.15
"""ERA5's own column may be this much more than the levels hold (its ground is lower, beside a
summit) to be used.
"""


def saturation_liquid(t: Array) -> Array:
    """Pa over liquid water at T [K], with which weathergen turned ERA5's relative humidity into
    vapour density.
    """
    return 611.21 * np.exp(17.67 * (t - 273.15) / (t - 273.15 + 238.88))


def saturation_mixed(t: Array) -> Array:
    """Pa over liquid, ice or both at T [K], which ERA5's relative humidity refers to (IFS
    documentation cy41r2, IV, 7.5).
    """
    liquid = 611.21 * np.exp(17.502 * (t - 273.16) / (t - 32.19))
    ice = 611.21 * np.exp(22.587 * (t - 273.16) / (t + 0.7))
    share = np.clip((t - 250.16) / (273.16 - 250.16), 0, 1) ** 2
    return np.asarray(share * liquid + (1 - share) * ice)


def harmonics(day: Array, annual: int, diurnal: int) -> Array:
    """(n_day * 24, (2 annual + 1)(2 diurnal + 1)) at every day of the year and the middle of every
    hour, UTC.
    """
    a, b = 2 * np.pi * day / 365.25, 2 * np.pi * (np.arange(24) + 0.5) / 24
    rows_a = [np.ones_like(a)] + [f(k * a) for k in range(1, annual + 1) for f in (np.cos, np.sin)]
    rows_b = [np.ones_like(b)] + [f(k * b) for k in range(1, diurnal + 1) for f in (np.cos, np.sin)]
    return np.array([np.outer(x, y).ravel() for x in rows_a for y in rows_b]).T


def fit(values: Array, basis: Array) -> NDArray[np.float32]:
    """Least squares of (n_day, 24, n_level) values on the harmonics. (n_harmonic, n_level)."""
    return np.linalg.lstsq(basis, values.reshape(len(basis), -1), rcond=None)[0].astype(np.float32)


def column(log_density: Array, height: Array, above: float) -> Array:
    """kg/m2 of vapour above a height [m] of profiles (..., n_level)."""
    z = np.arange(above, above + 16e3, 100.0)
    flat, heights = (
        log_density.reshape(-1, log_density.shape[-1]),
        height.reshape(-1, height.shape[-1]),
    )
    sums = [np.trapezoid(np.exp(np.interp(z, h, r)), z) for h, r in zip(heights, flat, strict=True)]
    return np.asarray(sums).reshape(log_density.shape[:-1])


def spread_of_column(
    own: Array, deviations: Array, log_density: Array, spread: Array, height: Array, day: Array
) -> Any:
    """(2, 3) standard deviation of ERA5's own ln(column) below and above its median, over what the
    levels' spreads would give if they varied together; None where that column begins far below the
    levels. ``own`` is (n_day, 24, 13), kg/m2.
    """
    log_own = np.log(np.maximum(own, 1e-3))
    mean, heights = log_density.mean(axis=(0, 1)), height.mean(axis=(0, 1))
    ground = np.arange(heights[0], heights[0] + 3e3, 50.0)
    held = np.array([float(column(mean, heights, above)) for above in ground])
    wanted = float(np.exp(log_own[..., MEDIAN].mean()))
    if wanted > COLUMN_EXCESS * held[0]:
        return None
    above = float(np.interp(-wanted, -held, ground))
    hours = slice(0, 24, 3)
    low, high = (
        column((log_density + sign * spread)[:, hours], height[:, hours], above) for sign in (-1, 1)
    )
    stacked = np.log(high / low) / 2
    basis = harmonics(day, 1, 0).reshape(len(day), 24, 3)[:, hours].reshape(-1, 3)
    factors = []
    for part in (BELOW, ABOVE):
        distance = (log_own[..., part] - log_own[..., MEDIAN, None])[:, hours]
        sigma = (distance * deviations[part]).sum(axis=-1) / (deviations[part] ** 2).sum()
        factors.append(fit(sigma / stacked, basis)[:, 0])
    return np.array(factors)


def read(path: Path) -> tuple[Array, Array, Array, dict[str, Array]]:
    """Pressure levels in hPa from the ground up, days of the year, the standard deviations of a
    normal law at which the 13 quantiles stand, and (n_day, 24, n_level, 13) quantiles by variable.
    """
    with h5py.File(path) as file:
        label = file["variable_labels"][:].astype(str)
        table = (
            file["normalized_quantiles"][:].astype(float) * file["quantiles_scaling"][:]
            + file["quantiles_offset"][:]
        )
        pressure, day = (
            file["pressure_levels"][:].astype(float) / 100,
            file["year_day_edge_points"][1:-1],
        )
        deviations = ndtri(file["q"][:])
    return (
        pressure,
        day,
        deviations,
        {name: table[:, :, label == name] for name in dict.fromkeys(label)},
    )


def climatology(path: Path) -> dict[str, NDArray[np.float32]]:
    """The arrays of one site (see operators/atmosphere/data/README.md)."""
    pressure, day, deviations, quantiles = read(path)
    kept, basis, annual = pressure >= HIGHEST, harmonics(day, ANNUAL, DIURNAL), harmonics(day, 1, 0)
    temperature, vapour = quantiles["temperature"], np.maximum(quantiles["water_vapor"], 1e-10)
    correction = saturation_mixed(temperature[..., MEDIAN]) / saturation_liquid(
        temperature[..., MEDIAN]
    )
    most = STRATOSPHERIC_WATER * pressure * 100 / (461.52 * temperature[..., MEDIAN])
    density = np.where(
        pressure <= STRATOSPHERE,
        np.minimum(vapour[..., MEDIAN] * correction, most),
        vapour[..., MEDIAN] * correction,
    )
    medians = {
        "temperature": temperature[..., MEDIAN],
        "log_vapour_density": np.log(density),
        "wind_east": quantiles["wind_east"][..., MEDIAN],
        "wind_north": quantiles["wind_north"][..., MEDIAN],
        "height": quantiles["geopotential"][..., MEDIAN] / 9.80665,
    }
    spread_of = {
        "temperature": temperature,
        "log_vapour_density": np.log(vapour),
        "wind_east": quantiles["wind_east"],
        "wind_north": quantiles["wind_north"],
    }
    out = {name: fit(values[..., kept], basis) for name, values in medians.items()}
    for name, q in spread_of.items():
        out[f"{name}_spread"] = fit(
            (q[..., HIGH] - q[..., LOW])[..., kept] / (deviations[HIGH] - deviations[LOW]), annual
        )
    air = pressure * 100 / (287.05 * temperature[..., MEDIAN])
    out["log_ozone"] = fit(
        np.log(np.maximum(quantiles["ozone"][..., MEDIAN] / air * 28.964 / 47.998, 1e-9)),
        harmonics(day, ANNUAL, 0),
    )
    out["pressure"] = (pressure * 100).astype(np.float32)
    if "column_water_vapor" in quantiles:
        factors = spread_of_column(
            quantiles["column_water_vapor"][:, :, 0],
            deviations,
            medians["log_vapour_density"][..., kept],
            (annual @ out["log_vapour_density_spread"]).reshape(len(day), 24, -1),
            medians["height"][..., kept],
            day,
        )
        if factors is not None:
            out["column_spread"] = factors.astype(np.float32)
    if path.stem in ICE_SHEETS:
        out["ground_temperature"] = fit(quantiles["surface_temperature"][..., MEDIAN], basis)[:, 0]
    return out


def main(path: Path) -> None:
    """Fit every site that has pressure levels, and write the file."""
    spec = importlib.util.find_spec("weathergen")
    if spec is None or spec.origin is None:
        raise SystemExit("pip install weathergen==2.4.0")
    out: dict[str, Any] = {}
    for source in sorted((Path(spec.origin).parent / "region_data").glob("*.h5")):
        with h5py.File(source) as file:
            if "pressure_levels" not in file:
                continue
        out.update(
            {f"{source.stem}/{name}": values for name, values in climatology(source).items()}
        )
    np.savez_compressed(path, **out)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
