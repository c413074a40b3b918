"""The table of claims: ``claims.html`` and ``claims.ecsv``, and for each claim a folder with its
values and a picture of them: the paper's value, zonda's realizations and mean, and the
counter-experiments below them.
"""

from __future__ import annotations

import math
from collections import Counter as Count
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zonda import __version__
from zonda.core.experiment.experiment import Values
from zonda.core.storage.files import atomic_path, write_text
from zonda.core.tables import Table, render

from .claims import LIMIT, ClaimsFile
from .rows import CounterResult, Row

if TYPE_CHECKING:
    from matplotlib.figure import Figure

LINE = 0.42
"""Height of a line, in."""
OWN, GOOD, BAD = "#0072B2", "#009E73", "#b3261e"
"""Colours of the claim, and of counter-experiments that satisfy their criterion or do not."""


def draw(row: Row) -> Figure:
    """Draw a claim: the paper's value, zonda's values and the counter-experiments. Those of another
    quantity or unit than the claim's have axes of their own below.
    """
    from matplotlib.figure import Figure

    claim = row.claim
    paper = row.claim.paper
    beside = [_line(c) for c in row.counters if c.comparable]
    own = ([("zonda", row.values, OWN), *beside], paper.factor, paper.unit or claim.statistic)
    panels = [own]
    for name, alike in groupby((c for c in row.counters if not c.comparable), _axis):
        found = list(alike)
        panels.append((list(map(_line, found)), found[0].unit.factor, name))
    heights = [(0.6 if k else 1.3) + LINE * len(lines) for k, (lines, _, _) in enumerate(panels)]
    figure = Figure(figsize=(6.4, sum(heights)), dpi=110, layout="constrained")
    axes = figure.subplots(len(heights), squeeze=False, height_ratios=heights)[:, 0]
    value = paper.value / paper.factor
    half = claim.rounding.value + claim.error.value
    sign = {"equal": "", "at_least": "at least ", "at_most": "at most "}[claim.relation]
    if half:
        span = value - half / paper.factor, value + half / paper.factor
        axes[0].axvspan(*span, color="#E69F00", alpha=0.25, lw=0)
    label = f"paper: {sign}{value:.4g} {paper.unit}".rstrip()
    axes[0].axvline(value, color="#D55E00", lw=1.5, label=label)
    for ax, panel in zip(axes, panels, strict=True):
        _draw_lines(ax, *panel)
    axes[0].legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def _draw_lines(
    ax: Any,
    lines: Sequence[tuple[str, Values, str]],
    factor: float,
    across: str | None,
) -> None:
    """A line for each result: realizations as strokes, their mean with its standard error."""
    for k, (_, values, colour) in enumerate(lines):
        numbers = [v / factor for v in values.values]
        if len(numbers) > 1:
            ax.plot(numbers, [-k - 0.18] * len(numbers), "|", color=colour, ms=8, alpha=0.6)
        error = values.standard_error / factor or None
        mean = values.mean / factor
        ax.errorbar(mean, -k, xerr=error, fmt="o", color=colour, ms=6, capsize=3)
    ax.set_yticks([-k for k in range(len(lines))], [name for name, _, _ in lines])
    ax.set_ylim(-len(lines) + 0.4, 0.6)
    ax.set_xlabel(across or "value")
    ax.ticklabel_format(axis="x", useOffset=False)
    ax.grid(True, axis="x", color="#dddddd", lw=0.6)
    ax.margins(x=0.08)


def _axis(counter: CounterResult) -> str:
    """Name of its values, with their unit."""
    unit = counter.unit.unit
    what = counter.experiment.statistic or "value"
    return f"{what} [{unit}]" if unit else what


def _line(counter: CounterResult) -> tuple[str, Values, str]:
    """Name, values and colour of its line."""
    colour = GOOD if counter.satisfied else BAD
    return counter.name.replace("_", " "), counter.values, colour


COLOURS = {"agrees": "#1a7f4b", "differs, explained": "#0b5c8f", "differs": "#b3261e"}

HEAD = (
    "claim",
    "paper",
    "zonda",
    "scatter",
    "of the mean",
    "distance of one",
    "of the mean",
    "verdict",
)

RULE = (
    "Distances are in standard deviations: of one realization, and of the mean over seeds; the"
    " paper's own error is included. A dash: they differ, and no error is stated or found. A claim"
    f" agrees within {LIMIT:g}. A difference is explained where every counter-experiment satisfies"
    " its criterion."
)

COLUMNS = {
    "id": "name of the claim, and of its folder",
    "section": "where it stands in the paper",
    "claim": "what the paper states, in our words",
    "unit": "of all numbers but distances; empty: a pure number",
    "relation": "the value is equal to the paper's, or at least or at most it",
    "paper": "the paper's value",
    "paper_error": "its standard error",
    "paper_rounding": "half width to which it is stated",
    "zonda": "mean over realizations; nan: none was run",
    "scatter": "standard deviation of one realization",
    "standard_error": "of the mean",
    "realizations": "number of realizations",
    "distance_one": "in standard deviations of one realization",
    "distance_mean": "in standard deviations of the mean",
    "verdict": "computed from the numbers",
    "remark": "why, and counter-experiments",
}
VALUES = {
    "experiment": "name of the counter-experiment; empty: the claim itself",
    "realization": "counted from 0",
    "value": "in the unit of the next column",
    "unit": "empty: a pure number",
}


