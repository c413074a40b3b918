"""The atmosphere above a place from a file of ERA5 on pressure levels, as the Copernicus Climate Data Store delivers it.

Both layouts are read: NetCDF-4 with ``valid_time`` and ``pressure_level`` (from 2024), and NetCDF-3 with packed values,
``time`` and ``level`` (before). Only what surrounds the place and the time is read from the disk. Interpolation is bilinear in
longitude and latitude and linear in time, of the temperature, the winds, the geopotential and the logarithm of humidity.
Heights are geopotential heights z / g. `retrieve` downloads such a file through the store's own client ``cdsapi``.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.errors import InputError, placed
from zonda.core.storage import hdf5_files
from zonda.core.storage.files import reading
from zonda.core.types import Floats
from zonda.core.weather import Column

from .humidity import from_relative, from_specific, ozone_from_mass
from .radiative_transfer import GRAVITY

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.site import Site


VARIABLES = {
    "t": "temperature",
    "q": "specific_humidity",
    "r": "relative_humidity",
    "u": "u_component_of_wind",
    "v": "v_component_of_wind",
    "z": "geopotential",
    "o3": "ozone_mass_mixing_ratio",
}
"""Short names in the file, and what the Climate Data Store calls them."""
AXES = {
    "time": ("valid_time", "time"),
    "level": ("pressure_level", "level"),
    "lat": ("latitude", "lat"),
    "lon": ("longitude", "lon"),
}
"""Names of the axes."""

SPACING_MAX = 1.0
"""deg between grid points, beyond which a mountain and its valley are one."""
STEP_MAX = 6.0
"""h between times."""
RATIO_MAX = 1.55
"""Between neighbouring pressure levels up to `HIGHEST` (700 and 500 hPa pass, 1000 and 500 hPa do not)."""
HIGHEST = 20000.0
"""Pa that the levels must reach: the vapour lies below."""
HALF_CELL = 0.13
"""deg that the place may lie outside the grid: half a cell of ERA5's own."""

DRIEST = 1e-9
"""kg/kg, or % of relative humidity: less is taken as this, which is 1e-5 mm of water in the whole column."""

GET = "`zonda weather fetch SITE --time TIME --output era5.nc` gets such a file, or the Climate Data Store's pages do"


def read_era5(path: Path, site: Site, time: Instant) -> Column:
    """The column above ``site`` at ``time``.

    Raises
    ------
    InputError
        A file that is not NetCDF, lacks a variable or an axis, is too coarse, or does not cover the place or the time.
    """
    place = f"ERA5 file {path}"
    with placed(place), _opened(path, place) as file:
        lacking = [name for name in ("t", "u", "v", "z") if name not in file] + ([] if "q" in file or "r" in file else ["q"])
        if lacking:
            names = ", ".join(f"{name} ({VARIABLES[name]})" for name in lacking)
            raise InputError(f"lacks {names}", cure=f"download these too: {GET}")
        axes = {kind: _axis(file, names) for kind, names in AXES.items()}
        pressure = _pressure(file, axes["level"])
        latitude, longitude = np.degrees(site.latitude), np.degrees(site.longitude)
        weights = {
            "time": _time_weights(file, axes["time"], time),
            "lat": _latitude_weights(file.values(axes["lat"]), latitude),
            "lon": _longitude_weights(file.values(axes["lon"]), longitude, abs(latitude)),
        }
        order = np.argsort(-pressure)

        def column(name: str, logarithm: bool = False) -> Floats:
            return file.interpolated(name, axes, weights, logarithm)[order]

        pressure, temperature = pressure[order], column("t")
        if "q" in file:
            h2o = from_specific(column("q", logarithm=True))
        else:
            h2o = from_relative(column("r", logarithm=True) / 100, pressure, temperature)
        o3 = column("o3") if "o3" in file else None
        return Column(
            pressure=pressure,
            height=column("z") / GRAVITY,
            temperature=temperature,
            h2o=h2o,
            wind_east=column("u"),
            wind_north=column("v"),
            ozone_pressure=pressure if "o3" in file else None,
            ozone=ozone_from_mass(np.maximum(o3, 0.0)) if o3 is not None else None,
            stated=f"ERA5 from {path.name}, {time}"
            + (f" ({'; '.join(remarks)})" if (remarks := _remarks(file.below_none, o3)) else ""),
        )


