"""Observing schedules of TOAST: version 5 (ECSV) and version 4 (text)."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.storage.ecsv import Table, read_table
from zonda.core.storage.files import reading

COLUMNS = ("start_time", "stop_time", "boresight_angle", "name", "azmin", "azmax", "el", "scan_index", "subscan_index")
"""In the order of version 4."""
CURE = f"give a schedule of TOAST, version 5 (ECSV with the columns {', '.join(COLUMNS)}) or version 4 (text)"


@dataclass(frozen=True)
class Row:
    """One constant-elevation scan.

    Attributes
    ----------
    name, number
        The patch; `scan_index` and `subscan_index`.
    start, duration
        Duration in s.
    azimuth
        (least, largest) of the mount, rad; the largest above the least.
    elevation, rotation
        rad; the turn of the focal plane about the boresight.
    """

    name: str
    number: tuple[str, str]
    start: Instant
    duration: float
    azimuth: tuple[float, float]
    elevation: float
    rotation: float

    @property
    def label(self) -> str:
        """TOAST's name of the observation."""
        return "-".join([self.name, *self.number])


def read_schedule(path: Path) -> list[Row]:
    """The rows of a schedule. Raises InputError for a file that is none, and for a row that makes no sense."""
    place = str(path)
    with reading(place, "a schedule", CURE), path.open(encoding="utf-8") as file:
        first = file.readline()
    return _rows(read_table(path) if first.startswith("# %ECSV") else _version_4(path, place))


def _version_4(path: Path, place: str) -> Table:
    """The table of a text schedule: a line about the site, then nine fields a line, between bars."""
    with reading(place, "a schedule", CURE):
        lines = [line for line in path.read_text(encoding="utf-8").splitlines() if line.strip() and not line.startswith("#")]
    rows = [[field.strip() for field in line.split("|")] if "|" in line else line.split() for line in lines]
    if len(rows) < 2 or len(rows[0]) != 5:
        raise InputError("is no schedule: there is no line about the site, or none behind it", place=place, cure=CURE)
    for number, row in enumerate(rows[1:]):
        if len(row) != len(COLUMNS):
            raise InputError(f"row {number + 1} has {len(row)} fields, not {len(COLUMNS)}", place=place, cure=CURE)
    columns = [list(column) for column in zip(*rows[1:], strict=True)]
    units = dict.fromkeys(("boresight_angle", "azmin", "azmax", "el"), "deg")
    return Table(place, {name: (column, units.get(name, "")) for name, column in zip(COLUMNS, columns, strict=True)})


def _rows(table: Table) -> list[Row]:
    angles = {name: table.numbers(name, "rad") for name in ("boresight_angle", "azmin", "azmax", "el")}
    texts = {name: table.texts(name) for name in ("name", "scan_index", "subscan_index")}
    begin, end = (_times(table, name) for name in ("start_time", "stop_time"))
    found = []
    for k in range(len(table)):
        low, high = float(angles["azmin"][k]), float(angles["azmax"][k])
        if high < low:
            high += 2 * np.pi
        row = Row(
            name=texts["name"][k],
            number=(texts["scan_index"][k], texts["subscan_index"][k]),
            start=begin[k],
            duration=end[k].seconds_since(begin[k]),
            azimuth=(low, high),
            elevation=float(angles["el"][k]),
            rotation=float(angles["boresight_angle"][k]),
        )
        wrong = _what_is_wrong(row)
        if wrong:
            raise InputError(f"row {k + 1} ({row.label}): {wrong}", place=table.place, cure="mend or remove that row")
        found.append(row)
    return found


def _what_is_wrong(row: Row) -> str:
    if row.duration <= 0:
        return "stop_time is not later than start_time"
    if not 0 < row.elevation <= np.pi / 2:
        return f"el is {np.degrees(row.elevation):g} deg, not between 0 and 90 deg"
    if row.azimuth[1] - row.azimuth[0] > 2 * np.pi:
        return "azmin and azmax are more than a turn apart"
    return ""


def _times(table: Table, name: str) -> list[Instant]:
    found = []
    for number, text in enumerate(table.texts(name)):
        try:
            found.append(Instant.parse(re.sub(r"\s*\+00:00$", "Z", text)))
        except ValueError as err:
            cure = "write it as 2025-03-01T06:00:00+00:00"
            raise InputError(f"{name} of row {number + 1}: {err}", place=table.place, cure=cure) from None
    return found
