"""Tables: ECSV (Astropy enhancement proposal 6), text with commas, semicolons, tabs, bars or blanks
between its columns, whose heading names them and their units (``ra [deg]``; VizieR's below it),
IPAC, FITS and VOTable.

Cells of text stay text until a reader asks for numbers: nothing of a file is evaluated, and units
are read by `configuration.units` alone.
"""

from __future__ import annotations

import csv
import itertools
import math
import re
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import numpy as np
import yaml
from astropy import table as astropy_table

from ..configuration.time import Instant
from ..errors import InputError
from ..types import Bools, Floats
from . import fits_files
from .files import UNPACKED_MAX, atomic_path, first_bytes, reading, too_large, unpacked

LARGEST = 1 << 28
"""Bytes of the text of a table that is read."""
AS_TEXT = (
    "give ECSV, FITS, VOTable, IPAC, or text whose heading names the columns, with their units in"
    " brackets"
)
FORMATS = {"ECSV": "ascii.ecsv", "VOTable": "votable", "IPAC": "ascii.ipac"}
"""Kinds of text with a format of their own, and astropy's names of these."""
MOST_COLUMNS = 999
"""Columns of a table, as of one in FITS."""
MOST_VALUES, MOST_HEADER = 100_000, 100_000
"""Largest number of values in the header of an ECSV table, with its aliases expanded, and of its
characters."""
NUMBERED = tuple(map(str, range(1, MOST_COLUMNS + 1)))
"""Names of columns that have none."""
LONGEST_NAME = 500
"""Characters of a column's heading."""
PER_CELL, PER_LINE = 90, 400
"""Bytes of memory that a cell and a line of text take."""
SERIALIZED = "__serialized_columns__"
"""Key of `Table.meta`: columns that astropy has split, such as positions."""
EMPTY = frozenset({"", "-", "--", "null", "none", "nan", "n/a"})
"""Cells that state no value, in small letters."""
HOURS = frozenset({"h", "hr", "hour", "hours", "hourangle", "h:m:s", "hms"})
"""Units of right ascensions, in small letters."""
MOST_TOLD = 12
"""Mistakes that are told one by one; the others are counted."""
BRACKETED = re.compile(
    r"(.*?)\s*(?:\[(.*)\]|\((degs?|degrees?|°|rad|radians?|arcmin|arcsec|s|secs?|seconds?"
    r"|h|hours?|%|[kMGT]?Hz|[mu]?Jy|[kcmu]?m|h?Pa|K)\))"
)
"""Name and unit of a column's heading; only such units stand in round brackets."""
SPELLED = {
    "degs": "deg",
    "d:m:s": "deg",
    "degrees": "deg",
    "radians": "rad",
    "sec": "s",
    "secs": "s",
    "seconds": "s",
    "ppm": "1e-6",
}
"""Units as headings write them, in small letters, that astropy does not know."""
WRITTEN = {
    **{u: u for u in ("deg", "rad", "arcmin", "arcsec", "s", "h", *SPELLED)},
    **{u.lower(): u for u in ("GHz", "Hz", "Jy", "mJy", "uJy")},
}
"""Units at the end of a name, in small letters."""


