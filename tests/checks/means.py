"""Steps that multiply a stream beside which stands a mean of tens of kelvin."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np

import zonda
from zonda.core.checks import Family, Measured
from zonda.core.data import Block
from zonda.core.operator import Operator
from zonda.plugins.checks.scenes import camera, scene

from .cases import MEAN

checks = Family("means")


class Gain(Operator):
    """Each detector's gain is off by up to 5 %; it knows nothing of means."""

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    linear: ClassVar[bool] = True

    def exec(self, block: Block, state: Any) -> None:
        """Multiply."""
        block.detdata["signal"] *= gain(block.detectors)[:, None].astype(
            block.detdata["signal"].dtype
        )


class GainOfFluctuation(Gain):
    """The same, which says that it knows of means and does not."""

    knows_means: ClassVar[bool] = True

    def exec(self, block: Block, state: Any) -> None:
        """Multiply what stands in the stream alone."""
        super().exec(block, state)


def gain(detectors: slice) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Of the detectors: 0.95 to 1.05."""
    return 1 + 0.05 * np.sin(np.arange(detectors.start, detectors.stop))


def _signal(*steps: Operator) -> np.ndarray[Any, np.dtype[np.float64]]:
    """The calibrated stream of 20 s, mean emission included."""
    pipeline = zonda.Pipeline(
        [
            zonda.PointingDaisy(radius="2 arcmin", speed="1 arcmin/s", scan_duration="20 s"),
            zonda.AtmosphereLayers(pwv="7 mm"),
            zonda.WhiteNoise(),
            zonda.Efficiency(),
            *steps,
        ]
    )
    return np.asarray(
        pipeline.run(scene(camera(19)), threads=1, keep=("signal",))
        .observations[0]
        .detdata["signal"]
    )


@checks.add(
    MEAN,
    reference="the whole stream, multiplied in float64",
    limit=2,
    unit="x 2^-24 of the largest fluctuation",
)
def gain_of_the_whole() -> Measured:
    """largest error of a stream of tens of kelvin that a step without knowledge of means has
    multiplied
    """
    plain, multiplied = _signal(), _signal(Gain())
    wanted = plain * gain(slice(0, len(plain)))[:, None]
    fluctuation = float(np.abs(wanted - plain).max()) + float(
        np.abs(plain - plain.mean(axis=1, keepdims=True)).max()
    )
    missed = float(np.abs(_signal(GainOfFluctuation()) - wanted).max())
    error = float(np.abs(multiplied - wanted).max())
    return error / (
        2.0**-24 * fluctuation
    ), f"{error:.1e} K of {np.abs(plain).max():.3g} K; without the mean {missed:.2g} K"
