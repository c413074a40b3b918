"""Each parameter of the diagnostics operators changes what a run makes, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from ..parameters import Step, cases

STEPS = (
    Step(
        "PowerSpectrum",
        chain=("WhiteNoise", "PinkNoise", "Efficiency", "PowerSpectrum"),
        changes={
            "streams": ({}, {"streams": ["signal"]}),
            "detectors": ({}, {"detectors": 3}),
            "segment": ({}, {"segment": "4 s"}),
        },
    ),
    Step(
        "TimeStreams",
        chain=("WhiteNoise", "Efficiency", "TimeStreams"),
        changes={
            "streams": ({}, {"streams": ["signal", "white"]}),
            "detectors": ({}, {"detectors": 5}),
            "observation": ({}, {"observation": 1}),
        },
    ),
    Step(
        "ModeSpectrum",
        chain=("WhiteNoise", "PinkNoise", "Efficiency", "ModeSpectrum"),
        changes={
            "modes": ({}, {"modes": 2}),
            "delays": ({}, {"delays": 1}),
            "delay": ({"delays": 1}, {"delay": "0.5 s"}),
            "detectors": ({}, {"detectors": 5}),
            "center": ({}, {"center": False}),
            "normalize": ({}, {"normalize": True}),
        },
    ),
    Step(
        "CompareStreams",
        chain=("WhiteNoise", "PinkNoise", "Efficiency", "CompareStreams"),
        given={"reference": "white"},
        changes={
            "stream": ({}, {"stream": "pink"}),
            "reference": ({}, {"reference": "pink"}),
            "detectors": ({}, {"detectors": 3}),
            "segment": ({}, {"segment": "0.5 s"}),
        },
    ),
    Step(
        "MeasureFigures",
        chain=("WhiteNoise", "Efficiency", "BinMap", "MeasureFigures"),
        given={"metrics": ["coverage", "central_rms"]},
        changes={"metrics": ({}, {"metrics": ["central_rms"]})},
    ),
    Step(
        "TransferFunction",
        chain=(
            "SkyMap",
            "WhiteNoise",
            "PinkNoise",
            "Efficiency",
            "HighpassFilter",
            "CommonModeFilter",
            "BinMap",
            "TransferFunction",
        ),
        changes={
            "modes": ({}, {"modes": "full"}),
            "bins": ({}, {"bins": 4}),
            "largest": ({}, {"largest": "50 arcsec"}),
            "smallest": ({}, {"smallest": "20 arcsec"}),
            "radius": ({}, {"radius": "60 arcsec"}),
            "taper": ({}, {"taper": "20 arcsec"}),
            "least_coverage": ({}, {"least_coverage": 0.6}),
            "map": ({}, {"map": "chart"}),
        },
        refused={"map": "there is no map 'chart'"},
    ),
    Step(
        "CompareMaps",
        chain=("SkyMap", "WhiteNoise", "Efficiency", "BinMap", "CompareMaps"),
        changes={
            "map": ({}, {"map": "chart"}),
            "reference": ({}, {"reference": "map"}),
            "file": ({}, {"file": "map.fits"}),
            "plane": ({"file": "cube.fits", "plane": 1}, {"plane": 2}),
            "hdu": ({"file": "two.fits"}, {"hdu": "second"}),
            "coordsys": ({"file": "fine.fits"}, {"coordsys": "galactic"}),
            "column": ({"file": "fine.fits"}, {"column": "other"}),
            "beam": ({}, {"beam": "20 arcsec"}),
            "least_coverage": ({}, {"least_coverage": 0.6}),
            "threshold": ({}, {"threshold": 3.0}),
            "noise": ({}, {"noise": "map"}),
            "bins": ({}, {"bins": 5}),
        },
        refused={"map": "there is no map 'chart'"},
    ),
    Step(
        "MapSpectrum",
        chain=("WhiteNoise", "Efficiency", "BinMap", "MapSpectrum"),
        changes={
            "maps": ({}, {"maps": ["chart"]}),
            "bins": ({}, {"bins": 5}),
            "least_coverage": ({}, {"least_coverage": 0.6}),
            "taper": ({}, {"taper": "20 arcsec"}),
        },
        refused={"maps": "no TAN map 'chart'"},
    ),
    Step(
        "Plots",
        chain=("WhiteNoise", "Efficiency", "BinMap", "Plots"),
        changes={
            "smooth": ({}, {"smooth": "none"}),
            "central_diameter": ({}, {"central_diameter": "30 arcsec"}),
            "least_coverage": ({}, {"least_coverage": 0.5}),
            "contours": ({}, {"contours": [-1.0, 1.0]}),
            "formats": ({}, {"formats": ["svg"]}),
            "dpi": ({}, {"dpi": 60.0}),
            "unit": ({}, {"unit": "MJy/sr"}),
            "spectral_index": ({"unit": "MJy/sr"}, {"unit": "MJy/sr", "spectral_index": 9.0}),
            "colours": ({}, {"colours": "magma"}),
            "limits": ({}, {"limits": ["-1 mK", "2 mK"]}),
            "stretch": ({}, {"stretch": "asinh"}),
            "scale_bar": ({}, {"scale_bar": "20 arcsec"}),
        },
    ),
    Step(
        "Report",
        chain=("WhiteNoise", "Efficiency", "BinMap", "Report"),
        changes={"central_diameter": ({}, {"central_diameter": "30 arcsec"})},
    ),
)


@pytest.mark.parametrize(("step", "field"), cases(STEPS))
def test_each_parameter_has_an_effect(
    step: Step, field: str, maps: Path, tmp_path: Path, known: dict[str, Any]
) -> None:
    step.check(field, maps, tmp_path, known)
