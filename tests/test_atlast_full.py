"""A thin slice of the shipped pipeline of the full AtLAST camera: streams made again give the same
map as streams kept.
"""

import numpy as np
import pytest

import zonda
from zonda.core.configuration.pipeline_file import load
from zonda.core.errors import PipelineError

DETECTORS, SECONDS = 400, 4


def slice_of(seconds=SECONDS, detectors=DETECTORS, pixel="60 arcsec", **changes):
    """Pipeline without its files, and scene, with fewer detectors over the same field. ``changes``:
    of the common mode.
    """
    file = load(
        "atlast_full", (f"PointingDaisy.scan_duration={seconds} s", f"BinMap.pixel={pixel}")
    )
    scene = file.scene()
    fewer = scene.instrument.model_copy(update={"detectors": detectors})
    steps = [
        o.model_copy(update=changes) if o.couples == "all" else o
        for o in file.operators
        if "map_file" not in o.provides
    ]
    return zonda.Pipeline(steps), scene.model_copy(update={"instrument": fewer})


def test_the_scene_is_the_full_design():
    file = load("atlast_full", ())
    instrument = file.scene().instrument
    pointing = next(o for o in file.operators if "boresight" in o.provides)
    assert (instrument.detectors, instrument.sample_rate) == (200_000, 900)
    assert np.isclose(np.degrees(instrument.field_of_view), 2)
    assert (pointing.scan_duration, round(np.degrees(pointing.radius), 9)) == (516, 1)
    assert np.degrees(pointing.speed) <= 0.9


def test_made_again_is_the_same_map():
    pipeline, scene = slice_of()
    whole = 4 * DETECTORS * SECONDS * 900
    kept = pipeline.run(scene, threads=1, memory=1 << 30)
    again = pipeline.run(scene, threads=2, memory=int(1.7 * whole))
    assert not any(who == "Execution" for who, _, _ in kept.log)
    assert any("made again" in what for who, what, _ in again.log if who == "Execution")
    one, other = kept.products["map"], again.products["map"]
    for name in ("signal", "hits", "weights", "noise"):
        assert np.array_equal(getattr(one, name), getattr(other, name), equal_nan=True)
    assert one.hits.sum() == DETECTORS * SECONDS * 900
    rows = [row for row in kept.log if row[0] != "Execution"]
    assert rows == [row for row in again.log if row[0] != "Execution"]


def test_singular_modes_of_a_stream_beyond_memory_and_disk_are_refused_with_a_way_out(monkeypatch):
    pipeline, scene = slice_of(method="svd")
    monkeypatch.setattr("zonda.core.run.schedule.free_disk", lambda: 1000)
    with pytest.raises(
        PipelineError, match=r"(?s)neither in memory nor on the disk.*CommonModeFilter.*--memory"
    ):
        pipeline.run(scene, threads=2, memory=int(1.7 * 4 * DETECTORS * SECONDS * 900))


def test_the_whole_of_it_fits_in_8_gb(tmp_path):
    """By the forecast, without running: 372 GB of streams are kept nowhere."""
    from zonda.core.data import Data
    from zonda.core.run.budget import divided
    from zonda.core.run.schedule import schedule
    from zonda.core.run.settings import Settings
    from zonda.core.run.views import View

    file = load("atlast_full", ())
    pipeline, scene = file.pipeline(), file.scene()
    data = Data(scene, output=tmp_path)
    for operator in pipeline.operators:
        operator.observe(data)
    longest = [View(pipeline.chain, data.observations[0])]
    left = divided(longest, Settings(threads=2, process=8 * 10**9))
    found = schedule(longest, left)
    assert found.bytes < left.memory
    assert any("made again" in what for what in found.elsewhere)
    with pytest.raises(
        PipelineError,
        match=r"(?s)the run would hold .*BinMap .* [GM]B.*budget is 1 GB.*larger pixel",
    ):
        divided(longest, Settings(threads=2, process=10**9))
