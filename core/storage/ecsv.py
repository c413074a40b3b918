"""Small tables as text: ECSV (Astropy enhancement proposal 6), a CSV file with units, descriptions
and provenance on top.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from astropy import table as astropy_table
from astropy import units as u
from astropy.table.meta import get_header_from_yaml
from numpy.typing import NDArray

from ..errors import InputError
from .files import atomic_path, reading
from .table_mistakes import Mistakes, TableError

LARGEST = 1 << 28
"""Bytes of a file that is read as a small table."""


@dataclass(frozen=True)
class Column:
    """Name, values (n,) (numbers, or all of them texts), FITS unit (empty: none) and
    description.
    """

    name: str
    values: Any
    unit: str
    description: str


def write_ecsv(path: str | Path, columns: Sequence[Column], meta: Mapping[str, Any]) -> Path:
    """Write a table atomically, numbers with nine digits; its path. Raises `OutputError`.

    ``meta``: texts and numbers.
    """
    made = astropy_table.Table(meta=dict(meta))
    for c in columns:
        if any(isinstance(v, str) for v in c.values):
            values: list[Any] = [" ".join(str(v).split()) for v in c.values]
        else:
            values = [float(f"{float(v):.9g}") for v in c.values]
        made[c.name] = astropy_table.Column(values, unit=c.unit or None, description=c.description)
    with atomic_path(path) as temporary:
        made.write(temporary, format="ascii.ecsv", delimiter=",")
    return Path(path)


@dataclass(frozen=True)
class Table:
    """A small table that was read.

    Attributes
    ----------
    place
        The file, as messages call it.
    columns
        By name: texts and the unit as it is written (empty: none).
    lines
        Line of the file of each row, from 1; of the heading last.
    """

    place: str
    columns: Mapping[str, tuple[list[str], str]]
    lines: Sequence[int]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))[0]) if self.columns else 0

    def texts(self, name: str) -> list[str]:
        """A column as it is written. Raises `TableError` where there is none of this name."""
        if name not in self.columns:
            cure = f"it has: {', '.join(self.columns)}"
            raise TableError(self.place, [(self.lines[-1], f"has no column {name!r}", cure)])
        return self.columns[name][0]

    def numbers(self, name: str, unit: str = "") -> NDArray[np.float64]:
        """A column of finite numbers, in ``unit``; where that is empty, the column has none.

        Raises `TableError` for a column without a unit, of another kind, and for every row that is
        not a finite number.
        """
        texts, mistakes = self.texts(name), Mistakes(self.place)
        factor = 1.0
        with mistakes.noted():
            factor = self._factor(name, self.columns[name][1], unit)
        values = self.values(name)
        for row in np.flatnonzero(~np.isfinite(values)).tolist():
            text = f"{name} is {texts[row]!r}, not a finite number"
            mistakes.add(self.lines[row], text, "mend or remove that row")
        mistakes.tell()
        return values * factor

    def values(self, name: str) -> NDArray[np.float64]:
        """A column as numbers, in the unit in which it is written; NaN where it has another
        text.
        """
        return np.array([_number(text) for text in self.texts(name)])

    def _factor(self, name: str, written: str, unit: str) -> float:
        if not unit and not written:
            return 1.0
        from ..configuration.units import KINDS  # slow to import, and pictures need tables alone

        named = KINDS[unit].display if unit in KINDS else (unit,)
        accepted = f"{', '.join(named[:-1])} or {named[-1]}" if len(named) > 1 else unit
        if not written:
            cure = (
                f"give it in {accepted}: in ECSV 'unit: {named[0]}', in CSV a heading such as"
                f" {name} [{named[0]}]"
            )
            raise TableError(self.place, [(self.lines[-1], f"{name} has no unit", cure)])
        try:
            return float(u.Unit(written).to(u.Unit(unit)))
        except (ValueError, u.UnitConversionError):
            cure = (
                f"give it in {accepted}, or another unit of its kind"
                if unit
                else "leave the unit out"
            )
            raise TableError(
                self.place, [(self.lines[-1], f"{name} has the unit {written!r}", cure)]
            ) from None


def _number(text: str) -> float:
    """NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def read_table(path: Path) -> Table:
    """Read ECSV, or CSV whose first line names the columns, with units in brackets: ``ra [deg], dec
    [deg]``.

    Raises InputError for another kind of file, rows of unequal length, columns of one name, or a
    table without rows.
    """
    place = str(path)
    with reading(
        place,
        "a table",
        "give ECSV, or CSV whose first line names the columns, with their units in brackets",
    ):
        if path.stat().st_size > LARGEST:
            raise InputError(
                f"is larger than {LARGEST >> 20} MB", place=place, cure="give a small table"
            )
        text = path.read_text(encoding="utf-8-sig")
    names, units, rows, lines = _ecsv(text, place) if text.startswith("# %ECSV") else _csv(text)
    mistakes = Mistakes(place)
    for name in sorted({n for n in names if names.count(n) > 1}):
        mistakes.add(lines[-1], f"has two columns {name!r}", "rename one of them")
    for row, line in zip(rows, lines, strict=False):
        if len(row) != len(names):
            cure = f"write {len(names)} values: {', '.join(names)}"
            mistakes.add(line, f"has {len(row)} values, not {len(names)}", cure)
    if not rows:
        mistakes.add(0, "has no rows", "give a table with a row or more")
    mistakes.tell()
    columns = [list(column) for column in zip(*rows, strict=True)]
    return Table(place, {n: (c, u) for n, u, c in zip(names, units, columns, strict=True)}, lines)


