"""Write docs/validation.md from docs/validation.ecsv, a stored claims.ecsv of `zonda validate`.

zonda validate --output out/validate
cp out/validate/claims.ecsv docs/validation.ecsv
python docs/make_validation.py
"""

from __future__ import annotations

import math
import re
from collections import Counter
from pathlib import Path
from typing import Any

from astropy.table import Table

STORED = Path(__file__).with_name("validation.ecsv")
PAGE = Path(__file__).with_name("validation.md")
LIMIT = 2.0
"""Distance up to which a claim agrees (`zonda.plugins.validation.claims.LIMIT`)."""
RUN = "from one run, 8 min on two busy cores"
"""The run that the table is from."""

HEAD = r"""# What the paper states, measured again

zonda follows van Marrewijk, Morris et al. 2024. `zonda validate` measures what that paper states: each row is a closed form,
or runs of a pipeline over seeds with a metric ([figures.md](figures.md)). One command runs all rows, and goes on where it was
interrupted:

```sh
zonda validate --output out/validate                 # claims.html, claims.ecsv, and a folder for each claim
zonda validate noise_shared --output out/validate    # one row
zonda validate --quick                               # closed forms and short runs
zonda validate --list
```

The verdicts are computed from the numbers. With the paper's value $p$, its error $e$ and the half width $r$ to which it is
stated, and $n$ realizations of mean $m$ and scatter $s$, the gap is

$$g = \max(0, |m - p| - r),$$

or what lies beyond a limit. Its distance is $g / \sqrt{e^2 + s^2}$ for one realization and $g / \sqrt{e^2 + s^2 / n}$ for the mean:
the first says whether the paper's figure is a likely realization, the second whether it is the expectation. A dash: they differ,
and no error is stated or found, as of closed forms.

| verdict | when |
|---|---|
| agrees | the distance is at most 2: of one realization, where the paper's figure is one; else of the mean |
| differs, explained | it is more, and counter-experiments that run, with stated criteria, show why: all of them are satisfied |
| the paper contradicts itself | other numbers of the paper exclude the value, whatever zonda finds |
| needs data we do not have | nothing can be run without them |
| differs | none of these. The exit status of `zonda validate` is then 1 |

The pipelines of these rows, and the shipped ones, state `AtmosphereLayers: {layer_response: column}`: in the paper a layer's water emits as
the column's does on average. With `layer`, the default elsewhere, the atmosphere fluctuates 10 % more at Green Bank and 6 % more at
Chajnantor ([physics.md](physics.md#atmosphere)).

Claims, pipelines and criteria stand in `pipelines/validation/claims.yaml`, whose head describes its keys. A file of one's own is
given with `--claims FILE`. A counter-experiment that changes nothing but seeds is refused.

## How far this can be trusted

- The criteria were not set in advance. The tolerances of values that the paper states as "about", the limits that counter-experiments
  must satisfy, and the choice of counter-experiments were written by people who had seen results of earlier runs. What the verdicts
  show is that the numbers and the reasons stated are those of the runs, and that they stay so; they are no blind test.
- What the paper does not state is our choice: the level of pink noise and the four fifths of it that detectors share (the noise of
  maps depends on both), PWV and time for AtLAST, regions and windows of figures, gaps between scans.
- The cluster is a synthetic one. Rows with that stand-in test the filters, not the paper's map.
- A row agrees more easily, the more its realizations scatter. The column "of the mean" is the stricter test.
- Limits (≥, ≤) agree with any value on their right side. Those of 0 or 1 state an order or a sense, no more.
"""

PICTURES = """## Pictures beside the paper's

The paper's figures are not part of this repository, so that they were compared by what their captions and text state, not side by
side. `zonda validate` draws these; each is in the folder of its row.

| what the paper shows | row and picture | what is worse in ours, or differs |
|---|---|---|
| emission and transmission with their lines | `emission_and_pwv/atmosphere.png` | ozone from one profile of a climatology; above 450 GHz all curves of the emission coincide, since Green Bank is opaque there |
| turbulent layers and the track through them | `contours_of_mock/screens_layers.png`, `screens_field.png` | the beam is too small to be seen in the high layers; no view in three dimensions |
| daisy and seconds per beam | `coverage_of_daisy/scan.png`, `coverage.png` | detectors' tracks show as threads at the rim |
| time streams | `contours_of_mock/tod.png` | total signal only; no real stream beside it |
| spectra with three regimes and closed forms | `slope_of_atmosphere/power_spectra.png`, `spectra_and_pwv`, `spectra_and_rms` | one picture for each PWV and rms, not one with all; steeper than the paper's $f^{-3}$ |
| input, noiseless filtered map and fidelity | `peak_of_cluster/comparison.png`, `comparison_quality.png` | another cluster, smaller; fidelity is ALMA's definition, as the paper's is not at hand |
| noise maps | `noise_shared/noise_map.png` | no real noise map beside it |
| radial spectra of noise maps | `noise_spectrum_small/map_spectra.png` | of one scan; no real map beside it; few modes above 2 arcmin |
| mock of 45 min with contours at -8, -4, -2, 2, 4 sigma | `contours_of_mock/map.png` | the contour at -8 sigma is a few pixels wide; islands of 2 sigma noise distract |
| transfer functions of MUSTANG-2 and AtLAST | `contours_of_mock/transfer_function.png`, `transfer_of_atlast/transfer_function.png` | in two pictures; a sky without power on small scales ends it at about 15 arcsec |
| first component of three apertures | `component_6m/values.png`, `component_42cm/values.png` | significances and differences, no histogram of the three |
| AtLAST's mock of 12 scans | `noise_of_atlast_12_scans/map.png` | 300 detectors stand for 3000 |
"""

