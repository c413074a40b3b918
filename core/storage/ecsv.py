"""Small tables as text: ECSV (Astropy enhancement proposal 6), a CSV file with units, descriptions and provenance on top."""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from .files import write_text


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
