"""Pictures of spectra, modes, time streams and scans."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import singledispatch
from typing import Any

import numpy as np

from zonda.core.canvas import (
    COLOURS,
    OTHER,
    PALE,
    SEQUENCE,
    Drawable,
    Sketch,
    axis_above,
    finish,
    new_axes,
    unit_of,
    wide_legend,
)
from zonda.core.data import Observation
from zonda.core.numerics.sphere import ARCSEC
from zonda.core.plots import draw_stream, draw_tracks
from zonda.core.stream import unit_of_stream
from zonda.core.types import AnyFloats

from .series import Modes, Spectrum, TimeStream
from .transfer_function import Transfer

LARGEST_RATIO = 2.0
"""S of a ring of a transfer function above which its power was brought from other scales: a filter
does not double amplitudes.
"""
MODES = 4
"""Modes whose streams are drawn."""
PER_DECADE = 24
"""Bins of a drawn spectrum per decade of frequency."""


def _binned(
    frequency: AnyFloats,
    psd: AnyFloats,
) -> tuple[AnyFloats, AnyFloats]:
    """Means of a spectrum in logarithmic bins (each at least one frequency wide)."""
    position = np.floor(np.log10(frequency / frequency[0]) * PER_DECADE).astype(int)
    _, first = np.unique(position, return_index=True)
    count = np.diff(np.append(first, frequency.size))
    return np.add.reduceat(frequency, first) / count, np.add.reduceat(psd, first) / count


@singledispatch
def draw(product: Any, file: str, where: str) -> list[Sketch]:
    """Pictures of a product whose names begin with ``file``; none of a product of another kind.
    ``where``: the step it was measured at, in words.
    """
    return product.sketches(file) if isinstance(product, Drawable) else []


def scans(number: int) -> str:
    """A number of scans in words."""
    return f"{number} scan{'s' if number > 1 else ''}"


@draw.register
def draw_spectra(spectrum: Spectrum, file: str, where: str) -> list[Sketch]:
    """Draw power spectra, one picture for the streams of each unit."""
    made = []
    for kind in dict.fromkeys(map(unit_of_stream, spectrum.psd)):
        psd = {name: psd for name, psd in spectrum.psd.items() if unit_of_stream(name) == kind}
        sky = kind == "K_RJ"
        caption = (
            f"Mean of {spectrum.detectors} detectors and {scans(spectrum.observations)} {where}"
        )
        if sky:
            caption += ", referred to the calibrated sky: divided by ζ exp(−τ), the atmosphere"
            caption += " multiplied by ε"
        caption += "."
        if "signal" in psd:
            caption += " The signal holds the mean emission too, which changes as the scan moves"
            caption += " in elevation."
        unit = {"K_RJ": ", Rayleigh–Jeans [K²/Hz]", "m": " [m²/Hz]"}.get(kind, " [1/Hz]")
        ax = _spectra(replace(spectrum, psd=psd))
        title = f"Power spectra of the time streams {where}"
        up = f"power spectral density{unit}"
        finish(ax, "frequency [Hz]", up, title, fontsize=9, loc="upper right")
        name = file if sky else f"{file}_{'_'.join(psd)}"
        made.append(Sketch(name, "Power spectra", caption, ax))
    return made


def _spectra(spectrum: Spectrum) -> Any:
    """One-sided power spectra, log-log: thin lines as measured, thick ones averaged in logarithmic
    bins.

    Dashed are closed forms: the level of white noise, 2 NET^2, and the laws of 1/f noise and of the
    atmosphere. The dotted line is the measured knee, where the spectrum of pink noise crosses that
    of white noise; it scatters about the knee of the law. Shades and names above tell which of the
    three laws dominates.
    """
    ax = new_axes()
    names = {
        "signal": "signal (all)",
        "sky": "astronomical sky",
        "pink": "pink noise",
        "white": "white noise",
    }
    top = 0.0
    bottom = np.inf
    others = [name for name in spectrum.psd if name not in COLOURS]
    colours = COLOURS | dict(zip(others, (OTHER, *SEQUENCE[4:], *SEQUENCE), strict=False))
    for name, psd in spectrum.psd.items():
        good = np.isfinite(psd) & (psd > 0)
        if not good.any():
            continue
        colour = colours.get(name, OTHER)
        x = spectrum.frequency[good]
        y = psd[good]
        ax.loglog(x, y, color=colour, linewidth=0.5, alpha=0.25)
        mean = _binned(x, y)
        width, order = (2.2, 3) if name == "signal" else (1.6, 2.5)
        label = names.get(name, name)
        ax.loglog(*mean, color=colour, linewidth=width, label=label, zorder=order)
        if name != "sky" or len(spectrum.psd) == 1:
            top = max(top, float(mean[1].max()))
            bottom = min(bottom, float(np.percentile(mean[1], 5)))
    floor = spectrum.white_level if {"white", "signal"} & set(spectrum.psd) else 0.0
    if floor > 0:
        top = max(top, floor)
        bottom = min(bottom, floor)
    if 0 < bottom < top:
        ax.set_ylim(max(bottom * 1e-2, min(floor or bottom, top) * 1e-4), top * 5)
    ax.set_xlim(spectrum.frequency[0], spectrum.frequency[-1])
    dashed: dict[str, Any] = {"linestyle": (0, (4, 2)), "linewidth": 1.1, "zorder": 3.5}
    for name, law in spectrum.closed_forms.items():
        ax.loglog(spectrum.frequency, law, color=colours[name], **dashed)
    _mark_regimes(ax, spectrum.regimes())
    _mark_levels(ax, floor, spectrum.knee())
    return ax


def _mark_regimes(ax: Any, regimes: Sequence[tuple[str, float, float]]) -> None:
    """Shade the frequencies where each law dominates, and write its name at the lower edge if there
    is room.
    """
    words = {"atmosphere": "atmosphere", "pink": "1/f noise", "white": "white noise"}
    low, high = np.log10(ax.get_xlim())
    style: dict[str, Any] = {"xycoords": ("data", "axes fraction"), "ha": "center", "va": "bottom"}
    for name, start, stop in regimes:
        colour = COLOURS[name]
        at = (np.sqrt(start * stop), 0.012)
        ax.axvspan(start, stop, color=colour, alpha=0.07, linewidth=0, zorder=0)
        if np.log10(stop / start) / (high - low) > 0.015 * len(words[name]):
            ax.annotate(words[name], at, color=colour, fontsize=8.5, bbox=PALE, zorder=4, **style)


def _mark_levels(ax: Any, level: float, knee: float | None) -> None:
    """The level of white noise (0: none) and the knee [Hz] of a picture of spectra."""
    small: dict[str, Any] = {"textcoords": "offset points", "fontsize": 8}
    if level > 0:
        ax.axhline(level, color="black", linestyle="--", linewidth=1.0, zorder=2)
        text = f"2 NET² (NET = {np.sqrt(level / 2) * 1e3:.3g} mK√s)"
        place: dict[str, Any] = {"xycoords": ("axes fraction", "data"), "ha": "right", "va": "top"}
        ax.annotate(text, (1, level), xytext=(-4, -5), **place, **small)
    if knee is not None:
        ax.axvline(knee, color="black", linestyle=":", linewidth=1.0, zorder=2)
        place = {"xycoords": ("data", "axes fraction"), "xytext": (4, 0), "rotation": 90}
        text = f"measured knee {knee:.2g} Hz"
        ax.annotate(text, (knee, 0.06), va="bottom", bbox=PALE, zorder=4, **place, **small)


@draw.register
def draw_transfer(transfer: Transfer, file: str, where: str) -> list[Sketch]:
    """Share of each angular scale that the filters leave: T with its standard error, and S, the
    ratio of amplitudes.

    Rings are left out where the sky has no power beside what the filters bring from other scales
    (S above `LARGEST_RATIO`, or none at all). Horizontal bars are the rings. The dotted line is the
    beam's FWHM; the upper axis counts wavelengths.
    """
    ax = new_axes(size=(7.2, 5.0), above=0.9)
    r = transfer.rings
    scale = transfer.scale / ARCSEC
    edges = 1 / transfer.edges / ARCSEC
    known = r.amplitude <= LARGEST_RATIO  # and no NaN
    width = np.stack([np.abs(scale - edges[1:]), np.abs(edges[:-1] - scale)])[:, known]
    style: dict[str, Any] = {"fmt": "o", "markersize": 4, "label": "T: share in phase"}
    error = np.nan_to_num(r.error[known])
    shown = (r.transfer[known], r.amplitude[known])
    ax.errorbar(scale[known], shown[0], yerr=error, xerr=width, color=SEQUENCE[0], **style)
    label = "S: ratio of amplitudes"
    ax.plot(scale[known], shown[1], "--", color=SEQUENCE[1], linewidth=1.2, label=label)
    ax.set_xscale("log")
    ax.set_xlim(edges[0], edges[-1])
    top = float(np.max(shown, initial=1.0))
    bottom = float(np.min(shown, initial=0.0))
    ax.set_ylim(1.05 * bottom, 1.15 * top)
    ax.axhline(1.0, color="0.6", linewidth=0.8, zorder=1)
    if transfer.fwhm > 0 and edges[-1] <= transfer.fwhm / ARCSEC <= edges[0]:
        ax.axvline(transfer.fwhm / ARCSEC, color="black", linestyle=":", linewidth=1.0)
    axis_above(ax, 1e-3 / ARCSEC, "baseline [1000 wavelengths]")
    whose = "the sky alone" if transfer.modes == "sky" else "the complete data"
    more = file.removeprefix("transfer_function").removeprefix("_")
    what = "Transfer function" + (f" ({more})" if more else "")
    title = f"{what}, singular modes of {whose}"
    finish(ax, "angular scale [arcsec]", "transfer function", title, fontsize=9, loc="best")
    caption = (
        "The map of the sky alone through all filters against the same map without filters, by"
        " angular scale: the ratio of their cross spectrum to the spectrum of the latter, with the"
        " standard error from the scatter of the modes (bars); dashed, the ratio of amplitudes."
        f" Dotted, the beam. Singular modes of {whose}."
    )
    if empty := int(np.count_nonzero(~known)):
        text = f"{empty} of {known.size} rings are left out: the sky has no power there"
        ax.annotate(text, (0.5, 0.02), xycoords="axes fraction", ha="center", fontsize=8)
        caption += f" {text}; the table has them."
    return [Sketch(file, what, caption, ax)]


@draw.register
def draw_streams(stream: TimeStream, file: str, where: str) -> list[Sketch]:
    """A picture for each stream."""
    made = []
    for name in stream.streams:
        meaning = "at the detector"
        if name == "signal":
            meaning = "divided by ζ exp(−τ), with the mean emission that no filter has removed"
        elif unit_of_stream(name) != "K_RJ":
            meaning = "along the line of sight, without its mean"
        what = f"Stream {name} of {len(stream.names)} detectors {where}: {meaning}"
        caption = f"{what}. Pale: samples; dark: means over 1 s."
        ax = new_axes((7.2, 3.6))
        title = f"Time streams of {stream.observation} {where}"
        draw_stream(
            ax,
            name,
            unit_of_stream(name),
            stream.seconds,
            stream.streams[name],
            stream.names,
            title,
        )
        own = file if name == "signal" else f"{file}_{name}"
        made.append(Sketch(own, "Time streams", caption, ax))
    return made


def draw_scan(observations: Sequence[Observation]) -> list[Sketch]:
    """Track of the boresight about the centre of the first scan, a line per scan."""
    many = len(observations) > 8
    ax = new_axes(size=(5.7, 5.2 if many else 5.7))
    draw_tracks(ax, observations)
    if not many:  # below the axes
        ax.figure.subplots_adjust(bottom=0.2)
        wide_legend(ax, loc="upper center", bbox_to_anchor=(0.5, -0.13), ncols=4, frameon=False)
    text = "The boresight about the target, one line per scan."
    return [Sketch("scan", "Boresight track", text, ax)]


@draw.register
def draw_modes(modes: Modes, file: str, where: str) -> list[Sketch]:
    """Share of the variance in each mode, and the leading modes in time, below one another."""
    widths: dict[str, Any] = {"width_ratios": (0.30, 0.515), "gridspec_kw": {"wspace": 0.3}}
    left, right = new_axes(size=(9.6, 4.2), ncols=2, **widths)
    share = modes.shares[modes.shares > 0]
    number = np.arange(1, share.size + 1)
    left.loglog(number, share, "o-", color=SEQUENCE[0], markersize=3.5, linewidth=0.9)
    for k, value in enumerate(share[:2], 1):
        place: dict[str, Any] = {"xytext": (5, 5), "textcoords": "offset points", "fontsize": 9}
        left.annotate(f"{100 * value:.3g} %", (k, value), **place)
    left.set_xlim(0.8, max(2.0, 1.2 * share.size))
    finish(left, "mode", "share of the variance", f"Modes {where}")
    rows = modes.streams[:MODES] / np.sqrt(max(1, modes.vectors.shape[1]))
    peak = float(np.nanmax(abs(rows), initial=0.0)) or 1.0
    factor, unit = unit_of(peak) if modes.unit else (1.0, "")
    for k, row in enumerate(rows):
        style: dict[str, Any] = {"label": f"{k + 1}", "zorder": 4 - k, "linewidth": 0.7}
        right.plot(modes.seconds, row * factor, color=SEQUENCE[k], **style)
    right.margins(x=0)
    low, high = right.get_ylim()
    right.set_ylim(low, high + 0.12 * (high - low))
    up = f"mode / √rows [{unit}]" if unit else "mode / √rows"
    finish(right, f"time since the start of {modes.observation} [s]", up)
    wide_legend(right, frameon=False, ncols=MODES, loc="upper right")
    what = f"{modes.detectors} detectors"
    what += f" at {modes.delays + 1} delays of {modes.delay:.3g} s" if modes.delays else ""
    shares = f"left, the share of the variance in each, mean of {scans(len(modes.values))}"
    streams = f"right, the first in time, of {modes.observation}"
    caption = f"Principal components of {what} {where}: {shares}; {streams}."
    return [Sketch(file, "Modes", caption, left)]
