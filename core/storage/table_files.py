"""Tables as text: ECSV (Astropy enhancement proposal 6), and text with commas, semicolons, tabs,
bars or blanks between its columns, whose heading names them and their units: ``ra [deg]``.
"""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from astropy import table as astropy_table
from astropy.table.meta import get_header_from_yaml
from numpy.typing import NDArray

from ..configuration.time import Instant
from ..errors import InputError
from .files import atomic_path, reading, unpacked_text

LARGEST = 1 << 28
"""Bytes of the text of a table that is read."""
AS_TEXT = "give ECSV, or text whose heading names the columns, with their units in brackets"
MOST_COLUMNS = 999
"""Columns of a table, as of one in FITS."""
MOST_VALUES = 100_000
"""Largest number of values in the header of an ECSV table, with its aliases expanded."""
MOST_TOLD = 12
"""Mistakes that are told one by one; the others are counted."""
BRACKETED = re.compile(r"(.*?)\s*(?:\[(.*)\]|\((degs?|degrees?|°|rad|radians?|s|secs?|seconds?)\))")
"""Name and unit of a column's heading; only such units stand in round brackets."""
SPELLED = {
    "degs": "deg",
    "degrees": "deg",
    "radians": "rad",
    "sec": "s",
    "secs": "s",
    "seconds": "s",
    "ppm": "1e-6",
}
"""Units as headings write them, in small letters, that astropy does not know."""


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


class Table:
    """A table that was read. It collects the mistakes that are found in it; `check` tells them.

    Attributes
    ----------
    place
        The file, as messages call it.
    columns
        By name: texts, or an array of numbers, and the unit as it is written (empty: none).
    lines
        Line of the file of each row, from 1; of the heading last. 0: the file has no lines.
    meta
        What the head of an ECSV file states beside the columns.
    """

    def __init__(
        self,
        place: str,
        columns: Mapping[str, tuple[Any, str]],
        lines: Sequence[int],
        meta: Mapping[str, Any] | None = None,
    ) -> None:
        self.place, self.columns, self.lines, self.meta = place, columns, lines, meta or {}
        self._mistakes: list[tuple[int, str, str]] = []

    def __len__(self) -> int:
        return len(self.lines) - 1

    def note(self, row: int | None, message: str, cure: str) -> None:
        """Note a mistake in a row; -1: in the heading, None: in the table as a whole."""
        self._mistakes.append((0 if row is None else self.lines[row], message, cure))

    def note_rows(
        self,
        wrong: NDArray[np.bool_],
        message: str | Callable[[int], str],
        cure: str,
    ) -> None:
        """Note a mistake in each ``wrong`` row (n,)."""
        for row in np.flatnonzero(wrong).tolist():
            self.note(row, message if isinstance(message, str) else message(row), cure)

    def check(self) -> None:
        """Raise `InputError` about all mistakes at once, each with its line."""
        found, self._mistakes = sorted(self._mistakes, key=lambda mistake: mistake[0]), []
        told = [(f"line {line}: {text}" if line else text, cure) for line, text, cure in found]
        if len(told) == 1:
            raise InputError(told[0][0], place=self.place, cure=told[0][1])
        if told:
            cures = [f"{text}; {cure}" if cure else text for text, cure in told[:MOST_TOLD]]
            cures += [f"and {len(told) - MOST_TOLD} more"] if len(told) > MOST_TOLD else []
            raise InputError(f"{len(told)} mistakes", place=self.place, cure="\n".join(cures))

    def texts(self, name: str) -> Sequence[str]:
        """A column as it is written; empty texts, and a mistake, where there is none."""
        if name in self.columns:
            found: Sequence[str] = self.columns[name][0]
            return found
        self.note(-1, f"has no column {name!r}", f"it has: {', '.join(self.columns)}")
        return [""] * len(self)

    def values(self, name: str) -> NDArray[np.float64]:
        """A column as numbers, in the unit in which it is written; NaN for another text."""
        column = self.columns[name][0]
        numbers = [_number(text) for text in column] if isinstance(column, list) else column
        return np.asarray(numbers, np.float64)

    def numbers(self, name: str, unit: str = "") -> NDArray[np.float64]:
        """A column of finite numbers, in ``unit``; where that is empty, the column has none.

        A column that is not there, has no unit or one of another kind, and every row that is not a
        finite number, are mistakes.
        """
        texts = self.texts(name)
        if name not in self.columns:
            return np.full(len(self), np.nan)
        factor, values = self.factor(name, unit), self.values(name)
        self.note_rows(
            ~np.isfinite(values),
            lambda row: f"{name} is {texts[row]!r}, not a finite number",
            "mend or remove that row",
        )
        return values * factor

    def factor(self, name: str, unit: str, otherwise: str = "") -> float:
        """The unit of a column in terms of ``unit``; 1, and a mistake, where it is none.

        ``otherwise``: the unit of a column that states none.
        """
        written = self.columns[name][1] or otherwise
        if not unit and not written:
            return 1.0
        from ..configuration.units import KINDS, factor_to  # slow, and pictures need tables alone

        named = KINDS[unit].display if unit in KINDS else (unit,)
        accepted = f"{', '.join(named[:-1])} or {named[-1]}" if len(named) > 1 else unit
        if not written:
            heading = f"in ECSV 'unit: {named[0]}', in CSV a heading such as {name} [{named[0]}]"
            self.note(-1, f"{name} has no unit", f"give it in {accepted}: {heading}")
            return 1.0
        factor = factor_to(unit, SPELLED.get(written.lower(), written))
        if factor is None:
            other = f"give it in {accepted}, or another unit of its kind"
            cure = other if unit else "leave the unit out"
            self.note(-1, f"{name} has the unit {written!r}", cure)
        return factor or 1.0

    def instants(self, name: str, *, optional: bool = False) -> list[Instant | None]:
        """A column of times; None, and a mistake, for another text. ``optional``: it may be
        empty.
        """
        found: list[Instant | None] = []
        for row, text in enumerate(self.texts(name)):
            try:
                found.append(Instant.parse(text) if text or not optional else None)
            except ValueError as err:
                found.append(None)
                self.note(row, f"{name}: {err}", "write it as 2024-11-25T07:00:00.5 (UTC)")
        return found


