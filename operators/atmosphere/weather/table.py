"""A profile from a text table that the user wrote."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING, Literal

import numpy as np

from zonda.core.configuration.input_paths import InputPath
from zonda.core.storage import table_files
from zonda.core.types import Floats
from zonda.core.weather import Column, WeatherSource

from .air import from_density, from_relative, from_specific, impossible, wind_speed

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.site import Site

HIGHEST = 8e3
"""m above sea level that a table must reach: nearly all water lies below."""
REQUIRED = {"height": "m", "pressure": "Pa", "temperature": "K"}
HUMIDITIES = {
    "relative humidity": "",
    "vapour density": "kg / m3",
    "specific humidity": "",
    "mixing ratio": "",
}
"""One of these: relative (mixed phase), density, specific, or mixing ratio (volume)."""
UNITS = REQUIRED | HUMIDITIES | {"wind east": "m / s", "wind north": "m / s", "ozone": ""}
"""Columns, and the units that they are converted to."""
CELSIUS = ("degC", "deg_C", "Celsius")
DRY_AIR = 0.011
"""Relative humidity that some level of any air has: less is a share that was called a percentage.
"""
PRESSURE_MIN = 1e-3
"""Pa: that of 95 km. Below, the share of water that a humidity gives is not a number one can work
with.
"""
CURE, SORT = "check the unit of the column", "sort the rows from the ground up"


class Table(WeatherSource):
    """The user's own profile in a text table, one row per height; the same at any time."""

    source: Literal["table"] = "table"
    """Registered name."""
    table: InputPath
    """CSV with a header, e.g. `height [m], pressure [hPa], temperature [K], relative humidity [%]`;
    see docs/weather.md.
    """

    def column(self, site: Site, time: Instant) -> Column:
        """The column of a CSV table; ``#`` begins a comment.

        Heights are above sea level. Without winds there is a west wind of `air.wind_speed`.

        Raises
        ------
        InputError
            With the lines of all mistakes: an unknown, missing or doubled column, text that is no
            number, NaN, heights that do not increase, pressures that do not fall, what no air is, a
            table that ends below 8 km.
        """
        place = f"table {self.table}"
        text = table_files.read_text(self.table, place)
        if not text.startswith("# %ECSV"):
            text = re.sub(r"[ \t]*#.*", "", text)
        table = table_files.read_table(self.table, place, text)
        table.columns = {
            " ".join(name.lower().replace("_", " ").split()): column
            for name, column in table.columns.items()
        }
        for name in table.columns.keys() - UNITS.keys():
            table.note(-1, f"the column {name!r} is not known", f"columns: {', '.join(UNITS)}")
        kinds = [name for name in HUMIDITIES if name in table.columns]
        if len(kinds) != 1:
            table.note(-1, f"has {len(kinds)} humidities", f"give one: {', '.join(HUMIDITIES)}")
        winds = {"wind east", "wind north"} & table.columns.keys()
        if len(winds) == 1:
            table.note(-1, "has one component of the wind only", "give both or none")
        offset = 0.0
        if table.columns.get("temperature", ("", ""))[1] in CELSIUS:
            offset = 273.15
            table.columns["temperature"] = (table.columns["temperature"][0], "K")
        read = {
            name: table.numbers(name, unit)
            for name, unit in UNITS.items()
            if name in REQUIRED or name in table.columns
        }
        height, pressure = read["height"], read["pressure"]
        low = f"the pressure is below {PRESSURE_MIN:g} Pa"
        table.note_rows(np.diff(height, prepend=-np.inf) <= 0, "the height does not increase", SORT)
        table.note_rows(pressure < PRESSURE_MIN, low, "leave the row out: no air")
        falls = "the pressure does not fall with height"
        table.note_rows(np.diff(pressure, prepend=np.inf) >= 0, falls, CURE)
        table.check()
        temperature = read["temperature"] + offset
        humidity, kind = read[kinds[0]], kinds[0]
        calm = not winds
        wind = wind_speed(np.maximum(height - site.altitude, 0.0)), np.zeros_like(height)
        h2o = humidity
        if kind == "relative humidity":
            h2o = from_relative(humidity, pressure, temperature)
        elif kind == "vapour density":
            h2o = from_density(humidity, pressure, temperature)
        elif kind == "specific humidity":
            h2o = from_specific(humidity)
        found = Column(
            pressure=pressure,
            height=height,
            temperature=temperature,
            h2o=h2o,
            wind_east=wind[0] if calm else read["wind east"],
            wind_north=wind[1] if calm else read["wind north"],
            ozone_pressure=pressure if "ozone" in read else None,
            ozone=read.get("ozone"),
            stated=f"table {self.table.name}"
            + (" (without winds: a west wind of 8 to 38 m/s)" if calm else ""),
        )
        self._check(table, found, kind, humidity)
        return found

    @staticmethod
    def _check(table: table_files.Table, column: Column, kind: str, humidity: Floats) -> None:
        """Note levels that no air has."""
        height, faults = column.height, list(impossible(column))
        if kind == "relative humidity":
            faults.append((humidity > 1.2, f"the {kind} is above 120 %"))
            if 0 < humidity.max() <= DRY_AIR:
                text = f"the {kind} is {humidity.max():.2g} at most, which no air has"
                table.note(-1, text, CURE)
        if column.ozone is not None:
            faults.append((column.ozone < 0, "the ozone is negative"))
        for wrong, text in faults:
            table.note_rows(wrong, f"{text}: no air has that", CURE)
        if len(height) < 5 or height[-1] < HIGHEST:
            text = f"has {len(height)} heights up to {height[-1]:g} m above sea level"
            cure = f"give at least 5, up to {HIGHEST:g} m: vapour and most of the oxygen lie below"
            table.note(None, text, cure)
        table.check()
