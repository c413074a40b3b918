"""Variants of a pipeline: their keys, their values on any executor, values that are kept."""

from __future__ import annotations

import pickle
from pathlib import Path

import pytest

from zonda.core.campaign.engines import engine
from zonda.core.errors import PipelineError
from zonda.core.experiment import SECONDS, Experiment, Variant, run_file
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


def wanted(pipeline: Path, folder: Path, seeds: int = 2) -> tuple[Experiment, list[Variant]]:
    made = Experiment(folder)
    variants = [Variant(pipeline), Variant(pipeline, ("BinMap.pixel=4 arcsec",))]
    return made, [made.want(variant, RMS, seeds) for variant in variants]


def test_a_variant_is_known_by_what_its_values_depend_on(pipeline: Path) -> None:
    plain, same = Variant(pipeline), Variant(pipeline, ("seed=1",))
    assert plain.key == Variant(pipeline).key == pickle.loads(pickle.dumps(plain)).key
    assert (same.key == plain.key) == (plain.file.scene().seed == 1)
    assert Variant(pipeline, ("seed=99",)).key != plain.key
    assert Variant(pipeline, ("BinMap.pixel=4 arcsec",)).key != plain.key
    (pipeline.parent / "sky.fits").unlink()
    write_sky(pipeline.parent / "sky.fits", 21, 0.004, 2e-3)
    assert Variant(pipeline).key != plain.key  # another input


def test_values_are_the_same_on_any_executor_and_are_kept(pipeline: Path, tmp_path: Path) -> None:
    serial, variants = wanted(pipeline, tmp_path / "serial")
    serial.run()
    parallel, _ = wanted(pipeline, tmp_path / "processes")
    with engine("processes", workers=2, threads=1) as pool:
        parallel.run(pool.executor)
    found = [serial.values(variant, RMS.name, 2) for variant in variants]
    assert found == [parallel.values(variant, RMS.name, 2) for variant in variants]
    assert len({value for pairs in found for value, _ in pairs}) == 4  # variants and seeds differ
    assert (serial.made, parallel.made) == (4, 4)

    again, _ = wanted(pipeline, tmp_path / "serial", seeds=3)
    again.run()
    assert again.made == 2  # the third seed of each
    assert [again.values(variant, RMS.name, 2) for variant in variants] == found
    for path in (tmp_path / "serial" / "runs").iterdir():
        path.write_text(path.read_text()[:-20])
    damaged, _ = wanted(pipeline, tmp_path / "serial")
    damaged.run()
    assert damaged.made == 4
    assert [damaged.values(variant, RMS.name, 2) for variant in variants] == found


def test_the_seconds_of_a_run_are_a_metric(pipeline: Path, tmp_path: Path) -> None:
    made = Experiment(tmp_path / "out")
    variant = made.want(Variant(pipeline), None, 1)
    made.run()
    assert made.values(variant, SECONDS, 1)[0][0] > 0


def test_a_metric_that_a_variant_cannot_have(pipeline: Path, tmp_path: Path) -> None:
    pipeline.write_text(TEXT.replace("  - BinMap: {pixel: 8 arcsec}\n  - SaveMap\n", ""))
    with pytest.raises(PipelineError, match="needs map"):
        Experiment(tmp_path).want(Variant(pipeline), RMS, 1)


def test_a_run_leaves_no_products_where_it_is_made(
    pipeline: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    before = set(tmp_path.rglob("*"))
    data = run_file(Variant(pipeline).file, [RMS.metric], seed=5)
    assert data.scene.seed == 5
    assert "map" in data.products
    assert set(tmp_path.rglob("*")) == before
    run_file(
        Variant(pipeline).file, operators=Variant(pipeline).file.operators, output=tmp_path / "out"
    )
    assert (tmp_path / "out" / "map.fits").exists()
