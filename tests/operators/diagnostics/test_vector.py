"""PDF and SVG files: text as text, fonts embedded, the same bits from run to run; contours of the
SNR.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import replace

import numpy as np

import zonda
from zonda.core.canvas import file_of, new_axes
from zonda.core.maps.map_plots import plot_contours
from zonda.core.maps.map_product import MapProduct
from zonda.core.numerics.sphere import ARCSEC
from zonda.operators.diagnostics.plot_operators import Plots, _snr
from zonda.plugins.checks import scenes


def drawn():
    ax = new_axes((3.0, 2.0))
    ax.plot([0, 1], [0, 1], label="a line")
    ax.imshow(np.arange(4.0).reshape(2, 2))
    ax.legend()
    return ax


def test_the_same_figure_gives_the_same_bytes():
    for kind in ("png", "pdf", "svg"):
        assert file_of(drawn().figure, kind) == file_of(drawn().figure, kind)


def test_text_stays_text():
    svg = file_of(drawn().figure, "svg").decode()
    texts = [
        element.text for element in ET.fromstring(svg).iter("{http://www.w3.org/2000/svg}text")
    ]
    assert "a line" in texts
    assert "<dc:date>" not in svg
    pdf = file_of(drawn().figure, "pdf")
    assert pdf.startswith(b"%PDF-1.")
    assert pdf.rstrip().endswith(b"%%EOF")
    assert b"FontFile2" in pdf  # TrueType
    assert b"CreationDate" not in pdf


def product():
    """A source of 10 sigma in white noise, smoothed with the beam."""
    y, x = np.indices((48, 48)) - 23.5
    rng = np.random.default_rng(1)
    noise, half = 1e-3 * rng.standard_normal((2, 48, 48))
    hits = np.full((48, 48), 10)
    world = {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "CRVAL1": 75.0,
        "CRVAL2": 20.0,
    }
    world |= {
        "CRPIX1": 24.5,
        "CRPIX2": 24.5,
        "CDELT1": -2 / 3600,
        "CDELT2": 2 / 3600,
        "RADESYS": "ICRS",
    }
    signal = noise + 3e-3 * np.exp(-4 * np.log(2) * (x**2 + y**2) * 4 / 20.0**2)
    centre = (float(np.radians(75.0)), float(np.radians(20.0)))
    return MapProduct(
        signal,
        hits,
        hits * 1e5,
        np.full((48, 48), 1e-3),
        half,
        world,
        centre,
        2 * ARCSEC,
        fwhm=9 * ARCSEC,
    )


def test_plots_in_all_formats(tmp_path):
    run = zonda.Data(scenes.scene())
    run.output = tmp_path
    run.products["map"] = product()
    Plots(contours=[-4, 4, 8], formats=["pdf", "svg", "svg"]).finalize(run)
    written = sorted(path.name for path in tmp_path.iterdir())
    assert written == [
        f"{name}.{kind}" for name in ("coverage", "map", "noise_map") for kind in ("pdf", "svg")
    ]
    captions = {p.name: p.caption for p in run.products["pictures"]}
    assert (
        "Contours of the signal-to-noise ratio: −4, 4, 8 σ (negative ones dashed)."
        in captions["map"]
    )
    assert "× white noise, as in half the difference, even − odd scans." in captions["map"]
    assert all(p.png.startswith(b"\x89PNG") for p in run.products["pictures"])  # for the report


def test_resolution_of_png_files(tmp_path):
    sizes = []
    for dpi in (55, 110):
        run = zonda.Data(scenes.scene())
        run.output = tmp_path
        run.products["map"] = product()
        Plots(dpi=dpi).finalize(run)
        sizes.append(int.from_bytes((tmp_path / "map.png").read_bytes()[16:20], "big"))
    assert abs(sizes[1] - 2 * sizes[0]) <= 2


def test_contours_are_of_the_smoothed_map():
    """White noise smoothed with a beam of 4.5 pixels has an SNR of unit rms (some 80 independent
    patches: 8 %), the source about 3 (4 pi sigma^2 / A)^(1/2) 20^2 / (20^2 + 9^2) = 17."""
    style = Plots(contours=[4.0])
    found = product()
    snr, words = _snr(found, style, {"map": found}, "map")
    edge = np.ones((48, 48), bool)
    edge[8:40, 8:40] = False
    assert 0.75 < snr[edge].std() < 1.3
    assert 12 < snr.max() < 22
    assert words.endswith("x white noise, as in half the difference, even - odd scans")
    alone = replace(found, half_difference=None)
    assert _snr(alone, style, {"map": alone}, "map")[1] == "white noise only"


def test_no_contours_where_no_level_is_reached():
    ax = new_axes((3.0, 2.0))
    plot_contours(ax, np.full((4, 4), np.nan), [2.0])
    plot_contours(ax, np.zeros((4, 4)), [2.0])
    assert not ax.collections
    plot_contours(ax, np.arange(16.0).reshape(4, 4), [-2.0, 5.0])
    assert len(ax.collections) == 1
