"""Quick pictures of maps for notebooks; those of reports are made by operators."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from ..types import AnyFloats
from .map_arrays import MapArrays
from .map_plots import draw_beam, plot_plain

SHOWN = 99.5
"""Per cent of the pixels that the colours cover by default."""
FAR = 0.1
"""A map whose lowest brightness is more than this share of its highest is far from zero (one with
the mean emission in it).
"""
PREFIXES = ((1.0, ""), (1e-3, "m"), (1e-6, "u"), (1e-9, "n"))


@dataclass
class Shown:
    """Content of a picture: ``values`` (ny, nx), NaN grey, in ``unit``; ``fwhm`` [rad] of a beam,
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
    """Draw a picture with a colour bar into ``ax`` or a new figure; its Axes. ``limit``: where the
    colours end.
    """
    if ax is None:
        from matplotlib import pyplot as plt

        figure = plt.figure(figsize=(6.4, 5.2), layout="constrained")
        ax = figure.add_subplot(projection=shown.wcs)
    values, unit = shown.values, shown.unit
    low, top, around_zero = _range(values[np.isfinite(values)], limit, shown.around_zero)
    size, letter = 1.0, ""
    if unit in ("K_RJ", "K_CMB"):
        size, letter = next(
            ((s, p) for s, p in PREFIXES if max(abs(low), abs(top)) >= s), PREFIXES[-1]
        )
    colours, limits = "RdBu_r" if around_zero else "viridis", (low / size, top / size)
    label = letter + unit
    plot_plain(values / size, shown.wcs, limits, colours, label, ax=ax, title=shown.title)
    if shown.fwhm > 0:
        draw_beam(ax, shown.wcs, values.shape, shown.fwhm)
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
