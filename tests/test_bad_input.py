"""What a user gets for bad input, from the command line: where, what, what would mend it, and nothing half done."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from zonda.core import cli

PIPELINE = """\
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h00m00s +20d00m00s
seed: 1
operators:
  - PointingDaisy: {scan_duration: 2 s}
  - SkyMap: {file: map.fits}
  - WhiteNoise
  - Efficiency
  - BinMap
  - SaveMap
"""


WORLD = ("CTYPE1", "CTYPE2", "CRPIX1", "CRPIX2", "CRVAL1", "CRVAL2", "CDELT1", "CDELT2")


def write_map(path: Path, values: np.ndarray | None = None, **cards: object) -> None:
    from astropy.io import fits

    image = fits.PrimaryHDU(np.ones((11, 11)) if values is None else values)
    header = {"CTYPE1": "RA---TAN", "CTYPE2": "DEC--TAN", "CRPIX1": 6, "CRPIX2": 6, "CRVAL1": 75.0, "CRVAL2": 20.0}
    header |= {"CDELT1": -1 / 60, "CDELT2": 1 / 60, "CUNIT1": "deg", "CUNIT2": "deg", "BUNIT": "K", "TEMPSCAL": "K_RJ"}
    image.header.update({k: v for k, v in (header | cards).items() if v is not None})
    image.writeto(path)


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write_map(tmp_path / "map.fits")
    (tmp_path / "my.yaml").write_text(PIPELINE)
    return tmp_path


def refused(capsys, command="run", *more):
    """The message of a command that must fail as a user's mistake."""
    status = cli.main([command, "my.yaml", *(["--output", "out"] if command == "run" else []), *more])
    message = capsys.readouterr().err
    assert status == 2, message
    assert "Traceback" not in message
    left = [p for p in Path().rglob("*") if p.is_file() and p.name not in ("my.yaml", "map.fits", "resolved.yaml")]
    assert not left, left
    return message


def test_the_pipeline_itself_is_good(here, capsys):
    assert cli.main(["check", "my.yaml"]) == 0
    assert cli.main(["run", "my.yaml", "--output", "out"]) == 0
    assert (here / "out" / "map.fits").is_file()


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("map.fits", "nowhere.fits"), ["nowhere.fits", "no such file"]),
        (("- SkyMap", "- SkyMpa"), ["my.yaml:8:5", "unknown operator 'SkyMpa'", "did you mean 'SkyMap'?"]),
        (("mustang2", "mustang3"), ["my.yaml:2:13", "unknown instrument 'mustang3'", "did you mean 'mustang2'?"]),
        (("green_bank", "green_bnak"), ["my.yaml:1:7", "unknown site 'green_bnak'", "did you mean 'green_bank'?"]),
        (("2 s}", "-2 s}"), ["my.yaml:7:36", "scan_duration: must be greater than 0", "got -2 s"]),
        (("2 s}", "2 s, sample_rate: 0 Hz}"), ["my.yaml:7:54", "sample_rate: must be greater than 0 Hz, got 0 Hz"]),
        (("2 s}", "2 arcsec}"), ["my.yaml:7:38", "'arcsec' is a unit of angle"]),
        (("  - WhiteNoise\n  - Efficiency\n", "  - Efficiency\n  - WhiteNoise\n"), ["WhiteNoise", "only after Efficiency"]),
        (("  - BinMap\n  - SaveMap\n", "  - SaveMap\n  - BinMap\n"), ["SaveMap needs map", "move it below BinMap"]),
    ],
)
@pytest.mark.parametrize("command", ["check", "run"])
def test_what_the_file_shows(here, capsys, command, change, words):
    assert change[0] in PIPELINE
    (here / "my.yaml").write_text(PIPELINE.replace(*change))
    message = refused(capsys, command)
    assert all(w in message for w in words), message
    assert "^" in message  # a caret under it


