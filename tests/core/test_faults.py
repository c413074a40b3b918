"""What plugin code raises is told as a plugin's fault, whatever it is and wherever it is raised."""

from __future__ import annotations

import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from zonda.core import cli, registry
from zonda.core.errors import PluginError, ZondaError
from zonda.core.faults import fault, faults_named

Plugin = Callable[..., Path]

BREAKS = '''
import sys
import click
import numpy as np
from pydantic import field_validator
from zonda.core.data import Block
from zonda.core.errors import InputError
from zonda.core.instrument import Band
from zonda.core.operator import Operator
from zonda.core.output import Output
from zonda.core.plan.bounds import Estimate, Traits
from zonda.core.plan.planning import Planning
from zonda.core.site import Site
from zonda.operators.noise.models import NoiseModel

HOW = ""

def act():
    if HOW == "sys.exit(0)":
        sys.exit(0)
    if HOW == "click":
        raise click.exceptions.Exit(0)
    if HOW == "input":
        raise InputError("no such table", place="table.csv", cure="write one")
    raise {"ValueError": ValueError("not so"), "KeyError": KeyError("x"), "GeneratorExit": GeneratorExit(),
           "StopIteration": StopIteration(), "KeyboardInterrupt": KeyboardInterrupt()}[HOW]

class Breaks(Operator):
    """Breaks at a place."""
    requires, provides = frozenset({"signal"}), frozenset({"signal"})
    where: str = ""
    """The place."""
    def at(self, place):
        if place == self.where:
            act()
    @field_validator("where")
    @classmethod
    def valid(cls, where):
        if where == "validator":
            act()
        return where
    def observe(self, data): self.at("observe")
    def check(self, data):
        self.at("check")
        return []
    def configure(self, observation): self.at("configure")
    def prepare(self, observation): self.at("prepare")
    def halo(self, observation):
        self.at("halo")
        return 0
    def exec(self, block, state): self.at("exec")
    def collect(self, data, observation, state): self.at("collect")
    def finalize(self, data): self.at("finalize")

class Plans(Planning):
    """What the planner asks."""
    of = Breaks
    def in_time_order(self, observation):
        self.operator.at("in_time_order")
        return False
    def memory(self, observation):
        self.operator.at("memory")
        return 0
    def sweeps(self, observation): return 1
    def traits(self, observation):
        self.operator.at("traits")
        return Traits()
    def estimate(self, context):
        self.operator.at("estimate")
        return Estimate()

class Measures(Breaks):
    """Reads it all."""
    couples = "all"
    def measure(self, stream, model=None):
        self.at("measure")
        for _ in stream.sweep(lambda detectors, samples, part: self.at("sweep")):
            pass

class Ends(Output):
    """Acts at the end."""
    where: str = ""
    """The place."""
    def watch(self, data, done):
        if self.where == done:
            act()
    def finalize(self, data):
        if self.where == "end":
            act()

class Noise(NoiseModel):
    """A model."""
    def net(self, observation):
        act()

def hill():
    act()

def metric(data):
    act()
'''
GROUPS = {
    "zonda.operators": {
        "Breaks": "zf_breaks:Breaks",
        "Measures": "zf_breaks:Measures",
        "Ends": "zf_breaks:Ends",
    },
    "zonda.planning": {"Breaks": "zf_breaks:Plans"},
    "zonda.noise_models": {"zf_noise": "zf_breaks:Noise"},
    "zonda.sites": {"zf_hill": "zf_breaks:hill"},
    "zonda.metrics": {"zf_metric": "zf_breaks:metric"},
}
HEAD = (
    "version: 1\nname: faults\nseed: 5\nsite: {site}\ninstrument: mustang2\ntime:"
    " 2024-11-25T07:00\ntarget: 05h +20d\n"
)
STEPS = """operators:
  - PointingStare: {{scan_duration: 2 s}}
  - WhiteNoise: {noise}
  - Efficiency
{step}  - BinMap: {{pixel: 20 arcsec}}
"""


