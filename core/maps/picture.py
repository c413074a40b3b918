"""Quick pictures of maps for notebooks; those of reports are made by operators."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..types import AnyFloats
from .grid import wcs_grid
from .map_arrays import MapArrays

SHOWN = 99.5
"""Per cent of the pixels that the colours cover by default."""
FAR = 0.1
"""A map whose lowest brightness is more than this share of its highest is far from zero (one with
the mean emission in it).
"""
PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "u"), (1e-9, "n"))


@dataclass
class Shown:
    """What a picture shows: ``values`` (ny, nx), NaN grey, in ``unit``; ``fwhm`` [rad] of a beam,
    0: none.
    """

    values: AnyFloats
    wcs: Any
    unit: str
    title: str = ""
    around_zero: bool = True
    fwhm: float = 0.0


def draw_map(product: MapArrays, ax: Any, plane: str, title: str, limit: float | None) -> Any:
    """`MapProduct.plot`."""
    if product.polarization is not None and plane in ("I", "Q", "U", "P"):
        return draw_map(product.stokes(plane), ax, "signal", title or plane, limit)
    found = product.plane(plane)
    values = np.where(product.hits > 0, found.values[0], np.nan)
    if product.projection != "TAN":
        from .on_plane import on_plane

        flat, wcs = on_plane(product, {plane: values})
        values = flat[plane]
    else:
        wcs = product.wcs
    unit = found.unit or found.fits_unit(product.unit)
    around_zero = found.smoothing == "mean"
    fwhm = product.resolution if plane == "signal" else 0.0
    shown = Shown(values, wcs, unit, title or plane.replace("_", " "), around_zero, fwhm)
    return draw(shown, ax, limit)


def draw(shown: Shown, ax: Any, limit: float | None) -> Any:
    """A picture with a colour bar, in ``ax`` or a new figure; its Axes. ``limit``: where the
    colours end.
    """
    import matplotlib as mpl
    from matplotlib import pyplot as plt

    if ax is None:
        ax = plt.figure(figsize=(6.4, 5.2), layout="constrained").add_subplot(projection=shown.wcs)
    values, wcs, unit = shown.values, shown.wcs, shown.unit
    low, top, around_zero = _range(values[np.isfinite(values)], limit, shown.around_zero)
    size, letter = 1.0, ""
    if unit in ("K_RJ", "K_CMB"):
        size, letter = next(
            ((s, p) for s, p in PREFIXES if max(abs(low), abs(top)) >= s), PREFIXES[-1]
        )
    colours = mpl.colormaps["RdBu_r" if around_zero else "viridis"].with_extremes(bad="0.85")
    picture = ax.imshow(
        values / size,
        origin="lower",
        cmap=colours,
        vmin=low / size,
        vmax=top / size,
        interpolation="nearest",
    )
    ax.figure.colorbar(picture, ax=ax, label=letter + unit)
    if hasattr(ax, "coords"):
        for axis, name in zip(ax.coords, wcs.wcs.ctype, strict=True):
            axis.set_axislabel(
                {"RA--": "right ascension", "DEC-": "declination", "GLON": "l", "GLAT": "b"}.get(
                    name[:4], name
                )
            )
    if shown.fwhm > 0:
        _beam(ax, shown)
    ax.set_title(shown.title)
    return ax


def _range(known: AnyFloats, limit: float | None, around_zero: bool) -> tuple[float, float, bool]:
    """(lowest, highest) brightness of the colours; whether they lie about zero: not those of a map
    that is far from it.
    """
    if not known.size:
        return -(limit or 1.0), limit or 1.0, around_zero
    low, top = (float(v) for v in np.percentile(known, [(100 - SHOWN) / 2, (100 + SHOWN) / 2]))
    if around_zero and low <= FAR * top and top >= FAR * low:
        top = limit or max(abs(low), abs(top)) or 1.0
        return -top, top, True
    top = top if limit is None else limit
    return (low, top, False) if low < top else (low, low + (abs(low) or 1.0), False)


def circle_on_sky(grid: Any, place: Any, diameter: float, **style: Any) -> Any:
    """Circle of ``diameter`` [rad] on the sky about a pixel (x, y) of a grid: a matplotlib Ellipse.

    Pixels off the sky take the metric of the middle of the image.
    """
    from matplotlib.patches import Ellipse

    xx, xy, yy = (float(g) for g in grid.metric(*place))
    if not math.isfinite(xx * yy):
        xx, xy, yy = grid.middle
    turn = 0.5 * math.atan2(2 * xy, xx - yy)  # of the principal axis nearest to x
    if abs(turn) > math.pi / 4:
        turn -= math.copysign(math.pi / 2, turn)
    c, s = math.cos(turn), math.sin(turn)
    along = xx * c * c + 2 * xy * c * s + yy * s * s
    across = xx * s * s - 2 * xy * c * s + yy * c * c
    sizes = diameter / math.sqrt(along), diameter / math.sqrt(across)
    return Ellipse((float(place[0]), float(place[1])), *sizes, angle=math.degrees(turn), **style)


def _beam(ax: Any, shown: Shown) -> None:
    """Draw the beam in the lower left corner: a circle on the sky, in the picture an ellipse."""
    grid = wcs_grid(shown.wcs, (shown.values.shape[0], shown.values.shape[1]))
    corner = np.array([ax.get_xlim()[0], ax.get_ylim()[0]])
    place, style = np.zeros(2), {"facecolor": "white", "edgecolor": "black"}
    for _ in range(2):  # its own size says where it lies
        box = circle_on_sky(grid, place, shown.fwhm).get_extents()
        place = corner + 1.2 * np.array([box.width, box.height])
    ax.add_patch(circle_on_sky(grid, place, shown.fwhm, **style))
