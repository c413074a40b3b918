"""Memory is forecast by the rules of the execution, and what does not fit is refused before anything is prepared."""

import re
from typing import ClassVar

import numpy as np
import pytest
from zonda.core.run.forecast import BASE, forecast, need, room

from tests.core.run.test_execution import CHAIN, Demean, Level, Scale, Sink, Source, execute, observation
from zonda.core.errors import PipelineError
from zonda.core.operator import Operator
from zonda.core.run.settings import Settings


def labelled(chain):
    chain = [o.model_copy() for o in chain]
    for i, o in enumerate(chain):
        o._label = f"{type(o).__name__}.{i}"
    return chain


@pytest.mark.parametrize("chain", [[Source(), Demean(), Level(), Sink()], [Source(), Demean(), Scale(), Sink()], CHAIN])
@pytest.mark.parametrize("threads", [1, 3])
@pytest.mark.parametrize("share", [1.9, 4.0, 40.0])
def test_what_is_held_is_what_was_forecast(chain, threads, share):
    """The ledger's peak stays below the forecast, and that below the budget; the least that is forecast is enough."""
    obs = observation()
    settings = {"memory": int(share * threads * 4 * obs.n_detectors * obs.n_samples), "threads": threads}
    found = forecast(labelled(chain), obs, Settings(**settings))
    # the bench keeps the last stream besides
    kept = 4 * obs.n_detectors * obs.n_samples
    execution, want, _ = execute(chain, obs, **settings)
    assert execution.ledger.peak <= found.bytes + kept
    assert found.least <= found.bytes <= settings["memory"]
    least = forecast(labelled(chain), obs, Settings(memory=1, threads=threads)).least
    _, got, _ = execute(chain, observation(), threads=threads, memory=least + 2 * kept)
    assert np.array_equal(got, want)


class Heavy(Operator):
    """Holds much."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    product_only: ClassVar[bool] = True
    lighter: ClassVar[str] = "choose a larger pixel"
    size: int = 0

    def memory(self, observation):
        return self.size


def test_what_does_not_fit_is_refused_with_what_would_make_it_fit(monkeypatch):
    chain = labelled([Source(), Heavy(size=3_000_000_000)])
    obs, settings = observation(), Settings(threads=2)
    monkeypatch.setattr("zonda.core.run.forecast.resident_memory", lambda: BASE)
    monkeypatch.setattr("zonda.core.run.forecast.available_memory", lambda: 10**10)
    with pytest.raises(
        PipelineError, match=r"(?s)3\.23 GB: Heavy\.1 3 GB.*budget is 2 GB.*use --memory 33..MB.*Heavy.1: choose a l"
    ):
        room(chain, [obs], settings, 2 * 10**9, "test")
    monkeypatch.setattr("zonda.core.run.forecast.available_memory", lambda: 10**9)
    with pytest.raises(PipelineError, match=r"more than this machine has \(1\.23 GB\)") as refused:
        room(chain, [obs], settings, 2 * 10**9, "test")
    assert "--memory" not in refused.value.cure
    left, products = room(chain, [obs], settings, 4 * 10**9, "test")
    assert products == 3 * 10**9
    assert left == 10**9 - BASE


def test_blocks_that_are_too_large_are_worked_on_by_fewer_threads(monkeypatch):
    """Blocks of 4 threads take 774 MB, of one 193.5 MB: 630 MB less the libraries' 230 MB have room for two of them."""
    obs, settings = observation(16, 1_000_000), Settings(threads=4)
    monkeypatch.setattr("zonda.core.run.forecast.resident_memory", lambda: BASE)
    room(labelled([Source(), Demean(), Sink()]), [obs], settings, 630 * 10**6, "test")
    assert settings.threads == 2


def test_the_figure_that_a_refusal_names_works(monkeypatch):
    obs, chain = observation(16, 1_000_000), labelled([Source(), Demean(), Sink()])
    monkeypatch.setattr("zonda.core.run.forecast.resident_memory", lambda: BASE)
    for kept in (0, 300_000_000):
        with pytest.raises(PipelineError, match=r"blocks on 1 thread 19\d MB") as refused:
            room(chain, [obs], Settings(threads=4), 3 * 10**8, "test", kept)
        found = re.search(r"use --memory (\d+)MB; or split the scan into shorter ones", refused.value.cure)
        assert found is not None
        settings = Settings(threads=4)
        settings.memory, _ = room(chain, [obs], settings, int(found[1]) * 10**6, "test", kept)
        assert settings.threads == 1
        assert settings.memory >= settings.least
        assert int(found[1]) * 10**6 >= need(chain, [obs], Settings(threads=4), kept)


def test_no_cure_is_named_that_cannot_work(monkeypatch):
    """Less than the libraries take: no shorter scan makes that fit."""
    obs = observation(16, 1_000_000)
    monkeypatch.setattr("zonda.core.run.forecast.resident_memory", lambda: BASE)
    for free, cure in ((10**10, r"use --memory \d+MB"), (10**8, "use a machine with more memory")):
        monkeypatch.setattr("zonda.core.run.forecast.available_memory", lambda free=free: free)
        with pytest.raises(PipelineError) as refused:
            room(labelled([Source(), Demean(), Sink()]), [obs], Settings(threads=4), BASE // 2, "test")
        assert re.fullmatch(cure, refused.value.cure)
