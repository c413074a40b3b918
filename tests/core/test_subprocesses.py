"""Processes that zonda starts find no modules in the folder they run in, and all that this one
finds.
"""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from zonda.core import machine
from zonda.core.accuracy.bench import run_in
from zonda.core.experiment.engines import engine
from zonda.core.experiment.variant import FileVariant

from ..scenes import camera

NAMES = (
    "zonda",
    "multiprocessing",
    "numpy",
    "numba",
    "encodings",
    "json",
    "pickle",
    "re",
    "h5py",
    "site",
    "subprocess",
    "tempfile",
)
"""Of modules that children import; a folder of the user may hold files of these names."""

SHORT = (
    "--set",
    "PointingDaisy.scan_duration=4 s",
    "--set",
    "PointingDaisy.scans=2",
    "--threads",
    "1",
)

CAMPAIGN = f"""\
{camera(7)}campaign: {{nights: 2}}
operators:
  - PointingDaisy: {{radius: 1 arcmin, speed: 50 arcsec/s, scan_duration: 3 s, scans: 1}}
  - WhiteNoise
  - Efficiency
  - BinMap: {{pixel: 8 arcsec}}
  - SaveMap
"""

START = (
    "import sys\nfrom zonda.core.cli import main\nif __name__ == '__main__':\n   "
    " sys.exit(main(sys.argv[1:]))\n"
)


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A folder with modules that leave a word when they run."""
    folder = tmp_path / "here"
    folder.mkdir()
    for name in NAMES:
        trap = (
            f"open({str(tmp_path / 'sprung')!r}, 'a').write({name!r} + '\\n')\nraise"
            f" ImportError('{name}.py of this folder')\n"
        )
        (folder / f"{name}.py").write_text(trap)
    return folder


def environment(folder: Path, **more: str) -> dict[str, str]:
    """As a shell has it: the packages are found, and nothing is remembered from earlier runs."""
    given = {name: value for name, value in os.environ.items() if name != machine.SAFE}
    path = os.pathsep.join(p for p in sys.path if p)
    return {**given, "PYTHONPATH": path, "ZONDA_CACHE_DIR": str(folder / "cache"), **more}


def zonda(hostile: Path, *arguments: Any) -> subprocess.CompletedProcess[str]:
    """The command in the hostile folder. It is started by a script of another one, as an installed
    `zonda` is.
    """
    start = hostile.parent / "bin" / "start.py"
    start.parent.mkdir(exist_ok=True)
    start.write_text(START)
    command = [sys.executable, str(start), *map(str, arguments)]
    return subprocess.run(
        command, cwd=hostile, env=environment(hostile.parent), capture_output=True, text=True
    )


def unsprung(hostile: Path, done: subprocess.CompletedProcess[str]) -> None:
    sprung = hostile.parent / "sprung"
    assert not sprung.exists(), f"ran the folder's {sprung.read_text().split()}\n{done.stderr}"
    assert done.returncode == 0, done.stderr


def test_the_traps_work(hostile: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", "import h5py"],
        cwd=hostile,
        env=environment(hostile.parent),
        capture_output=True,
    )
    assert done.returncode == 1
    assert "h5py" in (hostile.parent / "sprung").read_text().split()


def test_a_run_with_its_pictures(hostile: Path) -> None:
    """A first run, compilation and pictures included."""
    unsprung(
        hostile,
        zonda(hostile, "run", "mustang2_cluster", *SHORT, "--output", hostile.parent / "out"),
    )


@pytest.mark.nightly
def test_a_plan(hostile: Path) -> None:
    unsprung(hostile, zonda(hostile, "plan", "mustang2_cluster", *SHORT[:4]))


@pytest.mark.nightly
def test_a_study_of_accuracy(hostile: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = hostile.parent / "a.yaml"
    path.write_text(CAMPAIGN.replace("campaign: {nights: 2}\n", ""))
    monkeypatch.chdir(hostile)
    with engine("processes", workers=1, threads=1) as pool:
        run = run_in(pool, FileVariant(path), "map_rms", 1, None, False)
    assert run.found
    assert not (hostile.parent / "sprung").exists()


@pytest.mark.nightly
@pytest.mark.parametrize("engine", ["serial", "processes"])
def test_a_campaign(hostile: Path, engine: str) -> None:
    (hostile.parent / "c.yaml").write_text(CAMPAIGN)
    options = (
        "--engine",
        engine,
        "--output",
        hostile.parent / "out",
        *(("--workers", "2") if engine == "processes" else ()),
    )
    unsprung(hostile, zonda(hostile, "run", hostile.parent / "c.yaml", *options))


def test_modules_of_pythonpath_are_found(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also those of a folder that was put into the path later, and arguments arrive as they are."""
    (tmp_path / "za_child.py").write_text(
        "def main(*given):\n    print(*map(repr, given))\n    return len(given)\n"
    )
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir("/")
    done = subprocess.run(
        machine.command("za_child", "main", 3, 'it\'s \\ "so"'), capture_output=True, text=True
    )
    assert done.returncode == 2, done.stderr
    assert done.stdout == "3 " + repr('it\'s \\ "so"') + "\n"


@pytest.mark.parametrize("before", [None, "", "1"])
def test_the_environment_is_as_before(monkeypatch: pytest.MonkeyPatch, before: str | None) -> None:
    if before is None:
        monkeypatch.delenv(machine.SAFE, raising=False)
    else:
        monkeypatch.setenv(machine.SAFE, before)
    with machine.safe_path():
        assert os.environ[machine.SAFE] == "1"
    assert os.environ.get(machine.SAFE) == before


def test_no_interpreter_to_start_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sys, "executable", None)
    with pytest.raises(OSError, match="no Python interpreter"):
        machine.command("zonda", "main")
