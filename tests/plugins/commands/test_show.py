"""`zonda show instrument`: what is printed, and what is drawn."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner

from zonda.core import cli
from zonda.core.instrument import Instrument
from zonda.core.plots import focal_plane_figure
from zonda.core.registry import instruments
from zonda.plugins.commands.show import lines, show, split_provenance


def shown(name: str, path: Path) -> str:
    done = CliRunner().invoke(
        show, ["instrument", name, "--output", str(path)], catch_exceptions=False
    )
    assert done.exit_code == 0, done.output
    return str(done.stdout)


def test_a_camera_of_two_bands(tmp_path: Path) -> None:
    text = shown("act_pa5", tmp_path / "act.png")
    rows = {
        line.split()[0]: line.split()
        for line in text.splitlines()
        if line.startswith(("f090", "f150"))
    }
    assert rows["f090"][:6] == ["f090", "80", "to", "116", "858", "2.24′"]
    assert rows["f150"][-2:] == ["0.1", "1"]
    assert "detectors     1716, hexagon layout, pixels shared, polarized" in text
    sources, stand_ins = text.split("stand-ins")
    assert "detectors: 2012 in PA4, 1716 in PA5" in sources
    assert "NET: 300 uK_CMB" in stand_ins
    assert (tmp_path / "act.png").read_bytes().startswith(b"\x89PNG")


def test_stand_ins_are_told_from_sources() -> None:
    sources, stand_ins = split_provenance(instruments.create("apex"))
    assert any("Siringo" in text for text in sources)
    assert "NET: about 75 mJy s(1/2) in this beam, not verified" in stand_ins
    assert not any("stand-in" in text for text in sources + stand_ins)


def test_the_instrument_of_a_pipeline_file(tmp_path: Path) -> None:
    table = (
        "name, xi [arcmin], eta [arcmin], fwhm [arcsec], wafer, dead\na, 0, 0, 8, w1, 0\nb, 1, 0,"
        " 9, w2, 1\n"
    )
    (tmp_path / "array.csv").write_text(table)
    (tmp_path / "my.yaml").write_text(
        "site: green_bank\ninstrument: {like: mustang2, focalplane: array.csv}\ntime:"
        " 2024-11-25T07:00\ntarget: 05h +20d\noperators:\n  - PointingDaisy\n  - WhiteNoise\n  -"
        " Efficiency\n  - BinMap\n"
    )
    text = shown(str(tmp_path / "my.yaml"), tmp_path / "my.svg")
    assert "detectors     2, from array.csv, 2 wafers, not polarized, 1 dead" in text
    assert "8″ to 9″" in text
    assert "<svg" in (tmp_path / "my.svg").read_text()


def of(**more: Any) -> Instrument:
    given = {
        "name": "camera",
        "telescope": {"name": "dish", "diameter": "6 m"},
        "band": {"name": "b150", "low": "140 GHz", "high": "160 GHz"},
        "detectors": 42,
        "field_of_view": "1 deg",
        "main_beam_efficiency": 0.6,
        "illumination_efficiency": 0.9,
        "net": "500 uK s(1/2)",
        "sample_rate": "20 Hz",
    }
    return Instrument.model_validate(given | more)


def test_beams_and_angles_are_to_scale() -> None:
    camera = of(polarization="pairs", layout="wafers", wafers=3, fwhm="6 arcmin")
    plane = camera.focalplane()
    whole, middle = focal_plane_figure(camera, plane).axes
    beams = middle.collections[0]
    assert beams.get_offsets().shape[0] <= 42
    np.testing.assert_allclose(
        beams.get_widths(), 6 if "arcmin" in middle.get_xlabel() else 0.1
    )  # the diameter
    segments = np.array(middle.collections[1].get_segments())
    angles = (
        np.degrees(np.arctan2(*(segments[:, 1] - segments[:, 0]).T)) % 180
    )  # from eta towards xi
    expected = np.degrees(plane.polarization_angle) % 180
    np.testing.assert_allclose(
        np.sort(np.unique(angles.round(6) % 180)), np.sort(np.unique(expected.round(6))), atol=1e-6
    )
    assert len(whole.patches) == 3  # the outlines of the wafers


def test_the_inner_panel_shows_one_wafer_alone() -> None:
    """Of two wafers with 7 pixels each, which are fewer than the panel asks for."""
    camera = of(layout="wafers", wafers=2, detectors=14, fwhm="1 arcmin")
    plane = camera.focalplane()
    _, middle = focal_plane_figure(camera, plane).axes
    xi, eta = np.degrees([plane.xi, plane.eta]) * 60
    (left, right), (low, high) = middle.get_xlim(), middle.get_ylim()
    seen = (left < xi) & (xi < right) & (low < eta) & (eta < high)
    np.testing.assert_array_equal(seen, plane.wafer == plane.wafer[seen][0])
    assert "inside a wafer" in middle.get_title()
    np.testing.assert_allclose(
        [(left + right) / 2, (low + high) / 2], [xi[seen].mean(), eta[seen].mean()], atol=1e-6
    )


@pytest.mark.parametrize("more", [{"detectors": 1, "field_of_view": "0 deg"}, {"detectors": 2}])
def test_few_detectors(more: dict[str, Any]) -> None:
    camera = of(**more)
    assert len(focal_plane_figure(camera, camera.focalplane()).axes) == 2
    assert f"{more['detectors']}, hexagon layout" in "\n".join(lines(camera, camera.focalplane()))


def test_mistakes(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["show", "instrument", "mustang"]) == 2
    assert "did you mean 'mustang2'" in capsys.readouterr().err
    assert cli.main(["show", "instrument", "mustang2", "--output", "x.txt"]) == 2
    assert "x.txt does not end in .png, .pdf or .svg" in capsys.readouterr().err
