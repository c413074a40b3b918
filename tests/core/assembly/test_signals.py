"""Signals of one pass: what each is formed of, how it is measured, masked, filtered and mapped, and
what follows from others.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
from pydantic import PrivateAttr

import zonda
from zonda.core.configuration.pipeline_file import parse
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import PipelineError, ZondaError
from zonda.core.mapmaker import MapMaker
from zonda.core.operator import Operator
from zonda.core.output import Output
from zonda.core.pipeline import Part, Pipeline
from zonda.core.product import Product
from zonda.core.signal import Component, Signal
from zonda.plugins.checks import scenes
from zonda.plugins.checks.scenes import camera, scan, sky_file

SKY, REST = {"only": ["sky"], "modes": "full"}, {"without": ["sky"], "modes": "full"}
BOTH = {"sky": SKY, "rest": REST}
N_DET, N = 12, 3000


# ---- a scene with an atmosphere


class Several(Operator):
    """Scans at the same place, of other noise and a later atmosphere."""

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})
    scans: int = 2

    def observe(self, data: Data) -> None:
        for k in range(self.scans):
            o = scan(19, 6000, radius=2)
            o.index, o.name = k, f"scan-{k}"
            data.observations.append(o)


def steps(*filters: Operator, **binning: Any) -> list[Operator]:
    generators = [
        zonda.AtmosphereLayers(pwv="7.7 mm", pwv_rms="2 %"),
        zonda.WhiteNoise(scatter=0.3),
        zonda.PinkNoise(shared=0.8),
        zonda.Efficiency(calibration_error="5 %"),
    ]
    return [*generators, *filters, zonda.BinMap(**{"pixel": "8 arcsec", **binning})]


def observed(
    operators: list[Operator], runs: Any, scans: int = 2, **settings: Any
) -> tuple[Pipeline, Data]:
    """The pipeline, and what it made of a source of 50 mK."""
    y, x = np.indices((40, 40)) - 19.5
    more = {name: settings.pop(name) for name in ("only", "precision") if name in settings}
    part = settings.pop("part", None)
    with sky_file(0.05 * np.exp(-(x**2 + y**2) / 50), 8.0) as path:
        pipeline = Pipeline(
            [Several(scans=scans), zonda.SkyMap(file=path), *operators], runs=runs, **more
        )
        scene, settings = scenes.scene(camera(19)), {"threads": 2, **settings}
        return pipeline, (
            pipeline.run(scene, **settings)
            if part is None
            else pipeline.run_part(scene, part, **settings)
        )


HIGHPASS = zonda.HighpassFilter(frequency="0.5 Hz")
FILTERS = {
    "none": (),
    "high-pass": (HIGHPASS,),
    "modes": (
        zonda.HighpassFilter(frequency="0.5 Hz", trim="1 s"),
        zonda.CommonModeFilter(modes=2),
    ),
    "mean": (HIGHPASS, zonda.CommonModeFilter(method="mean")),
}


def same(one: Any, other: Any, *names: str) -> bool:
    return all(np.array_equal(getattr(one, n), getattr(other, n), equal_nan=True) for n in names)


# ---- remainders


@pytest.mark.parametrize("filters", FILTERS.values(), ids=FILTERS)
@pytest.mark.parametrize("precision", ["float32", "float64"])
def test_a_remainder_is_what_would_be_formed(filters, precision):
    """Streams of up to 0.5 K (fluctuations of the atmosphere), rounded to 2^-24 of it some 20 times
    in a sample: 6e-7 K.

    float64: each of three sums is rounded to 2^-37 K, times weights of 2^(1/2) at most.
    """
    pipeline, data = observed(steps(*filters), BOTH, precision=precision)
    assert pipeline.signals.remainders == {"rest": ("sky",)}
    assert [s.stream for s in pipeline.signals.formed] == ["signal", "signal/sky"]
    _, formed = observed(steps(*filters), {"rest": REST}, precision=precision)
    found, true, whole = (
        data.products["rest/map"],
        formed.products["rest/map"],
        data.products["map"],
    )
    allowed = 6e-7 if precision == "float32" else 4 * 2.0**-36
    assert np.nanmax(abs(found.signal - true.signal)) < allowed < 1e-2 * np.nanstd(true.signal)
    assert np.nanmax(abs(found.half_difference - true.half_difference)) < allowed
    assert np.nanmax(abs(whole.signal - true.signal)) > 100 * allowed, (
        "there is a sky to be taken away"
    )
    assert same(found, true, "hits", "weights", "noise")
    assert ("rest", "remainder", "the complete signal minus sky") in list(data.log)


class Unsaid(Operator):
    """Changes the signal, and does not say that it is linear."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})

    def exec(self, block: Any, state: Any) -> None:
        """Leaves all as it is."""


MAP = zonda.SkyMap(file=Path(zonda.__file__).parent / "pipelines" / "data" / "merging_cluster.fits")