@pytest.fixture
def breaks(
    plugin: Plugin, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> Callable[..., tuple[int, str]]:
    """Runs a command in this process, with a pipeline that holds a step that does ``how``; the exit
    status and what was said.
    """
    monkeypatch.chdir(tmp_path)
    for each in registry.registries:  # classes of the same name, of the test before
        monkeypatch.setattr(each, "_loaded", {})

    def run(
        how: str,
        step: str = "",
        *command: str,
        site: str = "green_bank",
        noise: str = "{}",
        more: str = "",
    ) -> tuple[int, str]:
        if not (tmp_path / "site-packages" / "zf_breaks.py").exists():
            plugin("zf-breaks", "1.5", GROUPS, zf_breaks=BREAKS)
        import zf_breaks

        zf_breaks.HOW = how
        text = (
            HEAD.format(site=site)
            + STEPS.format(noise=noise, step=f"  - {step}\n" if step else "")
            + more
        )
        (tmp_path / "faults.yaml").write_text(text)
        status = cli.main(
            [*(command or ("run", "--threads", "2", "--output", "out")), "faults.yaml"]
        )
        return status, ""

    return run


WAYS = {
    "sys.exit(0)": "asked for the end of the program (SystemExit: 0)",
    "ValueError": "raised ValueError: not so",
    "GeneratorExit": "asked for the end of the program (GeneratorExit)",
    "StopIteration": "raised StopIteration",
    "click": "raised Exit: 0",
}
PLACES = ["observe", "configure", "prepare", "halo", "exec", "collect", "finalize"]


def told(status: int, err: str, words: str, place: str) -> None:
    assert status == 2, err
    assert "Traceback" not in err
    assert words in err
    assert "this is a fault in zf-breaks 1.5, not in your pipeline: " in err
    assert re.search(r"zf_breaks\.py, line \d+", err)
    assert place in err


@pytest.mark.parametrize("where", PLACES)
def test_whatever_method_ends_the_program(breaks: Any, capsys: Any, where: str) -> None:
    status, _ = breaks("sys.exit(0)", f"Breaks: {{where: {where}}}")
    told(
        status,
        capsys.readouterr().err,
        WAYS["sys.exit(0)"],
        f"Breaks: zf_breaks.Breaks.{where} of zf-breaks 1.5 ",
    )


@pytest.mark.parametrize("where", ["in_time_order", "memory", "traits", "estimate"])
def test_planning_too(breaks: Any, capsys: Any, where: str) -> None:
    command = ("run", "--prune", "--threads", "2", "--output", "out")
    status, _ = breaks("sys.exit(0)", f"Breaks: {{where: {where}}}", *command)
    told(
        status,
        capsys.readouterr().err,
        WAYS["sys.exit(0)"],
        f"Breaks: zf_breaks.Plans.{where} of zf-breaks 1.5 ",
    )


@pytest.mark.parametrize("how", list(WAYS))
def test_whatever_is_raised_on_any_thread(breaks: Any, capsys: Any, how: str) -> None:
    status, _ = breaks(how, "Breaks: {where: exec}")
    told(status, capsys.readouterr().err, WAYS[how], "Breaks: zf_breaks.Breaks.exec")


@pytest.mark.parametrize("where", ["measure", "sweep"])
def test_measuring(breaks: Any, capsys: Any, where: str) -> None:
    status, _ = breaks("sys.exit(0)", f"Measures: {{where: {where}}}")
    told(
        status, capsys.readouterr().err, WAYS["sys.exit(0)"], "Measures: zf_breaks.Measures.measure"
    )


@pytest.mark.parametrize("where", ["pointing", "scan", "maps", "end"])
def test_what_acts_at_the_end(breaks: Any, capsys: Any, where: str) -> None:
    status, _ = breaks("sys.exit(0)", "", more=f"  - Ends: {{where: {where}}}\n")
    told(status, capsys.readouterr().err, WAYS["sys.exit(0)"], "Ends: zf_breaks.Ends.")


@pytest.mark.parametrize("where", ["check", "validator"])
def test_checking_a_pipeline(breaks: Any, capsys: Any, where: str) -> None:
    status, _ = breaks("sys.exit(0)", f"Breaks: {{where: {where}}}", "check")
    told(status, capsys.readouterr().err, WAYS["sys.exit(0)"], "zf_breaks.Breaks.")


@pytest.mark.parametrize("how", ["sys.exit(0)", "KeyError"])
def test_other_components(breaks: Any, capsys: Any, how: str) -> None:
    status, _ = breaks(how, "", noise="{model: zf_noise}")
    told(
        status,
        capsys.readouterr().err,
        WAYS.get(how, "raised KeyError: 'x'"),
        ": zf_breaks.Noise.net of zf-breaks 1.5",
    )
    status, _ = breaks(how, "", "check", site="zf_hill")
    err = capsys.readouterr().err
    assert status == 2, err
    assert "site 'zf_hill' could not be loaded from the plugin zf-breaks 1.5" in err
    assert how.startswith("sys") == ("SystemExit: 0" in err)


def test_a_user_s_mistake_stays_one(breaks: Any, capsys: Any) -> None:
    status, _ = breaks("input", "Breaks: {where: prepare}")
    assert status == 2
    assert "error: table.csv: no such table\n  = write one" in capsys.readouterr().err


def test_ctrl_c_stays_ctrl_c(breaks: Any, capsys: Any) -> None:
    status, _ = breaks("KeyboardInterrupt", "Breaks: {where: exec}")
    assert status == 130
    assert "interrupted" in capsys.readouterr().err


def test_a_campaign_s_tasks(breaks: Any, capsys: Any) -> None:
    """In worker processes, too: a task that ends its process would be taken for one that was
    killed, or for done.
    """
    campaign = "campaign: {realizations: 2}\n"
    status, _ = breaks(
        "sys.exit(0)",
        "Breaks: {where: exec}",
        "run",
        "--engine",
        "serial",
        "--output",
        "out",
        more=campaign,
    )
    err = capsys.readouterr().err
    assert status == 2, err
    assert (
        "tasks failed; the first is 0: Breaks: zf_breaks.Breaks.exec of zf-breaks 1.5 asked for"
        " the end" in err
    )


BAD = "import sys\nsys.exit(0)\n"


def test_a_module_that_ends_the_program_at_import(plugin: Plugin, capsys: Any) -> None:
    plugin(
        "zf-ends",
        "0.1",
        {"zonda.operators": {"Leaves": "zf_ends:Leaves"}, "zonda.sites": {"away": "zf_ends:away"}},
        zf_ends=BAD,
    )
    assert cli.main(["plugins", "--check"]) == 1
    out, err = capsys.readouterr()
    assert [line.split()[-1] for line in out.splitlines() if "zf-ends" in line] == [
        "FAILED",
        "FAILED",
    ]
    assert "operator 'Leaves' could not be loaded from the plugin zf-ends 0.1; SystemExit: 0" in err
    assert "2 faults" in err


def test_a_hook_that_ends_the_program_is_left_out(plugin: Plugin, capsys: Any) -> None:
    plugin("zf-hook", "0.1", {"zonda.hooks": {"x": "zf_hook"}}, zf_hook=BAD)
    assert cli.main(["plugins", "--check"]) == 1
    assert "plugin zf-hook 0.1 (zf_hook): left out: SystemExit: 0" in capsys.readouterr().err


COMMAND = """
import sys, click
from zonda.core.hooks import hookimpl
@hookimpl
def zonda_commands(group):
    @group.command()
    def leave():
        "Leaves."
        sys.exit(7)
"""


def test_a_plugin_s_own_command_ends_as_it_likes(
    plugin: Plugin, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(cli.zonda, "commands", dict(cli.zonda.commands))
    monkeypatch.setattr(
        cli.zonda, "_extended", False
    )  # another test may have asked for the plugins' commands
    plugin("zf-command", "0.1", {"zonda.hooks": {"x": "zf_command"}}, zf_command=COMMAND)
    with pytest.raises(SystemExit) as caught:
        cli.main(["leave"])
    assert caught.value.code == 7


def test_in_python_an_exception_is_what_it_was(breaks: Any, capsys: Any) -> None:
    """With a note; but what would end the interpreter is an error."""
    from zonda.core.configuration.pipeline_file import load

    breaks("pass", "Breaks: {where: exec}", "check")
    file = load("faults.yaml", ())
    sys.modules["zf_breaks"].HOW = "ValueError"  # type: ignore[attr-defined]
    with pytest.raises(ValueError, match="not so") as caught:
        file.pipeline().run(file.scene(), threads=1)
    assert len(caught.value.__notes__) == 1
    assert (
        "Breaks: zf_breaks.Breaks.exec of zf-breaks 1.5 raised ValueError: not so"
        in caught.value.__notes__[0]
    )
    sys.modules["zf_breaks"].HOW = "sys.exit(0)"  # type: ignore[attr-defined]
    with pytest.raises(PluginError, match="asked for the end"):
        file.pipeline().run(file.scene(), threads=1)


def test_what_is_no_plugin_s_is_left_alone() -> None:
    with pytest.raises(ZeroDivisionError) as caught, faults_named():
        _ = 1 / 0
    assert fault(caught.value) is None
    with pytest.raises(ZondaError, match="mine"), faults_named():
        raise ZondaError("mine")
