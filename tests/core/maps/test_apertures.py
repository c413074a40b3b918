"""Fluxes in apertures against those of a Gaussian, on every grid, and their errors against scatter."""

from __future__ import annotations

import math
from dataclasses import replace

import healpy
import numpy as np
import pytest
from astropy.wcs import WCS

from zonda.core.errors import InputError
from zonda.core.maps.apertures import Aperture, ApertureFlux, within
from zonda.core.maps.map_product import MapProduct
from zonda.plugins.checks.scenes import camera

ARCSEC = math.pi / 648000
FWHM = 20 * ARCSEC
BEAM = math.pi / (4 * math.log(2)) * FWHM**2
CENTRE = math.radians(75), math.radians(60)


def grid(kind, pixel):
    """A map of zeros in MJy/sr about CENTRE, 3 arcmin wide."""
    side = pixel * ARCSEC
    more = {"centre": CENTRE, "unit": "MJy/sr", "band": camera().band, "fwhm": 9 * ARCSEC}
    if kind == "HEALPix":
        nside = 2 ** round(math.log2(math.sqrt(math.pi / 3) / side))
        pixels = np.sort(
            healpy.query_disc(nside, healpy.ang2vec(75, 60, lonlat=True), 100 * ARCSEC)
        )
        more |= {"nside": nside, "pixels": pixels, "pixel": healpy.nside2resol(nside)}
        shape, header = pixels.shape, None
    else:
        ny, nx = round(180 / pixel), round(180 / pixel)
        wcs = WCS(naxis=2)
        wcs.wcs.cdelt = [-pixel / 3600, pixel / 3600]
        wcs.wcs.ctype, wcs.wcs.crval = ["RA---TAN", "DEC--TAN"], [75, 60]
        # the centre lies at no pixel's centre or corner
        wcs.wcs.crpix = [nx / 2 + 0.8, ny / 2 + 0.3]
        if kind == "CAR":
            nx = 2 * nx
            wcs.wcs.ctype, wcs.wcs.crval = ["RA---CAR", "DEC--CAR"], [75, 0]
            wcs.wcs.crpix = [nx / 2 + 0.8, ny / 2 + 0.3 - 60 * 3600 / pixel]
        shape, header = (ny, nx), wcs.to_header()
        more["pixel"] = side
    zeros = np.zeros(shape)
    return MapProduct(zeros, np.full(shape, 9), zeros + 1, zeros + 0.1, None, header, **more)


def gaussian(product):
    r = product.grid.distance(CENTRE)
    return product.with_planes(signal=np.exp(-4 * math.log(2) * (r / FWHM) ** 2))


def enclosed(radius):
    return 1e6 * BEAM * (1 - 2 ** (-4 * (radius * ARCSEC / FWHM) ** 2))


@pytest.mark.parametrize("kind", ["TAN", "CAR", "HEALPix"])
@pytest.mark.parametrize("radius", [9, 14, 21, 50])
def test_a_gaussian_has_its_flux_within_every_radius(kind, radius):
    found = gaussian(grid(kind, 4)).aperture_flux(f"{radius} arcsec")
    # pixels of a fifth of the FWHM, in which the brightness is taken as uniform: 2 % (module)
    assert found.flux == pytest.approx(enclosed(radius), rel=0.02)
    assert found.missing < 2e-3


@pytest.mark.parametrize("kind", ["TAN", "CAR", "HEALPix"])
@pytest.mark.parametrize("size", [0.3, 2, 3.3, 10])
def test_circles_have_their_area_whatever_pixels_their_edge_cuts(kind, size):
    product = grid(kind, 4)
    radius = size * product.pixel
    shares = within(product.grid, CENTRE, radius)
    area = 4 * math.pi * math.sin(radius / 2) ** 2
    # 0.3 pixels: about 70 of 256 points of one pixel are inside, +- the points on its edge
    tolerance = 0.15 if size < 1 else 2e-3
    assert (shares * product.grid.areas).sum() == pytest.approx(area, rel=tolerance)
    assert shares.min() == 0
    if size > 2:
        assert shares.max() == 1


def test_the_mean_of_an_annulus_is_taken_off():
    product = gaussian(grid("TAN", 4))
    raised = product.with_planes(signal=product.signal + 0.3)
    found = raised.aperture_flux("21 arcsec", annulus=("50 arcsec", "80 arcsec"))
    assert found.flux == pytest.approx(enclosed(21), rel=0.01)
    area = math.pi * (21 * ARCSEC) ** 2
    assert raised.aperture_flux("21 arcsec").flux == pytest.approx(
        enclosed(21) + 0.3e6 * area, rel=0.01
    )


