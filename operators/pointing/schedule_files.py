"""Observing schedules of TOAST: version 5 (ECSV) and versions 4 to 1 (text)."""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.storage.table_files import Table, read_table, read_text

COLUMNS = (
    "start_time",
    "stop_time",
    "boresight_angle",
    "name",
    "azmin",
    "azmax",
    "el",
    "scan_index",
    "subscan_index",
)
"""In the order of version 4."""
ANGLES = ("boresight_angle", "azmin", "azmax", "el")
OVERLAP = 1.0
"""s: rows may overlap by as much, since schedules round their times to seconds."""
WIDEST_WRAP = np.pi
"""rad: azmax below azmin is read as a sweep through north; a wider one is taken for exchanged
limits.
"""
CURE = (
    f"give a schedule of TOAST, version 5 (ECSV with the columns {', '.join(COLUMNS)}) or version 4"
    " to 1 (text)"
)
TWO_WORDS = (11, 23, 24)
"""Fields of a row whose dates and times are two words: versions 3 and 1."""
CONCISE = {9: range(9), 21: (0, 1, 4, 5, 6, 7, 8, 19, 20), 22: (0, 1, 4, 5, 6, 7, 8, 19, 20)}
"""Where `COLUMNS` stand in a row of so many fields: of versions 4 and 3; of 2 and 1, whose last may
lack.
"""


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


@dataclass(frozen=True)
class SchedulesSite:
    """Site for which a schedule was made: its name, and position [rad]."""

    name: str
    latitude: float
    longitude: float


def read_schedule(path: Path, nods: float = 0.0) -> tuple[list[Row], SchedulesSite | None]:
    """The rows of a schedule, and the site that it was made for: None where it states none, or one
    that is not known (TOAST's default).

    ``nods``: seconds before each scan in which the telescope nods. Raises InputError for a file
    that is none, and for a row that makes no sense.
    """
    text = read_text(path, str(path))
    table = read_table(path, text=text) if text.startswith("# %ECSV") else _of_text(text, str(path))
    return _rows(table, nods), _site(table)


def _site(table: Table) -> SchedulesSite | None:
    """Raises InputError for a latitude or longitude that is none."""
    name, *stated = (table.meta.get(key) for key in ("site_name", "site_lat", "site_lon"))
    if None in stated:
        return None
    try:
        latitude, longitude = (_degrees(value) for value in stated)
    except ValueError:
        text = f"its site's latitude and longitude are {stated[0]!r} and {stated[1]!r}"
        raise InputError(text, place=table.place, cure="write them in degrees") from None
    if name in (None, "Unknown") and latitude == longitude == 0:
        return None
    return SchedulesSite(str(name), math.radians(latitude), math.radians(longitude))


def _degrees(value: Any) -> float:
    """Degrees of a number, or a text such as ``-22.96 deg``. Raises ValueError."""
    from astropy.units import Quantity, UnitsError, deg, dimensionless_unscaled

    try:
        found = Quantity(value)
        degrees = found.value if found.unit == dimensionless_unscaled else found.to_value(deg)
    except (TypeError, UnitsError) as err:
        raise ValueError from err
    if not abs(degrees) <= 360:
        raise ValueError
    return float(degrees)


def _of_text(text: str, place: str) -> Table:
    """The table of a text schedule: a line about the site, then the fields of a row a line, between
    bars or blanks.

    Rows that are SPECIAL (cooler cycles) are no scans; as in TOAST they are left out.
    """
    lines, rows, special = [], [], []
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.startswith("#"):
            fields = [f.strip() for f in line.split("|")] if "|" in line else line.split()
            if fields[0].startswith("SPECIAL"):
                special.append(number)
                continue
            lines.append(number)
            rows.append(fields)
    if special:
        more = f"(line {special[0]}{', ...' * (len(special) > 1)}): they are left out"
        told = f"{place}: {len(special)} rows are SPECIAL, no scans {more}"
        warnings.warn(told, stacklevel=2)
    if len(rows) < 2 or len(rows[0]) != 5:
        cause = "is no schedule: there is no line about the site, or none behind it"
        raise InputError(cause, place=place, cure=CURE)
    (name, _, latitude, longitude, _), *rows = rows
    meta = {"site_name": name, "site_lat": latitude, "site_lon": longitude}
    table = Table(place, {}, [*lines[1:], lines[0]], meta)
    found = []
    for k, row in enumerate(rows):
        if len(row) in TWO_WORDS:
            row = [f"{row[0]} {row[1]}", f"{row[2]} {row[3]}", *row[4:]]
        if len(row) not in CONCISE:
            table.note(k, f"has {len(row)} fields, not {len(COLUMNS)}", CURE)
            continue
        found.append([row[k] for k in CONCISE[len(row)]])
    table.check()
    units = dict.fromkeys(ANGLES, "deg")
    columns = zip(COLUMNS, map(list, zip(*found, strict=True)), strict=True)
    table.columns = {name: (column, units.get(name, "")) for name, column in columns}
    return table


