"""Processes that steps want, before their modules are imported."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from zonda.core import early

SOURCE = """
calls = []

class Started:
    def __init__(self):
        calls.append(self)
        self.open = True

    def close(self):
        self.open = False

def broken():
    raise OSError("no more processes")
"""

MINIMAL = """
site: green_bank
instrument: mustang2
time: 2024-11-25T02:00-05:00
target: 05h00m00s +20d00m00s
operators: [PointingDaisy: {radius: 4 arcmin, speed: 50 arcsec/s, scan_duration: 1 min}, WhiteNoise]
"""


@pytest.fixture
def started(plugin: Callable[..., Path]):
    plugin(
        "zonda-ze",
        "1",
        {early.GROUP: {"Draws": "ze_toys:Started", "Fails": "ze_toys:broken"}},
        ze_toys=SOURCE,
    )
    yield lambda: sys.modules["ze_toys"].calls if "ze_toys" in sys.modules else []
    early.end()


def begin(tmp_path: Path, text: str) -> None:
    (tmp_path / "p.yaml").write_text(text)
    early.begin(str(tmp_path / "p.yaml"))


@pytest.mark.parametrize(
    "step",
    ["- Draws", "  - Draws: {a: 1}", "  - 'Draws': {}", '-  "Draws"', "- Draws # all", "- Draws :"],
)
def test_a_step_has_its_process(started, tmp_path, step):
    begin(tmp_path, f"name: x\noperators:\n{step}\n- Fails\n")
    (process,) = started()
    assert early.take(type(process)) is process
    early.end()
    assert process.open  # whoever took it closes it


@pytest.mark.parametrize(
    "step",
    [
        "- DrawsNot",
        "# - Draws",
        "description: - Draws it",
        "- Draws: {}\ncampaign: {}",
        "- Draws it",
    ],
)
def test_other_text_has_none(started, tmp_path, step):
    begin(tmp_path, f"operators:\n{step}\n")
    assert started() == []


def test_what_nobody_takes_is_closed(started, tmp_path):
    begin(tmp_path, "operators:\n- Draws\n")
    early.end()
    (process,) = started()
    assert not process.open
    other = early.take(type(process))
    assert other is not process
    assert other.open


def test_a_file_that_is_not_there_is_somebody_elses_affair(tmp_path):
    early.begin(str(tmp_path / "none.yaml"))


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
def test_a_pipe_is_left_to_who_reads_the_file(monkeypatch, tmp_path):
    """``zonda run <(...)``: what is read of it is gone."""
    opened: list[Path] = []
    monkeypatch.setattr("zonda.core.configuration.locate.read", opened.append)
    os.mkfifo(tmp_path / "pipe")
    early.begin(str(tmp_path / "pipe"))
    assert opened == []


def test_a_campaign_that_the_text_does_not_show_closes_it_before_it_begins(
    started, tmp_path, monkeypatch
):
    """Its tasks run for hours."""
    from click.testing import CliRunner

    from zonda.core import cli
    from zonda.core.campaign import command

    (tmp_path / "p.yaml").write_text('"campaign": {realizations: 2}\nx-list:\n- Draws\n' + MINIMAL)
    monkeypatch.setattr("zonda.core.machine.available_threads", lambda: 2)
    monkeypatch.setattr(command, "run", lambda *a, **k: seen.extend(p.open for p in started()))
    seen: list[bool] = []
    done = CliRunner().invoke(cli.zonda, ["run", str(tmp_path / "p.yaml")], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    assert seen == [False]


@pytest.mark.skipif(not Path("/proc/self").is_dir(), reason="looks for processes in /proc")
@pytest.mark.parametrize(
    ("more", "count"), [([], 1), (["--threads", "1"], 0), (["--engine", "serial"], 0)]
)
def test_a_mistake_in_the_file_is_told_as_ever_and_nothing_is_left(started, tmp_path, more, count):
    """The child of a run that ends at once ends with it."""
    log = tmp_path / "log"
    source = f"""
import subprocess, sys
class Sleeper:
    def __init__(self):
        self.process = subprocess.Popen([sys.executable, "-c", "import sys; sys.stdin.read()"], stdin=subprocess.PIPE)
        open({str(log)!r}, "a").write(f"{{self.process.pid}}\\n")
    def close(self):
        self.process.kill()
        self.process.wait()
"""
    folder = tmp_path / "site-packages"
    (folder / "ze_toys.py").write_text(source + "Started = Sleeper\n")
    (tmp_path / "bad.yaml").write_text("site: green_bank\noperators:\n- Draws\n")
    log.write_text("")
    command = [sys.executable, "-m", "zonda.core.cli", "run", "bad.yaml", *more]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(folder), *sys.path])}
    run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True, env=environment)
    assert run.returncode == 2
    assert "unknown operator 'Draws'" in run.stderr
    assert "Traceback" not in run.stderr
    found = log.read_text().split()
    if len(os.sched_getaffinity(0)) > 1:
        assert len(found) == count
    assert not any(Path(f"/proc/{pid}").exists() for pid in found)
