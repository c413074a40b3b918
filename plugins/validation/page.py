"""The table of claims: ``claims.html`` and ``claims.ecsv``, and for each claim a folder with its
values and a picture of them.
"""

from __future__ import annotations

import math
from collections import Counter as Count
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from zonda import __version__
from zonda.core.pages import render
from zonda.core.storage.ecsv import Column, write_ecsv
from zonda.core.storage.files import atomic_path, write_text

from .claims import ClaimsFile
from .figure import draw
from .rows import Row
from .runs import described
from .verdict import LIMIT, Values

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


def write(file: ClaimsFile, rows: Sequence[Row], folder: Path) -> None:
    """Write everything. Raises `OutputError`."""
    for row in rows:
        if row.values.values:
            own = folder / row.claim.id
            _write_values(row, own / "values.ecsv")
            with atomic_path(own / "values.png") as temporary:
                draw(row).savefig(temporary)
    meta = {"paper": file.paper, "zonda": __version__, "verdicts": summary(rows)}
    write_ecsv(folder / "claims.ecsv", list(_columns(rows)), meta)
    write_text(folder / "claims.html", _html(file, rows, folder))


def summary(rows: Sequence[Row]) -> str:
    """Numbers of claims by verdict: ``12 agree, 1 differs``."""
    return ", ".join(
        f"{verdict}: {number}"
        for verdict, number in Count(row.verdict.value for row in rows).most_common()
    )


def _columns(rows: Sequence[Row]) -> Iterator[Column]:
    """Numbers in the unit of the paper's value."""

    def number(name: str, of: str, about: str) -> Column:
        return Column(name, [_numbers(row)[of] for row in rows], "", about)

    yield Column("id", [row.claim.id for row in rows], "", "name of the claim, and of its folder")
    yield Column("section", [row.claim.section for row in rows], "", "where it stands in the paper")
    yield Column(
        "claim", [row.claim.claim for row in rows], "", "what the paper states, in our words"
    )
    yield Column(
        "unit",
        [row.claim.paper.unit for row in rows],
        "",
        "of all numbers but distances; empty: a pure number",
    )
    yield Column(
        "relation",
        [row.claim.relation for row in rows],
        "",
        "the value is equal to the paper's, or at least or at most it",
    )
    yield number("paper", "paper", "the paper's value")
    yield number("paper_error", "paper_error", "its standard error")
    yield number("paper_rounding", "paper_rounding", "half width to which it is stated")
    yield number("zonda", "zonda", "mean over realizations; nan: none was run")
    yield number("scatter", "scatter", "standard deviation of one realization")
    yield number("standard_error", "standard_error", "of the mean")
    yield Column(
        "realizations", [len(row.values.values) for row in rows], "", "number of realizations"
    )
    yield number("distance_one", "distance_one", "in standard deviations of one realization")
    yield number("distance_mean", "distance_mean", "in standard deviations of the mean")
    yield Column("verdict", [row.verdict.value for row in rows], "", "computed from the numbers")
    yield Column("remark", [remark(row) for row in rows], "", "why, and counter-experiments")


def _numbers(row: Row) -> dict[str, float]:
    claim, values = row.claim, row.values
    factor, nan = claim.paper.factor, float("nan")
    return {
        "paper": claim.paper.value / factor,
        "paper_error": claim.error.value / factor,
        "paper_rounding": claim.rounding.value / factor,
        "zonda": values.mean / factor,
        "scatter": values.scatter / factor if values.values else nan,
        "standard_error": values.standard_error / factor,
        "distance_one": row.comparison.of_one if row.comparison else nan,
        "distance_mean": row.comparison.of_mean if row.comparison else nan,
    }


def remark(row: Row) -> str:
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
        parts.append(
            f"{counter.shows}"
            f" ({found}{'' if counter.satisfied else ': its criterion is not satisfied'})."
        )
    return " ".join(filter(None, parts))


def stated(values: Values, factor: float, unit: str) -> str:
    """``164.5 ± 3.9 uK``: mean and its standard error, where there is one."""
    error = values.standard_error / factor
    text = f"{values.mean / factor:.4g}" + (f" ± {error:.2g}" if error > 0 else "")
    return f"{text} {unit}".rstrip()


def _write_values(row: Row, path: Path) -> None:
    """Each value of the claim and of its counter-experiments."""
    experiments = [
        ("", row.values, row.claim.paper),
        *((c.name, c.values, c.unit) for c in row.counters),
    ]
    names = [name for name, values, _ in experiments for _ in values.values]
    numbers = [float(k) for _, values, _ in experiments for k in range(len(values.values))]
    values = [v / unit.factor for _, found, unit in experiments for v in found.values]
    units = [unit.unit for _, found, unit in experiments for _ in found.values]
    columns = [
        Column("experiment", names, "", "name of the counter-experiment; empty: the claim itself"),
        Column("realization", numbers, "", "counted from 0"),
        Column("value", values, "", "in the unit of the next column"),
        Column("unit", units, "", "empty: a pure number"),
    ]
    write_ecsv(path, columns, {"claim": row.claim.id, "zonda": __version__})


def _html(file: ClaimsFile, rows: Sequence[Row], folder: Path) -> str:
    return render(
        __package__,
        "claims.html",
        title=file.paper,
        version=__version__,
        summary=summary(rows),
        rule=RULE,
        head=HEAD,
        colours=COLOURS,
        claims=[_claim(row, folder) for row in rows],
    )


def _claim(row: Row, folder: Path) -> dict[str, Any]:
    """Values of one claim for the page: sentences, numbers, experiments, pictures."""
    claim = row.claim
    images = sorted((folder / claim.id).glob("*.png"), key=lambda path: path.name != "values.png")
    return {
        "id": claim.id,
        "states": claim.claim,
        "section": claim.section,
        "verdict": row.verdict.value,
        "numbers": _cells(row),
        "remark": remark(row),
        "experiments": [
            (name or "the claim", ", ".join(described(experiment)))
            for name, experiment in claim.experiments()
        ],
        "pictures": [(image.name, image.stem.replace("_", " ")) for image in images],
    }


def _cells(row: Row) -> list[str]:
    """Cells of the numbers of one claim: the paper's, zonda's, and the distances between them."""
    claim, n = row.claim, _numbers(row)
    sign = {"equal": "", "at_least": "≥ ", "at_most": "≤ "}[claim.relation]
    error = n["paper_error"] or n["paper_rounding"]
    paper = (
        f"{sign}{n['paper']:.4g}"
        + (f" ± {error:.2g}" if error else "")
        + f" {claim.paper.unit}".rstrip()
    )
    found = [
        f"{n[key]:.{digits}g}"
        for key, digits in (("zonda", 4), ("scatter", 2), ("standard_error", 2))
    ]
    if not n["scatter"]:
        found[1:] = ["", ""]
    shown = (
        [*found, *(distance_text(n[key]) for key in ("distance_one", "distance_mean"))]
        if row.values.values
        else [""] * 5
    )
    return [paper, *shown]


def distance_text(distance: float) -> str:
    """Standard deviations; a dash where the values differ and nothing has an error."""
    return f"{distance:.2g}" if math.isfinite(distance) else "–"
