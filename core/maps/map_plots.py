"""Pictures of maps and of their coverage, on astropy's world axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..canvas import DPI, PALE, log_labels, unit_of
from ..numerics.angles import angle_text
from ..types import AnyFloats
from .grid import wcs_grid

if TYPE_CHECKING:
    from astropy.wcs import WCS
    from matplotlib.axes import Axes

IMAGE = (4.23, 4.28)
"""Largest width and height of an image, in."""
LONG, THIN = 8.4, 1.05
"""Width of an image of a strip, and the least height or width of one, in; a longer strip is
stretched across.
"""
STRIP = 2.2
"""Width over height from which an image is a strip, with its colour bar below."""
BAR, SECOND, LABELS, TITLE = 0.2, 0.75, 1.05, 4.4
"""Width of a colour bar, room for a second scale of it, for the labels of axes and a title, in."""
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
MOST_TURNED = np.tan(np.radians(30.0))
"""Slope of meridians and parallels to the edges from which an image has lines of both."""


def map_axes(shape: tuple[int, ...], wcs: WCS, count: int = 1, scales: int = 1) -> list[Any]:
    """World axes of a new figure for ``count`` images (ny, nx), each with ``bar_axes`` for its
    colour bar.

    Pixels have the shape that they have on the sky in the middle of the image. Strips are wide, one
    below the other, with their colour bars below; a strip too thin to be seen is stretched, and its
    axis says so. Images side by side have their latitudes written once. ``scales`` (1 or 2) is the
    number of scales of a colour bar.
    """
    import astropy.visualization.wcsaxes  # noqa: F401  (before Figure.add_axes takes a WCS)
    from matplotlib.figure import Figure

    ny, nx = shape
    xx, _, yy = wcs_grid(wcs, (ny, nx)).middle
    across = nx * np.sqrt(xx / yy)  # in the pixels' height
    strip = across > STRIP * ny
    scale = min((LONG if strip else IMAGE[0]) / across, IMAGE[1] / ny)
    width, height = max(across * scale, THIN), max(ny * scale, THIN)
    stretched = width / across / (height / ny)
    beside = 0.1 + (SECOND if scales == 2 and not strip else 0.0)
    pitch = height + 1.7 if strip else max(TITLE, width + beside + BAR + LABELS) + 0.2
    size = (width + 2, count * pitch + 0.5) if strip else (count * pitch + LABELS, height + 2)
    figure = Figure(figsize=size, dpi=DPI)
    upright, whole = _upright(wcs, shape), _all_sky(wcs, shape)

    def place(x: float, y: float, w: float, h: float) -> tuple[float, float, float, float]:
        return x / size[0], y / size[1], w / size[0], h / size[1]

    made = []
    for k in range(count):
        x, y = (1.0, (count - 1 - k) * pitch + 1.2) if strip else (LABELS + k * pitch, 1.0)
        under = 0.7 + (0.3 if scales == 2 else 0.0)
        ax: Any = figure.add_axes(place(x, y, width, height), projection=wcs)
        ax.bar_axes = figure.add_axes(
            place(x + 0.1 * width, y - under, 0.8 * width, 0.14)
            if strip
            else place(x + width + beside, y, BAR, height)
        )
        ax.bar_below = strip
        ax.title_pad = 6.0 if upright or whole else 36.0  # above labels on the upper edge
        _label(ax, upright, whole, latitudes=strip or k == 0 or not upright)
        if not 0.99 < stretched < 1.01:
            name = ax.coords[0].get_axislabel()
            how = f"{1 / stretched:.2g}×" if stretched < 1 else f"{stretched:.2g}×"
            other = f"{names_of(wcs)[1]} " if stretched < 1 else ""
            ax.coords[0].set_axislabel(f"{name}, {other}stretched {how}")
        made.append(ax)
    return made


def wcs_of(header: Any) -> WCS:
    """The celestial WCS of a FITS header."""
    from astropy.wcs import WCS

    return WCS(dict(header), naxis=2).celestial


def names_of(wcs: WCS) -> tuple[str, str, str]:
    """Names of the two axes of a map and of their frame: RA, Dec, ICRS; l, b, Galactic."""
    first, second = wcs.wcs.ctype
    if first.startswith("GLON"):
        return "l", "b", "Galactic"
    if first.startswith("RA"):
        return "RA", "Dec", wcs.wcs.radesys or "ICRS"
    return first.split("-")[0].lower() or "x", second.split("-")[0].lower() or "y", "as in the file"


def _label(ax: Any, upright: bool, whole: bool, latitudes: bool) -> None:
    """Name the axes, and draw meridians and parallels where these do not follow the edges."""
    first, second, frame = names_of(ax.wcs)
    for axis, name, room in zip(ax.coords, (first, second), (0.8, 0.7), strict=True):
        axis.set_axislabel(f"{name} ({frame})", minpad=room if upright else 1.0)
        axis.set_ticklabel(size=9, exclude_overlapping=True, simplify=False)
        if axis.coord_type in ("longitude", "latitude"):
            axis.set_separator("ʰᵐˢ" if name == "RA" else "°′″")
    if not latitudes:
        ax.coords[1].set_ticklabel_visible(False)
        ax.coords[1].set_axislabel("")
    if not upright:
        ax.coords.grid(color="0.4", linewidth=0.6, alpha=0.7)
    if whole:
        _label_lines(ax)
        ax.coords[0].set_axislabel(f"{first} on its lines, {second} on its lines ({frame})")
        ax.coords[0].set_axislabel_visibility_rule("always")
        ax.coords[1].set_axislabel("")


def _label_lines(ax: Any) -> None:
    """Write longitudes on the equator and latitudes on the central meridian of the whole sky."""
    for k, span in enumerate(((0.0, 330.0), (-80.0, 80.0))):
        axis = ax.coords[k]
        axis.set_ticks_visible(False)
        axis.set_ticklabel_visible(False)
        values, spacing = axis.locator(*span)
        texts = axis.formatter(values, spacing)
        middle = float(ax.wcs.wcs.crval[0]) if k else 0.0
        for value, text in zip(values.to_value("deg"), texts, strict=True):
            at = (middle, value) if k else (value, middle)
            x, y = ax.wcs.wcs_world2pix([at], 0)[0]
            ax.text(x, y, text, fontsize=8, ha="center", va="center", zorder=4, bbox=PALE)


def _upright(wcs: WCS, shape: tuple[int, ...]) -> bool:
    """True if meridians run up and parallels across, within 30 deg, all along the edges."""
    ny, nx = shape
    along, h = np.linspace(0.001, 0.999, 33), 1e-3 * min(nx, ny)
    low, high = np.full(33, 0.001), np.full(33, 0.999)
    x = np.concatenate([along, along, low, high]) * nx - 0.5
    y = np.concatenate([low, high, along, along]) * ny - 0.5
    slopes = []
    for dx, dy in ((h, 0.0), (0.0, h)):
        lon0, lat0 = wcs.wcs_pix2world(x - dx, y - dy, 0)
        lon1, lat1 = wcs.wcs_pix2world(x + dx, y + dy, 0)
        east = ((lon1 - lon0 + 180) % 360 - 180) * np.cos(np.radians((lat0 + lat1) / 2))
        slopes += [east, lat1 - lat0]
    east_x, north_x, east_y, north_y = slopes
    one_way = all((s > 0).all() or (s < 0).all() for s in (east_x, north_y))  # False for NaN
    turned = (abs(north_x) > MOST_TURNED * abs(north_y)) | (abs(east_y) > MOST_TURNED * abs(east_x))
    return one_way and not turned.any()


def _all_sky(wcs: WCS, shape: tuple[int, ...]) -> bool:
    """True if the corners of an image are off the sky, as of all-sky projections."""
    ny, nx = shape
    x, y = np.array([0, nx - 1, 0, nx - 1]), np.array([0, 0, ny - 1, ny - 1])
    return not np.isfinite(wcs.wcs_pix2world(x, y, 0)).any()


def plot_map(
    values: AnyFloats,
    wcs: WCS,
    *,
    ax: Any = None,
    title: str = "",
    fwhm: float | None = None,
    limit: float | None = None,
    unit: str = "K_RJ",
) -> Axes:
    """Brightness map with its colour bar and resolution.

    Values around zero have diverging colours, zero in white; those of one sign sequential ones that
    begin at zero. A map far from zero (one with the mean emission still in it) is shown between its
    lowest and highest brightness.

    Parameters
    ----------
    values
        (ny, nx) K_RJ; NaN where nothing was observed (drawn grey).
    wcs
        Its `astropy.wcs.WCS`.
    ax
        World axes to draw into.
    title
        Says what is shown.
    fwhm
        Resolution, rad; drawn to scale.
    limit
        Largest brightness of the colour scale, K; default: what `SHOWN` % of the pixels stay below.
    unit
        Of the values; those in K_RJ are shown in the unit that reads best.
    """
    bottom, top, name = _range_of(values, limit)
    factor, label = unit_of(max(abs(bottom), abs(top)))
    if unit == "K_RJ":
        label = f"Rayleigh–Jeans brightness [{label}]"
    else:
        factor, label = 1.0, f"brightness [{unit}]" if unit else "brightness"
    limits = (bottom * factor, top * factor)
    drawn = plot_plain(values * factor, wcs, limits, name, label, ax=ax, title=title)
    if fwhm:
        draw_beam(drawn, wcs, values.shape, fwhm)
    return drawn


def plot_plain(
    values: AnyFloats,
    wcs: WCS,
    limits: tuple[float, float],
    colours: str,
    label: str,
    *,
    ax: Any = None,
    title: str = "",
) -> Axes:
    """Quantity (ny, nx) of a map, e.g. its SNR, on a linear scale between ``limits``, with the text
    ``label`` at the colour bar.
    """
    from matplotlib.colors import Normalize

    shown = np.ma.masked_invalid(values)
    drawn: Axes = _show(ax, wcs, shown, label, title, colours, Normalize(*limits))
    return drawn


def plot_coverage(
    hits: NDArray[np.integer] | AnyFloats,
    wcs: WCS,
    *,
    title: str = "",
    per_beam: AnyFloats | float | None = None,
) -> Axes:
    """Samples per pixel (ny, nx), pixels without any in grey.

    ``per_beam``: seconds that a sample per pixel gives to a beam, of all pixels or of each; the
    colours then are seconds of all detectors per beam. Where they are the same for all pixels to a
    per cent, a second scale counts the samples per pixel.
    """
    from matplotlib.colors import LogNorm, Normalize

    factor = None if per_beam is None else np.asarray(per_beam, np.float32)
    even = factor is not None and float(factor.max()) <= 1.01 * float(factor.min())
    ax = map_axes(hits.shape, wcs, scales=2 if even else 1)[0]
    seen = np.asarray(hits, np.float32)
    values = seen if factor is None else seen * factor
    used = values[seen > 0]
    top, middle = (float(used.max()), float(np.median(used))) if used.size else (1.0, 1.0)
    least = 1.0 if factor is None else float(used.min()) if used.size else 0.1
    wide = top > 30 * middle
    norm = LogNorm(min(max(least, middle / 30), top / 2), top) if wide else Normalize(0, top)
    label, head = "samples per pixel", "Samples per pixel"
    if factor is not None:
        label, head = "integration time of all detectors [s per beam]", "Integration time per beam"
    shown = np.ma.masked_where(seen <= 0, values)
    _show(ax, wcs, shown, label, title or head, "cividis", norm)
    if factor is not None and even:
        _count_samples(ax, float(factor.mean()))
    return ax  # type: ignore[no-any-return]


def plot_circle(ax: Any, shape: tuple[int, ...], place: Sequence[float], diameter: float) -> None:
    """Draw a dotted circle of ``diameter`` [rad] about a pixel (x, y) of a map (ny, nx)."""
    style = {"fill": False, "edgecolor": "black", "linestyle": ":", "linewidth": 1.2}
    ax.add_patch(circle_on_sky(wcs_grid(ax.wcs, (shape[0], shape[1])), place, diameter, **style))


def plot_contours(ax: Any, snr: AnyFloats, levels: Sequence[float]) -> None:
    """Contours of an SNR (ny, nx) at ``levels`` on an image in pixels; negative ones dashed, all
    with a pale edge.
    """
    from matplotlib.patheffects import withStroke

    order = sorted(levels)
    if not (np.isfinite(snr).any() and np.nanmin(snr) < order[-1] and np.nanmax(snr) > order[0]):
        return
    lines = ax.contour(
        np.ma.masked_invalid(snr),
        levels=order,
        colors="black",
        linewidths=0.8,
        linestyles=["dashed" if level < 0 else "solid" for level in order],
        zorder=4,
    )
    lines.set_path_effects([withStroke(linewidth=1.8, foreground="white", alpha=0.6)])


def contour_text(levels: Sequence[float]) -> str:
    """Levels in words: ``−4, −2, 2, 4 σ``."""
    return ", ".join(f"{level:g}".replace("-", "−") for level in sorted(levels)) + " σ"


def noise_text(words: str, short: bool = False) -> str:
    """Noise of an SNR as pictures write it: ``1.44 × white noise, as in ...``.

    ``short``: without where it was measured.
    """
    text = words.partition(", as in ")[0] if short else words
    return text.replace(" x ", " × ").replace(" - ", " − ")


def _count_samples(ax: Any, per_beam: float) -> None:
    """Add a second scale to the colour bar, in samples per pixel."""
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


def _show(ax: Any, wcs: WCS, values: Any, label: str, title: str, colours: str, norm: Any) -> Any:
    """Draw an image with its title and colour bar into ``ax`` or a new figure; the axes.

    The colour bar has a pointed end where values lie beyond it.
    """
    import matplotlib as mpl

    ax = map_axes(values.shape, wcs)[0] if ax is None else ax
    if hasattr(ax, "coords") and not hasattr(ax, "bar_axes"):
        _label(ax, upright=True, whole=False, latitudes=True)
    picture = ax.imshow(
        values,
        origin="lower",
        interpolation="nearest",
        aspect="auto" if hasattr(ax, "bar_axes") else "equal",
        cmap=mpl.colormaps[colours].with_extremes(bad="0.85"),
        norm=norm,
    )
    low, high = picture.get_clim()
    spare = 1e-6 * (high - low)  # of rounding
    beyond = (
        bool(np.ma.less(values, low - spare).any()),
        bool(np.ma.greater(values, high + spare).any()),
    )
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get(beyond)
    own, under = getattr(ax, "bar_axes", None), getattr(ax, "bar_below", False)
    bar = ax.figure.colorbar(
        picture,
        extend=extend or "neither",
        orientation="horizontal" if under else "vertical",
        **({"ax": ax} if own is None else {"cax": own}),
    )
    if norm.__class__.__name__ == "LogNorm":
        log_labels(bar.ax.xaxis if under else bar.ax.yaxis, low, high)
    bar.set_label(label)
    ax.set_title(title, pad=getattr(ax, "title_pad", None))
    return ax


def draw_beam(ax: Any, wcs: WCS, shape: tuple[int, ...], fwhm: float) -> None:
    """Draw the beam's half-power circle to scale in the lower left corner, with its width.

    A map that is hardly larger than the beam has the width alone.
    """
    grid, (ny, nx) = wcs_grid(wcs, (shape[0], shape[1])), shape
    place, half = np.array([0.05 * nx, 0.05 * ny]), np.zeros(2)
    for _ in range(2):  # its own size says where it lies
        beam = circle_on_sky(grid, place + half, fwhm, facecolor="white", edgecolor="black")
        half = np.array([beam.get_extents().width, beam.get_extents().height]) / 2
    if (2 * half < 0.4 * np.array([nx, ny])).all():
        beam.set_zorder(5)
        ax.add_patch(beam)
    else:
        half = np.zeros(2)
    ax.annotate(
        f"FWHM {angle_text(fwhm)}",
        (place[0] + 2 * half[0], place[1] + half[1]),
        xytext=(6, 0),
        textcoords="offset points",
        va="center",
        fontsize=8,
        zorder=5,
        bbox=PALE,
    )


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
