"""A profile from a text table that the user wrote."""

from __future__ import annotations

import csv
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError, placed
from zonda.core.types import Floats
from zonda.core.weather import Column

from .humidity import from_density, from_relative, from_specific
from .standard_atmosphere import misplaced, wind_speed

if TYPE_CHECKING:
    from zonda.core.site import Site


HIGHEST = 8e3
"""m above sea level that a table must reach: nearly all water lies below."""
TEMPERATURES = (150.0, 340.0)
"""K of any air below 50 km."""

UNITS = {
    "height": {"m": 1.0, "km": 1e3},
    "pressure": {"Pa": 1.0, "hPa": 100.0, "mbar": 100.0, "kPa": 1e3},
    "temperature": {"K": 1.0, "degC": 1.0},
    "relative humidity": {"%": 0.01, "1": 1.0},
    "vapour density": {"kg/m3": 1.0, "g/m3": 1e-3},
    "specific humidity": {"kg/kg": 1.0, "g/kg": 1e-3},
    "mixing ratio": {"1": 1.0, "ppm": 1e-6},
    "wind east": {"m/s": 1.0, "km/h": 1 / 3.6},
    "wind north": {"m/s": 1.0, "km/h": 1 / 3.6},
    "ozone": {"1": 1.0, "ppm": 1e-6},
}
"""Columns and the units each may have. Humidity is one of relative (mixed phase), density,
specific, or mixing ratio (volume).
"""
HUMIDITY = ("relative humidity", "vapour density", "specific humidity", "mixing ratio")
DRY_AIR = 0.011
"""Relative humidity that some level of any air has: less is a share that was called a percentage.
"""
PRESSURE_MIN = 1e-3
"""Pa: that of 95 km. Below, the share of water that a humidity gives is not a number one can work
with.
"""

EXAMPLE = (
    "height [m], pressure [hPa], temperature [K], relative humidity [%], wind east [m/s], wind"
    " north [m/s]"
)


