"""Make `operators/atmosphere/data/climatology.npz`: harmonics of ERA5 medians above the sites that weathergen knows.

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

Array = NDArray[np.float64]

MEDIAN, LOW, HIGH = 6, 4, 8
"""Of weathergen's 13 quantiles; LOW and HIGH stand 1.0988 standard deviations of a normal law below and above the median."""
DEVIATIONS = 1.0988
HIGHEST = 10.0
"""hPa: above this level only ozone is kept."""


def saturation_liquid(t: Array) -> Array:
    """Pa over liquid water at T [K], with which weathergen turned ERA5's relative humidity into vapour density."""
    return 611.21 * np.exp(17.67 * (t - 273.15) / (t - 273.15 + 238.88))


def saturation_mixed(t: Array) -> Array:
    """Pa over liquid, ice or both at T [K], which ERA5's relative humidity refers to (IFS documentation cy41r2, IV, 7.5)."""
    liquid = 611.21 * np.exp(17.502 * (t - 273.16) / (t - 32.19))
    ice = 611.21 * np.exp(22.587 * (t - 273.16) / (t + 0.7))
    share = np.clip((t - 250.16) / (273.16 - 250.16), 0, 1) ** 2
    return np.asarray(share * liquid + (1 - share) * ice)


def harmonics(day: Array, annual: int, diurnal: int) -> Array:
    """(n_day * 24, (2 annual + 1)(2 diurnal + 1)) at every day of the year and the middle of every hour, UTC."""
    a, b = 2 * np.pi * day / 365.25, 2 * np.pi * (np.arange(24) + 0.5) / 24
    rows_a = [np.ones_like(a)] + [f(k * a) for k in range(1, annual + 1) for f in (np.cos, np.sin)]
    rows_b = [np.ones_like(b)] + [f(k * b) for k in range(1, diurnal + 1) for f in (np.cos, np.sin)]
    return np.array([np.outer(x, y).ravel() for x in rows_a for y in rows_b]).T


def fit(values: Array, basis: Array) -> NDArray[np.float32]:
    """Least squares of (n_day, 24, n_level) values on the harmonics. (n_harmonic, n_level)."""
    return np.linalg.lstsq(basis, values.reshape(len(basis), -1), rcond=None)[0].astype(np.float32)


def read(path: Path) -> tuple[Array, Array, dict[str, Array]]:
    """Pressure levels in hPa from the ground up, days of the year, and (n_day, 24, n_level, 13) quantiles by variable."""
    with h5py.File(path) as file:
        label = file["variable_labels"][:].astype(str)
        table = file["normalized_quantiles"][:].astype(float) * file["quantiles_scaling"][:] + file["quantiles_offset"][:]
        pressure, day = file["pressure_levels"][:].astype(float) / 100, file["year_day_edge_points"][1:-1]
    return pressure, day, {name: table[:, :, label == name] for name in dict.fromkeys(label)}


def climatology(path: Path) -> dict[str, NDArray[np.float32]]:
    """The arrays of one site (see operators/atmosphere/data/README.md)."""
    pressure, day, quantiles = read(path)
    kept, basis, annual = pressure >= HIGHEST, harmonics(day, 3, 1), harmonics(day, 1, 0)
    temperature, vapour = quantiles["temperature"], np.maximum(quantiles["water_vapor"], 1e-10)
    correction = saturation_mixed(temperature[..., MEDIAN]) / saturation_liquid(temperature[..., MEDIAN])
    medians = {
        "temperature": temperature[..., MEDIAN],
        "log_vapour_density": np.log(vapour[..., MEDIAN] * correction),
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
    air = pressure * 100 / (287.05 * temperature[..., MEDIAN])
    out = {name: fit(values[..., kept], basis) for name, values in medians.items()}
    for name, q in spread_of.items():
        out[f"{name}_spread"] = fit((q[..., HIGH] - q[..., LOW])[..., kept] / (2 * DEVIATIONS), annual)
    out["ozone"] = (quantiles["ozone"][..., MEDIAN] / air * 28.964 / 48).mean(axis=(0, 1)).astype(np.float32)
    out["pressure"] = (pressure * 100).astype(np.float32)
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
        out.update({f"{source.stem}/{name}": values for name, values in climatology(source).items()})
    np.savez_compressed(path, **out)
    print(f"{path}: {path.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