FORMULAS = (
    (r"FWHM = D sqrt\(z\^-2 \+ z_r\^-2\)", r"$\\mathrm{FWHM} = D \\sqrt{z^{-2} + z_r^{-2}}$"),
    (
        r"\((1\.7) mK sqrt\(s\) / 148 uK\)\^2",
        r"$(1.7\\,\\mathrm{mK}\\sqrt{\\mathrm{s}} / 148\\,\\mathrm{µK})^2$",
    ),
    (r"pi \(6\.1 arcmin\)\^2", r"$\\pi\\,(6.1\\,\\mathrm{arcmin})^2$"),
    (r"2 k T nu\^2 / c\^2", r"$2 k T \\nu^2 / c^2$"),
    (r"lambda z / D\^2", r"$\\lambda z / D^2$"),
    (r"([\d.]+) lambda / D", r"$\1\\,\\lambda / D$"),
    (r"lambda / D", r"$\\lambda / D$"),
    (r"f-lambda", r"$f\\lambda$"),
    (r"D / z_r", r"$D / z_r$"),
    (r"T_scan", r"$T_\\mathrm{scan}$"),
    (r"mK sqrt\(s\)", r"mK√s"),
    (r"sqrt\(([^()]*)\)", r"$\\sqrt{\1}$"),
    (r"\bf\^(-[\d/]+)", r"$f^{\1}$"),
    (r"\bu(K|Jy)(?![A-Za-z0-9])", r"µ\1"),
    (r"arcmin2\b", "arcmin²"),
)
"""What claims write in plain text, and how the page writes it."""


def stored() -> Any:
    """The stored table; an empty text is one, not a missing value."""
    table = Table.read(STORED)
    return table.filled("") if table.masked or table.has_masked_columns else table


def page(table: Any) -> str:
    """The whole page."""
    counts = ", ".join(
        f"{verdict}: {number}"
        for verdict, number in Counter(map(str, table["verdict"])).most_common()
    )
    far = [
        str(row["id"])
        for row in table
        if row["verdict"] == "agrees" and row["distance_mean"] > LIMIT
    ]
    lines = [
        HEAD,
        "## The claims",
        "",
        f"{len(table)} rows with zonda {table.meta['zonda']}, {RUN}. {counts}.",
        "",
    ]
    if far:
        lines += [f"Likely as one realization, though not the expectation: {', '.join(far)}.", ""]
    lines += [
        "| claim | paper | zonda | scatter | of the mean | distance of one | of the mean |"
        " verdict |"
    ]
    lines += [
        "|---|---:|---:|---:|---:|---:|---:|---|",
        *map(_row, table),
        "",
        PICTURES,
        "## Why",
        "",
    ]
    lines += [
        f"**{row['id']}.** {_text(row['claim'])} {_text(row['remark'])}\n"
        for row in table
        if row["remark"]
    ]
    return "\n".join(lines).rstrip() + "\n"


def _row(row: Any) -> str:
    sign = {"equal": "", "at_least": "≥ ", "at_most": "≤ "}[row["relation"]]
    error = row["paper_error"] or row["paper_rounding"]
    paper = (
        f"{sign}{row['paper']:.4g}"
        + (f" ± {error:.2g}" if error else "")
        + f" {_text(row['unit'])}".rstrip()
    )
    known = not math.isnan(row["zonda"])
    cells = [
        f"{row['zonda']:.4g}",
        *(f"{row[k]:.2g}" if row["scatter"] else "" for k in ("scatter", "standard_error")),
    ]
    cells += [
        f"{row[key]:.2g}" if math.isfinite(row[key]) else "–"
        for key in ("distance_one", "distance_mean")
    ]
    return (
        f"| **{row['id']}** {_text(row['claim'])} | {paper} |"
        f" {' | '.join(cells if known else [''] * 5)} | {row['verdict']} |"
    )


def _text(text: str) -> str:
    """A text of the table as Markdown, its formulas for KaTeX."""
    text = str(text).replace("|", "\\|").replace("<", "&lt;")
    every = re.compile("|".join(f"(?:{plain})" for plain, _ in FORMULAS))
    return every.sub(_formula, text).replace("_RJ", "\\_RJ")


def _formula(found: re.Match[str]) -> str:
    """One of `FORMULAS` as the page writes it."""
    return next(
        re.sub(plain, written, found[0])
        for plain, written in FORMULAS
        if re.fullmatch(plain, found[0])
    )


if __name__ == "__main__":
    PAGE.write_text(page(stored()), encoding="utf-8")
