"""The figures of all sets of products of a campaign as one table: ``sweep.ecsv``, ``sweep.html``
and ``sweep.png``.

At each point of the axes a figure has n values over realizations: their mean, their scatter s, and
s / sqrt(n), the standard error of the mean.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ..configuration.units import factor_to
from ..figures import Figure
from ..pages import render
from ..storage.ecsv import Column
from ..storage.files import atomic_path, write_text
from ..tables import Table

if TYPE_CHECKING:
    from .folder import Record

LOGARITHMIC = 8.0
"""Ratio of the largest to the smallest swept value from which the axis is logarithmic."""


@dataclass(frozen=True)
class Point:
    """A figure at one point of the axes: values and their errors over realizations, (n,)."""

    axes: tuple[tuple[str, Any], ...]
    name: str
    unit: str
    values: tuple[float, ...]
    errors: tuple[float, ...]

    @property
    def mean(self) -> float:
        """Mean over the realizations."""
        return float(np.mean(self.values))

    @property
    def scatter(self) -> float:
        """Standard deviation of one realization; of a single one the error that its metric states,
        NaN: not known.
        """
        return float(np.std(self.values, ddof=1)) if len(self.values) > 1 else self.errors[0]

    @property
    def standard_error(self) -> float:
        """Standard error of the mean."""
        return self.scatter / math.sqrt(len(self.values))


def write(record: Record) -> None:
    """Write the table of a campaign whose combinations are all finished."""
    job, folder, points = record.job, record.folder, collected(record)
    axes = list(dict.fromkeys(key for point in points for key, _ in point.axes))
    columns = [
        Column(key, [_text(dict(p.axes).get(key)) for p in points], "", "value on this axis")
        for key in axes
    ]
    columns += [
        Column("figure", [p.name for p in points], "", "metric and parameters"),
        Column(
            "unit",
            [p.unit for p in points],
            "",
            "of mean, scatter and standard_error; empty: a pure number",
        ),
        Column("mean", [p.mean for p in points], "", "over realizations"),
        Column(
            "scatter",
            [p.scatter for p in points],
            "",
            "standard deviation of one realization; nan: not known",
        ),
        Column(
            "standard_error", [p.standard_error for p in points], "", "of the mean; nan: not known"
        ),
        Column("realizations", [len(p.values) for p in points], "", "number of realizations"),
    ]
    about = {"PIPELINE": job.name, "ZONDA": job.version, "COMMAND": job.command}
    table = Table(columns, about)
    table.write(folder / "sweep.ecsv")
    with atomic_path(folder / "sweep.png") as temporary:
        draw(points).savefig(temporary)
    page = render("zonda.core", "sweep.html", title=job.name, head=table.head, rows=table.shown())
    write_text(folder / "sweep.html", page)


def collected(record: Record) -> list[Point]:
    """Figures at every point, figure by figure."""
    job = record.job
    found: dict[tuple[str, str], tuple[tuple[tuple[str, Any], ...], list[Figure]]] = {}
    for number, combination in enumerate(job.combinations):
        axes = tuple(
            (key, value)
            for key, value in combination.axes
            if key not in ("realization", "observation")
        )
        place = json.dumps(
            [
                [
                    combination.folder.partition("/")[0] if len(job.source) > 1 else "",
                    *map(list, axes),
                ]
            ]
        )
        for figure in (Figure(*row) for row in record.combined[number]):
            found.setdefault((figure.name, place), (axes, []))[1].append(figure)
    order = list(dict.fromkeys(name for name, _ in found))
    points = [
        Point(
            axes,
            name,
            figures[0].unit,
            tuple(f.value for f in figures),
            tuple(f.error for f in figures),
        )
        for (name, _), (axes, figures) in found.items()
    ]
    return sorted(points, key=lambda point: order.index(point.name))


def draw(points: Sequence[Point]) -> Any:
    """A matplotlib figure with a panel for each figure: mean and standard error (scatter, thin)
    against the first axis that changes; one line for each combination of the others."""
    from matplotlib.figure import Figure as Canvas

    names = list(dict.fromkeys(point.name for point in points))
    canvas = Canvas(figsize=(6.4, 0.6 + 3.0 * len(names)), dpi=110, layout="constrained")
    for ax, name in zip(canvas.subplots(len(names), 1, squeeze=False)[:, 0], names, strict=True):
        _panel(ax, [point for point in points if point.name == name])
    return canvas


def _panel(ax: Any, points: Sequence[Point]) -> None:
    keys = list(dict.fromkeys(key for point in points for key, _ in point.axes))
    changing = [k for k in keys if len({_text(dict(p.axes).get(k)) for p in points}) > 1]
    first, others = (changing[0], changing[1:]) if changing else ("", [])
    places, label, ticks = _positions([dict(p.axes).get(first) for p in points])
    lines: dict[str, list[tuple[float, Point]]] = {}
    for place, point in zip(places, points, strict=True):
        lines.setdefault(
            ", ".join(f"{k}={_text(dict(point.axes).get(k))}" for k in others), []
        ).append((place, point))
    for number, (name, line) in enumerate(lines.items()):
        line.sort(key=lambda item: item[0])
        x, y = [x for x, _ in line], [p.mean for _, p in line]
        colour = f"C{number % 10}"
        _bars(ax, x, y, [p.scatter for _, p in line], colour, lw=0.7, alpha=0.6)
        _bars(ax, x, y, [p.standard_error for _, p in line], colour, lw=2.2)
        ax.plot(x, y, "o-", color=colour, ms=5, lw=1, label=name or None)
    if ticks:
        ax.set_xticks(range(len(ticks)), ticks)
    elif min(places) > 0 and max(places) / min(places) >= LOGARITHMIC:
        ax.set_xscale("log")
    ax.set_xlabel(f"{first} [{label}]" if label else first)
    ax.set_title(points[0].name, fontsize=9, loc="left")
    ax.set_ylabel(points[0].unit)
    ax.grid(True, color="#dddddd", lw=0.6)
    if len(lines) > 1:
        ax.legend(fontsize=7, frameon=False)


def _bars(
    ax: Any,
    x: Sequence[float],
    y: Sequence[float],
    sizes: Sequence[float],
    colour: str,
    **style: Any,
) -> None:
    known = [k for k, size in enumerate(sizes) if math.isfinite(size)]
    if known:
        ax.vlines(
            [x[k] for k in known],
            [y[k] - sizes[k] for k in known],
            [y[k] + sizes[k] for k in known],
            colour,
            **style,
        )


_QUANTITY = re.compile(r"\s*([-+]?[\d.]+(?:[eE][-+]?\d+)?)\s*(.*?)\s*$")


def _positions(values: Sequence[Any]) -> tuple[list[float], str, list[str]]:
    """Places of values on an axis, the unit (that of the first), and the ticks where they are
    names.
    """
    matches = [_QUANTITY.match(_text(value)) for value in values]
    units = [match[2] if match else None for match in matches]
    factors = [None if unit is None else factor_to(units[0] or "", unit) for unit in units]
    if matches and None not in factors:
        numbers = [
            float(match[1]) * factor
            for match, factor in zip(matches, factors, strict=True)
            if match and factor
        ]
        return numbers, units[0] or "", []
    names = list(dict.fromkeys(map(_text, values)))
    return [float(names.index(_text(value))) for value in values], "", names


def _text(value: Any) -> str:
    return value if isinstance(value, str) else "" if value is None else json.dumps(value)
