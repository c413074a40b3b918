"""Rings, windows, tables and pictures of transfer functions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import zonda
from zonda.core.errors import PipelineError
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.sphere import ARCSEC
from zonda.core.storage.table_files import write_ecsv
from zonda.operators.diagnostics.plot_operators import Plots, pictures
from zonda.operators.diagnostics.series_plots import draw
from zonda.operators.diagnostics.transfer_function import (
    Transfer,
    TransferFunction,
    compare,
    window_of,
)

SIDE, PIXEL = 64, 4 * ARCSEC
EDGES = np.geomspace(1 / (120 * ARCSEC), 1 / (9 * ARCSEC), 5)


def hann() -> np.ndarray:
    one = np.sin(np.pi * (np.arange(SIDE) + 0.5) / SIDE) ** 2
    return np.outer(one, one)


def white(seed: int) -> np.ndarray:
    return np.random.default_rng(seed).standard_normal((SIDE, SIDE))


def test_a_constant_share():
    """Half of everything is left: T = S = 1/2 in every ring, without error."""
    a = white(1)
    found = compare(a + 3.0, 0.5 * a - 7.0, hann(), PIXEL, EDGES)
    np.testing.assert_allclose(found.transfer, 0.5, atol=1e-13)
    np.testing.assert_allclose(found.amplitude, 0.5, atol=1e-13)
    assert found.error.max() < 1e-13
    assert (np.diff(found.wavenumber) > 0).all()
    k = np.hypot(*np.meshgrid(np.fft.fftfreq(SIDE, PIXEL), np.fft.fftfreq(SIDE, PIXEL)))
    ring = (k >= EDGES[1]) & (k < EDGES[2])
    assert found.wavenumber[1] == pytest.approx(k[ring].mean())
    # a Hann window: mean w^4 / (mean w^2)^2 = (35/128 / (3/8)^2)^2 in two dimensions, mean w^2
    # being 3/8 and w^4 35/128
    assert found.modes[1] == pytest.approx(ring.sum() / 2 / (35 / 128 / (3 / 8) ** 2) ** 2)


def test_the_error_is_the_scatter():
    """b = 0.7 a + 0.5 g, g independent of a: (T - 0.7) / sigma has unit variance, S^2 is 0.49 +
    0.25.

    80 x 4 deviates, nearly Student's t of N - 1 >= 4 degrees of freedom: the standard deviation of
    the rms is about 0.06.
    """
    scores, sizes = [], []
    for seed in range(80):
        a, g = white(2 * seed), white(2 * seed + 1)
        found = compare(a, 0.7 * a + 0.5 * g, hann(), PIXEL, EDGES)
        scores.append((found.transfer - 0.7) / found.error)
        sizes.append(found.amplitude**2)
        assert (found.amplitude >= abs(found.transfer)).all()
    assert found.modes.min() > 4
    assert abs(np.sqrt(np.mean(np.square(scores))) - 1) < 0.25
    assert abs(np.mean(scores)) < 5 / np.sqrt(320) * 1.2
    assert np.mean(sizes) == pytest.approx(0.74, abs=0.05)


def test_turned_structure_is_not_in_phase():
    """A map moved by half a wave has lost all of that wave and kept its amplitude."""
    x = np.arange(SIDE) * np.ones((SIDE, 1))
    wave = np.sin(2 * np.pi * 8 * x / SIDE)
    found = compare(wave, -wave, hann(), PIXEL, np.array([7 / SIDE, 9 / SIDE]) / PIXEL)
    assert found.transfer[0] == pytest.approx(-1)
    assert found.amplitude[0] == pytest.approx(1)


def test_pixels_without_samples_and_rings_without_modes():
    a, b = white(3), white(4)
    b[10:20, 5] = np.nan
    a[0, 0] = np.nan
    edges = np.array([0.2 / SIDE, 0.5 / SIDE, 1.01 / SIDE, 10 / SIDE, 12 / SIDE]) / PIXEL
    found = compare(a, b, hann(), PIXEL, edges)
    assert np.isnan(found.transfer[0])
    assert np.isnan(found.error[0])
    assert found.modes[0] == 0
    assert np.isfinite(found.transfer[1])
    assert np.isnan(found.error[1]), (
        "four modes, two of them the others' mirror images, all correlated: no scatter to tell"
    )
    assert np.isfinite(found.error[2:]).all()
    nothing = compare(np.zeros((SIDE, SIDE)), b, hann(), PIXEL, edges)
    assert np.isnan(nothing.transfer).all()
    assert np.isnan(compare(a, np.full_like(a, np.nan), hann(), PIXEL, edges).transfer).all()


def product(hits: np.ndarray, **more) -> MapProduct:
    from zonda.operators.maps.grid import tangent_wcs

    zeros = np.zeros(hits.shape)
    header = tangent_wcs((1.3, 0.3), PIXEL, hits.shape).to_header()
    return MapProduct(zeros, hits, zeros, zeros, None, header, (1.3, 0.3), PIXEL, **more)


def test_windows():
    """A disc has cos^2(pi/2 r / R); a taper has its width; holes are filled, bare edges left
    out.
    """
    y, x = np.indices((101, 101)) - 50
    r = np.hypot(x, y)
    hits = np.where(r <= 40, 100, 0)
    window = window_of(product(hits))
    np.testing.assert_allclose(
        window[50, 50:], np.cos(np.pi / 2 * np.minimum(r[50, 50:] / 40, 1)) ** 2, atol=0.01
    )  # pixels
    hits[50, 50] = hits[30, 40] = 0
    assert np.array_equal(window_of(product(hits)), window)
    hits[r > 30] = np.minimum(hits[r > 30], 5)
    assert not window_of(product(hits))[r > 31].any()
    assert (window_of(product(hits), least=0.01)[r < 40] > 0).all()
    assert not window_of(product(hits), radius=20.2 * PIXEL)[r > 20.5].any()
    flat = window_of(product(hits), taper=10 * PIXEL)
    assert (flat[r < 20] == 1).all()
    assert not window_of(product(np.zeros((5, 5), int))).any()


@pytest.fixture
def transfer() -> Transfer:
    a = white(5)
    edges = np.append(0.2 / SIDE / PIXEL, EDGES)
    return Transfer(
        compare(a, 0.5 * a + 0.1 * white(6), hann(), PIXEL, edges),
        edges,
        "sky",
        8.5 * ARCSEC,
        "TransferFunction",
        "map",
    )


def test_the_table_is_read_by_astropy(transfer, tmp_path):
    from astropy.table import Table

    meta = {"PIPELINE": 'a "b": é', "SEED": 7, **transfer.meta}
    write_ecsv(tmp_path / "t.ecsv", transfer.columns(), meta)
    table = Table.read(tmp_path / "t.ecsv")
    assert table.meta["PIPELINE"] == 'a "b": é'
    assert (table.meta["SEED"], table.meta["MODES"], table.meta["BEAM"]) == (7, "sky", "8.5 arcsec")
    assert str(table["scale"].unit) == "arcsec"
    np.testing.assert_allclose(table["scale"], transfer.scale / ARCSEC, rtol=1e-8)
    np.testing.assert_allclose(table["transfer"], transfer.rings.transfer, rtol=1e-8)
    np.testing.assert_allclose(table["kilolambda"] * table["scale"], 648 / np.pi, rtol=1e-8)
    assert np.isnan(table["error"][0])
    assert (table["scale_smallest"] <= table["scale"]).all()
    assert (table["scale"] <= table["scale_largest"]).all()
    assert "arcsec" in transfer._repr_html_()


def test_the_picture(transfer, data):
    ax = draw(transfer, "transfer_function", "")[0].ax
    assert ax.get_title() == "Transfer function, singular modes of the sky alone"
    assert ax.get_xlabel() == "angular scale [arcsec]"
    low, high = ax.get_xlim()
    assert low == pytest.approx(1 / transfer.edges[0] / ARCSEC)
    assert high == pytest.approx(1 / transfer.edges[-1] / ARCSEC)
    amplitude = transfer.rings.amplitude.copy()
    amplitude[-2:] = 50.0, np.nan  # the sky has no power there
    wild = replace(transfer, rings=replace(transfer.rings, amplitude=amplitude))
    sketch = draw(wild, "transfer_function", "")[0]
    (amplitudes,) = (line for line in sketch.ax.lines if line.get_linestyle() == "--")
    np.testing.assert_allclose(amplitudes.get_xdata(), transfer.scale[:-2] / ARCSEC)
    left = f"2 of {amplitude.size} rings are left out: the sky has no power there"
    assert left in sketch.caption
    assert left in [text.get_text() for text in sketch.ax.texts]
    data.products["transfer_function"] = transfer
    made = {p.name: p for p in pictures(data, Plots())}
    assert made["transfer_function"].png.startswith(b"\x89PNG")
    assert "sky alone" in made["transfer_function"].caption


@pytest.fixture
def run():
    """Runs a short scan of a random sky (or none), and a TransferFunction."""
    from zonda.plugins.checks.scenes import sky_file

    def made(binning, parameters, with_sky=True):
        scene = zonda.Scene(
            site="green_bank",
            instrument="mustang2",
            time="2024-11-25T07:00",
            target="05h +20d",
            seed=1,
        )
        with sky_file(np.random.default_rng(0).standard_normal((200, 200)), 2.0) as path:
            sky = [zonda.SkyMap(file=path)] if with_sky else []
            point = zonda.PointingDaisy(radius="1 arcmin", scan_duration="6 s", sample_rate="20 Hz")
            steps = [
                point,
                *sky,
                zonda.WhiteNoise(),
                zonda.Efficiency(),
                zonda.BinMap(**binning),
                TransferFunction(**parameters),
            ]
            return zonda.Pipeline(steps).run(scene)

    return made


@pytest.mark.parametrize(
    ("binning", "parameters", "words"),
    [
        ({"nside": 8192}, {}, "TAN map"),
        ({"contents": "hits"}, {}, "TAN map"),
        ({"product": "chart"}, {}, "no map 'map'"),
        ({"pixel": "8 arcsec"}, {"largest": "5 arcsec"}, "are none"),
        ({"pixel": "8 arcsec"}, {"radius": "1 arcsec"}, "no pixel is left"),
    ],
)
def test_what_cannot_be_compared(binning, parameters, words, run):
    with pytest.raises(PipelineError, match=words):
        run(binning, parameters)


def test_what_is_refused_before_it_runs(run):
    with pytest.raises(PipelineError, match="TransferFunction needs 'sky', which no step provides"):
        run({}, {}, with_sky=False)
    with pytest.raises(ValueError, match="largest must be larger"):
        TransferFunction(largest="5 arcsec", smallest="6 arcsec")
