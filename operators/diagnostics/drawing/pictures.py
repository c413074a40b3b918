"""Pictures of a run from plain values: what is drawn in the second process. numpy and, when
something is drawn, matplotlib.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from zonda.core.drawable import Drawable, Sketch
from zonda.core.maps.central import central_diameter, in_beams
from zonda.core.maps.planes import Plane
from zonda.core.numerics.angles import angle_text, sides_text
from zonda.core.types import AnyFloats

from ..series import Modes, Spectrum, TimeStream, unit_of_stream
from .canvas import DPI, unit_of
from .flat_map import FlatMap
from .map_layout import map_axes
from .map_plots import (
    SHOWN,
    contour_text,
    noise_text,
    plot_circle,
    plot_contours,
    plot_coverage,
    plot_map,
    plot_plain,
    plot_plane,
)
from .plot_modes import plot_modes
from .plots import ScanTrack, plot_scan, plot_spectra, plot_tod, plot_transfer
from .png import png_of
from .sky_axes import SkyAxes
from .vector import vector_of


@dataclass(frozen=True)
class Picture:
    """A picture: ``name`` without suffix, a title, what it shows, its bytes as PNG and, by format,
    as further files.
    """

    name: str
    title: str
    caption: str
    png: bytes
    files: dict[str, bytes] = field(default_factory=dict)


@dataclass(frozen=True)
class Style:
    """Parameters of `Plots`; angles in rad, ``smooth`` None: with the beam, 0: not;
    ``central_diameter`` None: as the map.
    """

    smooth: float | None
    central_diameter: float | None
    least_coverage: float
    contours: tuple[float, ...] = ()
    formats: tuple[str, ...] = ("png",)
    dpi: float = DPI


def printed(draw: Callable[..., list[Sketch]], style: Style, *arguments: Any) -> list[Picture]:
    """What ``draw(*arguments)`` sketches, in the formats of the style; PNG always, since reports
    show it.
    """
    made = []
    for sketch in draw(*arguments):
        png = png_of(sketch.ax, style.dpi)
        files = {
            name: png if name == "png" else vector_of(sketch.ax, name, style.dpi)
            for name in style.formats
        }
        made.append(Picture(sketch.name, sketch.title, sketch.caption, png, files))
    return made


def draw_input(
    file: str, values: Any, axes: SkyAxes | None, header: dict[str, Any], signed: bool = False
) -> list[Sketch]:
    """The input map (ny, nx), K_RJ; ``signed``: Q or U, with zero in the middle of the colours."""
    what, where = _named("Input", file, "input"), header if axes is None else axes
    title = f"{what}: the sky before the beam"
    if signed:
        top = float(np.nanpercentile(np.abs(values), 99.7)) or 1.0
        factor, unit = unit_of(top)
        label = f"Rayleigh–Jeans brightness [{unit}]"
        ax = plot_plain(
            values * factor, where, (-top * factor, top * factor), "RdBu_r", label, title=title
        )
    else:
        ax = plot_map(values, where, title=title)
    text = "The input map, before beam, opacity and filters."
    if header.get("BMAJ"):
        width = angle_text(math.radians(float(header["BMAJ"])))
        text += f" Its pixels are spread over a grid with Gaussians of {width} (FWHM)."
    return [Sketch(file, what, text, ax)]


def draw_map(
    file: str,
    signal: str,
    key: str,
    product: FlatMap,
    style: Style,
    snr: tuple[AnyFloats, str] | None = None,
) -> list[Sketch]:
    """Plane ``signal`` of a map of a signal, called ``key``; ``snr``: (ny, nx), contours of it, and
    what its noise is.
    """
    window = product.window()
    shown, how = _shown(product.cropped(window), style)
    title = {"": "Map", "noiseless": "Noiseless map"}.get(signal, f"Map of signal {signal}")
    title = _named(title, key)
    meaning = {
        "": "Everything: sky, atmosphere and noise, filtered and binned.",
        "noiseless": (
            "The sky alone through the same pointing, filters and binning: what the processing"
            " leaves of it."
        ),
    }.get(signal, "A part of the components, filtered and binned.")
    limit = shown.limit("signal", shown.hits, SHOWN if signal == "noiseless" else 99.7)
    head = _titled(title, shown)
    if snr is not None:
        head += f"; contours: S/N, {noise_text(snr[1], short=True)}"
    ax = _panels([(shown, head)], style, limit)
    text = f"{meaning} {how[0].upper()}{how[1:]}.{_resolution(shown)}"
    if snr is not None:
        plot_contours(
            ax,
            np.where(shown.covered(style.least_coverage), snr[0][window], np.nan),
            style.contours,
        )
        text += (
            f" Contours of the signal-to-noise ratio: {contour_text(style.contours)} (negative ones"
            " dashed)."
        )
        text += f" Its noise: {noise_text(snr[1])}."
    return [Sketch(file, title, text, ax)]


def draw_noise(file: str, sources: dict[str, FlatMap], style: Style) -> list[Sketch]:
    """Maps of noise alone: ``half_difference`` (of the map, which comes first) and ``source_free``
    (plane ``signal``).
    """
    words = {"source_free": "all but the sky"}
    panels, figures, limits, how = [], [], [], ""
    first = next(iter(sources.values()))
    window, diameter = (
        first.window(),
        central_diameter(first.fwhm, first.pixel, style.central_diameter),
    )
    for of, source in sources.items():
        words.setdefault(of, source.difference)
        shown, how = _shown(source.cropped(window), style)
        plane = next(iter(shown.planes))
        panels.append((shown, _titled(_named(f"Noise: {words[of]}", file, "noise"), shown)))
        limits.append(shown.limit(plane, panels[0][0].hits, 99.7))
        rms = shown.central_rms(plane, diameter / 2)
        if math.isfinite(rms):
            figures.append(f"{words[of]} {rms * 1e6:.4g} µK_RJ")
    limit = max((x for x in limits if x), default=None)
    ax = _panels(panels, style, limit, diameter)
    text = f"Noise maps on one scale, {how}.{_resolution(panels[0][0])}"
    if figures:
        wide = f"{np.degrees(diameter) * 60:.3g}′{in_beams(diameter, first.fwhm)}"
        text += f" Weighted rms within the dotted circle of {wide}: {', '.join(figures)}."
    return [Sketch(file, _named("Noise", file, "noise"), text, ax)]


def draw_coverage(
    file: str, product: FlatMap, samples: int, pixels: int, sides: tuple[float, float]
) -> list[Sketch]:
    """Samples per pixel and seconds per beam; ``samples`` in ``pixels`` in all, of these
    `MapArrays.sides`.
    """
    product = product.cropped()
    what = "Samples per pixel" if product.per_beam is None else "Integration time per beam"
    ax = plot_coverage(
        product.hits, product.sky, per_beam=product.per_beam, title=_named(what, file, "coverage")
    )
    text = f"{samples:,} samples in {pixels:,} pixels of {sides_text(*sides)}.".replace(
        ",", "\u202f"
    )
    if product.per_beam is not None:
        beam = f"of {angle_text(product.fwhm)} FWHM (area π FWHM² / (4 ln 2))"
        text += (
            " Integration time: of all detectors together, in the area of the telescope's beam"
            f" {beam}."
        )
    return [Sketch(file, "Coverage", text, ax)]


def draw_plane(file: str, product: FlatMap, plane: Plane) -> list[Sketch]:
    """A plane of numbers, which says itself how it is shown. ``plane``: without its values."""
    product = product.cropped()
    (values,) = product.planes.values()
    return [Sketch(file, plane.title, plane.caption, plot_plane(values, product.sky, plane))]


def draw_scan(tracks: Sequence[ScanTrack]) -> list[Sketch]:
    """Where the boresight went."""
    ax = plot_scan(tracks)
    return [
        Sketch("scan", "Boresight track", "The boresight about the target, one line per scan.", ax)
    ]


def draw_spectra(file: str, spectrum: Spectrum, before: str) -> list[Sketch]:
    """Power spectra, taken after the step ``before``."""
    where = f"after {before}" if before else f"at step {spectrum.label}"
    many = (
        f"{spectrum.detectors} detectors and {spectrum.observations}"
        f" scan{'s' if spectrum.observations > 1 else ''}"
    )
    made = []
    for kind in dict.fromkeys(map(unit_of_stream, spectrum.psd)):
        part = replace(
            spectrum,
            psd={name: psd for name, psd in spectrum.psd.items() if unit_of_stream(name) == kind},
        )
        extra, caption = (
            "" if kind == "K_RJ" else f"_{'_'.join(part.psd)}",
            f"Mean of {many} {where}",
        )
        if kind == "K_RJ":
            caption += (
                ", referred to the calibrated sky: divided by ζ exp(−τ), the atmosphere multiplied"
                " by ε"
            )
        caption += "."
        if "signal" in part.psd:
            caption += (
                " The signal holds the mean emission too, which changes as the scan moves in"
                " elevation."
            )
        ax = plot_spectra(part, title=f"Power spectra of the time streams {where}")
        made.append(Sketch(f"{file}{extra}", "Power spectra", caption, ax))
    return made


def draw_modes(file: str, modes: Modes, before: str) -> list[Sketch]:
    """Shares of the variance and the leading modes in time, taken after the step ``before``."""
    where = f"after {before}" if before else f"at step {modes.label}"
    what = f"{modes.detectors} detectors"
    what += f" at {modes.delays + 1} delays of {modes.delay:.3g} s" if modes.delays else ""
    caption = (
        f"Principal components of {what} {where}: left, the share of the variance in each, mean of"
        f" {len(modes.values)} scan{'s' if len(modes.values) > 1 else ''}; right, the first in"
        f" time, of {modes.observation}."
    )
    ax = plot_modes(modes, title=f"Modes {where}")
    return [Sketch(file, "Modes", caption, ax)]


def draw_transfer(file: str, transfer: Any) -> list[Sketch]:
    """A `Transfer`."""
    whose = "the sky alone" if transfer.modes == "sky" else "the complete data"
    caption = (
        "The map of the sky alone through all filters against the same map without filters, by"
        " angular scale: the ratio of their cross spectrum to the spectrum of the latter, with the"
        " standard error from the scatter of the modes (bars); dashed, the ratio of amplitudes."
        f" Dotted, the beam. Singular modes of {whose}."
    )
    of = "" if file == "transfer_function" else f" ({file.removeprefix('transfer_function_')})"
    ax = plot_transfer(transfer, title=f"Transfer function{of}, singular modes of {whose}")
    return [Sketch(file, f"Transfer function{of}", caption, ax)]


def draw_own(file: str, product: Drawable) -> list[Sketch]:
    """A product that draws itself."""
    return product.sketches(file)


def draw_streams(file: str, stream: TimeStream, before: str) -> list[Sketch]:
    """A picture for each stream, taken after the step ``before``."""
    where = f"after {before}" if before else f"at step {stream.label}"
    made = []
    for which in stream.streams:
        extra = "" if which == "signal" else f"_{which}"
        meaning = (
            "divided by ζ exp(−τ), with the mean emission that no filter has removed"
            if which == "signal"
            else "at the detector"
        )
        meaning = (
            meaning
            if unit_of_stream(which) == "K_RJ"
            else "along the line of sight, without its mean"
        )
        caption = (
            f"Stream {which} of {len(stream.names)} detectors {where}: {meaning}. Pale: samples;"
            " dark: means over 1 s."
        )
        ax = plot_tod(stream, name=which, title=f"Time streams of {stream.observation} {where}")
        made.append(Sketch(f"{file}{extra}", "Time streams", caption, ax))
    return made


def _shown(product: FlatMap, style: Style) -> tuple[FlatMap, str]:
    """The map as its picture shows it, and what was done to it."""
    if not product.smooth or style.smooth == 0 or product.smoothed_by:
        return (
            product,
            (
                f"smoothed by {angle_text(product.smoothed_by)}"
                if product.smoothed_by
                else "not smoothed"
            ),
        )
    fwhm = product.fwhm if style.smooth is None else style.smooth
    return (
        (product.smoothed(fwhm), f"smoothed by {angle_text(fwhm)} for this picture")
        if fwhm > 0
        else (product, "not smoothed")
    )


def _resolution(shown: FlatMap) -> str:
    """What the circle in a map's corner is."""
    if not shown.fwhm:
        return ""
    beam, smoothing = angle_text(shown.fwhm), angle_text(shown.smoothed_by)
    if not shown.smoothed_by:
        return f" Resolution {beam} FWHM, the beam's."
    whole = angle_text(math.hypot(shown.fwhm, shown.smoothed_by))
    return (
        f" Resolution {whole} FWHM: the beam's {beam} and the smoothing's {smoothing}, added in"
        " quadrature."
    )


