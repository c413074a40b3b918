"""What a user is told of bad input to `AtmosphereLayers`: the place, what is wrong, and what would
mend it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import zonda
from zonda.core import cli
from zonda.core.errors import ZondaError
from zonda.operators.atmosphere.turbulence.geometry import scan_planes

from .test_layers import instrument, observe, operator, swept

PIPELINE = """\
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: {target}
seed: 1
operators:
  - PointingStare: {{scan_duration: 2 s}}
  - AtmosphereLayers: {{{parameters}}}
  - Efficiency
  - BinMap
"""
STRAIGHT_UP = "{az: 0 deg, el: 60 deg}"


def complaint(
    capsys: Any,
    monkeypatch: Any,
    folder: Path,
    parameters: str,
    target: str = STRAIGHT_UP,
    run: bool = False,
) -> str:
    """Standard error of a command that must end as a user's mistake."""
    monkeypatch.chdir(folder)
    (folder / "my.yaml").write_text(PIPELINE.format(parameters=parameters, target=target))
    status = cli.main(["run", "my.yaml", "--output", "out"] if run else ["check", "my.yaml"])
    message = str(capsys.readouterr().err)
    assert status == 2, message
    assert "Traceback" not in message
    return message


@pytest.mark.parametrize(
    ("parameters", "words"),
    [
        ("outer_scale: 0 m", ["my.yaml:8:37", "outer_scale: must be greater than 0 m, got 0 m"]),
        ("outer_scale: -5 m", ["outer_scale: must be greater than 0 m, got -5 m"]),
        (
            "outer_scale: nan m",
            ["my.yaml:8:37", "cannot read 'nan m' as a length", "such as '500 m'"],
        ),
        ("outer_scale: .nan", ["outer_scale: nan has no unit"]),
        (
            "lowest: -100 m",
            ["my.yaml:8:32", "lowest: must be greater than 0 m, got -100 m", "above the site"],
        ),
        ("highest: 25 km", ["highest: must be at most 20 km, got 25 km"]),
        ("lowest: 6 km", ["lowest must be below highest"]),
        ("layers: 0", ["my.yaml:8:32", "layers: must be at least 1, got 0"]),
        ("layers: -3", ["layers: must be at least 1, got -3"]),
        ("layer: 4", ["unknown key 'layer'", "did you mean 'layers'?"]),
        ("pwv: -1 mm", ["pwv: must be greater than 0 mm, got -1 mm"]),
        ("pwv: 500 mm", ["pwv: must be at most 60 mm, got 500 mm"]),
        ("pwv: .nan", ["pwv: nan has no unit"]),
        ("pwv_rms: -1 %", ["pwv_rms: must be at least", "got -1 %"]),
        ("pwv_rms: nan %", ["pwv_rms: cannot read 'nan %'"]),
        ("wind: profil", ["did you mean 'profile'?"]),
        ("wind: {speed: -3 m/s}", ["wind.speed", "must be at least 0 m/s, got -3 m/s"]),
        ("wind: {speed: nan m/s}", ["wind.speed", "cannot read 'nan m/s' as a speed"]),
        ("wind: [{speed: 3 m/s}]", ["wind lists 1 winds for 10 layers"]),
        ("beam: gausian", ["did you mean 'gaussian'?"]),
        ("weights: vapor", ["did you mean 'vapour'?"]),
        ("edge_taper: 4", ["edge_taper is for beam: tapered"]),
        ("tolerance: .nan", ["tolerance: expected a finite number, got nan"]),
        ("outputs: [ozone]", ["outputs", "must be 'pwv', 'opacity' or 'path_delay'"]),
    ],
)
def test_parameters(
    capsys: Any, monkeypatch: Any, tmp_path: Path, parameters: str, words: list[str]
) -> None:
    message = complaint(capsys, monkeypatch, tmp_path, parameters)
    for word in ["AtmosphereLayers", "my.yaml:8:", *words]:
        assert word in message, message


@pytest.mark.parametrize(
    ("target", "parameters", "words"),
    [
        (
            "{az: 0 deg, el: 0 deg}",
            "pwv: 7 mm",
            ["elevation 0.00 deg", "reaches 5 deg", "choose an elevation"],
        ),
        (
            STRAIGHT_UP,
            "pwv: 7 mm, outer_scale: 1e9 m",
            ["outer scale 1e+09 m", "known from 0.001 to 1e+06", "choose an outer_scale"],
        ),
        (
            STRAIGHT_UP,
            "pwv: 7 mm, outer_scale: 1 mm",
            ["outer scale 0.001 m", "choose an outer_scale from 0.042 m"],
        ),
    ],
)
def test_what_only_the_scan_shows(
    capsys: Any, monkeypatch: Any, tmp_path: Path, target: str, parameters: str, words: list[str]
) -> None:
    message = complaint(capsys, monkeypatch, tmp_path, parameters, target, run=True)
    for word in words:
        assert word in message, message


# -------------------------------------------------------------------------------------------------
# known faults Strict: whoever mends one is told to take the mark away.


def test_an_elevation_of_zero_is_named() -> None:
    with pytest.raises(ZondaError, match=r"elevation|horizon"):
        operator().prepare(
            observe(1.0, elevation=1e-9, camera=instrument(detectors=1, field="0 deg"))
        )


def test_nan_in_the_pointing_is_named() -> None:
    o = observe(1.0)
    o.boresight_azel[50] = np.nan
    with pytest.raises(ZondaError, match=r"pointing|boresight|sample 50"):
        operator().prepare(o)


def test_a_scan_round_the_horizon_is_at_its_own_elevation() -> None:
    # Footprints, separations and every error bound use height / sin(elevation): half of it at 30
    # deg, and the nodes are wrong by 2.4e-3 of the fluctuation where the report states 3e-5 (50 m,
    # 0.5 deg).
    track = scan_planes(
        [swept(30.0, np.linspace(0, 360, 2000), instrument(detectors=1, field="0 deg"))]
    )[0]
    assert track.elevation == pytest.approx(np.radians(30.0), abs=1e-3)


def test_water_past_the_table_is_refused_or_has_its_mean_and_rms() -> None:
    # hard_cases.md: range errors name the limits and the sample.
    with pytest.raises(ZondaError, match="60 mm"):
        operator(pwv="55 mm", pwv_rms="10 %", outer_scale="20 m").prepare(observe(600.0, 1.0))


def test_the_realization_is_reported() -> None:
    o = observe(60.0)
    operator(layers=2).prepare(o)
    assert any("realization" in f"{what} {text}" for _, what, text in o.log)


def test_the_rms_stated_after_the_beam_is_that_of_the_log_normal() -> None:
    o = observe(5.0, camera=instrument(detectors=1, field="0 deg"))
    zonda.AtmosphereLayers(
        pwv="1 mm", pwv_rms=1.0, layers=1, lowest="1 km", outer_scale="20 m"
    ).prepare(o)
    stated = next(text for _, what, text in o.log if what == "PWV rms")
    variance = next(text for _, what, text in o.log if what.startswith("PWV rms after the beam"))
    v = (float(variance.split(": ")[1].rstrip("%")) / 100) ** 2
    assert float(stated.split(", ")[1].split("%")[0]) / 100 == pytest.approx(
        np.sqrt(np.expm1(np.log(2) * v)), rel=2e-3
    )
