"""Tables as aligned text, ECSV files and JSON records; HTML from jinja2 templates."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from numbers import Integral
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment
    from markupsafe import Markup

    from .storage.table_files import Column


def render(package: str, template: str, **values: Any) -> str:
    """The text of a template in the folder ``templates`` of a package, or in that of the core.

    Every value is escaped, unless it is `markupsafe.Markup`.
    """
    return _environment(package).get_template(template).render(**values)


def html_table(title: str, rows: Sequence[tuple[Any, Any]]) -> str:
    """A table of two columns that shows an object in a notebook."""
    return render("zonda.core", "notebook.html", title=title, rows=rows)


@cache
def _environment(package: str) -> Environment:
    from jinja2 import ChoiceLoader, Environment, PackageLoader, StrictUndefined

    packages = dict.fromkeys((package, "zonda.core"))
    made = Environment(
        loader=ChoiceLoader([PackageLoader(name) for name in packages]),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    made.filters |= {"code": code, "number": cell_text}
    return made


def code(text: str) -> Markup:
    """Docstring text with single and double backquotes as code."""
    from markupsafe import Markup, escape

    plain = str(escape(" ".join(text.split())))
    return Markup(re.sub(r"``(.+?)``|`(.+?)`", lambda m: f"<code>{m[1] or m[2]}</code>", plain))


def aligned(
    rows: Iterable[Sequence[Any]],
    head: Sequence[str] = (),
    align: str = "<",
    *,
    indent: str = "",
    gap: str = "  ",
) -> list[str]:
    """Lines of a table, each column as wide as its longest cell.

    Parameters
    ----------
    rows
        Cells of each row; a row may be shorter than others.
    head
        Names of the columns; none by default.
    align
        A character for each column, ``<`` left or ``>`` right; the last one holds for all that
        follow.
    indent, gap
        Text before each line, and between columns.
    """
    table = [[str(cell) for cell in row] for row in ([head, *rows] if head else rows)]
    number = max(map(len, table), default=0)
    widths = [max(len(row[k]) for row in table if k < len(row)) for k in range(number)]
    sides = align + align[-1] * number

    def line(row: Sequence[str]) -> str:
        cells = zip(row, sides, widths, strict=False)
        return gap.join(f"{cell:{side}{width}}" for cell, side, width in cells)

    return [(indent + line(row)).rstrip() for row in table]


@dataclass(frozen=True)
class Table:
    """Named columns of equal length, with units and descriptions, and ``meta`` about all of it."""

    columns: Sequence[Column]
    meta: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        records: Sequence[Mapping[str, Any]],
        about: Mapping[str, str],
        meta: Mapping[str, Any],
    ) -> Table:
        """A table of mappings that have the same keys; ``about``: descriptions of the columns."""
        from .storage.table_files import Column  # with astropy's tables

        made = [Column(k, [one[k] for one in records], "", text) for k, text in about.items()]
        return cls(made, meta)

    @property
    def head(self) -> list[str]:
        """Names of the columns."""
        return [column.name for column in self.columns]

    @property
    def rows(self) -> list[tuple[Any, ...]]:
        """Values of each row."""
        return list(zip(*(column.values for column in self.columns), strict=True))

    def shown(self) -> list[list[str]]:
        """Cells of each row as text; unknown values are empty."""
        return [[cell_text(value) for value in row] for row in self.rows]

    def lines(self, align: str = "<") -> list[str]:
        """Aligned text with a head; ``align`` as in `aligned`."""
        return aligned(self.shown(), self.head, align)

    def records(self) -> list[dict[str, Any]]:
        """A dictionary for each row, for JSON; numbers that are not finite are None."""
        return [dict(zip(self.head, map(_plain, row), strict=True)) for row in self.rows]

    def write(self, path: str | Path) -> Path:
        """Write an ECSV file, and return its path. Raises `OutputError`."""
        from .storage.table_files import write_ecsv

        return write_ecsv(path, self.columns, self.meta)


def cell_text(value: Any, digits: int = 5) -> str:
    """A text or a whole number as it is, another one to ``digits``; empty for None and NaN."""
    if isinstance(value, str | Integral):
        return str(value)
    return "" if value is None or math.isnan(value) else f"{value:.{digits}g}"


def _plain(value: Any) -> Any:
    if value is None or isinstance(value, str | bool | int):
        return value
    return float(value) if math.isfinite(value) else None
