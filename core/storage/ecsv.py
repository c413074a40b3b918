"""Small tables as text: ECSV (Astropy enhancement proposal 6), a CSV file with units, descriptions
and provenance on top.
"""

from __future__ import annotations

import csv
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import InputError
from .files import reading, write_text
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
    """Write a table atomically; its path. ``meta``: texts and numbers. Raises `OutputError`."""
    head = ["%ECSV 1.0", "---", "delimiter: ','", "datatype:"]
    for c in columns:
        unit = f"unit: {c.unit}, " if c.unit else ""
        kind = "string" if any(isinstance(v, str) for v in c.values) else "float64"
        head.append(
            f"- {{name: {c.name}, {unit}datatype: {kind}, description:"
            f" {json.dumps(c.description)}}}"
        )
    head.append("meta: !!omap")
    head += [f"- {{{json.dumps(key)}: {json.dumps(value)}}}" for key, value in meta.items()]
    head.append("schema: astropy-2.0")
    rows = zip(*(c.values for c in columns), strict=True)
    body = [",".join(c.name for c in columns)]
    body += [",".join(map(_cell, row)) for row in rows]
    return write_text(path, "\n".join([*(f"# {line}" for line in head), *body]) + "\n")


def _cell(value: Any) -> str:
    """Text in quotation marks, a number with nine digits."""
    if isinstance(value, str):
        return '"' + " ".join(value.split()).replace('"', '""') + '"'
    return "nan" if math.isnan(value) else f"{float(value):.9g}"


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
        from astropy import units

        try:
            return float(units.Unit(written).to(units.Unit(unit)))
        except (ValueError, units.UnitConversionError):
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
    """ECSV."""
    import yaml

    with reading(place, "ECSV", "write it with astropy: table.write(path, format='ascii.ecsv')"):
        lines = text.splitlines()
        head = [line[2:] for line in lines if line.startswith("# ")]
        document = yaml.safe_load(_without_meta(head[1:]))
        described = {
            str(column["name"]): str(column.get("unit", "")) for column in document["datatype"]
        }
        body = [
            (number, line)
            for number, line in enumerate(lines, 1)
            if line.strip() and not line.startswith("#")
        ]
        numbers, rows = _cells(body, str(document.get("delimiter", " ")))
        names = rows[0]
        units = [described[name] for name in names]
    return names, units, rows[1:], [*numbers[1:], numbers[0]]


def _without_meta(head: list[str]) -> str:
    """The heading of an ECSV file without its provenance, which may have YAML tags of astropy."""
    kept, skipping = [], False
    for line in head:
        if not line.startswith((" ", "-")):
            skipping = line.startswith("meta:")
        if not skipping:
            kept.append(line)
    return "\n".join(kept)
