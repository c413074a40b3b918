"""Homographies against astropy's own world-to-pixel transformation."""

from __future__ import annotations

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from astropy.wcs import WCS
from astropy.wcs.utils import wcs_to_celestial_frame
from scipy.spatial.transform import Rotation

from zonda.core.errors import InputError
from zonda.core.maps.header import exact_header
from zonda.core.numerics.projection import (
    directions,
    frame_rotation,
    pixel_matrix,
    ray_coefficients,
    rotation_matrices,
    share_outside,
    tangent_wcs,
)


def tan(
    ctype=("RA---TAN", "DEC--TAN"),
    crval=(75.0, 20.0),
    crpix=(17.3, -4.0),
    lonpole=180.0,
    cdelt=(-2 / 3600, 3 / 3600),
):
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cdelt = ctype, crval, crpix, cdelt
    wcs.wcs.pc = [[0.8, 0.6], [-0.6, 0.8]]
    wcs.wcs.lonpole = lonpole
    if ctype[0][0] != "G":
        wcs.wcs.radesys = "ICRS"
    return wcs


@pytest.mark.parametrize(
    "wcs",
    [
        tan(), tan(lonpole=30.0), tan(("GLON-TAN", "GLAT-TAN")),
        tan(("DEC--TAN", "RA---TAN"), (20.0, 75.0), cdelt=(3 / 3600, 2 / 3600)),
        tan(crval=(0.0, 89.9)), tan(crval=(359.999, -90.0)),
    ],
)  # fmt: skip
def test_pixels_equal_astropys(wcs):
    rng = np.random.default_rng(0)
    centre = SkyCoord(wcs.pixel_to_world(17.0, -5.0)).icrs
    # boresights within half a degree of the centre, any roll, then detectors within 0.1 deg of
    # those
    from scipy.spatial.transform import Rotation

    lon = centre.ra.rad + rng.normal(0, 4e-3, 50) / max(np.cos(centre.dec.rad), 1e-3)
    lat = np.clip(centre.dec.rad + rng.normal(0, 4e-3, 50), -np.pi / 2, np.pi / 2)
    quaternions = Rotation.from_euler(
        "ZYZ", np.stack([lon, np.pi / 2 - lat, rng.uniform(0, 6, 50)], axis=1)
    ).as_quat()
    xi, eta = rng.normal(0, 1e-3, (2, 3))
    x, y, z = np.moveaxis(directions(quaternions, xi, eta), 2, 0)
    sky = SkyCoord(x=x, y=y, z=z, representation_type="cartesian", frame="icrs")
    sky.representation_type = "unitspherical"
    expected = np.array(wcs.world_to_pixel(sky))
    h = ray_coefficients(quaternions, pixel_matrix(wcs)).T
    found = np.einsum("nij,dj->ind", h.reshape(-1, 3, 3), np.stack([xi, eta, np.ones(3)], axis=1))
    # 1e-13 of the distance in pixels (1e3) twice over, and astropy's own degrees
    assert np.abs((found[:2] / found[2]).swapaxes(1, 2) - expected).max() < 1e-8
    assert (found[2] > 0).all()


def test_behind_the_image_has_negative_w():
    quaternion = np.array([[0.0, np.sin(0.3), 0.0, np.cos(0.3)]])
    wcs = tan(crval=(180.0, -60.0))
    h = ray_coefficients(quaternion, pixel_matrix(wcs))[:, 0]
    assert h[8] < 0


def test_rotation_matrices_turn_the_boresight():
    q = np.array([[0.1, -0.4, 0.3, 0.8], [0, 0, 0, 2.0]])
    matrices = rotation_matrices(q)
    np.testing.assert_allclose(
        matrices @ matrices.transpose(0, 2, 1), np.tile(np.eye(3), (2, 1, 1)), atol=1e-15
    )
    np.testing.assert_allclose(matrices[1], np.eye(3), atol=1e-15)


def test_galactic_frame_rotation_equals_astropy():
    here = SkyCoord("05h00m00s +20d00m00s", frame="icrs")
    np.testing.assert_allclose(
        frame_rotation("galactic") @ here.cartesian.xyz.value,
        here.galactic.cartesian.xyz.value,
        atol=1e-14,
    )


@pytest.mark.parametrize(
    ("wcs", "message"),
    [
        (tan(("RA---SIN", "DEC--SIN")), "not a plain TAN"),
        (WCS(naxis=2), "celestial"),
        (WCS(naxis=3), "celestial"),
    ],
)
def test_other_images_are_refused(wcs, message):
    with pytest.raises(InputError, match=message):
        pixel_matrix(wcs)


def test_unknown_frame_is_refused():
    with pytest.raises(InputError, match="unknown celestial frame"):
        frame_rotation("supergalactical")


def test_share_of_the_samples_outside_an_image():
    """A boresight that crosses an image of half its track, seen by detectors in a row across it;
    behind it is outside.
    """
    wcs = WCS(naxis=2)
    wcs.wcs.ctype, wcs.wcs.crval, wcs.wcs.crpix, wcs.wcs.cdelt = (
        ["RA---TAN", "DEC--TAN"],
        [0.0, 0.0],
        [50.5, 50.5],
        [-0.01, 0.01],
    )
    matrix = pixel_matrix(wcs)  # 1 deg x 1 deg about (0, 0)
    n = 3000

    def along(longitude):
        return Rotation.from_euler(
            "ZY", np.stack([longitude, np.full(n, np.pi / 2)], axis=1)
        ).as_quat()

    inside = np.radians(np.linspace(-1.0, 1.0, n))  # half of 2 deg
    one = np.zeros(1)
    assert share_outside([(along(inside), one, one)], matrix, (100, 100)) == pytest.approx(
        0.5, abs=2 / 250
    )
    across = np.radians(
        np.linspace(-0.25, 0.75, 400)
    )  # a quarter of the detectors is beyond the edge
    many = [(along(0 * inside), 0 * across, across), (along(0 * inside + np.pi), one, one)]
    assert share_outside(many[:1], matrix, (100, 100)) == pytest.approx(0.25, abs=1 / 30)
    assert share_outside(many[1:], matrix, (100, 100)) == 1.0


@pytest.mark.parametrize(
    ("frame", "crval", "crpix", "cdelt"),
    [
        ("icrs", (75.0, 20.0), (300.5, 300.5), (-1 / 3600, 1 / 3600)),
        ("icrs", (0.001, -89.9), (1.0, 77.25), (2 / 3600, 3 / 3600)),
        ("galactic", (359.9, -30.0), (-1e4, 20.0), (-1e-3, -2e-3)),
    ],
)
def test_tangent_images_are_astropys(frame, crval, crpix, cdelt):
    wcs = tangent_wcs(frame, crval, crpix, cdelt)
    header = exact_header(wcs)
    assert (header["CRVAL1"], header["CRPIX2"], header["CDELT1"]) == (crval[0], crpix[1], cdelt[0])
    np.testing.assert_array_equal(pixel_matrix(WCS(header)), pixel_matrix(wcs))
    assert wcs_to_celestial_frame(wcs).name == frame
