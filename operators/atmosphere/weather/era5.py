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
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.errors import InputError, placed
from zonda.core.types import Floats
from zonda.core.weather import Column

from .humidity import from_relative, from_specific, ozone_from_mass
from .netcdf import GET, QUANTITIES, opened
from .radiative_transfer import GRAVITY
from .standard_atmosphere import misplaced

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.site import Site


SPACING_MAX = 1.0
"""deg between grid points, beyond which a mountain and its valley are one."""
STEP_MAX = 6.0
"""h between times."""
RATIO_MAX = 1.55
"""Between neighbouring pressure levels up to `HIGHEST` (700 and 500 hPa pass, 1000 and 500 hPa do
not).
"""
HIGHEST = 20000.0
"""Pa that the levels must reach: the vapour lies below."""
HALF_CELL = 0.13
"""deg that the place may lie outside the grid: half a cell of ERA5's own."""

TEMPERATURES, WINDIEST, MOISTEST = (150.0, 340.0), 200.0, 0.1
"""K, m/s and volume mixing ratio of any air below 50 km: what is beyond is in another unit than the
file says, or none.
"""
RELATIVE = 1.0, 300.0
"""%: the moistest level of air is between these, in ice clouds too."""


def read_era5(path: Path, site: Site, time: Instant) -> Column:
    """The column above ``site`` at ``time``.

    Raises
    ------
    InputError
        A file that is not NetCDF, lacks a variable or an axis, is too coarse, or does not cover the
        place or the time.
    """
    place = f"ERA5 file {path}"
    with placed(place), opened(path, place) as file:
        either = (
            [] if "q" in file or "r" in file else ["q"],
            [] if "z" in file or "gh" in file else ["z"],
        )
        lacking = [name for name in ("t", "u", "v") if name not in file] + either[0] + either[1]
        if lacking:
            names = ", ".join(f"{name} ({QUANTITIES[name].what})" for name in lacking)
            raise InputError(f"lacks {names}", cure=f"download these too: {GET}")
        axes = file.axes()
        pressure = axes["level"].values
        _check_levels(pressure)
        latitude, longitude = np.degrees(site.latitude), np.degrees(site.longitude)
        weights = {
            "time": _time_weights(axes["time"].values, time),
            "lat": _latitude_weights(axes["lat"].values, latitude),
            "lon": _longitude_weights(axes["lon"].values, longitude, abs(latitude)),
        }
        order = np.argsort(-pressure)

        def column(name: str, logarithm: bool = False) -> Floats:
            return file.interpolated(name, axes, weights, logarithm)[order]

        pressure, temperature = pressure[order], column("t")
        if "q" in file:
            h2o = from_specific(column("q", logarithm=True))
        else:
            relative = column("r", logarithm=True)
            _check(
                not RELATIVE[0] <= relative.max() <= RELATIVE[1],
                f"its relative humidity is up to {relative.max():.3g} %",
            )
            h2o = from_relative(relative / 100, pressure, temperature)
        o3 = column("o3") if "o3" in file else None
        height = column("z" if "z" in file else "gh") / GRAVITY
        _check_air(pressure, height, temperature, h2o, column)
        return Column(
            pressure=pressure,
            height=height,
            temperature=temperature,
            h2o=h2o,
            wind_east=column("u"),
            wind_north=column("v"),
            ozone_pressure=pressure if "o3" in file else None,
            ozone=ozone_from_mass(np.maximum(o3, 0.0)) if o3 is not None else None,
            stated=f"ERA5 from {path.name}, {time}"
            + (
                f" ({'; '.join(remarks)})"
                if (remarks := [*file.remarks, *_remarks(file.below_none, o3)])
                else ""
            ),
        )


def _remarks(water_below_none: int, o3: Floats | None) -> list[str]:
    """Remarks on slightly negative water and ozone, which ERA5's packing and spectral transform
    leave and which count as none.
    """
    ozone_below_none = 0 if o3 is None else int(np.count_nonzero(o3 < 0))
    found = ["ozone of the standard atmosphere"] if o3 is None else []
    found += (
        [f"{water_below_none} negative values of the humidity taken as none"]
        if water_below_none
        else []
    )
    return found + (
        [f"{ozone_below_none} negative levels of ozone taken as none"] if ozone_below_none else []
    )


def _check_levels(pressure: Floats) -> None:
    falling = np.sort(pressure)[::-1]
    low = falling[falling >= HIGHEST * (1 - 1e-9)]
    gap = float((low[:-1] / low[1:]).max()) if len(low) > 1 else np.inf
    if falling[-1] > HIGHEST or gap > RATIO_MAX:
        levels = (
            f"its {len(falling)} pressure levels ({', '.join(f'{p / 100:g}' for p in falling[:12])}"
            " hPa)"
        )
        fault = (
            f"end at {falling[-1] / 100:g} hPa"
            if falling[-1] > HIGHEST
            else f"lie up to a factor {gap:.2g} apart"
        )
        cure = (
            f"download all levels up to {HIGHEST / 100:g} hPa or higher, none further apart than"
            f" 700 and 500 hPa: {GET}"
        )
        raise InputError(f"is too coarse: {levels} {fault}", cure=cure)


