"""Pictures of a run, written as files and shown in the report."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from zonda.core.canvas import DPI, Sketch, file_of
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.noise_figures import maps_of, noise_alone, noise_sources
from zonda.core.output import Output, output_folder
from zonda.core.storage.files import product_path
from zonda.core.types import AnyFloats, Floats

from .comparison.files import plane_of
from .comparison.statistics import Comparison
from .drawing.comparison_plots import draw_comparison
from .drawing.pictures import (
    Picture,
    draw_coverage,
    draw_input,
    draw_map,
    draw_noise,
    draw_plane,
)
from .drawing.plots import draw, draw_scan
from .series import Spectrum, TimeStream

__all__ = ["Picture", "Plots", "pictures"]

DRAWN = frozenset(
    [
        "map",
        "spectrum",
        "time_streams",
        "transfer_function",
        "modes",
        "comparison",
        "map_spectra",
        "screens",
        "stream_comparison",
    ]
)
"""Products with pictures."""
FILES: dict[type, tuple[str, str]] = {
    Spectrum: ("spectrum", "power_spectra"),
    TimeStream: ("time_streams", "tod"),
}
"""Names of products and of their pictures, where these differ."""


class Plots(Output):
    """Pictures of the products, as PNG, PDF or SVG files in the output folder, each where there is
    something to show.

    ``input.png``, ``noiseless_map.png``, ``map.png``, ``noise_map.png``, ``coverage.png``,
    ``power_spectra.png``, ``tod.png``, ``scan.png``, ``transfer_function.png``, ``modes.png``,
    ``comparison.png``, ``map_spectra.png``. The report shows them too.

    Raises `OutputError` when there is no output folder, it cannot be written, or the disk is full.
    """

    optional: ClassVar[frozenset[str]] = DRAWN
    provides: ClassVar[frozenset[str]] = frozenset({"pictures"})

    smooth: Annotated[Angle, Field(ge=0, le=0.1)] | Literal["beam", "none"] = "beam"
    """Smooth image maps that are not smoothed yet for their pictures: with the beam, with a
    Gaussian of this FWHM, or not.
    """
    central_diameter: Angle | None = Field(None, gt=0)
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
    formats: list[Literal["png", "pdf", "svg"]] = Field(["png"], min_length=1)
    """Files of each picture; PDF and SVG for print."""
    dpi: float = Field(DPI, ge=50, le=600)
    """Dots per inch of PNG files; images within PDF and SVG files have at least 300."""

    def observe(self, data: Data) -> None:
        """Refuse a missing or unwritable output folder before anything is simulated."""
        output_folder(data, self.label)

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
        """The map as its picture shows it."""
        fwhm = self.smoothing(product)
        return product.smoothed(fwhm) if fwhm > 0 else product

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
            maps, key=lambda n: (n.rpartition("/")[2], not n.startswith("noiseless/"), "/" in n)
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
        file, label = _file(name), getattr(product, "label", "")
        band = next((b for b in bands if name.endswith(b)), "")
        usual, stem = FILES.get(type(product), ("", ""))
        if stem:
            file = f"{stem}{band if name == f'{usual}{band}' else f'_{file}'}"
        if isinstance(product, Comparison):
            yield from draw_comparison(file, product, style.contours)
        where = f"after {before[label]}" if before.get(label) else f"at step {label}"
        yield from draw(product, file, where)


def _file(name: str) -> str:
    """Name of the picture of a product, without suffix."""
    return product_path("", name).name


def _steps_before(data: Data) -> dict[str, str]:
    """The last step above each step that may have changed the streams, by label."""
    found, last = {}, ""
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
    product: MapProduct, style: Plots, maps: Mapping[str, MapProduct], name: str
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
