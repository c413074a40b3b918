"""Each operator has a test of each of its parameters, beside its other tests."""

from __future__ import annotations

from importlib import import_module
from pathlib import Path

import pytest

import zonda
from zonda.core.errors import ZondaError
from zonda.core.registry import operators

from .parameters import Step, outcome, scene

FOLDERS = sorted(path.parent.name for path in Path(__file__).parent.glob("*/test_parameters.py"))
STEPS: dict[str, Step] = {
    step.name: step
    for folder in FOLDERS
    for step in import_module(f"..{folder}.test_parameters", __name__).STEPS
}
NEED_OTHERS = {"ToastOperator", "PySMSky"}
"""Steps that need packages which are not installed with the tests; tests/interop and
sky/test_pysm.py have them.
"""


def test_no_operator_and_no_parameter_is_left_out() -> None:
    own = {c.name: operators for c in operators.candidates() if c.distribution == "zonda"}
    assert set(own) == set(STEPS) | NEED_OTHERS
    for name, registry in own.items():
        if name not in NEED_OTHERS:
            fields = set(registry.get(name).model_fields) - {"name"}
            assert fields == set(STEPS[name].changes), name


@pytest.mark.parametrize("name", sorted(STEPS))
def test_the_name_of_a_step_is_its_label(name: str, maps: Path) -> None:
    given = STEPS[name].pipeline(maps, name="mine")
    assert "mine" in [step.label for step in zonda.Pipeline(given).operators]


def test_a_scan_that_is_not_there_cannot_be_shown(maps: Path, tmp_path: Path) -> None:
    with pytest.raises(ZondaError, match="observation"):
        outcome(STEPS["TimeStreams"].pipeline(maps, observation=7), scene(), tmp_path)