def _named(title: str, key: str, shows: str = "") -> str:
    """With the product's name; of ``map`` only what is behind it (band, Stokes parameter): ``f150
    Q``. ``shows``: before it.
    """
    more = key.removeprefix(shows).lstrip("_").removeprefix("map").lstrip("_").replace("_", " ")
    return f"{title} ({more})" if more else title


def _titled(title: str, shown: FlatMap) -> str:
    """With the resolution, which the circle in the map's corner shows: beam and smoothing
    together.
    """
    if not shown.smoothed_by:
        return f"{title}, not smoothed"
    return f"{title}, smoothed to {angle_text(math.hypot(shown.fwhm, shown.smoothed_by))}"


def _panels(
    panels: Sequence[tuple[FlatMap, str]], style: Style, limit: float | None, circle: float = 0.0
) -> Any:
    """The first plane of each map with its title, side by side, where the first map is well
    covered; ``circle``: diameter.
    """
    whole = panels[0][0]
    covered = whole.covered(style.least_coverage)
    fwhm = math.hypot(whole.fwhm, whole.smoothed_by)
    axes = map_axes(covered.shape, whole.sky, len(panels))
    for ax, (shown, title) in zip(axes, panels, strict=True):
        values = np.where(covered, next(iter(shown.planes.values())), np.float32(np.nan))
        plot_map(values, whole.sky, ax=ax, title=title, fwhm=fwhm or None, limit=limit)
        if circle:
            plot_circle(ax, whole.sky, values.shape, circle)
    return axes[0]
