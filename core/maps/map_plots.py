"""Pictures of maps and of their coverage, on astropy's world axes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..canvas import DPI, PALE, log_labels, unit_of
from ..configuration.diagnostics import nearest
from ..errors import InputError
from ..numerics.sphere import angle_text
from ..types import AnyFloats
from .grid import wcs_grid
from .map_arrays import MapArrays, on_plane

if TYPE_CHECKING:
    from astropy.wcs import WCS
    from matplotlib.axes import Axes

IMAGE, LONG = 4.25, 8.4
"""Largest width or height of an image, and width of a strip, in."""
STRIP, TALL = 8.0, 4.0
"""Width over height, and height over width, beyond which an image is stretched."""
WIDE = 2.2
"""Width over height from which an image has its colour bar below."""
LEFT, INNER, BELOW, ABOVE = 1.15, 0.35, 0.7, 0.5
"""Margins of an image, in: with latitudes, without, with longitudes, with a title of two lines."""
BAR, NEAR, FAR_OFF, TEXT = 0.14, 0.12, 0.8, 1.3
"""Width of a colour bar; its distance from the image, and that with a second scale between; space
for its numbers and label, in."""
SHOWN = 99.95
"""Per cent of the pixels of a noise-free map that its colour scale covers."""
ONE_SIDED = 0.25
"""A sky whose values of one sign reach this share of those of the other has sequential colours: a
source, with the bowl that filters leave around it.
"""
SIGNED = "RdBu_r"
"""Colours of residuals, noise, and skies of both signs: zero is white."""
POSITIVE, NEGATIVE, FAR = "inferno", "Blues_r", "viridis"
"""Colours of positive skies, of negative ones (as in the diverging scale), and of maps far from
zero.
"""


@dataclass(frozen=True)
class Look:
    """Colours of a map's picture, as a user wants them; None: chosen by the values.

    Attributes
    ----------
    colours
        Name of one of matplotlib's colour maps.
    limits
        Where the colours begin and end, in the map's unit.
    stretch
        ``linear``, ``sqrt`` (of the distance from the lower limit), ``asinh`` (linear within a
        twentieth of the larger limit) or ``log`` (three decades, unless the lower limit is
        positive).
    scale_bar
        Length of a bar on the sky, rad; 0: none.
    """

    colours: str | None = None
    limits: tuple[float, float] | None = None
    stretch: str = "linear"
    scale_bar: float = 0.0

    def check(self, place: str) -> None:
        """Raise InputError for colours that matplotlib has not, limits that are none, and another
        stretch.
        """
        from matplotlib import colormaps

        if self.colours is not None and self.colours not in colormaps:
            cure = nearest(self.colours, colormaps) or "e.g. inferno, viridis, RdBu_r"
            raise InputError(f"no colour map {self.colours!r}", place=place, cure=cure)
        cure = "give the lower, then the upper, numbers in the map's unit"
        try:
            low, high = (0.0, 1.0) if self.limits is None else map(float, self.limits)
        except (TypeError, ValueError):
            raise InputError(f"{self.limits!r} are no limits", place=place, cure=cure) from None
        if not (math.isfinite(low) and math.isfinite(high) and low < high):
            raise InputError(f"{low:g} to {high:g} are no limits", place=place, cure=cure)
        if self.stretch not in STRETCHES:
            cure = f"choose from: {', '.join(STRETCHES)}"
            raise InputError(f"no stretch {self.stretch!r}", place=place, cure=cure)

    def norm(self, low: float, high: float) -> Any:
        """Normalization of values between two limits."""
        from matplotlib import colors

        if self.stretch == "sqrt":
            return colors.PowerNorm(0.5, low, high)
        if self.stretch == "asinh":
            return colors.AsinhNorm(0.05 * max(abs(low), abs(high)), low, high)
        if self.stretch == "log" and high > 0:
            return colors.LogNorm(low if low > 0 else 1e-3 * high, high, clip=False)
        return colors.Normalize(low, high)


BESIDE: Any = {"textcoords": "offset points", "fontsize": 8, "zorder": 5, "bbox": PALE}
"""Style of the text at a beam or a scale bar."""
STRETCHES = ("linear", "sqrt", "asinh", "log")
AS_IT_IS = Look()


def map_axes(
    shape: tuple[int, ...],
    wcs: WCS,
    count: int = 1,
    figure: Any = None,
    gap: float = NEAR,
) -> list[Any]:
    """World axes of a new figure (or ``figure``) for ``count`` images (ny, nx): strips one below
    the other, others side by side, with their latitudes written once. ``gap``: between an image and
    its colour bar, in. `bar_place` of the axes is the rectangle for the colour bar.
    """
    from astropy.visualization.wcsaxes import WCSAxes
    from matplotlib.figure import Figure

    width, height, _ = _proportions(wcs, shape)
    strip = width > WIDE * height
    scale = min((LONG if strip else IMAGE) / width, IMAGE / height)
    width = scale * width
    height = scale * height
    if strip:
        below = BELOW + gap + BAR + BELOW
        step = 0.0, ABOVE + height + below
        size = LEFT + width + INNER, count * step[1]
    else:
        below = BELOW
        step = (width + gap + BAR + TEXT + INNER, 0.0)
        size = LEFT - INNER + count * step[0], ABOVE + height + below
    figure = Figure(dpi=DPI) if figure is None else figure
    figure.set_size_inches(*size)

    def part(x: float, y: float, wide: float, high: float) -> list[float]:
        return [x / size[0], y / size[1], wide / size[0], high / size[1]]

    axes = []
    for k in range(count):
        x = LEFT + k * step[0]
        y = below + (count - 1 - k) * step[1]
        ax = figure.add_axes(WCSAxes(figure, part(x, y, width, height), wcs=wcs))
        ax.inner = k > 0 and not strip
        beside = (x + width + gap, y, BAR, height)
        ax.bar_place = part(*((x, y - BELOW - gap - BAR, width, BAR) if strip else beside))
        axes.append(ax)
    return axes


def _proportions(wcs: WCS, shape: tuple[int, ...]) -> tuple[float, float, float]:
    """Width and height of an image on the sky, in pixels' heights, and by how much it is stretched
    across: a strip is at least as wide or high as `TALL` and `STRIP` say.
    """
    xx, _, yy = wcs_grid(wcs, shape).middle
    across = shape[1] * math.sqrt(xx / yy)
    ratio = across / shape[0]
    stretched = min(max(ratio, 1 / TALL), STRIP) / ratio
    return across * stretched, float(shape[0]), stretched


def wcs_of(header: Any) -> WCS:
    """The celestial WCS of a FITS header."""
    from astropy.wcs import WCS

    return WCS(dict(header), naxis=2).celestial


def _label(ax: Any, shape: tuple[int, ...], stretched: float) -> None:
    """Name the axes, and draw meridians and parallels. On images of the whole sky, whose corners
    are off it, longitudes are written on the equator and latitudes on the central meridian.
    """
    wcs = ax.wcs
    names = [kind.split("-")[0].lower() for kind in wcs.wcs.ctype]
    frame = "as in the file"
    if names[0] == "glon":
        names = ["l", "b"]
        frame = "Galactic"
    elif names[0] == "ra":
        names = ["RA", "Dec"]
        frame = wcs.wcs.radesys or "ICRS"
    more = f", {'' if stretched > 1 else names[1] + ' '}stretched "
    more += f"{max(stretched, 1 / stretched):.2g}×"
    ax.coords.grid(color="0.4", linewidth=0.6, alpha=0.7)
    corners = np.array([0, shape[1] - 1, 0, shape[1] - 1]), np.array([0, 0, *[shape[0] - 1] * 2])
    whole = not np.isfinite(wcs.wcs_pix2world(*corners, 0)).any()
    for k, (axis, name) in enumerate(zip(ax.coords, names, strict=True)):
        axis.set_ticklabel(size=9, exclude_overlapping=True, simplify=False)
        axis.set_axislabel(f"{name} ({frame}){'' if k or 0.99 < stretched < 1.01 else more}")
        if axis.coord_type in ("longitude", "latitude"):
            axis.set_separator("ʰᵐˢ" if name == "RA" else "°′″")
        if not whole:
            continue
        axis.set_ticks_visible(False)
        axis.set_ticklabel_visible(False)
        values, spacing = axis.locator(*((-80.0, 80.0) if k else (0.0, 330.0)))
        middle = float(wcs.wcs.crval[0]) if k else 0.0
        for value, text in zip(
            values.to_value("deg"),
            axis.formatter(values, spacing),
            strict=True,
        ):
            x, y = wcs.wcs_world2pix([(middle, value) if k else (value, middle)], 0)[0]
            ax.text(x, y, text, fontsize=8, ha="center", va="center", zorder=4, bbox=PALE)
    if getattr(ax, "inner", False):
        ax.coords[1].set_ticklabel_visible(False)
        ax.coords[1].set_axislabel("")
    if whole:
        ax.coords[0].set_axislabel_visibility_rule("always")
        ax.coords[0].set_axislabel(f"{names[0]} and {names[1]} on their lines ({frame})")
        ax.coords[1].set_axislabel("")


def draw_map(
    product: MapArrays,
    ax: Any,
    plane: str,
    title: str,
    limit: float | None,
    look: Look,
) -> Any:
    """`MapProduct.plot`."""
    look.check("map.plot")
    if product.polarization is not None and plane in ("I", "Q", "U", "P"):
        return draw_map(product.stokes(plane), ax, "signal", title or plane, limit, look)
    found = product.plane(plane)
    title = title or plane.replace("_", " ")
    shown, wcs = on_plane(product, {plane: np.where(product.hits > 0, found.values[0], np.nan)})
    values = shown[plane]
    ax = notebook_axes(values.shape, wcs) if ax is None else ax
    if found.smoothing == "mean":
        more: dict[str, Any] = {"fwhm": product.resolution, "unit": product.unit}
        return plot_map(values, wcs, ax=ax, title=title, limit=limit, look=look, **more)
    known = values[np.isfinite(values)]
    limits = float(known.min(initial=0.0)), limit or float(known.max(initial=0.0))
    unit = found.unit or found.fits_unit(product.unit)
    colours = look.colours or FAR
    limits = look.limits or limits
    return plot_plain(values, wcs, limits, colours, unit, ax=ax, title=title, look=look)


def notebook_axes(shape: tuple[int, ...], wcs: WCS) -> Any:
    """World axes of a figure of pyplot, which notebooks show."""
    from matplotlib import pyplot as plt

    return map_axes(shape, wcs, figure=plt.figure())[0]


def plot_map(
    values: AnyFloats,
    wcs: WCS,
    *,
    ax: Any = None,
    title: str = "",
    fwhm: float | None = None,
    limit: float | None = None,
    unit: str = "K_RJ",
    look: Look = AS_IT_IS,
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
    look
        Colours, limits, stretch and scale bar.
    """
    bottom, top, name = range_of(values, limit)
    if look.limits is not None:
        bottom, top = look.limits
        name = _colours_of(bottom, top)
    name = look.colours or name
    factor, label = unit_of(max(abs(bottom), abs(top)))
    if unit == "K_RJ":
        label = f"Rayleigh–Jeans brightness [{label}]"
    else:
        factor = 1.0
        label = f"brightness [{unit}]" if unit else "brightness"
    limits = (bottom * factor, top * factor)
    drawn = plot_plain(values * factor, wcs, limits, name, label, ax=ax, title=title, look=look)
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
    look: Look = AS_IT_IS,
) -> Axes:
    """Quantity (ny, nx) of a map, e.g. its SNR, between ``limits``, with the text ``label`` at the
    colour bar; of a ``look`` stretch and scale bar.
    """
    shown = np.ma.masked_invalid(values)
    drawn: Axes = _show(ax, wcs, shown, label, title, colours, look.norm(*limits))
    if look.scale_bar:
        draw_scale(drawn, wcs, values.shape, look.scale_bar)
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

    factor = np.asarray(1.0 if per_beam is None else per_beam, np.float32)
    shown = np.ma.masked_where(hits <= 0, np.asarray(hits, np.float32) * factor)
    used = shown.compressed()
    top, middle = (float(used.max()), float(np.median(used))) if used.size else (1.0, 1.0)
    norm: Any = Normalize(0, top)
    if top > 30 * middle:
        norm = LogNorm(min(max(float(used.min()), middle / 30), top / 2), top)
    label = "samples per pixel"
    head = "Samples per pixel"
    if per_beam is not None:
        label = "integration time of all detectors [s per beam]"
        head = "Integration time per beam"
    two = per_beam is not None and float(factor.max()) <= 1.01 * float(factor.min())
    ax = map_axes(hits.shape, wcs, gap=FAR_OFF if two else NEAR)[0]
    _show(ax, wcs, shown, label, title or head, "cividis", norm)
    if two:
        _count_samples(ax.images[0].colorbar, float(factor.mean()))
    return ax  # type: ignore[no-any-return]


