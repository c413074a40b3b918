"""The map that is drawn is the map: smoothing and noise figures against `MapProduct`'s, in single
precision.
"""

from __future__ import annotations

import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from zonda.core.maps.map_product import MapProduct
from zonda.operators.diagnostics.drawing.pictures import (
    Style,
    draw_coverage,
    draw_input,
    draw_map,
    draw_noise,
)
from zonda.operators.diagnostics.drawing.png import png_of
from zonda.operators.diagnostics.plot_operators import _flat, _input
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


def test_smoothing_is_that_of_the_map(product):
    mine, there = (
        _flat(product, "signal", "half_difference").smoothed(9 * ARCSEC),
        product.smoothed(9 * ARCSEC),
    )
    for plane in ("signal", "half_difference"):
        # float32: sums of some 300 terms about zero, each rounded at 6e-8 of 1e-4 K
        np.testing.assert_allclose(
            mine.planes[plane], getattr(there, plane), rtol=0, atol=3e-10, equal_nan=True
        )
    assert mine.smoothed_by == there.smoothed_by


def test_the_stated_noise_is_that_of_the_map(product):
    flat = _flat(product, "half_difference").smoothed(9 * ARCSEC)
    there = product.smoothed(9 * ARCSEC).rms(30 * ARCSEC, of="half_difference")
    assert flat.central_rms("half_difference", 30 * ARCSEC) == pytest.approx(there, rel=1e-5)


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
    flat, style = _flat(product, "signal"), Style(0.0, 60 * ARCSEC, 0.0)
    half = _flat(product, "half_difference")
    titles = [
        draw_map(key, "", key, flat, style)[0].ax.get_title(),
        draw_noise(f"noise_{key}", {"half_difference": half}, style)[0].ax.get_title(),
        draw_coverage(f"coverage_{key}", flat, 1, 1, product.sides)[0].ax.get_title(),
    ]
    noise = f"Noise: {half.difference}{behind}, not smoothed"
    assert titles[:2] == [f"Map{behind}, not smoothed", noise]
    assert draw_noise(f"noise_{key}", {"half_difference": half}, style)[0].title == f"Noise{behind}"
    assert (
        "in 1 pixels of 1″ x 2″."
        in draw_coverage(f"coverage_{key}", flat, 1, 1, (2 * ARCSEC, ARCSEC))[0].caption
    )
    assert titles[2].endswith(f"per beam{behind}") or titles[2] == f"Samples per pixel{behind}"


def test_the_coverage_of_a_map_with_a_pole_in_it_is_drawn(product):
    from dataclasses import replace

    header = tangent_wcs((1.3, np.pi / 2), 2 * ARCSEC, product.hits.shape).to_header()
    flat = _flat(replace(product, header=header, centre=(1.3, np.pi / 2)), "signal")
    assert png_of(draw_coverage("coverage", flat, 1, 1, product.sides)[0].ax).startswith(b"\x89PNG")


def test_an_input_with_a_pole_in_it_is_drawn():
    wcs = tangent_wcs((1.3, np.pi / 2), 2 * ARCSEC, (30, 40))
    image: Any = SimpleNamespace(values=np.ones((30, 40)), header=wcs.to_header(), wcs=wcs)
    assert png_of(draw_input(*_input("input", image))[0].ax).startswith(b"\x89PNG")


def test_a_healpix_map_keeps_its_own_noise():
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
    flat = _flat(product, "signal", style=Style(None, np.radians(0.4), 0.1))
    assert not flat.smooth
    assert flat.central_rms("signal", np.radians(0.2)) == product.rms(np.radians(0.2))


def test_the_process_that_draws_imports_little():
    code = (
        "import sys\nfrom zonda.operators.diagnostics.drawing import artist, pictures\nassert"
        " 'matplotlib' not in sys.modules\nartist._prepare()\nheavy = {'numba', 'scipy',"
        " 'pydantic', 'healpy', 'matplotlib.pyplot'}\nassert 'matplotlib.figure' in"
        " sys.modules and not heavy & set(sys.modules), heavy & set(sys.modules)\n"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