def _remarks(water_below_none: int, o3: Floats | None) -> list[str]:
    """What ERA5's packing and spectral transform leave: slightly negative water and ozone, which are taken as none."""
    ozone_below_none = 0 if o3 is None else int(np.count_nonzero(o3 < 0))
    found = ["ozone of the standard atmosphere"] if o3 is None else []
    found += [f"{water_below_none} negative values of the humidity taken as none"] if water_below_none else []
    return found + ([f"{ozone_below_none} negative levels of ozone taken as none"] if ozone_below_none else [])


class _File:
    """What NetCDF-3 and NetCDF-4 have in common.

    ``below_none``: how many values below 0 were raised to `DRIEST` before their logarithm was taken.
    """

    def __init__(self, variables: Any, dimensions: dict[str, list[str]], place: str) -> None:
        self._variables, self._dimensions, self._place = variables, dimensions, place
        self.below_none = 0

    def __contains__(self, name: str) -> bool:
        return name in self._dimensions

    def attribute(self, name: str, key: str, default: Any = None) -> Any:
        variable = self._variables[name]
        value = variable.attrs.get(key, default) if hasattr(variable, "attrs") else getattr(variable, key, default)
        if isinstance(value, bytes):
            return value.decode()
        return value.item() if isinstance(value, np.ndarray) and value.size == 1 else value

    def values(self, name: str, where: Any = ()) -> Floats:
        """Unpacked values, NaN where they are missing."""
        if hasattr(self._variables[name], "dims"):
            hdf5_files.check_size(self._variables[name], self._place)
        raw = np.asarray(self._variables[name][where])
        missing = [self.attribute(name, key) for key in ("_FillValue", "missing_value")]
        scale, offset = float(self.attribute(name, "scale_factor", 1.0)), float(self.attribute(name, "add_offset", 0))
        out = raw.astype(np.float64) * scale + offset
        for value in missing:
            if value is not None:
                out = np.where(raw == value, np.nan, out)
        return np.atleast_1d(out)

    def interpolated(self, name: str, axes: dict[str, str], weights: dict[str, dict[int, float]], log: bool) -> Floats:
        """(n_level,) of a variable."""
        total: Floats | float = 0.0
        for i, a in weights["time"].items():
            for j, b in weights["lat"].items():
                for k, c in weights["lon"].items():
                    column = self._column(name, axes, {"time": i, "lat": j, "lon": k})
                    if log:
                        self.below_none += int(np.count_nonzero(column < 0))
                        column = np.log(np.maximum(column, DRIEST))
                    total = total + a * b * c * column
        return np.asarray(np.exp(total) if log else total)

    def _column(self, name: str, axes: dict[str, str], at: dict[str, int]) -> Floats:
        names = self._dimensions[name]
        index = {axes[kind]: value for kind, value in at.items()} | {axes["level"]: slice(None)}
        if any(axis not in names for axis in axes.values()):
            message = f"the variable {name} lies on {', '.join(names)}"
            raise InputError(message, cure=f"it needs time, level, latitude and longitude: {GET}")
        values = self.values(name, tuple(index.get(n, slice(None)) for n in names))
        extra = [n for n in names if n not in index]  # expver: ERA5, and its preliminary months; number: of an ensemble
        if extra:
            rest = [n for n in names if n in extra or n == axes["level"]]
            values = np.moveaxis(values, rest.index(axes["level"]), 0).reshape(values.shape[rest.index(axes["level"])], -1)
            whole = np.flatnonzero(np.isfinite(values).all(axis=0))
            values = values[:, whole[0] if len(whole) else 0]
        if not np.isfinite(values).all():
            raise InputError(f"the variable {name} has no values at this place and time", cure="download the file again")
        return values


