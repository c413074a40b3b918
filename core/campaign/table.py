"""The figures of all sets of products of a campaign as one table: ``sweep.ecsv``, ``sweep.html``
and ``sweep.png``.

At each point of the axes a figure has n values over realizations: their mean, their scatter s, and
s / sqrt(n), the standard error of the mean.
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..canvas import SEQUENCE, new_axes
from ..configuration.units import factor_to
from ..experiment.experiment import Values
from ..storage.files import atomic_path, write_text
from ..tables import Table, render

if TYPE_CHECKING:
    from .folder import Record

LOGARITHMIC = 8.0
"""Ratio of the largest to the smallest swept value from which the axis is logarithmic."""

COLUMNS = {
    "figure": "metric and parameters",
    "unit": "of mean, scatter and standard_error; empty: a pure number",
    "mean": "over realizations",
    "scatter": "standard deviation of one realization; nan: not known",
    "standard_error": "of the mean; nan: not known",
    "realizations": "number of realizations",
}


@dataclass(frozen=True)
class Point:
    """A figure at one point of the axes, whose values are texts as in YAML."""

    axes: dict[str, str]
    name: str
    unit: str
    values: Values


def write(record: Record) -> None:
    """Write the table of a campaign whose combinations are all finished."""
    job, folder, points = record.job, record.folder, collected(record)
    axes = list(dict.fromkeys(key for point in points for key in point.axes))
    rows = [
        {key: point.axes.get(key, "") for key in axes}
        | {
            "figure": point.name,
            "unit": point.unit,
            "mean": point.values.mean,
            "scatter": point.values.scatter,
            "standard_error": point.values.standard_error,
            "realizations": len(point.values.values),
        }
        for point in points
    ]
    meta = {"PIPELINE": job.name, "ZONDA": job.version, "COMMAND": job.command}
    table = Table.of(rows, dict.fromkeys(axes, "value on this axis") | COLUMNS, meta)
    table.write(folder / "sweep.ecsv")
    with atomic_path(folder / "sweep.png") as temporary:
        draw(points).savefig(temporary, bbox_inches="tight")
    page = render("zonda.core", "sweep.html", title=job.name, head=table.head, rows=table.shown())
    write_text(folder / "sweep.html", page)


def collected(record: Record) -> list[Point]:
    """Figures at every point, figure by figure."""
    job = record.job
    found: dict[str, dict[tuple[Any, ...], list[tuple[str, float, float]]]] = {}
    for number, combination in enumerate(job.combinations):
        own = [a for a in combination.axes if a[0] not in ("realization", "observation")]
        source = combination.folder.partition("/")[0] if len(job.source) > 1 else ""
        place = (source, *((key, _text(value)) for key, value in own))
        for name, value, unit, error, _ in record.combined[number]:
            found.setdefault(name, {}).setdefault(place, []).append((unit, value, error))
    return [
        Point(
            dict(place[1:]),
            name,
            rows[0][0],
            Values(tuple(value for _, value, _ in rows), rows[0][2]),
        )
        for name, places in found.items()
        for place, rows in places.items()
    ]


def draw(points: Sequence[Point]) -> Any:
    """A matplotlib figure with a panel for each figure: mean and standard error (scatter, thin)
    against the first axis that changes; one line for each combination of the others."""
    names = list(dict.fromkeys(point.name for point in points))
    size = (6.4, 0.6 + 3.0 * len(names))
    axes = new_axes(size, nrows=len(names), squeeze=False, gridspec_kw={"hspace": 0.4})[:, 0]
    for ax, name in zip(axes, names, strict=True):
        _panel(ax, [point for point in points if point.name == name])
    return axes[0].figure


def _panel(ax: Any, points: Sequence[Point]) -> None:
    keys = list(dict.fromkeys(key for point in points for key in point.axes))
    changing = [k for k in keys if len({point.axes.get(k) for point in points}) > 1]
    first, others = (changing[0], changing[1:]) if changing else ("", [])
    places, unit, ticks = _positions([point.axes.get(first, "") for point in points])
    lines: dict[str, list[tuple[float, Values]]] = {}
    for place, point in zip(places, points, strict=True):
        name = ", ".join(f"{key}={point.axes.get(key, '')}" for key in others)
        lines.setdefault(name, []).append((place, point.values))
    for number, (name, line) in enumerate(lines.items()):
        line.sort(key=lambda item: item[0])
        colour, x = SEQUENCE[number % len(SEQUENCE)], [place for place, _ in line]
        mean, scatter, error = np.array([(v.mean, v.scatter, v.standard_error) for _, v in line]).T
        for size, style in ((scatter, {"lw": 0.7, "alpha": 0.6}), (error, {"lw": 2.2})):
            ax.vlines(x, mean - size, mean + size, colour, **style)
        ax.plot(x, mean, "o-", color=colour, ms=5, lw=1, label=name or None)
    if ticks:
        ax.set_xticks(range(len(ticks)), ticks)
    elif min(places) > 0 and max(places) / min(places) >= LOGARITHMIC:
        ax.set_xscale("log")
    ax.set_xlabel(f"{first} [{unit}]" if unit else first)
    ax.set_title(points[0].name, fontsize=9, loc="left")
    ax.set_ylabel(points[0].unit)
    ax.grid(True, color="#dddddd", lw=0.6)
    if len(lines) > 1:
        ax.legend(fontsize=7, frameon=False)


_QUANTITY = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(.*?)\s*$")


def _positions(values: Sequence[str]) -> tuple[list[float], str, list[str]]:
    """Places of values on an axis, the unit (that of the first), and the ticks where they are
    names.
    """
    found = [match.groups() for value in values if (match := _QUANTITY.match(value))]
    unit = found[0][1] if found else ""
    factors = [factor_to(unit, own) for _, own in found]
    if len(found) == len(values) and None not in factors:
        return [float(n) * (f or 0.0) for (n, _), f in zip(found, factors, strict=True)], unit, []
    names = list(dict.fromkeys(values))
    return [float(names.index(value)) for value in values], "", names


def _text(value: Any) -> str:
    return value if isinstance(value, str) else "" if value is None else json.dumps(value)