Lines = Sequence[tuple[int, str]]
"""Lines of a text, each with its number."""
Named = list[tuple[str, str]]
"""Name and unit of each column."""
Parsed = tuple[list[int], list[list[str]], Named]
"""Line numbers, rows (the heading first), names with units."""


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
        By name: texts, or an array, and the unit as it is written (empty: none).
    lines
        Line of the file of each row, from 1; of the heading last. 0: the file has no lines.
    meta
        What the head of an ECSV file states beside the columns, all of it as text; ``comments`` of
        other text.
    counted
        Word for the numbers of ``lines``: line, or row.
    """

    def __init__(
        self,
        place: str,
        columns: Mapping[str, tuple[Any, str]],
        lines: Sequence[int],
        meta: Mapping[str, Any] | None = None,
        counted: str = "line",
    ) -> None:
        self.place = place
        self.columns = columns
        self.lines = lines
        self.meta = meta or {}
        self.counted = counted
        self._mistakes: list[tuple[int, str, str]] = []

    def __len__(self) -> int:
        return len(self.lines) - 1

    def note(self, row: int | None, message: str, cure: str) -> None:
        """Note a mistake in a row; -1: in the heading, None: in the table as a whole."""
        self._mistakes.append((0 if row is None else self.lines[row], message, cure))

    def note_rows(
        self,
        wrong: Bools,
        message: str | Callable[[int], str],
        cure: str,
    ) -> None:
        """Note a mistake in each ``wrong`` row (n,)."""
        for row in np.flatnonzero(wrong).tolist():
            self.note(row, message if isinstance(message, str) else message(row), cure)

    def check(self) -> None:
        """Raise `InputError` about all mistakes at once, each with its line."""
        found = sorted(self._mistakes, key=lambda mistake: mistake[0])
        self._mistakes = []
        told = [
            (f"{self.counted} {line}: {text}" if line else text, cure) for line, text, cure in found
        ]
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
            if isinstance(found, np.ndarray):
                return ["" if v != v else str(v) for v in found.tolist()]
            return found
        self.note(-1, f"has no column {name!r}", f"it has: {', '.join(self.columns)}")
        return [""] * len(self)

    def values(self, name: str) -> Floats:
        """A column as numbers, in the unit in which it is written; NaN for another text."""
        column = self.columns[name][0]
        numbers = [_number(text) for text in column] if isinstance(column, list) else column
        return np.asarray(numbers, np.float64)

    def numbers(self, name: str, unit: str = "", empty: float | None = None) -> Floats:
        """A column of finite numbers, in ``unit``; where that is empty, the column has none.

        A column that is not there, has no unit or one of another kind, and every row that is not a
        finite number, are mistakes. ``empty``: what cells without a value are, where they may be.
        """
        texts = self.texts(name)
        if name not in self.columns:
            return np.full(len(self), np.nan)
        factor = self.factor(name, unit)
        values = self.values(name)
        blank = np.zeros(len(self), bool)
        if empty is not None:
            blank = np.array([text.strip().lower() in EMPTY for text in texts], bool)
        self.note_rows(
            ~np.isfinite(values) & ~blank,
            lambda row: f"{name} is {texts[row]!r}, not a finite number",
            "mend or remove that row",
        )
        return np.where(blank, np.nan if empty is None else empty, values * factor)

    def angles(self, name: str, *, hours: bool = False, gaps: bool = False) -> Floats:
        """A column of angles in rad: numbers with a unit, or sexagesimal.

        ``hours``: sexagesimal ones without marks or unit are hours, as of right ascensions.
        ``gaps``: other texts are NaN, and no mistakes.
        """
        from ..configuration.target import radians

        if name in self.columns:
            column, unit = self.columns[name]
            if unit.lower() in HOURS:
                self.columns = {**self.columns, name: (column, "hourangle")}
            if isinstance(column, list) and any(re.search(r"\d[\s:hd°]+\d", t) for t in column):
                turns = hours and not unit.lower().startswith("d")
                found = np.full(len(self), np.nan)
                for row, text in enumerate(column):
                    try:
                        plain = re.sub(r"(?<=\d)\s+(?=\d)", ":", text.strip())
                        found[row] = radians(plain, name, hours=turns)
                    except ValueError as error:
                        if gaps:
                            continue
                        cure = "write it as 05:00:00 or 05h00m00s, +20:00:00 or +20d00m00s"
                        self.note(row, f"{name} {text!r}: {error}", cure)
                return found
        return self.values(name) * self.factor(name, "rad") if gaps else self.numbers(name, "rad")

    def rename(self, aliases: Mapping[str, Sequence[str]]) -> None:
        """Rename columns to the keys of ``aliases``, whose values are the names that files have for
        them, in small letters, the preferred one first.

        Capitals, blanks and a unit at the end (``ra_deg``) do not matter; ``coord.ra`` is ``ra``.
        Names that are not found stay.
        """
        known = {name for names in aliases.values() for name in names}
        written: dict[str, tuple[str, str]] = {}
        for name, (_, unit) in self.columns.items():
            plain = "_".join(name.lower().split())
            base, _, after = plain.rpartition("_")
            last = plain.rpartition(".")[2]
            stated = unit
            if plain not in known and last in known:
                plain = last
            elif plain not in known and base in known and after in WRITTEN and not unit:
                plain = base
                stated = WRITTEN[after]
            if plain not in written or name == plain:
                written[plain] = name, stated
        found = {
            written[first][0]: (ours, written[first][1])
            for ours, names in aliases.items()
            if (first := next((name for name in names if name in written), None))
        }
        columns = self.columns.items()
        self.columns = {
            found.get(name, (name,))[0]: (column, found.get(name, ("", unit))[1])
            for name, (column, unit) in columns
        }

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


def _is_number(text: str) -> bool:
    return math.isfinite(_number(text))


def _number(text: str) -> float:
    """NaN where it is none."""
    try:
        return float(text)
    except ValueError:
        return math.nan


def read_table(
    path: Path,
    place: str = "",
    text: str | None = None,
    names: Sequence[str] | None = None,
) -> Table:
    """Read a table. The heading of text is the first line that is no comment; where that has
    numbers, a comment above with as many fields.

    Parameters
    ----------
    text
        The content, if it was read before.
    names
        Of a table of numbers, in which a `#` ends a line: names of the columns where there is no
        heading.

    Raises
    ------
    InputError
        For another kind of file, rows of unequal length, columns of one name, a table without rows.
    """
    place = place or str(path)
    if text is None:
        with reading(place, "a table", AS_TEXT):
            if first_bytes(path) == b"SIMPLE  =":
                return _fits(path, place)
        text = read_text(path, place)
    lines = text.count("\n") + 1
    cells = lines + max(text.count(mark) for mark in ",;\t| <")
    if (size := PER_CELL * cells + PER_LINE * lines) > UNPACKED_MAX:
        raise too_large(f"has {lines} lines, which need {size / 1e9:.3g} GB of memory", place)
    written = [(number, line) for number, line in enumerate(text.splitlines(), 1) if line.strip()]
    body = [(number, line) for number, line in written if not line.startswith("#")]
    kind = _kind(text, body)
    cure = f"write it with astropy: table.write(path, format={FORMATS.get(kind)!r})"
    meta: Mapping[str, Any] = {}
    with reading(place, kind, cure if kind in FORMATS else AS_TEXT):
        if kind == "ECSV":
            numbers, rows, named, meta = _ecsv(written, body)
        elif kind == "VOTable":
            numbers, rows, named = _votable(text)
        elif kind == "IPAC":
            numbers, rows, named = _ipac(body)
        else:  # csv raises for a quote that is not closed
            numbers, rows, named = _plain_text(written, body, names)
            meta = {"comments": [line.strip("# \t") for _, line in written if line[:1] == "#"]}
    counted = "row" if kind == "VOTable" else "line"
    table = Table(place, {}, [*numbers[1:], *(numbers[:1] or [1])], meta, counted)
    _check_names([name for name, _ in named], table)
    for k, row in enumerate(rows[1:]):
        if len(row) != len(named):
            cure = f"write {len(named)} values: {', '.join(name for name, _ in named)}"
            table.note(k, f"has {len(row)} values, not {len(named)}", cure)
    if not rows[1:]:
        table.note(None, "has no rows", "give a table with a row or more")
    table.check()
    columns = [list(column) for column in zip(*rows[1:], strict=True)]
    table.columns = {n: (c, unit) for (n, unit), c in zip(named, columns, strict=True)}
    return table


def _kind(text: str, body: Lines) -> str:
    """Kind of a table of text: one of `FORMATS`, or a table."""
    first, last = (body[k][1].lstrip()[:1] if body else "" for k in (0, -1))
    if text.startswith("# %ECSV"):
        return "ECSV"
    if first == "<":
        return "VOTable"
    return "IPAC" if first == "\\" or (first == "|" and last != "|") else "a table"


def _check_names(names: Sequence[str], table: Table) -> None:
    """Refuse too many columns, and names that are too long; note those that are there twice."""
    text = ""
    cure = "leave out columns"
    if len(names) > MOST_COLUMNS:
        text = f"has {len(names)} columns, more than the {MOST_COLUMNS} that are read"
    elif long := [name for name in names if len(name) > LONGEST_NAME]:
        text = f"has a column whose name begins {long[0][:40]!r} and has {len(long[0])} characters"
        cure = "give it a shorter name"
    if text:
        raise InputError(text, place=table.place, cure=cure)
    for name, number in Counter(names).items():
        if number > 1:
            table.note(-1, f"has two columns {name!r}", "rename one of them")


def _fits(path: Path, place: str) -> Table:
    """The first table of a FITS file: its columns of one value a row."""
    from astropy.io import fits

    with fits_files.opened(path, place, AS_TEXT) as file:
        hdu = next((h for h in file if isinstance(h, fits.BinTableHDU | fits.TableHDU)), None)
        if hdu is None:
            raise InputError("has no table", place=place, cure=AS_TEXT)
        fits_files.check_size(hdu, place)
        frame = re.search(r"frame: (\w+)", str(hdu.header.get("COMMENT", "")))
        meta = {SERIALIZED: {"": {"frame": frame[1]}}} if frame else {}
        columns: dict[str, tuple[Any, str]] = {}
        for column in hdu.columns:
            values = np.asarray(hdu.data[column.name])
            if values.ndim == 1 and values.dtype.kind in "SU":
                columns[column.name] = (
                    [str(v).strip() for v in values.tolist()],
                    str(column.unit or ""),
                )
            elif values.ndim == 1 and values.dtype.kind in "fiub":
                if isinstance(column.null, int) and values.dtype.kind in "iu":
                    values = np.where(values == column.null, np.nan, values)
                columns[column.name] = values, str(column.unit or "")
        table = Table(place, columns, [*range(1, 1 + len(hdu.data)), 0], meta, "row")
    if not len(table):
        table.note(None, "has no rows", "give a table with a row or more")
    table.check()
    return table


def _ecsv(
    written: Lines,
    body: Lines,
) -> tuple[list[int], list[list[str]], Named, Mapping[str, Any]]:
    """`Parsed`, and meta: texts, mappings and lists of them."""
    header = "\n".join(line[2:] for _, line in written if line.startswith("# "))
    check_header(header)
    head = yaml.load(header, Loader=yaml.BaseLoader)  # tags are not followed
    numbers, rows = _cells(body, head.get("delimiter", " "))
    described = {column["name"]: column.get("unit", "") for column in head["datatype"]}
    if wrong := [name for name, unit in described.items() if not isinstance(unit, str)]:
        raise ValueError(f"the unit of {wrong[0]} is no text")
    named = [(name, described[name]) for name in rows[0]]
    meta = head.get("meta", {})
    if isinstance(meta, list):  # an ordered mapping
        meta = {key: value for each in meta for key, value in dict(each).items()}
    return numbers, rows, named, meta


def _votable(text: str) -> Parsed:
    """The first table of a VOTable: names and units of its fields, and TABLEDATA."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:
        raise ValueError("it declares entities")
    named = Named()
    rows = [list[str]()]
    for element in ElementTree.fromstring(text).iter():
        kind = element.tag.rpartition("}")[2]
        if kind == "STREAM":
            raise ValueError("its rows are binary; write them as TABLEDATA")
        if kind == "FIELD":
            given = element.attrib
            named.append((given.get("name") or given.get("ID", ""), given.get("unit", "")))
        elif kind == "TR":
            rows.append([(cell.text or "").strip() for cell in element])
        elif kind == "TABLE" and named:
            break
    return [0, *range(1, len(rows))], rows, named


