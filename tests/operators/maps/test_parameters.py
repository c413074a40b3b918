"""Each parameter of the maps operators changes what a run makes, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from zonda.core.errors import ZondaError

from ..parameters import Step, cases, ignored

MAPS: dict[str, Any] = {
    "pixel": ({}, {"pixel": "3 arcsec"}),
    "centre": ({}, {"centre": "05h00m01s +20d00m00s"}),
    "projection": ({}, {"projection": "CAR"}),
    "frame": ({}, {"frame": "galactic"}),
    "nside": ({}, {"nside": 8192}),
    "ordering": ({"nside": 8192}, {"ordering": "nested"}),
    "stokes": ({}, {"stokes": "IQU"}),
    "condition_limit": ({"stokes": "IQU"}, {"condition_limit": 3.0}),
    "half_difference": ({}, {"half_difference": False}),
    "crosslinking": ({}, {"crosslinking": True}),
    "visits": ({}, {"visits": True}),
    "scan_hits": ({}, {"scan_hits": True}),
    "smooth": ({}, {"smooth": "beam"}),
    "product": ({}, {"product": "chart"}),
    "weights": ({}, {"weights": "uniform"}),
    "noise": ({}, {"noise": "scatter"}),
    "contents": ({}, {"contents": "hits"}),
}
"""Changes of what all map makers have."""

STEPS = (
    Step(
        "BinMap",
        ignored=(
            {"nside": 1024, "pixel": "3 arcsec"},
            {"nside": 1024, "width": "3 arcmin"},
            {"ordering": "nested"},
        ),
        chain=("SkyMap", "WhiteNoise", "Efficiency", "BinMap"),
        changes=MAPS
        | {
            "width": ({}, {"width": "3 arcmin"}),
            "height": ({"width": "3 arcmin"}, {"height": "2 arcmin"}),
        },
        polarized=("condition_limit", "stokes"),
    ),
    Step(
        "MaximumLikelihoodMap",
        ignored=({"nside": 1024, "pixel": "3 arcsec"}, {"ordering": "nested"}),
        chain=("SkyMap", "WhiteNoise", "PinkNoise", "Efficiency", "MaximumLikelihoodMap"),
        changes=MAPS
        | {
            "width": ({}, {"width": "12 arcmin"}),
            "height": ({"width": "12 arcmin"}, {"height": "13 arcmin"}),
            "baseline": ({}, {"baseline": "0.4 s"}),
            "modes": ({}, {"modes": 2}),
            "free": ({}, {"free": 0}),
            "group": ({}, {"group": "wafer"}),
            "trend": ({}, {"trend": 2}),
            "noise": ({}, {"noise": "simulated"}),
            "refine": ({}, {"refine": 0}),
            "tolerance": ({}, {"tolerance": 1e-2}),
            "undetermined": ({}, {"undetermined": "none"}),
            "patterns": ({}, {"patterns": 2}),
        },
        refused=dict.fromkeys(("weights", "contents"), "belong to BinMap"),
        polarized=("condition_limit", "stokes"),
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
