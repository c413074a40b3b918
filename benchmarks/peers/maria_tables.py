"""Files of weather and spectra in the layout that maria 1.5 downloads, from zonda's climatology and
absorption table.

With them maria runs without a network, in the same air as zonda. Axes of the spectra are as fine as
those maria publishes.
"""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.site import Site
from zonda.operators.atmosphere.weather.radiative_transfer import spectrum
from zonda.operators.atmosphere.weather.sources import profile_of

PWV = 1e-3 * np.array([0, 0.1, 0.2, 0.5, 1, 2, 5, 10, 20, 50])
ELEVATION = np.radians([10, 20, 30, 40, 50, 60, 70, 80, 90])
GRAVITY = 9.80665


def write_tables(folder: Path, region: str, site: Site, time: Instant) -> None:
    profile = profile_of(None, site, time, 1)
    _weather(folder / "atmosphere" / "weather" / "era5" / f"{region}.h5", profile, site.altitude)
    _spectra(
        folder / "atmosphere" / "spectra" / "am" / "v3" / f"{region}.h5", profile, site.altitude
    )


def _weather(path: Path, profile, altitude: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    celsius = profile.temperature - 273.15
    saturation = 611.21 * np.exp(17.67 * celsius / (238.88 + celsius))  # maria's
    fields = {
        "geopotential": (profile.altitude + profile.height) * GRAVITY,
        "temperature": profile.temperature,
        "humidity": 100 * profile.vapour_density * 461.5 * profile.temperature / saturation,
        "wind_east": profile.wind_east,
        "wind_north": profile.wind_north,
        "wind_speed": np.hypot(profile.wind_east, profile.wind_north),
        "divergence": np.ones_like(profile.height),
    }
    with h5py.File(path, "w") as f:
        f["quantile_levels"], f["pressure_levels"] = [0.0, 1.0], profile.pressure / 100
        f["year_day_side"], f["day_hour_side"] = [-1.0, 367.0], [-1.0, 25.0]
        f["year_day_edge_index"], f["day_hour_edge_index"] = [0, 0], [0, 0]
        for name, values in fields.items():
            f[f"data/{name}/mean"] = values[None, None, None]
            f[f"data/{name}/scale"] = np.ones((1, 1, 1, len(values)))
            f[f"data/{name}/normalized_quantiles"] = np.zeros((1, 1, 2, len(values)))


def _spectra(path: Path, profile, altitude: float) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    found = [[spectrum(profile.scaled(pwv).layers, float(e)) for e in ELEVATION] for pwv in PWV]
    emission = np.array([[s.brightness for s in row] for row in found])
    opacity = np.array([[s.slant_opacity for s in row] for row in found])
    temperature = profile.temperature[0] + np.array([-20.0, 0.0, 20.0])

    def table(values: np.ndarray) -> np.ndarray:
        """The same at every altitude and temperature."""
        return np.broadcast_to(values, (2, len(temperature), *values.shape)).astype(np.float32)

    with h5py.File(path, "w") as f:
        f["rayleigh_jeans_temperature_K"], f["opacity_nepers"], f["excess_path_m"] = (
            table(emission),
            table(opacity),
            table(0 * opacity),
        )
        f["side_altitude_m"], f["side_base_temperature_K"] = [0.0, 9000.0], temperature
        f["side_elevation_deg"], f["side_zenith_pwv_mm"], f["side_nu_Hz"] = (
            np.degrees(ELEVATION),
            1e3 * PWV,
            found[0][0].frequency,
        )
