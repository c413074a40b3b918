"""Companion runs whose filters are those of the complete data."""

from __future__ import annotations

from typing import ClassVar

import numpy as np
import pytest
from pydantic import PrivateAttr
from zonda.core.run.companion import Companion
from zonda.core.run.frozen import Frozen

from zonda.core.configuration.pipeline_file import parse
from zonda.core.data import Block, Observation
from zonda.core.errors import PipelineError, ZondaError
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.operators.filters.common_mode import CommonModeFilter
from zonda.operators.filters.highpass import HighpassFilter
from zonda.operators.maps.bin_map import BinMap
from zonda.plugins.checks import scenes

N_DET, N = 12, 3000
RUNS = {"sky": {"only": ["sky"], "modes": "full"}, "rest": {"without": ["sky"], "modes": "full"}}


class Given(Operator):
    """A stream that is given."""

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    _values: np.ndarray = PrivateAttr(default_factory=lambda: np.zeros((0, 0)))

    def exec(self, block: Block, state: object) -> None:
        (name,) = self.provides
        block.new(name)[...] = self._values[block.detectors, block.samples]


class Sky(Given):
    """The sky."""

    provides: ClassVar[frozenset[str]] = frozenset({"sky"})


class Noise(Given):
    """The noise, of detectors that it makes unequal; it flags some samples."""

    provides: ClassVar[frozenset[str]] = frozenset({"white"})

    def configure(self, observation: Observation) -> None:
        observation.focalplane.net = observation.focalplane.net * np.linspace(1, 3, observation.n_detectors)

    def prepare(self, observation: Observation) -> None:
        observation.flags[700:720] |= 64


class Sum(Operator):
    """Adds up."""

    optional: ClassVar[frozenset[str]] = frozenset({"sky", "white", "pink"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})

    def exec(self, block: Block, state: object) -> None:
        block.new("signal")[...] = sum(block.detdata[n] for n in ("sky", "white", "pink") if n in block.detdata)


class Median(Operator):
    """Subtracts the median over all samples: it is not linear, and says nothing of how it would be frozen."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    couples: ClassVar = "all"

    def prepare(self, observation: Observation) -> list[float]:
        return []

    def measure(self, stream, state) -> None:
        state[:] = [float(np.median(stream.array))]

    def exec(self, block: Block, state: list[float]) -> None:
        block.detdata["signal"] -= state[0]


class FreezingMedian(Median):
    """The same, frozen: another run loses the complete data's median."""

    def freeze(self, state):
        return state[0]

    def measure_frozen(self, stream, state, frozen) -> None:
        state[:] = [frozen]


def streams(dead: bool = True) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    common = np.cumsum(rng.standard_normal((2, N)), axis=1) / 30
    noise = 0.3 * rng.standard_normal((N_DET, N)) + rng.uniform(0.5, 1.5, (N_DET, 2)) @ common
    noise[4] = np.nan if dead else 0.0
    return np.sin(np.arange(N) / 70 + np.arange(N_DET)[:, None] / 3), noise


def chain(*filters: Operator, dead: bool = True) -> list[Operator]:
    sky, noise = Sky(), Noise()
    sky._values, noise._values = streams(dead)
    return [sky, noise, Sum(), *filters, BinMap(pixel="10 arcsec")]


def run(steps: list[Operator], runs: object = RUNS, **settings: object):
    points = scenes.Points()
    points._observation = scenes.scan(N_DET, N)
    settings = {"threads": 1, **settings}
    return Pipeline([points, *steps], runs=runs, precision="float64").run(scenes.scene(), **settings)


FILTERS = [
    (CommonModeFilter(modes=2, on_undetermined="remove"),),
    (CommonModeFilter(method="mean"),),
    (HighpassFilter(frequency="0.5 Hz", trim="1 s"), CommonModeFilter(residual=1e-3)),
    (CommonModeFilter(), HighpassFilter(frequency="0.5 Hz"), CommonModeFilter(on_undetermined="skip")),
]


