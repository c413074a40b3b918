"""`zonda accuracy` and `zonda run --verify` in processes of their own, on a toy whose error and
cost are known.
"""

import json
import os

import pytest

from zonda.core import cli

MODULE = '''
import numpy as np
from zonda.core.data import Observation
from zonda.core.errors import InputError
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.plan.planning import Knob
from zonda.core.operator import Operator
from zonda.core.plan.planning import Planning
from zonda.core.site import Site

site = Site(name="za_site", latitude="38 deg", longitude="-79 deg")

def camera():
    return Instrument(
        name="za_camera", telescope=Telescope(name="t", diameter="100 m"), band=Band(name="b", low="78 GHz", high="108 GHz"),
        detectors=7, field_of_view="4 arcmin", main_beam_efficiency=0.3, illumination_efficiency=0.8, net="1 mK s(1/2)",
        sample_rate="100 Hz",
    )

class Stare(Operator):
    """Stares."""
    provides = frozenset({"boresight"})
    scan_duration: float = 4096.0
    """Samples."""
    def observe(self, data):
        n = int(self.scan_duration)
        q, scene = np.tile([0.0, 0, 0, 1], (n, 1)), data.scene
        data.observations.append(Observation("scan", 0, scene.site, scene.instrument, scene.instrument.focalplane(), scene.time,
                                             np.arange(float(n)), 1.0, q, q, (0, 0), scene.seed))

class Integral(Operator):
    """The integral of exp over 0 .. 1 by the trapezium rule on n intervals: its error is 1 / (12 n^2) to first order."""
    requires, provides = frozenset({"boresight"}), frozenset({"signal"})
    n: int = 4
    """Intervals."""
    def prepare(self, observation):
        if self.n == 2:
            raise InputError("two is no number", place=self.label)
        work = np.ones(30000)
        for _ in range(3 * self.n):  # in proportion to n
            work = np.sin(work)
        x = np.exp(np.linspace(0, 1, self.n + 1))
        return (x[1:] + x[:-1]).mean() / 2
    def exec(self, block, state):
        block.new("signal")[...] = state
    def finalize(self, data):
        x = np.exp(np.linspace(0, 1, self.n + 1))
        data.products["integral"] = (x[1:] + x[:-1]).mean() / 2 + 1e-9 * data.scene.seed

class IntegralPlanning(Planning[Integral]):
    of = Integral
    knobs = (Knob("n", (1, 2, 4, 8, 64), "an integral by a sum"),)

def integral(data):
    return data.products["integral"]
'''
GROUPS = {
    "zonda.sites": {"za_site": "za_toys:site"},
    "zonda.instruments": {"za_camera": "za_toys:camera"},
    "zonda.operators": {"ZaStare": "za_toys:Stare", "ZaIntegral": "za_toys:Integral"},
    "zonda.planning": {"Integral": "za_toys:IntegralPlanning"},
    "zonda.metrics": {"integral": "za_toys:integral"},
}
PIPELINE = """
site: za_site
instrument: za_camera
time: 2024-11-25T07:00
seed: 3
operators: [ZaStare, ZaIntegral]
"""


@pytest.fixture
def toy_file(plugin, tmp_path, monkeypatch):
    folder = plugin("zonda-accuracy-toys", "1.0", GROUPS, za_toys=MODULE)
    monkeypatch.setenv(
        "PYTHONPATH", os.pathsep.join([str(folder), *filter(None, [os.environ.get("PYTHONPATH")])])
    )
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "toy.yaml"
    path.write_text(PIPELINE)
    return path


def command(*arguments):
    return cli.main([str(a) for a in arguments])


