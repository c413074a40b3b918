"""The table of claims: ``claims.html`` and ``claims.ecsv``, and for each claim a folder with its
values and a picture of them.
"""

from __future__ import annotations

import math
from collections import Counter as Count
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from zonda import __version__
from zonda.core.experiment.experiment import Values
from zonda.core.storage.files import atomic_path, write_text
from zonda.core.tables import Table, render

from .claims import ClaimsFile
from .figure import draw
from .rows import Row
from .verdict import LIMIT

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
    claim, values, comparison = row.claim, row.values, row.comparison
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
