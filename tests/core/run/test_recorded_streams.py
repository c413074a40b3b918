"""Steps that point the telescope and make streams; components that enter calibrated without a step
that calibrates.
"""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
import pytest

import zonda
from zonda.core.block import Block
from zonda.core.data import Data
from zonda.core.numerics.smooth import SmoothField
from zonda.core.operator import Operator
from zonda.plugins.checks.scenes import camera, scan, scene


class PointsAndGives(Operator):
    """Points, and makes the signal."""

    provides: ClassVar[frozenset[str]] = frozenset({"boresight", "signal"})

    def observe(self, data: Data) -> None:
        data.observations.append(scan(7, 3000))

    def exec(self, block: Block, state: Any) -> None:
        number = np.arange(block.samples.start, block.samples.stop)
        block.new("signal")[...] = (
            np.arange(block.detectors.start, block.detectors.stop)[:, None] + number % 5
        )


class PointsAndAdds(PointsAndGives):
    """Points, and makes a component that enters calibrated, with a mean beside it."""

    provides: ClassVar[frozenset[str]] = frozenset(
        {"boresight", zonda.Component("real", "calibrated")}
    )
    knows_means: ClassVar[bool] = True

    def prepare(self, observation: Any) -> SmoothField:
        return SmoothField.constant(np.full(observation.n_detectors, 30.0), observation.n_samples)

    def exec(self, block: Block, state: SmoothField) -> None:
        block.new("real")[...] = np.arange(block.detectors.start, block.detectors.stop)[:, None]
        block.means["real"] = state


class PointsAndNotes(PointsAndGives):
    """Points, and looks at the blocks without making anything."""

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})
    seen: ClassVar[list[int]] = []

    def exec(self, block: Block, state: Any) -> None:
        self.seen.append(block.shape[0] * block.shape[1])


def run(*steps: Operator, **more: Any) -> Data:
    return zonda.Pipeline(list(steps)).run(scene(camera(7)), threads=1, **more)


def test_a_step_that_points_and_makes_the_signal_acts_on_blocks() -> None:
    data = run(PointsAndGives(), zonda.BinMap(pixel="20 arcsec"), keep=["signal"])
    expected = np.arange(7)[:, None] + np.arange(3000) % 5
    np.testing.assert_array_equal(data.tod("signal"), expected)
    assert data["map"].hits.sum() == 7 * 3000


def test_what_enters_calibrated_is_the_signal_with_its_mean() -> None:
    data = run(PointsAndAdds(), zonda.BinMap(pixel="20 arcsec"), keep=["signal"])
    np.testing.assert_array_equal(
        data.tod("signal"), np.broadcast_to(30.0 + np.arange(7)[:, None], (7, 3000))
    )


def test_the_means_of_what_is_calibrated_add_up() -> None:
    steps = (PointsAndAdds(), zonda.AtmosphereLayers(pwv="5 mm", layers=2), zonda.Efficiency())
    both = run(*steps, keep=["signal"])
    atmosphere = zonda.Pipeline(list(steps), runs={"air": {"only": ["atmosphere"]}}).run(
        scene(camera(7)), threads=1, keep=["signal", "signal/air"]
    )
    np.testing.assert_array_equal(both.tod("signal"), atmosphere.tod("signal"))
    rest = atmosphere.tod("signal") - atmosphere.tod("signal/air")
    assert atmosphere.tod("signal/air").mean() > 5
    # float32 streams below 10 K: each sum is rounded to 2^-24 of them
    np.testing.assert_allclose(
        rest, np.broadcast_to(30.0 + np.arange(7)[:, None], rest.shape), rtol=0, atol=2e-6
    )


def test_a_pointing_step_with_an_exec_sees_every_sample() -> None:
    PointsAndNotes.seen.clear()
    run(PointsAndNotes(), zonda.WhiteNoise(), zonda.Efficiency(), zonda.BinMap(pixel="20 arcsec"))
    assert sum(PointsAndNotes.seen) == 7 * 3000


@pytest.mark.parametrize("samples", [1, 511, 512, 4097])
def test_a_finer_field_is_the_same(samples: int) -> None:
    rng = np.random.default_rng(1)
    field = SmoothField(
        rng.normal(size=(3, 2)), rng.normal(size=(2, -(-samples // 512) + 3)), 512, samples
    )
    whole = slice(0, 3), slice(0, samples)
    other = SmoothField.constant(np.arange(3.0), samples, 64)
    # a cubic is carried over exactly; what remains is rounding of values of order 10
    np.testing.assert_allclose(
        field.refined(64).evaluate(*whole), field.evaluate(*whole), rtol=0, atol=1e-13
    )
    np.testing.assert_allclose(
        field.plus(other).evaluate(*whole),
        field.evaluate(*whole) + other.evaluate(*whole),
        atol=1e-13,
    )
