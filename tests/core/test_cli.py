from __future__ import annotations

import errno
import json
import os
import re
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from zonda import __version__
from zonda.core import cli
from zonda.core.command_options import Bytes

HEAVY = ("numpy", "astropy", "numba", "healpy", "scipy", "matplotlib", "h5py", "pydantic")
RUN = [
    sys.executable,
    "-c",
    "import sys; from zonda.core.cli import main; sys.exit(main(sys.argv[1:]))",
]

TOYS = '''
import errno, os, time
import numpy as np
from zonda.core.data import Observation
from zonda.core.storage.files import atomic_path, write_text
from zonda.core.hooks import hookimpl
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.operator import Operator
from zonda.core.site import Site

site = Site(name="zc_site", latitude="38 deg", longitude="-79 deg")

def camera():
    return Instrument(
        name="zc_camera", telescope=Telescope(name="t", diameter="100 m"), band=Band(name="b", low="78 GHz", high="108 GHz"),
        detectors=7, field_of_view="4 arcmin", main_beam_efficiency=0.3, illumination_efficiency=0.8, net="1 mK s(1/2)",
        sample_rate="100 Hz",
    )

class Stare(Operator):
    """Stares."""
    provides = frozenset({"boresight"})
    def observe(self, data):
        q, scene = np.tile([0.0, 0, 0, 1], (4096, 1)), data.scene
        data.observations.append(Observation("scan", 0, scene.site, scene.instrument, scene.instrument.focalplane(), scene.time,
                                             np.arange(4096.0), 1.0, q, q, (0, 0), scene.seed))

class Ones(Operator):
    """Makes a signal."""
    requires, provides = frozenset({"boresight"}), frozenset({"signal"})
    value: float = 1.0
    """What to fill in."""
    def exec(self, block, state):
        block.new("signal")[...] = self.value
        block.observation.log.count(self.label, "samples", block.detdata["signal"].size)

class Total(Operator):
    """Writes the sum of the signal."""
    requires, provides = frozenset({"signal"}), frozenset({"total"})
    after: str = "nothing"
    """What happens when half the file is written."""
    def prepare(self, observation):
        return []
    def exec(self, block, state):
        state.append(float(block.detdata["signal"].sum()))
    def collect(self, data, observation, state):
        data.products["total"] = sum(state)
    def finalize(self, data):
        with atomic_path(data.output / "total.txt") as path, path.open("w") as file:
            file.write("half")
            file.flush()
            if self.after == "sleep":
                print("ready", flush=True)
                time.sleep(60)
            if self.after == "full":
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
            if self.after == "fault":
                raise RuntimeError("a fault of the program")
            file.write(f" {data.products['total']} {data.provenance['resolved_yaml'].count('Total')}")

@hookimpl
def zonda_commands(group):
    @group.command()
    def wave():
        """Wave a hand."""
        print("waving")

    @group.command("run")
    def run():
        """A command that tries to replace a built-in one."""
        print("not the real one")
'''
POINTS = {
    "zonda.operators": {name: f"zc_toys:{name}" for name in ("Stare", "Ones")},
    "zonda.mapmakers": {"Total": "zc_toys:Total"},
    "zonda.sites": {"zc_site": "zc_toys:site"},
    "zonda.instruments": {"zc_camera": "zc_toys:camera"},
    "zonda.hooks": {"zc": "zc_toys"},
}
PIPELINE = (
    "site: zc_site\ninstrument: zc_camera\ntime: 2024-11-25T07:00\noperators: [Stare, Ones,"
    " Total]\n"
)


