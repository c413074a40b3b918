"""Pictures of a run: made once, written as PNG files and shown in the report."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Future, ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, PrivateAttr

from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.drawable import Drawable, Sketch
from zonda.core.early import take
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.noise_figures import Noise, maps_of, noise_alone, noise_sources
from zonda.core.maps.on_plane import on_plane
from zonda.core.output import Output, Progress, output_folder
from zonda.core.storage.files import MOST_AT_ONCE, atomic_path, product_path
from zonda.core.types import AnyFloats, Floats

from .comparison.files import plane_of
from .comparison.statistics import Comparison
from .drawing.artist import Artist
from .drawing.canvas import DPI
from .drawing.comparison_plots import draw_comparison, draw_map_spectra
from .drawing.flat_map import FlatMap
from .drawing.pictures import (
    Picture,
    Style,
    draw_coverage,
    draw_input,
    draw_map,
    draw_modes,
    draw_noise,
    draw_own,
    draw_plane,
    draw_scan,
    draw_spectra,
    draw_streams,
    draw_transfer,
    printed,
)
from .drawing.plots import ScanTrack
from .drawing.sky_axes import SkyAxes
from .drawing.stream_comparison import draw_stream_comparison
from .map_spectra import MapSpectra
from .series import Modes, Spectrum, TimeStream
from .stream_statistics import StreamComparison
from .transfer_function import Transfer

__all__ = ["Picture", "Plots", "pictures"]

LARGEST = 1500
"""Pixels of an image's longer side in a picture; larger images are thinned out."""


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

    _artist: Artist | None = PrivateAttr(None)
    _begun: dict[str, Future[Any]] = PrivateAttr(default_factory=dict)

    def observe(self, data: Data) -> None:
        """Refuse a missing or unwritable output folder before anything is simulated; let a second
        process be started.
        """
        output_folder(data, self.label)
        self._begun = {}
        with suppress(OSError):
            self._artist = (
                take(Artist) if self._artist is None and data.threads > 1 else self._artist
            )

    def watch(self, data: Data, done: Progress) -> None:
        """Begin with the pictures of what will not change any more."""
        if self._artist is not None:
            style = self.style()
            for drawing in _drawings(data, style):
                if (drawing.at_once or done == "maps") and drawing.key not in self._begun:
                    self._begun[drawing.key] = self._artist.submit(
                        printed, drawing.function, style, *drawing.arguments()
                    )

    def finalize(self, data: Data) -> None:
        folder = output_folder(data, self.label)
        try:
            data.products["pictures"] = _write_all(
                folder, data, self.style(), self._begun, self._artist
            )
        finally:
            self._begun = {}
            if self._artist is not None:
                self._artist.close()
                self._artist = None

    def style(self) -> Style:
        """Its parameters, for another process."""
        smooth: Any = {"beam": None, "none": 0.0}.get(str(self.smooth), self.smooth)
        formats = tuple(dict.fromkeys(self.formats))
        return Style(
            smooth,
            self.central_diameter,
            self.least_coverage,
            tuple(self.contours),
            formats,
            self.dpi,
        )


@dataclass(frozen=True)
class Drawing:
    """Pictures to be made by ``printed(function, style, *arguments())``.

    ``at_once``: nothing that follows changes what they show, once there is anything to show.
    """

    key: str
    function: Callable[..., list[Sketch]]
    arguments: Callable[[], tuple[Any, ...]]
    at_once: bool = False


def _write_all(
    folder: Path, data: Data, style: Style, begun: Mapping[str, Future[Any]], artist: Artist | None
) -> list[Picture]:
    """Write every picture; while the disk writes one, the next is drawn."""
    written = []
    with ThreadPoolExecutor(MOST_AT_ONCE, "Plots") as pool:

        def write(picture: Picture) -> None:
            for kind, content in picture.files.items():
                written.append(
                    pool.submit(_write, product_path(folder, picture.name, f".{kind}"), content)
                )

        made = pictures(data, style, begun, artist, write)
        if artist is not None:
            pool.submit(artist.close)  # it takes as long to end as a file to be written
    for file in written:
        file.result()
    return made


def _write(path: Path, content: bytes) -> None:
    with atomic_path(path) as temporary:
        temporary.write_bytes(content)


def pictures(
    data: Data,
    style: Style,
    begun: Mapping[str, Future[Any]] | None = None,
    artist: Artist | None = None,
    there: Callable[[Picture], Any] = lambda picture: None,
) -> list[Picture]:
    """Every picture that the products allow, in reading order.

    ``begun``: by `Drawing.key`, what ``artist`` is drawing. ``there`` is told of every picture as
    soon as it is there.
    """
    drawings, coming = list(_drawings(data, style)), dict(begun or {})
    for drawing in drawings:
        if artist is not None and drawing.key not in coming:
            coming[drawing.key] = artist.submit(
                printed, drawing.function, style, *drawing.arguments()
            )
    for future in as_completed(coming.values()):
        for picture in future.result() or ():
            there(picture)
    made: list[Picture] = []
    for drawing in drawings:
        found = coming[drawing.key].result() if drawing.key in coming else None
        if found is None:
            found = printed(drawing.function, style, *drawing.arguments())
            for picture in found:
                there(picture)
        made += found
    return made


