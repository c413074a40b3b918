"""Order is checked before anything runs; companion runs leave out what they should."""

from typing import ClassVar

import numpy as np
import pytest
from pydantic import PrivateAttr

import zonda
from zonda.core.assembly.order import check_order, makers
from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.mapmaker import MapMaker
from zonda.core.numerics.random import normals
from zonda.core.numerics.smooth import SmoothField
from zonda.core.operator import Operator
from zonda.core.output import Output
from zonda.core.pipeline import Pipeline
from zonda.core.registry import operators
from zonda.core.signal import Signal, product_name


class Point(Operator):
    """Stares."""

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})
    scans: int = 2

    def observe(self, data):
        q = np.tile([0.0, 0, 0, 1], (3000, 1))
        for k in range(self.scans):
            scene = data.scene
            data.observations.append(
                Observation(
                    f"scan-{k}",
                    k,
                    scene.site,
                    scene.instrument,
                    scene.instrument.focalplane(),
                    scene.time,
                    np.arange(3000.0),
                    1.0,
                    q,
                    q,
                    (0, 0),
                    scene.seed,
                )
            )


class Component(Operator):
    """Draws noise."""

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})

    def exec(self, block, state):
        (name,) = self.provides
        for d in range(block.detectors.start, block.detectors.stop):
            key = block.observation.key(self.label, d)
            block.new(name)[d - block.detectors.start] += normals(
                key, block.samples.start, block.samples.stop
            )


class Sky(Component):
    """The sky."""

    provides: ClassVar[frozenset[str]] = frozenset({"sky"})


class White(Component):
    """The noise."""

    provides: ClassVar[frozenset[str]] = frozenset({"white"})


class Sum(Operator):
    """Adds up."""

    optional: ClassVar[frozenset[str]] = frozenset({"sky", "white"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})

    def exec(self, block, state):
        for name in ("sky", "white"):
            if name in block.detdata:
                block.new("signal")[...] += block.detdata[name]


class Filter(Operator):
    """Changes the signal, which others make."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})

    def exec(self, block, state):
        block.detdata["signal"] *= 1


class Total(MapMaker):
    """Keeps all signals."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"total"})

    def prepare(self, observation):
        shape = observation.n_detectors, observation.n_samples
        return {name: np.zeros(shape, np.float32) for name in observation.signals}

    def exec(self, block, state):
        for name in block.signals:
            state[name][block.detectors, block.samples] = block.detdata[name]

    def collect(self, data, observation, state):
        for name, whole in state.items():
            data.products.setdefault(product_name(name, "total"), []).append(whole)


class Late(Output):
    """Looks at everything at the end."""

    requires: ClassVar[frozenset[str]] = frozenset({"total"})

    _heard: list = PrivateAttr(default_factory=list)

    def watch(self, data, done):
        self._heard.append((done, len(data.products.get("total", []))))

    def finalize(self, data):
        data.products["seen"], data.products["heard"] = sorted(data.products), self._heard


@pytest.fixture(scope="module")
def scene():
    return zonda.Scene(
        site="green_bank", instrument="hexagonal_array", time="2024-11-25T07:00", seed=3
    )


RUNS = {"noiseless": {"only": ["sky"]}, "source_free": {"without": ["sky"]}}


def test_signals_are_made_of_the_same_random_numbers(scene):
    data = Pipeline([Point(), Sky(), White(), Sum(), Total(), Late()], runs=RUNS).run(
        scene, threads=1
    )
    assert data.products["seen"] == ["noiseless/total", "source_free/total", "total"]
    for k in range(2):
        whole, sky, noise = (
            data.products[n][k] for n in ("total", "noiseless/total", "source_free/total")
        )
        assert np.array_equal(whole, sky + noise)
        assert 0.9 < sky.std() < 1.1


def test_outputs_hear_of_what_is_done(scene):
    data = Pipeline(
        [Point(), Sky(), White(), Sum(), Total(), Late()], runs={"again": {"only": ["sky"]}}
    ).run(scene, threads=1)
    assert data.products["heard"] == [("pointing", 0), ("scan", 1), ("scan", 2), ("maps", 2)]


class Flag(Operator):
    """Flags a sample; says how often it was prepared before."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    _prepared: int = PrivateAttr(0)

    def prepare(self, observation):
        observation.log.state(self.label, "prepared before", f"{self._prepared} times")
        observation.smooth["transmission"] = SmoothField.constant(
            np.full(1, self._prepared), observation.n_samples
        )
        self._prepared += 1

    def exec(self, block, state):
        block.observation.flags[0] = 1
        block.observation.log.count(self.label, "signals seen", 1)


def test_a_scan_is_prepared_and_told_of_once(scene):
    """Whatever the signals: only what a step tells of the complete one stays."""
    runs = {"noiseless": {"only": ["sky"]}}
    data = Pipeline([Point(), Sky(), White(), Sum(), Flag(), Total()], runs=runs).run(
        scene, threads=1, memory=1 << 30
    )
    alone = Pipeline([Point(), Sky(), White(), Sum(), Flag(), Total()]).run(
        scene, threads=1, memory=1 << 30
    )
    for number, observation in enumerate(data.observations):
        assert observation.flags[0] == 1
        assert observation.smooth["transmission"].weights[0, 0] == number
        assert ("Flag", "prepared before", f"{number} times") in list(observation.log)
    assert data.log.get("Flag", "signals seen") == alone.log.get("Flag", "signals seen") > 0


class Uses(Operator):
    """Evaluates a smooth field."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    kept: ClassVar[list[int]] = []

    def exec(self, block, state):
        found = block.observation.smooth["transmission"]
        found.evaluate(block.detectors, block.samples)
        self.kept.append(len(found._kept))


