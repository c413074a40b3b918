"""A workbench for operators that work on streams: made-up scans and streams, run through the real executor."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import PrivateAttr

from zonda.core.configuration.time import Instant
from zonda.core.data import Block, Data, Observation
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.core.scene import Scene
from zonda.core.site import Site

ARCSEC = np.radians(1 / 3600)
CENTRE = (np.radians(75.0), np.radians(20.0))


def quaternions(lon: Any, lat: Any, psi: Any) -> np.ndarray:
    """Rz(lon) Ry(pi/2 - lat) Rz(psi), (n, 4) in the order x y z w."""
    from scipy.spatial.transform import Rotation

    lon, lat, psi = np.broadcast_arrays(lon, lat, psi)
    return Rotation.from_euler("ZYZ", np.stack([lon, np.pi / 2 - lat, psi], axis=-1)).as_quat()


class Pointed(Operator):
    """Appends given observations."""

    provides = frozenset({"boresight"})
    _observations: list[Observation] = PrivateAttr(default_factory=list)

    def observe(self, data: Data) -> None:
        data.observations += self._observations


class GivenComponents(Operator):
    """Puts given arrays (n_det, n_samp) into the block, and given smooth fields into the observation."""

    requires = frozenset({"boresight"})
    provides = frozenset({"sky", "atmosphere", "transmission", "white", "pink"})
    _streams: dict[str, Any] = PrivateAttr(default_factory=dict)
    _smooth: dict[str, Any] = PrivateAttr(default_factory=dict)
    _means: dict[str, Any] = PrivateAttr(default_factory=dict)

    def prepare(self, observation: Observation) -> Any:
        observation.smooth.update(self._smooth)
        return {k: v(observation) if callable(v) else v for k, v in self._streams.items()}

    def exec(self, block: Block, state: Any) -> None:
        for name, array in state.items():
            block.new(name)[...] = array[block.detectors, block.samples]
        block.means.update(self._means)


class GivenSignal(GivenComponents):
    """The same for the signal."""

    provides = frozenset({"signal"})


def camera(n_det: int, field: str = "4.2 arcmin", net: str = "1.7 mK s(1/2)") -> Instrument:
    return Instrument(
        name="test_camera", telescope=Telescope(name="dish", diameter="100 m"), band=Band(name="b", low="78 GHz", high="108 GHz"),
        detectors=n_det, field_of_view=field, fwhm="8.5 arcsec", main_beam_efficiency=0.3, illumination_efficiency=0.8, net=net,
        sample_rate="100 Hz",
    )  # fmt: skip


class Workbench:
    """``observation(...)`` makes a scan; ``run(operators, observations, ...)`` a pipeline over given streams."""

    CENTRE, ARCSEC = CENTRE, ARCSEC
    quaternions = staticmethod(quaternions)
    camera = staticmethod(camera)

    @staticmethod
    def observation(
        n_det: int = 7, n_samples: int = 3000, rate: float = 100.0, index: int = 0, radius: float = 60 * ARCSEC,
        instrument: Instrument | None = None, centre: tuple[float, float] = CENTRE,
    ) -> Observation:  # fmt: skip
        instrument = instrument or camera(n_det)
        t = np.arange(n_samples) / rate
        x = radius * np.sin(2 * np.pi * t / 7.3 + index) * np.cos(2 * np.pi * t / 31.0)
        y = radius * np.sin(2 * np.pi * t / 7.3 + index) * np.sin(2 * np.pi * t / 31.0)
        lat = centre[1] + y
        radec = quaternions(centre[0] + x / np.cos(centre[1]), lat, 0.3 + 1e-4 * t)
        return Observation(
            name=f"scan{index}", index=index, site=Site(name="s", latitude="38 deg", longitude="-79 deg"), instrument=instrument,
            focalplane=instrument.focalplane(), start=Instant.parse("2024-11-25T07:00"), seconds=t, sample_rate=rate,
            boresight_azel=quaternions(-1.0 + 0 * t, 0.9, 0.0), boresight_radec=radec, centre=centre, seed=5,
        )  # fmt: skip

    @staticmethod
    def run(
        operators: list[Operator], observations: Observation | list[Observation], streams: dict[str, Any] | None = None, *,
        smooth: dict[str, Any] | None = None, means: dict[str, Any] | None = None, precision: Any = "float32", threads: int = 1,
        memory: int = 1 << 30, keep: tuple[str, ...] = ("signal",),
    ) -> SimpleNamespace:  # fmt: skip
        """``data``, ``observations`` and ``signal`` (n_det, n_samp), float64, of the first; ``count(who, what)``."""
        many = observations if isinstance(observations, list) else [observations]
        pointed = Pointed()
        pointed._observations = many
        given = GivenSignal() if "signal" in (streams or {}) else GivenComponents()
        given._streams, given._smooth, given._means = streams or {}, smooth or {}, means or {}
        pipeline = Pipeline([pointed, given, *operators], precision=precision)
        scene = Scene(site=many[0].site, instrument=many[0].instrument, time="2024-11-25T07:00", seed=5)
        data = pipeline.run(scene, threads=threads, memory=memory, keep=keep)
        text = {(who, what): value for who, what, value in data.tally}
        return SimpleNamespace(
            data=data, observations=data.observations, signal=data.observations[0].detdata.get("signal"), tally=text,
            map=data.products.get("map"),
        )  # fmt: skip


@pytest.fixture
def bench() -> Workbench:
    return Workbench()
