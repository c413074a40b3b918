"""Instruments, sites and bands that YAML files describe: of a package, and of the user's own."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from zonda.core import registry
from zonda.core.cli import main
from zonda.core.configuration.diagnostics import ConfigurationError
from zonda.core.configuration.pipeline_file import load
from zonda.core.registry import RegistryError
from zonda.core.scene import Scene

CAMERA = """# Cameras of a 12 m dish.
x-dish: &dish {name: Dish, diameter: 12 m, site: chajnantor}

little:
  description: 7 detectors
  telescope: *dish
  band: {name: wide, file: wide.txt}
  detectors: 7
  field_of_view: 4 arcmin
  main_beam_efficiency: 0.7
  illumination_efficiency: 0.9
  net: 400 uK s(1/2)
  sample_rate: 50 Hz
  provenance:
    NET: 'stand-in: round'
    detectors: counted

other_name:
  like: little

littler: {like: little, detectors: 3}
"""
PIPELINE = """site: chajnantor
instrument: camera.yaml
time: 2024-11-25T04:00
target: 05h -23d
operators:
  - PointingStare: {scan_duration: 10 s}
  - WhiteNoise
  - Efficiency
  - BinMap: {pixel: 1 arcmin}
  - SaveMap
"""

Plugin = Callable[..., Path]


@pytest.fixture
def cameras(plugin: Plugin) -> Path:
    """The folder of an installed package with files of cameras, whose code must not be imported."""
    folder = plugin("zonda-dish", "1.0", {"zonda.instruments": {"dish": "zd_dish.cameras"}})
    files = folder / "zd_dish" / "cameras"
    files.mkdir(parents=True)
    (folder / "zd_dish" / "__init__.py").write_text("raise RuntimeError('imported')\n")
    (files / "little.yaml").write_text(CAMERA)
    (files / "wide.txt").write_text("140 1\n150 1\n160 1\n")
    registry.refresh()
    return files


def test_a_package_of_files(cameras: Path) -> None:
    assert {"little", "other_name", "littler"} <= {*registry.instruments}
    assert "dish" not in registry.instruments
    found = next(f for f in registry.instruments.candidates() if f.name == "little")
    assert (found.distribution, found.reference) == ("zonda-dish", "zd_dish.cameras/little.yaml")
    little = registry.instruments.create("Little")
    assert (little.name, little.detectors, little.band.centre) == ("little", 7, 150e9)
    assert little.band.file == cameras / "wide.txt"
    assert little.provenance == "detectors: counted; stand-in: NET: round"
    assert registry.instruments.create("zonda-dish:other_name") is little
    variant = registry.instruments.create("littler")
    assert (variant.name, variant.detectors, variant.net) == ("littler", 3, little.net)
    scene = Scene(site="chajnantor", instrument="little", time="2024-11-25T04:00")
    assert scene.instrument == little
    assert "zd_dish" not in sys.modules


def test_files_of_others_are_not_read(cameras: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A name is found by the first level of the files; of one file alone is an instrument made."""
    made = []
    original = Path.open
    _ = [*registry.instruments]  # the index of names
    monkeypatch.setattr(
        Path, "open", lambda self, *a, **k: made.append(self) or original(self, *a, **k)
    )
    registry.instruments.create("little")
    assert [path.name for path in made if path.suffix == ".yaml"] == ["little.yaml"]


@pytest.mark.parametrize(
    ("old", "new", "line", "words"),
    [
        ("net: 400 uK s(1/2)", "net: 400 uK", 12, ("little, net",)),
        ("  detectors: 7", "  detektors: 7", 8, ("unknown key 'detektors'", "did you mean")),
        ("  detectors: 7\n", "", 4, ("little needs 'detectors'",)),
        ("detectors: 7", "detectors: 7\n  detectors: 8", 9, ("duplicate key 'detectors'",)),
        ("{name: wide, file: wide.txt}", "wide_one", 7, ("unknown band 'wide_one'",)),
        ("  description: 7 detectors", "  description: [", 5, ("'[' is not closed",)),
    ],
)
def test_a_mistake_is_told_at_its_line(
    cameras: Path, old: str, new: str, line: int, words: tuple[str, ...]
) -> None:
    path = cameras / "little.yaml"
    path.write_text(CAMERA.replace(old, new))
    registry.refresh()
    with pytest.raises(RegistryError) as caught:
        registry.instruments.create("little")
    assert caught.value.place.startswith(f"{path}:{line}:")
    for word in words:
        assert word in str(caught.value)
    assert "zonda-dish 1.0" in str(caught.value)
    assert registry.instruments.create("mustang2").name == "mustang2"


