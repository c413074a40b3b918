"""A small scan whose pointing is built by hand, without any other operator."""

from __future__ import annotations

import numpy as np
import pytest

from zonda.core.configuration.time import Instant
from zonda.core.data import Data, Observation
from zonda.core.instrument import Band, Instrument, Telescope
from zonda.core.scene import Scene
from zonda.core.site import Site
from zonda.core.smooth import SmoothField


def rotation(axis, angle):
    q = np.zeros((*np.shape(angle), 4))
    q[..., axis], q[..., 3] = np.sin(np.asarray(angle) / 2), np.cos(np.asarray(angle) / 2)
    return q


def product(p, q):
    (a, b, c, d), (e, f, g, h) = np.moveaxis(p, -1, 0), np.moveaxis(q, -1, 0)
    return np.stack(
        [
            d * e + a * h + b * g - c * f,
            d * f - a * g + b * h + c * e,
            d * g + a * f - b * e + c * h,
            d * h - a * e - b * f - c * g,
        ],
        -1,
    )


def quaternions(lon, lat, psi):
    return product(product(rotation(2, lon), rotation(1, np.pi / 2 - lat)), rotation(2, psi))


@pytest.fixture
def scene():
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
def make_observation(scene, tmp_path):
    def make(n_samples=5000, index=0):
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
def data(scene, tmp_path):
    found = Data(scene=scene, output=tmp_path / "out")
    found.provenance.update(
        name="demo <b>", description="a & b", seed=7, resolved_yaml="a: 1\nb: 'é'\n", versions={"zonda": "0.1.0"}
    )
    return found
