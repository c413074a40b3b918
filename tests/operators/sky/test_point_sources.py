"""Point sources: the flux in a map is that of the catalogue; catalogues that are wrong."""

from __future__ import annotations

import numpy as np
import pytest

import zonda
import zonda.testing
from zonda.core.errors import InputError
from zonda.core.instrument import SPEED_OF_LIGHT
from zonda.core.numerics.projection import rotation_matrices
from zonda.core.numerics.radiation import BOLTZMANN, to_kelvin_rj
from zonda.operators.sky.point_sources import Catalogue, PointSources
from zonda.plugins.checks import scenes

ARCSEC = np.radians(1 / 3600)


def catalogue(path, rows, heading="ra [deg],dec [deg],flux [mJy]"):
    path.write_text("\n".join([heading, *(",".join(map(str, row)) for row in rows)]) + "\n")
    return path


def test_it_keeps_the_contract(tmp_path):
    path = catalogue(tmp_path / "c.csv", [(75.0, 20.0, 500.0), (75.05, 20.02, 100.0)])
    zonda.testing.check_operator(PointSources(catalogue=path))


def test_columns_that_are_not_read_are_told(tmp_path):
    path = catalogue(
        tmp_path / "c.csv",
        [(75.0, 20.0, 1.0, 0.1, "B1950")],
        "ra [deg],dec [deg],flux [Jy],q [Jy],epoch",
    )
    assert PointSources(catalogue=path).check(None)[1:] == ["not used: q, epoch"]


@pytest.mark.parametrize("index", [0.0, -0.8])
def test_the_flux_in_a_map(tmp_path, index):
    """Sum over a map, T dOmega, against S <c^2 (nu / nu_0)^alpha / 2 k nu^2>: to 1e-3.

    Detectors on a square of 1.5 arcsec, so that every pixel of 3 arcsec holds four at the corners
    of a square: the sum is a quadrature of the Gaussian (FWHM 8.5 arcsec), exact but for exp(-2
    pi^2 (sigma / 1.5 arcsec)^2).
    """
    side = (np.arange(-40, 40) + 0.5) * 1.5 * ARCSEC
    xi, eta = (g.ravel() for g in np.meshgrid(side, side))
    observation = scenes.scan(
        6400, 20, radius=0.0, offsets=(xi, eta), instrument=scenes.camera(6400)
    )
    heading = "ra [deg],dec [deg],flux [Jy],spectral_index"
    path = catalogue(
        tmp_path / "c.csv", [(75.0014, 20.0011, 0.3, index), (75.4, 20.0, 5.0, index)], heading
    )
    found = scenes.run(
        [PointSources(catalogue=path), zonda.BinMap(pixel="3 arcsec", width="2 arcmin")],
        observation,
    ).products["map"]
    flux = np.nansum(found.signal) * (3 * ARCSEC) ** 2
    band = observation.instrument.band
    assert flux == pytest.approx(0.3 * to_kelvin_rj("Jy/beam", band, None, index, 1.0), rel=1e-3)


def test_the_stream_is_the_beam_itself(tmp_path, bench):
    """At every sample of every detector: T = S c^2 / (2 k nu^2 Omega) exp(-4 ln 2 theta^2 / w^2),
    narrow band.
    """
    observation = scenes.scan(
        7, 3000, radius=0.8, instrument=scenes.camera(7, low="89.9 GHz", high="90.1 GHz")
    )
    path = catalogue(
        tmp_path / "c.csv", [(75.01, 20.01, 200.0), (74.99, 20.02, -50.0), (180.0, 20.0, 1e6)]
    )
    found = (
        scenes.run([PointSources(catalogue=path)], observation, keep=("sky",))
        .observations[0]
        .detdata["sky"]
    )
    plane = observation.focalplane
    rays = np.stack([-plane.eta, -plane.xi, np.ones(7)]) / np.sqrt(1 + plane.xi**2 + plane.eta**2)
    looks = np.moveaxis(
        rotation_matrices(observation.boresight_radec) @ rays, 0, 2
    )  # (3, n_det, n)
    fwhm = float(observation.focalplane.fwhm[0])
    area = np.pi * fwhm**2 / (4 * np.log(2))
    expected = np.zeros((7, 3000))
    for ra, dec, flux in ((75.01, 20.01, 0.2), (74.99, 20.02, -0.05)):
        a, d = np.radians([ra, dec])
        source = np.array([np.cos(d) * np.cos(a), np.cos(d) * np.sin(a), np.sin(d)])
        theta = 2 * np.arcsin(np.linalg.norm(looks - source[:, None, None], axis=0) / 2)
        peak = flux * 1e-26 * SPEED_OF_LIGHT**2 / (2 * BOLTZMANN * 90e9**2) / area
        expected += peak * np.exp(-4 * np.log(2) * theta**2 / fwhm**2)
    assert np.abs(expected).max() > 1e-3
    np.testing.assert_allclose(found, expected, rtol=0, atol=2e-6 * np.abs(expected).max())