def test_observations_do_not_end_with_every_detectors_lines(scene):
    """They are quicker than made for every block, but up to 2 MB for each field of each scan."""
    steps = [Point(), Sky(), White(), Sum(), Flag(), Uses(), Total()]
    data = Pipeline(steps, runs={"noiseless": {"only": ["sky"]}}).run(scene, threads=1)
    assert set(Uses.kept) == {1}
    assert [len(o.smooth["transmission"]._kept) for o in data.observations] == [0] * len(
        data.observations
    )


def test_same_seed_same_bits_two_seeds_incoherent(scene):
    def total(seed, **settings):
        out = Pipeline([Point(scans=1), White(), Sum(), Total()]).run(
            scene.model_copy(update={"seed": seed}), **settings
        )
        return out.products["total"][0]

    one = total(1, threads=1)
    assert np.array_equal(one, total(1, threads=2, memory=4_000_000))
    other = total(2, threads=1)
    # correlation of independent normals: 0 +- 1 / sqrt(n)
    assert abs(np.mean(one.astype(float) * other)) < 5 / np.sqrt(one.size)


def test_namesakes_draw_different_numbers(scene):
    pipeline = Pipeline([Point(scans=1), White(), White(), Sum(), Total()])
    assert [o.label for o in pipeline.operators] == ["Point", "White", "White.2", "Sum", "Total"]
    out = pipeline.run(scene, threads=1).products["total"][0]
    assert abs(out.var() - 2) < 5 * 2 * np.sqrt(2 / out.size)  # 4 if both were the same


def test_streams_are_kept_when_asked(scene):
    data = Pipeline([Point(scans=1), Sky(), Sum()]).run(scene, keep=["signal"])
    assert data.observations[0].detdata["signal"].shape == (61, 3000)
    assert "sky" not in data.observations[0].detdata
    assert "signal" in repr(data.observations[0].detdata.keys())
    assert "<table>" in data._repr_html_()
    assert "scan-0" in data.observations[0]._repr_html_()


class Glitches(Component):
    """A component with a name of its own."""

    provides: ClassVar[frozenset[str]] = frozenset({zonda.Component("glitches", "at the detector")})


def test_a_component_enters_at_a_place_that_there_is():
    with pytest.raises(
        ValueError,
        match=r"component 'glitches' cannot enter 'at detector': choose from .*'at the detector'",
    ):
        zonda.Component("glitches", "at detector")


@pytest.mark.parametrize(
    ("steps", "words"),
    [
        ([Sky()], "Sky needs boresight, which no step provides"),
        ([White(), Point()], "White needs boresight, which Point provides only later"),
        ([Point(), Total()], "Total needs signal, which no step provides"),
        ([Point(), White(), Filter(), Filter()], "Filter needs signal, which no step provides"),
        ([Point(), Sum(), Sky()], "Sky provides sky only after Sum has used it"),
        (
            [Point(), Sky(), Sum(), Glitches()],
            "Glitches provides glitches only after Sum has used it",
        ),
        ([Sum()], "no step points the telescope"),
    ],
)
def test_misordered_steps(steps, words):
    with pytest.raises(PipelineError) as err:
        Pipeline(steps, name="mine")
    assert words in str(err.value)
    assert "mine" in str(err.value)
    assert any(words == p.message for p in check_order(steps))


class Varies(Component):
    """What it provides hangs on a parameter."""

    dust: bool = False

    @property
    def provides(self):
        return frozenset({"sky", "dust"} if self.dust else {"sky"})


def test_the_cure_names_the_operators_that_would_do():
    operators.register(Varies, name="Varies")
    assert "PointingDaisy" in makers("boresight")
    assert "Efficiency" in makers("signal")
    assert "HighpassFilter" not in makers("signal")  # it needs one itself
    assert makers("nothing of the kind") == []
    problem = next(p for p in check_order([Point(), Total()]) if "needs signal" in p.message)
    assert "Efficiency" in problem.cure


def test_all_mistakes_of_order_at_once():
    with pytest.raises(PipelineError) as err:
        Pipeline([Total(), Sum(), Sky()])
    assert str(err.value).count("step ") >= 3


def test_unknown_component_of_a_run():
    with pytest.raises(
        PipelineError, match=r"(?s)signal quiet names 'noise'.*choose from: sky, white"
    ):
        Pipeline([Point(), Sky(), White(), Sum()], runs={"quiet": {"without": ["noise"]}})


def test_no_observation(scene):
    with pytest.raises(PipelineError, match="made no observation"):
        Pipeline([Point(scans=0), Sky(), Sum()]).run(scene)


def test_the_signals_of_a_pipeline_make_another():
    """Those that its outputs ask for among them: they ask again."""
    steps = [Point(), Sky(), White(), Sum(), Total(), Asks()]
    pipeline = Pipeline(steps, runs={"noiseless": {"only": ["sky"]}})
    assert len(pipeline.runs) == 2
    again = Pipeline(pipeline.operators, runs=pipeline.runs)
    assert again.runs == pipeline.runs
    assert [o.shown for o in again.operators if isinstance(o, Asks)] == [
        o.shown for o in pipeline.operators if isinstance(o, Asks)
    ]


class Asks(Output):
    """Asks for a signal."""

    requires: ClassVar[frozenset[str]] = frozenset({"total"})

    def signals(self):
        return (Signal(without=["sky"]),)

    def finalize(self, data):
        assert data.products["total"]
