"""Companion runs that are derived from the main run and from others, against the same runs simulated."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from zonda.core.run.derived import derivable

import zonda
from zonda.core.data import Block, Data
from zonda.core.operator import Operator
from zonda.core.pipeline import Part, Pipeline
from zonda.plugins.checks import scenes
from zonda.plugins.checks.scenes import camera, scan, sky_file

SKY, REST = {"only": ["sky"], "modes": "full"}, {"without": ["sky"], "modes": "full"}
BOTH = {"sky": SKY, "rest": REST}


class Holes(Operator):
    """Puts NaN where the detectors look like glitches, so that no two runs have the same: it is not linear, but says so."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    linear: ClassVar[bool] = True

    def exec(self, block: Block, state: object) -> None:
        signal = block.detdata["signal"]
        signal[signal > 0.01] = np.nan


def steps(*filters: Operator, **binning: Any) -> list[Operator]:
    generators = [
        zonda.AtmosphereLayers(pwv="7.7 mm", pwv_rms="2 %"),
        zonda.WhiteNoise(scatter=0.3),
        zonda.PinkNoise(shared=0.8),
        zonda.Efficiency(calibration_error="5 %"),
    ]
    return [*generators, *filters, zonda.BinMap(**{"pixel": "8 arcsec", **binning})]


class Several(Operator):
    """Scans at the same place, of other noise and later air."""

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})
    scans: int = 2

    def observe(self, data: Data) -> None:
        for k in range(self.scans):
            o = scan(19, 6000, radius=2)
            o.index, o.name = k, f"scan-{k}"
            data.observations.append(o)


def observed(operators: list[Operator], runs: Any, scans: int = 2, precision: Any = "float32", **settings: Any):
    """The pipeline, and what it made of a source of 50 mK."""
    y, x = np.indices((40, 40)) - 19.5
    with sky_file(0.05 * np.exp(-(x**2 + y**2) / 50), 8.0) as path:
        sky = [Several(scans=scans), zonda.SkyMap(file=path)]
        pipeline = Pipeline([*sky, *operators], runs=runs, precision=precision)
        return pipeline, pipeline.run(scenes.scene(camera(19)), **{"threads": 2, **settings})


MAP = zonda.SkyMap(file=Path(zonda.__file__).parent / "pipelines" / "data" / "merging_cluster.fits")
FILTERS = {
    "none": (),
    "high-pass": (zonda.HighpassFilter(frequency="0.5 Hz"),),
    "modes": (zonda.HighpassFilter(frequency="0.5 Hz", trim="1 s"), zonda.CommonModeFilter(modes=2)),
    "mean": (zonda.HighpassFilter(frequency="0.5 Hz"), zonda.CommonModeFilter(method="mean")),
}


@pytest.mark.parametrize("filters", FILTERS.values(), ids=FILTERS)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_derived_is_simulated(filters, precision):
    """Streams of up to 0.5 K (fluctuations of the air), rounded to 2^-24 of it some 20 times in a sample: 6e-7 K.

    float64: each of three sums is rounded to 2^-37 K, times weights of 2^(1/2) at most.
    """
    pipeline, data = observed(steps(*filters), BOTH, precision=precision)
    assert pipeline.derived == {"rest": ("sky",)}
    _, simulated = observed(steps(*filters), {"rest": REST}, precision=precision)
    found, true, whole = data.products["rest/map"], simulated.products["rest/map"], data.products["map"]
    allowed = 6e-7 if precision == "float32" else 4 * 2.0**-36
    assert np.nanmax(abs(found.signal - true.signal)) < allowed < 1e-2 * np.nanstd(true.signal)
    assert np.nanmax(abs(found.half_difference - true.half_difference)) < allowed
    assert np.nanmax(abs(whole.signal - true.signal)) > 100 * allowed, "there is a sky to be taken away"
    for name in ("hits", "weights", "noise"):
        assert np.array_equal(getattr(found, name), getattr(true, name), equal_nan=True)
    assert np.array_equal(found.hits, whole.hits)
    assert ("rest", "derived as", "the main run minus sky") in list(data.tally)


def test_what_is_not_finite_in_the_main_run_is_left_out_of_all():
    """Hits of a run with the complete data's modes are the main run's, and the rest can be derived."""
    _, data = observed(steps(FILTERS["high-pass"][0], Holes()), BOTH)
    hits = [data.products[n].hits for n in ("map", "sky/map", "rest/map")]
    assert 0 < hits[0].sum() < 0.99 * 2 * 19 * 6000
    assert np.array_equal(hits[0], hits[1])
    assert np.array_equal(hits[0], hits[2])
    dropped = "samples dropped: not finite"
    assert data.tally.get("sky/BinMap", dropped) >= data.tally.get("BinMap", dropped) > 100
    for threads, memory in ((1, None), (3, 14_000_000)):
        _, again = observed(steps(FILTERS["high-pass"][0], Holes()), BOTH, threads=threads, memory=memory)
        for name in ("sky/map", "rest/map"):
            assert np.array_equal(data.products[name].signal, again.products[name].signal, equal_nan=True)


