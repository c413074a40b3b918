"""Pictures of a run, written as files and shown in the report."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from zonda.core.canvas import DPI, Sketch, file_of, unit_of
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.maps.image import Image
from zonda.core.maps.map_arrays import on_plane
from zonda.core.maps.map_plots import (
    SHOWN,
    SIGNED,
    Look,
    contour_text,
    map_axes,
    noise_text,
    plot_circle,
    plot_contours,
    plot_coverage,
    plot_map,
    plot_plain,
    wcs_of,
)
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.noise_figures import Noise, maps_of, noise_alone, noise_sources
from zonda.core.maps.planes import central_diameter, in_beams
from zonda.core.maps.smoothing import smoother
from zonda.core.maps.units import MapOutput, parse_unit
from zonda.core.numerics.sphere import angle_text, sides_text
from zonda.core.output import output_folder
from zonda.core.storage.files import atomic_path, product_path
from zonda.core.types import AnyFloats, Bools, Floats

from .comparison.files import plane_of
from .comparison.statistics import Comparison
from .comparison_plots import draw_comparison
from .series import Spectrum, TimeStream
from .series_plots import draw, draw_scan

Window = tuple[slice, slice]
_NUMBER = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)(e[-+]?\d+)?", re.IGNORECASE)
LARGEST = 1500
"""Pixels of an image's longer side in a picture; larger images are thinned out."""


@dataclass(frozen=True)
class Picture:
    """Picture of a product: ``name`` without suffix, a title, what it shows, its bytes as PNG and,
    by format, as further files.
    """

    name: str
    title: str
    caption: str
    png: bytes
    files: dict[str, bytes] = field(default_factory=dict)

    def write(self, folder: Path) -> list[Path]:
        """Write its files; their paths. Raises `OutputError`."""
        paths = [product_path(folder, self.name, f".{kind}") for kind in self.files]
        for path, content in zip(paths, self.files.values(), strict=True):
            with atomic_path(path) as temporary:
                temporary.write_bytes(content)
        return paths


@dataclass(frozen=True)
class Flat:
    """Planes (ny, nx) of a map as its picture shows them; ``covered``: pixels with enough samples.

    HEALPix and CAR maps are on a plane about their centre.
    """

    planes: dict[str, AnyFloats]
    hits: AnyFloats
    covered: Bools
    wcs: Any

    @classmethod
    def of(cls, product: MapProduct, planes: Mapping[str, AnyFloats], least: float = 0.0) -> Flat:
        """From planes on the grid of a map; ``least``: share of the 99th percentile of the samples.

        Samples are smoothed as the map is: the edge of what is covered is not ragged then.
        """
        seen = product.known_hits.astype(np.float64)
        if product.smoothed_by and product.projection != "HEALPix":
            seen = smoother(product.grid, product.smoothed_by)(seen)
        found: dict[str, Any] = {**planes, "hits": product.known_hits, "seen": seen}
        found, wcs = on_plane(product, found)
        hits = found.pop("hits")
        seen = np.nan_to_num(found.pop("seen"))
        used = seen[hits > 0]
        enough = seen >= least * np.percentile(used, 99) if used.size else seen > 0
        return cls(found, hits, enough, wcs)

    def window(self) -> Window:
        """Rows and columns where there are samples, with a margin of a hundredth of the longer
        side; all, if they are most.
        """
        seen = self.hits > 0
        size = np.array(self.hits.shape)
        if not seen.any():
            return slice(None), slice(None)
        places = np.nonzero(seen)
        low, high = (np.array([f(n) for n in places]) for f in (np.min, np.max))
        spare = math.ceil(0.01 * (high + 1 - low).max())
        low = np.maximum(low - spare, 0)
        high = np.minimum(high + 1 + spare, size)
        if (high - low).prod() >= 0.9 * size.prod():
            return slice(None), slice(None)
        return slice(int(low[0]), int(high[0])), slice(int(low[1]), int(high[1]))

    def cropped(self, window: Window | None = None) -> Flat:
        """The rows and columns of a window; `window` by default."""
        part = window or self.window()
        planes = {name: values[part] for name, values in self.planes.items()}
        return Flat(planes, self.hits[part], self.covered[part], self.wcs[part])

    def limit(self, plane: str, share: float) -> float | None:
        """Brightness scale that covers ``share`` per cent of well covered pixels: the noisy rim
        must not set it.
        """
        if not self.hits.any():
            return None
        well = self.hits > 0.25 * np.percentile(self.hits[self.hits > 0], 99)
        good = np.abs(self.planes[plane][well & np.isfinite(self.planes[plane])])
        return float(np.percentile(good, share)) if good.size else None