def plot_circle(ax: Any, shape: tuple[int, ...], place: Sequence[float], diameter: float) -> None:
    """Draw a dotted circle of ``diameter`` [rad] about a pixel (x, y) of a map (ny, nx)."""
    style = {"fill": False, "edgecolor": "black", "linestyle": ":", "linewidth": 1.2}
    ax.add_patch(circle_on_sky(wcs_grid(ax.wcs, shape), place, diameter, **style))


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


def _count_samples(bar: Any, per_beam: float) -> None:
    """Add a second scale to the colour bar, in samples per pixel."""
    both = (lambda seconds: seconds / per_beam), (lambda samples: samples * per_beam)
    if bar.orientation == "horizontal":
        second = bar.ax.secondary_xaxis("top", functions=both)
        axis = second.xaxis
    else:
        second = bar.ax.secondary_yaxis("left", functions=both)
        axis = second.yaxis
    axis.set_label_text("samples per pixel", fontsize=9)
    second.tick_params(labelsize=8)
    if bar.long_axis.get_scale() == "log":
        log_labels(axis)


def _colours_of(low: float, high: float) -> str:
    """Colours between two limits."""
    if low >= -ONE_SIDED * high and high > 0:
        return POSITIVE
    if high <= -ONE_SIDED * low and low < 0:
        return NEGATIVE
    return SIGNED if math.isclose(-low, high, rel_tol=1e-6) else FAR


