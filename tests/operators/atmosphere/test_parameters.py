"""Each parameter of the atmosphere operators changes what a run makes, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from zonda.core.errors import ZondaError

from ..parameters import Step, cases, ignored

STEPS = (
    Step(
        "AtmosphereLayers",
        ignored=({"layers": 1, "highest": "3000 m"}, {"layers": 1, "weights": "equal"}),
        changes={
            "pwv": ({}, {"pwv": "5 mm"}),
            "pwv_rms": ({}, {"pwv_rms": "1 %"}),
            "pwv_rms_at": ({}, {"pwv_rms_at": "zenith"}),
            "pwv_rms_after_beam": ({}, {"pwv_rms_after_beam": True}),
            "layers": ({}, {"layers": 5}),
            "lowest": ({}, {"lowest": "600 m"}),
            "highest": ({}, {"highest": "4000 m"}),
            "weights": ({}, {"weights": "equal"}),
            "layer_response": ({}, {"layer_response": "column"}),
            "outer_scale": ({}, {"outer_scale": "400 m"}),
            "wind": ({}, {"wind": {"speed": "3 m/s", "direction": "10 deg"}}),
            "fidelity": ({}, {"fidelity": "fine"}),
            "beam": ({}, {"beam": "top_hat"}),
            "edge_taper": ({"beam": "tapered"}, {"edge_taper": 20.0}),
            "outputs": ({}, {"outputs": ["pwv", "opacity", "path_delay"]}),
            "omit": ({}, {"omit": [0]}),
            "spectra": ({}, {"spectra": "none such"}),
            "lattice": ({}, {"lattice": 0.15}),
            "tolerance": ({}, {"tolerance": "0.01 %"}),
        },
        refused={"spectra": "unknown spectra 'none such'"},
    ),
    Step(
        "AtmosphereScreens",
        chain=("AtmosphereLayers", "AtmosphereScreens"),
        changes={
            "observation": ({}, {"observation": 1}),
            "moment": ({}, {"moment": "2 s"}),
            "moments": ({}, {"moments": 2}),
            "pixels": ({}, {"pixels": 8}),
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
