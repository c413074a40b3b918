"""Each parameter of the pointing operators changes what a run makes, or is refused."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from zonda.core.errors import ZondaError

from ..parameters import Changes, Step, cases, ignored

POINTING: Changes = {
    "target": ({}, {"target": "05h00m10s +20d00m00s"}),
    "targets": ({}, {"targets": ["05h00m00s +20d00m00s", "05h00m10s +20d00m00s"]}),
    "scan_duration": ({}, {"scan_duration": "14 s"}),
    "scans": ({}, {"scans": 3}),
    "gap": ({"scans": 2}, {"gap": "60 s"}),
    "offsets": ({"offsets": "none"}, {"offsets": "box"}),
    "offset_size": ({"offsets": "box"}, {"offset_size": "30 arcsec"}),
    "sample_rate": ({}, {"sample_rate": "40 Hz"}),
    "interpolation_error": ({"scan_duration": "30 s"}, {"interpolation_error": 1e-9}),
    "jitter": ({}, {"jitter": "1 ms"}),
    "check_limits": ({"check_limits": "warn"}, {"check_limits": "error"}),
}

STEPS = (
    Step(
        "PointingDaisy",
        ignored=({"offsets": "none", "offset_size": "2 arcmin"},),
        changes=POINTING
        | {
            "radius": ({}, {"radius": "70 arcsec"}),
            "speed": ({}, {"speed": "40 arcsec/s"}),
            "petals": ({}, {"petals": 4.0}),
            "inner": ({}, {"inner": 0.2}),
            "phase": ({}, {"phase": "1 rad"}),
        },
        refused={"check_limits": "dish's largest speed of the azimuth axis"},
    ),
    Step(
        "PointingStare",
        given={"scan_duration": "12 s"},
        changes=POINTING,
        refused={"check_limits": "dish's largest speed of the azimuth axis"},
    ),
    Step(
        "PointingBackAndForth",
        given={
            "scan_duration": "40 s",
            "throw": "4 arcmin",
            "speed": "30 arcsec/s",
            "acceleration": "20 arcsec/s2",
        },
        changes=POINTING
        | {
            "throw": ({}, {"throw": "5 arcmin"}),
            "speed": ({}, {"speed": "20 arcsec/s"}),
            "acceleration": ({}, {"acceleration": "30 arcsec/s2"}),
            "flag_turnarounds": ({}, {"flag_turnarounds": True}),
        },
        refused={"check_limits": "dish's largest speed of the azimuth axis"},
    ),
    Step(
        "PointingRaster",
        given={
            "scan_duration": "32 s",
            "scans": 2,
            "width": "2 arcmin",
            "speed": "30 arcsec/s",
        },
        changes=POINTING
        | {
            "width": ({}, {"width": "3 arcmin"}),
            "height": ({}, {"height": "1 arcmin"}),
            "spacing": ({}, {"spacing": "15 arcsec"}),
            "speed": ({}, {"speed": "40 arcsec/s"}),
            "acceleration": ({}, {"acceleration": "60 arcsec/s2"}),
            "smooth": ({}, {"smooth": True}),
            "position_angle": ({}, {"position_angle": "0 deg"}),
            "angles": ({}, {"angles": "cross_hatch"}),
            "axes": ({}, {"axes": "horizontal"}),
            "flag_turnarounds": ({}, {"flag_turnarounds": True}),
        },
        refused={"check_limits": "dish's largest speed of the azimuth axis"},
    ),
    Step(
        "Mispointing",
        chain=("PointingDaisy", "Mispointing", "SkyMap"),
        changes={
            "offset": ({}, {"offset": ["5 arcsec", "0 arcsec"]}),
            "scan_rms": ({}, {"scan_rms": "5 arcsec"}),
            "jitter_rms": ({}, {"jitter_rms": "5 arcsec"}),
            "jitter_time": ({"jitter_rms": "5 arcsec"}, {"jitter_time": "2 s"}),
        },
    ),
    Step(
        "PointingSchedule",
        given={"schedule": "night.txt", "speed": "0.5 deg/s", "check_limits": "warn"},
        changes={
            "schedule": ({}, {"schedule": "later.txt"}),
            "speed": ({}, {"speed": "0.2 deg/s"}),
            "acceleration": ({}, {"acceleration": "0.5 deg/s2"}),
            "turnaround": ({}, {"turnaround": "smooth"}),
            "flag_turnarounds": ({}, {"flag_turnarounds": False}),
            "sun_close": ({}, {"sun_close": "180 deg"}),
            "elevation_nods": ({}, {"elevation_nods": ["1 deg", "0 deg"]}),
            "elevation_speed": (
                {"elevation_nods": ["1 deg", "0 deg"]},
                {"elevation_speed": "0.5 deg/s"},
            ),
            "elevation_acceleration": (
                {"elevation_nods": ["1 deg", "0 deg"]},
                {"elevation_acceleration": "0.5 deg/s2"},
            ),
            "sample_rate": ({}, {"sample_rate": "40 Hz"}),
            "check_limits": ({}, {"check_limits": "error"}),
            "interpolation_error": ({}, {"interpolation_error": 1e-9}),
        },
        refused={"check_limits": "dish's largest speed of the azimuth axis"},
    ),
    Step(
        "PointingRecorded",
        chain=("WhiteNoise", "Efficiency", "BinMap"),
        given={"file": "scan.csv"},
        changes={
            "file": ({}, {"file": "other.csv"}),
            "clock": ({}, {"clock": "scene"}),
            "split": ({}, {"split": "2 s"}),
            "target": ({}, {"target": "05h00m10s +20d00m00s"}),
            "flag_mask": ({"file": "flagged.csv"}, {"flag_mask": 2}),
            "celestial": ({}, {"celestial": "recorded"}),
            "interpolation_error": ({"file": "long.csv"}, {"interpolation_error": 1e-9}),
        },
        refused={"clock": "is too large", "celestial": "no boresight_radec"},
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
