"""Variants of a pipeline: their keys, their values on any executor, values that are kept."""

from __future__ import annotations

import importlib
import pickle
import sys
from collections.abc import Iterator
from concurrent.futures import Executor, Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest

import zonda
from zonda.core.accuracy.metrics import Metric
from zonda.core.errors import InputError, PipelineError
from zonda.core.experiment.engines import engine
from zonda.core.experiment.experiment import SECONDS, Experiment
from zonda.core.experiment.variant import FileVariant, Variant
from zonda.core.figures import Choice

from ...scenes import camera, write_sky

TEXT = f"""\
{camera(7)}operators:
  - PointingDaisy: {{radius: 1 arcmin, speed: 50 arcsec/s, scan_duration: 3 s, scans: 1}}
  - SkyMap: {{file: sky.fits}}
  - WhiteNoise
  - Efficiency
  - BinMap: {{pixel: 8 arcsec}}
  - SaveMap
"""
RMS = Choice.parse("central_rms(radius=30 arcsec)")


@pytest.fixture
def pipeline(tmp_path: Path) -> Path:
    write_sky(tmp_path / "sky.fits", 21, 0.004, 1e-3)
    (tmp_path / "p.yaml").write_text(TEXT)
    return tmp_path / "p.yaml"


def of(pipeline: Path, folder: Path | None, seeds: int = 2) -> Experiment:
    """A plain variant and one of smaller pixels."""
    variants = [FileVariant(pipeline), FileVariant(pipeline, ("BinMap.pixel=4 arcsec",))]
    return Experiment(variants, seeds, [RMS], folder=folder)


def test_a_variant_is_known_by_what_its_values_depend_on(pipeline: Path) -> None:
    plain, same = FileVariant(pipeline), FileVariant(pipeline, ("seed=1",))
    assert plain.key == FileVariant(pipeline).key == pickle.loads(pickle.dumps(plain)).key
    assert (same.key == plain.key) == (plain.file.scene().seed == 1)
    assert FileVariant(pipeline, ("seed=99",)).key != plain.key
    assert FileVariant(pipeline, ("BinMap.pixel=4 arcsec",)).key != plain.key
    (pipeline.parent / "sky.fits").unlink()
    write_sky(pipeline.parent / "sky.fits", 21, 0.004, 2e-3)
    assert FileVariant(pipeline).key != plain.key  # another input


def test_values_are_the_same_on_any_executor_and_are_kept(pipeline: Path, tmp_path: Path) -> None:
    serial, parallel = of(pipeline, tmp_path / "serial"), of(pipeline, tmp_path / "processes")
    found = serial.run().records()
    with engine("processes", workers=2, threads=1) as pool:
        assert parallel.run(pool).records() == found
    with ThreadPoolExecutor(2) as threads:
        assert of(pipeline, None).run(threads).records() == found
    assert len({row["value"] for row in found}) == 4  # variants and seeds differ
    assert [row["seed"] for row in found[:2]] == [row["seed"] for row in found[2:]]
    assert (serial.made, parallel.made) == (4, 4)

    again = of(pipeline, tmp_path / "serial", seeds=3)
    rows = again.run().records()
    assert again.made == 2  # the third seed of each
    assert [rows[k] for k in (0, 1, 3, 4)] == found
    for path in (tmp_path / "serial" / "runs").iterdir():
        path.write_text(path.read_text()[:-20])
    damaged = of(pipeline, tmp_path / "serial")
    assert damaged.run().records() == found
    assert damaged.made == 4


def test_pipelines_and_scenes_of_python_give_the_values_of_their_file(pipeline: Path) -> None:
    file = FileVariant(pipeline).file
    variant = zonda.Variant(file.pipeline(), file.scene(), "mine")
    table = zonda.Experiment([variant], 2, ["central_rms(radius=30 arcsec)"]).run()
    rows, of_file = table.records(), of(pipeline, None).run().records()
    assert [row["variant"] for row in rows] == ["mine", "mine"]
    assert all(str(row["seed"]) in line for row, line in zip(rows, table.lines()[1:], strict=True))
    assert [row["value"] for row in rows] == [row["value"] for row in of_file[:2]]
    seeds = [row["seed"] for row in rows]
    assert zonda.Experiment([variant], seeds, [RMS]).run().records() == rows