def _check(bad: bool, message: str) -> None:
    if bad:
        raise InputError(
            f"{message}: no air has that", cure="check the variable's units in the file"
        )


def _check_air(
    pressure: Floats,
    height: Floats,
    temperature: Floats,
    h2o: Floats,
    column: Callable[[str], Floats],
) -> None:
    """Refuse what is in another unit than the file says, or than ERA5 has."""
    low, high = TEMPERATURES
    cold, warm = float(temperature.min()), float(temperature.max())
    _check(not low < cold <= warm < high, f"its temperatures are {cold:.4g} to {warm:.4g} K")
    _check(not h2o.max() < MOISTEST, f"its water vapour is up to {h2o.max():.3g} of the air")
    for name in ("u", "v"):
        fastest = float(np.abs(column(name)).max())
        _check(not fastest < WINDIEST, f"its wind {name} is up to {fastest:.4g} m/s")
    if (k := misplaced(pressure, height)) is not None:
        _check(True, f"its level of {pressure[k] / 100:g} hPa lies at {height[k]:.4g} m")


def _time_weights(seconds: Floats, time: Instant) -> dict[int, float]:
    order, wanted = np.argsort(seconds), time.posix
    first, last = seconds[order[0]], seconds[order[-1]]
    if not first - 1800 <= wanted <= last + 1800:
        covered = " to ".join(
            f"{datetime.fromtimestamp(t, UTC):%Y-%m-%dT%H:%MZ}" for t in (first, last)
        )
        raise InputError(
            f"covers {covered}, not {time}", cure=f"change the time, or get the file for it: {GET}"
        )
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
    offset = (
        longitude - wanted + 180
    ) % 360 - 180  # the place is at 0, wherever the file cuts the globe
    order = np.argsort(offset)
    if latitude > 89.9:
        return {int(np.argmin(np.abs(offset))): 1.0}
    return {int(order[k]): w for k, w in _within(offset[order], 0.0, "longitudes", wanted).items()}


def _within(points: Floats, wanted: float, noun: str, origin: float = 0.0) -> dict[int, float]:
    if not points[0] - HALF_CELL <= wanted <= points[-1] + HALF_CELL:
        message = (
            f"covers {noun} {points[0] + origin:.2f} to {points[-1] + origin:.2f} deg, not"
            f" {wanted + origin:.2f} deg"
        )
        raise InputError(message, cure=f"get the file for this place: {GET}")
    weights = _linear(points, wanted)
    spacing = np.ptp(points[list(weights)])
    if spacing > SPACING_MAX * 1.001:
        message = f"is too coarse: its {noun} are {spacing:g} deg apart"
        raise InputError(
            message, cure=f"get it on a grid of {SPACING_MAX:g} deg or finer (ERA5 has 0.25): {GET}"
        )
    return weights


def _linear(points: Floats, wanted: float) -> dict[int, float]:
    """Weights of the points around ``wanted``, by index; the nearest end where it is outside."""
    k = int(np.searchsorted(points, wanted))
    if k == 0 or k == len(points):
        return {min(k, len(points) - 1): 1.0}
    share = float((wanted - points[k - 1]) / (points[k] - points[k - 1]))
    return {k: 1.0} if share == 1 else {k - 1: 1 - share, k: share}


DATASET = "reanalysis-era5-pressure-levels"
_HIGH = (
    1,
    2,
    3,
    5,
    7,
    10,
    20,
    30,
    50,
    70,
    100,
    125,
    150,
    175,
    200,
    225,
    250,
    300,
    350,
    400,
    450,
    500,
    550,
    600,
    650,
    700,
)
LEVELS = (*_HIGH, 750, 775, 800, 825, 850, 875, 900, 925, 950, 975, 1000)
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
    latitude, longitude = math.degrees(site.latitude), math.degrees(site.longitude)
    longitude = (longitude + 180) % 360 - 180
    south, west = max(math.floor(latitude * 4) / 4, -90.0), math.floor(longitude * 4) / 4
    north, east = min(south + 0.25, 90.0), west + 0.25
    return {
        "product_type": ["reanalysis"],
        "variable": [QUANTITIES[name].what for name in ("t", "q", "u", "v", "z", "o3")],
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
            f"the Climate Data Store did not deliver: {text}", place="zonda weather fetch", cure=KEY
        ) from None
