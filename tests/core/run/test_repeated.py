"""Streams that later runs copy from the main run: the same bits and counts as made anew, within a share of the memory."""

import errno
from typing import ClassVar

import numpy as np
import pytest
from zonda.core.run.forecast import forecast, spares
from zonda.core.run.layout import Layout
from zonda.core.run.repeated import Repeated, affordable, alike

import zonda
from tests.core.run.test_derived import BOTH, FILTERS, MAP, SKY, Several, observed, steps
from tests.core.run.test_execution import CHAIN, Demean, Level, Sink, Source, observation
from tests.core.run.test_forecast import labelled
from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.numerics import chunks
from zonda.core.pipeline import Pipeline
from zonda.core.plan.planner import plan
from zonda.core.run import repeated
from zonda.core.run.settings import Settings

RUNS = {"sky": SKY, "own": {"only": ["sky"]}, "unfiltered": {"only": ["sky"], "filters": "none"}}


class Counted(zonda.SkyMap):
    """Counts the samples that it samples, by run and scan."""

    same_in_all_runs: ClassVar[bool] = True
    seen: ClassVar[dict[int, int]] = {}

    def exec(self, block, state):
        if not block.again:
            self.seen[block.observation.index] = self.seen.get(block.observation.index, 0) + block.shape[0] * block.shape[1]
        super().exec(block, state)


def made(monkeypatch, filters, runs=RUNS, **settings):
    """The products and the tally, and how often each scan's samples were made."""
    monkeypatch.setattr(zonda, "SkyMap", Counted)
    Counted.seen = {}
    _, data = observed(steps(*filters), runs, **settings)
    tally = [row for row in data.tally if row[0].rpartition("/")[2] != "Execution"]
    return data.products, tally, {k: n / (19 * 6000) for k, n in Counted.seen.items()}


@pytest.mark.parametrize("threads", [1, 2])
@pytest.mark.parametrize("how", ["kept", "spilled", "again"])
@pytest.mark.parametrize("filters", ["modes", "mean"])
def test_copies_are_what_would_be_made(monkeypatch, filters, how, threads):
    with monkeypatch.context() as patched:
        patched.setattr(repeated, "alike", lambda steps: {})
        patched.setattr("zonda.core.run.simulation.alike", lambda steps: {})
        want, tally, times = made(patched, FILTERS[filters], threads=1)
    assert times == {0: 4, 1: 4}, "made in four runs"
    if how != "kept":
        if how == "spilled" or filters == "mean":
            monkeypatch.setattr("zonda.core.run.layout.choose", lambda *a, **k: (how, "for this test"))
        monkeypatch.setattr(Layout, "keeps", lambda *a: False)
    got, told, times = made(monkeypatch, FILTERS[filters], threads=threads, memory=30_000_000)
    assert times == {0: 1, 1: 1}
    assert told == tally
    assert ("own/SkyMap" in {who for who, *_ in tally}) or ("own/Counted" in {who for who, *_ in tally})
    for name in ("map", "sky/map", "own/map", "unfiltered/map"):
        assert np.array_equal(got[name].signal, want[name].signal, equal_nan=True)
        assert np.array_equal(got[name].hits, want[name].hits)


def test_what_does_not_fit_into_the_share_is_made_again(monkeypatch):
    """Streams of 0.456 MB: one scan's fits into a tenth of 9 MB, of two."""
    monkeypatch.setattr(repeated, "SHARE", 10)
    want, tally, _ = made(monkeypatch, FILTERS["modes"], BOTH)
    got, told, times = made(monkeypatch, FILTERS["modes"], BOTH, memory=9_000_000, threads=1)
    assert times == {0: 1, 1: 2}
    assert told == tally
    assert np.array_equal(got["sky/map"].signal, want["sky/map"].signal, equal_nan=True)


def test_memory_is_taken_from_the_budget_and_given_back(monkeypatch):
    held, real = [], Repeated.begin

    def begin(self, shape, settings):
        real(self, shape, settings)
        held.append((settings, sum(a.nbytes for a in settings.kept), settings.memory))

    monkeypatch.setattr(Repeated, "begin", begin)
    made(monkeypatch, FILTERS["modes"], BOTH, memory=20_000_000)
    each = 19 * 6000 * 4
    assert [size for _, size, _ in held] == [each, 2 * each]
    assert {memory for *_, memory in held} == {20_000_000 - 2 * each}
    assert held[0][0].kept == []


