"""Each parameter of the optics operators changes what a run makes, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ..parameters import ALL, Step, cases

STEPS = (
    Step(
        "Efficiency",
        chain=("SkyMap", "AtmosphereLayers", "WhiteNoise", "PinkNoise", "Efficiency"),
        changes={
            "main_beam": ({}, {"main_beam": 0.5}),
            "illumination": ({}, {"illumination": 0.5}),
            "scatter": ({}, {"scatter": "5 %"}),
            "calibration": ({}, {"calibration": "instantaneous"}),
            "calibration_error": ({}, {"calibration_error": "5 %"}),
        },
    ),
    Step(
        "HalfWavePlate",
        chain=("HalfWavePlate", "SkyMap", "AtmosphereLayers", "Leakage"),
        given={"frequency": "2 Hz"},
        changes={
            "frequency": ({}, {"frequency": "3 Hz"}),
            "angle": ({}, {"angle": "10 deg"}),
        },
        polarized=ALL,
    ),
    Step(
        "Leakage",
        chain=("SkyMap", "AtmosphereLayers", "Leakage"),
        changes={
            "share": ({}, {"share": "2 %"}),
            "angle": ({}, {"angle": "10 deg"}),
        },
        polarized=ALL,
    ),
    Step(
        "GroundPickup",
        changes={
            "rms": ({}, {"rms": "2 mK"}),
            "fwhm": ({}, {"fwhm": "5 deg"}),
            "power": ({}, {"power": -2.0}),
            "scatter": ({}, {"scatter": "5 %"}),
            "realization": ({}, {"realization": 1}),
        },
    ),
)


@pytest.mark.parametrize(("step", "field"), cases(STEPS))
def test_each_parameter_has_an_effect(
    step: Step, field: str, maps: Path, tmp_path: Path, known: dict[str, Any]
) -> None:
    step.check(field, maps, tmp_path, known)