@contextmanager
def _opened(path: Path, place: str) -> Iterator[_File]:
    import h5py

    kind, cure = "NetCDF", f"a GRIB file must be converted, a zip file unpacked; {GET}"
    with reading(place, kind, cure):
        of_hdf5 = path.is_file() and h5py.is_hdf5(path)
    if of_hdf5:
        with hdf5_files.opened(path, place, kind, cure) as file:
            sets = {name: file[name] for name in file if isinstance(file.get(name), h5py.Dataset)}
            yield _File(sets, {name: [_label(d) for d in item.dims] for name, item in sets.items()}, place)
        return
    from scipy.io import netcdf_file

    with reading(place, kind, cure), netcdf_file(path, "r", mmap=False) as file:
        yield _File(file.variables, {name: list(v.dimensions) for name, v in file.variables.items()}, place)


def _label(dimension: Any) -> str:
    return str(dimension[0].name).rpartition("/")[2] if len(dimension) else str(dimension.label)


def _axis(file: _File, names: tuple[str, ...]) -> str:
    found = next((name for name in names if name in file), None)
    if found is None:
        raise InputError(f"has no axis {' or '.join(names)}", cure=f"it must be on pressure levels: {GET}")
    return found


def _pressure(file: _File, name: str) -> Floats:
    """(n_level,) Pa."""
    unit = str(file.attribute(name, "units", "hPa"))
    pressure = file.values(name) * (1.0 if unit == "Pa" else 100.0)
    falling = np.sort(pressure)[::-1]
    low = falling[falling >= HIGHEST * (1 - 1e-9)]
    gap = float((low[:-1] / low[1:]).max()) if len(low) > 1 else np.inf
    if falling[-1] > HIGHEST or gap > RATIO_MAX:
        levels = f"its {len(falling)} pressure levels ({', '.join(f'{p / 100:g}' for p in falling[:12])} hPa)"
        fault = f"end at {falling[-1] / 100:g} hPa" if falling[-1] > HIGHEST else f"lie up to a factor {gap:.2g} apart"
        cure = f"download all levels up to {HIGHEST / 100:g} hPa or higher, none further apart than 700 and 500 hPa: {GET}"
        raise InputError(f"is too coarse: {levels} {fault}", cure=cure)
    return pressure


def _time_weights(file: _File, name: str, time: Instant) -> dict[int, float]:
    match = re.match(r"(seconds|hours|days) since (\d+)-(\d+)-(\d+)", str(file.attribute(name, "units", "")))
    if not match:
        raise InputError(f"its {name} has the unit '{file.attribute(name, 'units')}'", cure="expected hours since a date")
    start = datetime(int(match[2]), int(match[3]), int(match[4]), tzinfo=UTC).timestamp()
    seconds = start + file.values(name) * {"seconds": 1.0, "hours": 3600.0, "days": 86400.0}[match[1]]
    order, wanted = np.argsort(seconds), time.posix
    first, last = seconds[order[0]], seconds[order[-1]]
    if not first - 1800 <= wanted <= last + 1800:
        covered = " to ".join(f"{datetime.fromtimestamp(t, UTC):%Y-%m-%dT%H:%MZ}" for t in (first, last))
        raise InputError(f"covers {covered}, not {time}", cure=f"change the time, or get the file for it: {GET}")
    weights = _linear(seconds[order], wanted)
    if len(weights) == 2:
        low, high = (seconds[order[k]] for k in weights)
        if high - low > STEP_MAX * 3600 * 1.001:
            message = f"is too coarse: its times around {time} are {(high - low) / 3600:g} h apart"
            raise InputError(message, cure=f"get it every {STEP_MAX:g} h or more often: {GET}")
    return {int(order[k]): w for k, w in weights.items()}


def _latitude_weights(latitude: Floats, wanted: float) -> dict[int, float]:
    order = np.argsort(latitude)
    return {int(order[k]): w for k, w in _within(latitude[order], wanted, "latitudes").items()}


def _longitude_weights(longitude: Floats, wanted: float, latitude: float) -> dict[int, float]:
    offset = (longitude - wanted + 180) % 360 - 180  # the place is at 0, wherever the file cuts the globe
    order = np.argsort(offset)
    if latitude > 89.9:
        return {int(np.argmin(np.abs(offset))): 1.0}
    return {int(order[k]): w for k, w in _within(offset[order], 0.0, "longitudes", wanted).items()}


