"""Solid angles, steps, distances, duplicates and smoothing on grids of maps."""

from __future__ import annotations

import math

import numpy as np
import pytest

from zonda.core.errors import InputError
from zonda.core.maps.grid import HealpixPixels, image_grid, wcs_grid
from zonda.core.maps.smoothing import smoothed, smoother
from zonda.core.numerics.sphere import ARCMIN, FWHM_PER_SIGMA, separation, unit_vectors

ZENITHAL = ("TAN", "SIN", "ZEA", "ARC", "STG")
CYLINDRICAL = ("CAR", "CEA", "MER")


def header(
    kind: str,
    dec: float,
    shape=(61, 81),
    cdelt=(-1 / 60, 1 / 60),
    turn: float = 0.0,
    frame=("RA---", "DEC--"),
):
    """An image about (40, dec) deg; cylinders have their reference point on the equator, as
    usual.
    """
    ny, nx = shape
    crpix, crval = [(nx + 1) / 2, (ny + 1) / 2], [40.0, dec]
    c, s = math.cos(math.radians(turn)), math.sin(math.radians(turn))
    if kind in CYLINDRICAL:
        native = {
            "CAR": dec,
            "CEA": math.degrees(math.sin(math.radians(dec))),
            "MER": math.degrees(math.atanh(math.sin(math.radians(dec)))),
        }[kind]
        crpix = [crpix[0] - s * native / cdelt[0], crpix[1] - c * native / cdelt[1]]
        crval[1] = 0.0
    cards = {
        "NAXIS": 2,
        "CTYPE1": frame[0] + kind,
        "CTYPE2": frame[1] + kind,
        "CRVAL1": crval[0],
        "CRVAL2": crval[1],
    }
    cards |= {
        "CRPIX1": crpix[0],
        "CRPIX2": crpix[1],
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "CDELT1": cdelt[0],
        "CDELT2": cdelt[1],
    }
    if turn:
        cards |= {
            "PC1_1": c,
            "PC1_2": -s * cdelt[1] / cdelt[0],
            "PC2_1": s * cdelt[0] / cdelt[1],
            "PC2_2": c,
        }
    return cards


@pytest.mark.parametrize("kind", ["CAR", "CEA", "ZEA", "AIT", "MOL", "SIN"])
def test_the_solid_angles_of_a_whole_sky_add_up_to_it(kind):
    shape = (181, 361)
    cards = header("CAR", 0, shape, (-1.0, 1.0)) | {
        "CTYPE1": f"RA---{kind}",
        "CTYPE2": f"DEC--{kind}",
        "CRVAL2": 0.0,
    }
    if kind in ("ZEA", "SIN"):  # 8 / pi deg of the plane for a radian of the chord
        shape = (241, 241)
        cards |= {"CRPIX1": 121.0, "CRPIX2": 121.0}
    grid = image_grid(cards, shape)
    # SIN shows half the sky. The jagged limb leaves out or adds at most half of its pixels: 0.5 x 2
    # pi r pixels of r^2 pi
    share = 0.5 if kind == "SIN" else 1.0
    tolerance = {"CAR": 1e-9, "CEA": 0.01}.get(kind, 0.02 if kind != "SIN" else 0.1)
    assert grid.solid_angle(np.ones(shape, bool)) == pytest.approx(
        4 * math.pi * share, rel=tolerance
    )
    assert (
        kind != "CAR" or not grid.once[:, -1].any()
    )  # column 361 of a whole turn of 360 repeats the first one


@pytest.mark.parametrize("turn", [0.0, 30.0])
@pytest.mark.parametrize("cdelt", [(-1 / 60, 1 / 60), (-0.25 / 60, 1 / 60)])
@pytest.mark.parametrize("dec", [0.0, 60.0, 80.0])
@pytest.mark.parametrize("kind", [*ZENITHAL, *CYLINDRICAL])
def test_a_pixels_solid_angle_is_that_between_its_corners(kind, dec, cdelt, turn):
    cards, shape = header(kind, dec, (61, 81), cdelt, turn), (61, 81)
    grid = image_grid(cards, shape)
    areas = np.broadcast_to(grid.areas, shape)
    for row, column in ((0, 0), (30, 40), (55, 12)):
        corners = grid.at(
            column + np.array([-0.5, 0.5, 0.5, -0.5]), row + np.array([-0.5, -0.5, 0.5, 0.5])
        )
        # half the cross product of the diagonals; at 80 deg a row of CEA is 6 arcmin high, and
        # curvature matters by 1e-4
        flat = np.linalg.norm(np.cross(corners[2] - corners[0], corners[3] - corners[1])) / 2
        assert areas[row, column] == pytest.approx(flat, rel=3e-4 if kind == "CEA" else 3e-5)
    assert grid.pixel**2 == pytest.approx(areas[30, 40], rel=1e-6)


