"""Write maps: FITS images with world coordinates, or partial HEALPix tables."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import Field

from zonda.core import tangent
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle
from zonda.core.data import Data
from zonda.core.errors import OutputError, PipelineError
from zonda.core.files import atomic_path, check_output_folder, product_path
from zonda.core.fits_image import Cards, image_bytes
from zonda.core.operator import Operator

from .map_view import MapView, NoiseFigure, maps_of, noise_figures, noise_sources

if TYPE_CHECKING:
    from zonda.core.plan.context import Context
    from zonda.core.plan.estimate import Estimate

_MEANING = {
    "signal": "brightness",
    "hits": "samples per pixel",
    "weights": "sum of weights",
    "noise": "standard error per pixel",
    "half_difference": "noise from the difference of even and odd scans",
    "source_free": "map of the run without the sky",
}
_COORDSYS = {"icrs": "C", "galactic": "G", "barycentricmeanecliptic": "E"}


class SaveMap(Operator):
    """Write every map of the main and companion runs to the output folder.

    ``map.fits``, ``noiseless_map.fits`` ...: the signal in the primary HDU (K_RJ), then HITS, WEIGHTS, NOISE and, where it was
    made, HALF_DIFFERENCE, all with the same world coordinates; HEALPix maps are explicit-index (partial) tables that healpy
    reads. ``noise_map.fits``: the half-difference of the scans and the source-free run's map, with the rms in the central
    arcminute. Every file carries beam, seed, versions, the resolved YAML and the tally. Acts after all runs.

    Raises `OutputError` when there is no output folder, it cannot be written, or the disk is full.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"map"})
    provides: ClassVar[frozenset[str]] = frozenset({"map_file"})
    at_end: ClassVar[bool] = True

    central_diameter: Angle = quantity("1 arcmin", gt=0)
    """Diameter of the circle about the target in which the noise map's rms is taken."""
    overwrite: bool = Field(True)
    """Replace files of an earlier run; if false, they are an error."""

    def observe(self, data: Data) -> None:
        """Refuse a missing or unwritable output folder before anything is simulated."""
        output_folder(data, self.label)

    def estimate(self, context: Context) -> Estimate:
        """Its cost."""
        from zonda.core.plan.estimate import Cost, Estimate

        return Estimate((), Cost(once=0.06 * (1 + max(context.runs.values(), default=1)), bytes=20e6, kernel="python"))

    def finalize(self, data: Data) -> None:
        folder = output_folder(data, self.label)
        maps = maps_of(data.products)
        if not maps:
            raise PipelineError("there is no map to write", place=self.label, cure="add a step that makes one, e.g. BinMap")
        views = {product_path(folder, name, ".fits"): MapView.of(name, product) for name, product in maps.items()}
        noise = {product_path(folder, f"noise_{name}", ".fits"): name for name in maps if noise_sources(maps, name)}
        if not self.overwrite:
            for path in [*views, *noise]:
                if path.exists():
                    raise OutputError(
                        "is there already", place=str(path), cure="remove it, choose another output folder or set overwrite: true"
                    )
        tables = provenance_tables(data)
        for path, view in views.items():
            write_map(path, view, data, tables=tables)
        figures = noise_figures(maps, self.central_diameter)
        for path, name in noise.items():
            view = MapView.of(f"noise_{name}", maps[name])
            view.planes = {of: np.asarray(getattr(product, plane)) for of, (product, plane) in noise_sources(maps, name).items()}
            view.units = dict.fromkeys(view.planes, "K")
            cards = noise_cards([f for f in figures if f.product == name], self.central_diameter)
            write_map(path, view, data, cards, tables)
        data.products["map_file"] = [*views, *noise]


def output_folder(data: Data, place: str) -> Path:
    """The run's output folder, there and writable; `OutputError` otherwise."""
    if data.output is None:
        raise no_output_folder(place)
    return check_output_folder(data.output)


def no_output_folder(place: str) -> OutputError:
    """The error of a step that writes where nothing says whereto."""
    return OutputError(
        "there is no output folder", place=place, cure="give one: zonda run --output FOLDER, or run(scene, output=...)"
    )