def test_where_a_filter_bridged_the_main_run_the_run_is_simulated():
    """The high-pass bridges what is not finite, in the main run and in that of the noise; the sky has nothing to bridge."""

    class Gaps(Operator):
        """Holes of 20 samples in every 500 of the noise."""

        optional: ClassVar[frozenset[str]] = frozenset({"white"})
        provides: ClassVar[frozenset[str]] = frozenset({"white"})

        def exec(self, block: Block, state: object) -> None:
            where = np.arange(block.samples.start, block.samples.stop) % 500 < 20
            (block.detdata["white"] if "white" in block.detdata else block.new("white"))[:, where] = np.nan

    operators = steps(*FILTERS["high-pass"])
    operators.insert(2, Gaps())
    pipeline, data = observed(operators, BOTH)
    assert pipeline.derived == {"rest": ("sky",)}
    assert any(who == "rest" and what == "simulated" for who, what, _ in data.tally)
    _, alone = observed(operators, {"rest": REST})
    assert np.array_equal(data.products["rest/map"].signal, alone.products["rest/map"].signal, equal_nan=True)
    assert np.array_equal(data.products["rest/map"].hits, data.products["map"].hits)


@pytest.mark.parametrize("threads", [1, 2])
def test_operators_find_what_their_run_left_of_every_scan(threads):
    """Also of the first, which is prepared for the next run while the last one is still executed."""
    seen: dict[str, list[Any]] = {}

    class Look(Operator):
        requires: ClassVar[frozenset[str]] = frozenset({"signal"})
        only_tells: ClassVar[bool] = True

        def finalize(self, data: Data) -> None:
            seen[data.run] = [(int(np.count_nonzero(o.flags)), "atmosphere" in o.smooth) for o in data.observations]

    _, data = observed(steps(FILTERS["modes"][0], Look()), BOTH, threads=threads)
    trimmed = 2 * round(data.observations[0].sample_rate)
    assert seen[""][0] == seen[""][1] == (trimmed, True)
    assert seen["sky"] == seen["rest"] == [(trimmed, False)] * 2
    assert [o.index for o in data.observations] == [0, 1]
    assert [int(np.count_nonzero(o.flags)) for o in data.observations] == [trimmed] * 2


def test_where_samples_differ_the_run_is_simulated(monkeypatch):
    """Without the main run's holes in it the run of the sky has more samples."""
    monkeypatch.setattr(zonda.BinMap, "leave_out", Operator.leave_out)
    pipeline, data = observed(steps(FILTERS["high-pass"][0], Holes()), BOTH)
    assert pipeline.derived == {"rest": ("sky",)}
    assert data.products["sky/map"].hits.sum() > data.products["map"].hits.sum()
    assert any(who == "rest" and what == "simulated" for who, what, _ in data.tally)
    _, alone = observed(steps(FILTERS["high-pass"][0], Holes()), {"rest": REST})
    assert np.array_equal(data.products["rest/map"].signal, alone.products["rest/map"].signal, equal_nan=True)


@pytest.mark.parametrize(
    ("binning", "runs", "more"),
    [
        ({"noise": "scatter"}, BOTH, ()),
        ({}, {**BOTH, "sky": {"only": ["sky"]}}, ()),
        ({}, {**BOTH, "sky": {**SKY, "filters": "none"}}, ()),
        ({}, {"sky": SKY, "white": {"only": ["white"], "modes": "full"}}, ()),
        ({}, {"a": {"only": ["transmission"], "modes": "full"}, "b": {"without": ["transmission"], "modes": "full"}}, ()),
        ({}, BOTH, (1,)),
    ],
    ids=["scatter", "own modes", "no filters", "not all", "a factor", "says nothing of being linear"],
)
def test_what_cannot_be_derived(binning, runs, more):
    class Unsaid(Operator):
        """Changes the signal, and does not say that it is linear."""

        requires: ClassVar[frozenset[str]] = frozenset({"signal"})
        provides: ClassVar[frozenset[str]] = frozenset({"signal"})

    filters = [Unsaid()] if more else []
    operators = [scenes.Points(), MAP, *steps(*filters, **binning)]
    assert Pipeline(operators, runs=runs).derived == {}


def test_several_runs_make_up_the_rest():
    runs = {n: {"only": [n], "modes": "full"} for n in ("sky", "atmosphere", "white", "pink")}
    pipeline = Pipeline([scenes.Points(), MAP, *steps()], runs=runs)
    assert len(pipeline.derived) == 1
    ((name, parts),) = pipeline.derived.items()
    assert {name, *parts} == set(runs)
    runs = {"rest": REST, "noise": {"only": ["white", "pink"], "modes": "full"}, "sky": SKY}
    pipeline = Pipeline(pipeline.operators, runs=runs)
    assert pipeline.derived == {"rest": ("sky",)}
    assert pipeline.order == ["", "noise", "sky", "rest"]
    assert derivable(pipeline.selection, ["rest", "noise"]) == {}


@pytest.mark.parametrize("binning", [{"pixel": "8 arcsec"}, {"nside": 8192}], ids=["image", "HEALPix"])
def test_parts_of_a_campaign_give_the_same_bits(binning):
    operators = [*steps(*FILTERS["modes"])[:-1], zonda.BinMap(**binning)]
    _, whole = observed(operators, BOTH, scans=3)
    packed = []
    for first, scans in ((True, [0, 1]), (False, [2])):
        part = Part(scans, first=first)
        pipeline, _ = observed(operators, BOTH, scans=3, part=part)
        packed.append(part.packed)
    data = Data(scene=scenes.scene(camera(19)))
    for found in packed:
        pipeline.merge(data, found)
    pipeline.finish(data)
    for name in ("map", "sky/map", "rest/map"):
        for array in ("signal", "hits", "half_difference"):
            one, other = (getattr(d.products[name], array) for d in (whole, data))
            assert np.array_equal(one, other, equal_nan=True)