@pytest.mark.parametrize("filters", FILTERS, ids=["two modes", "mean", "after a filter", "twice"])
def test_runs_of_all_components_add_up_to_the_main_run(filters):
    """Dead detectors, flags, unequal weights included. Each of three maps rounds w d to 2^-36 K, 1/w at most 9 2^(1/2)."""
    data = run(chain(*filters))
    whole, sky, rest = (data.products[n] for n in ("map", "sky/map", "rest/map"))
    for other in (sky, rest):
        assert np.array_equal(whole.hits, other.hits)
        assert np.array_equal(whole.weights, other.weights)
    assert data.observations[0].n_samples * N_DET > whole.hits.sum() > 0
    np.testing.assert_allclose(sky.signal + rest.signal, whole.signal, atol=3 * 2**-37 * 9 * 2**0.5, rtol=0)
    alone = run(chain(*filters), {"sky": {"only": ["sky"]}}).products["sky/map"].signal
    assert np.nanmax(abs(alone - sky.signal)) > 1e-3  # the sky's own modes are others


def test_the_frozen_filter_is_a_symmetric_projection():
    """F = 1 - U U^T over the detectors in use: <b, F a> = <F b, a> (the dot test), and nothing of what it removes is left.

    float64: sums of n = 33 000 terms of order 1, rounded at each step, err by n^(1/2) 2^-53 n^(1/2) = 4e-12 at most.
    """
    a, b = np.random.default_rng(8).standard_normal((2, N_DET, N))
    given = [Sky(), Other(), Noise()]
    for step, values in zip(given, (a, b, streams()[1]), strict=True):
        step._values = values
    runs = {"a": {"only": ["sky"], "modes": "full"}, "b": {"only": ["pink"], "modes": "full"}}
    data = run([*given, Sum(), CommonModeFilter(modes=2, on_undetermined="remove"), Keep()], runs)
    use = np.ix_(data.observations[0].detector_flags == 0, data.observations[0].flags == 0)
    a, b, fa, fb = a[use], b[use], data.products["a/kept"][use], data.products["b/kept"][use]
    left, right = np.vdot(b, fa), np.vdot(fb, a)
    assert abs(left - right) < 1e-11 < 1 < abs(left)
    u, size, _ = np.linalg.svd(a - fa, full_matrices=False)
    assert size[1] > 1 > 1e-12 > size[2]
    assert abs(u[:, :2].T @ fa).max() < 1e-13
    assert abs(u[:, :2].T @ fb).max() < 1e-13


class Other(Given):
    """Another component."""

    provides: ClassVar[frozenset[str]] = frozenset({"pink"})