def noise_cards(figures: list[NoiseFigure], diameter: float) -> dict[str, tuple[float | None, str]]:
    """Header cards of a noise map: weighted rms about zero in the central circle; undefined where no pixel is there."""
    where = f"central {np.degrees(diameter) * 60:.3g} arcmin"
    cards: dict[str, tuple[float | None, str]] = {}
    for figure in figures:
        keyword = {"half_difference": "RMSHALF", "source_free": "RMSFREE"}[figure.of]
        cards[keyword] = (figure.rms if np.isfinite(figure.rms) else None, f"[K] rms, {where}")
        if np.isfinite(figure.smoothed):
            cards[f"{keyword}B"] = (figure.smoothed, "[K] the same smoothed with the beam")
    return cards


def write_map(
    path: Path,
    view: MapView,
    data: Data,
    cards: dict[str, tuple[float | None, str]] | None = None,
    tables: bytes | None = None,
) -> Path:
    """Write one map atomically; its path. ``cards`` are added to the header of the first image or table.

    ``tables``: `provenance_tables`, where several maps have the same.
    """
    write = _write_healpix if view.is_healpix else _write_images
    with atomic_path(path) as temporary:
        write(temporary, view, data, cards or {})
        with open(temporary, "ab") as file:
            file.write(provenance_tables(data) if tables is None else tables)
    return path


def _write_images(path: Path, view: MapView, data: Data, cards: dict[str, tuple[float | None, str]]) -> None:
    world = (tangent.plain(view.header) or view.wcs).to_header(relax=True)
    with open(path, "wb") as file:
        for k, (name, plane) in enumerate(view.planes.items()):
            header = Cards((key, world[key], world.comments[key]) for key in world if key not in ("", "COMMENT", "HISTORY"))
            header["EXTNAME"] = (name.upper(), "extension name")
            _describe(header, name, view.units.get(name, ""))
            if name not in ("hits", "weights"):
                _add(header, _beam(view))
            if k == 0:
                add_provenance(header, view, data)
                _add(header, cards)
            file.write(image_bytes(header, _stored(name, plane), extension=k > 0))


def _write_healpix(path: Path, view: MapView, data: Data, cards: dict[str, tuple[float | None, str]]) -> None:
    from astropy.io import fits

    hdus = _healpix_hdus(view)
    for hdu in hdus:
        add_provenance(hdu.header, view, data)
    _add(hdus[1].header, cards)
    fits.HDUList(hdus).writeto(path, output_verify="exception")


def _add(header: Any, cards: Mapping[str, tuple[Any, str]]) -> None:
    for keyword, card in cards.items():
        header[keyword] = card


def _stored(name: str, plane: Any) -> Any:
    """Numbers as they are written: hits as integers, everything else as float64."""
    if name == "hits" and np.array_equal(plane, np.rint(plane)):
        return np.asarray(plane, np.int64 if np.max(plane, initial=0) > 2**31 - 1 else np.int32)
    return np.asarray(plane, np.float64)


def _describe(header: Any, name: str, unit: str) -> None:
    if unit:
        header["BUNIT"] = (unit, _MEANING.get(name, name))
    if unit == "K":
        header["TEMPSCAL"] = ("K_RJ", "temperature scale: Rayleigh-Jeans brightness")


def _beam(view: MapView) -> dict[str, tuple[float, str]]:
    if not view.fwhm:
        return {}
    degrees = float(np.degrees(view.fwhm))
    return {"BMAJ": (degrees, "[deg] FWHM"), "BMIN": (degrees, "[deg] FWHM"), "BPA": (0.0, "[deg]")}


def _healpix_hdus(view: MapView) -> list[Any]:
    """A partial map, pixel numbers explicit; the cards are those of Gorski et al. (2005) that healpy reads."""
    from astropy.io import fits

    order = np.argsort(view.pixels, kind="stable")
    columns = [fits.Column("PIXEL", "K", array=view.pixels[order])]
    for name, plane in view.planes.items():
        values = _stored(name, plane)[order]
        code = "D" if values.dtype.kind == "f" else "K" if values.dtype.itemsize == 8 else "J"
        columns.append(fits.Column(name.upper(), code, unit=view.units.get(name) or None, array=values))
    table = fits.BinTableHDU.from_columns(columns, name="MAP")
    header = table.header
    header["PIXTYPE"] = ("HEALPIX", "HEALPix pixelization")
    header["ORDERING"] = ("NESTED" if view.nest else "RING", "pixel ordering")
    header["COORDSYS"] = (_COORDSYS[view.frame], f"{view.frame}")
    header["NSIDE"] = (view.nside, "resolution")
    header["INDXSCHM"] = ("EXPLICIT", "pixel numbers are in the column PIXEL")
    header["OBJECT"] = ("PARTIAL", "not all of the sky")
    header["TEMPSCAL"] = ("K_RJ", "temperature scale: Rayleigh-Jeans brightness")
    _add(header, _beam(view))
    return [fits.PrimaryHDU(), table]


