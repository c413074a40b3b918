"""Memory is forecast by the schedule that is followed, and what does not fit is refused before
anything is prepared.
"""

import re
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from tests.core.run.test_execution import (
    CHAIN,
    Demean,
    FocalPlaneMean,
    Level,
    Scale,
    Sink,
    Source,
    execute,
    observation,
    peak_of_streams_and_blocks,
)
from zonda.core.assembly.signals import Chain
from zonda.core.errors import PipelineError
from zonda.core.operator import Operator
from zonda.core.plan.planning import Planning
from zonda.core.registry import planning
from zonda.core.run.budget import BASE, divided, least_memory, with_scan_ahead
from zonda.core.run.schedule import schedule
from zonda.core.run.settings import Settings
from zonda.core.run.views import View


def views(obs, steps):
    steps = [o.model_copy() for o in steps]
    for i, o in enumerate(steps):
        o._label = f"{type(o).__name__}.{i}"
    return [View(Chain(steps), obs)]


@pytest.mark.parametrize(
    "chain", [[Source(), Demean(), Level(), Sink()], [Source(), Demean(), Scale(), Sink()], CHAIN]
)
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("share", [1.9, 4.0, 40.0])
def test_what_is_held_is_what_was_forecast(chain, threads, share):
    """The peak stays below the forecast, and that below the budget; the least that is
    forecast is enough.
    """
    obs = observation()
    settings = {
        "memory": int(share * threads * 4 * obs.n_detectors * obs.n_samples),
        "threads": threads,
    }
    found = schedule(views(obs, chain), Settings(**settings))
    # the bench keeps the last stream besides
    kept = 4 * obs.n_detectors * obs.n_samples
    with peak_of_streams_and_blocks() as peak:
        _, want, _ = execute(chain, obs, **settings)
    assert peak[0] <= found.bytes + kept
    assert found.least <= found.bytes <= settings["memory"]
    least = schedule(views(obs, chain), Settings(memory=1, threads=threads)).least
    _, got, _ = execute(chain, observation(), threads=threads, memory=least + 2 * kept)
    assert np.array_equal(got, want)


@pytest.mark.parametrize(
    ("last", "how", "said"),
    [
        ([Level()], "again", "made again"),
        ([Scale()], "spilled", "spilled to disk"),
        ([FocalPlaneMean()], "spilled", "spilled to disk"),
    ],
)
def test_the_schedule_is_followed(last, how, said):
    """A stream that does not fit in memory is made again where its reader sweeps it or takes it in
    blocks, else it is put on the disk. A run does with its streams what its schedule says.
    """
    obs = observation()
    execution, _, _ = execute(
        [Source(), Demean(), *last, Sink()],
        obs,
        room=0,
        memory=int(1.9 * 4 * obs.n_detectors * obs.n_samples),
    )
    assert execution.schedule.segments[0].how == how
    assert execution.schedule.elsewhere[0] == f"signal {said}"
    assert any(f"stream signal {said}" in what for _, what, _ in obs.log)


