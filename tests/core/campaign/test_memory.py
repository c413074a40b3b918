"""``--memory`` of a campaign: for all of it on this machine, shared out and checked before it
starts.
"""

import re

import pytest

from zonda.core.errors import PipelineError
from zonda.core.experiment import engines
from zonda.core.experiment.engines import engine, share_out

MB = 1_000_000
NEED = 500 * MB


@pytest.fixture(autouse=True)
def machine(monkeypatch):
    """8 CPUs, 16 GB free, and a main process of 300 MB."""
    monkeypatch.setattr("zonda.core.experiment.engines.available_memory", lambda: 16_000 * MB)
    monkeypatch.setattr("zonda.core.experiment.engines.available_threads", lambda: 8)
    monkeypatch.setattr(engines, "resident_memory", lambda: 300 * MB)


def shared(size, workers=None, name="processes", need=NEED):
    with engine(name, workers=workers, memory=size) as pool:
        share_out(pool, need, "test")
        return pool.workers, pool.threads, pool.memory


def test_it_is_divided_among_the_workers_beside_the_main_process():
    assert shared(4320 * MB, 4) == (4, 2, 1000 * MB)


def test_fewer_workers_where_more_do_not_fit():
    assert shared(1320 * MB) == (2, 4, 500 * MB)


@pytest.mark.parametrize(("workers", "size"), [(None, 50 * MB), (None, 300 * MB), (4, 1500 * MB)])
def test_too_little_is_refused_with_figures_that_work(workers, size):
    with pytest.raises(
        PipelineError,
        match=r"500 MB for its tasks, and the main process holds 320 MB; the memory budget is",
    ) as err:
        shared(size, workers)
    found = re.match(r"use --memory (\d+)MB", err.value.cure)
    assert found is not None
    assert shared(int(found[1]) * MB, workers)[0] == (workers or 1)
    if workers:
        alone = re.search(r"--workers 1 with --memory (\d+)MB", err.value.cure)
        assert alone is not None
        assert shared(int(alone[1]) * MB, 1)[0] == 1


def test_without_a_budget_half_of_what_is_free_is_shared():
    assert shared(None, 4) == (4, 2, 2000 * MB)
    assert shared(None, need=3000 * MB) == (2, 4, 4000 * MB)
    assert shared(None, 4, need=3000 * MB) == (
        4,
        2,
        3000 * MB,
    )  # asked for, and there is room for them
    with pytest.raises(PipelineError, match=r"each of 8 workers needs 3000 MB.*16000 MB are free"):
        shared(None, 8, need=3000 * MB)


def test_in_series_it_is_that_of_the_one_process():
    assert shared(600 * MB, name="serial") == (1, None, 600 * MB)
    with pytest.raises(PipelineError, match="the memory budget of each process is 400 MB") as err:
        shared(400 * MB, name="serial")
    assert "use --memory 500MB" in err.value.cure


@pytest.mark.parametrize("size", ["50MB", "300MB"])
def test_a_campaign_is_refused_before_it_starts(bench, capsys, size):
    out = bench.run(
        "{nights: 2}", "--memory", size, "--engine", "processes", "--workers", 2, status=2
    )
    message = capsys.readouterr().err
    assert "for its tasks" in message
    assert "use --memory" in message
    assert not (out / "campaign.json").exists()