@pytest.fixture
def here(plugin: Callable[..., Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a pipeline file ``p.yaml``, whose operators come from a fake plugin; its
    site-packages are beside it.
    """
    plugin("zonda-zc", "3.1", POINTS, zc_toys=TOYS)
    folder = tmp_path / "work"
    folder.mkdir()
    (folder / "p.yaml").write_text(PIPELINE)
    monkeypatch.chdir(folder)
    return folder


def test_help_and_import_are_light() -> None:
    for arguments in (
        "['--help']",
        "['--version']",
        "['run', '--help']",
        "['weather', '--help']",
        "['weather', 'show', '--help']",
    ):
        code = (
            f"import sys, zonda; from zonda.core.cli import main; main({arguments});"
            f"print([m for m in {HEAVY} if m in sys.modules], file=sys.stderr)"
        )
        done = subprocess.run(
            [sys.executable, "-c", code], capture_output=True, text=True, check=True
        )
        assert done.stderr.strip() == "[]"
    done = subprocess.run(
        [
            sys.executable,
            "-c",
            f"import sys, zonda; print([m for m in {HEAVY} if m in sys.modules])",
        ],
        capture_output=True,
        text=True,
        check=True,
    )
    assert done.stdout.strip() == "[]"


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["--version"]) == 0
    assert capsys.readouterr().out.strip() == f"zonda {__version__}"


def test_help_lists_commands_of_plugins(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli.zonda, "_extended", False)
    monkeypatch.setattr(cli.zonda, "commands", dict(cli.zonda.commands))
    assert cli.main(["--help"]) == 0
    text = capsys.readouterr().out
    for name in ("run", "check", "plugins", "pipelines", "schema", "wave"):
        assert re.search(rf"^  {name} ", text, re.MULTILINE)
    assert "tries to replace" not in text
    assert cli.main(["wave"]) == 0
    assert capsys.readouterr().out == "waving\n"


def test_run(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert (
        cli.main(["run", "p.yaml", "--set", "Ones.value=2", "--threads", "2", "--memory", "4GB"])
        == 0
    )
    out, err = capsys.readouterr()
    assert out == "out/p/\n"
    assert f"Ones: samples: {7 * 4096}" in err
    assert (here / "out/p/total.txt").read_text() == f"half {2.0 * 7 * 4096} 1"
    resolved = here / "out/p/resolved.yaml"
    assert "value: 2.0" in resolved.read_text()
    assert cli.main(["run", str(resolved), "--output", "again"]) == 0
    assert (here / "again/total.txt").read_text() == (here / "out/p/total.txt").read_text()
    assert (here / "again/resolved.yaml").read_text() == resolved.read_text()


def test_check(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", "p.yaml"]) == 0
    assert capsys.readouterr().out.splitlines() == [
        "p.yaml: no mistakes, 3 steps",
        "  Stare",
        "  Ones",
        "  Total",
    ]
    assert cli.main(["check", "p.yaml", "--set", "Ones.valu=2", "--set", "sed=1"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "Traceback" not in err
    expected = """\
error: unknown key 'valu' for Ones
 --> --set:1:1
  |
1 | Ones.valu=2
  | ^^^^^^^^^ did you mean 'value'?
  = Ones takes: name, value
"""
    assert expected in err
    assert "did you mean 'seed'?" in err
    assert err.endswith("2 mistakes in --set\n")
    assert not (here / "out").exists()


def test_check_points_the_telescope(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["check", "mustang2_cluster"]) == 0
    out = capsys.readouterr().out
    assert "    5 scans from 2024-11-25T07:00:00Z\n    elevation: 61.1" in out
    assert re.search(
        r"largest speed of the axes: azimuth 16\d\.?\d* arcsec/s \([\d.]+ % of 0.6 deg/s\)", out
    )
    assert re.search(r"samples per FWHM of 8.5 arcsec: 15\.\d", out)
    assert cli.main(["check", "mustang2_cluster", "--set", "time=2024-11-25T18:00"]) == 2
    assert "GBT reaches 5 deg to 88 deg" in capsys.readouterr().err
    assert cli.main(["check", "mustang2_cluster", "--set", "PointingDaisy.speed=0.5 deg/s"]) == 2
    assert "this would fit: speed" in capsys.readouterr().err


def test_plugins(
    here: Path, plugin: Callable[..., Path], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["plugins"]) == 0
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["site", "zc_site", "zonda-zc", "3.1", "zc_toys:site"] in rows
    assert ["hook", "zc", "zonda-zc", "3.1", "zc_toys"] in rows
    plugin(
        "zonda-broken",
        "0.9",
        {"zonda.sites": {"cliff": "zc_broken:cliff"}},
        zc_broken="import not_to_be_found\n",
    )
    plugin(
        "zonda-typo",
        "0.8",
        {"zonda.hooks": {"x": "zc_typo"}},
        zc_typo="def zonda_progress(done): ...\n",
    )
    plugin("zonda-twin", "0.7", {"zonda.sites": {"zc_site": "zc_toys:site"}})
    assert cli.main(["plugins", "--check"]) == 1
    out, err = capsys.readouterr()
    assert re.search(r"cliff .*zonda-broken 0.9 .*FAILED", out)
    assert len(re.findall(r"zc_site .*provided twice", out)) == 2
    assert "zonda-broken 0.9; ModuleNotFoundError: No module named 'not_to_be_found'" in err
    assert "Traceback" in err  # of the plugin, to mend it
    assert "zonda-typo 0.8" in err


def test_pipelines(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    from zonda.core.configuration import locate

    (tmp_path / "one.yaml").write_text("description: The first\n")
    (tmp_path / "two.yaml").write_text("name: two\n")
    monkeypatch.setattr(
        locate, "shipped", lambda: {p.stem: p for p in sorted(tmp_path.glob("*.yaml"))}
    )
    assert cli.main(["pipelines"]) == 0
    assert capsys.readouterr().out == "one  The first\ntwo\n"


def test_shipped_pipelines_go_by_name(
    here: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    from zonda.core.configuration import locate

    monkeypatch.setattr(locate, "shipped", lambda: {"toy_cluster": here / "p.yaml"})
    (here / "toy_cluster").mkdir()  # a folder of that name is no obstacle
    assert cli.main(["check", "toy_cluster"]) == 0
    assert cli.main(["check", "toy_clustr"]) == 2
    assert "did you mean 'toy_cluster'?" in capsys.readouterr().err


def test_schema(here: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["schema"]) == 0
    assert "Stare" in json.loads(capsys.readouterr().out)["$defs"]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["run", "nowhere.yaml"], "nowhere.yaml: no such pipeline file"),
        (["run", "."], ".: is a folder, not a pipeline file"),
        (["run", "empty.yaml"], "this pipeline file is empty"),
        (["run", "latin.yaml"], "is not UTF-8 text"),
        (
            ["run", "p.yaml", "--set", "Total.after=full"],
            "total.txt: cannot be written: no space left on the disk",
        ),
        (["run", "p.yaml", "--output", "p.yaml"], "p.yaml"),
        (
            ["run", "p.yaml", "--memory", "4 apples"],
            "'4 apples' is not a size; write e.g. 4GB or 500MiB",
        ),
        (["run", "p.yaml", "--memory", "1kB"], "memory budget"),
        (
            ["run", "p.yaml", "--memory", "1000"],
            "'1000' has no unit and would be bytes; write e.g. 1GB or 500MiB",
        ),
        (["run", "p.yaml", "--threads", "0"], "0 is not in the range"),
        (["run"], "Missing argument"),
        (["rnu", "p.yaml"], "there is no command 'rnu'; did you mean 'run'?"),
        (["p.yaml"], "did you mean 'zonda run p.yaml'?"),
        (["run", "p.yaml", "--sett", "x=1"], "No such option"),
    ],
)
def test_a_users_mistake_is_exit_status_2_without_traceback(
    here: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], words: str
) -> None:
    (here / "empty.yaml").write_text("")
    (here / "latin.yaml").write_bytes(b"name: h\xe9\n")
    assert cli.main(arguments) == 2
    err = capsys.readouterr().err
    assert words in err
    assert "Traceback" not in err
    assert not list(here.rglob("*.part*"))
    assert not list(here.rglob("total.txt"))


def test_operating_system_errors(
    here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(error: OSError) -> Any:
        def load(*arguments: Any) -> Any:
            raise error

        return load

    monkeypatch.setattr(
        "zonda.core.cli.run.load",
        fail(PermissionError(errno.EACCES, "Permission denied", "secret.fits")),
    )
    assert cli.main(["check", "p.yaml"]) == 2
    assert capsys.readouterr().err == "error: secret.fits: Permission denied\n"
    monkeypatch.setattr(
        "zonda.core.cli.run.load", fail(OSError(errno.EBADF, "Bad file descriptor"))
    )  # a fault of ours: show where
    with pytest.raises(OSError, match="Bad file descriptor"):
        cli.main(["check", "p.yaml"])


def test_a_fault_of_the_program_shows_its_traceback(
    here: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    from zonda.core.pipeline import Pipeline

    def broken(*_: Any) -> None:
        raise RuntimeError("a fault of the program")

    monkeypatch.setattr(Pipeline, "_begin", broken)
    with pytest.raises(RuntimeError, match="a fault of the program"):
        cli.main(["run", "p.yaml"])


def test_a_fault_of_a_plugin_is_told(here: Path, capsys: Any) -> None:
    assert cli.main(["run", "p.yaml", "--set", "Total.after=fault"]) == 2
    assert (
        "Total: zc_toys.Total.finalize of zonda-zc 3.1 raised RuntimeError: a fault of the program"
        in capsys.readouterr().err
    )
    assert not [p for p in here.rglob("*") if "total" in p.name]


@pytest.mark.skipif(os.name != "posix", reason="signals are sent as POSIX does")
@pytest.mark.parametrize("number", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_interrupted(here: Path, number: str) -> None:
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(here.parent / "site-packages"), *sys.path])
    }
    command = [*RUN, "run", "p.yaml", "--set", "Total.after=sleep"]

    def listen() -> (
        None
    ):  # a shell starts background jobs with Ctrl-C ignored, which children inherit
        signal.signal(signal.SIGINT, signal.default_int_handler)
        signal.signal(signal.SIGHUP, signal.SIG_DFL)

    pipes: dict[str, Any] = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    with subprocess.Popen(command, env=environment, preexec_fn=listen, **pipes) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == "ready\n"
        process.send_signal(signal.Signals[number])
        out, err = process.communicate(timeout=60)
    assert process.returncode == 128 + signal.Signals[number]
    assert err.endswith("interrupted: unfinished files were removed\n")
    assert out == ""
    assert [p for p in here.rglob("*") if p.is_file()] == [here / "p.yaml"]


def test_too_little_memory(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def command(*arguments: object, **options: object) -> None:
        raise MemoryError("Unable to allocate 8 EB")

    monkeypatch.setattr(cli.zonda, "main", command)
    assert cli.main([]) == 2
    message = capsys.readouterr().err
    assert "not enough memory: Unable to allocate 8 EB" in message
    assert "make the scans shorter" in message


@pytest.mark.skipif(os.name != "posix", reason="signals are sent as POSIX does")
def test_signals_that_are_ignored_or_handled_are_left_alone(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    seen = {}

    def command(*arguments: object, **options: object) -> None:
        seen.update({number: signal.getsignal(number) for number in before})

    monkeypatch.setattr(cli.zonda, "main", command)
    try:
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        assert cli.main([]) == 0
        assert seen[signal.SIGHUP] is signal.SIG_IGN
        assert callable(seen[signal.SIGTERM])
        assert signal.getsignal(signal.SIGTERM) is signal.SIG_DFL
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


@pytest.mark.parametrize(
    ("text", "size"),
    [
        ("4GB", 4_000_000_000),
        ("500MiB", 500 << 20),
        ("1.5 kB", 1500),
        ("4000000000", 4_000_000_000),
        ("7 B", 7),
        ("2gb", 2_000_000_000),
    ],
)
def test_sizes(text: str, size: int) -> None:
    assert Bytes().convert(text, None, None) == size


def test_warnings_are_one_line(here: Path, plugin: Callable[..., Path]) -> None:
    plugin(
        "zonda-typo",
        "0.8",
        {"zonda.hooks": {"x": "zc_typo"}},
        zc_typo="def zonda_progress(done): ...\n",
    )
    environment = os.environ | {
        "PYTHONPATH": os.pathsep.join([str(here.parent / "site-packages"), *sys.path])
    }
    done = subprocess.run(
        [*RUN, "--help"], capture_output=True, text=True, env=environment, check=True
    )
    (line,) = done.stderr.splitlines()
    assert line.startswith(
        "warning: plugin zonda-typo 0.8 (zc_typo): 'zonda_progress' is not called"
    )


def test_a_shipped_pipeline_given_as_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert cli.main(["mustang2_cluster"]) == 2
    assert "did you mean 'zonda run mustang2_cluster'?" in capsys.readouterr().err


def test_python_m_zonda_is_the_command() -> None:
    def run(*arguments: str) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "zonda", *arguments], capture_output=True, text=True, check=False
        )

    assert __version__ in run("--version").stdout
    wrong = run("check", "nowhere.yaml")
    assert wrong.returncode == 2
    assert "nowhere.yaml" in wrong.stderr
    assert "Traceback" not in wrong.stderr


@pytest.mark.parametrize("text", ["name=\udcff", "n\udcffe=1"])
def test_a_setting_that_is_not_utf8_is_a_users_mistake(here, capsys, text):
    """Bytes of the command line that are no UTF-8 come as surrogates."""
    assert cli.main(["check", "p.yaml", "--set", text]) == 2
    assert "a setting that is not UTF-8" in capsys.readouterr().err
