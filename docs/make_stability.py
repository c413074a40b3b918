"""Write docs/stability.md from the output of the checks: python docs/make_stability.py (a test
compares the two).
"""

from __future__ import annotations

import re
import sys
from pathlib import Path

from zonda.core.checks import Result, measure, registered

sys.path.insert(0, str(Path(__file__).parents[1]))
from tests.checks import matrix
from tests.checks.cases import MATRIX

PAGE = Path(__file__).with_name("stability.md")
DOCTOR = {check.name for check in registered()}

HEAD = """# Numerical stability

The numerical accuracy that zonda reaches in cases where naive code fails: one table per case. `docs/make_stability.py` makes this
page from the checks of `zonda doctor` (`plugins/checks/`) and those in `tests/checks/`; `tests/test_hard_cases.py` runs them
all. `zonda doctor` repeats those marked *in doctor* on your machine, in about half a minute. Covariances are the *implied*
ones, computed from the weights of the algorithm, not sampled. A limit of 0 means exact. Figures vary a little from CPU to CPU.

Packages add checks of their own under the entry-point group `zonda.checks` (see `core/checks.py`). `tests/test_mutations.py`
breaks the safeguards one at a time and verifies that a check fails.
"""


def page(results: list[Result]) -> str:
    """The whole page."""
    lines = [HEAD]
    for case in MATRIX:
        lines += [f"## {_text(case.text)}", "", f"Accepted: {_text(case.acceptance)}.", ""]
        lines += [
            "| check | reference | limit | reached | in doctor | remark |",
            "|---|---|---|---|---|---|",
        ]
        lines += [_row(r) for r in results if r.check.case is case] + [""]
    return "\n".join(lines)


def rows(text: str) -> dict[str, tuple[str, str, str, str]]:
    """By name: what, reference, limit and figure of a page."""
    found = {}
    for line in text.splitlines():
        if match := re.match(r"\| `(\S+)`: (.*) \| (.*) \| (.*) \| (.*) \| .* \| .*\|$", line):
            name, *cells = match.groups()
            found[name] = tuple(cells)
    return found


def _row(result: Result) -> str:
    check = result.check
    cells = [
        f"`{check.name}`: {_text(check.what)}",
        _text(check.reference),
        result.accepted,
        result.reached,
    ]
    return (
        f"| {' | '.join(cells)} | {'yes' if check.name in DOCTOR else ''} |"
        f" {_text(result.remark)} |"
    )


def _text(text: str) -> str:
    return text.replace("|", "\\|").replace("<", "&lt;")


if __name__ == "__main__":
    PAGE.write_text(page(list(measure(matrix()))), encoding="utf-8")
