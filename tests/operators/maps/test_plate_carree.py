"""CAR maps: pixell's pixels, every sample in the right one, maps that fit together, their areas and
their smoothing.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from astropy.coordinates import SkyCoord
from hypothesis import given, settings
from hypothesis import strategies as st

import zonda
from zonda.core.errors import InputError
from zonda.core.numerics.projection import directions
from zonda.core.numerics.sphere import ARCMIN, ARCSEC, separation
from zonda.operators.maps.bin_map import BinMap
from zonda.operators.maps.grid import PlateCarreeGrid
from zonda.operators.maps.map_layout import MapLayout, checked
from zonda.operators.maps.plate_carree import Box, _box, _joined, centre_of, rows_of
from zonda.plugins.checks import scenes


def full_sky(degrees: float) -> Any:
    """`pixell.enmap.fullsky_geometry` of pixell 0.32.9 with its defaults, written out."""
    from astropy.wcs import WCS

    wcs = WCS(naxis=2)
    rows = round(180 / degrees)
    wcs.wcs.ctype, wcs.wcs.crval = ["RA---CAR", "DEC--CAR"], [degrees / 2, 0.0]
    wcs.wcs.crpix, wcs.wcs.cdelt = [rows + 0.5, (rows + 1) / 2], [-degrees, degrees]
    return wcs


@settings(max_examples=30, deadline=None)
@given(st.floats(0, 360), st.floats(-80, 80), st.integers(1, 30), st.integers(1, 30))
def test_pixels_are_those_of_the_full_sky(
    longitude: float, latitude: float, half_width: int, half_height: int
) -> None:
    degrees = 0.5
    pixel = math.radians(degrees)
    box = _box(
        math.radians(longitude),
        half_width * pixel,
        *np.radians([latitude - half_height / 4, latitude + half_height / 4]),
        pixel,
    )
    grid = PlateCarreeGrid.of_box(box, pixel, "icrs")
    y, x = np.indices(grid.shape)
    found = grid.wcs.wcs_pix2world(x.ravel(), y.ravel(), 0)
    there = full_sky(degrees).wcs_world2pix(*found, 0)
    for place in there:  # whole pixels, to the rounding of 360 deg / 0.5 deg
        assert abs(place - np.rint(place)).max() < 1e-9
    assert np.degrees(centre_of(box, pixel))[1] == pytest.approx(float(found[1].mean()), abs=1e-9)


def test_pixell_calls_it_compatible() -> None:
    pixell = pytest.importorskip("pixell", reason="pixell is not installed: pip install pixell")
    from pixell import enmap, wcsutils

    _, whole = enmap.fullsky_geometry(res=math.radians(0.5))
    grid = PlateCarreeGrid.of_box((713, 30, 725, 44), math.radians(0.5), "icrs")
    assert wcsutils.is_compatible(grid.wcs, whole), pixell.__version__
    corners = enmap.pix2sky(grid.shape, grid.wcs, [[0, 14], [0, 12]])
    assert np.degrees(corners[0]) == pytest.approx([30.5 * 0.5 - 90, 44.5 * 0.5 - 90])


@pytest.mark.parametrize("frame", ["icrs", "galactic"])
def test_every_sample_is_in_the_pixel_that_astropy_says(bench: Any, frame: str) -> None:
    observation = bench.observation(7, 3000)
    a = np.arange(7 * 3000.0).reshape(7, 3000) % 97
    operator = BinMap(projection="CAR", pixel="5 arcsec", frame=frame)
    product = bench.run([operator], observation, {"signal": a}, precision="float64").map
    d = directions(
        observation.boresight_radec, observation.focalplane.xi, observation.focalplane.eta
    )
    sky = SkyCoord(x=d[..., 0], y=d[..., 1], z=d[..., 2], representation_type="cartesian")
    sky.representation_type = "unitspherical"
    places = np.array(product.wcs.world_to_pixel(sky)) + 0.5
    x, y = np.floor(places).astype(int)
    hits, total = np.zeros(product.hits.shape, int), np.zeros(product.hits.shape)
    np.add.at(hits, (y, x), 1)  # raises where one is beyond the map
    np.add.at(total, (y, x), a)
    # astropy's trigonometry differs by some 1e-8 of a pixel: samples on an edge may be in either
    # (20 deg is an edge)
    on_an_edge = (abs(places - np.rint(places)) < 1e-6).any(axis=0).sum()
    assert on_an_edge < 30
    assert abs(product.hits - hits).sum() <= 2 * on_an_edge
    same = (product.hits == hits) & (hits > 0)
    np.testing.assert_allclose(product.signal[same], (total / np.maximum(hits, 1))[same], rtol=1e-9)
    assert product.hits.sum() == a.size
    assert product.projection == "CAR"


def test_areas_are_those_of_the_sphere(bench: Any) -> None:
    product = bench.run(
        [BinMap(projection="CAR", pixel="5 arcsec")],
        bench.observation(7, 300),
        {"signal": np.ones((7, 300))},
    ).map
    edges = np.append(
        product.grid.latitudes - product.pixel / 2, product.grid.latitudes[-1] + product.pixel / 2
    )
    # the exact area between two latitudes; cancellation leaves 1e-16 / pixel
    assert product.areas().ravel() == pytest.approx(
        np.diff(np.sin(edges)) * product.pixel, rel=1e-10
    )
    assert product.grid.latitudes.mean() == pytest.approx(product.centre[1], abs=20 * ARCSEC)
    jansky = product.to("Jy/pixel").signal / product.to("MJy/sr").signal * 1e-6
    hit = product.hits > 0
    assert jansky[hit] == pytest.approx(np.broadcast_to(product.areas(), hit.shape)[hit], rel=1e-12)


def test_a_map_of_given_size_and_one_across_the_meridian(bench: Any) -> None:
    observation = bench.observation(7, 300)
    found = bench.run(
        [BinMap(projection="CAR", pixel="5 arcsec", width="6 arcmin", height="4 arcmin")],
        observation,
        {"signal": np.ones((7, 300))},
    )
    ny, nx = found.map.signal.shape
    assert nx * 5 == pytest.approx(360 / math.cos(observation.centre[1]), abs=4 * 5)
    assert ny * 5 == pytest.approx(240, abs=4 * 5)
    box = _box(0.0, 10 * ARCMIN, -0.1, 0.1, math.radians(0.05))
    grid = PlateCarreeGrid.of_box(box, math.radians(0.05), "icrs")
    where = np.empty((1, 1), np.int32)
    for angle in (-8 * ARCMIN, 8 * ARCMIN):
        direction = np.array([math.cos(angle), math.sin(angle), 0.0])
        h = np.zeros((9, 1))
        h[[2, 5, 8], 0] = direction
        grid.pixels(h, 0, 1, np.zeros(1), np.zeros(1), where)
        y, x = divmod(int(where[0, 0]), grid.shape[1])
        assert where[0, 0] >= 0
        lon, lat = np.radians(grid.wcs.wcs_pix2world(x, y, 0))
        assert separation(lon, lat, (angle, 0.0)) < math.radians(0.05)


@pytest.mark.parametrize("longitudes", [(40.0, 44.0), (359.0, 3.0), (10.0, 150.0)])
def test_a_map_of_given_size_lies_about_the_middle_of_several_targets(
    longitudes: tuple[float, float],
) -> None:
    """As in TAN, not about the first target; across the meridian, and for targets too far apart for
    a tangent plane.
    """
    scans = [scenes.scan(3, 50), scenes.scan(3, 50)]
    for scan, longitude in zip(scans, longitudes, strict=True):
        scan.centre = (math.radians(longitude), math.radians(20))
    mapping = MapLayout(BinMap(projection="CAR", pixel="1 arcmin", width="4 deg"))
    layout = mapping.common(scans, None)
    assert layout is not None
    middle = (
        (longitudes[0] + longitudes[1] + (360 if longitudes[1] < longitudes[0] else 0)) / 2 % 360
    )
    np.testing.assert_allclose(np.degrees(layout["middle"]), (middle, 20), atol=1 / 60)
    grid = mapping.grid(layout)
    ny, nx = grid.shape
    lon, lat = grid.wcs.wcs_pix2world((nx - 1) / 2, (ny - 1) / 2, 0)
    np.testing.assert_allclose(((lon - middle + 180) % 360 - 180, lat - 20), 0, atol=1 / 60)


boxes = st.tuples(st.integers(0, 719), st.integers(0, 300), st.integers(1, 200), st.integers(1, 40))


@given(boxes, boxes)
def test_a_joined_box_holds_both(one: tuple[int, ...], other: tuple[int, ...]) -> None:
    pixel, around = math.radians(0.5), 720

    def columns(box: Box) -> set[int]:
        return {c % around for c in range(box[0], box[2] + 1)}

    a, b = ((x[0], x[1], x[0] + x[2], x[1] + x[3]) for x in (one, other))
    found = _joined(a, b, pixel)
    assert rows_of(pixel) == 360
    assert columns(found) >= columns(a) | columns(b)
    assert found[1] == min(a[1], b[1])
    assert found[3] == max(a[3], b[3])
    assert 0 <= found[0] < around
    assert found[2] - found[0] < around


def test_smoothing_keeps_a_gaussian_round_at_high_latitude() -> None:
    """A Gaussian of 6 arcmin at 60 deg, smoothed by 8 arcmin, is one of 10: right to FWHM
    tan(latitude), here 0.4 %.
    """
    from zonda.core.maps.map_product import MapProduct

    pixel = math.radians(1 / 60)
    box = _box(1.0, math.radians(1.6), math.radians(59.3), math.radians(60.7), pixel)
    grid = PlateCarreeGrid.of_box(box, pixel, "icrs")
    header = grid.wcs.to_header()
    ones = np.ones(grid.shape)
    product = MapProduct(
        ones, ones.astype(int), ones, ones, None, header, centre_of(box, pixel), pixel
    )
    distance = product.distance()

    def gaussian(fwhm: float) -> Any:
        return np.exp(-4 * math.log(2) * (distance / fwhm) ** 2)

    product.signal = gaussian(6 * ARCMIN)
    found = product.smoothed(8 * ARCMIN).signal
    expected = 0.36 * gaussian(10 * ARCMIN)
    near = distance < 10 * ARCMIN
    assert abs(found - expected)[near].max() < 0.005 * expected.max()
    part = product.smoothed_rms(8 * ARCMIN, 5 * ARCMIN)
    assert part == pytest.approx(product.smoothed(8 * ARCMIN).rms(5 * ARCMIN), rel=1e-6)


def test_a_pixel_that_does_not_divide_the_sky_is_refused() -> None:
    with pytest.raises(
        zonda.core.errors.ZondaError,
        match=r"whole number of pixels; the nearest that fits is 7.0000",
    ):
        BinMap(projection="CAR", pixel="7 arcsec")
    grid = PlateCarreeGrid.of_box((0, 0, 100_000, 100_000), math.radians(1 / 3600), "icrs")
    with pytest.raises(InputError, match="too large"):
        checked(grid, "BinMap")


def test_blocks_threads_and_scans_give_the_same_bits() -> None:
    scene = zonda.Scene(
        site="green_bank",
        instrument="mustang2",
        time="2024-11-25T07:00",
        target="75 deg 20 deg",
        seed=3,
    )
    steps = [
        zonda.PointingDaisy(scan_duration="6 s", scans=2),
        zonda.WhiteNoise(),
        zonda.Efficiency(),
    ]
    maps = [
        zonda.Pipeline([*steps, zonda.BinMap(projection="CAR", pixel="5 arcsec")]).run(
            scene, threads=threads, memory=memory
        )["map"]
        for threads, memory in ((1, None), (2, 3e8))
    ]
    for plane in ("signal", "hits", "weights", "noise", "half_difference"):
        assert getattr(maps[0], plane).tobytes() == getattr(maps[1], plane).tobytes()