def test_a_beam_of_degrees_is_a_gaussian_of_the_angle(tmp_path):
    """Of 5 deg, a source 5 deg away: the chord in place of the angle would make it brighter by 1e-4
    of the peak.
    """
    streams = []
    for dec in (25.0, 20.0):
        observation = scenes.scan(1, 200, radius=0.0)
        observation.focalplane.fwhm[:] = np.radians(5)
        path = catalogue(tmp_path / "c.csv", [(75.0, dec, 1e9)])
        streams.append(
            scenes.run([PointSources(catalogue=path)], observation, keep=("sky",))
            .observations[0]
            .detdata["sky"]
        )
    np.testing.assert_allclose(
        streams[0] / streams[1], 1 / 16, rtol=2e-6
    )  # float32; the series of the angle ends at 2e-6


def test_fluxes_at_another_frequency(tmp_path):
    path = catalogue(
        tmp_path / "c.csv",
        [(75.0, 20.0, 100.0, 2.0)],
        "ra [deg],dec [deg],flux [mJy],spectral_index",
    )
    band = scenes.camera().band
    here, there = (
        Catalogue.read(PointSources(catalogue=path, frequency=f)).brightness(band, 1.0)
        for f in (None, "46.5 GHz")
    )
    assert there / here == pytest.approx((band.centre / 46.5e9) ** 2)


@pytest.mark.parametrize(
    ("heading", "row", "match"),
    [
        ("ra [deg],dec [deg]", (75, 20), "has no column 'flux'"),
        ("ra [deg],dec [deg],flux", (75, 20, 1), "flux has no unit"),
        ("ra [deg],dec [deg],flux [K]", (75, 20, 1), "flux has the unit 'K'"),
        ("ra [deg],dec [deg],flux [Jy]", (75, 95, 1), "line 2: dec is 95 deg"),
        ("ra [deg],dec [deg],flux [Jy]", (75, 20, "nan"), "not a finite number"),
    ],
)
def test_catalogues_that_are_wrong(tmp_path, heading, row, match):
    path = catalogue(tmp_path / "bad.csv", [row], heading)
    with pytest.raises(InputError, match=match) as caught:
        Catalogue.read(PointSources(catalogue=path))
    assert "bad.csv" in str(caught.value)
    scene = zonda.Scene(
        site="green_bank", instrument="mustang2", time="2024-11-25T07:00", target="05h +20d"
    )
    with pytest.raises(InputError, match=match):  # `zonda check` says so too
        PointSources(catalogue=path).check(zonda.Data(scene))


@pytest.mark.parametrize(
    "text",
    [
        "ra,dec,flux [Jy]\n05:00:00,+20:00:00,1\n",
        "RA (deg);DEC (deg);Flux (mJy)\n75;20;1000\n",
        "ra [h]\tdec [deg]\tflux [Jy]\n5\t20\t1\n",
        "ra [deg],dec [deg],flux [Jy],spectral_index,frequency [GHz]\n75,20,1,,\n",
        'RAJ2000\tDEJ2000\tS\n"h:m:s"\t"d:m:s"\tJy\n---\t---\t---\n05 00 00\t+20 00 00\t1\n',
        "RA_ICRS [deg],DE_ICRS [deg],s_nu [Jy]\n75,20,1\n",
        "GLON [deg],GLAT [deg],flux [Jy]\n181.656842606,-13.583273125,1\n",
    ],
)
def test_catalogues_as_people_have_them(tmp_path, text):
    """1 Jy at 75 deg +20 deg; Galactic coordinates as astropy has them, to 0.1 arcsec."""
    path = tmp_path / "c.txt"
    path.write_text(text)
    found = Catalogue.read(PointSources(catalogue=path))
    ra, dec = np.radians([75, 20])
    expected = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    np.testing.assert_allclose(found.directions[0], expected, atol=0.1 * ARCSEC)
    assert (found.flux[0], found.index[0]) == (pytest.approx(1.0), 0.0)
    assert np.isnan(found.frequency[0])
    assert found.unused == ()


@pytest.mark.parametrize("kind", ["ecsv", "fits"])
@pytest.mark.parametrize("frame", ["icrs", "galactic", "fk4"])
def test_positions_of_astropy(tmp_path, kind, frame):
    from astropy import units as u
    from astropy.coordinates import SkyCoord
    from astropy.table import QTable

    there = SkyCoord([75, 76] * u.deg, [20, -21] * u.deg).transform_to(frame)
    path = tmp_path / f"c.{kind}"
    QTable({"name": ["a", "b"], "where": there, "flux": [1.0, 2.0] * u.Jy}).write(path)
    step = PointSources(catalogue=path)
    if frame == "fk4":
        with pytest.raises(InputError, match="its positions are fk4"):
            Catalogue.read(step)
        return
    found = Catalogue.read(step).directions
    # our Galactic axes are astropy's to 1e-16; rotations lose some of that
    np.testing.assert_allclose(found, there.icrs.cartesian.xyz.value.T, atol=1e-13)