def test_the_whole_command(toy_file, tmp_path, capsys):
    options = (
        "--metric",
        "integral",
        "--repeats",
        "2",
        "--seeds",
        "2",
        "--knob",
        "n",
        "--target",
        "0.3 %",
        "--store",
    )
    assert command("accuracy", toy_file, *options, "--output", tmp_path / "out") == 0
    printed = capsys.readouterr()
    said, told = printed.out, printed.err.splitlines()
    assert told[0].startswith("integral of toy: 1 knob, at most 30 runs")
    assert len(told) > 5
    assert all(line.startswith("run ") and " of at most 30: " in line for line in told[1:])
    assert "refused: two is no number" in said
    assert {p.name for p in (tmp_path / "out").iterdir()} == {
        "accuracy.txt",
        "front.json",
        "work_precision.png",
        "fragment.yaml",
    }
    values = json.loads((tmp_path / "out" / "front.json").read_text())
    for rung in values["alone"][0]["rungs"]:
        if rung["value"] in ("1", "4", "8"):
            n = int(rung["value"])
            assert rung["error"] == pytest.approx(
                1 / (12 * n**2) - 1 / (12 * 64**2), rel=0.03
            )  # next term: 1 / (720 n^4)
    assert values["chosen"]["setting"] == {"ZaIntegral.n": "8"}  # 0.13 %; 4 intervals have 0.52 %
    # the process's own memory, not this one's: an interpreter with numpy, well below what pytest
    # and its plugins take
    assert all(1e7 < p["memory"] < 1e9 for p in values["points"])
    assert (tmp_path / "out" / "work_precision.png").read_bytes()[:4] == b"\x89PNG"
    assert "- ZaIntegral: {n: 8}" in (tmp_path / "out" / "fragment.yaml").read_text()

    # the stored Pareto front is used and holds
    assert command("accuracy", toy_file, "--metric", "integral", "--check") == 0
    assert capsys.readouterr().out.count("ok") >= 2
    wanted = "accuracy={target: 0.3 %, metric: integral}"
    assert command("run", toy_file, "--set", wanted, "--verify", "--output", tmp_path / "run") == 0
    said = capsys.readouterr().err
    assert "accuracy: stored Pareto front of integral: " in said
    assert "ZaIntegral.n=8" in said
    assert "error of integral against the tightest knobs: 0.13 % (target 0.3 %)" in said
    assert "n: 8" in (tmp_path / "run" / "resolved.yaml").read_text()


def test_no_setting_meets_the_target(toy_file, tmp_path, capsys):
    options = (
        "--metric",
        "integral",
        "--repeats",
        "2",
        "--seeds",
        "1",
        "--target",
        "1e-7",
        "--json",
        "--output",
        tmp_path / "out",
    )
    assert command("accuracy", toy_file, *options) == 1
    printed = capsys.readouterr()
    values = json.loads(printed.out)
    assert values["chosen"] is None
    assert "cause: ZaIntegral.n" in printed.err
    assert values["reference_error"] > 1e-7
    assert values["realization_scatter"] is None


@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--metric", "map_rsm"), "did you mean 'map_rms'?"),
        (("--metric", "map_rms"), "needs map, which no step makes"),
        (("--metric", "peak"), "needs map"),
        (("--metric", "transfer"), "needs map"),
        (("--metric", "psd"), "add PowerSpectrum"),
        (("--metric", "structure"), "add AtmosphereLayers"),
        (("--metric", "integral", "--target", "0"), "target must be above 0"),
        (("--metric", "integral", "--target", "-3 %"), "target must be above 0"),
        (("--metric", "integral", "--target", "3 m"), "unit of length"),
        (("--metric", "integral", "--knob", "m"), "ZaIntegral.n"),
        (("--metric", "integral", "--knob", "ZaIntegrl"), "did you mean 'ZaIntegral"),
        (("--metric", "integral", "--check"), "integral.json"),
        (("--metric", "integral", "--duration", "soon"), "soon"),
    ],
)
def test_mistakes(toy_file, capsys, options, words):
    assert command("accuracy", toy_file, *options) == 2
    said = capsys.readouterr().err
    assert words in said
    assert "Traceback" not in said


def test_the_run_names_a_metric_that_is_not_there(toy_file, capsys):
    assert command("run", toy_file, "--set", "accuracy={target: 1 %, metric: integrl}") == 2
    assert "did you mean 'integral'?" in capsys.readouterr().err