@pytest.mark.parametrize(
    ("binning", "runs", "more"),
    [
        ({"noise": "scatter"}, BOTH, ()),
        ({}, {**BOTH, "sky": {"only": ["sky"]}}, ()),
        ({}, {**BOTH, "sky": {**SKY, "filters": "none"}}, ()),
        ({}, {"sky": SKY, "white": {"only": ["white"], "modes": "full"}}, ()),
        (
            {},
            {
                "a": {"only": ["transmission"], "modes": "full"},
                "b": {"without": ["transmission"], "modes": "full"},
            },
            (),
        ),
        ({}, BOTH, (Unsaid(),)),
    ],
    ids=[
        "scatter",
        "own modes",
        "no filters",
        "not all",
        "a factor",
        "says nothing of being linear",
    ],
)
def test_what_is_no_remainder(binning, runs, more):
    assert (
        Pipeline([scenes.Points(), MAP, *steps(*more, **binning)], runs=runs).signals.remainders
        == {}
    )


def test_several_signals_make_up_the_rest():
    runs = {n: {"only": [n], "modes": "full"} for n in ("sky", "atmosphere", "white", "pink")}
    pipeline = Pipeline([scenes.Points(), MAP, *steps()], runs=runs)
    ((name, parts),) = pipeline.signals.remainders.items()
    assert {name, *parts} == set(runs)
    runs = {"rest": REST, "noise": {"only": ["white", "pink"], "modes": "full"}, "sky": SKY}
    assert Pipeline(pipeline.operators, runs=runs).signals.remainders == {"rest": ("sky",)}


def test_noise_from_the_scatter_is_each_signals_own():
    """Sums of squares are not linear: each of three signals has noise and sums of its own, as if it
    were mapped alone.
    """
    filters = FILTERS["high-pass"]
    _, data = observed(steps(*filters, noise="scatter"), BOTH)
    for name in ("sky", "rest"):
        _, alone = observed(steps(*filters, noise="scatter"), {name: BOTH[name]})
        assert same(
            data.products[f"{name}/map"],
            alone.products[f"{name}/map"],
            "signal",
            "noise",
            "hits",
            "half_difference",
        )
    quiet, loud = (np.nanmedian(data.products[n].noise) for n in ("sky/map", "rest/map"))
    assert quiet < 0.5 * loud


def test_hits_alone_are_of_no_signal_and_no_remainder_is_taken_from_them():
    _, data = observed(
        [*steps(HIGHPASS), zonda.BinMap(pixel="8 arcsec", contents="hits", product="seen")], BOTH
    )
    assert same(data.products["map"], data.products["seen"], "hits")
    assert {"rest/map", "sky/map"} < data.products.keys()


# ---- bits


@pytest.mark.parametrize(
    "settings",
    [{"threads": 1}, {"threads": 3, "memory": 24_000_000}],
    ids=["one thread", "small blocks"],
)
@pytest.mark.parametrize("filters", ["modes", "mean"])
def test_bits_depend_on_neither_threads_nor_memory(filters, settings):
    runs = {**BOTH, "own": {"only": ["sky"]}, "raw": {"only": ["sky"], "filters": "none"}}
    _, one = observed(steps(*FILTERS[filters]), runs)
    _, other = observed(steps(*FILTERS[filters]), runs, **settings)
    for name in ("map", "sky/map", "rest/map", "own/map", "raw/map"):
        assert same(one.products[name], other.products[name], "signal", "hits", "noise")


def test_the_complete_signal_has_the_bits_that_it_has_alone():
    for filters in FILTERS.values():
        _, alone = observed(steps(*filters), {})
        _, beside = observed(
            steps(*filters), {**BOTH, "raw": {"only": ["pink"], "filters": "none"}}
        )
        assert same(
            alone.products["map"],
            beside.products["map"],
            "signal",
            "hits",
            "weights",
            "noise",
            "half_difference",
        )


@pytest.mark.parametrize(
    "binning",
    [{"pixel": "8 arcsec"}, {"nside": 8192}, {"noise": "scatter"}],
    ids=["image", "HEALPix", "scatter"],
)
def test_parts_of_a_campaign_give_the_same_bits(binning):
    operators = [*steps(*FILTERS["modes"])[:-1], zonda.BinMap(**binning)]
    pipeline, whole = observed(operators, BOTH, scans=3)
    points = Data(scene=whole.scene, observations=whole.observations)
    pipeline.operators[-1].observe(points)
    data = Data(scene=scenes.scene(camera(19)), layouts=points.layouts, laid_out=True)
    for scans in ([0, 1], [2]):
        _, found = observed(operators, BOTH, scans=3, part=Part(scans, points.layouts))
        assert found.products == {}
        for label, product in found.partial.items():
            data.add(label, type(product).of(product.arrays()))
    pipeline.finish(data)
    for name in ("map", "sky/map", "rest/map"):
        assert same(
            whole.products[name], data.products[name], "signal", "hits", "noise", "half_difference"
        )


# ---- transmission and means


