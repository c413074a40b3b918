"""The next observation is prepared while one is executed: the same bits, order, errors and memory
as one after the other.
"""

import threading
from typing import ClassVar

import numpy as np
import pytest

import zonda
from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.hooks import hookimpl, manager
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline

WAIT = 60.0
"""Seconds after which a thread that never came is given up."""


class Point(Operator):
    """Stares, three times."""

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})

    def observe(self, data):
        scene, q = data.scene, np.tile([0.0, 0, 0, 1], (3000, 1))
        for k in range(3):
            plane, t = scene.instrument.focalplane(), np.arange(3000.0)
            data.observations.append(
                Observation(
                    f"scan-{k}",
                    k,
                    scene.site,
                    scene.instrument,
                    plane,
                    scene.time,
                    t,
                    1.0,
                    q,
                    q,
                    (0, 0),
                    scene.seed,
                )
            )


class Log:
    """What happened, in order."""

    def __init__(self):
        self.rows, self.threads = [], {}
        self.prepared = {k: threading.Event() for k in range(4)}
        self.prepared[3].set()  # there is no fourth observation

    def say(self, what, observation):
        self.rows.append((what, observation.index))
        self.threads[what, observation.index] = threading.current_thread().name


class Maker(Operator):
    """Makes a signal from what it drew in `prepare`; where it ``waits``, `exec` goes on once the
    next observation is prepared.
    """

    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    log: ClassVar[Log | None] = None
    waits: ClassVar[bool] = False
    fails: ClassVar[tuple[str, int] | None] = None

    def at(self, what, observation):
        if self.log:
            self.log.say(what, observation)
        if self.fails == (what, observation.index):
            raise PipelineError(f"{what} of {observation.name} failed")

    def prepare(self, observation):
        self.at("prepare", observation)
        observation.log.count(self.label, "prepared", 1)
        drawn = np.random.default_rng(observation.index).normal(size=observation.n_samples) * (
            observation.index + 1
        )
        if self.log:
            self.log.prepared[observation.index].set()
        return drawn

    def exec(self, block, state):
        if self.log and self.waits:
            assert self.log.prepared[block.observation.index + 1].wait(WAIT)
        self.at("exec", block.observation)
        block.new("signal")[...] += state[block.samples].astype(np.float32)

    def collect(self, data, observation, state):
        self.at("collect", observation)

    def discard(self, observation, state):
        self.at("discard", observation)


class Total(Operator):
    """Keeps the signal."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"total"})

    def prepare(self, observation):
        return np.zeros((observation.n_detectors, observation.n_samples), np.float32)

    def exec(self, block, state):
        state[block.detectors, block.samples] = block.detdata["signal"]

    def collect(self, data, observation, state):
        data.products.setdefault("total", []).append(state)


@pytest.fixture(scope="module")
def scene():
    return zonda.Scene(
        site="green_bank", instrument="hexagonal_array", time="2024-11-25T07:00", seed=3
    )


@pytest.fixture
def log(monkeypatch):
    made = Log()
    monkeypatch.setattr(Maker, "log", made)
    return made


def test_same_bits_and_tally_and_really_ahead(scene, log, monkeypatch):
    alone = Pipeline([Point(), Maker(), Total()]).run(scene, threads=1)
    assert set(log.threads.values()) == {"MainThread"}
    log.__init__()
    monkeypatch.setattr(Maker, "waits", True)
    beside = Pipeline([Point(), Maker(), Total()]).run(scene, threads=2)
    assert [log.threads["prepare", k].partition("_")[0] for k in range(3)] == [
        "MainThread",
        "ahead",
        "ahead",
    ]
    for a, b in zip(alone.products["total"], beside.products["total"], strict=True):
        assert np.array_equal(a, b)
    assert list(alone.log) == list(beside.log)
    assert [row for row in log.rows if row[0] == "collect"] == [("collect", k) for k in range(3)]
    assert not [t for t in threading.enumerate() if t.name.startswith("ahead")]


def test_error_in_preparation_comes_in_its_turn(scene, log, monkeypatch):
    monkeypatch.setattr(Maker, "waits", False)
    monkeypatch.setattr(Maker, "fails", ("prepare", 1))
    with pytest.raises(PipelineError, match="prepare of scan-1 failed"):
        Pipeline([Point(), Maker(), Total()]).run(scene, threads=2)
    assert ("collect", 0) in log.rows  # the scan before it was finished
    assert ("prepare", 2) not in log.rows
    assert not [row for row in log.rows if row[0] == "discard"]


@pytest.mark.parametrize("where", ["exec", "collect"])
def test_what_was_prepared_ahead_is_discarded_when_a_run_fails(scene, log, monkeypatch, where):
    monkeypatch.setattr(Maker, "waits", True)
    monkeypatch.setattr(Maker, "fails", (where, 0))
    with pytest.raises(PipelineError, match=f"{where} of scan-0 failed"):
        Pipeline([Point(), Maker(), Total()]).run(scene, threads=2)
    assert log.rows.count(("discard", 0)) == log.rows.count(("discard", 1)) == 1
    assert ("prepare", 2) not in log.rows
    assert not [t for t in threading.enumerate() if t.name.startswith("ahead")]


def test_ctrl_c_discards_what_was_prepared_ahead(scene, log, monkeypatch):
    monkeypatch.setattr(Maker, "waits", True)

    def interrupt(self, data, observation, state):
        raise KeyboardInterrupt

    monkeypatch.setattr(Maker, "collect", interrupt)
    with pytest.raises(KeyboardInterrupt):
        Pipeline([Point(), Maker(), Total()]).run(scene, threads=2)
    assert log.rows.count(("discard", 1)) == 1


def test_who_listens_hears_one_observation_after_the_other(scene, log):
    heard = []

    class Listener:
        @hookimpl
        def zonda_before_operator(self, operator, observation, stage):
            heard.append((stage, observation and observation.index))

    listener = Listener()
    manager().register(listener)
    try:
        Pipeline([Point(), Maker()]).run(scene, threads=2)
    finally:
        manager().unregister(listener)
    expected = [(stage, k) for k in range(3) for stage in ("prepare", "exec")]
    assert heard[:6] == expected
    assert {log.threads["prepare", k] for k in range(3)} == {"MainThread"}
