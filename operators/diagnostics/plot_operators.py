"""Pictures of a run: made once, written as PNG files and shown in the report."""

from __future__ import annotations

import io
from collections.abc import Callable, Iterator
from concurrent.futures import Future
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field, PrivateAttr

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.files import atomic_path, product_path
from zonda.core.operator import Operator
from zonda.operators.io.map_view import MapView, maps_of, noise_sources
from zonda.operators.io.save_map import output_folder
from zonda.operators.maps.image import Image
from zonda.operators.maps.map_product import FWHM_PER_SIGMA, MapProduct

from .artist import Artist
from .plots import SHOWN, plot_coverage, plot_map, plot_scan, plot_spectra, plot_tod, plot_transfer
from .power_spectrum import Spectrum
from .time_streams import TimeStream
from .transfer_function import Transfer

if TYPE_CHECKING:
    from zonda.core.plan.context import Context
    from zonda.core.plan.estimate import Estimate

LARGEST = 1500
"""Pixels of an image's longer side in a picture; larger images are thinned out."""


@dataclass(frozen=True)
class Picture:
    """A PNG image: ``name`` without suffix, a title, what it shows, its bytes."""

    name: str
    title: str
    caption: str
    png: bytes


class Plots(Operator):
    """Draw what the run made and write it as PNG files to the output folder.

    ``input.png``, ``noiseless_map.png``, ``map.png``, ``noise_map.png``, ``coverage.png``, ``power_spectra.png``, ``tod.png``,
    ``scan.png``, ``transfer_function.png``, each where there is something to show. Acts after all runs; the report shows the same
    pictures.

    Raises `OutputError` when there is no output folder, it cannot be written, or the disk is full.
    """

    optional: ClassVar[frozenset[str]] = frozenset({"map", "spectrum", "time_streams", "transfer_function"})
    provides: ClassVar[frozenset[str]] = frozenset({"pictures"})
    at_end: ClassVar[bool] = True

    smooth: Angle | Literal["beam", "none"] = "beam"
    """Smooth image maps that are not smoothed yet for their pictures: with the beam, with a Gaussian of this FWHM, or not."""
    central_diameter: Angle = quantity("1 arcmin", gt=0)
    """Diameter of the circle that noise maps show, in which their rms is taken."""
    least_coverage: float = Field(0.1, ge=0, lt=1)
    """Map pixels with fewer samples than this share of the 99th percentile are left grey in the pictures."""

    _artist: Artist | None = PrivateAttr(None)
    _begun: dict[str, Future[Any]] = PrivateAttr(default_factory=dict)

    def observe(self, data: Data) -> None:
        """Refuse a missing or unwritable output folder before anything is simulated; let a second process be started."""
        output_folder(data, self.label)
        self._begun = {}
        if self._artist is None and data.threads > 1:
            with suppress(OSError):
                self._artist = Artist()

    def after_run(self, data: Data) -> None:
        """Begin with the pictures of what will not change any more."""
        if self._artist is not None:
            last = data.run == ["", *data.provenance.get("runs", [])][-1]
            for drawing in _drawings(data, self._style()):
                if (drawing.settled or last) and drawing.key not in self._begun:
                    self._begun[drawing.key] = self._artist.submit(drawing.function, *drawing.arguments())

    def estimate(self, context: Context) -> Estimate:
        """Its cost."""
        from zonda.core.plan.estimate import Cost, Estimate

        return Estimate((), Cost(once=2.0 + 0.25 * len(context.observations), bytes=200e6, kernel="python"))

    def finalize(self, data: Data) -> None:
        folder = output_folder(data, self.label)
        try:
            made = pictures(data, self._style(), self._begun, self._artist)
        finally:
            self._begun = {}
            if self._artist is not None:
                self._artist.close()
                self._artist = None
        for picture in made:
            with atomic_path(product_path(folder, picture.name, ".png")) as temporary:
                temporary.write_bytes(picture.png)
        data.products["pictures"] = made

    def _style(self) -> Plots:
        """Its parameters alone, for another process."""
        style = self.model_copy()
        style._artist, style._begun = None, {}
        return style


