"""Stored fronts: what they hold for, and what is chosen from them."""

import dataclasses
import json

import pytest

import zonda
from zonda.core.accuracy import fronts as store
from zonda.core.accuracy.bench import Setup
from zonda.core.accuracy.fronts import Retest
from zonda.core.accuracy.pareto import study
from zonda.core.accuracy.report import lines
from zonda.core.accuracy.settings import knobs_of
from zonda.core.errors import InputError

TEXT = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
seed: 5
operators:
  - PointingDaisy: {scan_duration: 5 min}
  - PinkNoise
  - Efficiency
  - HighpassFilter: {frequency: 0.1 Hz}
  - CommonModeFilter
  - BinMap
"""
LAW = {"HighpassFilter.oversampling": (10.0, 0.05), "CommonModeFilter.residual": (1.0, 0.1)}
"""Errors and costs of the toy measurement below."""


def toy_run(setting, seed, alone):
    """A map whose difference from the reference is known: no process, no scan."""
    import numpy as np

    from zonda.core.accuracy.bench import TimedRun

    coarse = 1 / float(setting.get("HighpassFilter.oversampling", 24))
    loose = float(setting.get("CommonModeFilter.residual", 1e-6))
    signal = np.full((4, 4), 1 + 0.1 * coarse + loose)
    seconds = {"HighpassFilter": 1 / coarse, "CommonModeFilter": -float(np.log10(loose))}
    product = {"I": {"signal": signal, "weights": np.ones((4, 4)), "noise": np.ones((4, 4))}}
    return TimedRun(product, seconds, 10**8, 1.0)


@pytest.fixture
def made(tmp_path):
    path = tmp_path / "my.yaml"
    path.write_text(TEXT)
    file = zonda.load(path)
    knobs = knobs_of(file, ["oversampling", "residual"])
    found = study(file, Setup(str(path), (), "map_rms", 0.005, {}), knobs, run=toy_run)
    return path, file, found


def test_what_is_written_reads_back(made, tmp_path):
    _, file, found = made
    path = store.save(found, file)
    assert path == tmp_path / "fronts" / "my.map_rms.json"
    front = store.read(path)
    assert (front.metric, front.seed, front.fingerprint) == ("map_rms", 5, store.fingerprint(file))
    assert [p.setting for p in front.points] == [p.setting for p in found.points]
    assert [p.error for p in front.points] == pytest.approx(
        [p.error for p in found.points], rel=1e-5
    )


def test_the_chosen_setting_meets_the_target(made):
    _, file, found = made
    store.save(found, file)
    assert found.chosen.error + found.sweep.left <= 0.005
    for target in (0.03, 0.005):
        choice = store.settings_for(file, target)
        chosen = dict(text.split("=") for text in choice.overrides)
        error = (
            0.1 / float(chosen["HighpassFilter.oversampling"])
            - 0.1 / 48
            + float(chosen["CommonModeFilter.residual"])
        )
        assert error <= choice.error <= target
        assert "stored Pareto front" in choice.reason


def test_a_front_holds_for_its_own_pipeline(made):
    """Seed, knobs and the length of the scans do not matter, everything else does."""
    path, file, found = made
    store.save(found, file)
    same = [
        "seed=6",
        "HighpassFilter.oversampling=12",
        "BinMap.pixel=2 arcsec",
        "name=other",
        "PointingDaisy.scan_duration=1 min",
    ]
    other = [
        "HighpassFilter.frequency=0.2 Hz",
        "PointingDaisy.speed=1 arcmin/s",
        "target=06h +20d",
        "PinkNoise.knee=3 Hz",
        "site=chajnantor",
        "time=2024-11-26T07:00",
    ]
    for change in same:
        assert store.fingerprint(zonda.load(path, overrides=[change])) == store.fingerprint(file)
    for change in other:
        changed = zonda.load(path, overrides=[change])
        assert store.fingerprint(changed) != store.fingerprint(file)
        choice = store.settings_for(changed, 0.01)
        assert choice.error is None
        assert "of other steps" in choice.reason
        assert "HighpassFilter.oversampling=48" in choice.overrides


def test_without_a_front_the_tightest(made):
    _, file, _ = made
    choice = store.settings_for(file, 0.01)
    assert choice.error is None
    assert "no stored Pareto front" in choice.reason
    assert {"HighpassFilter.oversampling=48", "precision=float64"} <= set(choice.overrides)
    assert not any(
        "poles" in text for text in choice.overrides
    )  # another number of poles is another realization


def test_a_target_that_no_point_meets(made):
    _, file, found = made
    store.save(found, file)
    choice = store.settings_for(file, 1e-9)
    assert "no point of the stored Pareto front" in choice.reason
    assert "HighpassFilter.oversampling=48" in choice.overrides


def test_a_front_holds_for_its_own_values_of_knobs_that_redraw(tmp_path):
    """They are those of the file in all its points, and what they are wrong by is in its error."""
    path = tmp_path / "my.yaml"
    path.write_text(TEXT)
    file = zonda.load(path)
    store.save(
        study(
            file,
            Setup(str(path), (), "map_rms", 0.5, {}, seeds=(5, 6)),
            knobs_of(file),
            run=toy_run,
        ),
        file,
    )
    assert store.settings_for(file, 0.5).error is not None
    other = store.settings_for(zonda.load(path, overrides=["PinkNoise.poles=4"]), 0.5)
    assert other.error is None
    assert "was made with PinkNoise.poles=8" in other.reason


def test_what_the_file_states_stays(made):
    path, file, found = made
    store.save(found, file)
    stated = zonda.load(path, overrides=["HighpassFilter.oversampling=12"])
    choice = store.settings_for(stated, 0.01)
    assert not any("oversampling" in text for text in choice.overrides)
    assert "as the file states: HighpassFilter.oversampling=12" in choice.reason
    assert choice.error is None  # the front's error is not that of this mixture


@pytest.mark.parametrize(
    "text", ["", "[]", "{}", '{"format": 99}', '{"format": 1, "points": 3}', "{"]
)
def test_a_spoilt_file_is_named(made, text):
    _, file, found = made
    path = store.save(found, file)
    path.write_text(text)
    with pytest.raises(InputError, match=r"front.*|format"):
        store.settings_for(file, 0.01)


def test_json_is_complete(made):
    _, file, found = made
    values = json.loads(json.dumps(store.as_json(found, file)))
    assert {
        "alone",
        "front",
        "points",
        "chosen",
        "reference",
        "noise_floor",
        "realization_scatter",
        "versions",
    } <= values.keys()
    assert values["chosen"]["setting"] == found.chosen.setting


def test_accuracy_in_the_file(made):
    path, _, _ = made
    assert zonda.load(path).header.accuracy is None
    asked = zonda.load(path, overrides=["accuracy=2 %"]).header.accuracy
    assert (asked.target, asked.metric) == (0.02, "map_rms")
    asked = zonda.load(path, overrides=["accuracy={target: 2 %, metric: peak}"])
    assert asked.header.accuracy.metric == "peak"
    path.write_text(asked.resolved_yaml())
    assert zonda.load(path).header.accuracy == asked.header.accuracy
    for wrong in ("0 %", "-1 %", "soon", "{metric: peak}", "{target: 1 %, metrik: peak}"):
        with pytest.raises(zonda.ZondaError, match="accuracy"):
            zonda.load(path, overrides=[f"accuracy={wrong}"])


def test_a_retest_fails_where_the_error_grew():
    good = Retest({}, 0.01, 0.011)
    assert good.good
    assert not dataclasses.replace(good, now=0.013).good
    assert Retest({}, 0.0, 5e-6).good


def test_ctrl_c_leaves_the_front_so_far(made):
    path, file, whole = made
    calls = 0

    def run(setting, seed, alone):
        nonlocal calls
        calls += 1
        if calls == 6:
            raise KeyboardInterrupt
        return toy_run(setting, seed, alone)

    setup, knobs = Setup(str(path), (), "map_rms", 0.005, {}), knobs_of(file)[-3:-1]
    found = study(file, setup, knobs, run=run)
    assert found.interrupted
    assert [p.setting for p in found.points] == [p.setting for p in whole.points][:4]
    assert "interrupted after 5 runs" in "\n".join(lines(found))
    calls = 5
    with pytest.raises(KeyboardInterrupt):  # nothing is found yet
        study(file, setup, knobs, run=run)