def test_the_sky_is_seen_through_the_fluctuating_transmission_with_the_modes_of_the_complete_data():
    """x of 2 % of the PWV: with `full` the sky is multiplied by 1 + x, with `own` modes it is not;
    without filters they differ by nothing else. Transmission that is left out by name is not
    applied either."""
    runs = {
        "full": {**SKY, "filters": "none"},
        "own": {"only": ["sky"], "filters": "none"},
        "bare": {
            "without": ["transmission", "atmosphere", "white", "pink"],
            "modes": "full",
            "filters": "none",
        },
    }
    _, data = observed(steps(), runs)
    full, own, bare = (data.products[f"{n}/map"].signal for n in runs)
    assert np.array_equal(own, bare, equal_nan=True)
    assert 1e-5 < np.nanmax(abs(full - own)) < 0.02 * np.nanmax(own)


def test_only_a_signal_with_the_atmosphere_has_its_mean():
    """Tens of kelvin in the maps of signals without a high-pass that hold the atmosphere, none in
    the others.
    """
    runs = {
        "sky": {"only": ["sky"]},
        "air": {"only": ["atmosphere"]},
        "quiet": {"without": ["atmosphere"], "modes": "full"},
    }
    _, data = observed(steps(), runs, precision="float64")
    level = {
        name: abs(np.nanmean(data.products[f"{name}/map" if name else "map"].signal))
        for name in ("", *runs)
    }
    assert level[""] > 10 < level["air"]
    assert level["sky"] < 0.1 > level["quiet"]


def test_a_map_maker_that_does_not_know_of_means_sees_whole_signals():
    """Tens of kelvin in the signals with the atmosphere, under all their names."""
    runs = {"air": {"only": ["atmosphere"]}, "sky": {"only": ["sky"]}}
    _, data = observed([*steps()[:-1], Keep()], runs, scans=1)
    level = {
        name: data.products[f"signal/{name}" if name else "signal"].mean() for name in ("", *runs)
    }
    assert level[""] == pytest.approx(level["air"], rel=1e-3)
    assert level["air"] > 10 > 0.1 > level["sky"]