def _rows(table: Table, nods: float) -> list[Row]:
    turn, low, high, elevation = (table.numbers(name, "rad") for name in ANGLES)
    name, scan, subscan = (table.texts(n) for n in ("name", "scan_index", "subscan_index"))
    begin, end = (table.instants(name) for name in ("start_time", "stop_time"))
    table.check()
    found = []
    for k, (first, last) in enumerate(zip(begin, end, strict=True)):
        assert first is not None
        assert last is not None
        row = Row(
            name=name[k],
            number=(scan[k], subscan[k]),
            start=first,
            duration=last.seconds_since(first),
            azimuth=(float(low[k]), float(high[k]) + (2 * np.pi if high[k] < low[k] else 0.0)),
            elevation=float(elevation[k]),
            rotation=float(turn[k]),
        )
        if wrong := _what_is_wrong(row, float(high[k])):
            table.note(k, f"{row.label}: {wrong[0]}", wrong[1])
        found.append(row)
    _note_overlaps(found, nods, table)
    table.check()
    return found


def _what_is_wrong(row: Row, stated: float) -> tuple[str, str] | None:
    """Cause and cure. ``stated``: azmax as it is written [rad]."""
    cure = "mend or remove that row"
    if row.duration <= 0:
        return "stop_time is not later than start_time", cure
    if not 0 < row.elevation <= np.pi / 2:
        return f"el is {np.degrees(row.elevation):g} deg, not between 0 and 90 deg", cure
    low, high = row.azimuth
    text = f"azmin is {np.degrees(low):g} deg and azmax {np.degrees(stated):g} deg"
    if high - low > 2 * np.pi * (1 + 1e-12):
        return "azmin and azmax are more than a turn apart", cure
    if high - low < 1e-12:
        cure = "give limits that differ, or remove that row"
        return f"{text}: there is no sweep between them", cure
    if stated < low and high - low > WIDEST_WRAP * (1 + 1e-12):
        wide = f"azmax: {np.degrees(high):g} deg where the sweep is as wide"
        sweep = f"that is a sweep of {np.degrees(high - low):g} deg through north"
        return f"{text}: {sweep}", f"exchange them, or write {wide}"
    return None


def _note_overlaps(rows: list[Row], nods: float, table: Table) -> None:
    """Note each row that begins, with its ``nods`` [s] before it, before an earlier one stops: the
    telescope is in one place at a time."""
    sound = [k for k, row in enumerate(rows) if row.duration > 0]
    begins = {k: rows[k].start.seconds_since(rows[sound[0]].start) for k in sound}
    before, stops = -1, -math.inf
    for k in sorted(sound, key=begins.__getitem__):
        early, what = stops - begins[k], "begins"
        cure = "shift or shorten one of them, or remove one"
        if early <= OVERLAP + 1e-6 and nods:
            early += nods
            cure = f"leave {nods:.6g} s between the rows for the nods, or change elevation_nods"
            what = f"its elevation nods of {nods:.6g} s begin"
        if early > OVERLAP + 1e-6:
            other = f"{rows[before].label} (line {table.lines[before]})"
            table.note(k, f"{rows[k].label}: {what} {early:.6g} s before {other} stops", cure)
        if begins[k] + rows[k].duration > stops:
            before, stops = k, begins[k] + rows[k].duration