class Heavy(Operator):
    """Makes a product."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"heap"})
    size: int = 0


class HeavyPlanning(Planning):
    """Much memory."""

    of = Heavy
    smaller = "choose a larger pixel"

    def memory(self, observation):
        return self.operator.size


planning.register(HeavyPlanning, name="Heavy")


def libraries(monkeypatch, free=10**10):
    monkeypatch.setattr("zonda.core.run.budget.resident_memory", lambda: BASE)
    monkeypatch.setattr("zonda.core.run.budget.available_memory", lambda: free)


def test_what_does_not_fit_is_refused_with_what_would_make_it_fit(monkeypatch):
    chain = [Source(), Heavy(size=3_000_000_000)]
    obs, settings = observation(), Settings(threads=2, process=2 * 10**9)
    libraries(monkeypatch)
    with pytest.raises(
        PipelineError,
        match=(
            r"(?s)3\.24 GB: Heavy\.1 3 GB.*budget is 2 GB.*use --memory 3403MB.*Heavy.1: choose a l"
        ),
    ):
        divided(views(obs, chain), settings)
    libraries(monkeypatch, 10**9)
    with pytest.raises(PipelineError, match=r"more than this machine has \(1\.24 GB\)") as refused:
        divided(views(obs, chain), settings)
    assert "--memory" not in refused.value.cure
    found = divided(views(obs, chain), replace(settings, process=4 * 10**9))
    assert found.process == 4 * 10**9
    assert found.memory == 10**9 - BASE


def test_blocks_that_are_too_large_are_worked_on_by_fewer_threads(monkeypatch):
    """Blocks of 4 threads take 774 MB, of one 193.5 MB: 640 MB less the libraries' 240 MB have room
    for two of them.
    """
    libraries(monkeypatch)
    chain = [Source(), Demean(), Sink()]
    assert (
        divided(
            views(observation(16, 1_000_000), chain), Settings(threads=4, process=640 * 10**6)
        ).threads
        == 2
    )


def test_the_figure_that_a_refusal_names_works(monkeypatch):
    obs, chain = observation(16, 1_000_000), [Source(), Demean(), Sink()]
    libraries(monkeypatch)
    with pytest.raises(PipelineError, match=r"blocks on 1 thread 19\d MB") as refused:
        divided(views(obs, chain), Settings(threads=4, process=3 * 10**8))
    found = re.search(
        r"use --memory (\d+)MB; or split the scan into shorter ones", refused.value.cure
    )
    assert found is not None
    settings = divided(views(obs, chain), Settings(threads=4, process=int(found[1]) * 10**6))
    assert settings.threads == 1
    assert settings.memory >= schedule(views(obs, chain), settings).least
    assert int(found[1]) * 10**6 >= least_memory(views(obs, chain), Settings(threads=4))


def test_no_cure_is_named_that_cannot_work(monkeypatch):
    """Less than the libraries take: no shorter scan makes that fit."""
    obs = observation(16, 1_000_000)
    for free, cure in ((10**10, r"use --memory \d+MB"), (10**8, "use a machine with more memory")):
        libraries(monkeypatch, free)
        with pytest.raises(PipelineError) as refused:
            divided(
                views(obs, [Source(), Demean(), Sink()]), Settings(threads=4, process=BASE // 2)
            )
        assert re.fullmatch(cure, refused.value.cure)


def test_memory_of_a_scan_that_is_prepared_ahead_is_counted():
    class Holds(Source):
        """Holds 1 GB."""

    class HoldsPlanning(Planning):
        """1 GB."""

        of = Holds

        def memory(self, observation):
            return 1_000_000_000

    planning.register(HoldsPlanning, name="Holds")
    obs = observation(64, 1_000_000)  # one stream: 256 MB
    chain = [Holds(), Sink()]
    ahead = with_scan_ahead(views(obs, chain), Settings(2, memory=4_000_000_000))
    assert ahead is not None
    assert ahead.memory == 3_000_000_000
    assert with_scan_ahead(views(obs, chain), Settings(2, memory=1_000_000_000)) is None


def test_products_that_do_not_fit_when_they_are_written_are_refused(monkeypatch, tmp_path):
    """Pictures of a map take more than its sums: the run is refused before it begins."""
    import zonda

    libraries(monkeypatch)
    steps = [
        zonda.PointingStare(target={"az": "120 deg", "el": "60 deg"}, scan_duration="2 s"),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
        zonda.BinMap(pixel="1 arcsec", width="20 arcmin"),  # 1200^2 pixels
        zonda.SaveMap(),
    ]
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T01:00", target="05h +20d", seed=1
    )
    budget = BASE + 1200**2 * (64 + 40) + 30_000_000  # sums of two halves, planes
    pipeline = zonda.Pipeline([*steps, zonda.Plots()])
    with pytest.raises(PipelineError, match=r"the run would hold .*Plots") as refused:
        pipeline.run(scene, output=tmp_path, threads=1, ceiling=budget)
    assert "BinMap: choose a larger pixel" in refused.value.cure
    assert "streams" not in refused.value.cure  # none is kept
    zonda.Pipeline(steps).run(scene, output=tmp_path, threads=1, ceiling=budget)