def _drawings(data: Data, style: Style) -> Iterator[Drawing]:
    """What there is to draw, in reading order."""
    maps = maps_of(data.products)
    before = _steps_before(data)
    for name, image in data.products.items():
        if isinstance(image, Image) and "/" not in name:
            yield Drawing(f"input {name}", draw_input, partial(_input, name, image), True)
            for plane in ("Q", "U") if image.polarization is not None else ():
                yield Drawing(
                    f"input {name}_{plane}", draw_input, partial(_input, name, image, plane), True
                )
    for name in sorted(
        maps, key=lambda n: (n.rpartition("/")[2], not n.startswith("noiseless/"), "/" in n)
    ):
        if not name.startswith("source_free/") and maps[name].contents == "all":
            yield Drawing(f"map {name}", draw_map, partial(_map, name, maps[name], style, maps))
    for name, product in data.products.items():
        if (
            isinstance(product, MapProduct)
            and product.polarization is not None
            and not name.startswith(("source_free/", "_"))
        ):
            yield Drawing(
                f"map {name}_P",
                draw_map,
                partial(_map, f"{name}_P", product.stokes("P"), style, maps),
            )
    for name, product in maps.items():
        if "/" not in name and name in data.products:  # Q and U have the hits of I
            yield Drawing(f"coverage {name}", draw_coverage, partial(_coverage, name, product))
            for key in (key for key, plane in product.planes.items() if plane.colours is not None):
                yield Drawing(f"{key} {name}", draw_plane, partial(_plane, name, product, key))
        if sources := noise_sources(maps, name):
            yield Drawing(f"noise {name}", draw_noise, partial(_noise, name, sources, style))
    if data.observations:
        yield Drawing("scan", draw_scan, lambda: ([ScanTrack.of(o) for o in data.scans],), True)
    early = {p.product: p for p in data.partial.values() if isinstance(p, TimeStream)}
    for name, product in (data.products | early).items():
        file = product_path("", name).name
        band = next(
            (f"_{b.name}" for b in data.scene.instrument.bands if name.endswith(f"_{b.name}")), ""
        )
        if isinstance(product, Spectrum):
            file = f"power_spectra{band}" if name == f"spectrum{band}" else f"power_spectra_{file}"
            yield Drawing(
                f"spectra {name}",
                draw_spectra,
                partial(tuple, (file, product, before.get(product.label, ""))),
            )
        elif isinstance(product, TimeStream):
            file = f"tod{band}" if name == f"time_streams{band}" else f"tod_{file}"
            yield Drawing(
                f"streams {name}", draw_streams, partial(_streams, file, product, before), True
            )
        elif isinstance(product, Modes):
            yield Drawing(
                f"modes {name}",
                draw_modes,
                partial(tuple, (file, product, before.get(product.label, ""))),
            )
        elif isinstance(product, Transfer):
            yield Drawing(
                f"transfer function {name}", draw_transfer, partial(tuple, (file, product))
            )
        elif isinstance(product, Drawable):
            yield Drawing(f"own {name}", draw_own, partial(tuple, (file, product)))
        elif isinstance(product, Comparison):
            yield Drawing(
                f"comparison {name}",
                draw_comparison,
                partial(tuple, (file, product, style.contours)),
            )
        elif isinstance(product, MapSpectra):
            yield Drawing(f"map spectra {name}", draw_map_spectra, partial(tuple, (file, product)))
        elif isinstance(product, StreamComparison):
            yield Drawing(
                f"stream comparison {name}", draw_stream_comparison, partial(tuple, (file, product))
            )


def _steps_before(data: Data) -> dict[str, str]:
    """For every step's label, the last step above it that may have changed the streams: where a
    spectrum was taken.
    """
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


def _plain(header: Any) -> dict[str, Any]:
    """The header's numbers and texts, without comments."""
    return {
        key: header[key]
        for key in header
        if key and isinstance(header[key], bool | int | float | str)
    }