def test_other_centres_units_and_stokes_parameters():
    product = gaussian(grid("TAN", 4)).to("K_RJ")
    assert product.aperture_flux("21 arcsec").flux == pytest.approx(enclosed(21), rel=0.01)
    away = product.aperture_flux("21 arcsec", centre="75 deg 60.01 deg")  # 36 arcsec north
    assert 0 < away.flux < 0.1 * enclosed(21)
    # of a steeper spectrum the same brightness in the band is another flux at its centre
    steep = product.aperture_flux("21 arcsec", spectral_index=4).flux
    peaks = [product.to("MJy/sr", spectral_index=index).signal.max() for index in (0, 4)]
    assert peaks[1] != pytest.approx(peaks[0], rel=1e-3)
    assert steep == pytest.approx(enclosed(21) * peaks[1] / peaks[0], rel=0.01)


@pytest.mark.parametrize(("kind", "smooth"), [("TAN", 0.0), ("TAN", 12.0), ("HEALPix", 0.0)])
def test_the_error_is_the_scatter_of_the_flux(kind, smooth):
    """Noise twice its white error, as independent pixels or correlated between them: the error by
    apertures on the noise map is the scatter over many realizations."""
    rng, product, fluxes, errors = np.random.default_rng(3), grid(kind, 4), [], []
    for _ in range(16):
        one, two = (
            product.with_planes(signal=rng.normal(0, 0.2, product.signal.shape)) for _ in range(2)
        )
        if smooth:
            one, two = (each.smoothed(smooth * ARCSEC) for each in (one, two))
        drawn = replace(product.with_planes(signal=one.signal), fwhm=product.fwhm)
        drawn = drawn.with_planes(half_difference=two.signal)
        found = drawn.aperture_flux("14 arcsec")
        assert "apertures on half the difference" in found.noise
        fluxes.append(found.flux)
        errors.append(found.error)
    # the rms of 16 fluxes is known to 1 / sqrt(32) = 18 %, the mean error to less: 2.5 sigma
    assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(np.std(fluxes), rel=0.45)
    white = 1e6 * 0.1 * product.pixel * math.sqrt(math.pi) * 14 * ARCSEC
    if not smooth:
        # some 20 apertures of 16 maps: 1 / sqrt(2 * 16 * 20) = 4 %, and the edge's shares
        assert np.sqrt(np.mean(np.square(errors))) == pytest.approx(2 * white, rel=0.12)
    assert product.aperture_flux("14 arcsec").error == pytest.approx(white, rel=0.06)


def test_without_values_there_is_no_flux():
    product = gaussian(grid("TAN", 4))
    with pytest.raises(InputError, match=r"% of the circle(.|\n)*smaller radius"):
        product.aperture_flux("3 arcmin")
    holes = product.hits.copy()
    holes[20, 22] = 0  # one of 80 pixels
    found = product.with_planes(hits=holes).aperture_flux("21 arcsec")
    assert found.missing == pytest.approx(1 / 86.6, rel=0.05)
    assert found.flux < product.aperture_flux("21 arcsec").flux
    with pytest.raises(InputError, match="band of the map is not known"):
        replace(product.to("K_RJ"), band=None).aperture_flux("21 arcsec")


@pytest.mark.parametrize(
    ("radius", "annulus"),
    [
        (0, None),
        (None, None),
        ("-1 arcmin", None),
        ("1 Jy", None),
        ("1 arcmin", "2 arcmin"),
        ("1 arcmin", 5.0),
        ("1 arcmin", ("3 arcmin", "2 arcmin")),
        ("1 arcmin", ("2 arcmin", "2 arcmin")),
        ("1 arcmin", ("30 arcsec", "50 arcsec")),
    ],
)
def test_what_is_no_circle_or_ring_is_refused(radius, annulus):
    with pytest.raises(InputError, match=r"map\.aperture_flux") as caught:
        grid("CAR", 4).aperture_flux(radius, annulus=annulus)
    assert "annulus=('2 arcmin', '3 arcmin')" in caught.value.cure
    with pytest.raises(InputError, match=r"map\.aperture_flux, centre(.|\n)*as a position"):
        grid("CAR", 4).aperture_flux("1 arcmin", centre="M31")


def test_weights_of_an_annulus_sum_to_nothing():
    product = grid("CAR", 4)
    known = np.ones(product.hits.shape, bool)
    weights, _ = Aperture(20 * ARCSEC, 30 * ARCSEC, 60 * ARCSEC).weights(
        product.grid, CENTRE, known
    )
    assert abs(weights.sum()) < 1e-12 * np.abs(weights).sum()


def test_a_flux_has_the_digits_of_its_error():
    texts = [
        str(ApertureFlux(flux, error, np.radians(10 / 3600), 0.0, "white"))
        for flux, error in ((0.0076992, 0.00074), (12.3456, 1.5), (0.01, np.nan))
    ]
    assert [text.partition(" Jy")[0] for text in texts] == [
        "0.00770 +- 0.00074",
        "12.3 +- 1.5",
        "0.01",
    ]
