"""Small tables as text: ECSV (Astropy enhancement proposal 6), a CSV file with units, descriptions and provenance on top."""

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

LARGEST = 1 << 28
"""Bytes of a file that is read as a small table."""


@dataclass(frozen=True)
class Column:
    """Name, values (n,) (numbers, or all of them texts), FITS unit (empty: none) and description."""

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
        head.append(f"- {{name: {c.name}, {unit}datatype: {kind}, description: {json.dumps(c.description)}}}")
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
    """

    place: str
    columns: Mapping[str, tuple[list[str], str]]

    def __len__(self) -> int:
        return len(next(iter(self.columns.values()))[0]) if self.columns else 0

    def texts(self, name: str) -> list[str]:
        """A column as it is written. Raises InputError where there is none of this name."""
        if name not in self.columns:
            raise InputError(f"has no column {name!r}", place=self.place, cure=f"it has: {', '.join(self.columns)}")
        return self.columns[name][0]

    def numbers(self, name: str, unit: str = "") -> NDArray[np.float64]:
        """A column of finite numbers, in ``unit``; where that is empty, the column has none.

        Raises InputError for a column without a unit, of another kind, or with a row that is not a finite number.
        """
        texts, written = self.texts(name), self.columns[name][1]
        try:
            values = np.array([float(text) for text in texts])
        except ValueError:
            values = np.array([np.nan])
            bad = next(row for row, text in enumerate(texts) if not _is_number(text))
        else:
            bad = int(np.argmin(np.isfinite(values))) if len(values) else 0
        if not np.isfinite(values).all():
            raise InputError(
                f"{name} of row {bad + 1} is {texts[bad]!r}, not a finite number",
                place=self.place,
                cure="mend or remove that row",
            )
        return values * self._factor(name, written, unit)

    def _factor(self, name: str, written: str, unit: str) -> float:
        if not unit and not written:
            return 1.0
        if not written:
            cure = f"give it one: in ECSV 'unit: {unit}', in CSV a heading such as {name} [{unit}]"
            raise InputError(f"{name} has no unit", place=self.place, cure=cure)
        from astropy import units

        try:
            return float(units.Unit(written).to(units.Unit(unit)))
        except (ValueError, units.UnitConversionError):
            raise InputError(
                f"{name} has the unit {written!r}",
                place=self.place,
                cure=f"give it in {unit}, or another unit of its kind" if unit else "leave the unit out",
            ) from None


def _is_number(text: str) -> bool:
    try:
        return math.isfinite(float(text))
    except ValueError:
        return False


def read_table(path: Path) -> Table:
    """Read ECSV, or CSV whose first line names the columns, with units in brackets: ``ra [deg], dec [deg]``.

    Raises InputError for another kind of file, rows of unequal length, columns of one name, or a table without rows.
    """
    place = str(path)
    with reading(place, "a table", "give ECSV, or CSV whose first line names the columns, with their units in brackets"):
        if path.stat().st_size > LARGEST:
            raise InputError(f"is larger than {LARGEST >> 20} MB", place=place, cure="give a small table")
        text = path.read_text(encoding="utf-8-sig")
    names, units, rows = _ecsv(text, place) if text.startswith("# %ECSV") else _csv(text)
    twice = sorted({n for n in names if names.count(n) > 1})
    if twice:
        raise InputError(f"has two columns {twice[0]!r}", place=place, cure="rename one of them")
    for number, row in enumerate(rows):
        if len(row) != len(names):
            cure = f"write {len(names)} values: {', '.join(names)}"
            raise InputError(f"row {number + 1} has {len(row)} values, not {len(names)}", place=place, cure=cure)
    if not rows:
        raise InputError("has no rows", place=place, cure="give a table with a row or more")
    columns = [list(column) for column in zip(*rows, strict=True)]
    return Table(place, {n: (c, u) for n, u, c in zip(names, units, columns, strict=True)})


def _csv(text: str) -> tuple[list[str], list[str], list[list[str]]]:
    """Names, units and rows."""
    lines = [line for line in text.splitlines() if line.strip()]
    first = lines[0].lstrip("# ") if lines else ""
    named = [word.partition("[") for word in next(csv.reader([first]), [])]
    names, units = [name.strip() for name, _, _ in named], [unit.strip("] ") for _, _, unit in named]
    rows = csv.reader((line for line in lines[1:] if not line.startswith("#")), skipinitialspace=True)
    return names, units, [[cell.strip() for cell in row] for row in rows]


def _ecsv(text: str, place: str) -> tuple[list[str], list[str], list[list[str]]]:
    """Names, units and rows."""
    import yaml

    with reading(place, "ECSV", "write it with astropy: table.write(path, format='ascii.ecsv')"):
        lines = text.splitlines()
        head = [line[2:] for line in lines if line.startswith("# ")]
        document = yaml.safe_load(_without_meta(head[1:]))
        described = {str(column["name"]): str(column.get("unit", "")) for column in document["datatype"]}
        comma = str(document.get("delimiter", " "))
        body = [line for line in lines if line.strip() and not line.startswith("#")]
        rows = list(csv.reader(body, delimiter=comma, skipinitialspace=True))
        names = rows[0]
        units = [described[name] for name in names]
    return names, units, rows[1:]


def _without_meta(head: list[str]) -> str:
    """The heading of an ECSV file without its provenance, which may have YAML tags of astropy."""
    kept, skipping = [], False
    for line in head:
        if not line.startswith((" ", "-")):
            skipping = line.startswith("meta:")
        if not skipping:
            kept.append(line)
    return "\n".join(kept)
