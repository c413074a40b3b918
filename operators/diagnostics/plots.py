"""Pictures of maps, coverage, spectra, time streams and scans, drawn into ``ax`` or a new figure; each returns its Axes.

matplotlib is imported inside; no window system is needed and no global state is touched. Colours are told apart by
colour-blind eyes (Okabe & Ito 2008) and brightness scales are perceptually ordered.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from zonda.core.data import Observation

    from .power_spectrum import Spectrum
    from .time_streams import TimeStream
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


def _axes(ax: Any, size: tuple[float, float] = (6.4, 5.2), projection: Any = None) -> Any:
    """``ax``, or the Axes of a new figure that belongs to nobody else (not to pyplot)."""
    if ax is not None:
        return ax
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=110, layout="constrained")
    return figure.add_subplot(projection=projection) if projection is not None else figure.add_subplot()


def _unit(peak: float) -> tuple[float, str]:
    """Factor and name of the unit in which a brightness of ``peak`` kelvin reads well."""
    for factor, name in ((1e6, "µK"), (1e3, "mK")):
        if peak * factor < 3e3:
            return factor, f"{name}$_\\mathrm{{RJ}}$"
    return 1.0, "K$_\\mathrm{RJ}$"


def _is_world(ax: Any) -> bool:
    return hasattr(ax, "coords") and hasattr(ax, "wcs")


def _axis_names(wcs: Any) -> tuple[str, str, str]:
    """Names of the two axes of a map and of their frame, as its WCS says: RA, Dec, ICRS; l, b, Galactic."""
    kind = str(wcs.wcs.ctype[0])
    if kind.startswith("GLON"):
        return "l", "b", "Galactic"
    if kind.startswith("RA"):
        return "RA", "Dec", str(wcs.wcs.radesys).strip() or "ICRS"
    return kind.split("-")[0].lower() or "x", str(wcs.wcs.ctype[1]).split("-")[0].lower() or "y", "as in the file"


def _show(ax: Any, wcs: Any, values: Floats, label: str, **style: Any) -> Any:
    """An image with a colour bar, on world axes where ``ax`` has them, else on offsets from the map's centre in arcmin.

    The colour bar has a pointed end where values lie beyond it.
    """
    from astropy.wcs.utils import proj_plane_pixel_scales

    ny, nx = values.shape
    lon, lat, frame = _axis_names(wcs)
    if _is_world(ax):
        picture = ax.imshow(values, origin="lower", interpolation="nearest", **style)
        ax.coords[0].set_axislabel(f"{lon} ({frame})")
        ax.coords[1].set_axislabel(f"{lat} ({frame})", minpad=0.4)
        for coordinate in ax.coords:
            coordinate.set_ticklabel(size=9)
    else:
        dx, dy = proj_plane_pixel_scales(wcs) * 60
        flip = -1 if wcs.wcs.get_pc()[0, 0] * wcs.wcs.get_cdelt()[0] < 0 else 1
        half_x, half_y = nx * dx / 2 * flip, ny * dy / 2
        extent = (-half_x, half_x, -half_y, half_y)
        picture = ax.imshow(values, origin="lower", extent=extent, interpolation="nearest", aspect="equal", **style)
        ax.set_xlabel(f"{lon} offset [arcmin]")
        ax.set_ylabel(f"{lat} offset [arcmin]")
    low, high = picture.get_clim()
    below, above = bool(np.ma.less(values, low).any()), bool(np.ma.greater(values, high).any())
    extend = {(True, True): "both", (True, False): "min", (False, True): "max"}.get((below, above), "neither")
    bar = ax.figure.colorbar(picture, ax=ax, pad=0.02, shrink=0.9, extend=extend)
    bar.set_label(label)
    return picture


def _draw_beam(ax: Any, wcs: Any, shape: tuple[int, ...], fwhm: float) -> None:
    """The beam's half-power circle in the lower left corner, to scale."""
    from astropy.wcs.utils import proj_plane_pixel_scales
    from matplotlib.patches import Ellipse

    dx, dy = np.radians(proj_plane_pixel_scales(wcs)) if _is_world(ax) else (ARCMIN, ARCMIN)
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
        Its `astropy.wcs.WCS`; a new figure gets world axes, a plain ``ax`` offsets from the centre in arcmin.
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

    ax = _axes(ax, projection=wcs)
    finite = values[np.isfinite(values)]
    if limit is None:
        limit = float(np.percentile(np.abs(finite), SHOWN)) if finite.size else 1.0
    limit = limit or 1.0
    bottom, top, colours = -limit, limit, mpl.colormaps["RdBu_r"]
    low, high = (float(np.percentile(finite, p)) for p in (100 - SHOWN, SHOWN)) if finite.size else (0.0, 0.0)
    if low * high > 0 and 0 < high - low < 0.5 * max(abs(low), abs(high)):
        bottom, top, colours = low, high, mpl.colormaps["viridis"]
    factor, unit = _unit(max(abs(bottom), abs(top)))
    shown = np.ma.masked_invalid(np.asarray(values, np.float64) * factor)
    bounds = {"vmin": bottom * factor, "vmax": top * factor}
    _show(ax, wcs, shown, f"brightness [{unit}]", cmap=colours.with_extremes(bad="0.85"), **bounds)
    if fwhm:
        _draw_beam(ax, wcs, values.shape, fwhm)
    if circle:
        from astropy.wcs.utils import proj_plane_pixel_scales

        scale = np.radians(proj_plane_pixel_scales(wcs)) if _is_world(ax) else np.array([ARCMIN, ARCMIN])
        centre = ((values.shape[1] - 1) / 2, (values.shape[0] - 1) / 2) if _is_world(ax) else (0.0, 0.0)
        ax.add_patch(Ellipse(centre, *(circle / scale), fill=False, edgecolor="black", linestyle=":", linewidth=1.2))
    ax.set_title(title)
    return ax  # type: ignore[no-any-return]


