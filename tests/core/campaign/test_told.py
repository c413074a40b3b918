"""What a run in several tasks tells is what one process tells: counts of all scans once, warnings
once.
"""

from __future__ import annotations

import threading
import warnings
from concurrent.futures import ThreadPoolExecutor
from functools import partial

import pytest

import zonda
from zonda.core.experiment import engines

ONE = {"band": {"name": "f090", "low": "77 GHz", "high": "106 GHz"}, "net": "1 mK s(1/2)"}
TWO = {
    "bands": [
        {"name": "f090", "low": "77 GHz", "high": "106 GHz", "net": "300 uK s(1/2)"},
        {"name": "f150", "low": "130 GHz", "high": "170 GHz", "net": "360 uK s(1/2)"},
    ]
}


@pytest.mark.parametrize("bands", [ONE, TWO])
def test_tasks_count_their_own_scans(bands, tmp_path):
    camera = zonda.Instrument(
        name="camera",
        telescope={"name": "dish", "diameter": "6 m"},
        detectors=7,
        field_of_view="20 arcmin",
        main_beam_efficiency=0.8,
        illumination_efficiency=0.9,
        sample_rate="50 Hz",
        **bands,
    )
    scene = zonda.Scene(
        site="llano_de_chajnantor",
        instrument=camera,
        time="2022-08-01T23:00",
        target="260d -10d",
        seed=3,
    )
    pointing = zonda.PointingBackAndForth(
        throw="1 deg", speed="0.5 deg/s", acceleration="1 deg/s2", scan_duration="10 s", scans=3
    )
    steps = zonda.Pipeline(
        [
            pointing,
            zonda.WhiteNoise(),
            zonda.Efficiency(),
            zonda.BinMap(pixel="2 arcmin"),
            zonda.SaveMap(),
        ]
    )
    once = [
        row
        for row in steps.run(scene, output=tmp_path / "once", threads=1).log.told()
        if row[1].startswith("samples")
    ]
    made = zonda.campaign(
        steps, scene, output=tmp_path / "tasks", realizations=1, engine="serial", threads=1
    )
    assert [row[1:] for row in made.log if row[2].startswith("samples")] == once
    assert any(
        what.startswith("samples in turnarounds") and value.endswith("%)")
        for _, what, value in once
    )


@pytest.mark.nightly
def test_workers_leave_their_warnings_to_the_main_process(bench, capfd, recwarn):
    """The pointing is too fast for the sample rate: planning and both tasks warn of it."""
    bench.run(
        "{nights: 1}",
        "--engine",
        "processes",
        "--workers",
        2,
        changes=(("50 arcsec/s", "500 arcsec/s"),),
    )
    assert "UserWarning" not in capfd.readouterr().err
    assert sum("samples per FWHM" in str(one.message) for one in recwarn) == 1


def test_warnings_of_a_worker_are_sent_with_the_results_and_shown_once(recwarn):
    """Also of two calls at once in one process, as Dask's workers have them; it then shows warnings
    as before.
    """
    both = threading.Barrier(2, timeout=20)

    def work(number):
        both.wait()
        warnings.warn("it is late", stacklevel=1)
        both.wait()
        return number

    warnings.simplefilter("always")
    with ThreadPoolExecutor(2) as threads:
        results = list(threads.map(partial(engines.with_warnings, "another process", work), (1, 2)))
    assert [result for result, _ in results] == [1, 2]
    assert sorted(len(found) for _, found in results) == [0, 2]
    assert not recwarn.list
    warnings.simplefilter("default")
    shown = {}
    for _, found in results:
        engines.show_warnings(found, shown)
    assert [str(one.message) for one in recwarn.list] == ["it is late"]


def test_the_main_process_shows_its_warnings_at_once(recwarn):
    """Of the tasks of the engine `serial`, and of Dask's workers that are threads of it."""
    assert engines.with_warnings(engines.here(), warnings.warn, "it is late") == (None, [])
    assert [str(one.message) for one in recwarn.list] == ["it is late"]