def _ipac(body: Lines) -> Parsed:
    """A table of the Infrared Processing and Analysis Center: bars in the heading (names, types,
    units, values of empty cells) end the columns.
    """
    body = [(number, line.expandtabs()) for number, line in body if line[:1] != "\\"]
    head = [(number, line) for number, line in body if line[:1] == "|"]
    ends = [k for k, mark in enumerate(head[0][1]) if mark == "|"]
    spans = [slice(a + 1, b) for a, b in itertools.pairwise(ends)]
    spans[-1] = slice(ends[-2] + 1, None)

    def cells(line: str) -> list[str]:
        return [line[span].strip(" |") for span in spans]

    names, _, units, nulls = [cells(line) for _, line in (*head[:4], *[(0, "")] * 4)][:4]
    kept = [(number, line) for number, line in body if line[:1] != "|"]
    rows = [
        ["" if cell == null != "" else cell for cell, null in zip(cells(line), nulls, strict=True)]
        for _, line in kept
    ]
    named = list(zip(names, ("" if u == "-" else u for u in units), strict=True))
    return [head[0][0], *(number for number, _ in kept)], [names, *rows], named


def _plain_text(written: Lines, body: Lines, names: Sequence[str] | None) -> Parsed:
    """Text with marks or blanks between its columns."""
    if names is not None:
        body = [(number, line.partition("#")[0]) for number, line in body]
    first = body[0][1] if body else ""
    mark = max(",;\t|", key=first.count)
    if mark not in first or (mark == "\t" and all(map(_is_number, first.split()))):
        mark = " "
        body = [(number, line.replace("\t", " ")) for number, line in body]
    numbers, rows = _cells(body, mark)
    units: list[str] = []
    for k in range(1, min(4, len(rows))):
        if all(re.fullmatch("-+", cell) for cell in rows[k]):  # VizieR: names, units, dashes
            units = rows[1] if k > 1 else []
            del numbers[1 : k + 1], rows[1 : k + 1]
            break
    if rows and any(map(_is_number, rows[0])):
        above = [(k, line.lstrip("# ")) for k, line in written if k < body[0][0]]
        every = zip(*_cells(above, mark), strict=True)
        fitting = [both for both in every if len(both[1]) == len(set(both[1])) == len(rows[0])]
        fitting.sort(key=lambda both: any("[" in cell for cell in both[1]))
        if not fitting and names and len(names) >= len(rows[0]):
            fitting = [(body[0][0], list(names[: len(rows[0])]))]
        for number, heading in fitting[-1:]:
            numbers = [number, *numbers]
            rows = [heading, *rows]
    heading = rows[0] if rows else []
    found = [BRACKETED.fullmatch(word) if len(word) <= LONGEST_NAME else None for word in heading]
    named = [
        (m[1], m[2] or m[3] or "") if m else (word, "")
        for word, m in zip(heading, found, strict=True)
    ]
    if len(units) == len(named):
        named = [(name, u or unit) for (name, u), unit in zip(named, units, strict=True)]
    return numbers, rows, named


def check_header(text: str) -> None:
    """Raise ValueError for YAML of more than `MOST_HEADER` characters, with powers of three digits
    (of units, which astropy computes), or of more than `MOST_VALUES` values with its aliases
    expanded.
    """
    if len(text) > MOST_HEADER:
        raise ValueError(f"its header has more than {MOST_HEADER} characters")
    if re.search(r"(\*\*|\^)\W{0,9}\d{3}", text):
        raise ValueError("a unit has a power of three digits")
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
        return unpacked(path, place, LARGEST).decode("utf-8-sig")


def _cells(lines: Lines, mark: str) -> tuple[list[int], list[list[str]]]:
    """Cells of numbered lines, and the number of the line of each row."""
    texts = (line.strip(" ") for _, line in lines)
    if mark == " ":  # a unit in brackets belongs to the name before it
        texts = (re.sub(r"(?<=\S)\s+(?=[\[(])", "", line) for line in texts)
    reader = csv.reader(texts, delimiter=mark, skipinitialspace=True)
    found = [(lines[reader.line_num - 1][0], row) for row in reader]
    return [number for number, _ in found], [[cell.strip() for cell in row] for _, row in found]