@pytest.mark.parametrize(
    ("cards", "words"),
    [
        ({"BUNIT": "parsec"}, ["map.fits", "parsec", "Jy/pixel", "K_CMB"]),
        ({"BUNIT": None}, ["map.fits", "BUNIT", "unit"]),
        ({"TEMPSCAL": None}, ["map.fits", "K_RJ", "K_CMB"]),
        (dict.fromkeys(WORLD), ["CDELT", "pixel_size"]),
        ({"CDELT1": None, "CDELT2": None}, ["map.fits", "CDELT1"]),
    ],
)  # fmt: skip
def test_what_the_map_lacks(here, capsys, cards, words):
    (here / "map.fits").unlink()
    write_map(here / "map.fits", **cards)
    message = refused(capsys)
    assert all(w in message for w in words), message


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_nan_in_the_map(here, capsys, bad):
    (here / "map.fits").unlink()
    values = np.ones((11, 11))
    values[3, 4] = values[7, 7] = bad
    write_map(here / "map.fits", values)
    message = refused(capsys)
    assert all(w in message for w in ("map.fits", "2 ", "missing: zero")), message


def test_a_target_that_is_never_up(here, capsys):
    (here / "my.yaml").write_text(PIPELINE.replace("+20d00m00s", "-80d00m00s"))
    message = refused(capsys)
    assert all(w in message for w in ("never rises", "green_bank", "choose another target or site")), message


def test_a_target_that_is_up_later(here, capsys):
    (here / "my.yaml").write_text(PIPELINE.replace("2024-11-25T07:00", "2024-11-25T20:00"))
    message = refused(capsys)
    assert all(w in message for w in ("it is up (UTC) from 2024-11-2", "start then")), message


def test_a_plugin_that_cannot_be_imported(here):
    """It is named with its distribution and its fault, by the run that needs it; a run that does not is not stopped."""
    info = here / "site" / "broken_camera-0.4.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: broken-camera\nVersion: 0.4\n")
    (info / "entry_points.txt").write_text("[zonda.instruments]\nbroken_camera = broken_camera:camera\n")
    (here / "site" / "broken_camera.py").write_text("import a_module_that_is_not_there\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(here / "site"), os.environ.get("PYTHONPATH", "")])}

    def run(*arguments):
        command = [sys.executable, "-m", "zonda.core.cli", *arguments]
        return subprocess.run(command, env=environment, capture_output=True, text=True, cwd=here)

    assert run("check", "my.yaml").returncode == 0
    (here / "my.yaml").write_text(PIPELINE.replace("mustang2", "broken_camera"))
    done = run("check", "my.yaml")
    assert done.returncode == 2
    assert all(w in done.stderr for w in ("broken-camera 0.4", "a_module_that_is_not_there", "my.yaml:2:13")), done.stderr
    assert "Traceback" not in done.stderr
    listed = run("plugins", "--check")
    assert listed.returncode != 0
    assert "broken-camera 0.4" in listed.stdout + listed.stderr
    assert "mustang2" in listed.stdout


@pytest.mark.skipif(not Path("/proc/self").exists(), reason="needs a folder that nobody can write")
def test_an_output_folder_that_cannot_be_written(here, capsys):
    assert cli.main(["run", "my.yaml", "--output", "/proc/self/zonda"]) == 2
    message = capsys.readouterr().err
    assert "/proc/self/zonda: cannot be written" in message
    assert "choose another" in message
    assert "Traceback" not in message


@pytest.mark.parametrize("step", ["SaveTOD", "SaveTOD: {format: fits}"])
def test_a_disk_that_is_full(here, capsys, monkeypatch, step):
    """Simulated at the system call with which every file gets its name."""
    import errno

    (here / "my.yaml").write_text(PIPELINE.replace("  - BinMap\n", f"  - {step}\n  - BinMap\n"))

    def full(source, target):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    message = refused(capsys)
    assert "no space left on the disk" in message