class Keep(Operator):
    """Keeps the signal."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"kept"})

    def prepare(self, observation: Observation) -> np.ndarray:
        return np.zeros((observation.n_detectors, observation.n_samples))

    def exec(self, block: Block, state: np.ndarray) -> None:
        state[block.detectors, block.samples] = block.detdata["signal"]

    def collect(self, data, observation, state) -> None:
        data.products[data.product("kept")] = state


@pytest.mark.parametrize("settings", [{"threads": 3}, {"memory": 3_000_000}])
def test_bits_depend_on_neither_threads_nor_memory(settings):
    filters = FILTERS[2]
    one, other = (run(chain(*filters), **s).products["sky/map"].signal for s in ({}, settings))
    assert np.array_equal(one, other, equal_nan=True)


def test_an_operator_that_cannot_freeze_is_refused():
    with pytest.raises(PipelineError, match=r"run sky has modes: full, but Median cannot freeze.*\n?.*freeze and measure_frozen"):
        run(chain(Median()))
    run(chain(Median()), {"sky": {"only": ["sky"]}})
    with pytest.raises(NotImplementedError):
        Median().freeze([])


def test_a_third_party_operator_takes_part():
    """What it found in the complete data is what the other runs are told."""
    data = run([*chain(FreezingMedian(), dead=False)[:-1], Keep()])
    sky, noise = streams(dead=False)
    median = np.median(sky + noise)
    assert abs(median) > 1e-3
    np.testing.assert_array_equal(data.products["sky/kept"], sky - median)


def test_freezing_keeps_little():
    """Modes over detectors and flags, not streams: (2 modes x 12 x 8 bytes) and the flags where they changed."""
    frozen = Frozen()
    o = scenes.scan(N_DET, N)
    for label in "abc":
        frozen.at(o, label, "prepare")
    o.flags = o.flags.copy()
    o.flags[3] = 1
    frozen.at(o, "d", "prepare")
    kept = {id(array): array.nbytes for used in frozen._used.values() for array in used}
    assert sum(kept.values()) <= 2 * N + N_DET * (1 + 8)
    frozen.complete = True
    o.flags[:] = 7
    frozen.at(o, "a", "prepare")
    assert not o.flags.any()
    frozen.at(o, "d", "prepare")
    assert o.flags.sum() == 1


def test_modes_of_the_complete_data_where_nothing_is_left_out_are_its_own():
    """A step that asks for the sky alone in a pipeline of the sky alone reads the main run."""
    sky = Sky()
    sky._values = streams()[0]
    points = scenes.Points()
    points._observation = scenes.scan(N_DET, N)

    class Reads(Keep):
        """Reads two runs."""

        at_end: ClassVar[bool] = True

        def needs(self):
            return Companion(only=["sky"], modes="full"), Companion(only=["sky"], filters="none")

    pipeline = Pipeline([points, sky, CommonModeFilter(), Reads()])
    assert pipeline.operators[-1].runs == ("", "_sky_unfiltered")
    more = Pipeline([points, sky, Noise(), Sum(), CommonModeFilter(), Reads()], runs={"mine": {"only": ["sky"], "modes": "full"}})
    assert more.operators[-1].runs == ("mine", "_sky_unfiltered")
    assert list(more.runs) == ["mine", "_sky_unfiltered"]


def test_a_run_cannot_take_a_name_of_the_steps_own():
    with pytest.raises(PipelineError, match="cannot name a run"):
        run(chain(), {"_sky": {"only": ["sky"]}})


FILE = """
site: green_bank
instrument: mustang2
time: 2024-11-25T07:00
target: 05h +20d
runs: {quiet: {only: [white], modes: full, filters: none}}
operators:
  - PointingDaisy: {scan_duration: 10 s}
  - WhiteNoise
  - PinkNoise
  - Efficiency
  - CommonModeFilter
  - BinMap
"""


def test_in_a_pipeline_file():
    file = parse(FILE)
    assert file.runs["quiet"] == Companion(only=["white"], modes="full", filters="none")
    assert parse(file.resolved_yaml()).runs == file.runs
    with pytest.raises(ZondaError, match=r"(?s)modes.*own.*full"):
        parse(FILE.replace("modes: full", "modes: mine"))


def test_a_pipeline_file_says_where_an_operator_cannot_freeze(monkeypatch):
    monkeypatch.delattr(CommonModeFilter, "freeze")
    parse(FILE)  # without filters nothing is to be frozen
    with pytest.raises(ZondaError, match=r"(?s)CommonModeFilter cannot freeze.*quiet: \{only"):
        parse(FILE.replace(", filters: none", ""))
    text = FILE.replace("  - WhiteNoise", "  - SkyMap: {file: pipelines/data/merging_cluster.fits}\n  - WhiteNoise")
    with pytest.raises(ZondaError, match=r"(?s)run _sky_full has modes: full.*cannot freeze.*operators:"):
        parse(
            text.replace("runs: {quiet: {only: [white], modes: full, filters: none}}", "")
            + "  - TransferFunction: {modes: full}\n"
        )
