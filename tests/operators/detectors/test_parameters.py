"""Each parameter of the detectors operators changes what a run makes, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ..parameters import Step, cases

STEPS = (
    Step(
        "Glitches",
        given={"rate": "0.5 Hz"},
        changes={
            "rate": ({}, {"rate": "1 Hz"}),
            "amplitude": ({}, {"amplitude": "1 K"}),
            "decay": ({}, {"decay": "50 ms"}),
            "flag_above": ({}, {"flag_above": "1 mK"}),
        },
    ),
    Step(
        "GainDrift",
        chain=("WhiteNoise", "Efficiency", "GainDrift"),
        given={"fastest": "0.5 Hz"},
        changes={
            "rms": ({}, {"rms": "1 %"}),
            "slope": ({}, {"slope": 1.0}),
            "fastest": ({}, {"fastest": "1 Hz"}),
        },
    ),
    Step(
        "TimeConstant",
        chain=("WhiteNoise", "Efficiency", "TimeConstant"),
        changes={"tau": ({}, {"tau": "20 ms"}), "scatter": ({}, {"scatter": "10 %"})},
    ),
    Step(
        "Crosstalk",
        chain=("WhiteNoise", "Efficiency", "Crosstalk"),
        changes={"level": ({}, {"level": "1 %"}), "file": ({}, {"file": "shares.csv"})},
    ),
)


@pytest.mark.parametrize(("step", "field"), cases(STEPS))
def test_each_parameter_has_an_effect(
    step: Step, field: str, maps: Path, tmp_path: Path, known: dict[str, Any]
) -> None:
    step.check(field, maps, tmp_path, known)