def test_nothing_is_kept_where_other_streams_would_go_to_disk():
    obs = observation()
    each = 4 * obs.n_detectors * obs.n_samples
    chain = labelled([Source(), Demean(), Level(), Sink()])
    names = {"Source.0": {"signal"}}
    assert affordable(chain, names, [obs], Settings(memory=100 * each)) == [each]
    assert affordable(chain, names, [obs, obs], Settings(memory=100 * each)) == [each, each]
    for share in np.arange(4, 9, 0.1):  # from where it is a quarter to where there is room for all
        settings = Settings(memory=int(share * each), threads=1)
        less = Settings(memory=settings.memory - each, threads=1)
        found = affordable(chain, names, [obs], settings)
        same = forecast(chain, obs, settings).elsewhere == forecast(chain, obs, less).elsewhere
        assert found == [each if same else 0]


def test_nothing_is_kept_where_other_streams_would_need_a_disk_that_is_full(monkeypatch):
    """With all of the memory two streams are held at once and the run fits; with what is left it would be refused."""
    obs = observation()
    each = 4 * obs.n_detectors * obs.n_samples
    settings = Settings(memory=int(6.5 * each), threads=1)
    monkeypatch.setattr("zonda.core.run.streams.free_disk", lambda: 0)
    assert forecast(labelled(CHAIN), obs, settings).elsewhere == ()
    with pytest.raises(PipelineError, match="nor on the disk"):
        forecast(labelled(CHAIN), obs, Settings(memory=settings.memory - each, threads=1))
    assert affordable(labelled(CHAIN), {"Source.0": {"signal"}}, [obs], settings) == [0]
    assert not spares(labelled(CHAIN), obs, settings, each)


def test_only_what_says_so_and_comes_first_is_copied():
    class Silent(zonda.SkyMap):
        """Says nothing of its own `exec`."""

        def exec(self, block, state):
            super().exec(block, state)

    class Wide(zonda.SkyMap):
        """Sees neighbours."""

        def halo(self, observation: Observation) -> int:
            return 3

    def names(*operators):
        pipeline = Pipeline([Several(), *operators, *steps()])
        return set(alike(pipeline.selection.steps("")))

    assert names(MAP) == {"SkyMap"}
    assert names(MAP, MAP) == {"SkyMap"}, "the second adds to what is there"
    assert names(Silent(file=MAP.file)) == names(Wide(file=MAP.file)) == set()
    assert names(Silent(file=MAP.file), MAP) == set()


def test_memory_that_the_system_refuses_is_a_memory_error(monkeypatch):
    """As with numpy's own arrays, where the system has a limit (``ulimit -v``): the command line knows it."""

    def refused(*given, **named):
        raise OSError(errno.ENOMEM, "Cannot allocate memory")

    monkeypatch.setattr(chunks.mmap, "mmap", refused)
    assert chunks.empty((2, chunks.LARGE), np.float32).shape == (2, chunks.LARGE)
    with pytest.raises(MemoryError):
        chunks.empty((1 << 31, 1 << 26), np.float32)


def test_a_plan_counts_the_copied_step_once_and_the_memory(monkeypatch):
    file = zonda.load("mustang2_cluster", overrides=["PointingDaisy.scans=2", "PointingDaisy.scan_duration=30 s"])
    made = plan(file, threads=2, memory=2 << 30, drop=["Plots", "Report"])
    assert made.prediction.runs["SkyMap"] == 1
    assert made.prediction.runs["BinMap"] == 2
    monkeypatch.setattr("zonda.core.plan.cost.alike", lambda steps: {})
    before = plan(file, threads=2, memory=2 << 30, drop=["Plots", "Report"])
    assert before.prediction.runs["SkyMap"] == 2
    samples = sum(o.n_samples * o.n_detectors for o in made.context.observations)
    assert made.prediction.bytes - before.prediction.bytes == pytest.approx(4 * samples)
    assert made.prediction.seconds["SkyMap"] < before.prediction.seconds["SkyMap"]


def test_a_step_that_does_not_make_what_it_promised(monkeypatch):
    class Idle(zonda.SkyMap):
        same_in_all_runs: ClassVar[bool] = True

        def exec(self, block, state):
            pass

    monkeypatch.setattr(zonda, "SkyMap", Idle)
    with pytest.raises(PipelineError, match="made no stream 'sky', which it provides"):
        observed(steps(*FILTERS["mean"]), RUNS)
