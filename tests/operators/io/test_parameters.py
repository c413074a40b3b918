"""Each parameter of the io operators changes what a run makes, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ..parameters import Step, cases

STEPS = (
    Step(
        "LoadTOD",
        chain=("BinMap",),
        given={"file": "recorded.h5"},
        changes={
            "file": ({}, {"file": "again.h5"}),
            "signal": ({}, {"signal": "none"}),
            "unit": ({}, {"unit": "mK_RJ"}),
            "band": ({}, {"band": "150 GHz"}),
            "noise": ({}, {"noise": "noise.ecsv"}),
            "noise_model": ({}, {"noise_model": "el_noise"}),
            "celestial": ({}, {"celestial": "recomputed"}),
            "flag_mask": ({"file": "flagged.h5"}, {"flag_mask": 1}),
            "detector_mask": ({"file": "flagged.h5"}, {"detector_mask": 1}),
            "target": ({}, {"target": "05h00m10s +20d00m00s"}),
            "interpolation_error": (
                {"file": "long.h5", "celestial": "recomputed"},
                {"interpolation_error": 1e-9},
            ),
        },
        refused={
            "signal": "BinMap needs signal",
            "band": "no band, or more than one, at 150 GHz",
            "noise_model": "has no noise model 'el_noise'",
        },
    ),
    Step(
        "SaveTOD",
        chain=("WhiteNoise", "Efficiency", "SaveTOD"),
        changes={
            "format": ({}, {"format": "fits"}),
            "streams": ({}, {"streams": ["signal", "white"]}),
            "dtype": ({}, {"dtype": "float32"}),
        },
    ),
    Step(
        "SaveMap",
        chain=("WhiteNoise", "Efficiency", "BinMap", "SaveMap"),
        changes={
            "central_diameter": ({}, {"central_diameter": "30 arcsec"}),
            "overwrite": ({}, {"overwrite": False}),
            "unit": ({}, {"unit": "MJy/sr"}),
            "spectral_index": ({"unit": "MJy/sr"}, {"unit": "MJy/sr", "spectral_index": 2.0}),
        },
        refused={"overwrite": "exists already"},
    ),
)


@pytest.mark.parametrize(("step", "field"), cases(STEPS))
def test_each_parameter_has_an_effect(
    step: Step, field: str, maps: Path, tmp_path: Path, known: dict[str, Any]
) -> None:
    step.check(field, maps, tmp_path, known)