def test_the_seconds_of_a_run_are_a_metric(pipeline: Path, tmp_path: Path) -> None:
    made, variant = Experiment(folder=tmp_path / "out"), FileVariant(pipeline)
    made.want(variant, None, 1)
    made.run()
    assert made.figures(variant, SECONDS)[0].value > 0


def test_a_metric_that_a_variant_cannot_have(pipeline: Path, tmp_path: Path) -> None:
    pipeline.write_text(TEXT.replace("  - BinMap: {pixel: 8 arcsec}\n  - SaveMap\n", ""))
    with pytest.raises(PipelineError, match="needs map"):
        of(pipeline, tmp_path)


@pytest.mark.parametrize(
    ("metric", "words"),
    [
        ("central_rsm", "metric: unknown metric 'central_rsm'.*central_rms"),
        ("map_rms", "metric: map_rms is an error of one run against another.*central_rms"),
        ("central_rms(radius=3)", "radius: 3 has no unit"),
    ],
)
def test_a_metric_that_there_is_not(pipeline: Path, metric: str, words: str) -> None:
    with pytest.raises(InputError, match=f"(?s){words}"):
        Experiment([FileVariant(pipeline)], metrics=[metric])


class Silent(Executor):
    """Does not tell how many workers it has, as MPI's and Dask's, and begins when it has three."""

    def __init__(self) -> None:
        self.waiting: list[tuple[Future[Any], Any, Any]] = []

    def submit(self, fn: Any, /, *args: Any, **kwargs: Any) -> Future[Any]:
        self.waiting.append((Future(), fn, args))
        if len(self.waiting) == 3:
            for future, call, given in self.waiting:
                future.set_result(call(*given))
        return self.waiting[-1][0]


def test_an_executor_that_does_not_tell_its_workers_is_given_all_runs(pipeline: Path) -> None:
    executor, made = Silent(), Experiment([FileVariant(pipeline)], 3, [RMS])
    assert len(made.run(executor).records()) == 3


KILLED = """
import os
import signal

from zonda.core.figures import Metric


class Killed(Metric):
    \"\"\"Kills its process at the first run, and at every run of a pipeline called ``bad``.\"\"\"

    def __init__(self, mark):
        self.mark = mark

    def measure(self, data):
        if data.provenance["name"] == "bad" or not self.mark.exists():
            self.mark.touch()
            os.kill(os.getpid(), signal.SIGKILL)
        return data.scene.seed
"""


@pytest.fixture
def killed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Metric]:
    """A metric in a module that workers find, wherever pytest was started."""
    (tmp_path / "metric_that_kills.py").write_text(KILLED)
    monkeypatch.syspath_prepend(tmp_path)
    module = importlib.import_module("metric_that_kills")
    yield module.Killed(tmp_path / "mark")
    del sys.modules["metric_that_kills"]


def test_a_run_whose_worker_was_killed_is_made_again(pipeline: Path, killed: Metric) -> None:
    found: list[tuple[str, int]] = []
    with engine("processes", workers=2, threads=1) as pool:
        made = Experiment([FileVariant(pipeline)], [3, 4, 5], [killed])
        made.run(pool, lambda v, n, values: found.extend((str(v), s) for s in values.values()))
    assert sorted(found) == [("p", 3), ("p", 4), ("p", 5)]


@pytest.mark.nightly
def test_a_run_that_kills_its_worker_each_time_is_an_error(pipeline: Path, killed: Metric) -> None:
    bad = FileVariant(pipeline, ("name=bad",))
    with engine("processes", workers=1, threads=1) as pool:
        made = Experiment([bad], 1, [killed])
        with pytest.raises(PipelineError, match="was killed"):
            made.run(pool)


def test_a_run_leaves_no_products_where_it_is_made(
    pipeline: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.rglob("*"))
    variant: Variant = FileVariant(pipeline).variant
    data = variant.run([RMS.metric], seed=5)
    assert data.scene.seed == 5
    assert "map" in data.products
    assert set(tmp_path.rglob("*")) == before
    variant.run(operators=variant.pipeline.operators, output=tmp_path / "out")
    assert (tmp_path / "out" / "map.fits").exists()
