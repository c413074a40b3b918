"""The structure of the product stays within limits; `benchmarks/structure.py --verbose` says what
each figure consists of.
"""

from __future__ import annotations

import runpy
from functools import cache
from pathlib import Path
from typing import Any

import pytest

SCRIPT = Path(__file__).resolve().parents[1] / "benchmarks" / "structure.py"

# figure: largest value allowed. A limit is only ever lowered; what the design aims at is behind it.
LIMITS = {
    "methods and properties of Operator": 10,
    "class attributes of Operator": 7,
    "modules in the largest circle of imports": 0,
    "imports between siblings of operators": 0,
    "upward imports": 0,
    "operators that core names": 0,
    "lines of framework hooks in BinMap": 7,
}

pytestmark = pytest.mark.skipif(not SCRIPT.exists(), reason="benchmarks are not in this copy")


@cache
def structure() -> dict[str, Any]:
    return runpy.run_path(str(SCRIPT))


@cache
def figures() -> dict[str, Any]:
    return structure()["measure"]()


@pytest.mark.parametrize("name", LIMITS)
def test_within_its_limit(name: str) -> None:
    figure = figures()[name]
    assert figure.value <= LIMITS[name], f"{name}: {figure.value}\n" + "\n".join(figure.items)


def test_an_import_inside_a_function_closes_a_circle() -> None:
    edges = {"a": {"b"}, "b": {"c"}, "c": {"a", "d"}, "d": set(), "e": {"f"}, "f": {"e"}}
    assert structure()["circles"](edges) == [["a", "b", "c"], ["e", "f"]]


def test_lazy_and_relative_imports_count(tmp_path: Path) -> None:
    core = tmp_path / "core" / "run"
    core.mkdir(parents=True)
    (tmp_path / "core" / "__init__.py").write_text("")
    (core / "__init__.py").write_text("")
    (tmp_path / "core" / "one.py").write_text("def f():\n    from .run import two\n")
    (core / "two.py").write_text(
        "if TYPE_CHECKING:\n    from ..one import f\nimport zonda.core.one\nimport numpy\n"
    )
    measured = structure()
    edges = measured["imports"](measured["modules"](tmp_path))
    assert edges["core.one"] == {"core.run.two"}
    assert edges["core.run.two"] == {"core.one"}
