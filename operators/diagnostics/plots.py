"""Pictures of maps, coverage, spectra, time streams and scans, drawn into ``ax`` or a new figure; each returns its Axes.

matplotlib is imported inside; no window system is needed and no global state is touched. Colours are told apart by
colour-blind eyes (Okabe & Ito 2008) and brightness scales are perceptually ordered. Margins of a new figure are fixed, and
labels are plain Unicode text: measuring the one and parsing the other take longer than drawing.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from .sky_axes import SkyAxes, names_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from zonda.core.data import Observation

    from .series import Spectrum, TimeStream
    from .transfer_function import Transfer

Floats = NDArray[np.floating]

ARCMIN = np.pi / 180 / 60
SHOWN = 99.95
"""Per cent of the pixels of a noise-free map that its colour scale covers."""

COLOURS = {
    "signal": "#000000",
    "atmosphere": "#0072B2",
    "pink": "#CC79A7",
    "white": "#999999",
    "sky": "#D55E00",
    "transmission": "#009E73",
}
SEQUENCE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")


DPI = 110
MAP_SIZE = (6.4, 5.2)
"""Largest width and height of a picture of one map, in."""
_TOP, _BOTTOM, _BAR, _GAP = 0.34, 0.58, 1.12, 0.2
"""Margins for a title, for tick labels with an axis label, for a colour bar with its labels, and before the next map, in."""
MANY = 2000
"""Points of a track that are drawn, however near to one another."""
_CHARACTER, _LINE = 0.078, 0.17
"""Width of a character and height of a line of 9 pt text, in."""


@dataclass(frozen=True)
class Track:
    """A scan for `plot_scan`: unit vectors (n, 3) of the boresight, ICRS; the scan's centre (RA, Dec) [rad]."""

    name: str
    centre: tuple[float, float]
    directions: NDArray[np.float64]

    @classmethod
    def of(cls, observation: Observation, most: int = 20000) -> Track:
        """Of at most ``most`` samples, evenly spaced."""
        step = -(-observation.n_samples // most)
        x, y, z, w = np.asarray(observation.boresight_radec[::step], np.float64).T
        directions = np.stack([2 * (x * z + y * w), 2 * (y * z - x * w), 1 - 2 * (x * x + y * y)], axis=1)
        return cls(observation.name, observation.centre, directions)


def _axes(ax: Any, size: tuple[float, float] = (7.2, 5.0), left: float = 0.85, top: float = _TOP, right: float = 0.12) -> Any:
    """``ax``, or the Axes of a new figure that belongs to nobody else (not to pyplot). ``left``, ``top``, ``right``: margins,
    in."""
    if ax is not None:
        return ax
    width, height = size
    inside = (left / width, _BOTTOM / height, 1 - (left + right) / width, 1 - (_BOTTOM + top) / height)
    return _figure(size, [inside])[0]


_ready: dict[int, list[Any]] = {}
"""Figures that nobody has drawn into, by the number of their axes."""


def lay_in(count: int) -> None:
    """Make a figure with ``count`` axes ahead, for any of the functions below: a fifth of the work for a picture."""
    _ready.setdefault(count, []).append(_blank([{}] * count))


def _blank(kinds: Sequence[dict[str, Any]]) -> Any:
    """A figure with as many axes, of these kinds."""
    from matplotlib.figure import Figure

    figure = Figure(dpi=DPI)
    for kind in kinds:
        figure.add_axes((0.0, 0.0, 1.0, 1.0), **kind)
    return figure


def _figure(size: tuple[float, float], places: Sequence[tuple[float, float, float, float]], kinds: Any = None) -> list[Any]:
    """The axes of a new figure of ``size`` [in], at ``places`` (left, bottom, width, height), shares of it."""
    ready = _ready.get(len(places)) if kinds is None else None
    figure = ready.pop() if ready else _blank(kinds or [{}] * len(places))
    figure.set_size_inches(size)
    for ax, place in zip(figure.axes, places, strict=True):
        ax.set_position(place)
    return figure.axes  # type: ignore[no-any-return]


def _fit(ax: Any) -> None:
    """Move the left edge of the one axes of a figure to where its tick labels and their name have room."""
    labels = ax.yaxis.get_major_formatter().format_ticks(ax.yaxis.get_majorticklocs())
    left = (0.4 + 1.12 * _CHARACTER * max((len(label) for label in labels), default=0)) / ax.figure.get_figwidth()
    box = ax.get_position()
    ax.set_position((left, box.y0, box.x1 - left, box.height))


def map_axes(shape: tuple[int, ...], axes: SkyAxes | None, wcs: Any, count: int = 1) -> list[Any]:
    """Axes of a new figure for ``count`` images (ny, nx) side by side, each with one for its colour bar as ``bar_axes``.

    They have the image's pixel coordinates, with tick marks where ``axes`` has them, or are astropy's world axes of ``wcs``.
    Latitudes are written at the first one only, since they are the same for all.
    """
    from matplotlib.ticker import FixedFormatter, FixedLocator

    ny, nx = shape
    width, height = MAP_SIZE[0] - 1.05 - _BAR, MAP_SIZE[1] - _TOP - _BOTTOM
    scale = min(width / nx, height / ny)
    marks = None if axes is None else axes.ticks(shape, nx * scale / _CHARACTER, ny * scale / _LINE)
    left = 0.36 + _CHARACTER * max((len(label) for label in marks["left"].labels), default=0) if marks else 1.05
    scale = min((MAP_SIZE[0] - left - _BAR) / nx, height / ny)
    width, height = nx * scale, ny * scale
    bar = max(0.9 * height, min(1.2, MAP_SIZE[1] - _TOP - _BOTTOM))
    tall = max(height, bar)
    pitch = width + _BAR + (_GAP if marks else left)
    size = left + width + _BAR + (count - 1) * pitch, tall + _TOP + _BOTTOM
    places = []
    for x in (left + k * pitch for k in range(count)):
        image = x, _BOTTOM + (tall - height) / 2, width, height
        beside = x + width + 0.1, _BOTTOM + (tall - bar) / 2, 0.2, bar
        places += [(x / size[0], y / size[1], w / size[0], h / size[1]) for x, y, w, h in (image, beside)]
    if marks is None:
        from astropy.wcs import WCS

        found = _figure(size, places, [{"projection": wcs if hasattr(wcs, "wcs") else WCS(wcs, naxis=2)}, {}] * count)
    else:
        found = _figure(size, places)
    made = found[::2]
    for k, ax in enumerate(made):
        ax.bar_axes, ax.names_latitude = found[2 * k + 1], k == 0 or marks is None
        if marks is not None:
            for axis, edge in ((ax.xaxis, "bottom"), (ax.yaxis, "left")):
                axis.set_major_locator(FixedLocator(marks[edge].places.tolist()))
                axis.set_major_formatter(FixedFormatter(marks[edge].labels))
                axis.set_tick_params(labelsize=9)
            ax.yaxis.set_tick_params(labelleft=k == 0)
            ax.plot(marks["top"].places, np.full(len(marks["top"].places), ny - 0.5), **_tick_style(2))
            ax.plot(np.full(len(marks["right"].places), nx - 0.5), marks["right"].places, **_tick_style(1))
    return made


def _tick_style(marker: int) -> dict[str, Any]:
    """Of tick marks that no axis draws."""
    return {"linestyle": "none", "marker": marker, "markersize": 3.5, "markeredgewidth": 0.8, "color": "black", "clip_on": False}


def _unit(peak: float) -> tuple[float, str]:
    """Factor and name of the unit in which a brightness of ``peak`` kelvin reads well."""
    for factor, name in ((1e6, "µK"), (1e3, "mK")):
        if peak * factor < 3e3:
            return factor, name
    return 1.0, "K"


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _power_of_ten(value: float) -> str:
    power = int(np.floor(np.log10(value) + 1e-9))
    mantissa = f"{value / 10.0**power:.3g}"
    return f"{'' if mantissa == '1' else mantissa + ' · '}10{str(power).translate(_RAISED)}"


def _log_labels(axis: Any, low: float, high: float) -> None:
    """Label the powers of ten between ``low`` and ``high``, and 2 and 5 of each where there are few of them."""
    few = 0 < low < high < 160 * low
    text = (lambda value: f"{value:.6g}") if low > 1e-3 and high < 1e5 else _power_of_ten
    axis.set_major_formatter(lambda value, _: text(value) if value > 0 else "")
    axis.set_tick_params(which="minor", pad=5)  # their labels are as far away as those of the longer marks
    axis.set_minor_formatter(lambda value, _: text(value) if few and value > 0 and f"{value:.0e}"[0] in "25" else "")


def _title(ax: Any, title: str, pad: float | None = None) -> None:
    """Above the axes, where it stands: looking for room takes as long as drawing."""
    ax.set_title(title, y=1.0, pad=pad)


def _is_world(ax: Any) -> bool:
    """Whether positions on ``ax`` are pixels: world axes of astropy's, or those of `map_axes`."""
    return hasattr(ax, "bar_axes") or (hasattr(ax, "coords") and hasattr(ax, "wcs"))


def _scales(wcs: Any, axes: SkyAxes | None) -> tuple[float, float]:
    """Sizes of a pixel, deg."""
    if axes is not None:
        return axes.scales
    from astropy.wcs import WCS
    from astropy.wcs.utils import proj_plane_pixel_scales

    x, y = proj_plane_pixel_scales(wcs if hasattr(wcs, "wcs") else WCS(wcs, naxis=2))
    return float(x), float(y)


def _show(ax: Any, wcs: Any, axes: SkyAxes | None, values: Floats, label: str, **style: Any) -> Any:
    """An image with a colour bar, in pixels on world axes, else on offsets from the map's centre in arcmin.

    The colour bar has a pointed end where values lie beyond it.
    """
    ny, nx = values.shape
    if axes is not None:
        lon, lat, frame = axes.names
        flip = -1 if axes.matrix[0, 0] < 0 else 1
    else:
        header = wcs.to_header(relax=True) if hasattr(wcs, "to_header") else wcs
        lon, lat, frame = names_of(header)
        flip = -1 if float(header.get("PC1_1", 1.0)) * float(header.get("CDELT1", 1.0)) < 0 else 1
    if _is_world(ax):
        picture = ax.imshow(values, origin="lower", interpolation="nearest", **style)
        names = f"{lon} ({frame})", f"{lat} ({frame})"
        if hasattr(ax, "coords"):
            ax.coords[0].set_axislabel(names[0])
            ax.coords[1].set_axislabel(names[1], minpad=0.4)
            for coordinate in ax.coords:
                coordinate.set_ticklabel(size=9)
        else:
            ax.set_xlabel(names[0])
            ax.set_ylabel(names[1] if ax.names_latitude else "")
    else:
        dx, dy = (60 * scale for scale in _scales(wcs, axes))
        half_x, half_y = nx * dx / 2 * flip, ny * dy / 2
        extent = (-half_x, half_x, -half_y, half_y)
        picture = ax.imshow(values, origin="lower", extent=extent, interpolation="nearest", aspect="equal", **style)
        ax.set_xlabel(f"{lon} offset [arcmin]")
        ax.set_ylabel(f"{lat} offset [arcmin]")
    low, high = picture.get_clim()
    below, above = bool(np.ma.less(values, low).any()), bool(np.ma.greater(values, high).any())
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")
    own = getattr(ax, "bar_axes", None)
    place = {"ax": ax, "pad": 0.02, "shrink": 0.9} if own is None else {"cax": own}
    bar = ax.figure.colorbar(picture, extend=extend, **place)
    if picture.norm.__class__.__name__ == "LogNorm":
        _log_labels(bar.ax.yaxis, low, high)
    bar.set_label(label)
    return picture


def _draw_beam(ax: Any, scales: tuple[float, float], fwhm: float) -> None:
    """The beam's half-power circle in the lower left corner, to scale. ``scales``: rad per unit of the axes."""
    from matplotlib.patches import Ellipse

    dx, dy = scales
    width, height = fwhm / dx, fwhm / dy
    x0, x1 = ax.get_xlim()
    y0, y1 = ax.get_ylim()
    sign = 1 if x1 > x0 else -1
    margin_x, margin_y = 0.05 * abs(x1 - x0) + width / 2, 0.05 * abs(y1 - y0) + height / 2
    centre = (x0 + sign * margin_x, y0 + margin_y)
    ax.add_patch(Ellipse(centre, width, height, facecolor="white", edgecolor="black", linewidth=1.0, zorder=5))
    ax.annotate(
        f"FWHM {np.degrees(fwhm) * 3600:.3g}″",
        (centre[0] + sign * (width * 0.5), centre[1]),
        xytext=(6, 0),
        textcoords="offset points",
        va="center",
        fontsize=8,
        zorder=5,
        bbox={"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.5},
    )


def plot_map(
    values: Floats,
    wcs: Any,
    *,
    ax: Any = None,
    title: str = "",
    fwhm: float | None = None,
    limit: float | None = None,
    circle: float | None = None,
) -> Axes:
    """A brightness map in K_RJ, zero in white, with its colour bar and resolution.

    A map far from zero (one with the mean emission still in it) is shown between its lowest and highest brightness instead.

    Parameters
    ----------
    values
        (ny, nx) K_RJ; NaN where nothing was observed (drawn grey).
    wcs
        Its `astropy.wcs.WCS`, FITS header or `SkyAxes`; a new figure gets tick marks in longitude and latitude, a plain
        ``ax`` offsets from the centre in arcmin, one of astropy's world axes its own.
    ax
        Axes to draw into.
    title
        Says what is shown.
    fwhm
        Resolution, rad; drawn to scale.
    limit
        Colour scale from -limit to limit, K; default: what `SHOWN` % of the pixels stay below.
    circle
        Diameter of a circle about the centre of the map, rad (where a noise figure was taken).
    """
    import matplotlib as mpl
    from matplotlib.patches import Ellipse

    axes = wcs if isinstance(wcs, SkyAxes) else SkyAxes.of(wcs)
    ax = map_axes(values.shape, axes, wcs)[0] if ax is None else ax
    finite = values[np.isfinite(values)]
    if limit is None:
        limit = float(np.percentile(np.abs(finite), SHOWN)) if finite.size else 1.0
    limit = limit or 1.0
    bottom, top, colours = -limit, limit, mpl.colormaps["RdBu_r"]
    low, high = (float(p) for p in np.percentile(finite, (100 - SHOWN, SHOWN))) if finite.size else (0.0, 0.0)
    if low * high > 0 and 0 < high - low < 0.5 * max(abs(low), abs(high)):
        bottom, top, colours = low, high, mpl.colormaps["viridis"]
    factor, unit = _unit(max(abs(bottom), abs(top)))
    shown = np.ma.masked_invalid(values * factor)
    bounds = {"vmin": bottom * factor, "vmax": top * factor}
    _show(ax, wcs, axes, shown, f"Rayleigh–Jeans brightness [{unit}]", cmap=colours.with_extremes(bad="0.85"), **bounds)
    dx, dy = np.radians(_scales(wcs, axes)) if _is_world(ax) else (ARCMIN, ARCMIN)
    if fwhm:
        _draw_beam(ax, (dx, dy), fwhm)
    if circle:
        centre = ((values.shape[1] - 1) / 2, (values.shape[0] - 1) / 2) if _is_world(ax) else (0.0, 0.0)
        ax.add_patch(Ellipse(centre, circle / dx, circle / dy, fill=False, edgecolor="black", linestyle=":", linewidth=1.2))
    _title(ax, title)
    return ax  # type: ignore[no-any-return]


def plot_coverage(hits: NDArray[np.integer] | Floats, wcs: Any, *, ax: Any = None, title: str = "Samples per pixel") -> Axes:
    """Where the telescope looked: samples per pixel (ny, nx), pixels without any in grey. Other arguments as `plot_map`."""
    import matplotlib as mpl
    from matplotlib.colors import LogNorm, Normalize

    axes = wcs if isinstance(wcs, SkyAxes) else SkyAxes.of(wcs)
    ax = map_axes(hits.shape, axes, wcs)[0] if ax is None else ax
    hits = np.asarray(hits, np.float32)
    colours = mpl.colormaps["cividis"].with_extremes(bad="0.85")
    seen = hits[hits > 0]
    top, middle = (float(seen.max()), float(np.median(seen))) if seen.size else (1.0, 1.0)
    scale = LogNorm(max(1.0, middle / 30), top) if top > 30 * middle else Normalize(0, top)
    _show(ax, wcs, axes, np.ma.masked_where(hits <= 0, hits), "samples per pixel", cmap=colours, norm=scale)
    _title(ax, title)
    return ax  # type: ignore[no-any-return]


def _binned(frequency: Floats, psd: Floats, per_decade: int = 24) -> tuple[Floats, Floats]:
    """Means of a spectrum in logarithmic bins (each at least one frequency wide)."""
    position = np.floor(np.log10(frequency / frequency[0]) * per_decade).astype(int)
    _, first = np.unique(position, return_index=True)
    count = np.diff(np.append(first, frequency.size))
    return np.add.reduceat(frequency, first) / count, np.add.reduceat(psd, first) / count


def plot_spectra(spectrum: Spectrum, *, ax: Any = None, title: str = "Power spectra of the time streams") -> Axes:
    """One-sided power spectra, log-log: thin lines as measured, thick ones averaged in logarithmic bins.

    The dashed line is the level of white noise, 2 NET^2; the dotted one the knee, where pink noise equals white.
    """
    ax = _axes(ax, left=0.95)
    names = {"signal": "signal (all)", "sky": "astronomical sky", "pink": "pink noise", "white": "white noise"}
    top, bottom = 0.0, np.inf
    for name, psd in spectrum.psd.items():
        good = np.isfinite(psd) & (psd > 0)
        if not good.any():
            continue
        frequency, power = spectrum.frequency[good], psd[good]
        x, y = _binned(frequency, power)
        colour = COLOURS.get(name, "#56B4E9")
        ax.loglog(frequency, power, color=colour, linewidth=0.5, alpha=0.25)
        ax.loglog(
            x,
            y,
            color=colour,
            linewidth=2.2 if name == "signal" else 1.6,
            label=names.get(name, name),
            zorder=3 if name == "signal" else 2.5,
        )
        if name != "sky" or len(spectrum.psd) == 1:
            top, bottom = max(top, float(y.max())), min(bottom, float(np.percentile(y, 5)))
    level = spectrum.white_level
    if level > 0 and ({"white", "signal"} & set(spectrum.psd)):
        ax.axhline(level, color="black", linestyle="--", linewidth=1.0, zorder=2)
        net = np.sqrt(level / 2) * 1e3
        ax.annotate(
            f"2 NET² (NET = {net:.3g} mK√s)",
            (1, level),
            xycoords=("axes fraction", "data"),
            xytext=(-4, -5),
            textcoords="offset points",
            fontsize=8,
            ha="right",
            va="top",
        )
        top, bottom = max(top, level), min(bottom, level)
    knee = spectrum.knee()
    if knee is not None:
        ax.axvline(knee, color="black", linestyle=":", linewidth=1.0, zorder=2)
        ax.annotate(
            f"knee {knee:.2g} Hz",
            (knee, 0.02),
            xycoords=("data", "axes fraction"),
            xytext=(4, 0),
            textcoords="offset points",
            fontsize=8,
            rotation=90,
            va="bottom",
        )
    if 0 < bottom < top:
        floor = level if level > 0 and {"white", "signal"} & set(spectrum.psd) else bottom
        ax.set_ylim(max(bottom * 1e-2, min(floor, top) * 1e-4), top * 5)
    ax.set_xlim(spectrum.frequency[0], spectrum.frequency[-1])
    _log_labels(ax.xaxis, *ax.get_xlim())
    _log_labels(ax.yaxis, *ax.get_ylim())
    ax.set_xlabel("frequency [Hz]")
    ax.set_ylabel("power spectral density, Rayleigh–Jeans [K²/Hz]")
    ax.grid(which="major", color="0.9", linewidth=0.7)
    ax.legend(frameon=False, fontsize=9, loc="upper right")
    _title(ax, title)
    return ax  # type: ignore[no-any-return]


def plot_transfer(transfer: Transfer, *, ax: Any = None, title: str = "Transfer function") -> Axes:
    """Share of each angular scale that the filters leave: T with its standard error, and S, the ratio of amplitudes.

    S grows without bound where the beam leaves no sky: above 2 it leaves the picture, so that T can be read.
    Horizontal bars are the rings. The dotted line is the beam's FWHM; the upper axis counts wavelengths.
    """
    ax = _axes(ax, (7.2, 4.8), top=0.86)
    r, arcsec = transfer.rings, ARCMIN / 60
    scale, edges = transfer.scale / arcsec, 1 / transfer.edges / arcsec
    width = [np.abs(scale - edges[1:]), np.abs(edges[:-1] - scale)]
    error = np.where(np.isfinite(r.error), r.error, 0.0)
    ax.errorbar(scale, r.transfer, yerr=error, xerr=width, fmt="o", color=SEQUENCE[0], markersize=4, label="T: share in phase")
    ax.plot(scale, r.amplitude, "--", color=SEQUENCE[1], linewidth=1.2, label="S: ratio of amplitudes")
    ax.set_xscale("log")
    ax.set_xlim(edges[0], edges[-1])
    _log_labels(ax.xaxis, edges[-1], edges[0])
    top = float(np.nanmax(np.append(np.minimum(r.amplitude, 2.0), r.transfer), initial=1.0))
    ax.set_ylim(min(0.0, float(np.nanmin(r.transfer, initial=0.0))) * 1.05, 1.05 * top)
    ax.axhline(1.0, color="0.6", linewidth=0.8, zorder=1)
    if transfer.fwhm > 0 and edges[-1] <= transfer.fwhm / arcsec <= edges[0]:
        ax.axvline(transfer.fwhm / arcsec, color="black", linestyle=":", linewidth=1.0)
    upper = ax.secondary_xaxis("top", functions=(_to_kilolambda, _to_kilolambda))
    upper.set_xlabel("baseline [1000 wavelengths]")
    _log_labels(upper.xaxis, _to_kilolambda(edges[0]), _to_kilolambda(edges[-1]))
    ax.set_xlabel("angular scale [arcsec]")
    ax.set_ylabel("transfer function")
    ax.grid(which="major", color="0.9", linewidth=0.7)
    ax.legend(frameon=False, fontsize=9, loc="best")
    _title(ax, title, pad=42)
    return ax  # type: ignore[no-any-return]


def _to_kilolambda(arcsec: Any) -> Any:
    """1000 wavelengths of a scale in arcsec, and back: the function is its own inverse."""
    with np.errstate(divide="ignore"):
        return 1e-3 / (np.asarray(arcsec, np.float64) * ARCMIN / 60)


def _envelope(x: Floats, y: Floats, columns: int = 1600) -> tuple[Floats, Floats]:
    """Lowest and highest of y, in turn, in ``columns`` equal parts: what a line of many more points looks like."""
    width = len(y) // columns
    if width < 4:
        return x, y
    whole = width * columns
    parts, ends = y[:whole].reshape(columns, width), y[whole:]
    both = np.stack([parts.min(axis=1), parts.max(axis=1)], axis=1).ravel()
    at = x[:whole].reshape(columns, width)[:, [width // 4, 3 * width // 4]].ravel()
    return np.append(at, x[whole:]), np.append(both, ends)


def plot_tod(stream: TimeStream, *, ax: Any = None, name: str = "signal", title: str = "") -> Axes:
    """Stream ``name`` of a few detectors against time, K_RJ: samples pale, means over one second dark."""
    own, ax = ax is None, _axes(ax, (7.2, 3.6))
    values = stream.streams[name]
    finite = values[np.isfinite(values)]
    factor, unit = _unit(float(np.abs(finite).max()) if finite.size else 1.0)
    label = f"{name}, Rayleigh–Jeans [{unit}]"
    if name == "transmission":
        factor, label = 1.0, "relative change of the transmission"
    step = float(np.median(np.diff(stream.seconds))) if len(stream.seconds) > 1 else 0.0  # samples need not be a comb
    width = max(1, round(1.0 / step)) if step > 0 else 1
    whole = values.shape[1] // width * width
    centres = stream.seconds[:whole].reshape(-1, width).mean(axis=1)
    for k, detector in enumerate(stream.names):
        colour = SEQUENCE[k % len(SEQUENCE)]
        ax.plot(*_envelope(stream.seconds, values[k] * factor), linewidth=0.4, alpha=0.2, color=colour)
        ax.plot(centres, values[k, :whole].reshape(-1, width).mean(axis=1) * factor, linewidth=0.9, color=colour, label=detector)
    ax.set_xlabel("time since the start of the scan [s]")
    ax.set_ylabel(label)
    ax.margins(x=0)
    if len(stream.seconds) > 1:
        ax.set_xlim(stream.seconds[0], stream.seconds[-1])
    ax.grid(color="0.92", linewidth=0.7)
    if values.shape[0]:
        rows = -(-len(stream.names) // 6)
        if rows <= 3:  # above the lines
            low, high = ax.get_ylim()
            ax.set_ylim(low, high + (high - low) * 0.08 * rows)
        frame = {"frameon": rows > 3, "framealpha": 0.85, "edgecolor": "none"}
        legend = ax.legend(**frame, fontsize=8, ncols=min(6, len(stream.names)), loc="upper right")
        for line in legend.get_lines():
            line.set_linewidth(2)
    if own:
        _fit(ax)
    _title(ax, title or f"Time streams of {stream.observation}, after step {stream.label}")
    return ax  # type: ignore[no-any-return]


def plot_scan(observations: Sequence[Observation | Track], *, ax: Any = None, title: str = "Boresight track") -> Axes:
    """Track of the boresight about the centre of the first scan, tangent-plane offsets in arcmin or deg, a line per scan.

    Earlier scans are drawn wider: a scan that repeats another's track does not hide it.
    """
    tracks = [o if isinstance(o, Track) else Track.of(o) for o in observations]
    named, own = len(tracks) <= 8, ax is None
    right = 0.55 + _CHARACTER * max(len(track.name) for track in tracks) if named and own else 0.0
    ax = _axes(ax, (5.7 + right, 5.2), left=0.75, right=0.12 + right)
    offsets = [_offsets(track, tracks[0].centre) for track in tracks]
    known = np.concatenate(offsets)
    known = known[np.isfinite(known).all(axis=1)]
    extent = float(np.ptp(known, axis=0).max()) if len(known) else 0.0
    scale, unit = (60, "deg") if extent > 120 else (1, "arcmin")
    for k, (track, offset) in enumerate(zip(tracks, offsets, strict=True)):
        width = 0.6 + 1.2 * (1 - (k + 1) / len(tracks))
        x, y = _apart(offset, extent / 1000).T / scale
        ax.plot(x, y, linewidth=width, color=SEQUENCE[k % len(SEQUENCE)], label=track.name)
    ax.set_aspect("equal", adjustable="datalim")
    if not ax.xaxis_inverted():
        ax.invert_xaxis()
    ax.set_xlabel(f"RA offset [{unit}]")
    ax.set_ylabel(f"Dec offset [{unit}]")
    ax.grid(color="0.92", linewidth=0.7)
    if named:
        beside = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "frameon": False}
        within = {"loc": "upper right", "framealpha": 0.85, "edgecolor": "none"}
        legend = ax.legend(fontsize=8, **(beside if own else within))
        for line in legend.get_lines():
            line.set_linewidth(2)
    _title(ax, title)
    return ax  # type: ignore[no-any-return]


def _offsets(track: Track, centre: tuple[float, float]) -> NDArray[np.float64]:
    """(n, 2) arcmin east and north of ``centre`` on its tangent plane; NaN far from it."""
    ra, dec = centre
    ahead = np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])
    east = np.array([-np.sin(ra), np.cos(ra), 0.0])
    cosine = track.directions @ ahead
    plane = track.directions @ np.stack([east, np.cross(ahead, east)], axis=1) / np.where(cosine > 0.1, cosine, np.nan)[:, None]
    return np.asarray(plane / ARCMIN, np.float64)


def _apart(points: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """The points of a track (n, 2), without those less than ``least`` along it from one that is kept."""
    steps = np.nan_to_num(np.hypot(*np.diff(points, axis=0).T))
    if least <= 0 or len(points) < MANY:
        return points
    part = np.floor(np.append(0.0, np.cumsum(steps)) / least)
    keep = np.append(True, part[1:] != part[:-1]) | ~np.isfinite(points).all(axis=1)
    keep[-1] = True
    return points[keep]
