"""Observing schedules of TOAST: version 5 (ECSV) and versions 4 to 1 (text)."""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.storage.ecsv import Table, read_table
from zonda.core.storage.files import reading
from zonda.core.storage.table_mistakes import Mistakes
from zonda.core.types import Floats

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


def read_site(path: Path) -> SchedulesSite | None:
    """The site that the head of a schedule states; None where it states none, or one that is not
    known (TOAST's default).

    Raises InputError for a latitude or longitude that is none.
    """
    lines = path.read_text(encoding="utf-8").splitlines()
    if lines and lines[0].startswith("# %ECSV"):
        about = _head_of_ecsv(lines)
        found = [about.get(key) for key in ("site_name", "site_lat", "site_lon")]
    else:
        first = next(line for line in lines if line.strip() and not line.startswith("#"))
        fields = first.split("|") if "|" in first else first.split()
        found = [fields[0].strip(), fields[2], fields[3]]
    if found[1] is None or found[2] is None:
        return None
    try:
        latitude, longitude = (_degrees(value) for value in found[1:])
    except ValueError:
        text = f"its site's latitude and longitude are {found[1]!r} and {found[2]!r}"
        raise InputError(text, place=str(path), cure="write them in degrees") from None
    if found[0] in (None, "Unknown") and latitude == longitude == 0:
        return None
    return SchedulesSite(str(found[0]), math.radians(latitude), math.radians(longitude))


def _head_of_ecsv(lines: list[str]) -> dict[str, Any]:
    """The table's provenance: a mapping, or a list of them."""
    from astropy.io.misc import yaml

    head = [line[2:] for line in lines if line.startswith("# ")]
    begin = next((k for k, line in enumerate(head) if line.startswith("meta:")), len(head))
    end = next(
        (
            k
            for k, line in enumerate(head[begin + 1 :], begin + 1)
            if not line.startswith((" ", "-"))
        ),
        len(head),
    )
    try:
        about = (yaml.load("\n".join(head[begin:end])) or {}).get("meta")
    except Exception:  # what other programs wrote there with tags of their own
        return {}
    if isinstance(about, list):
        return dict(
            pair for one in about for pair in (one.items() if isinstance(one, Mapping) else [one])
        )
    return dict(about) if isinstance(about, Mapping) else {}


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


def read_schedule(path: Path, nods: float = 0.0) -> list[Row]:
    """The rows of a schedule. Raises InputError for a file that is none, and for a row that makes
    no sense.

    ``nods``: seconds before each scan in which the telescope nods.
    """
    place = str(path)
    with reading(place, "a schedule", CURE), path.open(encoding="utf-8") as file:
        first = file.readline()
    return _rows(read_table(path) if first.startswith("# %ECSV") else _of_text(path, place), nods)


def _of_text(path: Path, place: str) -> Table:
    """The table of a text schedule: a line about the site, then the fields of a row a line, between
    bars or blanks.

    Rows that are SPECIAL (cooler cycles) are no scans; as in TOAST they are left out.
    """
    with reading(place, "a schedule", CURE):
        text = path.read_text(encoding="utf-8").splitlines()
    written = [
        (number, line)
        for number, line in enumerate(text, 1)
        if line.strip() and not line.startswith("#")
    ]
    special = [number for number, line in written if re.match(r"\s*SPECIAL\b", line)]
    written = [(number, line) for number, line in written if number not in special]
    if special:
        text_of = (
            f"{len(special)} rows are SPECIAL, no scans (line"
            f" {special[0]}{', ...' * (len(special) > 1)})"
        )
        warnings.warn(f"{place}: {text_of}: they are left out", stacklevel=2)
    rows = [
        [field.strip() for field in line.split("|")] if "|" in line else line.split()
        for _, line in written
    ]
    if len(rows) < 2 or len(rows[0]) != 5:
        raise InputError(
            "is no schedule: there is no line about the site, or none behind it",
            place=place,
            cure=CURE,
        )
    mistakes, lines = Mistakes(place), [number for number, _ in written]
    found = []
    for line, row in zip(lines[1:], rows[1:], strict=True):
        if len(row) in TWO_WORDS:
            row = [f"{row[0]} {row[1]}", f"{row[2]} {row[3]}", *row[4:]]
        if len(row) not in CONCISE:
            mistakes.add(line, f"has {len(row)} fields, not {len(COLUMNS)}", CURE)
            continue
        found.append([row[k] for k in CONCISE[len(row)]])
    mistakes.tell()
    columns = [list(column) for column in zip(*found, strict=True)]
    units = dict.fromkeys(("boresight_angle", "azmin", "azmax", "el"), "deg")
    named = {
        name: (column, units.get(name, "")) for name, column in zip(COLUMNS, columns, strict=True)
    }
    return Table(place, named, [*lines[1:], lines[0]])