def range_of(values: AnyFloats, limit: float | None = None) -> tuple[float, float, str]:
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
        low = float(finite.min())
        high = float(finite.max())
    limit = limit or max(abs(low), abs(high)) or 1.0
    if low * high > 0 and 0 < high - low < 0.5 * max(abs(low), abs(high)):
        return low, high, FAR
    name = _colours_of(low, high)
    if name == POSITIVE:
        return min(low, 0.0), limit, name
    if name == NEGATIVE:
        return -limit, max(high, 0.0), name
    return -limit, limit, SIGNED


def _show(ax: Any, wcs: WCS, values: Any, label: str, title: str, colours: str, norm: Any) -> Any:
    """Draw an image with its title and colour bar into ``ax`` or a new figure; the axes. Axes that
    are not those of a sky are replaced.

    Pixels have the shape that they have on the sky in the middle of the image; the axes say where
    an image is stretched. The colour bar has a pointed end where values lie beyond it.
    """
    import matplotlib as mpl

    ax = map_axes(values.shape, wcs)[0] if ax is None else _on_the_sky(ax, wcs)
    width, height, stretched = _proportions(wcs, values.shape)
    aspect = height / values.shape[0] / (width / values.shape[1])
    _label(ax, values.shape, stretched)
    cmap = mpl.colormaps[colours].with_extremes(bad="0.85")
    picture = ax.imshow(
        values,
        origin="lower",
        interpolation="nearest",
        aspect=aspect,
        cmap=cmap,
        norm=norm,
    )
    low, high = picture.get_clim()
    spare = 1e-6 * (high - low)  # of rounding
    below = (values < low - spare).any() is np.True_
    above = (values > high + spare).any() is np.True_
    place = getattr(ax, "bar_place", None)
    bar = ax.figure.colorbar(
        picture,
        ax=ax,
        cax=ax.figure.add_axes(place) if place else None,
        extend={(1, 1): "both", (1, 0): "min", (0, 1): "max"}.get((below, above), "neither"),
        location="bottom" if width > WIDE * height else "right",
    )
    if bar.long_axis.get_scale() == "log":
        log_labels(bar.long_axis)
    elif bar.long_axis.get_scale() == "asinh":  # matplotlib's own marks lie on each other about 0
        ticks = {float(f"{v:.0e}") for v in norm.inverse(np.linspace(0, 1, 9))}
        bar.set_ticks(sorted(t for t in ticks if low <= t <= high), minor=False)
        bar.minorticks_off()
        bar.long_axis.set_major_formatter("{x:g}")
    bar.set_label(label, wrap=True)
    ax.set_title(title, wrap=True)
    return ax