def _within(points: Floats, wanted: float, noun: str, origin: float = 0.0) -> dict[int, float]:
    if not points[0] - HALF_CELL <= wanted <= points[-1] + HALF_CELL:
        message = f"covers {noun} {points[0] + origin:.2f} to {points[-1] + origin:.2f} deg, not {wanted + origin:.2f} deg"
        raise InputError(message, cure=f"get the file for this place: {GET}")
    weights = _linear(points, wanted)
    spacing = np.ptp(points[list(weights)])
    if spacing > SPACING_MAX * 1.001:
        message = f"is too coarse: its {noun} are {spacing:g} deg apart"
        raise InputError(message, cure=f"get it on a grid of {SPACING_MAX:g} deg or finer (ERA5 has 0.25): {GET}")
    return weights


def _linear(points: Floats, wanted: float) -> dict[int, float]:
    """Weights of the points around ``wanted``, by index; the nearest end where it is outside."""
    k = int(np.searchsorted(points, wanted))
    if k == 0 or k == len(points):
        return {min(k, len(points) - 1): 1.0}
    share = float((wanted - points[k - 1]) / (points[k] - points[k - 1]))
    return {k: 1.0} if share == 1 else {k - 1: 1 - share, k: share}


DATASET = "reanalysis-era5-pressure-levels"
_HIGH = (1, 2, 3, 5, 7, 10, 20, 30, 50, 70, 100, 125, 150, 175, 200, 225, 250, 300, 350, 400, 450, 500, 550, 600, 650, 700)
LEVELS = (*_HIGH, 750, 775, 800, 825, 850, 875, 900, 925, 950, 975, 1000)
"""hPa: all of them."""
KEY = "https://cds.climate.copernicus.eu/how-to-api says how to get a free key and where to put it"


def request(site: Site, time: Instant, hours: int) -> dict[str, Any]:
    """What to ask for: the cells around the site, and every hour from that before ``time`` to ``hours`` later.

    The store takes whole days times hours of the day, so a period over midnight gets more than that.
    """
    first = time.datetime.replace(minute=0, second=0, microsecond=0)
    stamps = [first + timedelta(hours=k) for k in range(hours + 2)]
    latitude, longitude = math.degrees(site.latitude), math.degrees(site.longitude)
    longitude = (longitude + 180) % 360 - 180
    south, west = max(math.floor(latitude * 4) / 4, -90.0), math.floor(longitude * 4) / 4
    north, east = min(south + 0.25, 90.0), west + 0.25
    return {
        "product_type": ["reanalysis"],
        "variable": [VARIABLES[name] for name in ("t", "q", "u", "v", "z", "o3")],
        "year": sorted({f"{s:%Y}" for s in stamps}),
        "month": sorted({f"{s:%m}" for s in stamps}),
        "day": sorted({f"{s:%d}" for s in stamps}),
        "time": sorted({f"{s:%H}:00" for s in stamps}),
        "pressure_level": [str(level) for level in sorted(LEVELS)],
        "area": [north, west, south, east],
        "data_format": "netcdf",
        "download_format": "unarchived",
    }


def retrieve(site: Site, time: Instant, hours: int, path: Path) -> None:
    """Download to ``path``.

    Raises
    ------
    InputError
        Without the package, without a key, or when the store refuses, in its own words.
    """
    try:
        client = import_module("cdsapi").Client
    except ImportError:
        raise InputError(
            "the package cdsapi is not installed", place="zonda weather fetch", cure="pip install 'zonda[weather]'"
        ) from None
    try:
        client(quiet=True).retrieve(DATASET, request(site, time, hours), str(path))
    except Exception as err:  # cdsapi raises bare Exceptions: no key, no licence accepted, no network
        text = str(err).strip().splitlines()[0] if str(err).strip() else type(err).__name__
        raise InputError(f"the Climate Data Store did not deliver: {text}", place="zonda weather fetch", cure=KEY) from None
