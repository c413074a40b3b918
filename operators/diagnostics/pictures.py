"""Pictures of a run from plain values: what is drawn in the second process. numpy and, when something is drawn, matplotlib."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from zonda.core.numerics.angles import angle_text

from .flat_map import FlatMap
from .map_layout import map_axes
from .map_plots import SHOWN, plot_coverage, plot_map
from .plots import ScanTrack, plot_scan, plot_spectra, plot_tod, plot_transfer
from .png import png_of
from .series import Spectrum, TimeStream
from .sky_axes import SkyAxes


@dataclass(frozen=True)
class Picture:
    """A PNG image: ``name`` without suffix, a title, what it shows, its bytes."""

    name: str
    title: str
    caption: str
    png: bytes


@dataclass(frozen=True)
class Style:
    """Parameters of `Plots`; angles in rad, ``smooth`` None: with the beam, 0: not."""

    smooth: float | None
    central_diameter: float
    least_coverage: float


def draw_input(file: str, values: Any, axes: SkyAxes | None, header: dict[str, Any]) -> list[Picture]:
    """The input map (ny, nx), K_RJ."""
    ax = plot_map(values, header if axes is None else axes, title="Input: the sky before the beam")
    return [Picture(file, "Input", "The input map, before beam, opacity and filters.", png_of(ax))]


def draw_map(file: str, signal: str, key: str, product: FlatMap, style: Style) -> list[Picture]:
    """Plane ``signal`` of a map of a signal, called ``key``."""
    shown, how = _shown(product.cropped(), style)
    title = {"": "Map", "noiseless": "Noiseless map"}.get(signal, f"Map of signal {signal}")
    title += "" if key == "map" else f" ({key})"
    meaning = {
        "": "Everything: sky, atmosphere and noise, filtered and binned.",
        "noiseless": "The sky alone through the same pointing, filters and binning: what the processing leaves of it.",
    }.get(signal, "A part of the components, filtered and binned.")
    limit = shown.limit("signal", shown.hits, SHOWN if signal == "noiseless" else 99.7)
    png = _panels([(shown, _titled(title, how))], style, limit)
    return [Picture(file, title, f"{meaning} {how[0].upper()}{how[1:]}.{_resolution(shown)}", png)]


def draw_noise(file: str, sources: dict[str, FlatMap], style: Style) -> list[Picture]:
    """Maps of noise alone: ``half_difference`` (of the map, which comes first) and ``source_free`` (plane ``signal``)."""
    words = {"half_difference": "even minus odd scans", "source_free": "all but the sky"}
    panels, figures, limits, how = [], [], [], ""
    window = next(iter(sources.values())).window()
    for of, source in sources.items():
        shown, how = _shown(source.cropped(window), style)
        plane = next(iter(shown.planes))
        panels.append((shown, _titled(f"Noise: {words[of]}", how)))
        limits.append(shown.limit(plane, panels[0][0].hits, 99.7))
        rms = shown.central_rms(plane, style.central_diameter / 2)
        if math.isfinite(rms):
            figures.append(f"{words[of]} {rms * 1e6:.4g} µK_RJ")
    limit = max((x for x in limits if x), default=None)
    png = _panels(panels, style, limit, circle=True)
    text = f"Noise maps on one scale, {how}.{_resolution(panels[0][0])}"
    if figures:
        text += f" Weighted rms within the dotted circle of {np.degrees(style.central_diameter) * 60:.3g}′: {', '.join(figures)}."
    return [Picture(file, "Noise", text, png)]


def draw_coverage(file: str, product: FlatMap, samples: int, pixels: int) -> list[Picture]:
    """Samples per pixel and seconds per beam; ``samples`` in ``pixels`` in all."""
    product = product.cropped()
    ax = plot_coverage(product.hits, product.sky, per_beam=product.per_beam)
    text = f"{samples:,} samples in {pixels:,} pixels of {angle_text(product.pixel)}.".replace(",", "\u202f")
    if product.per_beam is not None:
        beam = f"of {angle_text(product.fwhm)} FWHM (area π FWHM² / (4 ln 2))"
        text += f" Integration time: of all detectors together, in the area of the telescope's beam {beam}."
    return [Picture(file, "Coverage", text, png_of(ax))]


def draw_scan(tracks: Sequence[ScanTrack]) -> list[Picture]:
    """Where the boresight went."""
    ax = plot_scan(tracks)
    return [Picture("scan", "Boresight track", "The boresight about the target, one line per scan.", png_of(ax))]


def draw_spectra(file: str, spectrum: Spectrum, before: str) -> list[Picture]:
    """Power spectra, taken after the step ``before``."""
    where = f"after {before}" if before else f"at step {spectrum.label}"
    ax = plot_spectra(spectrum, title=f"Power spectra of the time streams {where}")
    many = f"{spectrum.detectors} detectors and {spectrum.observations} scan{'s' if spectrum.observations > 1 else ''}"
    caption = f"Mean of {many} {where}, referred to the calibrated sky: divided by ζe^-τ, the atmosphere times ε."
    if "signal" in spectrum.psd:
        caption += " The signal holds the mean emission too, which changes as the scan moves in elevation."
    return [Picture(file, "Power spectra", caption, png_of(ax))]


def draw_transfer(file: str, transfer: Any) -> list[Picture]:
    """A `Transfer`."""
    whose = "the sky alone" if transfer.modes == "sky" else "the complete data"
    caption = (
        "The map of the sky alone through all filters against the same map without filters, by angular scale: the ratio of "
        "their cross spectrum to the spectrum of the latter, with the standard error from the scatter of the modes (bars); "
        f"dashed, the ratio of amplitudes. Dotted, the beam. Singular modes of {whose}."
    )
    ax = plot_transfer(transfer, title=f"Transfer function, singular modes of {whose}")
    return [Picture(file, "Transfer function", caption, png_of(ax))]


def draw_streams(file: str, stream: TimeStream, before: str) -> list[Picture]:
    """A picture for each stream, taken after the step ``before``."""
    where = f"after {before}" if before else f"at step {stream.label}"
    made = []
    for which in stream.streams:
        extra = "" if which == "signal" else f"_{which}"
        meaning = "divided by ζe^-τ, with what is left of the mean emission" if which == "signal" else "at the detector"
        caption = f"Stream {which} of {len(stream.names)} detectors {where}: {meaning}. Pale: samples; dark: means over 1 s."
        ax = plot_tod(stream, name=which, title=f"Time streams of {stream.observation} {where}")
        made.append(Picture(f"{file}{extra}", "Time streams", caption, png_of(ax)))
    return made


def _shown(product: FlatMap, style: Style) -> tuple[FlatMap, str]:
    """The map as its picture shows it, and what was done to it."""
    if not product.smooth:
        return product, "not smoothed"
    if style.smooth == 0 or product.smoothed_by:
        return product, f"smoothed by {angle_text(product.smoothed_by)}" if product.smoothed_by else "not smoothed"
    fwhm = product.fwhm if style.smooth is None else style.smooth
    return (product.smoothed(fwhm), f"smoothed by {angle_text(fwhm)} for this picture") if fwhm > 0 else (product, "not smoothed")


def _resolution(shown: FlatMap) -> str:
    """What the circle in a map's corner is."""
    if not shown.fwhm:
        return ""
    beam, smoothing = angle_text(shown.fwhm), angle_text(shown.smoothed_by)
    if not shown.smoothed_by:
        return f" Resolution {beam} FWHM, the beam's."
    whole = angle_text(math.hypot(shown.fwhm, shown.smoothed_by))
    return f" Resolution {whole} FWHM: the beam's {beam} and the smoothing's {smoothing}, added in quadrature."


def _titled(title: str, how: str) -> str:
    return f"{title}, {how.removesuffix(' for this picture')}"


def _panels(panels: Sequence[tuple[FlatMap, str]], style: Style, limit: float | None, circle: bool = False) -> bytes:
    """The first plane of each map with its title, side by side, where the first map is well covered."""
    whole = panels[0][0]
    covered = whole.covered(style.least_coverage)
    fwhm = math.hypot(whole.fwhm, whole.smoothed_by)
    axes = map_axes(covered.shape, whole.sky, len(panels))
    for ax, (shown, title) in zip(axes, panels, strict=True):
        values = np.where(covered, next(iter(shown.planes.values())), np.float32(np.nan))
        width = style.central_diameter if circle else None
        plot_map(values, whole.sky, ax=ax, title=title, fwhm=fwhm or None, limit=limit, circle=width)
    return png_of(axes[0])
