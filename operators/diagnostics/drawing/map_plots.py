"""Pictures of maps and of their coverage."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.maps.planes import Plane
from zonda.core.numerics.angles import ARCMIN, angle_text
from zonda.core.types import AnyFloats

from .canvas import PALE, log_labels, unit_of, write_title
from .graticule import AstropyAxes
from .map_layout import located, map_axes, sky_steps
from .sky_axes import SkyAxes

if TYPE_CHECKING:
    from matplotlib.axes import Axes

SHOWN = 99.95
"""Per cent of the pixels of a noise-free map that its colour scale covers."""
ONE_SIDED = 0.05
"""A sky whose values of one sign reach this share of those of the other has a scale that begins or
ends near zero.
"""
POSITIVE, NEGATIVE, FAR = "inferno", "Blues_r", "viridis"
"""Colours of positive skies, of negative ones (as in the diverging scale), and of maps far from
zero.
"""


def plot_map(
    values: AnyFloats,
    wcs: Any,
    *,
    ax: Any = None,
    title: str = "",
    fwhm: float | None = None,
    limit: float | None = None,
    unit: str = "K_RJ",
) -> Axes:
    """A brightness map in K_RJ with its colour bar and resolution.

    Values around zero have diverging colours, zero in white; those of one sign sequential ones that
    begin at zero. A map far from zero (one with the mean emission still in it) is shown between its
    lowest and highest brightness.

    Parameters
    ----------
    values
        (ny, nx) K_RJ; NaN where nothing was observed (drawn grey).
    wcs
        Its `astropy.wcs.WCS`, FITS header or `SkyAxes`; a new figure gets tick marks in longitude
        and latitude, a plain ``ax`` offsets from the centre in arcmin, one of astropy's world axes
        its own.
    ax
        Axes to draw into.
    title
        Says what is shown.
    fwhm
        Resolution, rad; drawn to scale.
    limit
        Largest brightness of the colour scale, K; default: what `SHOWN` % of the pixels stay below.
    unit
        Of the values; those in K_RJ are shown in the unit that reads best.
    """
    import matplotlib as mpl

    axes = located(wcs)
    ax = map_axes(values.shape, axes)[0] if ax is None else ax
    bottom, top, name = _range_of(values, limit)
    factor, label = unit_of(max(abs(bottom), abs(top)))
    factor, label = (
        (factor, f"Rayleigh–Jeans brightness [{label}]")
        if unit == "K_RJ"
        else (1.0, f"brightness [{unit}]")
    )
    shown = np.ma.masked_invalid(values * factor)
    style = {
        "vmin": bottom * factor,
        "vmax": top * factor,
        "cmap": mpl.colormaps[name].with_extremes(bad="0.85"),
    }
    _show(ax, axes, shown, label if unit else "brightness", **style)
    if fwhm:
        _draw_beam(ax, _scales(ax, axes, values.shape), fwhm)
    _head(ax, title)
    return ax  # type: ignore[no-any-return]


def plot_circle(ax: Any, wcs: Any, shape: tuple[int, ...], diameter: float) -> None:
    """A dotted circle of ``diameter`` [rad] about the centre of a map (ny, nx) that is drawn in
    ``ax``.
    """
    from matplotlib.patches import Ellipse

    axes = located(wcs)
    width, height = (diameter / scale for scale in _scales(ax, axes, shape))
    ax.add_patch(
        Ellipse(
            _centre(ax, axes, shape),
            width,
            height,
            fill=False,
            edgecolor="black",
            linestyle=":",
            linewidth=1.2,
        )
    )


def plot_plain(
    values: AnyFloats,
    wcs: Any,
    limits: tuple[float, float],
    colours: str,
    label: str,
    *,
    ax: Any = None,
    title: str = "",
) -> Axes:
    """A quantity (ny, nx) of a map, e.g. its SNR, on a linear scale between ``limits``. ``label``:
    what the colour bar says.
    """
    import matplotlib as mpl

    axes = located(wcs)
    ax = map_axes(values.shape, axes)[0] if ax is None else ax
    style = {
        "vmin": limits[0],
        "vmax": limits[1],
        "cmap": mpl.colormaps[colours].with_extremes(bad="0.85"),
    }
    _show(ax, axes, np.ma.masked_invalid(values), label, **style)
    _head(ax, title)
    return ax  # type: ignore[no-any-return]


def plot_contours(ax: Any, snr: AnyFloats, levels: Sequence[float]) -> None:
    """Contours of an SNR (ny, nx) at ``levels`` on an image in pixels; negative ones dashed, all
    with a pale edge.
    """
    from matplotlib.patheffects import withStroke

    order = sorted(levels)
    if not (np.isfinite(snr).any() and np.nanmin(snr) < order[-1] and np.nanmax(snr) > order[0]):
        return
    kinds = ["dashed" if level < 0 else "solid" for level in order]
    lines = ax.contour(
        np.ma.masked_invalid(snr),
        levels=order,
        colors="black",
        linewidths=0.8,
        linestyles=kinds,
        zorder=4,
    )
    lines.set_path_effects([withStroke(linewidth=1.8, foreground="white", alpha=0.6)])


def contour_text(levels: Sequence[float]) -> str:
    """``−4, −2, 2, 4 σ``."""
    return ", ".join(f"{level:g}".replace("-", "−") for level in sorted(levels)) + " σ"


def noise_text(words: str, short: bool = False) -> str:
    """What the noise of an SNR is, as pictures write it: ``1.44 × white noise, as in ...``.

    ``short``: without where it was measured.
    """
    return (
        (words.partition(", as in ")[0] if short else words)
        .replace(" x ", " × ")
        .replace(" - ", " − ")
    )


def plot_coverage(
    hits: NDArray[np.integer] | AnyFloats,
    wcs: Any,
    *,
    ax: Any = None,
    title: str = "",
    per_beam: AnyFloats | float | None = None,
) -> Axes:
    """Where the telescope looked: samples per pixel (ny, nx), pixels without any in grey. Other
    arguments as `plot_map`.

    ``per_beam``: seconds that a sample per pixel gives to a beam, of all pixels or of each; the
    colours then are seconds of all detectors per beam. Where they are the same for all pixels to a
    per cent, a second scale counts the samples per pixel.
    """
    import matplotlib as mpl
    from matplotlib.colors import LogNorm, Normalize

    axes = located(wcs)
    factor = None if per_beam is None else np.asarray(per_beam, np.float32)
    even = factor is None or float(factor.max()) <= 1.01 * float(factor.min())
    ax = (
        map_axes(hits.shape, axes, scales=2 if factor is not None and even else 1)[0]
        if ax is None
        else ax
    )
    seen = np.asarray(hits, np.float32)
    values = seen if factor is None else seen * factor
    colours = mpl.colormaps["cividis"].with_extremes(bad="0.85")
    used = values[seen > 0]
    top, middle = (float(used.max()), float(np.median(used))) if used.size else (1.0, 1.0)
    least = 1.0 if factor is None else float(used.min()) if used.size else 0.1
    scale = (
        LogNorm(min(max(least, middle / 30), top / 2), top)
        if top > 30 * middle
        else Normalize(0, top)
    )
    label = (
        "samples per pixel" if factor is None else "integration time of all detectors [s per beam]"
    )
    _show(ax, axes, np.ma.masked_where(seen <= 0, values), label, cmap=colours, norm=scale)
    if factor is not None and even and hasattr(ax, "bar_axes"):
        _count_samples(ax, float(factor.mean()))
    _head(ax, title or ("Samples per pixel" if factor is None else "Integration time per beam"))
    return ax  # type: ignore[no-any-return]


def plot_plane(
    values: AnyFloats, wcs: Any, plane: Plane, *, ax: Any = None, title: str = ""
) -> Axes:
    """Numbers (ny, nx) without unit, NaN in grey, in the colours of their ``plane``. Other
    arguments as `plot_map`.
    """
    import matplotlib as mpl

    axes = located(wcs)
    ax = map_axes(values.shape, axes)[0] if ax is None else ax
    colours = mpl.colormaps["cividis_r"].with_extremes(bad="0.85")
    scale = mpl.colors.Normalize(*(plane.colours or (None, None)))
    _show(ax, axes, np.ma.masked_invalid(values), plane.unit, cmap=colours, norm=scale)
    _head(ax, title or plane.title)
    return ax  # type: ignore[no-any-return]


def _count_samples(ax: Any, per_beam: float) -> None:
    """A second scale of the colour bar, in samples per pixel."""
    bar = ax.bar_axes
    both = (lambda seconds: seconds / per_beam), (lambda samples: samples * per_beam)
    if ax.bar_below:
        second = bar.secondary_xaxis("top", functions=both)
        second.set_xlabel("samples per pixel", fontsize=8, labelpad=2)
        axis, limits = second.xaxis, bar.get_xlim()
    else:
        second = bar.secondary_yaxis("left", functions=both)
        second.set_ylabel("samples per pixel", fontsize=9)
        axis, limits = second.yaxis, bar.get_ylim()
    second.tick_params(labelsize=8)
    if ax.images[0].norm.__class__.__name__ == "LogNorm":
        log_labels(axis, *(edge / per_beam for edge in limits))


def _range_of(values: AnyFloats, limit: float | None) -> tuple[float, float, str]:
    """Lowest and highest brightness of the colours, and their name."""
    finite = values[np.isfinite(values)]
    if limit is None:
        limit = float(np.percentile(np.abs(finite), SHOWN)) if finite.size else 1.0
    low, high = (
        (float(p) for p in np.percentile(finite, (100 - SHOWN, SHOWN)))
        if finite.size
        else (0.0, 0.0)
    )
    if low == high and finite.size:  # a source of a few pixels
        low, high = float(finite.min()), float(finite.max())
    limit = limit or max(abs(low), abs(high)) or 1.0
    if low * high > 0 and 0 < high - low < 0.5 * max(abs(low), abs(high)):
        return low, high, FAR
    if low >= -ONE_SIDED * high and high > 0:
        return min(low, 0.0), limit, POSITIVE
    if high <= -ONE_SIDED * low and low < 0:
        return -limit, max(high, 0.0), NEGATIVE
    return -limit, limit, "RdBu_r"


def _is_world(ax: Any) -> bool:
    """Whether positions on ``ax`` are pixels: world axes of astropy's, or those of `map_axes`."""
    return hasattr(ax, "bar_axes") or (hasattr(ax, "coords") and hasattr(ax, "wcs"))