def plot_coverage(hits: NDArray[np.integer] | Floats, wcs: Any, *, ax: Any = None, title: str = "Samples per pixel") -> Axes:
    """Where the telescope looked: samples per pixel (ny, nx), pixels without any in grey. Other arguments as `plot_map`."""
    import matplotlib as mpl
    from matplotlib.colors import LogNorm, Normalize

    ax = _axes(ax, projection=wcs)
    hits = np.asarray(hits, np.float64)
    colours = mpl.colormaps["cividis"].with_extremes(bad="0.85")
    seen = hits[hits > 0]
    top, middle = (float(seen.max()), float(np.median(seen))) if seen.size else (1.0, 1.0)
    scale = LogNorm(max(1.0, middle / 30), top) if top > 30 * middle else Normalize(0, top)
    _show(ax, wcs, np.ma.masked_where(hits <= 0, hits), "samples per pixel", cmap=colours, norm=scale)
    ax.set_title(title)
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
    ax = _axes(ax, (7.2, 5.0))
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
    ax.set_xlabel("frequency [Hz]")
    ax.set_ylabel("power spectral density [K$_\\mathrm{RJ}^2$/Hz]")
    ax.grid(which="major", color="0.9", linewidth=0.7)
    ax.legend(frameon=False, fontsize=9, loc="upper right")
    ax.set_title(title)
    return ax  # type: ignore[no-any-return]


def plot_transfer(transfer: Transfer, *, ax: Any = None, title: str = "Transfer function") -> Axes:
    """Share of each angular scale that the filters leave: T with its standard error, and S, the ratio of amplitudes.

    S grows without bound where the beam leaves no sky: above 2 it leaves the picture, so that T can be read.
    Horizontal bars are the rings. The dotted line is the beam's FWHM; the upper axis counts wavelengths.
    """
    ax = _axes(ax, (7.2, 4.6))
    r, arcsec = transfer.rings, ARCMIN / 60
    scale, edges = transfer.scale / arcsec, 1 / transfer.edges / arcsec
    width = [np.abs(scale - edges[1:]), np.abs(edges[:-1] - scale)]
    error = np.where(np.isfinite(r.error), r.error, 0.0)
    ax.errorbar(scale, r.transfer, yerr=error, xerr=width, fmt="o", color=SEQUENCE[0], markersize=4, label="T: share in phase")
    ax.plot(scale, r.amplitude, "--", color=SEQUENCE[1], linewidth=1.2, label="S: ratio of amplitudes")
    ax.set_xscale("log")
    ax.set_xlim(edges[0], edges[-1])
    top = float(np.nanmax(np.append(np.minimum(r.amplitude, 2.0), r.transfer), initial=1.0))
    ax.set_ylim(min(0.0, float(np.nanmin(r.transfer, initial=0.0))) * 1.05, 1.05 * top)
    ax.axhline(1.0, color="0.6", linewidth=0.8, zorder=1)
    if transfer.fwhm > 0 and edges[-1] <= transfer.fwhm / arcsec <= edges[0]:
        ax.axvline(transfer.fwhm / arcsec, color="black", linestyle=":", linewidth=1.0)
    upper = ax.secondary_xaxis("top", functions=(_to_kilolambda, _to_kilolambda))
    upper.set_xlabel("baseline [1000 wavelengths]")
    ax.set_xlabel("angular scale [arcsec]")
    ax.set_ylabel("transfer function")
    ax.grid(which="major", color="0.9", linewidth=0.7)
    ax.legend(frameon=False, fontsize=9, loc="best")
    ax.set_title(title)
    return ax  # type: ignore[no-any-return]


