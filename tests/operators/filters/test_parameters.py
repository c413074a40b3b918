"""Each parameter of the filters operators changes what a run makes, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from zonda.core.errors import ZondaError

from ..parameters import Step, cases, ignored

STEPS = (
    Step(
        "HighpassFilter",
        ignored=({"response": "bessel", "oversampling": 12}, {"degree": None}),
        chain=("WhiteNoise", "PinkNoise", "Efficiency", "HighpassFilter"),
        changes={
            "frequency": ({}, {"frequency": "0.2 Hz"}),
            "degree": ({}, {"degree": 1}),
            "trim": ({}, {"trim": "1 s"}),
            "oversampling": ({}, {"oversampling": 8.0}),
            "response": ({}, {"response": "bessel"}),
            "mask": ({}, {"mask": {"radius": "20 arcsec"}}),
        },
    ),
    Step(
        "Detrend",
        chain=("WhiteNoise", "PinkNoise", "Efficiency", "Detrend"),
        changes={"order": ({}, {"order": 2}), "mask": ({}, {"mask": {"radius": "20 arcsec"}})},
    ),
    Step(
        "Despline",
        chain=("WhiteNoise", "PinkNoise", "Efficiency", "Despline"),
        changes={"knots": ({}, {"knots": "5 s"})},
    ),
    Step(
        "PolynomialFilter",
        chain=("WhiteNoise", "PinkNoise", "Efficiency", "PolynomialFilter"),
        changes={
            "order": ({}, {"order": 2}),
            "interval": ({}, {"interval": "throw"}),
            "mask": ({}, {"mask": {"radius": "20 arcsec"}}),
        },
        refused={"interval": "no interval 'throw'"},
    ),
    Step(
        "GroundFilter",
        chain=("WhiteNoise", "PinkNoise", "Efficiency", "GroundFilter"),
        given={"bin": "0.01 deg"},
        changes={
            "bin": ({}, {"bin": "0.02 deg"}),
            "split": ({}, {"split": True}),
            "trend": ({}, {"trend": 3}),
        },
    ),
    Step(
        "Taper",
        chain=("WhiteNoise", "PinkNoise", "Efficiency", "Taper"),
        changes={"share": ({}, {"share": "20 %"})},
    ),
    Step(
        "CommonModeFilter",
        ignored=(
            {"method": "mean", "scale": "rms"},
            {"method": "mean", "modes": 3},
            {"method": "mean", "residual": 0.001},
            {"method": "mean", "gap": 0.5},
            {"method": "mean", "on_undetermined": "skip"},
        ),
        chain=("WhiteNoise", "PinkNoise", "Efficiency", "CommonModeFilter"),
        changes={
            "modes": ({}, {"modes": 2}),
            "method": ({}, {"method": "mean"}),
            "residual": ({}, {"residual": 1e-2}),
            "gap": ({"gap": 0.99}, {"gap": 1e-3}),
            "on_undetermined": ({"gap": 1e-3}, {"on_undetermined": "skip"}),
            "scale": ({}, {"scale": "rms"}),
            "group": ({}, {"group": "wafer"}),
            "mask": ({}, {"mask": {"radius": "20 arcsec"}}),
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
