"""Write docs/stability.md from the checks' own output: python docs/make_stability.py (a test holds the two together)."""

from __future__ import annotations

import re
from pathlib import Path

from zonda.core.checks import Check, Result, measure, registered
from zonda.plugins.checks.cases import MATRIX

PAGE = Path(__file__).with_name("stability.md")

HEAD = """# The hard cases

What the arithmetic reaches where naive code fails: one table for each row of the stability matrix, made by
`docs/make_stability.py` from the checks in `plugins/checks/`, which are also the tests (`tests/test_hard_cases.py`) and what
`zonda doctor` runs on your machine (those marked *quick*; `--all` for all). Covariances are *implied* ones, computed from the
algorithm's weights, not sampled. A limit of 0 means exactly. Figures vary a little from CPU to CPU.

A package adds checks of its own under the entry-point group `zonda.checks` (see `core/checks.py`). That the safeguards are
needed is shown by `tests/test_mutations.py`, which breaks them one at a time and finds a check that fails.
"""


def page(results: list[Result]) -> str:
    """The whole page."""
    lines = [HEAD]
    for case in MATRIX:
        lines += [f"## {_text(case.text)}", "", f"Accepted: {_text(case.acceptance)}.", ""]
        lines += ["| check | reference | limit | reached | |", "|---|---|---|---|---|"]
        lines += [_row(r) for r in results if r.check.case is case] + [""]
    return "\n".join(lines)


def published() -> list[Check]:
    """The checks of the matrix, in the order of its rows."""
    return [check for case in MATRIX for check in registered() if check.case is case]


def rows(text: str) -> dict[str, tuple[str, str, str, str]]:
    """By name: what, reference, limit and figure of a page."""
    found = {}
    for line in text.splitlines():
        if match := re.match(r"\| `(\S+)`: (.*) \| (.*) \| (.*) \| (.*) \| .*\|$", line):
            name, *cells = match.groups()
            found[name] = tuple(cells)
    return found


def _row(result: Result) -> str:
    check = result.check
    marks = " ".join(part for part in ("quick" if check.quick else "", result.remark and f"({_text(result.remark)})") if part)
    return f"| `{check.name}`: {_text(check.what)} | {_text(check.reference)} | {result.accepted} | {result.reached} | {marks} |"


def _text(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    PAGE.write_text(page(list(measure(published()))), encoding="utf-8")
