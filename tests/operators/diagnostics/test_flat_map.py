"""Maps as their pictures show them."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from zonda.core.canvas import file_of
from zonda.core.maps.map_product import MapProduct
from zonda.operators.diagnostics.plot_operators import (
    Flat,
    Plots,
    draw_coverage,
    draw_input,
    draw_map,
    draw_noise,
)
from zonda.operators.maps.grid import tangent_wcs

ARCSEC = np.pi / 648000


@pytest.fixture
def product():
    rng = np.random.default_rng(2)
    shape, centre = (70, 90), (1.3, 0.35)
    hits = rng.integers(0, 50, shape)
    hits[:10, :7] = 0
    signal = np.where(hits > 0, rng.normal(0, 1e-4, shape), np.nan)
    half = np.where(hits > 3, rng.normal(0, 1e-4, shape), np.nan)
    header = tangent_wcs(centre, 2 * ARCSEC, shape).to_header()
    return MapProduct(
        signal, hits, hits * 1e6, np.where(hits > 0, 1e-4, np.nan), half, header,
        centre=centre, pixel=2 * ARCSEC, weighting="inverse_variance", fwhm=9 * ARCSEC,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("key", "behind"),
    [
        ("map", ""),
        ("map_f150", " (f150)"),
        ("map_f150_Q", " (f150 Q)"),
        ("healpix_f090", " (healpix f090)"),
    ],
)
def test_titles_say_of_which_band_and_stokes_parameter_a_picture_is(product, key, behind):
    style = Plots(smooth="none", central_diameter="60 arcsec", least_coverage=0.0)
    noise = draw_noise(f"noise_{key}", {"half_difference": (product, "half_difference")}, style)
    coverage = draw_coverage(f"coverage_{key}", product)
    titles = [
        draw_map(key, "", key, product, style)[0].ax.get_title(),
        noise[0].ax.get_title(),
        coverage[0].ax.get_title(),
    ]
    half = product.difference.replace(" - ", " minus ")
    assert titles[:2] == [f"Map{behind}, not smoothed", f"Noise: {half}{behind}, not smoothed"]
    assert noise[0].title == f"Noise{behind}"
    assert (
        f"in {np.count_nonzero(product.hits):,} pixels of 2″.".replace(",", "\u202f")
        in coverage[0].caption
    )
    assert titles[2].endswith(f"per beam{behind}") or titles[2] == f"Samples per pixel{behind}"


def png(sketches: Any) -> bytes:
    return file_of(sketches[0].ax.figure, "png")


def test_the_coverage_of_a_map_with_a_pole_in_it_is_drawn(product):
    header = tangent_wcs((1.3, np.pi / 2), 2 * ARCSEC, product.hits.shape).to_header()
    polar = replace(product, header=header, centre=(1.3, np.pi / 2))
    assert png(draw_coverage("coverage", polar)).startswith(b"\x89PNG")


def test_an_input_with_a_pole_in_it_is_drawn():
    header = tangent_wcs((1.3, np.pi / 2), 2 * ARCSEC, (30, 40)).to_header()
    image: Any = SimpleNamespace(values=np.ones((30, 40)), header=header, fwhm=0.0)
    assert png(draw_input("input", image)).startswith(b"\x89PNG")


def test_the_stated_noise_is_that_of_the_smoothed_map(product):
    style = Plots(central_diameter="60 arcsec", least_coverage=0.0)
    [sketch] = draw_noise("noise_map", {"half_difference": (product, "half_difference")}, style)
    there = product.smoothed(9 * ARCSEC).rms(30 * ARCSEC, of="half_difference")
    assert f"{there * 1e6:.4g} µK_RJ" in sketch.caption


def test_a_healpix_map_is_not_smoothed():
    import healpy

    pixels = healpy.query_disc(1024, healpy.ang2vec(75.0, 20.0, lonlat=True), np.radians(0.5))
    n = pixels.size
    signal = np.random.default_rng(1).normal(0, 1e-3, n)
    product = MapProduct(
        signal,
        np.full(n, 5),
        np.full(n, 5.0),
        np.full(n, 1e-3),
        None,
        None,
        centre=(np.radians(75.0), np.radians(20.0)),
        pixel=healpy.nside2resol(1024),
        nside=1024,
        pixels=np.sort(pixels),
        fwhm=9 * ARCSEC,
    )
    assert Plots().smoothed(product) is product
    flat = Flat.of(product, {"signal": signal}, 0.1)
    assert set(flat.planes["signal"][flat.covered]) == set(signal)
