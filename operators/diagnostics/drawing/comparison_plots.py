"""Pictures of two maps or streams that are compared, and of radial spectra of maps."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.canvas import OTHER, SEQUENCE, log_labels, new_axes, unit_of
from zonda.core.drawable import Sketch
from zonda.core.maps.map_plots import (
    contour_text,
    map_axes,
    noise_text,
    plot_contours,
    plot_map,
    plot_plain,
    wcs_of,
)
from zonda.core.numerics.angles import ARCSEC, angle_text
from zonda.core.types import Floats

if TYPE_CHECKING:
    from ..compare_streams import StreamComparison
    from ..comparison.radial import RadialSpectra
    from ..comparison.statistics import Comparison
    from ..map_spectra import MapSpectra

CONTOURS = (-8.0, -4.0, -2.0, 2.0, 4.0)
"""Default levels of the contours on SNR maps."""
DEPTH = 1e-5
"""Least power spectral density that is shown, as a share of the largest."""
MOST_FIDELITY = 100.0
"""End of the scale of fidelity maps."""


def draw_comparison(file: str, found: Comparison, contours: Sequence[float] = ()) -> list[Sketch]:
    """The two maps and their difference; fidelity and SNR; spectra and profiles."""
    levels = contours or CONTOURS
    sketches = [_maps(file, found), _quality(file, found, levels)]
    return [*sketches, _curves(file, found)]


def _maps(file: str, found: Comparison) -> Sketch:
    planes, where = found.planes, wcs_of(found.header)
    shape = planes["map"].shape
    axes = map_axes(shape, where, 3)
    both = np.abs(
        np.concatenate([planes[name][np.isfinite(planes[name])] for name in ("reference", "map")])
    )
    limit = float(np.percentile(both, 99.7))
    reference, other = found.names
    style: dict[str, Any] = {"fwhm": found.fwhm or None, "unit": found.unit}
    plot_map(
        planes["reference"],
        where,
        ax=axes[0],
        title=_short(f"Reference: {reference}"),
        limit=limit,
        **style,
    )
    plot_map(planes["map"], where, ax=axes[1], title=_short(f"Map: {other}"), limit=limit, **style)
    plot_map(planes["difference"], where, ax=axes[2], title="Map − reference", **style)
    f = found.figures
    caption = (
        f"{other} against {reference}: {'; '.join(found.notes)}. Gain {f['gain']:.4g} ±"
        f" {f['gain error']:.2g}, correlation {f['correlation']:.4g}. The difference has a scale of"
        " its own."
    )
    return Sketch(file, "Comparison", caption, axes[0])


def _quality(file: str, found: Comparison, levels: Sequence[float]) -> Sketch:
    planes, where = found.planes, wcs_of(found.header)
    snr = planes.get("snr")
    axes = map_axes(planes["map"].shape, where, 1 if snr is None else 2)
    finite = planes["fidelity"][np.isfinite(planes["fidelity"])]  # infinite where maps are equal
    most = (min(MOST_FIDELITY, float(np.percentile(finite, 99.9))) if finite.size else 0.0) or 1.0
    plot_plain(
        planes["fidelity"], where, (0.0, most), "viridis", "fidelity", ax=axes[0], title="Fidelity"
    )
    caption = "Fidelity: |reference| / max(|difference|, threshold times its rms)."
    if snr is not None:
        reached = [abs(level) for level in levels if (snr * np.sign(level) >= abs(level)).any()]
        top = float(math.ceil(max(float(np.nanpercentile(np.abs(snr), 99.9)), *reached, 1.0)))
        words = noise_text(found.noise["snr"][0])
        title = f"Signal-to-noise ratio, {noise_text(found.noise['snr'][0], short=True)}"
        plot_plain(
            snr, where, (-top, top), "RdBu_r", "signal-to-noise ratio", ax=axes[1], title=title
        )
        plot_contours(axes[1], snr, levels)
        caption += (
            f" Contours of the SNR: {contour_text(levels)} (negative ones dashed). Its noise:"
            f" {words}."
        )
    return Sketch(f"{file}_quality", "Fidelity and SNR", caption, axes[0])


def _curves(file: str, found: Comparison) -> Sketch:
    left, right = new_axes(None, (10.6, 4.6), ncols=2, gridspec_kw={"wspace": 0.25})
    plot_radial_spectra(left, found.spectra, found.unit, found.fwhm)
    p, names = (
        found.profiles,
        {"reference": found.names[0], "map": found.names[1], "difference": "difference"},
    )
    used = np.isfinite(p.mean["map"])
    factor, unit = 1.0, found.unit
    if unit == "K_RJ":
        factor, unit = unit_of(
            max(float(np.abs(mean[used]).max(initial=0.0)) for mean in p.mean.values())
        )
    for k, (name, mean) in enumerate(p.mean.items()):
        error = np.where(np.isfinite(p.error[name]), p.error[name], 0.0)
        style: dict[str, Any] = {
            "color": SEQUENCE[k],
            "linewidth": 1.3,
            "markersize": 3,
            "elinewidth": 0.8,
        }
        right.errorbar(
            p.radius[used] / ARCSEC,
            factor * mean[used],
            yerr=factor * error[used],
            fmt="o-",
            label=_short(names[name], 28),
            **style,
        )
    right.axhline(0.0, color="0.6", linewidth=0.8, zorder=1)
    right.set_xlim(0, float(p.radius[used].max()) / ARCSEC)
    right.set_xlabel("distance from the centre [arcsec]")
    right.set_ylabel(f"mean brightness [{unit}]" if unit else "mean brightness")
    right.grid(which="major", color="0.9", linewidth=0.7)
    right.legend(frameon=False, fontsize=8)
    left.set_title("Radial power spectra")
    right.set_title("Radial profiles")
    caption = (
        "Power spectral densities in rings of angular scale under a cosine window, and means in"
        " rings about the map's centre."
    )
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
    values: list[Floats] = []
    for k, (name, power) in enumerate(found.power.items()):
        good = np.isfinite(power) & (power > 0)
        error = 1 / np.sqrt(np.maximum(found.modes, 1.0))
        colour, y = SEQUENCE[k % len(SEQUENCE)], power / ARCSEC**2
        ax.plot(
            scale[good],
            y[good],
            "o-",
            color=colour,
            linewidth=1.4,
            markersize=3,
            label=(names or {}).get(name, name),
        )
        low, high = (y * np.maximum(1 - error, 0.05))[good], (y * (1 + error))[good]
        ax.fill_between(scale[good], low, high, color=colour, alpha=0.15, linewidth=0)
        values.append(y[good])
        if name in found.white:
            level, known = found.white[name] / ARCSEC**2, np.isfinite(found.white[name])
            ax.plot(
                scale[known],
                level[known],
                "--",
                color=colour,
                linewidth=1.0,
                label=f"white level of {name}",
            )
            values.append(level[known])
    for name, power in found.cross.items():
        if name.endswith("_TE"):
            good = np.isfinite(power) & (power != 0)
            ax.plot(
                scale[good],
                np.abs(power[good]) / ARCSEC**2,
                ":",
                color="0.4",
                linewidth=1.2,
                label=f"|{name}|",
            )
    ax.set_xscale("log")
    ax.set_yscale("log")
    every = np.concatenate(values) if values else np.ones(1)
    top = float(every.max(initial=1e-300))
    ax.set_ylim(max(float(every.min(initial=top)) / 2, DEPTH * top), 3 * top)
    ends = (1 / found.edges[0] / ARCSEC, 1 / found.edges[-1] / ARCSEC)
    ax.set_xlim(*ends)
    if ends[1] < fwhm / ARCSEC < ends[0]:
        ax.axvline(fwhm / ARCSEC, color="black", linestyle=":", linewidth=1.0)
    log_labels(ax.xaxis, ends[1], ends[0])
    log_labels(ax.yaxis, *ax.get_ylim())
    upper = ax.secondary_xaxis("top", functions=(_inverse, _inverse))
    upper.set_xlabel("wavenumber 1/scale [1/arcmin]")
    log_labels(upper.xaxis, _inverse(ends[0]), _inverse(ends[1]))
    ax.set_xlabel("angular scale [arcsec]")
    ax.set_ylabel(
        f"power spectral density [{unit}² arcsec²]" if unit else "power spectral density [arcsec²]"
    )
    ax.grid(which="major", color="0.9", linewidth=0.7)
    ax.legend(frameon=False, fontsize=8)
    return ax


def _inverse(arcsec: Any) -> Any:
    """1/arcmin of a scale in arcsec, and back: the function is its own inverse."""
    with np.errstate(divide="ignore"):
        return 60.0 / np.asarray(arcsec, np.float64)


def draw_map_spectra(file: str, found: MapSpectra) -> list[Sketch]:
    """Radial spectra of maps, each with the white level that its noise promises."""
    ax = new_axes(None, (7.2, 5.2))
    plot_radial_spectra(ax, found.spectra, "K_RJ", found.fwhm, found.names)
    ax.set_title("Radial power spectra of the maps")
    caption = (
        "Power spectral densities of the maps in rings of angular scale under a cosine window over"
        " the well covered field."
    )
    if found.spectra.white:
        caption += " Dashed: the level of white noise by NET and samples."
    if found.fwhm:
        caption += f" Dotted: the beam, {angle_text(found.fwhm)} FWHM."
    return [Sketch(file, "Radial power spectra of maps", caption, ax)]


def _short(text: str, most: int = 46) -> str:
    """The text, its middle left out where it is long."""
    half = math.floor((most - 1) / 2)
    return text if len(text) <= most else f"{text[:half]}…{text[-half:]}"


def draw_stream_comparison(file: str, found: StreamComparison) -> list[Sketch]:
    """Spectra, their ratio and the coherence."""
    spectra, ratio, coherence = new_axes(
        None, (7.2, 7.2), nrows=3, height_ratios=(0.43, 0.21, 0.20), gridspec_kw={"hspace": 0.06}
    )
    f, (x, y, d) = found.frequency, found.power
    for row, label, colour in (
        (x, found.stream, "black"),
        (y, found.reference, SEQUENCE[0]),
        (d, "difference", SEQUENCE[1]),
    ):
        if np.isfinite(row).all() and (row > 0).any():
            spectra.loglog(
                f, np.where(row > 0, row, np.nan), color=colour, linewidth=1.1, label=label
            )
    spectra.set_ylabel("power spectral density [unit²/Hz]")
    spectra.legend(frameon=False, fontsize=9)
    positive = y > 0
    ratio.loglog(f[positive], x[positive] / y[positive], color="black", linewidth=0.9)
    gain = found.over_detectors("gain")[0]
    if np.isfinite(gain) and gain != 0:
        ratio.axhline(gain**2, color=OTHER, linestyle="--", linewidth=1.0)
    ratio.set_ylabel("ratio")
    coherence.semilogx(f, found.coherence, color="black", linewidth=0.9)
    coherence.axhline(1 / found.segments, color=OTHER, linestyle="--", linewidth=1.0)
    coherence.set_ylabel("coherence")
    coherence.set_ylim(0, 1.05)
    coherence.set_xlabel("frequency [Hz]")
    for ax in (spectra, ratio, coherence):
        _finish(ax, f, last=ax is coherence)
    spectra.set_title(f"{found.stream} and {found.reference}")
    return [Sketch(file, "Streams compared", _caption_of_streams(found), spectra)]


def _finish(ax: Any, f: Any, last: bool) -> None:
    ax.set_xlim(f[0], f[-1])
    ax.grid(which="major", color="0.9", linewidth=0.7)
    log_labels(ax.xaxis, *ax.get_xlim())
    if ax.get_yscale() == "log":
        log_labels(ax.yaxis, *ax.get_ylim())
    if not last:
        ax.tick_params(labelbottom=False, which="both")


def _caption_of_streams(found: StreamComparison) -> str:
    (r, scatter, error), (gain, _, gain_error) = (
        found.over_detectors(k) for k in ("correlation", "gain")
    )
    many = (
        f"{len(found.names)} detectors and {found.observations}"
        f" scan{'s' if found.observations > 1 else ''}"
    )
    return (
        f"Streams {found.stream} and {found.reference} at step {found.label}, mean of {many}: power"
        f" spectra on the calibrated sky, their ratio (dashed: gain², {gain:.4g} ±"
        f" {gain_error:.2g}) and the coherence (dashed: 1/n of independent streams, n ="
        f" {found.segments:.3g} segments). Correlation {r:.4f} ± {error:.2g} of one detector,"
        f" scatter over detectors {scatter:.2g}."
    )