def write(file: ClaimsFile, rows: Sequence[Row], folder: Path) -> None:
    """Write everything. Raises `OutputError`."""
    records = [_record(row) for row in rows]
    for row in rows:
        if row.values.values:
            found = [("", row.values, row.claim.paper)]
            found += [(c.name, c.values, c.unit) for c in row.counters]
            values = [
                dict(zip(VALUES, (name, float(k), value / unit.factor, unit.unit), strict=True))
                for name, several, unit in found
                for k, value in enumerate(several.values)
            ]
            meta = {"claim": row.claim.id, "zonda": __version__}
            Table.of(values, VALUES, meta).write(folder / row.claim.id / "values.ecsv")
            with atomic_path(folder / row.claim.id / "values.png") as temporary:
                draw(row).savefig(temporary)
    meta = {"paper": file.paper, "zonda": __version__, "verdicts": summary(rows)}
    Table.of(records, COLUMNS, meta).write(folder / "claims.ecsv")
    page = render(
        __package__,
        "claims.html",
        title=file.paper,
        version=__version__,
        summary=summary(rows),
        rule=RULE,
        head=HEAD,
        colours=COLOURS,
        claims=[
            {
                **record,
                "numbers": _cells(record),
                "experiments": [(n or "the claim", str(e)) for n, e in row.claim.experiments()],
                "pictures": sorted(
                    (
                        (image.name, image.stem.replace("_", " "))
                        for image in (folder / row.claim.id).glob("*.png")
                    ),
                    key=lambda picture: (picture[0] != "values.png", picture),
                ),
            }
            for row, record in zip(rows, records, strict=True)
        ],
    )
    write_text(folder / "claims.html", page)


def summary(rows: Sequence[Row]) -> str:
    """Numbers of claims by verdict: ``12 agree, 1 differs``."""
    found = Count(row.verdict.value for row in rows).most_common()
    return ", ".join(f"{verdict}: {number}" for verdict, number in found)


def _record(row: Row) -> dict[str, Any]:
    """Values of `COLUMNS`; numbers in the unit of the paper's value."""
    claim = row.claim
    values = row.values
    comparison = row.comparison
    factor = claim.paper.factor
    return {
        "id": claim.id,
        "section": claim.section,
        "claim": claim.claim,
        "unit": claim.paper.unit,
        "relation": claim.relation,
        "paper": claim.paper.value / factor,
        "paper_error": claim.error.value / factor,
        "paper_rounding": claim.rounding.value / factor,
        "zonda": values.mean / factor,
        "scatter": values.scatter / factor if values.values else math.nan,
        "standard_error": values.standard_error / factor,
        "realizations": len(values.values),
        "distance_one": comparison.of_one if comparison else math.nan,
        "distance_mean": comparison.of_mean if comparison else math.nan,
        "verdict": row.verdict.value,
        "remark": _remark(row),
    }


def _remark(row: Row) -> str:
    """Why, what data are missing or stand in, what contradicts, and what the counter-experiments
    found: sentences.
    """
    claim = row.claim
    parts = [
        claim.note,
        f"Needs {claim.needs}." if claim.needs else "",
        f"Stand-in: {claim.stand_in}." if claim.stand_in else "",
    ]
    if claim.contradiction is not None:
        other = claim.paper.write(claim.contradiction.calculate.value)
        parts.append(f"{claim.contradiction.says} ({other} {claim.paper.unit})".rstrip(" )") + ").")
    parts.append(claim.because)
    for counter in row.counters:
        found = stated(counter.values, counter.unit.factor, counter.unit.unit)
        fails = "" if counter.satisfied else ": its criterion is not satisfied"
        parts.append(f"{counter.shows} ({found}{fails}).")
    return " ".join(filter(None, parts))


def stated(values: Values, factor: float, unit: str) -> str:
    """``164.5 ± 3.9 uK``: mean and its standard error, where there is one."""
    error = values.standard_error / factor
    text = f"{values.mean / factor:.4g}" + (f" ± {error:.2g}" if error > 0 else "")
    return f"{text} {unit}".rstrip()


def _cells(record: dict[str, Any]) -> list[str]:
    """Cells of the numbers of one claim: the paper's, zonda's, and the distances between them, with
    a dash where the values differ and nothing has an error.
    """
    sign = {"equal": "", "at_least": "≥ ", "at_most": "≤ "}[record["relation"]]
    error = record["paper_error"] or record["paper_rounding"]
    paper = f"{sign}{record['paper']:.4g}" + (f" ± {error:.2g}" if error else "")
    cells = [f"{paper} {record['unit']}".rstrip()]
    if not record["realizations"]:
        return cells + [""] * 5
    scatters = (record[key] for key in ("scatter", "standard_error"))
    distances = (record[key] for key in ("distance_one", "distance_mean"))
    return [
        *cells,
        f"{record['zonda']:.4g}",
        *(f"{value:.2g}" if record["scatter"] else "" for value in scatters),
        *(f"{value:.2g}" if math.isfinite(value) else "–" for value in distances),
    ]