def _number(text: str) -> float:
    """NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def read_table(path: Path, place: str = "", text: str | None = None) -> Table:
    """Read a table. The heading of text is the first line that is no comment; where that has
    numbers, a comment above with as many fields. ``text``: the content, if it was read before.

    Raises InputError for another kind of file, rows of unequal length, columns of one name, or a
    table without rows.
    """
    place = place or str(path)
    text = read_text(path, place) if text is None else text
    written = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    body = [(number, line) for number, line in written if not line.startswith("#")]
    meta: Mapping[str, Any] = {}
    if text.startswith("# %ECSV"):
        cure = "write it with astropy: table.write(path, format='ascii.ecsv')"
        with reading(place, "ECSV", cure):
            numbers, rows, named, meta = _ecsv(written, body)
    else:
        with reading(place, "a table", AS_TEXT):  # a quote that is not closed
            numbers, rows, named = _plain_text(written, body)
    names = [name for name, _ in named]
    table = Table(place, {}, [*numbers[1:], *(numbers[:1] or [1])], meta)
    if len(names) > MOST_COLUMNS:
        text = f"has {len(names)} columns, more than the {MOST_COLUMNS} that are read"
        raise InputError(text, place=place, cure="leave out columns")
    for name in sorted({n for n in names if names.count(n) > 1}):
        table.note(-1, f"has two columns {name!r}", "rename one of them")
    for k, row in enumerate(rows[1:]):
        if len(row) != len(names):
            cure = f"write {len(names)} values: {', '.join(names)}"
            table.note(k, f"has {len(row)} values, not {len(names)}", cure)
    if not rows[1:]:
        table.note(None, "has no rows", "give a table with a row or more")
    table.check()
    columns = [list(column) for column in zip(*rows[1:], strict=True)]
    table.columns = {n: (c, unit) for (n, unit), c in zip(named, columns, strict=True)}
    return table


Lines = Sequence[tuple[int, str]]
"""Lines of a text, each with its number."""


def _ecsv(
    written: Lines,
    body: Lines,
) -> tuple[list[int], list[list[str]], list[tuple[str, str]], Mapping[str, Any]]:
    """Line numbers, rows (the heading first), names with units, and meta of an ECSV table."""
    header = [line[2:] for _, line in written if line.startswith("# ")]
    check_header("\n".join(header))
    head = get_header_from_yaml(header)
    numbers, rows = _cells(body, str(head.get("delimiter", " ")))
    described = {column["name"]: str(column.get("unit", "")) for column in head["datatype"]}
    named = [(name, described[name]) for name in rows[0]]
    return numbers, rows, named, head["meta"] if isinstance(head.get("meta"), Mapping) else {}


def _plain_text(
    written: Lines,
    body: Lines,
) -> tuple[list[int], list[list[str]], list[tuple[str, str]]]:
    """Line numbers, rows (the heading first), and names with units of a table of other text."""
    first = body[0][1] if body else ""
    mark = max(",;\t|", key=first.count)
    mark = mark if mark in first else " "
    numbers, rows = _cells(body, mark)
    if rows and any(math.isfinite(_number(cell)) for cell in rows[0]):
        above = [(k, line.lstrip("# ")) for k, line in written if k < body[0][0]]
        every = zip(*_cells(above, mark), strict=True)
        fitting = [both for both in every if len(both[1]) == len(rows[0])]
        fitting.sort(key=lambda both: any("[" in cell for cell in both[1]))
        for number, heading in fitting[-1:]:
            numbers, rows = [number, *numbers], [heading, *rows]
    found = [(word, BRACKETED.fullmatch(word)) for word in (rows[0] if rows else [])]
    return numbers, rows, [(m[1], m[2] or m[3] or "") if m else (word, "") for word, m in found]


def check_header(text: str) -> None:
    """Raise ValueError for YAML of more than `MOST_VALUES` values with its aliases expanded."""
    if _unfolded(yaml.compose(text), {}) > MOST_VALUES:
        raise ValueError(f"its aliases unfold to more than {MOST_VALUES} values")


def _unfolded(node: Any, sizes: dict[int, float]) -> float:
    """Number of values below a YAML node, with aliases expanded; infinite for one inside itself."""
    if isinstance(node, tuple):
        return sum(_unfolded(each, sizes) for each in node)
    if not isinstance(node, yaml.CollectionNode):
        return 1.0
    if id(node) not in sizes:
        sizes[id(node)] = math.inf  # for an alias of this node inside it
        sizes[id(node)] = 1.0 + sum(_unfolded(each, sizes) for each in node.value)
    return sizes[id(node)]


def read_text(path: Path, place: str) -> str:
    """The text of a table, unpacked. Raises InputError for one that is larger than `LARGEST`, or
    no text.
    """
    with reading(place, "a table", AS_TEXT):
        return unpacked_text(path, place, LARGEST)


def _cells(lines: Lines, mark: str) -> tuple[list[int], list[list[str]]]:
    """Cells of numbered lines, and the number of the line of each row."""
    texts = (line.strip(" ") for _, line in lines)
    if mark == " ":  # a unit in brackets belongs to the name before it
        texts = (re.sub(r"\s+(?=[\[(])", "", line) for line in texts)
    reader = csv.reader(texts, delimiter=mark, skipinitialspace=True)
    found = [(lines[reader.line_num - 1][0], row) for row in reader]
    return [number for number, _ in found], [[cell.strip() for cell in row] for _, row in found]
