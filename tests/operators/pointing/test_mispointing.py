"""Pointing errors: the sky is seen elsewhere than recorded; their rms and correlation."""

from __future__ import annotations

import numpy as np
import pytest

import zonda
from zonda.core.data import Data
from zonda.core.numerics.projection import boresights
from zonda.core.numerics.quaternions import multiply
from zonda.operators.pointing.mispointing import Mispointing, beside
from zonda.plugins.checks import scenes

ARCSEC = np.radians(1 / 3600)


def test_rms_and_correlation(bench_scan):
    """Variances over scans of offset, scan and jitter, and the jitter's correlation exp(-t /
    tau).
    """
    step = Mispointing(scan_rms="3 arcsec", jitter_rms="2 arcsec", jitter_time="0.5 s")
    n = 1500
    errors = np.array([step.errors(bench_scan(k, 200)) for k in range(n)]) / ARCSEC  # (n, 2, 200)
    for at in (0, 100):
        x = errors[:, :, at]
        assert (np.abs(x.var(axis=0) - 13) < 4 * 13 * np.sqrt(2 / n)).all()
        assert abs((x[:, 0] * x[:, 1]).mean()) < 4 * 13 / np.sqrt(n)
    lag = 40  # 0.4 s at 100 Hz
    expected = 9 + 4 * np.exp(-0.8)
    found = (errors[:, :, 50] * errors[:, :, 50 + lag]).mean(axis=0)
    assert (np.abs(found - expected) < 4 * np.sqrt((13**2 + expected**2) / n)).all()


@pytest.fixture
def bench_scan():
    def make(index, samples):
        observation = scenes.scan(3, samples)
        observation.index = index
        return observation

    return make


def test_it_turns_towards_azimuth_and_elevation():
    """A detector at (xi, eta) looks where the boresight with the error (atan xi, atan eta) does,
    small angles.
    """
    from zonda.core.numerics.projection import directions

    observation = scenes.scan(1, 50)
    n = observation.n_samples
    turned = beside(observation.boresight_radec, np.full(n, 30 * ARCSEC), np.full(n, -20 * ARCSEC))
    there = directions(
        observation.boresight_radec, np.array([30 * ARCSEC]), np.array([-20 * ARCSEC])
    ).reshape(n, 3)
    np.testing.assert_allclose(boresights(turned).T, there, atol=1e-10)
    np.testing.assert_allclose(np.linalg.norm(turned, axis=1), 1, rtol=1e-12)


@pytest.mark.parametrize("rotation", [0.0, 0.7, np.pi / 2, -2.5])
def test_the_error_is_along_azimuth_and_elevation_however_the_focal_plane_is_turned(rotation):
    """A turn of the focal plane about the boresight leaves the true boresight where it is: it turns
    no direction on the sky.
    """
    plain, turned = scenes.scan(1, 20), scenes.scan(1, 20)
    about = np.array([[0.0, 0.0, np.sin(rotation / 2), np.cos(rotation / 2)]])
    turned.boresight_azel, turned.boresight_radec = (
        multiply(q, about) for q in (plain.boresight_azel, plain.boresight_radec)
    )
    for observation in (plain, turned):
        data = Data(scenes.scene(scenes.camera(1)))
        data.observations.append(observation)
        Mispointing(offset=("10 arcsec", "4 arcsec"), jitter_rms="3 arcsec").observe(data)
    np.testing.assert_allclose(
        boresights(turned.pointed_radec), boresights(plain.pointed_radec), atol=1e-14
    )
    np.testing.assert_allclose(
        multiply(plain.pointed_radec, about), turned.pointed_radec, atol=1e-14
    )