Cells = list[list[str]]
Written = tuple[list[str], list[str], Cells, list[int]]
"""Names, units and rows of a table, and `Table.lines`."""


def _csv(text: str) -> Written:
    """CSV. The heading is the first line that is no comment; where that has numbers, a comment
    above with as many fields.
    """
    written = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    numbers, rows = _cells(
        [(number, line) for number, line in written if not line.startswith("#")], ","
    )
    if rows and any(math.isfinite(_number(cell)) for cell in rows[0]):
        above = [
            (number, line.lstrip("# "))
            for number, line in written
            if line.startswith("#") and number < numbers[0]
        ]
        fitting = [
            (number, row)
            for number, row in zip(*_cells(above, ","), strict=True)
            if len(row) == len(rows[0])
        ]
        with_units = [(number, row) for number, row in fitting if any("[" in cell for cell in row)]
        if fitting:
            number, heading = (with_units or fitting)[-1]
            numbers, rows = [number, *numbers], [heading, *rows]
    named = [word.partition("[") for word in (rows[0] if rows else [])]
    names, units = (
        [name.strip() for name, _, _ in named],
        [unit.strip("] ") for _, _, unit in named],
    )
    return (
        names,
        units,
        [[cell.strip() for cell in row] for row in rows[1:]],
        [*numbers[1:], *(numbers[:1] or [1])],
    )


def _cells(lines: Sequence[tuple[int, str]], comma: str) -> tuple[list[int], Cells]:
    """Cells of numbered lines, and the number of the line of each row."""
    reader = csv.reader((line for _, line in lines), delimiter=comma, skipinitialspace=True)
    found = [(lines[reader.line_num - 1][0], row) for row in reader]
    return [number for number, _ in found], [row for _, row in found]


def _ecsv(text: str, place: str) -> Written:
    with reading(place, "ECSV", "write it with astropy: table.write(path, format='ascii.ecsv')"):
        lines = text.splitlines()
        head = get_header_from_yaml(line[2:] for line in lines if line.startswith("# "))
        described = {column["name"]: str(column.get("unit", "")) for column in head["datatype"]}
        body = [
            (number, line)
            for number, line in enumerate(lines, 1)
            if line.strip() and not line.startswith("#")
        ]
        numbers, rows = _cells(body, str(head.get("delimiter", " ")))
        names = rows[0]
        units = [described[name] for name in names]
    return names, units, rows[1:], [*numbers[1:], numbers[0]]