@pytest.mark.parametrize("cdelt", [(-1 / 60, 1 / 60), (-0.5 / 60, 1 / 60)])
@pytest.mark.parametrize("dec", [0.0, 30.0, 60.0, 80.0, 89.5])
@pytest.mark.parametrize("kind", ["TAN", "SIN", "ZEA", "CAR", "CEA", "turned"])
def test_a_delta_pixel_becomes_a_gaussian_of_its_own_solid_angle(kind, dec, cdelt):
    """Every pixel: exp(-r^2 / 2 sigma^2) W / 2 pi sigma^2, to 0.5 % of the peak; as does white
    noise that is the same in each.
    """
    shape, fwhm = (61, 81), 5 * ARCMIN
    if kind in CYLINDRICAL:
        dec = min(dec, {"CAR": 85.0, "CEA": 60.0}[kind])  # a row of CEA is 1 / cos(dec) high
        shape = (61, math.ceil(81 / math.cos(math.radians(dec))))
    cards = (
        header("TAN", dec, shape, cdelt, 33.0)
        if kind == "turned"
        else header(kind, dec, shape, cdelt)
    )
    grid = image_grid(cards, shape)
    sigma, at = fwhm / FWHM_PER_SIGMA, (28, shape[1] // 2 + 4)
    values = np.zeros(shape)
    values[at] = 1.0
    found, noise = smoothed(grid, values, fwhm, noise=np.ones(shape))
    directions = grid.directions()
    apart = 2 * np.arcsin(np.clip(np.linalg.norm(directions - directions[at], axis=-1) / 2, 0, 1))
    areas = np.broadcast_to(grid.areas, shape)
    expected = np.exp(-(apart**2) / (2 * sigma**2)) * areas[at] / (2 * math.pi * sigma**2)
    wide = shape[1] * 3 // 8
    inner = np.s_[12:-12, wide:-wide]  # the kernel lies within the image
    assert abs(found - expected)[inner].max() < 0.005 * expected.max()
    assert noise[inner] == pytest.approx(
        np.sqrt(areas / (4 * math.pi * sigma**2))[inner], rel=0.005
    )


def test_the_pole_of_a_whole_plate_carree_sky():
    """Half a degree from the pole, in the row that is 0.75 deg from it: a kernel of 2 deg reaches
    across.
    """
    shape = (20, 720)
    cards = header("CAR", 0, (360, 720), (-0.5, 0.5)) | {
        "CRPIX2": -159.5
    }  # rows from 80.25 to 89.75 deg
    grid = image_grid(cards, shape)
    assert np.degrees(grid.latitudes[[0, -1]]) == pytest.approx([80.25, 89.75])
    fwhm = math.radians(2.0)
    values, sigma = np.zeros(shape), fwhm / FWHM_PER_SIGMA
    values[18, 100] = 1.0
    found, _ = smoothed(grid, values, fwhm)
    directions = grid.directions()
    apart = 2 * np.arcsin(np.linalg.norm(directions - directions[18, 100], axis=-1) / 2)
    expected = (
        np.exp(-(apart**2) / (2 * sigma**2)) * grid.areas[18]
    )  # over its own sum: rings of 0.6 sigma add up to 1.01
    for row, column in ((18, 100), (19, 460), (17, 460), (18, 280), (16, 100)):
        at = directions[row, column]
        weight = (
            np.exp(-2 * np.arcsin(np.linalg.norm(directions - at, axis=-1) / 2) ** 2 / sigma**2)
            * grid.areas
        )
        # cut at 5 sigma: what lies beyond is exp(-12.5)
        assert found[row, column] == pytest.approx(
            expected[row, column] / weight.sum(), abs=2e-5 * expected.max() / weight.sum()
        )


@pytest.mark.parametrize("width", [6.0, 18.0])
def test_a_large_plate_carree_sky_is_smoothed_as_a_small_one(width, monkeypatch):
    """By rows where these are nearly alike, pixel by pixel near the poles: as pixel by pixel
    everywhere, to 0.5 % of the peak.
    """
    shape = (90, 180)
    grid = image_grid(header("CAR", 0, shape, (-2.0, 2.0)), shape)
    fwhm, rows = math.radians(width), (3, 15, 40, 60, 75, 85)
    values = np.zeros(shape)
    for row in rows:
        values[row, (37 * row) % 180] = 1.0
    monkeypatch.setattr("zonda.core.maps.smoothing.DIRECT", 1e99)
    expected, noise = smoothed(grid, values, fwhm, noise=np.ones(shape))
    monkeypatch.setattr("zonda.core.maps.smoothing.DIRECT", 0.0)
    found, other = smoothed(grid, values, fwhm, noise=np.ones(shape))
    for row in rows:
        near = slice(max(row - 3, 0), row + 4)
        assert abs(found - expected)[near].max() < 0.005 * expected[near].max()
    np.testing.assert_allclose(other, noise, rtol=0.005)


def test_a_pole_that_would_take_hours_is_refused(monkeypatch):
    shape = (90, 180)
    grid = image_grid(header("CAR", 0, shape, (-2.0, 2.0)), shape)
    monkeypatch.setattr("zonda.core.maps.smoothing.DIRECT", 0.0)
    monkeypatch.setattr("zonda.core.maps.smoothing.MOST_DIRECT", 1.0)
    with pytest.raises(InputError, match="would take"):
        smoother(grid, math.radians(6.0))


def test_rows_that_go_round_the_sky_have_no_ends():
    """361 columns: the last repeats the first; a pixel beside the seam spreads across it."""
    shape = (41, 361)
    grid = image_grid(header("CAR", 0, shape, (-1.0, 1.0)), shape)
    values = np.zeros(shape)
    values[20, 1] = 1.0
    found, _ = smoothed(grid, values, math.radians(5.0))
    assert found[20, 359] == pytest.approx(found[20, 3], rel=1e-9)
    np.testing.assert_array_equal(found[:, 0], found[:, 360])
    assert np.count_nonzero(~grid.once) == 41


def test_distances_and_places_go_forth_and_back():
    for kind in (*ZENITHAL, *CYLINDRICAL):
        grid = image_grid(header(kind, 60.0), (61, 81))
        directions = grid.directions()
        np.testing.assert_array_equal(
            grid.pixels_at(directions), np.arange(61 * 81).reshape(61, 81)
        )
        centre = (math.radians(41.0), math.radians(60.2))
        apart = np.arccos(np.clip(directions @ unit_vectors(*centre), -1, 1))
        assert grid.distance(centre) == pytest.approx(apart, abs=3e-8)
        part = grid.window(slice(5, 20), slice(7, 50))
        np.testing.assert_allclose(part.directions(), directions[5:20, 7:50], atol=1e-14)
        assert np.broadcast_to(part.areas, (15, 43)) == pytest.approx(
            np.broadcast_to(grid.areas, (61, 81))[5:20, 7:50], rel=1e-9
        )


def test_pixels_beyond_the_sky_have_no_area_and_no_value():
    shape = (41, 41)
    grid = image_grid(header("SIN", 20.0, shape, (-4.0, 4.0)), shape)
    assert not grid.once[0, 0]
    assert grid.once[20, 20]
    assert math.isnan(grid.areas[0, 0])
    assert grid.pixels_at(unit_vectors(math.radians(220.0), math.radians(-20.0))) == -1
    found, _ = smoothed(grid, np.where(grid.once, 2.0, np.nan), math.radians(10.0))
    assert found[grid.once] == pytest.approx(2.0)
    assert np.isnan(found[~grid.once]).all()


def test_swapped_axes():
    from astropy.wcs import WCS

    cards = header("CAR", 60.0)
    swapped = {
        key: cards[key[:-1] + "21"[int(key[-1]) - 1]] if key[-1] in "12" else cards[key]
        for key in cards
    }
    one, other = image_grid(cards, (61, 81)), wcs_grid(WCS(swapped), (81, 61))
    np.testing.assert_allclose(np.broadcast_to(one.areas, (61, 81)).T, other.areas, rtol=1e-6)
    assert one.sides == pytest.approx(other.sides[::-1], rel=1e-6)
    assert one.sides == pytest.approx((ARCMIN, ARCMIN / 2), rel=1e-6)  # cos 60 deg


@pytest.mark.parametrize("nest", [False, True])
def test_healpix(nest):
    import healpy

    nside, fwhm = 256, math.radians(1.0)
    middle = (0.7, 1.0)
    pixels = np.sort(healpy.query_disc(nside, unit_vectors(*middle), math.radians(6.0), nest=nest))
    grid = HealpixPixels(nside, nest, pixels)
    assert grid.areas == pytest.approx(healpy.nside2pixarea(nside))
    assert (grid.pixels_at(grid.directions()) == np.arange(len(pixels))).all()
    at = int(grid.distance(middle).argmin())
    values, sigma = np.zeros(len(pixels)), fwhm / FWHM_PER_SIGMA
    values[at] = 1.0
    found, noise = smoothed(grid, values, fwhm, noise=np.ones(len(pixels)))
    where = grid.directions()[at]
    lon, lat = math.atan2(where[1], where[0]), math.asin(where[2])
    expected = (
        np.exp(-(grid.distance((lon, lat)) ** 2) / (2 * sigma**2))
        * float(grid.areas[0])
        / (2 * math.pi * sigma**2)
    )
    near = grid.distance(middle) < math.radians(3.0)
    assert abs(found - expected)[near].max() < 0.01 * expected.max()
    assert noise[near] == pytest.approx(
        math.sqrt(float(grid.areas[0]) / (4 * math.pi * sigma**2)), rel=0.01
    )
    assert separation(np.array([lon]), np.array([lat]), (lon, lat))[0] == 0.0
