"""The machine of each task is on record; another kind of machine is reported, or refused."""

from __future__ import annotations

import json

import pytest

from zonda.core.campaign import machines
from zonda.core.campaign.machines import Watch, differences, kind, kinds, read
from zonda.core.machine import arithmetic

SERIAL = ("--engine", "serial", "--threads", 1)
OTHER = {"cpu": "another-cpu", "numpy": "2.3.1"}
SMALL = "{nights: 3}"  # of two scans: six tasks


def other_kind():
    return json.dumps(json.loads(machines.here()) | OTHER, sort_keys=True)


@pytest.fixture
def moving(monkeypatch):
    """Tasks of this process run elsewhere from the ``after``-th on."""
    mine, strange = machines.here(), other_kind()

    def begin(after, until=10**6):
        calls = iter(range(10**6))
        monkeypatch.setattr(
            machines, "here", lambda: strange if after <= next(calls) < until else mine
        )

    return begin


def status(bench, out, capsys):
    capsys.readouterr()
    assert bench.command("status", out, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert bench.command("status", out) == 0
    return found, capsys.readouterr().out


@pytest.mark.nightly
@pytest.mark.parametrize(
    "engine", [SERIAL, ("--engine", "processes", "--workers", 2)], ids=["serial", "processes"]
)
def test_each_task_has_its_machine(bench, capsys, engine):
    out = bench.run(SMALL, *engine)
    assert "another kind" not in capsys.readouterr().err
    found, said = status(bench, out, capsys)
    (machine,) = found["machines"]
    assert machine == arithmetic()
    assert {
        "zonda",
        "numpy",
        "numba",
        "scipy",
        "astropy",
        "cpu",
        "instructions",
        "processor",
    } <= machine.keys()
    assert [task["machine"] for task in found["tasks"]] == [0] * 6
    assert f"numpy {machine['numpy']}" in said
    assert machine["cpu"] in said


def test_another_kind_is_told_once(bench, moving, capsys):
    moving(3)
    out = bench.run(SMALL, *SERIAL)
    said = capsys.readouterr().err
    assert said.count("ran on another kind of machine or with other libraries than the first") == 1
    assert "task 3" in said
    assert f"numpy 2.3.1 ({arithmetic()['numpy']} there)" in said
    found, said = status(bench, out, capsys)
    assert [task["machine"] for task in found["tasks"]] == [0, 0, 0, 1, 1, 1]
    assert "2 kinds: maps of the two may differ in the last bits" in said
    assert "3 tasks: another-cpu" in said


def test_another_kind_is_refused_on_request(bench, moving, capsys):
    whole = bench.run(SMALL, *SERIAL)
    moving(3)
    out = bench.run("{nights: 3, same_machine: true}", *SERIAL, status=2)
    assert "same_machine refuses it" in capsys.readouterr().err
    assert not (out / "map.fits").exists()
    assert len(list((out / "tasks").glob("0000*.npz"))) == 3  # that of the fourth is gone
    moving(0)
    assert bench.command("resume", out, *SERIAL) == 2  # still elsewhere
    assert "another-cpu" in capsys.readouterr().err
    moving(10**6)
    assert bench.command("resume", out, *SERIAL) == 0
    assert bench.planes(out) == bench.planes(whole)
    found, _ = status(bench, out, capsys)
    assert len(found["machines"]) == 1


def test_what_another_kind_has_done_is_done_again_on_request(bench, moving, capsys):
    file, out = bench.file(SMALL), bench.new()
    assert bench.command("run", file, "--output", out, *SERIAL, "--task", "1/2") == 0
    moving(0)
    assert bench.command("run", file, "--output", out, *SERIAL, "--task", "2/2") == 0
    assert "another kind of machine" in capsys.readouterr().err  # the first share's products say so
    assert len(status(bench, out, capsys)[0]["machines"]) == 2
    moving(10**6)
    assert bench.command("resume", out, *SERIAL, "--same-machine") == 0
    assert (
        "3 tasks ran on another kind of machine than the first: run again"
        in capsys.readouterr().err
    )
    assert len(status(bench, out, capsys)[0]["machines"]) == 1


def test_the_campaign_s_word_can_be_taken_back(bench, moving, capsys):
    moving(3)
    out = bench.run("{nights: 3, same_machine: true}", *SERIAL, status=2)
    moving(0)
    assert bench.command("resume", out, *SERIAL, "--any-machine") == 0
    assert "another kind of machine" in capsys.readouterr().err


def test_what_counts_as_another_kind():
    one = {
        "cpu": "a",
        "instructions": "sse2 avx2",
        "numpy": "2.4.6",
        "processor": "x",
        "python": "3.12.1",
    }
    text = json.dumps(one)
    assert kind(text) == kind(json.dumps(one | {"processor": "y", "python": "3.13.0"}))
    for change in (
        {"cpu": "b"},
        {"numpy": "2.4.5"},
        {"instructions": "sse2"},
        {"libc": "glibc 2.36"},
    ):
        assert kind(text) != kind(json.dumps(one | change))
    assert differences(
        json.dumps(one | {"instructions": "sse2 avx512f", "numpy": "2.3"}), text
    ) == ("instructions with avx512f, without avx2, numpy 2.3 (2.4.6 there)")
    assert kinds(["", "null", "[1", text, text]) == [(text, 2)]
    assert read("[]") == {}


def test_an_unknown_machine_is_not_compared(tmp_path):
    said = []
    watch = Watch({0: "", 1: '{"cpu": "a"}'}, True, tmp_path, said.append)
    assert watch.meet("", "task 2") == ""
    assert watch.meet('{"cpu": "b"}', "task 3")
    assert not said
