"""A workbench for operators that work on streams: made-up scans and streams, run through the real
executor.
"""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from pydantic import PrivateAttr

from zonda.core.configuration.time import Instant
from zonda.core.data import Block, Data, Observation
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.numerics.smooth import SmoothField
from zonda.core.operator import Operator
from zonda.core.pipeline import Pipeline
from zonda.core.scene import Scene
from zonda.core.site import Site

from .parameters import write_inputs

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
    """Puts given arrays (n_det, n_samp) into the block, and given smooth fields into the
    observation.
    """

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
        name="test_camera",
        telescope=Telescope(name="dish", diameter="100 m"),
        band=Band(name="b", low="78 GHz", high="108 GHz"),
        detectors=n_det,
        field_of_view=field,
        fwhm="8.5 arcsec",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net=net,
        sample_rate="100 Hz",
    )


class Workbench:
    """``observation(...)`` makes a scan; ``run(operators, observations, ...)`` a pipeline over
    given streams.
    """

    CENTRE, ARCSEC = CENTRE, ARCSEC
    quaternions = staticmethod(quaternions)
    camera = staticmethod(camera)

    @staticmethod
    def observation(
        n_det: int = 7,
        n_samples: int = 3000,
        rate: float = 100.0,
        index: int = 0,
        radius: float = 60 * ARCSEC,
        instrument: Instrument | None = None,
        centre: tuple[float, float] = CENTRE,
    ) -> Observation:
        instrument = instrument or camera(n_det)
        t = np.arange(n_samples) / rate
        x = radius * np.sin(2 * np.pi * t / 7.3 + index) * np.cos(2 * np.pi * t / 31.0)
        y = radius * np.sin(2 * np.pi * t / 7.3 + index) * np.sin(2 * np.pi * t / 31.0)
        lat = centre[1] + y
        radec = quaternions(centre[0] + x / np.cos(centre[1]), lat, 0.3 + 1e-4 * t)
        return Observation(
            name=f"scan{index}",
            index=index,
            site=Site(name="s", latitude="38 deg", longitude="-79 deg"),
            instrument=instrument,
            focalplane=instrument.focalplane(),
            start=Instant.parse("2024-11-25T07:00"),
            seconds=t,
            sample_rate=rate,
            boresight_azel=quaternions(-1.0 + 0 * t, 0.9, 0.0),
            boresight_radec=radec,
            centre=centre,
            seed=5,
        )

    @staticmethod
    def run(
        operators: list[Operator],
        observations: Observation | list[Observation],
        streams: dict[str, Any] | None = None,
        *,
        smooth: dict[str, Any] | None = None,
        means: dict[str, Any] | None = None,
        precision: Any = "float32",
        threads: int = 1,
        memory: int = 1 << 30,
        keep: tuple[str, ...] = ("signal",),
    ) -> SimpleNamespace:
        """``data``, ``observations`` and ``signal`` (n_det, n_samp), float64, of the first;
        ``count(who, what)``.
        """
        many = observations if isinstance(observations, list) else [observations]
        pointed = Pointed()
        pointed._observations = many
        given = GivenSignal() if "signal" in (streams or {}) else GivenComponents()
        given._streams, given._smooth, given._means = streams or {}, smooth or {}, means or {}
        pipeline = Pipeline([pointed, given, *operators], precision=precision)
        scene = Scene(
            site=many[0].site, instrument=many[0].instrument, time="2024-11-25T07:00", seed=5
        )
        data = pipeline.run(scene, threads=threads, memory=memory, keep=keep)
        text = {(who, what): value for who, what, value in data.log}
        return SimpleNamespace(
            data=data,
            observations=data.observations,
            signal=data.observations[0].detdata.get("signal"),
            log=text,
            map=data.products.get("map"),
        )


@pytest.fixture
def bench() -> Workbench:
    return Workbench()


@pytest.fixture
def scene() -> Scene:
    """A small camera on a hill; `io` and `diagnostics` write and draw what it sees."""
    band = Band(name="b", low="80 GHz", high="100 GHz")
    telescope = Telescope(name="dish", diameter="100 m")
    instrument = Instrument(
        name="camera",
        telescope=telescope,
        band=band,
        detectors=19,
        field_of_view="4 arcmin",
        fwhm="9 arcsec",
        main_beam_efficiency=0.3,
        illumination_efficiency=0.8,
        net="1 mK s(1/2)",
        knee="1 Hz",
        sample_rate="50 Hz",
    )
    site = Site(name="hill", latitude="38.4 deg", longitude="-79.8 deg", altitude="818 m")
    return Scene(site=site, instrument=instrument, time="2024-11-25T07:00:00.123456789", seed=7)


@pytest.fixture
def make_observation(scene: Scene, tmp_path: Path) -> Any:
    """Makes scans whose pointing is built by hand."""

    def make(n_samples: int = 5000, index: int = 0) -> Observation:
        seconds = np.arange(n_samples) / 50.0
        offset = np.radians(0.05) * np.sin(seconds)
        az, el = np.radians(120.0) + offset, np.radians(60.0) + offset / 2
        ra, dec = np.radians(75.0) - offset, np.radians(20.0) + offset / 3
        observation = Observation(
            name=f"scan_{index}",
            index=index,
            site=scene.site,
            instrument=scene.instrument,
            focalplane=scene.instrument.focalplane(),
            start=Instant.parse("2024-11-25T07:00:00.123456789Z"),
            seconds=seconds,
            sample_rate=50.0,
            boresight_azel=quaternions(-az, el, 0 * az),
            boresight_radec=quaternions(ra, dec, 0.3 + offset),
            centre=(np.radians(75.0), np.radians(20.0)),
            seed=7,
            output=tmp_path / "out",
        )
        observation.focalplane.polarization_angle[:] = np.linspace(-1, 2, 19)
        observation.flags[17:30] = 1
        observation.smooth["transmission"] = SmoothField.constant(np.full(19, 0.9), n_samples)
        return observation

    return make


@pytest.fixture
def data(scene: Scene, tmp_path: Path) -> Data:
    found = Data(scene=scene, output=tmp_path / "out")
    found.provenance.update(
        name="demo <b>",
        description="a & b",
        seed=7,
        resolved_yaml="a: 1\nb: 'é'\n",
        versions={"zonda": "0.1.0"},
    )
    return found


@pytest.fixture(scope="session")
def maps(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Input files of the tests of parameters."""
    folder = tmp_path_factory.mktemp("maps")
    write_inputs(folder)
    return folder


@pytest.fixture(scope="module")
def known() -> dict[str, Any]:
    """Runs before the change of a parameter, made once each."""
    return {}
