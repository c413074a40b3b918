"""The scan and the streams over which `core.testing` runs operators."""

from __future__ import annotations

from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from .configuration.time import Instant
from .data import STREAMS, Block, Data, Observation
from .instrument import Band, Instrument, Telescope
from .numerics.chunks import TILE_SAMPLES
from .numerics.quaternions import from_angles
from .numerics.random import normals
from .numerics.smooth import SmoothField
from .operator import Operator
from .scene import Scene
from .site import Site

N_DETECTORS, N_SAMPLES, RATE = 37, 3 * TILE_SAMPLES + 321, 50.0


class Points(Operator):
    """Points at the made-up scan."""

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})

    def observe(self, data: Data) -> None:
        data.observations.append(made_up_scan())


class Given(Operator):
    """Provides every stream: a slow wave, common to all detectors, with noise of each detector's
    own.

    ``mean`` names one that has a mean of some 30 K, ``beside`` it or in it.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"boresight"})
    provides: ClassVar[frozenset[str]] = frozenset(STREAMS)
    knows_means: ClassVar[bool] = True
    mean: str = ""
    beside: bool = True

    def prepare(self, observation: Observation) -> SmoothField:
        """The mean: of each detector its own, falling slowly."""
        field = SmoothField.from_values(
            *slow(observation.n_samples), MEAN_STEP, observation.n_samples
        )
        if self.mean == "atmosphere" and self.beside:
            observation.smooth["atmosphere"] = field
        return field

    def exec(self, block: Block, state: Any) -> None:
        start, stop = block.samples.start, block.samples.stop
        wave = np.sin(np.arange(start, stop) / RATE / 3.0)
        for number, name in enumerate(STREAMS):
            stream = block.new(name)
            for d in range(block.detectors.start, block.detectors.stop):
                noise = normals(block.observation.key("given", name, d), start, stop)
                stream[d - block.detectors.start] = 1e-3 * (3 * wave * (number + 1) + noise)
        if self.mean == "signal" and self.beside:
            block.means["signal"] = state
        elif self.mean and not self.beside:
            block.detdata[self.mean] += state.evaluate(block.detectors, block.samples)


MEAN_STEP = 256
"""Samples between the coefficients of the made-up mean."""


def slow(n_samples: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Weights (detector, node) and node values of a mean: 30 K and more, falling by 0.3 K in a
    straight line.
    """
    weights = np.stack(
        [30 + 0.1 * np.arange(N_DETECTORS), np.linspace(0.5, 1, N_DETECTORS)], axis=1
    )
    n = -(-n_samples // MEAN_STEP) + 3
    return weights, np.stack([np.ones(n + 24), -0.3 * np.arange(n + 24) / n])


def made_up_scene() -> Scene:
    """A camera of 37 detectors on a hill."""
    camera = Instrument(
        name="conformance",
        telescope=Telescope(name="dish", diameter="10 m"),
        band=Band(name="band", low="140 GHz", high="160 GHz"),
        detectors=N_DETECTORS,
        field_of_view="10 arcmin",
        main_beam_efficiency=0.5,
        illumination_efficiency=0.9,
        net="1 mK s(1/2)",
        knee="0.2 Hz",
        pink_minimum_frequency="10 mHz",
        sample_rate=f"{RATE} Hz",
    )
    site = Site(
        name="somewhere",
        latitude="38.4 deg",
        longitude="-79.8 deg",
        altitude="800 m",
        climatology="green_bank",
    )
    return Scene(
        site=site,
        instrument=camera,
        time=Instant.parse("2024-11-25T07:00"),
        target="05h +20d",
        seed=11,
    )


def made_up_scan() -> Observation:
    """A scan in circles of 5 arcmin around RA 75 deg, Dec 20 deg, at 60 deg of elevation."""
    scene = made_up_scene()
    t = np.arange(N_SAMPLES) / RATE
    ra, dec = np.radians(75.0), np.radians(20.0)
    reach = np.radians(5 / 60)
    x, y = reach * np.cos(t / 3), reach * np.sin(t / 3)
    return Observation(
        "scan-000",
        0,
        scene.site,
        scene.instrument,
        scene.instrument.focalplane(),
        scene.time,
        t,
        RATE,
        from_angles(-1.0 - x / np.cos(1.05), 1.05 + y),
        from_angles(ra + x / np.cos(dec), dec + y),
        (ra, dec),
        scene.seed,
    )


def given_signal(observation: Observation, factor: float) -> NDArray[np.float32]:
    """A whole scan of the given signal, times a factor."""
    block = Block(observation, slice(0, N_DETECTORS), slice(0, N_SAMPLES))
    given = Given()
    given.exec(block, given.prepare(observation))
    return np.asarray(block.detdata["signal"] * np.float32(factor), np.float32)