def _head(ax: Any, title: str) -> None:
    write_title(ax, title, getattr(ax, "title_pad", None), getattr(ax, "title_room", None))


def _show(ax: Any, axes: SkyAxes | AstropyAxes, values: Any, label: str, **style: Any) -> Any:
    """An image with a colour bar, in pixels on world axes, else on offsets from the map's centre in
    arcmin.

    The colour bar has a pointed end where values lie beyond it.
    """
    ny, nx = values.shape
    lon, lat, frame = axes.names
    flip = -1 if axes.matrix[0, 0] < 0 else 1
    if hasattr(ax, "bar_axes"):
        picture = ax.imshow(values, origin="lower", interpolation="nearest", aspect="auto", **style)
        ax.set_xlim(-0.5, nx - 0.5)
        ax.set_ylim(-0.5, ny - 0.5)
        ax.set_xlabel(ax.sky_names[0])
        ax.set_ylabel(ax.sky_names[1] if ax.names_latitude else "")
    elif _is_world(ax):
        picture = ax.imshow(values, origin="lower", interpolation="nearest", **style)
        ax.coords[0].set_axislabel(f"{lon} ({frame})")
        ax.coords[1].set_axislabel(f"{lat} ({frame})", minpad=0.4)
        for coordinate in ax.coords:
            coordinate.set_ticklabel(size=9)
    else:
        dx, dy = (60 * step for step in sky_steps(axes, values.shape))
        half_x, half_y = nx * dx / 2 * flip, ny * dy / 2
        extent = (-half_x, half_x, -half_y, half_y)
        picture = ax.imshow(
            values, origin="lower", extent=extent, interpolation="nearest", aspect="equal", **style
        )
        ax.set_xlabel(f"{lon} offset [arcmin]")
        ax.set_ylabel(f"{lat} offset [arcmin]")
    low, high = picture.get_clim()
    below, above = bool(np.ma.less(values, low).any()), bool(np.ma.greater(values, high).any())
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(
        (below, above), "neither"
    )
    own, under = getattr(ax, "bar_axes", None), getattr(ax, "bar_below", False)
    place = {"ax": ax, "pad": 0.02, "shrink": 0.9} if own is None else {"cax": own}
    bar = ax.figure.colorbar(
        picture, extend=extend, orientation="horizontal" if under else "vertical", **place
    )
    if picture.norm.__class__.__name__ == "LogNorm":
        log_labels(bar.ax.xaxis if under else bar.ax.yaxis, low, high)
    bar.set_label(label)
    return picture