def _on_the_sky(ax: Any, wcs: WCS) -> Any:
    """World axes: ``ax`` itself, or new ones in the place of plain axes."""
    if hasattr(ax, "coords"):
        return ax
    figure = ax.figure
    place = ax.get_position()
    spec = ax.get_subplotspec()
    ax.remove()
    if spec is None:
        return figure.add_axes(place, projection=wcs)
    return figure.add_subplot(spec, projection=wcs)


def draw_beam(ax: Any, wcs: WCS, shape: tuple[int, ...], fwhm: float) -> None:
    """Draw the beam's half-power circle to scale in the lower left corner, with its width.

    A map that is hardly larger than the beam has the width alone.
    """
    grid, (ny, nx) = wcs_grid(wcs, shape), shape
    place = np.array([0.05 * nx, 0.05 * ny])
    half = np.zeros(2)
    for _ in range(2):  # its own size says where it lies
        beam = circle_on_sky(grid, place + half, fwhm, facecolor="white", edgecolor="black")
        half = np.array([beam.get_extents().width, beam.get_extents().height]) / 2
    if (2 * half < 0.4 * np.array([nx, ny])).all():
        beam.set_zorder(5)
        ax.add_patch(beam)
    else:
        half = np.zeros(2)
    at = place[0] + 2 * half[0], place[1] + half[1]
    ax.annotate(f"FWHM {angle_text(fwhm)}", at, xytext=(6, 0), va="center", **BESIDE)


def draw_scale(ax: Any, wcs: WCS, shape: tuple[int, ...], length: float) -> None:
    """Draw a bar of ``length`` [rad] on the sky in the lower right corner, with its length."""
    grid, (ny, nx) = wcs_grid(wcs, shape), shape
    end = 0.95 * nx
    y = 0.06 * ny
    xx = float(grid.metric(0.8 * nx, y)[0])
    size = length / math.sqrt(xx if math.isfinite(xx) else grid.middle[0])
    ax.plot([end - size, end], [y, y], color="black", linewidth=2.5, zorder=5)
    text = angle_text(length)
    ax.annotate(text, (end - size / 2, y), xytext=(0, 4), ha="center", **BESIDE)


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
    c = math.cos(turn)
    s = math.sin(turn)
    along = xx * c * c + 2 * xy * c * s + yy * s * s
    across = xx * s * s - 2 * xy * c * s + yy * c * c
    sizes = diameter / math.sqrt(along), diameter / math.sqrt(across)
    return Ellipse((float(place[0]), float(place[1])), *sizes, angle=math.degrees(turn), **style)
