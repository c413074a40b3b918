"""Products, scans and kept streams of a run, found by name."""

from __future__ import annotations

import numpy as np
import pytest

import zonda
from zonda.core.errors import InputError, PipelineError
from zonda.plugins.checks.scenes import camera, scene

STEPS = (
    zonda.PointingDaisy(scan_duration="4 s", scans=2),
    zonda.AtmosphereLayers(pwv="5 mm"),
    zonda.WhiteNoise(),
    zonda.Efficiency(),
)


@pytest.fixture(scope="module")
def data():
    pipeline = zonda.Pipeline(
        [*STEPS, zonda.BinMap(pixel="6 arcsec")], runs={"quiet": {"without": ["white"]}}
    )
    return pipeline.run(scene(camera(19)), keep=["signal", "atmosphere", "white"], threads=1)


def test_it_is_shown_with_its_scans_and_products(data):
    assert repr(data) == "<Data: 2 observations, products ['map', 'quiet/map']>"
    data = zonda.Data(data.scene, data.observations[:1])
    assert repr(data) == "<Data: 1 observation, products []>"


def test_products_by_name(data):
    assert data["map"] is data.products["map"]
    assert data["quiet/map"] is data.products["quiet/map"]
    assert "map" in data
    assert "maps" not in data
    assert set(data) == set(data.products)
    with pytest.raises(
        InputError,
        match=r"no product 'mpa'(.|\n)*did you mean 'map'(.|\n)*there are: map, quiet/map",
    ):
        data["mpa"]


def test_time_streams_of_a_scan(data):
    first, second = data.tod("signal", 0), data.tod("signal", "scan-001")
    assert first.shape == (19, 400)
    assert first.dtype == np.float64
    assert not np.shares_memory(first, data.tod("signal", 0))
    np.testing.assert_array_equal(data.tod("signal", -1), second)


def test_they_are_complete(data):
    """The signal is the sum of the components over the efficiency and the transmission, tens of
    kelvin of emission included.
    """
    atmosphere, white = data.tod("atmosphere", 0), data.tod("white", 0)
    assert atmosphere.mean() > 5
    fluctuation = data.observations[0].detdata["atmosphere"]
    assert abs(fluctuation.mean()) < 1
    observation = data.observations[0]
    plane = observation.focalplane
    zeta, epsilon = plane.main_beam_efficiency[:, None], plane.illumination_efficiency[:, None]
    transmission = observation.smooth["transmission"].evaluate(slice(0, 19), slice(0, 400))
    # float32: 2^-24 of what stands beside the mean, below 1 K of 70 K
    np.testing.assert_allclose(
        data.tod("signal", 0), (epsilon * atmosphere + white) / (zeta * transmission), rtol=1e-6
    )


def test_block_by_block_is_the_same(data):
    for scan in (0, 1):
        for stream in ("signal", "atmosphere"):
            parts = [part for _, _, part in data.blocks(stream, scan, detectors=7)]
            assert [len(part) for part in parts] == [7, 7, 5]
            np.testing.assert_array_equal(np.concatenate(parts), data.tod(stream, scan))
    seen = [(o.name, rows.start) for o, rows, _ in data.blocks("signal", detectors=10)]
    assert seen == [("scan-000", 0), ("scan-000", 10), ("scan-001", 0), ("scan-001", 10)]


def test_what_is_not_there_is_said(data):
    with pytest.raises(PipelineError, match="take 1 or more"):
        next(data.blocks(detectors=0))
    with pytest.raises(InputError, match=r"2 scans: scan-000, scan-001(.|\n)*scan='scan-000'"):
        data.tod("signal")
    with pytest.raises(InputError, match=r"no scan 'scan-01'(.|\n)*did you mean"):
        data.tod("signal", "scan-01")
    with pytest.raises(InputError, match="no scan 2"):
        data.tod("signal", 2)
    with pytest.raises(
        InputError, match=r"'pink' was not kept, only atmosphere and signal and white(.|\n)*keep=\["
    ):
        data.tod("pink", 0)


def test_a_stream_that_nobody_makes_is_refused_at_once(monkeypatch):
    pipeline = zonda.Pipeline(STEPS)
    monkeypatch.setattr(zonda.PointingDaisy, "observe", lambda *args: pytest.fail("it began"))
    with pytest.raises(
        PipelineError,
        match=r"'atmosphre' cannot be kept: no step makes it(.|\n)*did you mean 'atmosphere'",
    ):
        pipeline.run(scene(camera(3)), keep=["atmosphre"])


def test_kept_streams_count_in_the_budget(monkeypatch):
    """Two streams of two scans of 200 detectors, 60000 samples: 192 MB, refused where there is room
    for all but them.
    """
    from zonda.core.machine import resident_memory
    from zonda.core.run import budget as module

    steps = [zonda.PointingDaisy(scan_duration="10 min", scans=2), *STEPS[2:]]
    where, room = scene(camera(200)), max(resident_memory(), 230_000_000) + 150_000_000
    with pytest.raises(PipelineError, match=r"kept streams 192 MB(.|\n)*keep fewer streams"):
        zonda.Pipeline(steps).run(where, keep=["signal", "white"], ceiling=room, threads=1)
    monkeypatch.setattr(module, "available_memory", lambda: 191_999_999)
    with pytest.raises(PipelineError, match=r"the kept streams would take 192 MB, 192 MB are free"):
        zonda.Pipeline(steps).run(where, keep=["signal", "white"], memory=10**8, threads=1)


def test_a_kept_stream_has_the_same_bits_wherever_it_was_held():
    """In memory, or spilled to disk: little memory, many blocks."""
    pipeline = zonda.Pipeline([*STEPS, zonda.HighpassFilter(frequency="1 Hz")])
    where = scene(camera(19))
    ample = pipeline.run(where, keep=["signal"], threads=1)
    little = pipeline.run(where, keep=["signal"], threads=1, memory=300_000)
    np.testing.assert_array_equal(ample.tod("signal", 0), little.tod("signal", 0))