def _to_kilolambda(arcsec: Any) -> Any:
    """1000 wavelengths of a scale in arcsec, and back: the function is its own inverse."""
    with np.errstate(divide="ignore"):
        return 1e-3 / (np.asarray(arcsec, np.float64) * ARCMIN / 60)


def plot_tod(stream: TimeStream, *, ax: Any = None, name: str = "signal", title: str = "") -> Axes:
    """Stream ``name`` of a few detectors against time, K_RJ: samples pale, means over one second dark."""
    ax = _axes(ax, (7.2, 3.6))
    values = stream.streams[name]
    finite = values[np.isfinite(values)]
    factor, unit = _unit(float(np.abs(finite).max()) if finite.size else 1.0)
    step = float(np.median(np.diff(stream.seconds))) if len(stream.seconds) > 1 else 0.0  # samples need not be a comb
    width = max(1, round(1.0 / step)) if step > 0 else 1
    whole = values.shape[1] // width * width
    centres = stream.seconds[:whole].reshape(-1, width).mean(axis=1)
    for k, detector in enumerate(stream.names):
        colour = SEQUENCE[k % len(SEQUENCE)]
        ax.plot(stream.seconds, values[k] * factor, linewidth=0.4, alpha=0.2, color=colour, rasterized=True)
        ax.plot(centres, values[k, :whole].reshape(-1, width).mean(axis=1) * factor, linewidth=0.9, color=colour, label=detector)
    ax.set_xlabel("time since the start of the scan [s]")
    ax.set_ylabel(f"{name} [{unit}]")
    ax.margins(x=0)
    ax.grid(color="0.92", linewidth=0.7)
    if values.shape[0]:
        legend = ax.legend(frameon=False, fontsize=8, ncols=min(6, len(stream.names)), loc="upper right")
        for line in legend.get_lines():
            line.set_linewidth(2)
    ax.set_title(title or f"Time streams of {stream.observation}, after step {stream.label}")
    return ax  # type: ignore[no-any-return]


def plot_scan(observations: Sequence[Observation], *, ax: Any = None, title: str = "Boresight track") -> Axes:
    """Track of the boresight about the centre of the first scan, tangent-plane offsets in arcmin, a line per scan.

    Earlier scans are drawn wider: a scan that repeats another's track does not hide it.
    """
    ax = _axes(ax, (5.6, 5.2))
    ra0, dec0 = observations[0].centre
    for k, observation in enumerate(observations):
        step = max(1, observation.n_samples // 20000)
        lon, lat = observation.ra[::step] - ra0, observation.dec[::step]
        cosine = np.sin(dec0) * np.sin(lat) + np.cos(dec0) * np.cos(lat) * np.cos(lon)
        near = cosine > 0.1
        x = np.where(near, np.cos(lat) * np.sin(lon) / np.where(near, cosine, 1), np.nan) / ARCMIN
        y = (np.cos(dec0) * np.sin(lat) - np.sin(dec0) * np.cos(lat) * np.cos(lon)) / np.where(near, cosine, 1) / ARCMIN
        width = 0.6 + 1.2 * (1 - (k + 1) / len(observations))
        ax.plot(x, y, linewidth=width, color=SEQUENCE[k % len(SEQUENCE)], label=observation.name, rasterized=True)
    ax.set_aspect("equal", adjustable="datalim")
    if not ax.xaxis_inverted():
        ax.invert_xaxis()
    ax.set_xlabel("RA offset [arcmin]")
    ax.set_ylabel("Dec offset [arcmin]")
    ax.grid(color="0.92", linewidth=0.7)
    if len(observations) <= 8:
        legend = ax.legend(frameon=False, fontsize=8, loc="upper right")
        for line in legend.get_lines():
            line.set_linewidth(2)
    ax.set_title(title)
    return ax  # type: ignore[no-any-return]