def read_table(path: Path, site: Site) -> Column:
    """The column of a CSV table: a header of ``name [unit]``, then rows of increasing height; ``#``
    begins a comment.

    Heights are above sea level. Without winds there is a west wind of
    `standard_atmosphere.wind_speed`.

    Raises
    ------
    InputError
        With the line: an unknown, missing or doubled column, text that is no number, NaN, heights
        that do not increase, pressures that do not fall, what no air is, a table that ends below 8
        km.
    """
    with placed(f"table {path}"):
        lines = _lines(path)
        values = _numbers(lines, _header(lines[0][1]))
        height, pressure, temperature = (
            values[name] for name in ("height", "pressure", "temperature")
        )
        _limits(values, [number for number, _ in lines[1:]])
        if len(height) < 5 or height[-1] < HIGHEST:
            cause = f"has {len(height)} heights up to {height[-1]:g} m above sea level"
            raise InputError(
                cause,
                cure=(
                    f"give at least 5, up to {HIGHEST:g} m: vapour and most of the oxygen lie below"
                ),
            )
    humidity: dict[str, Callable[[Floats], Floats]] = {
        "relative humidity": lambda x: from_relative(x, pressure, temperature),
        "vapour density": lambda x: from_density(x, pressure, temperature),
        "specific humidity": from_specific,
        "mixing ratio": lambda x: x,
    }
    h2o = next(function(values[name]) for name, function in humidity.items() if name in values)
    calm = "wind east" not in values
    return Column(
        pressure=pressure,
        height=height,
        temperature=temperature,
        h2o=h2o,
        wind_east=(
            wind_speed(np.maximum(height - site.altitude, 0.0)) if calm else values["wind east"]
        ),
        wind_north=np.zeros_like(height) if calm else values["wind north"],
        ozone_pressure=pressure if "ozone" in values else None,
        ozone=values.get("ozone"),
        stated=f"table {path.name}"
        + (" (without winds: a west wind of 8 to 38 m/s)" if calm else ""),
    )


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """(line number, cells) of the header and every row."""
    try:
        text = path.read_text(encoding="utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as err:
        raise InputError(
            f"cannot be read as text: {err}", cure=f"write a CSV file: {EXAMPLE}"
        ) from None
    found = [(n, line.partition("#")[0].strip()) for n, line in enumerate(text, 1)]
    lines = [(n, [cell.strip() for cell in next(csv.reader([line]))]) for n, line in found if line]
    if len(lines) < 2:
        raise InputError("holds no rows", cure=f"write a header and one row per height: {EXAMPLE}")
    return lines


def _header(cells: list[str]) -> list[tuple[str, str]]:
    """(name, unit) of each column."""
    columns: list[tuple[str, str]] = []
    for cell in cells:
        match = re.fullmatch(r"([A-Za-z_ ]+?)\s*\[\s*(.*?)\s*\]", cell)
        name = " ".join(match[1].lower().replace("_", " ").split()) if match else ""
        if not match or name not in UNITS or match[2] not in UNITS[name]:
            units = (
                f"'{name}' comes in {', '.join(UNITS[name])}"
                if name in UNITS
                else f"columns: {', '.join(UNITS)}"
            )
            raise InputError(
                f"the column '{cell}' is not known", cure=f"{units}; a header is e.g. {EXAMPLE}"
            )
        if name in (known for known, _ in columns):
            raise InputError(f"the column '{name}' is there twice", cure="keep one")
        columns.append((name, match[2]))
    names = [name for name, _ in columns]
    missing = [name for name in ("height", "pressure", "temperature") if name not in names]
    if missing or not any(name in names for name in HUMIDITY):
        lacks = ", ".join(
            [
                *missing,
                *(
                    []
                    if any(n in names for n in HUMIDITY)
                    else [f"a humidity ({', '.join(HUMIDITY)})"]
                ),
            ]
        )
        raise InputError(f"lacks {lacks}", cure=f"a header is e.g. {EXAMPLE}")
    if sum(name in names for name in HUMIDITY) > 1 or ("wind east" in names) != (
        "wind north" in names
    ):
        raise InputError(
            "has two humidities, or one component of the wind only",
            cure="one humidity, both or no winds",
        )
    return columns


def _numbers(
    lines: list[tuple[int, list[str]]], columns: list[tuple[str, str]]
) -> dict[str, Floats]:
    """SI values of each column."""
    table = np.empty((len(lines) - 1, len(columns)))
    for row, (number, cells) in enumerate(lines[1:]):
        if len(cells) != len(columns):
            raise InputError(
                f"line {number} has {len(cells)} cells for {len(columns)} columns",
                cure="mend that line",
            )
        for k, cell in enumerate(cells):
            try:
                table[row, k] = float(cell)
            except ValueError:
                raise InputError(
                    f"line {number}: '{cell}' is not a number", cure=f"mend {columns[k][0]} there"
                ) from None
            if not np.isfinite(table[row, k]):
                message = f"line {number}: {columns[k][0]} is {cell}"
                raise InputError(message, cure="give every value, or leave the row out")
    values = {name: table[:, k] * UNITS[name][unit] for k, (name, unit) in enumerate(columns)}
    if ("temperature", "degC") in columns:
        values["temperature"] = values["temperature"] + 273.15
    return values


def _limits(values: dict[str, Floats], rows: list[int]) -> None:
    def refuse(bad: NDArray[np.bool_], message: str, cure: str) -> None:
        if bad.any():
            raise InputError(f"line {rows[int(np.argmax(bad))]}: {message}", cure=cure)

    height, pressure, temperature = (values[name] for name in ("height", "pressure", "temperature"))
    refuse(
        np.append(False, np.diff(height) <= 0),
        "the height does not increase",
        "sort the rows from the ground up",
    )
    refuse(
        pressure < PRESSURE_MIN,
        f"the pressure is below {PRESSURE_MIN:g} Pa",
        "check its unit, or leave the row out: no air",
    )
    falls = "the pressure does not fall with height"
    refuse(np.append(False, np.diff(pressure) >= 0), falls, "check pressures and their unit")
    if (k := misplaced(pressure, height)) is not None:
        message = f"a pressure of {pressure[k] / 100:.4g} hPa at {height[k]:g} m: no air has that"
        raise InputError(
            f"line {rows[k]}: {message}", cure="check the units of height and pressure"
        )
    low, high = TEMPERATURES
    refuse(
        ~((temperature > low) & (temperature < high)),
        f"the temperature is not between {low:g} and {high:g} K",
        "check its unit",
    )
    for name in (*HUMIDITY, "ozone"):
        if name in values:
            refuse(values[name] < 0, f"the {name} is negative", "a humidity is at least 0")
    if "relative humidity" in values:
        refuse(
            values["relative humidity"] > 1.2,
            "the relative humidity is above 120 %",
            "check its unit: [%] or [1]",
        )
        if 0 < values["relative humidity"].max() <= DRY_AIR:
            message = (
                f"the relative humidity is {values['relative humidity'].max():.2g} at most, which"
                " no air has"
            )
            raise InputError(message, cure="check its unit: [%] or [1]")
    for name in ("specific humidity", "mixing ratio"):
        if name in values:
            refuse(values[name] > 0.1, f"the {name} is above 0.1", "check its unit")
    for name in ("wind east", "wind north"):
        if name in values:
            refuse(np.abs(values[name]) > 200, "the wind is above 200 m/s", "check its unit")