def test_a_package_without_files(plugin: Plugin) -> None:
    folder = plugin("zonda-none", "1", {"zonda.sites": {"none": "zd_none.places"}})
    (folder / "zd_none").mkdir()
    (folder / "zd_none" / "__init__.py").write_text("")
    with pytest.raises(RegistryError, match=r"site 'none' could not be loaded .* zonda-none 1"):
        registry.sites.create("none")
    (folder / "zd_none" / "places.py").write_text("")
    with pytest.raises(RegistryError, match=r"has no \*\.yaml files"):
        registry.sites.create("none")
    sys.modules.pop("zd_none", None)
    sys.modules.pop("zd_none.places", None)


def test_a_mapping(plugin: Plugin) -> None:
    source = "hill = {'latitude': '1 deg', 'longitude': '2 deg', 'altitude': '3 km'}\nbog = {}\n"
    points = {"hill": "zd_map:hill", "bog": "zd_map:bog"}
    plugin("zonda-map", "1", {"zonda.sites": points}, zd_map=source)
    hill = registry.sites.create("hill")
    assert (hill.name, hill.altitude) == ("hill", 3000.0)
    with pytest.raises(RegistryError, match="Site needs 'latitude'"):
        registry.sites.create("bog")


@pytest.fixture
def pipeline(tmp_path: Path) -> Path:
    one = CAMERA[: CAMERA.index("other_name")]
    (tmp_path / "camera.yaml").write_text(one)
    (tmp_path / "wide.txt").write_text("140 1\n150 1\n160 1\n")
    (tmp_path / "pipeline.yaml").write_text(PIPELINE)
    return tmp_path / "pipeline.yaml"


def test_a_file_of_ones_own(pipeline: Path, tmp_path: Path, monkeypatch: Any) -> None:
    file = load(pipeline)
    instrument = file.scene().instrument
    assert (instrument.name, instrument.detectors) == ("little", 7)
    resolved = tmp_path / "elsewhere" / "resolved.yaml"
    resolved.parent.mkdir()
    resolved.write_text(file.resolved_yaml())
    (tmp_path / "camera.yaml").unlink()
    again = load(resolved).scene().instrument
    assert again.model_dump(mode="json") == instrument.model_dump(mode="json")
    monkeypatch.chdir(tmp_path)
    (tmp_path / "camera.yaml").write_text(CAMERA[: CAMERA.index("other_name")])
    scene = Scene(site="chajnantor", instrument="camera.yaml", time="2024-11-25T04:00")
    assert scene.instrument == instrument
    varied = load(pipeline, ["instrument={like: camera.yaml, detectors: 3}"]).scene().instrument
    assert (varied.detectors, np.float64(varied.net)) == (3, instrument.net)


def test_it_is_shown(pipeline: Path, monkeypatch: Any, capsys: Any) -> None:
    monkeypatch.chdir(pipeline.parent)
    for name in ("camera.yaml", "pipeline.yaml"):
        assert main(["show", "instrument", name, "--output", "camera.png"]) == 0
        assert "7 detectors" in capsys.readouterr().out
    assert (pipeline.parent / "camera.png").stat().st_size > 1000
    assert main(["show", "instrument", "none.yaml"]) == 2


def test_mistakes_in_it_are_told_with_carets(pipeline: Path, capsys: Any) -> None:
    camera = pipeline.parent / "camera.yaml"
    camera.write_text(camera.read_text().replace("50 Hz", "50 GHz s"))
    assert main(["check", str(pipeline)]) == 2
    error = capsys.readouterr().err
    assert f"{camera}:13:" in error
    assert "13 |   sample_rate: 50 GHz s" in error
    camera.write_text(CAMERA)
    with pytest.raises(ConfigurationError, match="describes 3 instruments: little, other_name"):
        load(pipeline)
    camera.unlink()
    with pytest.raises(ConfigurationError, match=r"no such file: 'camera\.yaml'"):
        load(pipeline)
