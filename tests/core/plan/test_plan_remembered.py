"""A plan that is remembered is the plan that would be made."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from pydantic import ValidationError

import zonda
from zonda.core.configuration import locate
from zonda.core.plan import bands, remembered
from zonda.core.plan.planner import plan_band
from zonda.core.plan.remembered import summary

SHORT = ["PointingDaisy.scan_duration=40 s", "PointingDaisy.scans=1"]


@pytest.fixture
def file(tmp_path, monkeypatch):
    """The shipped pipeline with a sky map of its own, and an empty memory."""
    monkeypatch.setenv("ZONDA_CACHE_DIR", str(tmp_path / "cache"))
    shipped = Path(str(locate.shipped()["mustang2_cluster"]))
    shutil.copytree(shipped.parent / "data", tmp_path / "data")
    shutil.copy(shipped, tmp_path)
    return zonda.load(tmp_path / shipped.name, overrides=SHORT)


@pytest.fixture
def no_planning(monkeypatch):
    def refuse(*args, **kwargs):
        raise RuntimeError("planned again")

    def switch():
        monkeypatch.setattr(bands, "plan_band", refuse)

    return switch


def test_the_same_as_planned(file, no_planning):
    made = plan_band(file)
    first = summary(file)
    no_planning()
    again = summary(file)
    assert again == first
    assert again.short == made.summary.short
    assert again.apply(file).resolved_yaml() == made.apply(file).resolved_yaml()
    assert str(again).startswith("about ")


def test_what_it_depends_on_makes_it_anew(file, tmp_path, no_planning, monkeypatch):
    summary(file)
    no_planning()
    changes = [
        lambda: summary(file, drop=["poles"]),
        lambda: summary(file, prune_all=False),
        lambda: summary(
            zonda.load(tmp_path / "mustang2_cluster.yaml", overrides=[*SHORT, "seed=1"])
        ),
        lambda: summary(
            zonda.load(
                tmp_path / "mustang2_cluster.yaml", overrides=[*SHORT, "AtmosphereLayers.pwv=3 mm"]
            )
        ),
    ]
    for change in changes:
        with pytest.raises(RuntimeError, match="planned again"):
            change()
    summary(file)
    monkeypatch.setattr(remembered, "fingerprint", lambda: "another program")
    with pytest.raises(RuntimeError, match="planned again"):
        summary(file)
    monkeypatch.undo()


def test_a_changed_input_map(file, tmp_path, no_planning):
    import os

    summary(file)
    no_planning()
    os.utime(tmp_path / "data" / "merging_cluster.fits", (1, 1))
    with pytest.raises(RuntimeError, match="planned again"):
        summary(file)


def test_an_input_map_of_other_content_and_the_same_size_and_time(file, tmp_path, no_planning):
    import os

    path = tmp_path / "data" / "merging_cluster.fits"
    before = path.stat()
    summary(file)
    no_planning()
    content = bytearray(path.read_bytes())
    content[-4000] ^= 1
    path.write_bytes(content)
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
    assert (path.stat().st_mtime_ns, path.stat().st_size) == (before.st_mtime_ns, before.st_size)
    with pytest.raises(RuntimeError, match="planned again"):
        summary(file)


@pytest.mark.parametrize(
    "value",
    [None, [], {}, {"operators": 1}, {"operators": [], "runs": [], "settings": {}, "short": [[1]]}],
)
def test_foreign_memories_count_as_none(value):
    with pytest.raises(ValidationError):
        remembered.SUMMARY.validate_python(value)


def test_others_operators_are_not_remembered(file, monkeypatch):
    from zonda.core.discovery import Found

    monkeypatch.setattr(
        remembered, "discover", lambda group: [Found("Mine", "mine:Mine", "zonda-mine", "1")]
    )
    assert remembered._key(file, {}) is None


def test_free_memory_may_fluctuate_about_a_limit(file, no_planning, monkeypatch):
    """Only between powers of two whose middle it is near; a quarter of it is another case."""
    monkeypatch.setattr(remembered, "available_memory", lambda: int(2**33.45))
    first = summary(file)
    no_planning()
    for power in (33.0, 33.45, 33.55):
        monkeypatch.setattr(remembered, "available_memory", lambda power=power: int(2**power))
        assert summary(file) == first
    for power in (31.5, 34.0):
        monkeypatch.setattr(remembered, "available_memory", lambda power=power: int(2**power))
        with pytest.raises(RuntimeError, match="planned again"):
            summary(file)


def test_what_a_run_does_not_do(file, tmp_path):
    """The structure leaves out white noise for a map of hits, and the run says so."""
    from zonda.core.configuration.pipeline_file import parse

    text = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
runs: {quiet: {without: [white]}}
operators:
  - PointingDaisy: {scan_duration: 20 s}
  - SkyMap: {file: data/merging_cluster.fits}
  - WhiteNoise
  - Efficiency
  - BinMap: {pixel: 2 arcsec, contents: hits}
  - SaveMap
"""
    hits = parse(text, name="hits", folder=tmp_path)
    assert summary(hits).omitted(hits) == ["SkyMap", "WhiteNoise", "Efficiency", "signal quiet"]
    assert summary(file).omitted(file) == []