def add_provenance(header: Any, view: MapView, data: Data) -> None:
    """Say in a header where the data come from."""
    import zonda

    scene, provenance = data.scene, data.provenance
    header["ORIGIN"] = ("zonda", "simulated, not observed")
    header["CREATOR"] = (f"zonda {provenance.get('versions', {}).get('zonda', zonda.__version__)}", "software")
    header["PRODUCT"] = (ascii_text(view.name), "product of the pipeline")
    header["PIPELINE"] = (ascii_text(str(provenance.get("name", ""))), "pipeline")
    header["SEED"] = (int(scene.seed), "root of all random numbers")
    header["TELESCOP"] = ascii_text(scene.instrument.telescope.name)
    header["INSTRUME"] = ascii_text(scene.instrument.name)
    header["SITE"] = ascii_text(scene.site.name)
    header["DATE-OBS"] = (str(scene.time), "start of the first scan, UTC")
    header["RESTFRQ"] = (scene.instrument.band.centre, "[Hz] centre of the band")
    header["NSCANS"] = (len(data.observations), "scans")
    if command := provenance.get("command"):
        header["HISTORY"] = ascii_text(str(command))
    for line in str(provenance.get("resolved_yaml", "")).splitlines():
        header["HISTORY"] = ascii_text(line) or " "


def ascii_text(text: str) -> str:
    """FITS holds printable ASCII only: anything else becomes a Python escape (``\\xe9``)."""
    return "".join(c if " " <= c <= "~" else c.encode("unicode_escape").decode() for c in text)


def provenance_tables(data: Data) -> bytes:
    """The resolved YAML (a row per line), the plan and the tally: binary tables of text, as they stand in a file."""
    tables = b""
    if text := str(data.provenance.get("resolved_yaml", "")):
        tables += _text_table("RESOLVED_YAML", {"LINE": text.splitlines()})
    if plan := data.provenance.get("plan"):
        names = ("EFFECT", "DECISION", "BOUND", "FORMULA")
        tables += _text_table("PLAN", {n: [str(r[k]) for r in plan] for k, n in enumerate(names)})
    rows = list(data.tally)
    if rows:
        who, what, value = ([str(r[k]) for r in rows] for k in range(3))
        tables += _text_table("TALLY", {"STEP": who, "WHAT": what, "VALUE": value})
    return tables


def _text_table(name: str, columns: dict[str, list[str]]) -> bytes:
    """FITS 4.0, section 7.3; see `core.fits_image` for why not astropy."""
    plain = {title: [ascii_text(t) for t in texts] for title, texts in columns.items()}
    widths = {title: max([1, *map(len, texts)]) for title, texts in plain.items()}
    rows = list(zip(*([t.ljust(widths[title], "\0") for t in texts] for title, texts in plain.items()), strict=True))
    header = Cards([("XTENSION", "BINTABLE", "binary table extension"), ("BITPIX", 8), ("NAXIS", 2)])
    sizes = {"NAXIS1": sum(widths.values()), "NAXIS2": len(rows), "PCOUNT": 0, "GCOUNT": 1, "TFIELDS": len(plain)}
    for key, size in sizes.items():
        header[key] = size
    for k, (title, width) in enumerate(widths.items(), 1):
        header[f"TTYPE{k}"], header[f"TFORM{k}"] = title, f"{width}A"
    header["EXTNAME"] = name
    body = "".join("".join(row) for row in rows).encode("ascii")
    whole: bytes = header.tostring().encode("ascii") + body + bytes(-len(body) % 2880)
    return whole
