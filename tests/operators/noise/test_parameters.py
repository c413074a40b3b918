"""Each parameter of the noise operators changes what a run makes, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from zonda.core.errors import ZondaError

from ..parameters import Step, cases, ignored

STEPS = (
    Step(
        "WhiteNoise",
        ignored=({"model": "background_limited", "net": "1 mK s(1/2)"}, {"reference": "detector"}),
        changes={
            "net": ({}, {"net": "1 mK s(1/2)"}),
            "reference": ({"net": "1 mK s(1/2)"}, {"reference": "detector"}),
            "scatter": ({}, {"scatter": 0.1}),
            "model": ({}, {"model": "background_limited"}),
        },
    ),
    Step(
        "PinkNoise",
        ignored=({"reference": "detector"},),
        changes={
            "net": ({}, {"net": "1 mK s(1/2)"}),
            "reference": ({"net": "1 mK s(1/2)"}, {"reference": "detector"}),
            "knee": ({}, {"knee": "1 Hz"}),
            "slope": ({}, {"slope": 1.5}),
            "minimum_frequency": ({}, {"minimum_frequency": "10 mHz"}),
            "poles": ({}, {"poles": 6}),
            "shared": ({}, {"shared": 0.5}),
        },
    ),
)


@pytest.mark.parametrize(("step", "field"), cases(STEPS))
def test_each_parameter_has_an_effect(
    step: Step, field: str, maps: Path, tmp_path: Path, known: dict[str, Any]
) -> None:
    step.check(field, maps, tmp_path, known)


@pytest.mark.parametrize(("step", "parameters"), ignored(STEPS))
def test_what_would_be_ignored_is_refused(
    step: Step, parameters: dict[str, Any], maps: Path
) -> None:
    with pytest.raises(ZondaError):
        step.made(maps, parameters)
