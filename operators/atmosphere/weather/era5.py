"""The atmosphere above a place from a file of ERA5 on pressure levels, as the Copernicus Climate
Data Store delivers it.

NetCDF-4 with ``valid_time`` and ``pressure_level`` (from 2024), NetCDF-3 with packed values,
``time`` and ``level`` (before), and what others make of them (`netcdf`). Only what surrounds the
place and the time is read from the disk. Interpolation is bilinear in longitude and latitude and
linear in time, of the temperature, the winds, the geopotential and ln(humidity). Heights are
geopotential heights z / g. `retrieve` downloads such a file through the store's own client
``cdsapi``.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from importlib import import_module
from pathlib import Path
from typing import Any, Literal

import numpy as np

from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError, placed
from zonda.core.site import Site
from zonda.core.types import Floats
from zonda.core.weather import Column, WeatherSource

from .air import from_relative, from_specific, impossible, ozone_from_mass
from .netcdf import GET, QUANTITIES, NetCdf, opened
from .radiative_transfer import GRAVITY

SPACING_MAX = 1.0
"""deg between grid points, beyond which a mountain and its valley are one."""
STEP_MAX = 6 * 3600.0
"""s between times."""
RATIO_MAX = 1.55
"""Between neighbouring pressure levels up to `HIGHEST` (700 and 500 hPa pass, 1000 and 500 hPa do
not).
"""
HIGHEST = 20000.0
"""Pa that the levels must reach: the vapour lies below."""
HALF_CELL = 0.13
"""deg that the place may lie outside the grid: half a cell of ERA5's own."""

RELATIVE = 0.01, 3.0
"""The moistest level of air is between these, in ice clouds too."""
UNITS = "check the variable's units in the file"


class Era5(WeatherSource):
    """ERA5 on pressure levels from the user's NetCDF file, interpolated in space and time."""

    source: Literal["era5"] = "era5"
    """Registered name."""
    file: InputPath
    """NetCDF file of `reanalysis-era5-pressure-levels`: t, q (or r), u, v, z, and o3 where it has
    it.
    """

    def column(self, site: Site, time: Instant) -> Column:
        """The column above ``site`` at ``time``.

        Raises
        ------
        InputError
            A file that is not NetCDF, lacks a variable or an axis, is too coarse, or does not cover
            the place or the time.
        """
        place = f"ERA5 file {self.file}"
        with placed(place), opened(self.file, place) as file:
            found = self._read(file, site, time)
            for wrong, text in impossible(found):
                if wrong.any():
                    level = found.pressure[int(np.argmax(wrong))] / 100
                    raise InputError(
                        f"its level of {level:g} hPa: {text}: no air has that",
                        cure=UNITS,
                    )
        return found

    def _read(self, file: NetCdf, site: Site, time: Instant) -> Column:
        water = "r" if "r" in file and "q" not in file else "q"
        geopotential = "gh" if "gh" in file and "z" not in file else "z"
        if lacking := [n for n in ("t", "u", "v", water, geopotential) if n not in file]:
            names = ", ".join(f"{name} ({QUANTITIES[name].what})" for name in lacking)
            raise InputError(f"lacks {names}", cure=f"download these too: {GET}")
        axes = file.axes()
        pressure = axes["level"].values
        _check_levels(pressure)
        latitude = np.degrees(site.latitude)
        longitude = np.degrees(site.longitude)
        away = (
            axes["lon"].values - longitude + 180
        ) % 360 - 180  # wherever the file cuts the globe
        weights = {
            "time": _weights("times", axes["time"].values, time.posix, 1800, STEP_MAX, _date),
            "lat": _weights("latitudes", axes["lat"].values, latitude),
            "lon": {int(np.argmin(np.abs(away))): 1.0},
        }
        if abs(latitude) <= 89.9:
            weights["lon"] = _weights(
                "longitudes",
                away,
                0.0,
                say=lambda x: f"{x + longitude:.2f} deg",
            )
        order = np.argsort(-pressure)

        def column(name: str, logarithm: bool = False) -> Floats:
            return file.interpolated(name, axes, weights, logarithm)[order]

        pressure = pressure[order]
        temperature = column("t")
        h2o = column(water, logarithm=True)
        if water == "q":
            h2o = from_specific(h2o)
        elif RELATIVE[0] <= h2o.max() <= RELATIVE[1]:
            h2o = from_relative(h2o, pressure, temperature)
        else:
            raise InputError(
                f"its relative humidity is up to {h2o.max():.3g}: no air has that",
                cure=UNITS,
            )
        o3 = column("o3") if "o3" in file else None
        # ERA5's packing and spectral transform leave slightly negative water and ozone.
        remarks = [*file.remarks, *(["ozone of the standard atmosphere"] if o3 is None else [])]
        if file.below_none:
            remarks.append(f"{file.below_none} negative values of the humidity taken as none")
        if o3 is not None and (o3 < 0).any():
            remarks.append(f"{(o3 < 0).sum()} negative levels of ozone taken as none")
        return Column(
            pressure=pressure,
            height=column(geopotential) / GRAVITY,
            temperature=temperature,
            h2o=h2o,
            wind_east=column("u"),
            wind_north=column("v"),
            ozone_pressure=None if o3 is None else pressure,
            ozone=None if o3 is None else ozone_from_mass(np.maximum(o3, 0.0)),
            stated=f"ERA5 from {self.file.name}, {time}"
            + (f" ({'; '.join(remarks)})" if remarks else ""),
        )