def test_a_source_is_mapped_beside_its_place(tmp_path):
    """The telescope looks 6 arcsec beside and 8 above where it says that it looks: the source is
    mapped by that much to the other side; maps and files keep the recorded pointing. With psi = 0
    the frame's eta is north, and xi west.
    """
    path = tmp_path / "c.csv"
    path.write_text("ra [deg],dec [deg],flux [Jy]\n75,20,1\n")
    side = (
        (np.arange(-40, 40) + 0.5) * 1.5 * ARCSEC
    )  # detectors so dense that the map holds all of the beam
    xi, eta = (g.ravel() for g in np.meshgrid(side, side))
    for steps, expected in (
        ([], (0, 0)),
        ([Mispointing(offset=("6 arcsec", "8 arcsec"))], (6, -8)),
    ):
        observation = scenes.scan(
            6400, 20, radius=0.0, offsets=(xi, eta), instrument=scenes.camera(6400)
        )
        recorded = observation.boresight_radec.copy()
        chain = [
            *steps,
            zonda.PointSources(catalogue=path),
            zonda.BinMap(pixel="3 arcsec", width="2 arcmin"),
        ]
        data = scenes.run(chain, observation)
        map = data.products["map"]
        np.testing.assert_array_equal(data.observations[0].boresight_radec, recorded)
        y, x = np.indices(map.signal.shape)
        ra, dec = map.wcs.wcs_pix2world(x, y, 0)
        weight = np.nan_to_num(map.signal) / np.nansum(map.signal)
        centre = 3600 * np.array(
            [((ra - 75) * np.cos(np.radians(20)) * weight).sum(), ((dec - 20) * weight).sum()]
        )
        np.testing.assert_allclose(centre, expected, atol=0.02)


def test_the_jitter_dims_a_source(tmp_path):
    """A detector that stares at it sees on average sigma^2 / (sigma^2 + rms^2) of its peak, sigma
    that of the beam.

    A sample has the variance sigma^2 / (sigma^2 + 2 rms^2) less that share squared; with a
    correlation rho of the jitter from sample to sample at most, N samples count as N (1 - rho) / (1
    + rho).
    """
    path = tmp_path / "c.csv"
    path.write_text("ra [deg],dec [deg],flux [Jy]\n75,20,1\n")
    n, rms, sigma, seen = 20000, 3.0, 8.5 / np.sqrt(8 * np.log(2)), []
    for jitter in ("0 arcsec", f"{rms} arcsec"):
        steps = [
            Mispointing(jitter_rms=jitter, jitter_time="20 ms"),
            zonda.PointSources(catalogue=path),
        ]
        data = scenes.run(steps, scenes.scan(1, n, radius=0.0), keep=("sky",))
        seen.append(data.observations[0].detdata["sky"][0])
    share = sigma**2 / (sigma**2 + rms**2)
    variance = sigma**2 / (sigma**2 + 2 * rms**2) - share**2
    rho = np.exp(-0.5)  # 10 ms between samples
    error = np.sqrt(variance / (n * (1 - rho) / (1 + rho)))
    assert abs(seen[1].mean() / seen[0].mean() - share) < 4 * error


def test_polarization_is_seen_at_the_true_pointing():
    """The same bits as of a telescope that looks there and says so; by the recorded angles they
    would differ in places.
    """
    x, y = np.meshgrid(np.arange(64.0), np.arange(64.0))
    sky = zonda.SkyMap(
        map=np.stack([1e-3 * (1 + x / 64), 4e-4 * np.cos(y / 9), 3e-4 * np.sin(x / 7)]),
        unit="K_RJ",
        pixel_size="6 arcsec",
        centre="5h00m00s 20d00m00s",
        polarization_convention="cosmo",
    )
    camera = scenes.camera(6).model_copy(update={"polarization": "pairs"})
    streams = []
    for told in (False, True):
        observation = scenes.scan(6, 400, radius=1.0, instrument=camera)
        observation.focalplane.polarization_efficiency[:] = 1.0
        observation.focalplane.polarization_angle[:] = np.arange(6) * 0.5
        x, y = 60 * ARCSEC * np.cos(np.arange(400) / 50), 40 * ARCSEC * np.sin(np.arange(400) / 70)
        moved = beside(observation.boresight_radec, x, y)
        if told:
            observation.boresight_radec = moved
        else:
            observation.pointed_radec = moved
        streams.append(scenes.run([sky], observation, keep=("sky",)).observations[0].detdata["sky"])
    assert np.ptp(streams[0]) > 1e-4
    np.testing.assert_array_equal(*streams)


def test_each_scan_has_an_error_of_its_own():
    scene = scenes.scene(scenes.camera(3))
    data = Data(scene)
    zonda.PointingDaisy(scan_duration="5 s", scans=2).observe(data)
    Mispointing(scan_rms="5 arcsec").observe(data)
    a, b = (
        np.linalg.norm(boresights(o.sky_boresight) - boresights(o.boresight_radec), axis=0) / ARCSEC
        for o in data.observations
    )
    assert np.ptp(a) < 1e-3
    assert abs(a[0] - b[0]) > 0.1
