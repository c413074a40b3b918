"""Pictures of focal planes, passbands, scans and time streams.

An `Instrument`, `Band` or `Observation` draws itself with these functions, whose arguments have no
such types therefore: modules import each other one way.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from .canvas import SEQUENCE, finish, new_figure, unit_of, wide_legend
from .focalplane import Focalplane
from .numerics.projection import boresights
from .numerics.sphere import ARCMIN, local_axes
from .types import AnyFloats, Floats

if TYPE_CHECKING:
    from matplotlib.figure import Figure

UNITS = ((math.radians(1), "deg"), (math.radians(1 / 60), "arcmin"), (0.0, "arcsec"))
"""Least size for which a unit is taken, rad, and its name."""
PLACES = 14
"""Places of pixels that the middle shows, at least; a beam more on either side."""


def focal_plane_figure(instrument: Any, plane: Focalplane, notebook: bool = False) -> Figure:
    """Draw all detectors on the left, the middle on the right: circles are the FWHM to scale, ticks
    the polarization angles. ``notebook``: in a figure of pyplot.
    """
    name = instrument.name if len(instrument.name) < 60 else f"{instrument.name[:57]}..."
    telescope = f"{instrument.telescope.name}, {instrument.telescope.diameter:g} m"
    title = f"{name}: {len(plane)} detectors on {telescope}"
    figure = new_figure(title, (12.0, 6.4), notebook)
    whole, middle = figure.subplots(1, 2)
    draw_focal_plane(whole, instrument, plane)
    centre, reach = _middle(plane)
    _draw(middle, instrument, plane, reach, centre, ticks=True)
    inside = "inside a wafer" if len(np.unique(plane.wafer)) > 1 else "inside"
    angles = ", polarization angles" if plane.polarized else ""
    middle.set_title(f"{inside}: beams (FWHM) to scale{angles}", fontsize=10)
    return figure  # type: ignore[no-any-return]


def draw_focal_plane(ax: Any, instrument: Any, plane: Focalplane) -> None:
    """Draw all detectors, and the outlines of wafers."""
    largest = max(plane.radius + float(plane.fwhm.max()) / 2, 1e-9)
    _draw(ax, instrument, plane, largest, (0.0, 0.0))
    ax.legend(loc="upper right", frameon=True, fontsize=9, framealpha=0.8)
    outlined = ", wafers outlined" if _outlines(ax, plane, largest) else ""
    ax.set_title(f"focal plane{outlined}", fontsize=10)


def _middle(plane: Focalplane) -> tuple[tuple[float, float], float]:
    """Place of the pixel in the middle of the innermost array or wafer, and the distance within
    which this one has `PLACES`.
    """
    first = int(np.argmin(np.hypot(plane.xi, plane.eta)))
    own = np.flatnonzero((plane.band == plane.band[first]) & (plane.wafer == plane.wafer[first]))
    x = plane.xi[own]
    y = plane.eta[own]
    middle = int(np.argmin(np.hypot(x - x.mean(), y - y.mean())))
    centre = float(x[middle]), float(y[middle])
    places = np.unique(np.stack([x, y], axis=1).round(12), axis=0)
    away = np.sort(np.hypot(*(places - centre).T))
    return centre, float(away[min(PLACES, len(away) - 1)]) + float(plane.fwhm.max())


def _draw(
    ax: Any,
    instrument: Any,
    plane: Focalplane,
    reach: float,
    centre: tuple[float, float],
    ticks: bool = False,
) -> None:
    """Draw the detectors within ``reach`` of ``centre``, both in tangents."""
    from matplotlib.collections import EllipseCollection

    unit, name = _unit(reach)
    places = np.stack([plane.xi, plane.eta], axis=1)
    near = (np.abs(places - centre) <= 1.5 * reach).all(axis=1)
    for k, band in enumerate(instrument.cameras):
        own = plane.band == k if instrument.bands else np.ones(len(plane), bool)
        rows = np.flatnonzero(near & own)
        colour = SEQUENCE[k % len(SEQUENCE)]
        size = plane.fwhm[rows] / unit
        beams = EllipseCollection(
            size,
            size,
            np.zeros(len(rows)),
            units="xy",
            offsets=places[rows] / unit,
            offset_transform=ax.transData,
            facecolors="none",
            edgecolors=colour,
            linewidths=0.8 if ticks else 0.3,
            rasterized=True,
        )
        ax.add_collection(beams)
        label = f"{band}: {int(own.sum())}"
        ax.plot([], [], "o", markerfacecolor="none", color=colour, label=label)
        if ticks:
            _ticks(ax, plane, rows, unit, colour)
    dead = places[near & (plane.dead != 0)] / unit
    if len(dead):
        ax.plot(*dead.T, "x", color="0.4", ms=5, label=f"dead: {int(plane.dead.sum())}")
    for limits, at in ((ax.set_xlim, centre[0]), (ax.set_ylim, centre[1])):
        limits((at - 1.04 * reach) / unit, (at + 1.04 * reach) / unit)
    ax.set_aspect("equal")
    ax.set_xlabel(f"xi [{name}], towards increasing azimuth")
    ax.set_ylabel(f"eta [{name}], towards increasing elevation")
    ax.grid(alpha=0.2, lw=0.5)
    ax.set_axisbelow(True)


def _ticks(ax: Any, plane: Focalplane, rows: Any, unit: float, colour: str) -> None:
    """Polarization axes: angles from TOAST's X axis, towards decreasing eta, to its Y axis, towards
    decreasing xi.
    """
    from matplotlib.collections import LineCollection

    rows = rows[plane.polarization_efficiency[rows] > 0]
    angle = plane.polarization_angle[rows]
    half = 0.35 * plane.fwhm[rows] / unit
    axis = np.stack([np.sin(angle), np.cos(angle)], axis=1) * half[:, None]
    at = np.stack([plane.xi[rows], plane.eta[rows]], axis=1) / unit
    lines = list(np.stack([at - axis, at + axis], axis=1))
    ax.add_collection(LineCollection(lines, colors=colour, linewidths=1.2))


def _outlines(ax: Any, plane: Focalplane, reach: float) -> bool:
    """Draw the outline of each wafer in each band; whether there are several wafers."""
    from scipy.spatial import ConvexHull, QhullError

    if len(np.unique(plane.wafer)) < 2:
        return False
    unit, _ = _unit(reach)
    for band, wafer in np.unique(np.stack([plane.band, plane.wafer], axis=1), axis=0):
        rows = (plane.band == band) & (plane.wafer == wafer)
        at = np.unique(np.stack([plane.xi[rows], plane.eta[rows]], axis=1), axis=0) / unit
        try:
            hull: Floats = at[ConvexHull(at).vertices]
        except (QhullError, ValueError):  # fewer than three places, or in a line
            continue
        ax.fill(*hull.T, facecolor="none", edgecolor="0.2", lw=1.0)
    return True


def _unit(reach: float) -> tuple[float, str]:
    """rad of the unit for axes that reach so far, and its name."""
    least, name = next((least, name) for least, name in UNITS if reach >= least)
    return least or math.radians(1 / 3600), name


def draw_passband(ax: Any, band: Any) -> None:
    """Draw the relative transmission of a band over frequency, its centre, and its width about
    it.
    """
    ghz = band.frequency / 1e9
    centre = band.centre / 1e9
    half = band.width / 2e9
    spare = 0.15 * (ghz[-1] - ghz[0])
    x = np.concatenate([[ghz[0] - spare, ghz[0]], ghz, [ghz[-1], ghz[-1] + spare]])
    ax.plot(x, np.pad(band.transmission, 2), color=SEQUENCE[0], linewidth=1.4)
    ax.axvline(
        centre,
        color="black",
        linestyle=":",
        linewidth=1.0,
        label=f"centre {centre:.5g} GHz",
    )
    shade: dict[str, Any] = {"color": SEQUENCE[0], "alpha": 0.12, "linewidth": 0}
    ax.axvspan(centre - half, centre + half, ymax=0.8, label=f"width {2 * half:.4g} GHz", **shade)
    ax.set_xlim(x[0], x[-1])
    ax.set_ylim(0, 1.25)
    finish(ax, "frequency [GHz]", "relative transmission", band.name, loc="upper right")


def draw_tracks(ax: Any, scans: Sequence[Any]) -> None:
    """Draw the boresight about the centre of the first scan, tangent-plane offsets in arcmin or
    deg, a line per scan, from at most 20 000 samples each.

    Earlier scans are drawn wider: a scan that repeats another's track does not hide it.
    """
    tracks = []
    axes = local_axes(*scans[0].centre)
    for o in scans:
        cosine, east, north = axes @ boresights(o.boresight_radec[_thin(o)])
        away = np.where(cosine > 0.1, cosine, np.nan)  # of the tangent plane
        tracks.append(np.stack([east, north]) / away / ARCMIN)
    known = np.concatenate(tracks, axis=1)
    known = known[:, np.isfinite(known).all(axis=0)]
    far = known.size > 0 and float(np.ptp(known, axis=1).max()) > 120
    scale, unit = (60, "deg") if far else (1, "arcmin")
    _lines(ax, scans, [track / scale for track in tracks])
    ax.set_aspect("equal", adjustable="datalim")
    ax.invert_xaxis()
    finish(ax, f"RA offset [{unit}]", f"Dec offset [{unit}]", "Boresight track")


def plot_scans(scans: Sequence[Any], ax: Any = None) -> Any:
    """Draw scans on the sky (`draw_tracks`), and beside it in azimuth and elevation; Axes of the
    former. ``ax``: axes for that alone.
    """
    if ax is not None:
        draw_tracks(ax, scans)
        return ax
    left, right = new_figure("", (11.0, 5.4), notebook=True).subplots(1, 2)
    draw_tracks(left, scans)
    tracks = []
    for o in scans:
        thin = _thin(o)
        tracks.append(np.degrees([np.unwrap(o.azimuth[thin]), o.elevation[thin]]))
    for track in tracks:  # all on the side of the first
        track[0] -= 360 * round((track[0, 0] - tracks[0][0, 0]) / 360)
    _lines(right, scans, tracks)
    start = f"from {scans[0].start} at {scans[0].site.name}"
    finish(right, "azimuth [deg]", "elevation [deg]", f"Azimuth and elevation\n{start}")
    if len(scans) <= 8:
        wide_legend(left, loc="best", frameon=False)
    return left


def _thin(scan: Any) -> slice:
    return slice(None, None, -(-scan.n_samples // 20000))


def _lines(ax: Any, scans: Sequence[Any], tracks: Sequence[AnyFloats]) -> None:
    for k, (o, track) in enumerate(zip(scans, tracks, strict=True)):
        width = 0.6 + 1.2 * (1 - (k + 1) / len(tracks))
        ax.plot(*track, linewidth=width, color=SEQUENCE[k % len(SEQUENCE)], label=o.name)


WORDS = {
    "transmission": "relative change of the transmission",
    "opacity": "change of the opacity",
    "pwv": "change of the line-of-sight PWV",
    "path_delay": "change of the path",
}
"""Streams that are no brightness."""


def draw_stream(
    ax: Any,
    name: str,
    kind: str,
    seconds: Floats,
    values: AnyFloats,
    detectors: Sequence[str],
    title: str,
) -> None:
    """Draw the stream ``name`` of a few detectors (n, n_samp) against time: samples pale, means
    over one second dark. ``kind``: its unit (`core.stream.unit_of_stream`).
    """
    finite = values[np.isfinite(values)]
    factor, unit = unit_of(float(np.abs(finite).max()) if finite.size else 1.0)
    label = f"{name}, Rayleigh–Jeans [{unit}]"
    if kind != "K_RJ":
        factor, unit = (factor, f" [{unit.replace('K', 'm')}]") if kind == "m" else (1.0, "")
        label = WORDS.get(name, name) + unit
    step = float(np.median(np.diff(seconds))) if len(seconds) > 1 else 0.0  # they need not be even
    width = max(1, round(1.0 / step)) if step > 0 else 1
    whole = values.shape[1] // width * width
    centres = seconds[:whole].reshape(-1, width).mean(axis=1)
    for k, (detector, row) in enumerate(zip(detectors, values * factor, strict=True)):
        colour = SEQUENCE[k % len(SEQUENCE)]
        ax.plot(seconds, row, linewidth=0.4, alpha=0.2, color=colour)
        means = row[:whole].reshape(-1, width).mean(axis=1)
        ax.plot(centres, means, linewidth=0.9, color=colour, label=detector)
    ax.margins(x=0)
    if len(seconds) > 1:
        ax.set_xlim(seconds[0], seconds[-1])
    finish(ax, "time since the start of the scan [s]", label, title)
    if len(values):
        rows = -(-len(detectors) // 6)
        if rows <= 3:  # above the lines
            low, high = ax.get_ylim()
            ax.set_ylim(low, high + (high - low) * 0.08 * rows)
        frame = {"frameon": rows > 3, "framealpha": 0.85, "edgecolor": "none"}
        wide_legend(ax, **frame, ncols=min(6, len(detectors)), loc="upper right")
