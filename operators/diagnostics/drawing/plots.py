"""Pictures of spectra, modes, time streams and scans, drawn into ``ax`` or a new figure; each
returns its Axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.canvas import COLOURS, OTHER, PALE, SEQUENCE, log_labels, new_axes, unit_of
from zonda.core.numerics.angles import ARCMIN, ARCSEC
from zonda.core.numerics.sphere import local_axes
from zonda.core.types import AnyFloats

from ..series import unit_of_stream

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from zonda.core.data import Observation

    from ..series import Modes, Spectrum, TimeStream
    from ..transfer_function import Transfer

MODES = 4
"""Modes whose streams are drawn."""
MANY = 2000
"""Points of a track that are drawn, however near to one another."""


@dataclass(frozen=True)
class ScanTrack:
    """A scan for `plot_scan`: unit vectors (n, 3) of the boresight, ICRS; the scan's centre (RA,
    Dec) [rad].
    """

    name: str
    centre: tuple[float, float]
    directions: NDArray[np.float64]

    @classmethod
    def of(cls, observation: Observation, most: int = 20000) -> ScanTrack:
        """The track of a scan, from at most ``most`` evenly spaced samples."""
        from zonda.core.numerics.projection import boresights

        step = -(-observation.n_samples // most)
        return cls(
            observation.name, observation.centre, boresights(observation.boresight_radec[::step]).T
        )


def _binned(
    frequency: AnyFloats, psd: AnyFloats, per_decade: int = 24
) -> tuple[AnyFloats, AnyFloats]:
    """Means of a spectrum in logarithmic bins (each at least one frequency wide)."""
    position = np.floor(np.log10(frequency / frequency[0]) * per_decade).astype(int)
    _, first = np.unique(position, return_index=True)
    count = np.diff(np.append(first, frequency.size))
    return np.add.reduceat(frequency, first) / count, np.add.reduceat(psd, first) / count


def plot_spectra(
    spectrum: Spectrum, *, ax: Any = None, title: str = "Power spectra of the time streams"
) -> Axes:
    """One-sided power spectra, log-log: thin lines as measured, thick ones averaged in logarithmic
    bins.

    Dashed are closed forms: the level of white noise, 2 NET^2, and the laws of 1/f noise and of the
    atmosphere. The dotted line is the measured knee, where the spectrum of pink noise crosses that
    of white noise; it scatters about the knee of the law. Shades and names above tell which of the
    three laws dominates.
    """
    ax = new_axes(ax)
    names = {
        "signal": "signal (all)",
        "sky": "astronomical sky",
        "pink": "pink noise",
        "white": "white noise",
    }
    top, bottom = 0.0, np.inf
    others = [name for name in spectrum.psd if name not in COLOURS]
    colours = COLOURS | dict(zip(others, (OTHER, *SEQUENCE[4:], *SEQUENCE), strict=False))
    for name, psd in spectrum.psd.items():
        good = np.isfinite(psd) & (psd > 0)
        if not good.any():
            continue
        frequency, power = spectrum.frequency[good], psd[good]
        x, y = _binned(frequency, power)
        ax.loglog(frequency, power, color=colours.get(name, OTHER), linewidth=0.5, alpha=0.25)
        width, order = (2.2, 3) if name == "signal" else (1.6, 2.5)
        ax.loglog(
            x,
            y,
            color=colours.get(name, OTHER),
            linewidth=width,
            label=names.get(name, name),
            zorder=order,
        )
        if name != "sky" or len(spectrum.psd) == 1:
            top, bottom = max(top, float(y.max())), min(bottom, float(np.percentile(y, 5)))
    floor = spectrum.white_level if {"white", "signal"} & set(spectrum.psd) else 0.0
    if floor > 0:
        top, bottom = max(top, floor), min(bottom, floor)
    if 0 < bottom < top:
        ax.set_ylim(max(bottom * 1e-2, min(floor or bottom, top) * 1e-4), top * 5)
    ax.set_xlim(spectrum.frequency[0], spectrum.frequency[-1])
    for name, law in spectrum.closed_forms.items():
        ax.loglog(
            spectrum.frequency,
            law,
            color=colours[name],
            linestyle=(0, (4, 2)),
            linewidth=1.1,
            zorder=3.5,
        )
    _mark_regimes(ax, spectrum.regimes())
    _mark_levels(ax, floor, spectrum.knee())
    log_labels(ax.xaxis, *ax.get_xlim())
    log_labels(ax.yaxis, *ax.get_ylim())
    kinds = {unit_of_stream(name) for name in spectrum.psd}
    what = (
        {"K_RJ": ", Rayleigh–Jeans [K²/Hz]", "m": " [m²/Hz]"}.get(next(iter(kinds)), " [1/Hz]")
        if len(kinds) == 1
        else ""
    )
    _name(ax, "frequency [Hz]", f"power spectral density{what}")
    ax.legend(frameon=False, fontsize=9, loc="upper right")
    ax.set_title(title)
    return ax  # type: ignore[no-any-return]


def _mark_regimes(ax: Any, regimes: Sequence[tuple[str, float, float]]) -> None:
    """Shade the frequencies where each law dominates, and write its name at the lower edge if there
    is room.
    """
    words = {"atmosphere": "atmosphere", "pink": "1/f noise", "white": "white noise"}
    low, high = np.log10(ax.get_xlim())
    for name, start, stop in regimes:
        ax.axvspan(start, stop, color=COLOURS[name], alpha=0.07, linewidth=0, zorder=0)
        if (np.log10(stop / start)) / (high - low) > 0.015 * len(words[name]):
            place: dict[str, Any] = {
                "xycoords": ("data", "axes fraction"),
                "ha": "center",
                "va": "bottom",
                "fontsize": 8.5,
            }
            ax.annotate(
                words[name],
                (np.sqrt(start * stop), 0.012),
                color=COLOURS[name],
                bbox=PALE,
                zorder=4,
                **place,
            )


def _mark_levels(ax: Any, level: float, knee: float | None) -> None:
    """The level of white noise (0: none) and the knee [Hz] of a picture of spectra."""
    if level > 0:
        ax.axhline(level, color="black", linestyle="--", linewidth=1.0, zorder=2)
        text = f"2 NET² (NET = {np.sqrt(level / 2) * 1e3:.3g} mK√s)"
        place: dict[str, Any] = {
            "xycoords": ("axes fraction", "data"),
            "xytext": (-4, -5),
            "ha": "right",
            "va": "top",
        }
        ax.annotate(text, (1, level), textcoords="offset points", fontsize=8, **place)
    if knee is not None:
        ax.axvline(knee, color="black", linestyle=":", linewidth=1.0, zorder=2)
        place = {
            "xycoords": ("data", "axes fraction"),
            "xytext": (4, 0),
            "rotation": 90,
            "va": "bottom",
            "bbox": PALE,
        }
        ax.annotate(
            f"measured knee {knee:.2g} Hz",
            (knee, 0.06),
            textcoords="offset points",
            fontsize=8,
            zorder=4,
            **place,
        )


def _name(ax: Any, across: str, up: str, grey: str = "0.9") -> None:
    """Names of the axes, and a grid."""
    ax.set_xlabel(across)
    ax.set_ylabel(up)
    ax.grid(which="major", color=grey, linewidth=0.7)


def _legend(ax: Any, **style: Any) -> None:
    """A legend whose lines are wide enough for their colours to be told apart."""
    for line in ax.legend(fontsize=8, **style).get_lines():
        line.set_linewidth(2)


def plot_transfer(transfer: Transfer, *, ax: Any = None, title: str = "Transfer function") -> Axes:
    """Share of each angular scale that the filters leave: T with its standard error, and S, the
    ratio of amplitudes.

    S grows without bound where the beam leaves no sky: above 2 it is not drawn, so that T can be
    read; the legend says where. Horizontal bars are the rings. The dotted line is the beam's FWHM;
    the upper axis counts wavelengths.
    """
    ax = new_axes(ax, (7.2, 4.8))
    r = transfer.rings
    scale, edges = transfer.scale / ARCSEC, 1 / transfer.edges / ARCSEC
    width = [np.abs(scale - edges[1:]), np.abs(edges[:-1] - scale)]
    error = np.where(np.isfinite(r.error), r.error, 0.0)
    ax.errorbar(
        scale,
        r.transfer,
        yerr=error,
        xerr=width,
        fmt="o",
        color=SEQUENCE[0],
        markersize=4,
        label="T: share in phase",
    )
    high = scale[r.amplitude > 2].max(initial=0.0)
    label = "S: ratio of amplitudes" + (f" (above 2 from {high:.2g} arcsec down)" if high else "")
    shown = np.where(r.amplitude > 2, np.nan, r.amplitude)
    ax.plot(scale, shown, "--", color=SEQUENCE[1], linewidth=1.2, label=label)
    ax.set_xscale("log")
    ax.set_xlim(edges[0], edges[-1])
    log_labels(ax.xaxis, edges[-1], edges[0])
    top = float(np.nanmax(np.append(shown, r.transfer), initial=1.0))
    ax.set_ylim(min(0.0, float(np.nanmin(r.transfer, initial=0.0))) * 1.05, 1.15 * top)
    ax.axhline(1.0, color="0.6", linewidth=0.8, zorder=1)
    if transfer.fwhm > 0 and edges[-1] <= transfer.fwhm / ARCSEC <= edges[0]:
        ax.axvline(transfer.fwhm / ARCSEC, color="black", linestyle=":", linewidth=1.0)
    upper = ax.secondary_xaxis("top", functions=(_to_kilolambda, _to_kilolambda))
    upper.set_xlabel("baseline [1000 wavelengths]")
    log_labels(upper.xaxis, _to_kilolambda(edges[0]), _to_kilolambda(edges[-1]))
    _name(ax, "angular scale [arcsec]", "transfer function")
    ax.legend(frameon=False, fontsize=9, loc="best")
    ax.set_title(title)
    return ax  # type: ignore[no-any-return]


def _to_kilolambda(arcsec: Any) -> Any:
    """1000 wavelengths of a scale in arcsec, and back: the function is its own inverse."""
    with np.errstate(divide="ignore"):
        return 1e-3 / (np.asarray(arcsec, np.float64) * ARCSEC)


def _envelope(x: AnyFloats, y: AnyFloats, columns: int = 1600) -> tuple[AnyFloats, AnyFloats]:
    """Lowest and highest of y, in turn, in ``columns`` equal parts: what a line of many more points
    looks like.
    """
    width = len(y) // columns
    if width < 4:
        return x, y
    whole = width * columns
    parts, ends = y[:whole].reshape(columns, width), y[whole:]
    both = np.stack([parts.min(axis=1), parts.max(axis=1)], axis=1).ravel()
    at = x[:whole].reshape(columns, width)[:, [width // 4, 3 * width // 4]].ravel()
    return np.append(at, x[whole:]), np.append(both, ends)


def plot_tod(stream: TimeStream, *, ax: Any = None, name: str = "signal", title: str = "") -> Axes:
    """Stream ``name`` of a few detectors against time, K_RJ: samples pale, means over one second
    dark.
    """
    ax = new_axes(ax, (7.2, 3.6))
    values = stream.streams[name]
    finite = values[np.isfinite(values)]
    largest = float(np.abs(finite).max()) if finite.size else 1.0
    factor, unit = unit_of(largest)
    label = f"{name}, Rayleigh–Jeans [{unit}]"
    if (kind := unit_of_stream(name)) != "K_RJ":
        words = {
            "transmission": "relative change of the transmission",
            "opacity": "change of the opacity",
        }
        words |= {"pwv": "change of the line-of-sight PWV", "path_delay": "change of the path"}
        factor, unit = (factor, f" [{unit.replace('K', 'm')}]") if kind == "m" else (1.0, "")
        label = words.get(name, name) + unit
    step = (
        float(np.median(np.diff(stream.seconds))) if len(stream.seconds) > 1 else 0.0
    )  # samples need not be a comb
    width = max(1, round(1.0 / step)) if step > 0 else 1
    whole = values.shape[1] // width * width
    centres = stream.seconds[:whole].reshape(-1, width).mean(axis=1)
    for k, detector in enumerate(stream.names):
        colour = SEQUENCE[k % len(SEQUENCE)]
        ax.plot(
            *_envelope(stream.seconds, values[k] * factor), linewidth=0.4, alpha=0.2, color=colour
        )
        ax.plot(
            centres,
            values[k, :whole].reshape(-1, width).mean(axis=1) * factor,
            linewidth=0.9,
            color=colour,
            label=detector,
        )
    _name(ax, "time since the start of the scan [s]", label, "0.92")
    ax.margins(x=0)
    if len(stream.seconds) > 1:
        ax.set_xlim(stream.seconds[0], stream.seconds[-1])
    if values.shape[0]:
        rows = -(-len(stream.names) // 6)
        if rows <= 3:  # above the lines
            low, high = ax.get_ylim()
            ax.set_ylim(low, high + (high - low) * 0.08 * rows)
        frame = {"frameon": rows > 3, "framealpha": 0.85, "edgecolor": "none"}
        _legend(ax, **frame, ncols=min(6, len(stream.names)), loc="upper right")
    ax.set_title(title or f"Time streams of {stream.observation}, after step {stream.label}")
    return ax  # type: ignore[no-any-return]


def plot_scan(
    observations: Sequence[Observation | ScanTrack],
    *,
    ax: Any = None,
    title: str = "Boresight track",
) -> Axes:
    """ScanTrack of the boresight about the centre of the first scan, tangent-plane offsets in
    arcmin or deg, a line per scan.

    Earlier scans are drawn wider: a scan that repeats another's track does not hide it.
    """
    tracks = [o if isinstance(o, ScanTrack) else ScanTrack.of(o) for o in observations]
    named, own = len(tracks) <= 8, ax is None
    ax = new_axes(ax, (5.7, 5.2))
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
    _name(ax, f"RA offset [{unit}]", f"Dec offset [{unit}]", "0.92")
    if named:
        beside = {"loc": "upper left", "bbox_to_anchor": (1.0, 1.0), "frameon": False}
        within = {"loc": "upper right", "framealpha": 0.85, "edgecolor": "none"}
        _legend(ax, **(beside if own else within))
    ax.set_title(title)
    return ax  # type: ignore[no-any-return]


def _offsets(track: ScanTrack, centre: tuple[float, float]) -> NDArray[np.float64]:
    """(n, 2) arcmin east and north of ``centre`` on its tangent plane; NaN far from it."""
    cosine, east, north = local_axes(*centre) @ track.directions.T
    plane = np.stack([east, north], axis=1) / np.where(cosine > 0.1, cosine, np.nan)[:, None]
    return np.asarray(plane / ARCMIN, np.float64)


def _apart(points: NDArray[np.float64], least: float) -> NDArray[np.float64]:
    """The points of a track (n, 2), without those less than ``least`` along it from one that is
    kept.
    """
    steps = np.nan_to_num(np.hypot(*np.diff(points, axis=0).T))
    if least <= 0 or len(points) < MANY:
        return points
    part = np.floor(np.append(0.0, np.cumsum(steps)) / least)
    keep = np.append(True, part[1:] != part[:-1]) | ~np.isfinite(points).all(axis=1)
    keep[-1] = True
    return points[keep]


def plot_modes(modes: Modes, *, axes: Any = None, title: str = "Modes") -> Axes:
    """Share of the variance in each mode, and the leading modes in time, below one another;
    ``axes``: two Axes to draw into.
    """
    left, right = new_axes(
        axes, (9.6, 4.2), ncols=2, width_ratios=(0.30, 0.515), gridspec_kw={"wspace": 0.3}
    )
    share = modes.shares[modes.shares > 0]
    left.loglog(
        np.arange(1, share.size + 1), share, "o-", color=SEQUENCE[0], markersize=3.5, linewidth=0.9
    )
    for k, value in enumerate(share[:2]):
        place: dict[str, Any] = {"xytext": (5, 5), "textcoords": "offset points", "fontsize": 9}
        left.annotate(f"{100 * value:.3g} %", (k + 1, value), **place)
    left.set_xlabel("mode")
    left.set_ylabel("share of the variance")
    left.set_xlim(0.8, max(2.0, 1.2 * share.size))
    left.grid(which="major", color="0.9", linewidth=0.7)
    for axis, limits in ((left.xaxis, left.get_xlim()), (left.yaxis, left.get_ylim())):
        log_labels(axis, *limits)
    rows = modes.streams[:MODES] / np.sqrt(max(1, modes.vectors.shape[1]))
    peak = float(np.nanmax(abs(rows), initial=0.0)) or 1.0
    factor, unit = unit_of(peak) if modes.unit else (1.0, "")
    step = max(1, rows.shape[1] // 4000)
    for k, row in enumerate(rows):
        right.plot(
            modes.seconds[::step],
            row[::step] * factor,
            linewidth=0.7,
            color=SEQUENCE[k],
            label=f"{k + 1}",
            zorder=4 - k,
        )
    right.set_xlabel(f"time since the start of {modes.observation} [s]")
    right.set_ylabel(f"mode / √rows [{unit}]" if unit else "mode / √rows")
    right.margins(x=0)
    low, high = right.get_ylim()
    right.set_ylim(low, high + 0.12 * (high - low))
    right.grid(color="0.92", linewidth=0.7)
    _legend(right, frameon=False, ncols=MODES, loc="upper right")
    left.set_title(title, fontsize=10)
    return left  # type: ignore[no-any-return]
