"""White noise and single pixels in map products of every kind: what is stated is what is there."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zonda.core.instrument import Band
from zonda.core.maps.map_plots import plot_map
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.smoothing import smoothed
from zonda.core.numerics.sphere import ARCMIN, FWHM_PER_SIGMA
from zonda.operators.diagnostics.report import expected
from zonda.operators.maps.grid import PlateCarreeGrid, tangent_wcs
from zonda.operators.maps.plate_carree import box_about, centre_of
from zonda.plugins.metrics.common import relative_error_of_rms

FWHM = 5 * ARCMIN


def product(
    kind: str, dec: float, seed: int | None = 0, side: float = 1.5, pixel: float = ARCMIN
) -> MapProduct:
    """A map of ``side`` deg that is equally deep everywhere: 1 K in an equatorial pixel, as hits go
    with the solid angle.
    """
    if kind == "CAR":
        width = math.radians(side)
        box = box_about((1.0, math.radians(dec)), width, width, pixel)
        grid = PlateCarreeGrid.of_box(box, pixel, "icrs")
        header, shape, centre = grid.wcs.to_header(), grid.shape, centre_of(box, pixel)
    else:
        n, centre = round(math.radians(side) / pixel), (1.0, math.radians(dec))
        shape = (n, n)
        header = tangent_wcs(centre, pixel, shape).to_header()
    ones = np.ones(shape)
    found = MapProduct(
        ones, np.ones(shape, np.int64), ones, ones, None, header, centre, pixel, fwhm=FWHM
    )
    share = np.broadcast_to(found.areas(), shape) / pixel**2
    found.weights, found.noise, found.hits = (
        share * 1.0,
        share**-0.5,
        np.rint(1e4 * share).astype(np.int64),
    )
    found.signal = np.random.default_rng(seed).standard_normal(shape) * found.noise
    return found


@pytest.mark.parametrize(
    ("kind", "dec"), [("TAN", 60.0), ("CAR", 0.0), ("CAR", 60.0), ("CAR", 75.0), ("CAR", 85.0)]
)
def test_white_noise_is_what_the_map_and_the_report_state(kind, dec):
    """Smoothed: 1 K arcmin / sqrt(4 pi) sigma wherever the map is. The report's was 1 / sqrt(cos
    dec) of that in CAR maps.
    """
    one = product(kind, dec)
    sigma = FWHM / FWHM_PER_SIGMA
    wanted = ARCMIN / math.sqrt(4 * math.pi) / sigma
    radius = math.radians(0.5)
    near = one.distance() <= radius
    smooth = one.smoothed(FWHM)
    assert smooth.noise[near] == pytest.approx(wanted, rel=0.01 if dec < 80 else 0.02)
    # some A / 4 pi sigma^2 = 55 independent values in the circle: their rms is known to (2 x
    # 55)^-1/2 = 9 %, of ten maps to 3 %
    rms = math.sqrt(
        np.mean([product(kind, dec, seed).smoothed(FWHM).rms(radius) ** 2 for seed in range(10)])
    )
    assert rms == pytest.approx(wanted, rel=0.09)  # three of these errors
    assert one.smoothed_rms(FWHM, radius) == pytest.approx(smooth.rms(radius), rel=1e-4)
    ((what, beam, _),) = expected("map", one, 2 * radius)
    value, unit = beam.partition(" (")[0].partition(",")[0].split("\u00a0")
    assert float(value) * {"mK_RJ": 1e-3, "K_RJ": 1}[unit] == pytest.approx(wanted, rel=0.01)
    assert "white noise by NET and samples" in what


@pytest.mark.parametrize(("kind", "dec"), [("TAN", 60.0), ("CAR", 60.0)])
def test_the_error_of_an_rms_is_its_scatter(kind, dec):
    """Over 60 maps, whose scatter is known to 9 %; three times that."""
    radius = math.radians(0.5)
    maps = [product(kind, dec, seed).smoothed(FWHM) for seed in range(60)]
    found = np.array([one.rms(radius) for one in maps])
    error = relative_error_of_rms(maps[0], maps[0].distance() <= radius)
    assert found.std() / found.mean() == pytest.approx(error, rel=0.27)


@pytest.mark.parametrize(
    ("kind", "dec"), [("TAN", 60.0), ("CAR", 30.0), ("CAR", 60.0), ("CAR", 80.0)]
)
def test_a_single_pixel_keeps_its_flux(kind, dec):
    """In Jy/pixel 1, in K/sr 1 / area; smoothed the Gaussian of that flux, to 0.5 %."""
    one = product(kind, dec)
    at = np.unravel_index(int(one.distance().argmin()), one.signal.shape)
    areas = np.broadcast_to(one.areas(), one.signal.shape)
    one.signal = np.zeros(one.signal.shape)
    one.signal[at] = 1 / areas[at]
    found = one.smoothed(FWHM)
    sigma = FWHM / FWHM_PER_SIGMA
    assert found.signal[at] * 2 * math.pi * sigma**2 == pytest.approx(1.0, rel=0.005)
    assert (found.signal * areas).sum() == pytest.approx(1.0, rel=0.005)


def test_units_per_pixel_there_and_back():
    """At 60 deg a pixel of 1 arcmin is half as wide: its Jy/pixel are half of those on the
    equator.
    """
    one = product("CAR", 60.0)
    one.band = Band(name="b", low="80 GHz", high="100 GHz")
    one.signal = np.ones(one.signal.shape)
    there = one.to("Jy/pixel")
    np.testing.assert_allclose(
        there.signal, 1e6 * one.to("MJy/sr").signal * one.areas(), rtol=1e-12
    )
    middle = there.signal[there.signal.shape[0] // 2, 0]
    assert middle == pytest.approx(1e6 * one.to("MJy/sr").signal[0, 0] * ARCMIN**2 / 2, rel=1e-3)
    np.testing.assert_allclose(there.to("K_RJ").signal, 1.0, rtol=1e-12)


def test_a_wide_tangent_plane_is_smoothed_by_its_own_pixels():
    """20 deg from the tangent point a pixel is cos^3 of its size there: the kernel is wider in
    pixels, and noise as it is.
    """
    one = product("TAN", 0.0, side=45.0, pixel=12 * ARCMIN)
    one.signal = np.zeros(one.signal.shape)
    one.noise[:] = 1.0
    at = (225 // 2, 225 // 2 + 96)
    areas = one.areas()
    one.signal[at] = 1.0
    fwhm = 60 * ARCMIN
    found = one.smoothed(fwhm)
    sigma = fwhm / FWHM_PER_SIGMA
    assert found.signal[at] == pytest.approx(areas[at] / (2 * math.pi * sigma**2), rel=0.005)
    assert found.noise[at] == pytest.approx(
        math.sqrt(areas[at] / (4 * math.pi * sigma**2)), rel=0.005
    )


def test_large_images_are_smoothed_by_tiles(monkeypatch):
    """A single pixel 20 deg from the tangent point, as in small images, where each pixel has its
    own kernel.
    """
    one = product("TAN", 0.0, side=45.0, pixel=10 * ARCMIN)
    fwhm, sigma = 50 * ARCMIN, 50 * ARCMIN / FWHM_PER_SIGMA
    values = np.zeros(one.signal.shape)
    for at in ((135, 135 + 114), (135 + 78, 135 - 78), (64, 128)):
        values[at] = 1.0
    found, noise = smoothed(one.grid, values, fwhm, noise=np.ones(values.shape))
    monkeypatch.setattr("zonda.core.maps.smoothing.DIRECT", 0.0)
    tiled, other = smoothed(one.grid, values, fwhm, noise=np.ones(values.shape))
    peak = one.areas().max() / (2 * math.pi * sigma**2)
    assert abs(tiled - found).max() < 0.005 * peak
    np.testing.assert_allclose(other[20:-20, 20:-20], noise[20:-20, 20:-20], rtol=0.005)


def test_the_beam_of_a_picture_is_round_on_the_sky():
    import matplotlib as mpl

    mpl.use("Agg")
    one = product("CAR", 60.0)
    from matplotlib.figure import Figure

    ax = plot_map(one.signal, one.wcs, fwhm=FWHM, ax=Figure().add_subplot())
    (beam,) = ax.patches
    sizes = sorted([beam.width, beam.height])
    assert sizes == pytest.approx(
        [5.0, 10.0], rel=0.03
    )  # pixels of 1 arcmin, by half that in longitude; 2 % more in the corner
    assert beam.width > beam.height
    assert abs(beam.angle) < 1
