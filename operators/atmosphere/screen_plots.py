"""`Screens`: the layers at a moment and the PWV over the field, and their pictures."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from zonda.core.canvas import Sketch
from zonda.core.types import Floats

ACROSS = (4, 5, 3)
"""Panels in a row: what leaves the fewest places empty."""
SIDE = 3.1
"""Of a panel with its labels, in."""
MARGINS = (0.72, 0.62, 0.84, 0.42)
"""Left, bottom, right and top of each panel, in."""
COLOURS = "RdBu_r"


@dataclass(frozen=True)
class LayerScreen:
    """One layer about the point that the boresight looks through at a moment.

    Attributes
    ----------
    height, distance
        Of the layer, and along the line of sight, m.
    wind
        (east, north), m/s.
    values
        (n_along, n_across) fluctuation of the PWV at zenith in this layer, m: p a_l g_l PWV.
    spacing
        Between the values, m.
    track
        (n, 2) across and along the wind, m, where the boresight passes through the layer during the
        scan; 0 at the moment.
    fwhm, field
        Width of the beam there, and diameter of the field of view, m.
    """

    height: float
    distance: float
    wind: tuple[float, float]
    values: Floats
    spacing: float
    track: Floats
    fwhm: float
    field: float


@dataclass(frozen=True)
class Screens:
    """The layers at a moment, and the PWV over the field of view at several.

    Attributes
    ----------
    layers
        From the lowest up.
    moment
        Of ``layers``, s since the scan's start.
    seconds
        (k,) of ``pwv``, s since the scan's start.
    pwv
        (k, n, n) fluctuation of the PWV along the line of sight, m; rows eta, columns xi; NaN
        beyond the field.
    side
        Of the field, rad.
    mean_pwv
        At zenith, m.
    observation
        Name of the scan.
    """

    layers: list[LayerScreen]
    moment: float
    seconds: Floats
    pwv: Floats
    side: float
    mean_pwv: float
    observation: str

    def sketches(self, name: str) -> list[Sketch]:
        """See `core.drawable.Drawable`."""
        return sketches(name, self)


def sketches(name: str, found: Screens) -> list[Sketch]:
    """The layers, and the strip."""
    layers = _grid(len(found.layers))
    for ax, layer in zip(layers, found.layers, strict=True):
        _layer(ax, layer)
    text = (
        f"PWV fluctuation (at zenith) in each simulated layer, {found.moment:.3g} s after the start"
        f" of {found.observation}, in the frame that drifts with the layer's wind (arrow). Line:"
        " where the boresight passes through the layer in the scan; cross: at this moment; solid"
        " circle: the beam (FWHM); dotted: the field of view."
    )
    strip = _grid(len(found.seconds))
    half = math.degrees(found.side) * 30
    for ax, second, pwv in zip(strip, found.seconds, found.pwv, strict=True):
        change = pwv - np.nanmean(pwv)
        _image(ax, change, half, f"{second:.3g} s, mean {np.nanmean(pwv) * 1e6:+.3g} µm")
        ax.set_xlabel("xi [arcmin]", fontsize=9)
        ax.set_ylabel("eta [arcmin]", fontsize=9)
    caption = (
        "Fluctuation of the PWV along the line of sight [µm] over the field of view of"
        f" {found.observation}, minus its mean over the field, which each title states. Mean PWV"
        f" {found.mean_pwv * 1e3:.3g} mm."
    )
    return [
        Sketch(f"{name}_layers", "Turbulent layers", text, layers[0]),
        Sketch(f"{name}_field", "PWV over the field", caption, strip[0]),
    ]


def _grid(count: int) -> list[Any]:
    """``count`` square axes in rows."""
    from matplotlib.figure import Figure

    left, bottom, right, top = MARGINS
    columns = min(count, min(ACROSS, key=lambda n: -count % n))
    rows = -(-count // columns)
    inner = SIDE - left
    width, height = columns * (SIDE + right), rows * (inner + bottom + top)
    figure = Figure(figsize=(width, height), dpi=110)
    made = []
    for k in range(count):
        x, y = (
            (k % columns) * (SIDE + right) + left,
            height - (k // columns + 1) * (inner + bottom + top) + bottom,
        )
        made.append(figure.add_axes((x / width, y / height, inner / width, inner / height)))
    return made


def _image(ax: Any, values: Any, half: float, title: str) -> None:
    """Values [m] in µm, with a colour bar of its own, zero in white."""
    shown = np.ma.masked_invalid(values * 1e6)
    top = float(np.abs(shown).max()) or 1.0
    picture = ax.imshow(
        shown, origin="lower", extent=(-half, half, -half, half), cmap=COLOURS, vmin=-top, vmax=top
    )
    box = ax.get_position()
    figure = ax.figure
    bar = figure.add_axes(
        (box.x1 + 0.06 / figure.get_figwidth(), box.y0, 0.07 / figure.get_figwidth(), box.height)
    )
    figure.colorbar(picture, cax=bar).set_label("change of the PWV [µm]", fontsize=9, labelpad=5)
    bar.tick_params(labelsize=8.5, pad=1)
    ax.tick_params(labelsize=8.5)
    ax.locator_params(nbins=5)
    ax.set_title(title, fontsize=10, y=1.0)


def _layer(ax: Any, layer: LayerScreen) -> None:
    from matplotlib.patches import Circle

    n = layer.values.shape[0]
    half = n * layer.spacing / 2
    speed = math.hypot(*layer.wind)
    azimuth = math.degrees(math.atan2(*layer.wind)) % 360
    _image(
        ax, layer.values, half, f"{layer.height:.0f} m, wind {speed:.3g} m/s towards {azimuth:.0f}°"
    )
    ax.plot(*layer.track.T, color="black", linewidth=0.6)
    here = layer.track[np.abs(layer.track).sum(axis=1).argmin()]
    ax.plot(*here, "x", color="black", markersize=5)
    ax.add_patch(Circle(tuple(here), layer.fwhm / 2, fill=False, edgecolor="black", linewidth=1.0))
    ax.add_patch(
        Circle(
            tuple(here),
            layer.field / 2,
            fill=False,
            edgecolor="black",
            linewidth=1.0,
            linestyle=":",
        )
    )
    ax.annotate(
        "",
        (-0.86 * half, 0.9 * half),
        (-0.86 * half, 0.5 * half),
        arrowprops={"arrowstyle": "-|>", "linewidth": 1.4},
    )
    ax.set_xlim(-half, half)
    ax.set_ylim(-half, half)
    ax.set_xlabel("across the wind [m]", fontsize=9)
    ax.set_ylabel("along the wind [m]", fontsize=9)