def draw_input(file: str, image: Image, signed: bool = False) -> list[Sketch]:
    """Input map (ny, nx), K_RJ; ``signed``: Q or U, with zero in the middle of the colours."""
    step = -(-max(image.values.shape) // LARGEST)
    values = image.values[::step, ::step]
    wcs = wcs_of(image.header)[::step, ::step]
    what = _named("Input", file, "input")
    ax = map_axes(values.shape, wcs)[0]
    title = f"{what}: the sky before the beam"
    if signed:
        top = float(np.nanpercentile(np.abs(values), 99.7)) or 1.0
        factor, unit = unit_of(top)
        limits = (-top * factor, top * factor)
        label = f"Rayleigh–Jeans brightness [{unit}]"
        plot_plain(values * factor, wcs, limits, "RdBu_r", label, ax=ax, title=title)
    else:
        plot_map(values, wcs, ax=ax, title=title)
    text = "The input map, before beam, opacity and filters."
    if image.fwhm:
        width = angle_text(image.fwhm)
        text += f" Its pixels are spread over a grid with Gaussians of {width} (FWHM)."
    return [Sketch(file, what, text, ax)]


def draw_map(
    file: str,
    signal: str,
    key: str,
    product: MapProduct,
    style: Plots,
    snr: tuple[AnyFloats, str] | None = None,
) -> list[Sketch]:
    """Map of a signal, called ``key``; ``snr``: contours of it on the map's grid, and what its
    noise is.
    """
    shown = style.smoothed(product)
    planes = {"signal": shown.signal} | ({} if snr is None else {"snr": snr[0]})
    flat = Flat.of(shown, planes, style.least_coverage).cropped()
    titles = {
        "": ("Map", "Everything: sky, atmosphere and noise."),
        "noiseless": (
            "Noiseless map",
            "The sky alone through the same pointing, filters and map maker: what the processing"
            " leaves of it.",
        ),
    }
    other = f"Map of signal {signal}", "The signal of this name in `runs`."
    title, meaning = titles.get(signal, other)
    title = _named(title, key)
    how = _how(product, shown)
    text = f"{meaning} {how[0].upper()}{how[1:]}"
    if product.taken_off:
        text += f" Its {product.taken_off} is taken off: the data hardly determine it."
    head = _titled(title, shown)
    if snr is not None:
        head += f"; contours: S/N, {noise_text(snr[1], short=True)}"
        lines = f"Contours of the signal-to-noise ratio: {contour_text(style.contours)}"
        text += f" {lines} (negative ones dashed). Its noise: {noise_text(snr[1])}."
    limit = flat.limit("signal", SHOWN if signal == "noiseless" else 99.7)
    look = style.look(shown.unit)
    ax = _panels([(flat, flat.planes["signal"], head)], shown, limit, look)[0]
    if snr is not None:
        plot_contours(ax, np.where(flat.covered, flat.planes["snr"], np.nan), style.contours)
    return [Sketch(file, title, text, ax)]


def draw_noise(
    file: str,
    sources: Mapping[Noise, tuple[MapProduct, str]],
    style: Plots,
) -> list[Sketch]:
    """Maps of noise alone, with the plane that holds it: ``half_difference`` of the map, which
    comes first, and ``source_free``.
    """
    panels: list[tuple[Flat, AnyFloats, str]] = []
    values = []
    limits = []
    how = ""
    window = None
    first = next(iter(sources.values()))[0]
    diameter = central_diameter(first.fwhm, first.pixel, style.central_diameter)
    for of, (product, plane) in sources.items():
        half = product.difference.replace(" - ", " minus ")
        words = half if of == "half_difference" else "all but the sky"
        shown = style.smoothed(product)
        how = _how(product, shown)
        flat = Flat.of(shown, {plane: getattr(shown, plane)}, style.least_coverage)
        window = flat.window() if window is None else window
        flat = flat.cropped(window)
        head = _titled(_named(f"Noise: {words}", file, "noise"), shown)
        panels.append((flat, flat.planes[plane], head))
        limits.append(flat.limit(plane, 99.7))
        rms = shown.rms(diameter / 2, of=plane)
        if math.isfinite(rms):
            scale, unit = (1e6, "µK_RJ") if shown.unit == "K_RJ" else (1.0, shown.unit)
            values.append(f"{words} {rms * scale:.4g} {unit}")
    top = max((x for x in limits if x), default=1.0)
    look = Look(SIGNED, (-top, top), scale_bar=style.scale_bar)
    axes = _panels(panels, shown, None, look)
    place = axes[0].wcs.wcs_world2pix([np.degrees(first.centre)], 0)[0]
    for ax in axes:
        plot_circle(ax, panels[0][1].shape, place, diameter)
    text = f"Noise maps on one scale, {how}"
    if values:
        wide = f"{np.degrees(diameter) * 60:.3g}′{in_beams(diameter, first.fwhm)}"
        text += f" Weighted rms within the dotted circle of {wide}: {', '.join(values)}."
    return [Sketch(file, _named("Noise", file, "noise"), text, axes[0])]


def draw_coverage(file: str, product: MapProduct) -> list[Sketch]:
    """Samples per pixel and seconds per beam."""
    per_beam: Any = product.seconds_per_beam()
    each = isinstance(per_beam, np.ndarray) and per_beam.ndim > 0
    flat = Flat.of(product, {"per_beam": per_beam} if each else {}).cropped()
    if each:
        found = flat.planes["per_beam"]
        per_beam = np.where(np.isfinite(found), found, np.nanmean(found))
    what = "Samples per pixel" if per_beam is None else "Integration time per beam"
    title = _named(what, file, "coverage")
    ax = plot_coverage(flat.hits, flat.wcs, per_beam=per_beam, title=title)
    samples = int(product.hits.sum())
    pixels = int((product.hits > 0).sum())
    text = f"{samples:,} samples in {pixels:,} pixels of {sides_text(*product.sides)}.".replace(
        ",",
        "\u202f",
    )
    if per_beam is not None:
        beam = f"of {angle_text(product.fwhm)} FWHM (area π FWHM² / (4 ln 2))"
        text += (
            " Integration time: of all detectors together, in the area of the telescope's beam"
            f" {beam}."
        )
    return [Sketch(file, "Coverage", text, ax)]


def draw_plane(file: str, product: MapProduct, name: str) -> list[Sketch]:
    """Plane of numbers, whose colours, title and caption it states itself; grey without samples."""
    plane = product.planes[name]
    seen = np.where(product.hits > 0, plane.values[0], np.nan)
    flat = Flat.of(product, {name: seen}).cropped()
    values = flat.planes[name]
    assert plane.colours is not None
    known = values[np.isfinite(values)]
    low, high = plane.colours
    limits = (
        float(known.min(initial=0.0)) if low is None else low,
        float(known.max(initial=0.0)) if high is None else high,
    )
    ax = plot_plain(values, flat.wcs, limits, "cividis_r", plane.unit, title=plane.title)
    return [Sketch(file, plane.title, plane.caption, ax)]


def _how(product: MapProduct, shown: MapProduct) -> str:
    """Smoothing of a map for its picture, and the meaning of the circle in its corner, in words."""
    beam = angle_text(shown.fwhm)
    smoothing = angle_text(shown.smoothed_by)
    text = "not smoothed"
    circle = f" Resolution {beam} FWHM, the beam's."
    if shown.smoothed_by:
        text = f"smoothed by {smoothing}{'' if product.smoothed_by else ' for this picture'}"
        both = f"the beam's {beam} and the smoothing's {smoothing}, added in quadrature"
        circle = f" Resolution {angle_text(shown.resolution)} FWHM: {both}."
    return f"{text}.{circle if shown.fwhm else ''}"


def _named(title: str, key: str, shows: str = "") -> str:
    """The title with the product's name; of ``map`` only what is behind it (band, Stokes
    parameter): ``f150 Q``. ``shows``: before it.
    """
    more = key.removeprefix(shows).lstrip("_").removeprefix("map").lstrip("_").replace("_", " ")
    return f"{title} ({more})" if more else title


def _titled(title: str, shown: MapProduct) -> str:
    """The title with the resolution, which the circle in the map's corner shows: beam and smoothing
    together.
    """
    if not shown.smoothed_by:
        return f"{title}, not smoothed"
    return f"{title}, smoothed to {angle_text(shown.resolution)}"


def _panels(
    panels: Sequence[tuple[Flat, AnyFloats, str]],
    product: MapProduct,
    limit: float | None,
    look: Look,
) -> list[Any]:
    """Axes of maps side by side with their titles, where the first map is well covered."""
    first = panels[0][0]
    axes = map_axes(first.covered.shape, first.wcs, len(panels))
    for ax, (_, values, title) in zip(axes, panels, strict=True):
        shown = np.where(first.covered, values, np.nan)
        more: Any = {"fwhm": product.resolution or None, "unit": product.unit}
        plot_map(shown, first.wcs, ax=ax, title=title, limit=limit, look=look, **more)
    return axes


DRAWN = frozenset(
    [
        "map",
        "spectrum",
        "time_streams",
        "transfer_function",
        "modes",
        "comparison",
        "map_spectra",
        "noise_model",
        "screens",
        "stream_comparison",
    ]
)
"""Products with pictures."""
FILES: dict[type, str] = {Spectrum: "power_spectra", TimeStream: "tod"}
"""File names of pictures that are not named as their product."""


class Plots(MapOutput):
    """Pictures of the products, as PNG, PDF or SVG files in the output folder, each where there is
    something to show.

    ``input.png``, ``noiseless_map.png``, ``map.png``, ``noise_map.png``, ``coverage.png``,
    ``power_spectra.png``, ``tod.png``, ``scan.png``, ``transfer_function.png``, ``modes.png``,
    ``comparison.png``, ``map_spectra.png``, ``noise_model.png``. The report shows them too.

    Raises `OutputError` when there is no output folder, it cannot be written, or the disk is full.
    """

    optional = DRAWN
    provides = frozenset({"pictures"})

    smooth: Annotated[Angle, Field(ge=0, le=0.1)] | Literal["beam", "none"] = Field(
        "beam",
        examples=["9 arcsec"],
    )
    """Smooth image maps that are not smoothed yet for their pictures: with the beam, with a
    Gaussian of this FWHM, or not.
    """
    central_diameter: Angle | None = Field(None, gt=0, examples=["1 arcmin"])
    """Diameter of the circle that noise maps show, in which their rms is taken; where absent 1
    arcmin, or five beams or pixels where these are wider."""
    least_coverage: float = Field(0.1, ge=0, lt=1)
    """Map pixels with fewer samples than this share of the 99th percentile are left grey in the
    pictures.
    """
    contours: list[float] = Field([], max_length=20)
    """Levels of the signal-to-noise ratio, in sigma, at which maps have contours, e.g. [-8, -4, -2,
    2, 4].
    """
    colours: str | None = None
    """Colour map of maps, one of matplotlib's. Default: sequential for a source, diverging where
    both signs are in the map; noise and residuals are diverging in any case."""
    limits: list[str] | None = Field(None, min_length=2, max_length=2)
    """Where the colours of maps begin and end, e.g. [-0.1 mK, 2 mK]. Default: what nearly all
    pixels stay below.
    """
    stretch: Literal["linear", "sqrt", "asinh", "log"] = "linear"
    """Of the colours of maps: linear, the square root (of the distance from the lower limit), asinh
    (linear within a twentieth of the larger limit), or logarithmic (three decades, unless the
    lower limit is positive)."""
    scale_bar: Angle = quantity("0 arcmin", ge=0, le=1, examples=["1 arcmin"])
    """Length of a bar on the sky that maps show; 0: none."""
    formats: list[Literal["png", "pdf", "svg"]] = Field(["png"], min_length=1)
    """Files of each picture; PDF and SVG for print."""
    dpi: float = Field(DPI, ge=50, le=600)
    """Dots per inch of PNG files; images within PDF and SVG files have at least 300."""

    def check(self, data: Data) -> list[str]:
        """Refuse colours that there are not."""
        if self.colours is not None or self.limits is not None:
            self.look(self.unit or "K_RJ").check(self.label)
        return []

    def observe(self, data: Data) -> None:
        """Refuse an unwritable output folder, and colours that there are not, before anything is
        simulated.
        """
        super().observe(data)
        self.check(data)

    def look(self, unit: str) -> Look:
        """Colours of maps in ``unit``. Raises InputError for limits in another."""
        plain, size = parse_unit(unit or "K_RJ", place=self.label, temperature_scale="K_RJ")
        scale = plain if plain.startswith("K_") else "K_RJ"
        ends = []
        for text in self.limits or ():
            number, _, of = text.strip().partition(" ")
            other, factor = parse_unit(of, place=self.label, temperature_scale=scale)
            if other != plain or not _NUMBER.fullmatch(number):
                cure = f"write limits: [-1 {unit}, 5 {unit}]"
                raise InputError(f"{text!r} is no value in {unit}", place=self.label, cure=cure)
            ends.append(float(number) * factor / size)
        limits = (ends[0], ends[1]) if ends else None
        return Look(self.colours, limits, self.stretch, self.scale_bar)

    def finalize(self, data: Data) -> None:
        folder = output_folder(data, self.label)
        data.products["pictures"] = made = list(pictures(data, self))
        for picture in made:
            picture.write(folder)

    def smoothing(self, product: MapProduct) -> float:
        """Gaussian [rad] by which a map is smoothed for its picture; 0 for none."""
        if product.projection == "HEALPix" or product.smoothed_by:
            return 0.0
        width: Any = {"beam": product.fwhm, "none": 0.0}.get(str(self.smooth), self.smooth)
        return float(width)

    def smoothed(self, product: MapProduct) -> MapProduct:
        """The map as its picture shows it, in its unit."""
        fwhm = self.smoothing(product)
        return self.in_unit(product.smoothed(fwhm) if fwhm > 0 else product)

    def printed(self, sketch: Sketch) -> Picture:
        """A sketch in all formats; PNG always, since reports show it."""
        figure = sketch.ax.figure
        png = file_of(figure, "png", self.dpi)
        kinds = dict.fromkeys(map(str, self.formats))
        files = {k: png if k == "png" else file_of(figure, k, self.dpi) for k in kinds}
        return Picture(sketch.name, sketch.title, sketch.caption, png, files)


def pictures(data: Data, style: Plots) -> Iterator[Picture]:
    """Every picture that the products allow, in reading order; each is drawn when it is asked
    for.
    """
    for made in (_of_inputs(data), _of_maps(data, style), _of_series(data, style)):
        for sketch in made:
            yield style.printed(sketch)


def _of_inputs(data: Data) -> Iterator[Sketch]:
    """Pictures of input maps."""
    for name, image in data.products.items():
        if isinstance(image, Image) and "/" not in name:
            yield from draw_input(_file(name), image)
            for plane in ("Q", "U") if image.polarization is not None else ():
                yield from draw_input(_file(f"{name}_{plane}"), image.stokes(plane), signed=True)


def _of_maps(data: Data, style: Plots) -> Iterator[Sketch]:
    """Pictures of maps, their coverage and their noise."""
    maps = maps_of(data.products)
    shown = {
        name: maps[name]
        for name in sorted(
            maps,
            key=lambda n: (n.rpartition("/")[2], not n.startswith("noiseless/"), "/" in n),
        )
        if maps[name].contents == "all"
    }
    for name, product in data.products.items():
        if isinstance(product, MapProduct) and product.polarization is not None:
            shown[f"{name}_P"] = product.stokes("P")
    for name, product in shown.items():
        if not name.startswith(("source_free/", "_")):
            run, _, key = name.rpartition("/")
            snr = _snr(product, style, maps, name) if style.contours and not run else None
            yield from draw_map(_file(name), run, key, product, style, snr)
    for name, product in maps.items():
        behind = "" if name == "map" else f"_{name}"
        if "/" not in name and name in data.products:  # Q and U have the hits of I
            yield from draw_coverage(f"coverage{behind}", product)
            for key in (k for k, plane in product.planes.items() if plane.colours is not None):
                yield from draw_plane(f"{key}{behind}", product, key)
        if sources := noise_sources(maps, name):
            yield from draw_noise(_file(f"noise_{name}"), sources, style)


def _of_series(data: Data, style: Plots) -> Iterator[Sketch]:
    """Pictures of the scans, and of products that are no maps."""
    if data.observations:
        yield from draw_scan(data.scans)
    before = _steps_before(data)
    bands = [f"_{band.name}" for band in data.scene.instrument.bands]
    for name, product in data.products.items():
        file = _file(name)
        label = getattr(product, "label", "")
        band = next((b for b in bands if name.endswith(b)), "")
        if stem := FILES.get(type(product)):
            file = f"{stem}{band if name == f'{product.usual}{band}' else f'_{file}'}"
        if isinstance(product, Comparison):
            yield from draw_comparison(file, product, style.contours)
        where = f"after {before[label]}" if before.get(label) else f"at step {label}"
        yield from draw(product, file, where)


def _file(name: str) -> str:
    """Name of the picture of a product, without suffix."""
    return product_path("", name).name


def _steps_before(data: Data) -> dict[str, str]:
    """The last step above each step that may have changed the streams, by label."""
    found = {}
    last = ""
    for label, kind, _ in data.provenance.get("operators", []):
        found[label] = last
        if kind not in (
            "PowerSpectrum",
            "TimeStreams",
            "ModeSpectrum",
            "CompareStreams",
            "SaveTOD",
        ):
            last = label
    return found


def _noise_of(maps: Mapping[str, MapProduct], name: str) -> tuple[Floats, str] | None:
    """`noise_alone` of a map; of a P, the rms of that of its Q and U."""
    if name in maps:
        return noise_alone(maps, name)
    q, u = (noise_alone(maps, f"{name.removesuffix('_P')}_{which}") for which in "QU")
    return None if q is None or u is None else (np.hypot(q[0], u[0]) / math.sqrt(2), q[1])


def _snr(
    product: MapProduct,
    style: Plots,
    maps: Mapping[str, MapProduct],
    name: str,
) -> tuple[AnyFloats, str] | None:
    """SNR of a map as it is shown, on its own grid, and what its noise is, in words; None where it
    is not known.
    """
    plane = replace(plane_of(product, "map", _noise_of(maps, name)), fwhm=0.0)
    plane = plane.smoothed(style.smoothing(product)).measured()
    if plane.noise is None or not np.isfinite(plane.noise).any():
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.asarray(plane.values / plane.noise, np.float32), plane.noise_in_words
