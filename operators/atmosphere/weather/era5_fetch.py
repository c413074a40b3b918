"""ERA5 on pressure levels from the Copernicus Climate Data Store, through its own client ``cdsapi``."""

from __future__ import annotations

import math
from datetime import timedelta
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zonda.core.errors import InputError

from .era5 import VARIABLES

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.site import Site

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