@dataclass(frozen=True)
class Drawing:
    """Pictures to be made by ``function(*arguments())``; ``settled``: from what is there once it can be made,
    whatever runs follow."""

    key: str
    function: Callable[..., list[Picture]]
    arguments: Callable[[], tuple[Any, ...]]
    settled: bool = True


def pictures(
    data: Data, options: Plots, begun: dict[str, Future[Any]] | None = None, artist: Artist | None = None
) -> list[Picture]:
    """Every picture that the products allow, in reading order. ``begun``: by `Drawing.key`, what ``artist`` is drawing."""
    drawings, coming = list(_drawings(data, options)), dict(begun or {})
    for drawing in drawings:
        if artist is not None and drawing.key not in coming:
            coming[drawing.key] = artist.submit(drawing.function, *drawing.arguments())
    made: list[Picture] = []
    for drawing in drawings:
        found = coming[drawing.key].result() if drawing.key in coming else None
        made += drawing.function(*drawing.arguments()) if found is None else found
    return made


def _drawings(data: Data, options: Plots) -> Iterator[Drawing]:
    """What there is to draw, in reading order."""
    maps = maps_of(data.products)
    before = _steps_before(data)
    for name, image in data.products.items():
        if isinstance(image, Image) and "/" not in name:
            yield Drawing(f"input {name}", _input, partial(tuple, (name, image)))
    for name in sorted(maps, key=lambda n: (n.rpartition("/")[2], not n.startswith("noiseless/"), "/" in n)):
        if not name.startswith("source_free/") and maps[name].contents == "all":
            yield Drawing(f"map {name}", _map, partial(tuple, (name, maps[name], options)))
    for name, product in maps.items():
        if "/" not in name:
            yield Drawing(f"coverage {name}", _coverage, partial(tuple, (name, product)))
        if noise_sources(maps, name):
            sources = {k: maps[k] for k in (name, f"source_free/{name}") if k in maps}
            yield Drawing(f"noise {name}", _noise, partial(tuple, (name, sources, options)), settled=False)
    if data.observations:
        yield Drawing("scan", _scan, partial(_tracks, data))
    for name, product in data.products.items():
        if isinstance(product, Spectrum):
            yield Drawing(f"spectra {name}", _spectra, partial(tuple, (name, product, before.get(product.label, ""))))
        elif isinstance(product, TimeStream):
            yield Drawing(f"streams {name}", _streams, partial(tuple, (name, product, before.get(product.label, ""))))
        elif isinstance(product, Transfer):
            yield Drawing(f"transfer function {name}", _transfer, partial(tuple, (name, product)))


def _tracks(data: Data) -> tuple[list[Any]]:
    """What `plot_scan` reads of the observations: they themselves cannot be sent to another process."""
    tracks = []
    for o in data.observations:
        ra, dec, _ = o.derotate("boresight_radec")
        tracks.append(SimpleNamespace(name=o.name, centre=o.centre, n_samples=o.n_samples, ra=ra, dec=dec))
    return (tracks,)


def _steps_before(data: Data) -> dict[str, str]:
    """For every step's label, the last step above it that may have changed the streams: where a spectrum was taken."""
    found, last = {}, ""
    for label, kind, _ in data.provenance.get("operators", []):
        found[label] = last
        if kind not in ("PowerSpectrum", "TimeStreams", "SaveTOD"):
            last = label
    return found


