"""Pictures of two maps or streams that are compared, and of radial spectra of maps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.canvas import OTHER, SEQUENCE, Sketch, axis_above, finish, new_axes, unit_of
from zonda.core.maps.map_plots import (
    SHOWN,
    SIGNED,
    Look,
    contour_text,
    map_axes,
    noise_text,
    plot_contours,
    plot_map,
    plot_plain,
    range_of,
    wcs_of,
)
from zonda.core.numerics.sphere import ARCSEC, angle_text

from .compare_streams import StreamComparison
from .map_spectra import MapSpectra
from .series_plots import draw, scans

if TYPE_CHECKING:
    from .comparison.radial import RadialSpectra
    from .comparison.statistics import Comparison

CONTOURS = (-8.0, -4.0, -2.0, 2.0, 4.0)
"""Default levels of the contours on SNR maps."""
DEPTH = 1e-5
"""Least power spectral density that is shown, as a share of the largest."""
MOST_FIDELITY = 100.0
"""End of the scale of fidelity maps."""


def draw_comparison(file: str, found: Comparison, contours: Sequence[float] = ()) -> list[Sketch]:
    """The two maps and their difference; fidelity and SNR; spectra and profiles."""
    return [_maps(file, found), _quality(file, found, contours or CONTOURS), _curves(file, found)]


def _maps(file: str, found: Comparison) -> Sketch:
    planes = found.planes
    where = wcs_of(found.header)
    f = found.values
    axes = map_axes(planes["map"].shape, where, 3)
    both = np.stack([planes["reference"], planes["map"]])
    known = both[np.isfinite(both)]
    low, high, colours = range_of(known, float(np.percentile(np.abs(known), 99.7)))
    same = Look(colours, (low, high))
    away = planes["difference"]
    most = float(np.percentile(np.abs(away[np.isfinite(away)]), SHOWN)) or 1.0
    reference, other = found.names
    style: dict[str, Any] = {"fwhm": found.fwhm or None, "unit": found.unit}
    for ax, (name, title, look) in zip(
        axes,
        (
            ("reference", _short(f"Reference: {reference}"), same),
            ("map", _short(f"Map: {other}"), same),
            ("difference", "Map − reference", Look(SIGNED, (-most, most))),
        ),
        strict=True,
    ):
        plot_map(planes[name], where, ax=ax, title=title, look=look, **style)
    gain = f"Gain {f['gain']:.4g} ± {f['gain error']:.2g}, correlation {f['correlation']:.4g}."
    notes = f"{other} against {reference}: {'; '.join(found.notes)}."
    caption = f"{notes} {gain} Both maps have one scale; the difference has its own."
    return Sketch(file, "Comparison", caption, axes[0])


def _quality(file: str, found: Comparison, levels: Sequence[float]) -> Sketch:
    planes = found.planes
    where = wcs_of(found.header)
    snr = planes.get("snr")
    fidelity = planes["fidelity"]
    axes = map_axes(fidelity.shape, where, 1 if snr is None else 2)
    finite = fidelity[np.isfinite(fidelity)]  # infinite where maps are equal
    most = (min(MOST_FIDELITY, float(np.percentile(finite, 99.9))) if finite.size else 0.0) or 1.0
    plot_plain(fidelity, where, (0.0, most), "viridis", "fidelity", ax=axes[0], title="Fidelity")
    caption = "Fidelity: |reference| / max(|difference|, threshold times its rms)."
    if snr is not None:
        reached = [abs(level) for level in levels if (snr * np.sign(level) >= abs(level)).any()]
        top = float(math.ceil(max(float(np.nanpercentile(np.abs(snr), 99.9)), *reached, 1.0)))
        words = found.noise["snr"][0]
        name = "signal-to-noise ratio"
        title = f"Signal-to-noise ratio, {noise_text(words, short=True)}"
        plot_plain(snr, where, (-top, top), "RdBu_r", name, ax=axes[1], title=title)
        plot_contours(axes[1], snr, levels)
        lines = f" Contours of the SNR: {contour_text(levels)} (negative ones dashed)."
        caption += f"{lines} Its noise: {noise_text(words)}."
    return Sketch(f"{file}_quality", "Fidelity and SNR", caption, axes[0])


def _curves(file: str, found: Comparison) -> Sketch:
    left, right = new_axes((10.6, 4.9), above=0.9, ncols=2, gridspec_kw={"wspace": 0.25})
    plot_radial_spectra(left, found.spectra, found.unit, found.fwhm)
    p = found.profiles
    names = dict(zip(("reference", "map"), found.names, strict=True))
    used = np.isfinite(p.mean["map"])
    factor = 1.0
    unit = found.unit
    if unit == "K_RJ":
        peaks = (float(np.abs(mean[used]).max(initial=0.0)) for mean in p.mean.values())
        factor, unit = unit_of(max(peaks))
    radius = p.radius[used] / ARCSEC
    style: dict[str, Any] = {"fmt": "o-", "linewidth": 1.3, "markersize": 3, "elinewidth": 0.8}
    for colour, (name, mean) in zip(SEQUENCE, p.mean.items(), strict=False):
        error = factor * np.nan_to_num(p.error[name][used])
        label = _short(names.get(name, name), 28)
        right.errorbar(radius, factor * mean[used], error, color=colour, label=label, **style)
    right.axhline(0.0, color="0.6", linewidth=0.8, zorder=1)
    right.set_xlim(0, float(radius.max()))
    up = f"mean brightness [{unit}]" if unit else "mean brightness"
    finish(right, "distance from the centre [arcsec]", up, "Radial profiles", loc="best")
    left.set_title("Radial power spectra")
    what = "Power spectral densities in rings of angular scale under a cosine window, and means in"
    caption = f"{what} rings about the map's centre."
    if found.fwhm:
        caption += f" Resolution {angle_text(found.fwhm)} FWHM (dotted)."
    return Sketch(f"{file}_spectra", "Spectra and profiles", caption, left)


def plot_radial_spectra(
    ax: Any,
    found: RadialSpectra,
    unit: str,
    fwhm: float = 0.0,
    names: Mapping[str, str] | None = None,
) -> Any:
    """Power spectral densities against the angular scale, log-log; shaded: standard errors; dashed:
    the white level.
    """
    scale = found.scale / ARCSEC
    values = []
    error = 1 / np.sqrt(np.maximum(found.modes, 1.0))
    for k, (name, power) in enumerate(found.power.items()):
        good = np.isfinite(power) & (power > 0)
        x = scale[good]
        y = power[good] / ARCSEC**2
        e = error[good]
        colour = SEQUENCE[k % len(SEQUENCE)]
        label = (names or {}).get(name, name)
        ax.plot(x, y, "o-", color=colour, linewidth=1.4, markersize=3, label=label)
        low = y * np.maximum(1 - e, 0.05)
        high = y * (1 + e)
        ax.fill_between(x, low, high, color=colour, alpha=0.15, linewidth=0)
        values.append(y)
        if name in found.white:
            known = np.isfinite(found.white[name])
            x = scale[known]
            y = found.white[name][known] / ARCSEC**2
            ax.plot(x, y, "--", color=colour, linewidth=1.0, label=f"white level of {name}")
            values.append(y)
    for name, power in found.cross.items():
        if name.endswith("_TE"):
            good = np.isfinite(power) & (power != 0)
            x = scale[good]
            y = np.abs(power[good]) / ARCSEC**2
            ax.plot(x, y, ":", color="0.4", linewidth=1.2, label=f"|{name}|")
    ax.set_xscale("log")
    ax.set_yscale("log")
    every = np.concatenate(values) if values else np.ones(1)
    top = float(every.max(initial=1e-300))
    ax.set_ylim(max(float(every.min(initial=top)) / 2, DEPTH * top), 3 * top)
    first, last = (1 / found.edges[k] / ARCSEC for k in (0, -1))
    ax.set_xlim(first, last)
    if last < fwhm / ARCSEC < first:
        ax.axvline(fwhm / ARCSEC, color="black", linestyle=":", linewidth=1.0)
    axis_above(ax, 60.0, "wavenumber 1/scale [1/arcmin]")
    up = f"power spectral density [{unit}² arcsec²]" if unit else "power spectral density [arcsec²]"
    finish(ax, "angular scale [arcsec]", up, loc="best")
    return ax


@draw.register
def draw_map_spectra(found: MapSpectra, file: str, where: str) -> list[Sketch]:
    """Radial spectra of maps, each with the white level that its noise promises."""
    ax = new_axes((7.2, 5.4), above=0.9)
    plot_radial_spectra(ax, found.spectra, "K_RJ", found.fwhm, found.names)
    ax.set_title("Radial power spectra of the maps")
    what = "Power spectral densities of the maps in rings of angular scale under a cosine window"
    caption = f"{what} over the well covered field."
    if found.spectra.white:
        caption += " Dashed: the level of the white noise that the maps state."
    if found.fwhm:
        caption += f" Dotted: the beam, {angle_text(found.fwhm)} FWHM."
    return [Sketch(file, "Radial power spectra of maps", caption, ax)]


def _short(text: str, most: int = 46) -> str:
    """The text, its middle left out where it is long."""
    half = math.floor((most - 1) / 2)
    return text if len(text) <= most else f"{text[:half]}…{text[-half:]}"


@draw.register
def draw_stream_comparison(found: StreamComparison, file: str, where: str) -> list[Sketch]:
    """Spectra, their ratio and the coherence."""
    heights: dict[str, Any] = {"height_ratios": (0.43, 0.21, 0.20), "gridspec_kw": {"hspace": 0.06}}
    axes = spectra, ratio, coherence = new_axes((7.2, 7.2), nrows=3, sharex=True, **heights)
    f, (x, y, d) = found.frequency, found.power
    for row, label, colour in (
        (x, found.stream, "black"),
        (y, found.reference, SEQUENCE[0]),
        (d, "difference", SEQUENCE[1]),
    ):
        if np.isfinite(row).all() and (row > 0).any():
            shown = np.where(row > 0, row, np.nan)
            spectra.loglog(f, shown, color=colour, linewidth=1.1, label=label)
    positive = y > 0
    ratio.loglog(f[positive], x[positive] / y[positive], color="black", linewidth=0.9)
    (r, scatter, error), (gain, _, gain_error) = map(found.over_detectors, ("correlation", "gain"))
    if np.isfinite(gain) and gain != 0:
        ratio.axhline(gain**2, color=OTHER, linestyle="--", linewidth=1.0)
    coherence.semilogx(f, found.coherence, color="black", linewidth=0.9)
    coherence.axhline(1 / found.segments, color=OTHER, linestyle="--", linewidth=1.0)
    coherence.set_ylim(0, 1.05)
    spectra.set_xlim(f[0], f[-1])
    for ax, up in zip(
        axes,
        ("power spectral density [unit²/Hz]", "ratio", "coherence"),
        strict=True,
    ):
        finish(ax, "frequency [Hz]" if ax is coherence else "", up)
    spectra.legend(frameon=False, fontsize=9)
    spectra.set_title(f"{found.stream} and {found.reference}")
    many = f"{len(found.names)} detectors and {scans(found.observations)}"
    caption = (
        f"Streams {found.stream} and {found.reference} at step {found.label}, mean of {many}: power"
        f" spectra on the calibrated sky, their ratio (dashed: gain², {gain:.4g} ±"
        f" {gain_error:.2g}) and the coherence (dashed: 1/n of independent streams, n ="
        f" {found.segments:.3g} segments). Correlation {r:.4f} ± {error:.2g} of one detector,"
        f" scatter over detectors {scatter:.2g}."
    )
    return [Sketch(file, "Streams compared", caption, spectra)]
