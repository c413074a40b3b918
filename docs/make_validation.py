"""Write docs/validation.md from docs/validation.ecsv, a stored claims.ecsv of `zonda validate`.

zonda validate --output out/validate
cp out/validate/claims.ecsv docs/validation.ecsv
python docs/make_validation.py
"""

from __future__ import annotations

import math
from collections import Counter
from pathlib import Path
from typing import Any

from astropy.table import Table

STORED = Path(__file__).with_name("validation.ecsv")
PAGE = Path(__file__).with_name("validation.md")

HEAD = """# What the paper states, measured again

zonda follows van Marrewijk, Morris et al. 2024. `zonda validate` measures what that paper states: each row is a closed form,
or runs of a pipeline over seeds with a metric ([figures.md](figures.md)). One command runs all rows, and goes on where it was
interrupted:

```sh
zonda validate --output out/validate                 # claims.html, claims.ecsv, and a folder for each claim
zonda validate noise_shared --output out/validate    # one row
zonda validate --quick                               # closed forms and short runs
zonda validate --list
```

The verdicts are computed from the numbers. With the paper's value p, its error e and the half width r to which it is stated,
and n realizations of mean m and scatter s, the gap is max(0, |m - p| - r), or what lies beyond a limit. Its distance is
gap / √(e² + s²) for one realization and gap / √(e² + s²/n) for the mean: the first says whether the paper's figure is a
likely realization, the second whether it is the expectation. A dash: they differ, and no error is stated or found, as of closed
forms.

| verdict | when |
|---|---|
| agrees | the distance is at most 2: of one realization, where the paper's figure is one; else of the mean |
| differs, explained | it is more, and counter-experiments that run, with stated criteria, show why: all of them are satisfied |
| the paper contradicts itself | other numbers of the paper exclude the value |
| needs data we do not have | nothing can be run without them |
| differs | none of these. The exit status of `zonda validate` is then 1 |

Claims, pipelines and criteria stand in `pipelines/validation/claims.yaml`, whose head describes its keys. A file of one's own is
given with `--claims FILE`.
"""


def stored() -> Any:
    """The stored table; an empty text is one, not a missing value."""
    table = Table.read(STORED)
    return table.filled("") if table.masked or table.has_masked_columns else table


def page(table: Any) -> str:
    """The whole page."""
    counts = ", ".join(f"{verdict}: {number}" for verdict, number in Counter(map(str, table["verdict"])).most_common())
    lines = [HEAD, "## The claims", "", f"{len(table)} rows with zonda {table.meta['zonda']}. {counts}.", ""]
    lines += ["| claim | paper | zonda | scatter | of the mean | distance of one | of the mean | verdict |"]
    lines += ["|---|---:|---:|---:|---:|---:|---:|---|", *map(_row, table), "", "## Why", ""]
    lines += [f"**{row['id']}.** {_text(row['claim'])} {_text(row['remark'])}\n" for row in table if row["remark"]]
    return "\n".join(lines).rstrip() + "\n"


def _row(row: Any) -> str:
    sign = {"equal": "", "at_least": "≥ ", "at_most": "≤ "}[row["relation"]]
    error = row["paper_error"] or row["paper_rounding"]
    paper = f"{sign}{row['paper']:.4g}" + (f" ± {error:.2g}" if error else "") + f" {row['unit']}".rstrip()
    known = not math.isnan(row["zonda"])
    cells = [f"{row['zonda']:.4g}", *(f"{row[k]:.2g}" if row["scatter"] else "" for k in ("scatter", "standard_error"))]
    cells += [f"{row[key]:.2g}" if math.isfinite(row[key]) else "–" for key in ("distance_one", "distance_mean")]
    return f"| **{row['id']}** {_text(row['claim'])} | {paper} | {' | '.join(cells if known else [''] * 5)} | {row['verdict']} |"


def _text(text: str) -> str:
    return str(text).replace("|", "\\|").replace("<", "&lt;").replace("_RJ", "\\_RJ")


if __name__ == "__main__":
    PAGE.write_text(page(stored()), encoding="utf-8")