def _rows(table: Table, nods: float) -> list[Row]:
    mistakes, angles = Mistakes(table.place), dict[str, Floats]()
    texts, times = dict[str, list[str]](), dict[str, list[Instant]]()
    for name in ("boresight_angle", "azmin", "azmax", "el"):
        with mistakes.noted():
            angles[name] = table.numbers(name, "rad")
    for name in ("name", "scan_index", "subscan_index"):
        with mistakes.noted():
            texts[name] = table.texts(name)
    for name in ("start_time", "stop_time"):
        with mistakes.noted():
            times[name] = _times(table, name)
    mistakes.tell()
    begin, end = times["start_time"], times["stop_time"]
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
        wrong = _what_is_wrong(row) or _wrong_limits(row, float(angles["azmax"][k]))
        if wrong:
            message, cure = wrong
            mistakes.add(table.lines[k], f"{row.label}: {message}", cure)
        found.append(row)
    _note_overlaps(found, nods, table.lines, mistakes)
    mistakes.tell()
    return found


def _what_is_wrong(row: Row) -> tuple[str, str] | None:
    """Cause and cure."""
    cure = "mend or remove that row"
    if row.duration <= 0:
        return "stop_time is not later than start_time", cure
    if not 0 < row.elevation <= np.pi / 2:
        return f"el is {np.degrees(row.elevation):g} deg, not between 0 and 90 deg", cure
    if row.azimuth[1] - row.azimuth[0] > 2 * np.pi * (1 + 1e-12):
        return "azmin and azmax are more than a turn apart", cure
    return None


def _wrong_limits(row: Row, stated: float) -> tuple[str, str] | None:
    """Cause and cure of limits that are no sweep. ``stated``: azmax as it is written [rad]."""
    low, high = row.azimuth
    text = f"azmin is {np.degrees(low):g} deg and azmax {np.degrees(stated):g} deg"
    if high - low < 1e-12:
        return (
            f"{text}: there is no sweep between them",
            "give limits that differ, or remove that row",
        )
    if stated < low and high - low > WIDEST_WRAP * (1 + 1e-12):
        wide = f"azmax: {np.degrees(high):g} deg where the sweep is as wide"
        return (
            f"{text}: that is a sweep of {np.degrees(high - low):g} deg through north",
            f"exchange them, or write {wide}",
        )
    return None


def _note_overlaps(rows: list[Row], nods: float, lines: Sequence[int], mistakes: Mistakes) -> None:
    """Note each row that begins, with its ``nods`` [s] before it, before an earlier one stops: the
    telescope is in one place at a time."""
    sound = [k for k, row in enumerate(rows) if row.duration > 0]
    begins = {k: rows[k].start.seconds_since(rows[sound[0]].start) for k in sound}
    before, stops = -1, -math.inf
    for k in sorted(sound, key=begins.__getitem__):
        early, what, cure = (
            stops - begins[k],
            "begins",
            "shift or shorten one of them, or remove one",
        )
        if early <= OVERLAP + 1e-6 and nods:
            early, cure = (
                early + nods,
                f"leave {nods:.6g} s between the rows for the nods, or change elevation_nods",
            )
            what = f"its elevation nods of {nods:.6g} s begin"
        if early > OVERLAP + 1e-6:
            other = f"{rows[before].label} (line {lines[before]})"
            mistakes.add(
                lines[k], f"{rows[k].label}: {what} {early:.6g} s before {other} stops", cure
            )
        if begins[k] + rows[k].duration > stops:
            before, stops = k, begins[k] + rows[k].duration


def _times(table: Table, name: str) -> list[Instant]:
    found, mistakes = [], Mistakes(table.place)
    for text, line in zip(table.texts(name), table.lines, strict=False):
        try:
            found.append(Instant.parse(re.sub(r"\s*\+00:00$", "Z", text)))
        except ValueError as err:
            mistakes.add(line, f"{name}: {err}", "write it as 2025-03-01T06:00:00+00:00")
    mistakes.tell()
    return found