def _png(ax: Any) -> bytes:
    """What ``figure.savefig`` writes, without its rehearsal: it draws everything once more to find the layout."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg

    stream = io.BytesIO()
    FigureCanvasAgg(ax.figure).print_png(stream, metadata={"Software": "zonda"})  # type: ignore[no-untyped-call]
    return stream.getvalue()


def _input(name: str, image: Image) -> list[Picture]:
    step = -(-max(image.values.shape) // LARGEST)
    values, wcs = image.values[::step, ::step], image.wcs
    if step > 1:
        wcs = wcs.slice((slice(None, None, step), slice(None, None, step)))
    ax = plot_map(values, wcs, title="Input: the sky before the beam")
    caption = "The input map, before beam, opacity and filters."
    return [Picture(product_path("", name).name, "Input", caption, _png(ax))]


def _shown(product: MapProduct, options: Plots) -> tuple[MapProduct, str]:
    """The product as its picture shows it, and what was done to it."""
    if product.header is None:
        return product, "not smoothed"
    if options.smooth == "none" or product.smoothed_by:
        return product, f"smoothed by {_arcsec(product.smoothed_by)}" if product.smoothed_by else "not smoothed"
    fwhm = product.fwhm if options.smooth == "beam" else float(options.smooth)
    return (product.smoothed(fwhm), f"smoothed by {_arcsec(fwhm)} for this picture") if fwhm > 0 else (product, "not smoothed")


def _arcsec(angle: float) -> str:
    return f"{np.degrees(angle) * 3600:.3g}″"


def _covered(product: MapProduct, options: Plots) -> np.ndarray[Any, np.dtype[np.bool_]]:
    """Pixels with enough samples to be shown: samples as smoothed as the map is, so that the edge is not ragged."""
    hits = product.hits.astype(np.float64)
    if product.header is not None and product.smoothed_by:
        from scipy.ndimage import gaussian_filter

        hits = gaussian_filter(hits, product.smoothed_by / product.pixel / FWHM_PER_SIGMA, mode="constant")
    seen = hits[product.hits > 0]
    return np.asarray(hits >= options.least_coverage * np.percentile(seen, 99)) if seen.size else product.hits > 0


def _limit(values: Any, product: MapProduct, share: float = 99.7) -> float | None:
    """Brightness scale that covers ``share`` per cent of what is well covered: the noisy rim must not set it."""
    hits = product.hits
    if not hits.any():
        return None
    good = np.abs(values[(hits > 0.25 * np.percentile(hits[hits > 0], 99)) & np.isfinite(values)])
    return float(np.percentile(good, share)) if good.size else None


def _draw(
    name: str,
    product: MapProduct,
    planes: dict[str, Any],
    titles: dict[str, str],
    options: Plots,
    limit: float | None,
    circle: bool = False,
) -> bytes:
    """One panel per plane."""
    from matplotlib.figure import Figure

    covered = _covered(product, options)
    view = MapView.of(name, product)
    view.planes = {k: np.where(covered, v, np.nan) for k, v in planes.items()}
    flat = view.flat()
    figure = Figure(figsize=(6.4 * len(planes), 5.2), dpi=110, layout="constrained")
    for k, plane in enumerate(planes, 1):
        ax = figure.add_subplot(1, len(planes), k, projection=flat.wcs)
        width = options.central_diameter if circle else None
        plot_map(flat.planes[plane], flat.wcs, ax=ax, title=titles[plane], fwhm=view.fwhm or None, limit=limit, circle=width)
    return _png(ax)


def _map(name: str, product: MapProduct, options: Plots) -> list[Picture]:
    run, _, key = name.rpartition("/")
    shown, how = _shown(product, options)
    title = {"": "Map", "noiseless": "Map of the noiseless run"}.get(run, f"Map of run {run}")
    title += "" if key == "map" else f" ({key})"
    meaning = {
        "": "Everything: sky, atmosphere and noise, filtered and binned.",
        "noiseless": "The sky alone through the same pointing, filters and binning: what the processing leaves of it.",
    }.get(run, "A companion run.")
    limit = _limit(shown.signal, shown, SHOWN if run == "noiseless" else 99.7)
    png = _draw(name, shown, {"signal": shown.signal}, {"signal": _titled(title, how)}, options, limit)
    return [Picture(product_path("", name).name, title, f"{meaning} {how[0].upper()}{how[1:]}.", png)]


def _titled(title: str, how: str) -> str:
    return f"{title}, {how.removesuffix(' for this picture')}"


def _noise(name: str, maps: dict[str, MapProduct], options: Plots) -> list[Picture]:
    product = maps[name]
    planes: dict[str, Any] = {}
    titles: dict[str, str] = {}
    figures = []
    resolution, how = _shown(product, options)
    limits = []
    words = {"half_difference": "even minus odd scans", "source_free": "run without the sky"}
    for of, (source, plane) in noise_sources(maps, name).items():
        shown, how = _shown(source, options)
        planes[of], titles[of] = np.asarray(getattr(shown, plane)), _titled(f"Noise: {words[of]}", how)
        limits.append(_limit(planes[of], resolution))
        rms = shown.rms(options.central_diameter / 2, of=plane)
        if np.isfinite(rms):
            figures.append(f"{words[of]} {rms * 1e6:.4g} µK_RJ")
    limit = max((x for x in limits if x), default=None)
    png = _draw(name, resolution, planes, titles, options, limit, circle=True)
    text = "Noise maps on one scale, " + how + "."
    if figures:
        text += (
            f" Weighted rms within the dotted circle of {np.degrees(options.central_diameter) * 60:.3g}′: {', '.join(figures)}."
        )
    return [Picture(product_path("", f"noise_{name}").name, "Noise", text, png)]


def _coverage(name: str, product: MapProduct) -> list[Picture]:
    flat = MapView.of(name, product).flat()
    ax = plot_coverage(flat.planes["hits"], flat.wcs)
    suffix = "" if name == "map" else f"_{name}"
    return [
        Picture(
            f"coverage{suffix}",
            "Coverage",
            f"{int(product.hits.sum()):,} samples in {int((product.hits > 0).sum()):,} pixels.",
            _png(ax),
        )
    ]


def _scan(observations: list[Any]) -> list[Picture]:
    ax = plot_scan(observations)
    return [Picture("scan", "Boresight track", "The boresight about the target, one line per scan.", _png(ax))]


def _spectra(name: str, spectrum: Spectrum, before: str) -> list[Picture]:
    where = f"after {before}" if before else f"at step {spectrum.label}"
    ax = plot_spectra(spectrum, title=f"Power spectra of the time streams {where}")
    many = f"{spectrum.detectors} detectors and {spectrum.observations} scan{'s' if spectrum.observations > 1 else ''}"
    caption = f"Mean of {many} {where}, referred to the calibrated sky: divided by ζe^-τ, the atmosphere times ε."
    if "signal" in spectrum.psd:
        caption += " The signal holds the mean emission too, which changes as the scan moves in elevation."
    suffix = "" if name == "spectrum" else f"_{product_path('', name).name}"
    return [Picture(f"power_spectra{suffix}", "Power spectra", caption, _png(ax))]


def _transfer(name: str, transfer: Transfer) -> list[Picture]:
    whose = "the sky alone" if transfer.modes == "sky" else "the complete data"
    caption = (
        "The map of the sky alone through all filters against the same map without filters, by angular scale: the ratio of "
        "their cross spectrum to the spectrum of the latter, with the standard error from the scatter of the modes (bars); "
        f"dashed, the ratio of amplitudes. Dotted, the beam. Singular modes of {whose}."
    )
    ax = plot_transfer(transfer, title=f"Transfer function, singular modes of {whose}")
    return [Picture(product_path("", name).name, "Transfer function", caption, _png(ax))]


def _streams(name: str, stream: TimeStream, before: str) -> list[Picture]:
    where = f"after {before}" if before else f"at step {stream.label}"
    suffix = "" if name == "time_streams" else f"_{product_path('', name).name}"
    made = []
    for which in stream.streams:
        extra = "" if which == "signal" else f"_{which}"
        meaning = "divided by ζe^-τ, with what is left of the mean emission" if which == "signal" else "at the detector"
        caption = f"Stream {which} of {len(stream.names)} detectors {where}: {meaning}. Pale: samples; dark: means over 1 s."
        ax = plot_tod(stream, name=which, title=f"Time streams of {stream.observation} {where}")
        made.append(Picture(f"tod{suffix}{extra}", "Time streams", caption, _png(ax)))
    return made