class Plain(Operator):
    """Adds up the components, whatever their names; a mean that stands beside one is in it."""

    optional: ClassVar[frozenset[str]] = frozenset({"sky", "atmosphere", "white", "pink"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    linear: ClassVar[bool] = True

    def exec(self, block: Block, state: object) -> None:
        names = block.entering("at the detector") + [
            n for n in block.entering("above the atmosphere") if n != "transmission"
        ]
        block.new("signal")[...] = sum(block.detdata[name] for name in names)


def test_a_step_that_forms_signals_and_does_not_know_of_means_is_told_the_components():
    operators = [*steps()[:3], Plain(), zonda.BinMap(pixel="8 arcsec")]
    _, data = observed(operators, {"air": {"only": ["atmosphere"]}}, scans=1, precision="float64")
    level = {name: np.nanmean(data.products[f"{name}map"].signal) for name in ("", "air/")}
    assert level[""] == pytest.approx(level["air/"], rel=1e-3)
    assert level["air/"] > 10


def test_instantaneous_calibration_divides_the_signals_that_have_the_transmission():
    """(1 + x) is in the sky and divided out: `full` is then what `own` modes are without x, to
    rounding.
    """
    operators = steps()
    operators[3] = zonda.Efficiency(calibration="instantaneous")
    runs = {"full": {**SKY, "filters": "none"}, "own": {"only": ["sky"], "filters": "none"}}
    _, data = observed(operators, runs)
    full, own = (data.products[f"{n}/map"].signal for n in runs)
    np.testing.assert_allclose(full, own, rtol=0, atol=4 * 2.0**-24 * 0.05)


# ---- masks


class Gaps(Operator):
    """Holes of 20 samples in every 500 of the noise."""

    requires: ClassVar[frozenset[str]] = frozenset({"white"})
    provides: ClassVar[frozenset[str]] = frozenset({"white"})

    def exec(self, block: Block, state: object) -> None:
        where = np.arange(block.samples.start, block.samples.stop) % 500 < 20
        block.detdata["white"][:, where] = np.nan


@pytest.mark.parametrize("filters", [(), (HIGHPASS,)], ids=["none", "high-pass"])
def test_what_is_not_finite_in_one_signal_is_in_none(filters):
    """All maps have the same hits, and the sky and the rest add up to the map (float64, as
    above).
    """
    operators = steps(*filters)
    operators.insert(2, Gaps())
    _, data = observed(operators, {**BOTH, "raw": {**SKY, "filters": "none"}}, precision="float64")
    whole, sky, rest, raw = (data.products[n] for n in ("map", "sky/map", "rest/map", "raw/map"))
    assert 0 < whole.hits.sum() < 2 * 19 * 6000
    assert same(whole, sky, "hits", "weights")
    assert same(whole, rest, "hits", "weights")
    assert same(whole, raw, "hits", "weights")
    assert np.nanmax(abs(sky.signal + rest.signal - whole.signal)) < 4 * 2.0**-36


def test_a_filter_bridges_the_same_gaps_in_all_signals():
    """The mask is shared before the filter: what is formed of a part is the remainder of the
    others, behind it too (float64).
    """
    operators = steps(HIGHPASS)
    operators.insert(2, Gaps())
    _, both = observed(operators, BOTH, precision="float64", keep=("signal", "signal/sky"))
    _, formed = observed(operators, {"rest": REST}, precision="float64")
    whole, sky = (both.observations[0].detdata[name] for name in ("signal", "signal/sky"))
    assert np.isnan(sky).any()
    assert np.array_equal(np.isnan(whole), np.isnan(sky))
    assert (
        np.nanmax(abs(both.products["rest/map"].signal - formed.products["rest/map"].signal))
        < 4 * 2.0**-36
    )


class Holes(Operator):
    """Puts NaN where the signal looks like glitches, in each signal elsewhere: it is not linear."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True

    def exec(self, block: Block, state: object) -> None:
        signal = block.detdata["signal"]
        signal[signal > 0.01] = np.nan


def test_a_step_that_is_not_linear_acts_on_each_signal_and_they_share_its_mask():
    pipeline, data = observed(steps(HIGHPASS, Holes()), BOTH)
    assert pipeline.signals.remainders == {}
    said = {(who, what): text for who, what, text in data.log}
    assert (
        said["sky", "modes"]
        == "its own from Holes on, which is not linear, instead of those of the complete signal"
    )
    whole, sky, rest = (data.products[n] for n in ("map", "sky/map", "rest/map"))
    assert 0 < whole.hits.sum() < 0.99 * 2 * 19 * 6000
    assert same(whole, sky, "hits")
    assert same(whole, rest, "hits")


def test_modes_of_the_complete_signal_are_taken_up_to_the_first_step_that_is_not_linear():
    """`Unsaid` changes nothing, so that before it the map keeps its bits; behind it the modes are
    those of the sky.
    """
    highpass, common = FILTERS["modes"]
    _, full = observed(steps(highpass, common), {"sky": SKY})
    _, before = observed(steps(highpass, common, Unsaid()), {"sky": SKY})
    _, behind = observed(steps(highpass, Unsaid(), common), {"sky": SKY})
    assert same(full.products["sky/map"], before.products["sky/map"], "signal")
    assert np.nanstd(behind.products["sky/map"].signal) < 0.9 * np.nanstd(
        full.products["sky/map"].signal
    )


def test_unfiltered_signals_share_the_mask_of_the_filters_in_maps_with_noise_of_their_own():
    """Hits are those of all signals: what a filter spoils in others is not added up in the
    unfiltered one either.
    """
    runs = {"raw": {"only": ["sky"], "filters": "none"}}
    _, net = observed(steps(HIGHPASS, Holes()), runs)
    _, scatter = observed(steps(HIGHPASS, Holes(), noise="scatter"), runs)
    assert net.products["map"].hits.sum() < 0.99 * 2 * 19 * 6000
    assert same(net.products["raw/map"], scatter.products["raw/map"], "signal", "hits")


# ---- measuring, on streams that are given


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


class Other(Given):
    """Another component."""

    provides: ClassVar[frozenset[str]] = frozenset({"pink"})


class Noise(Given):
    """The noise, of detectors that it makes unequal; it flags some samples."""

    provides: ClassVar[frozenset[str]] = frozenset({"white"})

    def configure(self, observation: Observation) -> None:
        observation.focalplane.net = observation.focalplane.net * np.linspace(
            1, 3, observation.n_detectors
        )

    def prepare(self, observation: Observation) -> None:
        observation.flags[700:720] |= 64


class Sum(Operator):
    """Adds up what there is."""

    optional: ClassVar[frozenset[str]] = frozenset({"sky", "white", "pink"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    linear: ClassVar[bool] = True

    def exec(self, block: Block, state: object) -> None:
        block.new("signal")[...] = sum(
            block.detdata[n] for n in ("sky", "white", "pink") if n in block.detdata
        )


class Median(Operator):
    """Subtracts the median over all samples: that of the complete data, where it is told so."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    couples: ClassVar = "all"
    linear: ClassVar[bool] = True  # given the median: see the test

    def measure(self, stream, model=None):
        if model is not None:
            return model
        return float(np.median(stream.array)) if stream.signal == "signal" else 0.0

    def exec(self, block: Block, state: float) -> None:
        block.detdata["signal"] -= np.float64(state)


class Kept(Product):
    """Whole streams."""

    def __init__(self, streams):
        self.streams = streams

    def __iadd__(self, other):
        return self

    def arrays(self):
        return self.streams

    @classmethod
    def of(cls, arrays):
        return cls(dict(arrays))


class Keep(MapMaker):
    """Keeps every signal."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"kept"})

    def prepare(self, observation: Observation) -> dict[str, np.ndarray]:
        return {
            name: np.zeros((observation.n_detectors, observation.n_samples))
            for name in observation.signals
        }

    def exec(self, block: Block, state: dict[str, np.ndarray]) -> None:
        for name in block.signals:
            state[name][block.detectors, block.samples] = block.detdata[name]

    def collect(self, data, observation, state) -> None:
        data.add(self.label, Kept(state))

    def finalize(self, data) -> None:
        data.products |= data.take(self.label).streams


def streams(dead: bool = True) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(2)
    common = np.cumsum(rng.standard_normal((2, N)), axis=1) / 30
    noise = 0.3 * rng.standard_normal((N_DET, N)) + rng.uniform(0.5, 1.5, (N_DET, 2)) @ common
    noise[4] = np.nan if dead else 0.0
    return np.sin(np.arange(N) / 70 + np.arange(N_DET)[:, None] / 3), noise


def chain(*filters: Operator, dead: bool = True) -> list[Operator]:
    sky, noise = Sky(), Noise()
    sky._values, noise._values = streams(dead)
    return [sky, noise, Sum(), *filters, zonda.BinMap(pixel="10 arcsec")]


def run(steps: list[Operator], runs: object = BOTH, **settings: object) -> Data:
    points = scenes.Points()
    points._observation = scenes.scan(N_DET, N)
    return Pipeline([points, *steps], runs=runs, precision="float64").run(
        scenes.scene(), **{"threads": 1, **settings}
    )


MEASURED = [
    (zonda.CommonModeFilter(modes=2, on_undetermined="remove"),),
    (zonda.CommonModeFilter(method="mean"),),
    (zonda.HighpassFilter(frequency="0.5 Hz", trim="1 s"), zonda.CommonModeFilter(residual=1e-3)),
    (zonda.CommonModeFilter(), HIGHPASS, zonda.CommonModeFilter(on_undetermined="skip")),
]


@pytest.mark.parametrize("filters", MEASURED, ids=["two modes", "mean", "after a filter", "twice"])
def test_signals_of_all_components_add_up_to_the_complete_one(filters):
    """Dead detectors, flags, unequal weights included. Each of three maps rounds w d to 2^-36 K,
    1/w at most 9 2^(1/2).
    """
    data = run(chain(*filters), {"sky": SKY, "noise": {"only": ["white"], "modes": "full"}})
    whole, sky, rest = (data.products[n] for n in ("map", "sky/map", "noise/map"))
    assert same(whole, sky, "hits", "weights")
    assert same(whole, rest, "hits", "weights")
    assert data.observations[0].n_samples * N_DET > whole.hits.sum() > 0
    np.testing.assert_allclose(
        sky.signal + rest.signal, whole.signal, atol=3 * 2**-37 * 9 * 2**0.5, rtol=0
    )
    alone = run(chain(*filters), {"sky": {"only": ["sky"]}}).products["sky/map"].signal
    if filters[-1].method == "svd":
        assert np.nanmax(abs(alone - sky.signal)) > 1e-3  # the sky's own modes are others


def test_given_its_modes_the_filter_is_a_symmetric_projection():
    """F = 1 - U U^T over the detectors in use: <b, F a> = <F b, a> (the dot test), and nothing of
    what it removes is left.

    float64: sums of n = 33 000 terms of order 1, rounded at each step, err by n^(1/2) 2^-53 n^(1/2)
    = 4e-12 at most.
    """
    a, b = np.random.default_rng(8).standard_normal((2, N_DET, N))
    given = [Sky(), Other(), Noise()]
    for step, values in zip(given, (a, b, streams()[1]), strict=True):
        step._values = values
    runs = {"a": {"only": ["sky"], "modes": "full"}, "b": {"only": ["pink"], "modes": "full"}}
    data = run(
        [*given, Sum(), zonda.CommonModeFilter(modes=2, on_undetermined="remove"), Keep()], runs
    )
    use = np.ix_(data.observations[0].detector_flags == 0, data.observations[0].flags == 0)
    a, b, fa, fb = a[use], b[use], data.products["signal/a"][use], data.products["signal/b"][use]
    left, right = np.vdot(b, fa), np.vdot(fb, a)
    assert abs(left - right) < 1e-11 < 1 < abs(left)
    u, size, _ = np.linalg.svd(a - fa, full_matrices=False)
    assert size[1] > 1 > 1e-12 > size[2]
    assert abs(u[:, :2].T @ fa).max() < 1e-13
    assert abs(u[:, :2].T @ fb).max() < 1e-13


def test_a_third_party_step_is_told_what_it_found_in_the_complete_data():
    data = run([*chain(Median(), dead=False)[:-1], Keep()])
    sky, noise = streams(dead=False)
    median = np.median(sky + noise)
    assert abs(median) > 1e-3
    np.testing.assert_array_equal(data.products["signal/sky"], sky - median)
    own = run([*chain(Median(), dead=False)[:-1], Keep()], {"sky": {"only": ["sky"]}})
    np.testing.assert_array_equal(own.products["signal/sky"], sky)


class Centred(Operator):
    """Subtracts the mean of a component over all samples."""

    requires: ClassVar[frozenset[str]] = frozenset({"white"})
    provides: ClassVar[frozenset[str]] = frozenset({"white"})
    couples: ClassVar = "all"

    def measure(self, stream, model=None):
        assert model is None
        return float(stream.array.mean())

    def exec(self, block: Block, state: float) -> None:
        block.detdata["white"] -= state


class Peak(Operator):
    """Reads the signal twice: its peak, and how many samples come near it."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"near"})
    couples: ClassVar = "all"
    _measured: list[str] = PrivateAttr(default_factory=list)
    _near: int = PrivateAttr(0)

    def measure(self, stream, model=None):
        self._measured.append(stream.signal)
        return float(stream.array.max())

    def exec(self, block: Block, state: float) -> None:
        self._near += int((block.detdata["signal"] > 0.9 * state).sum())

    def finalize(self, data: Data) -> None:
        data.products["near"] = self._near, self._measured


def test_exec_is_given_what_was_found_in_a_component_or_in_the_complete_signal():
    sky, noise = streams(dead=False)
    given = chain(dead=False)
    data = run([*given[:2], Centred(), given[2], Peak(), Keep()])
    whole = sky + (noise - noise.mean())
    np.testing.assert_allclose(data.products["signal"], whole, rtol=0, atol=1e-12)
    assert data.products["near"] == (
        int((data.products["signal"] > 0.9 * data.products["signal"].max()).sum()),
        ["signal"],
    )


def test_the_complete_signal_decides_which_detectors_are_dead():
    """Detector 4 has no noise and no sky: dead. In the sky alone detector 5, which sees nothing, is
    a valid zero.
    """
    operators = chain(zonda.CommonModeFilter(), dead=False)
    operators[0]._values = operators[0]._values.copy()
    operators[0]._values[[4, 5]] = 0.0
    data = run(operators, {"own": {"only": ["sky"]}})
    assert np.flatnonzero(data.observations[0].detector_flags).tolist() == [4]
    assert same(data.products["map"], data.products["own/map"], "hits")
    alone = run(operators, {}, memory=None)
    assert same(alone.products["map"], data.products["map"], "signal")


def test_a_sky_of_two_components_is_the_sky_alone():
    """Detector 5, which sees nothing of either, is a valid zero as it is in one."""

    class Background(Given):
        """Another part of the sky."""

        provides: ClassVar[frozenset[str]] = frozenset(
            {Component("background", "above the atmosphere")}
        )

    class Both(Operator):
        """Adds up the two."""

        requires: ClassVar[frozenset[str]] = frozenset({"sky", "background"})
        provides: ClassVar[frozenset[str]] = frozenset({"signal"})

        def exec(self, block: Block, state: object) -> None:
            block.new("signal")[...] = block.detdata["sky"] + block.detdata["background"]

    sky, background = Sky(), Background()
    sky._values = background._values = streams()[0].copy()
    sky._values[5] = 0.0
    data = run(
        [sky, background, Both(), zonda.CommonModeFilter(), zonda.BinMap(pixel="10 arcsec")], {}
    )
    assert not data.observations[0].detector_flags.any()


class Boxcar(Operator):
    """The mean of the sample and its neighbours: a finite filter."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    linear: ClassVar[bool] = True

    def halo(self, observation: Observation) -> int:
        return 2

    def exec(self, block: Block, state: object) -> None:
        padded = np.pad(block.detdata["signal"], ((0, 0), (2, 2)), mode="edge")
        block.detdata["signal"][...] = sum(padded[:, k : k + block.shape[1]] for k in range(5)) / 5


@pytest.mark.parametrize("memory", [None, 3_000_000])
def test_a_finite_filter_sees_each_signal_with_its_neighbours(memory):
    sky, _ = streams(dead=False)
    padded = np.pad(sky, ((0, 0), (2, 2)), mode="edge")
    expected = sum(padded[:, k : k + N] for k in range(5)) / 5
    data = run(
        [*chain(Boxcar(), dead=False)[:-1], Keep()],
        {"sky": SKY},
        **({"memory": memory} if memory else {}),
    )
    np.testing.assert_allclose(data.products["signal/sky"], expected, rtol=0, atol=1e-14)
    assert abs(data.products["signal"] - data.products["signal/sky"]).max() > 0.1


# ---- unfiltered signals, and what is pruned


@pytest.mark.parametrize("filters", FILTERS.values(), ids=FILTERS)
def test_an_unfiltered_signal_is_mapped_as_it_was_formed(filters):
    """With the final flags; the bits of the map without filters, where these flag nothing."""
    _, data = observed(steps(*filters), {"raw": {"only": ["sky"], "filters": "none"}})
    _, plain = observed(steps(), {"raw": {"only": ["sky"]}})
    assert same(data.products["map"], data.products["raw/map"], "hits")
    if not any("trim" in f.model_fields_set for f in filters):
        assert same(plain.products["raw/map"], data.products["raw/map"], "signal", "hits")


def test_an_unfiltered_signal_is_made_of_its_own_components_alone(monkeypatch):
    """Behind a filter that measures, where memory has no room for its stream, the sky is sampled
    again; the noise is not.
    """
    made: list[tuple[str, bool]] = []
    for cls in (zonda.SkyMap, zonda.WhiteNoise):
        original = cls.exec

        def counted(self: Operator, block: Block, state: Any, original: Any = original) -> None:
            made.append((type(self).__name__, block.again))
            original(self, block, state)

        monkeypatch.setattr(cls, "exec", counted)
        monkeypatch.setattr(cls, "knows_means", True)
    runs = {"raw": {"only": ["sky"], "filters": "none"}}
    with monkeypatch.context() as short:
        short.setattr("zonda.core.run.schedule.AMPLE", np.inf)
        _, tight = observed(steps(*FILTERS["modes"]), runs)
    assert ("SkyMap", True) in made
    assert ("WhiteNoise", True) not in made
    made.clear()
    _, ample = observed(steps(*FILTERS["modes"]), runs, memory=1 << 30)
    assert ("SkyMap", True) not in made
    assert same(tight.products["raw/map"], ample.products["raw/map"], "signal", "hits")


@pytest.mark.parametrize("filters", FILTERS.values(), ids=FILTERS)
def test_narrowed_to_the_sky_the_complete_signal_has_the_bits_of_the_sky_in_the_full_run(filters):
    _, full = observed(steps(*filters), {"sky": {"only": ["sky"]}})
    _, narrow = observed(steps(*filters), {}, only=["sky"])
    assert same(
        full.products["sky/map"], narrow.products["map"], "signal", "hits", "weights", "noise"
    )


def test_narrowed_to_the_noise_its_level_is_that_of_the_scene():
    """Noise at the detector under the load of the atmosphere: `--only white` has the level of the
    whole scene.
    """
    operators = steps()
    operators[1] = zonda.WhiteNoise(model="background_limited")
    pipeline, full = observed(operators, {"white": {"only": ["white"], "modes": "full"}})
    _, narrow = observed(operators, {"sky": SKY}, only=["white"])
    assert same(full.products["white/map"], narrow.products["map"], "signal", "noise")
    assert "sky/map" not in narrow.products
    assert pipeline.signals.all["white"].components == {"white", "transmission"}


class Template(Operator):
    """A stream that is no component."""

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset({"template"})

    def exec(self, block: Block, state: object) -> None:
        block.new("template")[...] = np.sin(
            np.arange(block.samples.start, block.samples.stop) / 300
        )


class Responds(Operator):
    """A gain that follows the template."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal", "template"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    linear: ClassVar[bool] = True

    def exec(self, block: Block, state: object) -> None:
        block.detdata["signal"] *= 1 + 0.01 * block.detdata["template"]


def test_a_signal_that_is_made_again_alone_has_what_its_filters_read(monkeypatch):
    """Streams that do not fit in memory are swept, one signal after the other, through filters that
    read other streams.
    """
    operators = [Template(), *steps(Responds(), *FILTERS["mean"])]
    _, ample = observed(operators, BOTH, scans=1, threads=1)
    monkeypatch.setattr("zonda.core.run.schedule.Schedule._keeps", lambda *arguments: False)
    _, tight = observed(operators, BOTH, scans=1, threads=1)
    assert any("made again" in what for _, what, _ in tight.log)
    for name in ("map", "sky/map", "rest/map"):
        assert same(ample.products[name], tight.products[name], "signal", "hits")


class Smear(Operator):
    """The mean of a sample of the sky and its neighbours."""

    requires: ClassVar[frozenset[str]] = frozenset({"sky"})
    provides: ClassVar[frozenset[str]] = frozenset({"sky"})

    def halo(self, observation: Observation) -> int:
        return 2

    def exec(self, block: Block, state: object) -> None:
        padded = np.pad(block.detdata["sky"], ((0, 0), (2, 2)), mode="edge")
        block.detdata["sky"][...] = sum(padded[:, k : k + block.shape[1]] for k in range(5)) / 5


def test_an_unfiltered_signal_whose_components_need_neighbours_is_held(monkeypatch):
    runs = {"raw": {"only": ["sky"], "filters": "none"}}
    operators = [Smear(), *steps(*FILTERS["modes"])]
    _, ample = observed(operators, runs, memory=1 << 30)
    monkeypatch.setattr("zonda.core.run.schedule.AMPLE", np.inf)
    monkeypatch.setattr("zonda.core.run.segments.PIECE", 2048)
    _, tight = observed(operators, runs)
    assert same(tight.products["raw/map"], ample.products["raw/map"], "signal", "hits")


# ---- components with names of their own


@pytest.mark.parametrize("enters", ["above the atmosphere", "at the detector", "calibrated"])
def test_what_adds_to_the_data_is_a_component(enters):
    """Ground pickup of 10 mK: divided by zeta e^-tau at the detector, as it is when it is
    calibrated; in signals that keep it.
    """

    class Ground(Operator):
        provides: ClassVar[frozenset[str]] = frozenset({Component("ground", enters)})

        def exec(self, block: Block, state: object) -> None:
            block.new("ground")[...] = 0.01

    operators = steps()
    operators[3] = zonda.Efficiency()
    runs = {"ground": {"only": ["ground"]}, "rest": {"without": ["ground"]}}
    pipeline, data = observed([Ground(), *operators], runs, precision="float64")
    assert "ground" in pipeline.signals.components
    _, before = observed(operators, {}, precision="float64")
    level = np.nanmean(data.products["ground/map"].signal)
    plane, t = data.observations[0].focalplane, data.observations[0].smooth["transmission"]
    passed = plane.main_beam_efficiency[:, None] * t.evaluate(slice(0, 19), slice(0, 6000))
    expected = {
        "above the atmosphere": 0.01,
        "at the detector": float((0.01 / passed).mean()),
        "calibrated": 0.01,
    }
    assert level == pytest.approx(expected[enters], rel=2e-3)
    assert same(data.products["rest/map"], before.products["map"], "signal")
    whole, rest = data.products["map"].signal, data.products["rest/map"].signal
    assert np.nanmean(whole - rest) == pytest.approx(expected[enters], rel=0.05)


# ---- what outputs ask for, and names


def test_outputs_ask_for_signals():
    """One that is there is taken; in a scene of the sky alone, the sky is the complete signal."""

    class Reads(Output):
        """Reads two signals."""

        def signals(self) -> tuple[Signal, ...]:
            return Signal(only=["sky"], modes="full"), Signal(only=["sky"], filters="none")

        def finalize(self, data: Any) -> None:
            """Writes nothing."""

    sky = Sky()
    points, sky._values = scenes.Points(), streams()[0]
    pipeline = Pipeline([points, sky, zonda.CommonModeFilter(), Reads()])
    assert pipeline.operators[-1].shown == ("", "_sky_unfiltered")
    more = Pipeline(
        [points, sky, Noise(), Sum(), zonda.CommonModeFilter(), Reads()], runs={"mine": SKY}
    )
    assert more.operators[-1].shown == ("mine", "_sky_unfiltered")
    assert list(more.runs) == ["mine", "_sky_unfiltered"]


def test_a_signal_cannot_take_a_name_of_the_steps_own():
    with pytest.raises(PipelineError, match="cannot name a signal"):
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
    assert file.runs["quiet"] == Signal(only=["white"], modes="full", filters="none")
    assert parse(file.resolved_yaml()).runs == file.runs
    with pytest.raises(ZondaError, match=r"(?s)modes.*own.*full"):
        parse(FILE.replace("modes: full", "modes: mine"))
    with pytest.raises(
        ZondaError, match=r"(?s)'_quiet' cannot name a signal.*use letters"
    ) as found:
        parse(FILE.replace("quiet:", "_quiet:"))
    assert "did you mean" not in str(found.value), "the component is not the mistake"


@pytest.mark.parametrize(
    ("runs", "settings", "message"),
    [
        ({1: SKY}, {}, "'1' cannot name a signal"),
        (
            BOTH,
            {"only": "sky"},
            r"only is a list of components, not the text 'sky'\n.*write only=\['sky'\]",
        ),
        (
            BOTH,
            {"keep": ["signal/rest"]},
            (
                r"(?s)'signal/rest' cannot be kept: it is the complete signal minus"
                r" sky.*signal/sky, and sub"
            ),
        ),
        (
            BOTH,
            {"keep": ["signal/skyy"]},
            r"(?s)there is no such signal.*did you mean 'signal/sky'",
        ),
    ],
    ids=["a number", "a text", "a remainder", "a typing mistake"],
)
def test_what_is_asked_for_and_cannot_be_is_refused(runs, settings, message):
    with pytest.raises(PipelineError, match=message):
        observed(steps(), runs, **settings)


def test_an_unfiltered_signal_can_be_kept(monkeypatch):
    monkeypatch.setattr("zonda.core.run.schedule.AMPLE", np.inf)
    _, data = observed(
        steps(*FILTERS["modes"]), {"raw": {"only": ["sky"], "filters": "none"}}, keep=["signal/raw"]
    )
    assert 0.04 < data.observations[0].detdata["signal/raw"].max() < 0.06


def test_without_the_sky_a_scene_of_the_sky_alone_is_empty():
    sky = Sky()
    sky._values = streams()[0]
    data = run([sky, zonda.BinMap(pixel="10 arcsec")], {"rest": REST, "sky": {"only": ["sky"]}})
    assert same(data.products["map"], data.products["rest/map"], "hits")
    assert same(data.products["map"], data.products["sky/map"], "signal")
    assert np.nanmax(abs(data.products["rest/map"].signal)) == 0.0
