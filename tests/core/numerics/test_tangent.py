"""Plain tangent-plane images against astropy's `WCS`."""

from __future__ import annotations

import copy
import pickle
from typing import Any

import numpy as np
import pytest
from astropy.io.fits import Header
from astropy.wcs import WCS

from zonda.core.numerics.projection import pixel_matrix
from zonda.core.numerics.tangent import TangentWcs, plain
from zonda.core.storage.fits_image import Cards

IMAGES = [
    TangentWcs("icrs", (75.0, 20.0), (300.5, 300.5), (-1 / 3600, 1 / 3600)),
    TangentWcs("icrs", (0.001, -89.9), (1.0, 77.25), (2 / 3600, 3 / 3600)),
    TangentWcs("galactic", (359.9, -30.0), (-1e4, 20.0), (-1e-3, -2e-3)),
]


def header(image: TangentWcs = IMAGES[0], **changes: Any) -> Cards:
    made = image.to_header()
    for key, value in changes.items():
        if value is None:
            del made[key]
        else:
            made[key] = value
    return made


@pytest.mark.parametrize("image", IMAGES)
def test_it_is_what_astropy_makes_of_the_header(image: TangentWcs) -> None:
    theirs = WCS(image.to_header())
    x, y = np.meshgrid(np.linspace(-200.0, 700.0, 7), np.linspace(-100.0, 900.0, 5))
    ours = image.wcs_pix2world(x, y, 1)
    for mine, other in zip(ours, theirs.wcs_pix2world(x, y, 1), strict=True):
        assert (
            np.abs((mine - other + 180) % 360 - 180).max() < 1e-10
        )  # degrees; rounding of 360, beside a pole
    pairs = np.stack([x.ravel(), y.ravel()], axis=1)
    again = image.celestial.wcs_pix2world(
        pairs, 1
    )  # numpy may round numbers that do not lie together otherwise
    np.testing.assert_allclose(
        again, np.stack([v.ravel() for v in ours], axis=1), rtol=0, atol=1e-12
    )
    np.testing.assert_allclose(
        image.wcs_pix2world(1.0, 2.0, 0), image.wcs_pix2world(2.0, 3.0, 1), rtol=1e-14
    )
    scale = np.abs(pixel_matrix(theirs)).max()
    np.testing.assert_allclose(
        pixel_matrix(image), pixel_matrix(theirs), rtol=0, atol=1e-13 * scale
    )  # a card has 20 columns
    np.testing.assert_allclose(image.pixel_scale_matrix, theirs.pixel_scale_matrix, rtol=1e-13)


@pytest.mark.parametrize("image", IMAGES)
def test_its_header_is_astropys(image: TangentWcs) -> None:
    mine, other = image.to_header(), WCS(image.to_header()).to_header(relax=True)
    assert list(mine) == list(other)
    assert [*mine.comments.values()] == [*other.comments]
    for key, value in other.items():
        assert mine[key] == (pytest.approx(value, rel=1e-12) if isinstance(value, float) else value)
    assert plain(mine) == image
    read = plain(Header.fromstring(mine.tostring()))
    assert read is not None
    np.testing.assert_allclose(
        [read.crval, read.crpix, read.cdelt], [image.crval, image.crpix, image.cdelt], rtol=1e-13
    )


def test_other_names_are_astropys_and_it_can_be_copied() -> None:
    image = IMAGES[0]
    assert image.pixel_to_world_values(299.5, 299.5) == pytest.approx((75.0, 20.0))
    assert np.isnan(image.wcs.equinox)
    with pytest.raises(AttributeError):
        image.nothing_of_the_kind  # noqa: B018
    assert pickle.loads(pickle.dumps(image)) == copy.deepcopy(image) == image


@pytest.mark.parametrize(
    "changes",
    [
        {"CTYPE1": "RA---SIN", "CTYPE2": "DEC--SIN"},
        {"CTYPE1": "DEC--TAN", "CTYPE2": "RA---TAN"},
        {"CTYPE1": "RA---TAN-SIP"},
        {"PC1_2": 0.1},
        {"CD1_1": 1e-3},
        {"CROTA2": 10.0},
        {"PV2_1": 1.0},
        {"A_ORDER": 2},
        {"CPDIS1": "LOOKUP"},
        {"RADESYS": "FK5"},
        {"RADESYS": None, "EQUINOX": 1950.0},
        {"LONPOLE": 0.0},
        {"CUNIT1": "arcsec"},
        {"WCSAXES": 3},
        {"CRVAL2": 90.0},
        {"CRVAL1": "75"},
        {"CRPIX1": None},
        {"CDELT1": 0.0},
        {"CDELT2": True},
    ],
)
def test_what_is_more_is_left_to_astropy(changes: dict[str, Any]) -> None:
    assert plain(header(**changes)) is None


def test_defaults_of_fits() -> None:
    bare = header(RADESYS=None, LONPOLE=None, CUNIT1=None, CUNIT2=None, WCSAXES=None, LATPOLE=None)
    assert plain(bare) == IMAGES[0]
    assert plain(header(IMAGES[2], RADESYS="ICRS")) is None  # astropy takes it for ICRS


def test_real_headers_with_whole_numbers() -> None:
    assert plain(header(CRPIX1=300, CDELT1=1)) == TangentWcs(
        "icrs", (75.0, 20.0), (300.0, 300.5), (1.0, 1 / 3600)
    )
