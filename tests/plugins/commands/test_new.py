"""`zonda new`: a pipeline that `zonda check` accepts, a plugin whose tests pass."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

import zonda
from tests.scenes import installed_plugin
from zonda.core import cli
from zonda.core.configuration.pipeline_file import load


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("options", "site", "pixel"),
    [
        ([], "green_bank", "2 arcsec"),
        (["--instrument", "lmt_150ghz"], "sierra_negra", None),
        (["--site", "boston"], "boston", "2 arcsec"),
        (["--target", "az 120 deg el 50 deg"], "green_bank", None),
        (["--target", "galactic 120 deg -30 deg", "--site", "mauna_kea"], "mauna_kea", None),
    ],
)
def test_check_accepts_the_pipeline_at_once(here, capsys, options, site, pixel):
    assert cli.main(["new", "pipeline", "mine", *options]) == 0
    out, err = capsys.readouterr()
    assert (out, err) == ("mine.yaml\n", "zonda check mine.yaml; zonda run mine.yaml\n")
    assert cli.main(["check", "mine.yaml"]) == 0
    out, err = capsys.readouterr()
    assert "mine.yaml: no mistakes" in out
    file = load("mine.yaml")
    assert load("mine.yaml").parameters["site"] == site
    text = (here / "mine.yaml").read_text()
    assert pixel is None or f"pixel: {pixel}" in text
    assert "zonda run mine.yaml" in text
    assert file.header.name == "mine"


def test_the_pipeline_runs(here, capsys):
    assert cli.main(["new", "pipeline"]) == 0
    file = load("pipeline.yaml", ["PointingDaisy.scan_duration='5 s'"])
    data = zonda.Pipeline(file.operators[:-2]).run(file.scene(), threads=1)  # all but the files
    assert data["map"].hits.sum() > 0


def test_nothing_is_overwritten(here, capsys):
    (here / "mine.yaml").write_text("precious")
    assert cli.main(["new", "pipeline", "mine"]) == 2
    assert "mine.yaml: exists already" in capsys.readouterr().err
    assert (here / "mine.yaml").read_text() == "precious"
    (here / "zonda-mine").mkdir()
    assert cli.main(["new", "plugin", "zonda-mine"]) == 2
    assert "zonda-mine: exists already" in capsys.readouterr().err
    assert list((here / "zonda-mine").iterdir()) == []
    assert sorted(p.name for p in here.iterdir()) == ["mine.yaml", "zonda-mine"]


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["pipeline", "a b"], "'a b' cannot be the name of a pipeline"),
        (["pipeline", ".hidden"], "cannot be the name of a pipeline"),
        (["pipeline", "nowhere/x"], "there is no such folder"),
        (["pipeline", "x", "--instrument", "mustng2"], "did you mean 'mustang2'"),
        (["pipeline", "x", "--site", "gren_bank"], "green_bank"),
        (
            ["pipeline", "x", "--target", "mars"],
            "Invalid value for --target: cannot read 'mars' as a position",
        ),
        (["pipeline", "x", "--target", "nonsense"], "cannot read 'nonsense' as a position"),
        (["pipeline", "x", "--target", "05h -80d"], "it never rises"),
        (["plugin", "3x"], "cannot be the name of a plugin"),
        (["plugin", "../x"], "cannot be the name of a plugin"),
        (["plugin", "class"], "cannot be the name of a plugin"),
        (["plugin", "zonda"], "cannot be the name of a plugin"),
        (["plugin", "numpy"], "a Python module 'numpy' is installed already"),
        (["plugin", "a--b"], "cannot be the name of a plugin"),
    ],
)
def test_mistakes_write_nothing(here, capsys, arguments, said):
    assert cli.main(["new", *arguments]) == 2
    err = capsys.readouterr().err
    assert said in err
    assert "Traceback" not in err
    assert list(here.iterdir()) == []


@pytest.mark.nightly
def test_the_tests_of_a_new_plugin_pass_at_once(here, capsys):
    """Installed from its folder into another one, so that other tests do not see it; without
    network.
    """
    assert cli.main(["new", "plugin", "zonda-my.camera"]) == 0
    folder = here / "zonda-my.camera"
    files = {str(p.relative_to(folder)) for p in folder.rglob("*") if p.is_file()}
    inside = {"__init__.py", "operator.py", "instruments/camera.yaml"}
    assert files == {
        "pyproject.toml",
        "README.md",
        "tests/test_zonda_my_camera.py",
        *(f"src/zonda_my_camera/{n}" for n in inside),
    }
    assert not any("$" in (folder / name).read_text().replace("$ ", "") for name in files)
    environment = installed_plugin(folder, here / "site")
    tests = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider"]
    done = subprocess.run(tests, cwd=folder, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "4 passed" in done.stdout
    listed = subprocess.run(
        [sys.executable, "-m", "zonda", "plugins"],
        env=environment,
        capture_output=True,
        text=True,
    )
    assert "ZondaMyCameraDrift" in listed.stdout
    assert "zonda_my_camera_camera" in listed.stdout


def test_templates_are_part_of_the_package():
    import tomllib

    root = Path(__file__).parents[3]
    patterns = tomllib.loads((root / "pyproject.toml").read_text())["tool"]["setuptools"][
        "package-data"
    ]["zonda.plugins.commands"]
    folder = root / "plugins" / "commands"
    shipped = {path for pattern in patterns for path in folder.glob(pattern)}
    assert shipped == {path for path in (folder / "templates").rglob("*") if path.is_file()}