def _input(name: str, image: Image, plane: str = "") -> tuple[Any, ...]:
    image, name = (image.stokes(plane), f"{name}_{plane}") if plane else (image, name)
    step = -(-max(image.values.shape) // LARGEST)
    values, axes, header = (
        image.values[::step, ::step],
        SkyAxes.of(image.header),
        _plain(image.header),
    )
    if step > 1 and axes is not None:
        axes = axes.thinned(step)
    elif step > 1:
        every = (slice(None, None, step), slice(None, None, step))
        header = _plain(image.wcs.slice(every).to_header(relax=True))
    return product_path("", name).name, np.asarray(values, np.float32), axes, header, bool(plane)


def _flat(
    product: MapProduct,
    *planes: str,
    style: Style | None = None,
    per_beam: AnyFloats | float | None = None,
) -> FlatMap:
    """What pictures need of a map; a HEALPix or CAR map on a plane about its centre."""
    found = {"hits": product.known_hits} | {
        plane: product.plane(plane).values[0] for plane in ("weights", *planes)
    }
    header, is_flat = product.header, product.projection == "TAN"
    rms: dict[str, float] = {}
    if not is_flat:
        each = {"per_beam": per_beam} if isinstance(per_beam, np.ndarray) else {}
        found, wcs = on_plane(product, found | each)
        if each:
            there = found.pop("per_beam")
            per_beam = np.where(np.isfinite(there), there, np.nanmean(there))
        header = wcs.to_header(relax=True)
        radius = (
            None if style is None or style.central_diameter is None else style.central_diameter / 2
        )
        rms = {} if style is None else {p: product.rms(radius, of=p) for p in planes}
    arrays = {plane: np.asarray(values, np.float32) for plane, values in found.items()}
    return FlatMap(
        {plane: arrays[plane] for plane in planes},
        arrays["hits"],
        np.nan_to_num(arrays["weights"]),
        SkyAxes.of(header),
        _plain(header),
        product.centre,
        product.pixel,
        product.fwhm,
        product.smoothed_by,
        rms,
        is_flat,
        per_beam,
        product.difference.replace(" - ", " minus "),
    )


def _map(
    name: str, product: MapProduct, style: Style, maps: Mapping[str, MapProduct]
) -> tuple[Any, ...]:
    run, _, key = name.rpartition("/")
    flat = _flat(_smoothed(product, style), "signal")
    snr = None
    if style.contours and not run:
        snr = _snr(
            product,
            style,
            noise_alone(maps, name) if name in maps else _of_q_and_u(maps, name.removesuffix("_P")),
        )
    return product_path("", name).name, run, key, flat, style, snr


def _smoothed(product: MapProduct, style: Style) -> MapProduct:
    """A CAR map as it is shown: smoothed on its own pixels, before it is brought to a plane. Others
    as they are.
    """
    smoothing = product.fwhm if style.smooth is None else style.smooth
    return (
        product
        if product.projection != "CAR" or product.smoothed_by or not smoothing
        else product.smoothed(smoothing)
    )


def _of_q_and_u(maps: Mapping[str, MapProduct], name: str) -> tuple[Floats, str] | None:
    """As `noise_alone`, of the P of a map: the rms of that of its Q and U."""
    q, u = (noise_alone(maps, f"{name}_{which}") for which in "QU")
    return None if q is None or u is None else (np.hypot(q[0], u[0]) / math.sqrt(2), q[1])


def _snr(
    product: MapProduct, style: Style, alone: tuple[Floats, str] | None
) -> tuple[AnyFloats, str] | None:
    """The SNR of a map as it is shown, and what its noise is, in words; None where it is not known.
    ``alone``: `noise_alone`.
    """
    flat = product.projection == "TAN"
    smoothing = product.fwhm if style.smooth is None else style.smooth
    as_it_is = product.smoothed_by or product.projection == "HEALPix"
    plane = (
        replace(plane_of(product, "map", alone), fwhm=0.0)
        .smoothed(0.0 if as_it_is else smoothing)
        .measured()
    )
    if plane.noise is None or not np.isfinite(plane.noise).any():
        return None
    with np.errstate(invalid="ignore", divide="ignore"):
        snr = np.asarray(plane.values / plane.noise, np.float32)
    return snr if flat else on_plane(product, {"signal": snr})[0]["signal"], plane.noise_in_words


def _noise(
    name: str, sources: dict[Noise, tuple[MapProduct, Any]], style: Style
) -> tuple[Any, ...]:
    flat = {
        of: _flat(_smoothed(product, style), plane, style=style)
        for of, (product, plane) in sources.items()
    }
    return product_path("", f"noise_{name}").name, flat, style


def _coverage(name: str, product: MapProduct) -> tuple[Any, ...]:
    hits, per_beam = product.hits, product.seconds_per_beam()
    flat = _flat(product, per_beam=per_beam)
    return (
        f"coverage{'' if name == 'map' else f'_{name}'}",
        flat,
        int(hits.sum()),
        int((hits > 0).sum()),
        product.sides,
    )


def _plane(name: str, product: MapProduct, key: str) -> tuple[Any, ...]:
    file = key if name == "map" else f"{key}_{name}"
    return file, _flat(product, key), replace(product.planes[key], values=None)


def _streams(file: str, stream: TimeStream, before: dict[str, str]) -> tuple[Any, ...]:
    brief = replace(
        stream, streams={name: values.astype(np.float32) for name, values in stream.streams.items()}
    )
    return file, brief, before.get(stream.label, "")