def _centre(ax: Any, axes: SkyAxes | AstropyAxes, shape: tuple[int, ...]) -> tuple[float, float]:
    """Where the map's centre is: the reference point of its projection in pixels, else the
    middle.
    """
    if not _is_world(ax):
        return 0.0, 0.0
    middle = (shape[1] - 1) / 2, (shape[0] - 1) / 2
    return axes.reference if isinstance(axes, SkyAxes) and axes.projection != "CAR" else middle


def _scales(ax: Any, axes: SkyAxes | AstropyAxes, shape: tuple[int, ...]) -> Any:
    """rad per unit of the axes, along x and y."""
    return np.radians(sky_steps(axes, shape)) if _is_world(ax) else (ARCMIN, ARCMIN)


def _draw_beam(ax: Any, scales: Any, fwhm: float) -> None:
    """The beam's half-power circle in the lower left corner, to scale. ``scales``: of `_scales`."""
    from matplotlib.patches import Ellipse

    width, height = (fwhm / scale for scale in scales)
    x0, x1 = ax.get_xlim()
    y0, y1 = ax.get_ylim()
    sign = 1 if x1 > x0 else -1
    margin_x, margin_y = 0.05 * abs(x1 - x0) + width / 2, 0.05 * abs(y1 - y0) + height / 2
    if width > 0.4 * abs(x1 - x0) or height > 0.4 * abs(
        y1 - y0
    ):  # a map that is hardly larger than the beam
        width, margin_x, margin_y = 0.0, 0.03 * abs(x1 - x0), 0.06 * abs(y1 - y0)
    centre = (x0 + sign * margin_x, y0 + margin_y)
    if width:
        ax.add_patch(
            Ellipse(
                centre, width, height, facecolor="white", edgecolor="black", linewidth=1.0, zorder=5
            )
        )
    ax.annotate(
        f"FWHM {angle_text(fwhm)}",
        (centre[0] + sign * (width * 0.5), centre[1]),
        xytext=(6, 0),
        textcoords="offset points",
        va="center",
        fontsize=8,
        zorder=5,
        bbox=PALE,
    )
