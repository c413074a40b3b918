from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image

from zonda.operators.diagnostics.drawing.png import encoded, png_of


@pytest.mark.parametrize("shape", [(1, 1), (7, 5), (64, 300)])
def test_what_is_encoded_is_read_back(shape):
    pixels = np.random.default_rng(3).integers(0, 256, (*shape, 3), dtype=np.uint8)
    image = Image.open(io.BytesIO(encoded(pixels, 110, {"Software": "zonda"})))
    image.verify()
    image = Image.open(io.BytesIO(encoded(pixels, 110, {"Software": "zonda"})))
    assert image.mode == "RGB"
    assert np.array_equal(np.asarray(image), pixels)
    assert image.info["dpi"] == pytest.approx((110, 110), rel=1e-3)
    assert image.info["Software"] == "zonda"


def figure(kind):
    from matplotlib.figure import Figure

    drawn = Figure(figsize=(4, 3), dpi=100)
    ax = drawn.add_axes((0.25, 0.25, 0.5, 0.5))
    x = np.linspace(1, 50, 80)
    if kind == "image":
        shown = ax.imshow(
            np.ma.masked_less(np.outer(x, x), 30),
            cmap="viridis",
            vmax=2000,
            interpolation="nearest",
            aspect="auto",
        )
        drawn.colorbar(shown, cax=drawn.add_axes((0.78, 0.25, 0.03, 0.5)), extend="max").set_label(
            "value"
        )
    elif kind == "log":
        ax.loglog(x, x**3)
        ax.grid(which="both")
    ax.set_xlabel("abscissa")
    ax.set_ylabel("ordinate")
    ax.set_title("A title")
    return drawn


@pytest.mark.parametrize("kind", ["image", "log"])
def test_the_pixels_are_those_of_savefig(kind):
    stream = io.BytesIO()
    figure(kind).savefig(stream, format="png")
    made = np.asarray(Image.open(io.BytesIO(png_of(figure(kind).axes[0]))))
    assert np.array_equal(made, np.asarray(Image.open(stream))[..., :3])
