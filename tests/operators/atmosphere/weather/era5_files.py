"""ERA5-like files of made-up air: everything is linear in latitude, longitude and time."""

from datetime import UTC, datetime

import h5py
import numpy as np
from scipy.io import netcdf_file

from zonda.operators.atmosphere.weather import air as standard

LEVELS = np.array([1000, 925, 850, 700, 600, 500, 400, 300, 250, 200, 150, 100, 50, 20, 10.0])
START = datetime(2024, 3, 1, tzinfo=UTC)


def air(latitude, longitude, hours, levels=LEVELS):
    """Variables at points that broadcast against the levels (last axis)."""
    heights = np.linspace(-1000, 40e3, 4001)
    z = np.interp(-levels * 100, -standard.pressure(heights), heights)
    tilt = 0.5 * (latitude - 40) + 0.25 * (longitude - 10) + 0.1 * hours
    q = 8e-3 * np.exp(-z / 2000.0) + 3e-6
    return {
        "t": standard.temperature(z) + tilt,
        "q": q * np.exp(0.05 * tilt),
        "u": 10 + z / 1000 + tilt,
        "v": -5 + 2 * tilt + 0 * z,
        "z": 9.80665 * (z + 10 * tilt),
        "o3": 1e-6 * (1 + 0 * z + 0 * tilt),
    }


def grid(latitude, longitude, hours, levels=LEVELS):
    t, p, y, x = np.meshgrid(hours, levels, latitude, longitude, indexing="ij")
    return air(y, x, t, p)


def new_layout(
    path,
    latitude=(41.0, 40.5, 40.0),
    longitude=(9.75, 10.0, 10.25),
    hours=(0, 3, 6),
    levels=LEVELS,
    without=(),
    change=None,
):
    """NetCDF-4 as of 2024: valid_time, pressure_level, an ensemble number, latitudes from the
    north.
    """
    values = grid(
        np.array(latitude), np.array(longitude), np.array(hours, float), np.array(levels, float)
    )
    values = values if change is None else change(values)
    with h5py.File(path, "w") as file:
        axes = {
            "valid_time": START.timestamp() + 3600 * np.array(hours, np.int64),
            "pressure_level": np.array(levels, float),
            "latitude": np.array(latitude),
            "longitude": np.array(longitude),
        }
        for name, points in axes.items():
            file[name] = points
            file[name].make_scale(name)
        file["valid_time"].attrs["units"] = "seconds since 1970-01-01"
        file["pressure_level"].attrs["units"] = "hPa"
        file["number"] = np.int64(0)
        for name, array in values.items():
            if name not in without:
                file[name] = array.astype(np.float32)
                for k, axis in enumerate(axes):
                    file[name].dims[k].attach_scale(file[axis])
                file[name].attrs["_FillValue"] = np.float32(np.nan)
    return path


def old_layout(
    path, latitude=(41.0, 40.5, 40.0), longitude=(9.75, 10.0, 10.25), hours=(0, 3, 6), expver=False
):
    """NetCDF-3 as before 2024: time, level in millibars, values packed in 16 bits, expver as an
    axis where asked.
    """
    values = grid(np.array(latitude), np.array(longitude), np.array(hours, float))
    with netcdf_file(path, "w", version=2) as file:
        since = (START - datetime(1900, 1, 1, tzinfo=UTC)).total_seconds() / 3600
        axes = {"time": (since + np.array(hours)).astype("i4"), "level": LEVELS.astype("i4")}
        axes |= {"latitude": np.array(latitude, "f4"), "longitude": np.array(longitude, "f4")}
        for name, points in axes.items():
            file.createDimension(name, len(points))
            file.createVariable(name, points.dtype, (name,))[:] = points
        file.variables["time"].units = "hours since 1900-01-01 00:00:00.0"
        file.variables["level"].units = "millibars"
        names = tuple(axes)
        if expver:
            file.createDimension("expver", 2)
            names = ("time", "expver", "level", "latitude", "longitude")
        for name, array in values.items():
            low, high = array.min(), array.max()
            scale = max(high - low, 1e-9) / 65000
            packed = np.round((array - low) / scale - 32500).astype("i2")
            variable = file.createVariable(name, "i2", names)
            variable.scale_factor, variable.add_offset = scale, low + 32500 * scale
            variable._FillValue = np.int16(-32767)
            if expver:
                variable[:, 0] = np.int16(-32767)
                variable[:, 1] = packed
            else:
                variable[:] = packed
    return path