def _check_levels(pressure: Floats) -> None:
    falling = np.sort(pressure)[::-1]
    low = falling[falling >= HIGHEST * (1 - 1e-9)]
    gap = float((low[:-1] / low[1:]).max()) if len(low) > 1 else np.inf
    fault = f"lie up to a factor {gap:.2g} apart" if gap > RATIO_MAX else ""
    if falling[-1] > HIGHEST:
        fault = f"end at {falling[-1] / 100:g} hPa"
    if fault:
        listed = ", ".join(f"{p / 100:g}" for p in falling[:12])
        raise InputError(
            f"is too coarse: its {len(falling)} pressure levels ({listed} hPa) {fault}",
            cure=(
                f"download all levels up to {HIGHEST / 100:g} hPa or higher, none further apart"
                f" than 700 and 500 hPa: {GET}"
            ),
        )


def _date(seconds: float) -> str:
    return f"{datetime.fromtimestamp(seconds, UTC):%Y-%m-%dT%H:%MZ}"


def _weights(
    noun: str,
    points: Floats,
    wanted: float,
    reach: float = HALF_CELL,
    apart: float = SPACING_MAX,
    say: Callable[[float], str] = lambda x: f"{x:.2f} deg",
) -> dict[int, float]:
    """Weights of the points around ``wanted``, by index; the nearest end where it is outside by
    ``reach`` or less. ``apart``: how far apart they may be.
    """
    order = np.argsort(points)
    points = points[order]
    if not points[0] - reach <= wanted <= points[-1] + reach:
        raise InputError(
            f"covers {noun} {say(points[0])} to {say(points[-1])}, not {say(wanted)}",
            cure=f"get the file for this place and time: {GET}",
        )
    k = int(np.searchsorted(points, wanted))
    if k == 0 or k == len(points):
        return {int(order[min(k, len(points) - 1)]): 1.0}
    share = float((wanted - points[k - 1]) / (points[k] - points[k - 1]))
    if share == 1:
        return {int(order[k]): 1.0}
    if points[k] - points[k - 1] > apart * 1.001:
        unit, gap = ("h", 3600) if noun == "times" else ("deg", 1)
        raise InputError(
            f"is too coarse: its {noun} are {(points[k] - points[k - 1]) / gap:g} {unit} apart",
            cure=f"get it every {apart / gap:g} {unit} or finer (ERA5 has 1 h, 0.25 deg): {GET}",
        )
    return {int(order[k - 1]): 1 - share, int(order[k]): share}


DATASET = "reanalysis-era5-pressure-levels"
LEVELS = (
    *(1, 2, 3, 5, 7, 10, 20, 30, 50, 70),
    *range(100, 251, 25),
    *range(300, 701, 50),
    *range(750, 1001, 25),
)
"""hPa: all of them."""
KEY = "https://cds.climate.copernicus.eu/how-to-api says how to get a free key and where to put it"


def request(site: Site, time: Instant, hours: int) -> dict[str, Any]:
    """Request for the cells around the site, and every hour from that before ``time`` to ``hours``
    later.

    The store takes whole days times hours of the day, so a period over midnight gets more than
    that.
    """
    first = time.datetime.replace(minute=0, second=0, microsecond=0)
    stamps = [first + timedelta(hours=k) for k in range(hours + 2)]
    latitude = math.degrees(site.latitude)
    longitude = math.degrees(site.longitude)
    south = max(math.floor(latitude * 4) / 4, -90.0)
    west = math.floor(((longitude + 180) % 360 - 180) * 4) / 4
    stamp = {"year": "%Y", "month": "%m", "day": "%d", "time": "%H:00"}
    return {
        "product_type": ["reanalysis"],
        "variable": [QUANTITIES[name].what for name in ("t", "q", "u", "v", "z", "o3")],
        **{key: sorted({s.strftime(text) for s in stamps}) for key, text in stamp.items()},
        "pressure_level": [str(level) for level in sorted(LEVELS)],
        "area": [min(south + 0.25, 90.0), west, south, west + 0.25],
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
            "the package cdsapi is not installed",
            place="zonda weather fetch",
            cure="pip install 'zonda[weather]'",
        ) from None
    try:
        client(quiet=True).retrieve(DATASET, request(site, time, hours), str(path))
    except (
        Exception
    ) as err:  # cdsapi raises bare Exceptions: no key, no licence accepted, no network
        text = str(err).strip().splitlines()[0] if str(err).strip() else type(err).__name__
        raise InputError(
            f"the Climate Data Store did not deliver: {text}",
            place="zonda weather fetch",
            cure=KEY,
        ) from None
