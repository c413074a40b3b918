"""Map files: FITS images with world coordinates or partial HEALPix tables, and where they come from."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core import tangent
from zonda.core.data import Data
from zonda.core.files import atomic_path

from .map_view import MapView

Value = bool | int | float | str | None
Cards = Mapping[str, tuple[Value, str]]
"""Header cards: value (None: undefined) and comment by keyword."""

PIECE = 1 << 20
"""Bytes of an image that are converted at a time."""

_MEANING = {
    "signal": "brightness",
    "hits": "samples per pixel",
    "weights": "sum of weights",
    "noise": "standard error per pixel",
    "half_difference": "noise from the difference of even and odd scans",
    "source_free": "map of the run without the sky",
}
_COORDSYS = {"icrs": "C", "galactic": "G", "barycentricmeanecliptic": "E"}


@dataclass(frozen=True)
class Provenance:
    """What all map files of a run say alike.

    Attributes
    ----------
    cards
        For the first header: who made it, with what; the resolved YAML as HISTORY.
    tables
        The resolved YAML (a row per line), the plan and the tally: binary tables of text, as they stand at a file's end.
    """

    cards: str
    tables: bytes

    @classmethod
    def of(cls, data: Data) -> Provenance:
        """Of a run that has ended."""
        return cls(_cards(_origin(data)) + "".join(_history(data)), b"".join(_tables(data)))


def write_map(path: Path, view: MapView, about: Provenance, cards: Cards | None = None) -> Path:
    """Write one map atomically; its path. ``cards`` are added to the header of the first image, or of the table.

    Raises `OutputError` where it cannot be written.
    """
    with atomic_path(path) as temporary, open(temporary, "wb") as file:
        for piece in _table(view, about, cards or {}) if view.is_healpix else _images(view, about, cards or {}):
            file.write(piece)
        file.write(about.tables)
    return path


def _images(view: MapView, about: Provenance, cards: Cards) -> Iterator[bytes]:
    """FITS 4.0, sections 3.3.2 and 7.1. astropy takes ten times as long, most of it for reading again what it has written."""
    world = _world(tangent.plain(view.header) or view.wcs)
    for k, (name, plane) in enumerate(view.planes.items()):
        dtype = _type(name, plane)
        more: dict[str, tuple[Value, str]] = {"EXTNAME": (name.upper(), "extension name")}
        if unit := view.units.get(name, ""):
            more["BUNIT"] = (unit, _MEANING.get(name, name))
        if unit == "K":
            more["TEMPSCAL"] = ("K_RJ", "temperature scale: Rayleigh-Jeans brightness")
        if name not in ("hits", "weights"):
            more |= _beam(view)
        text = _structure(k == 0, dtype, plane.shape) + world + _cards(more)
        if k == 0:
            text += _cards({"PRODUCT": (ascii_text(view.name), "product of the pipeline")}) + about.cards + _cards(cards)
        yield _header(text)
        rows = max(1, PIECE // max(1, plane.shape[1] * dtype.itemsize))
        for first in range(0, plane.shape[0], rows):
            yield np.asarray(plane[first : first + rows], dtype).tobytes()
        yield bytes(-plane.size * dtype.itemsize % 2880)


def _structure(first: bool, dtype: np.dtype[Any], shape: tuple[int, ...]) -> str:
    """The cards that an image begins with (FITS 4.0, table 8)."""
    size = 8 * dtype.itemsize
    axes: dict[str, tuple[Value, str]] = {
        "BITPIX": (-size if dtype.kind == "f" else size, "array data type"),
        "NAXIS": (2, "number of array dimensions"),
        "NAXIS1": (shape[1], ""),
        "NAXIS2": (shape[0], ""),
    }
    if first:
        return _cards({"SIMPLE": (True, "conforms to FITS standard"), **axes, "EXTEND": (True, "")})
    counts: dict[str, tuple[Value, str]] = {"PCOUNT": (0, "number of parameters"), "GCOUNT": (1, "number of groups")}
    return _cards({"XTENSION": ("IMAGE", "Image extension"), **axes, **counts})


def _header(cards: str) -> bytes:
    """With its end, in whole blocks."""
    text = cards + "END".ljust(80)
    return (text + " " * (-len(text) % 2880)).encode("ascii")


def _cards(cards: Cards) -> str:
    from astropy.io.fits import Card

    return "".join(Card(keyword, value, comment or None).image for keyword, (value, comment) in cards.items())


def _world(wcs: Any) -> str:
    """World coordinates as cards."""
    return _plain_world(wcs) if isinstance(wcs, tangent.TangentWcs) else _text(wcs.to_header(relax=True))


@lru_cache(maxsize=1)  # the maps of all runs have the same
def _plain_world(wcs: tangent.TangentWcs) -> str:
    return _text(wcs.to_header(relax=True))


def _text(header: Any) -> str:
    return str(header.tostring(endcard=False, padding=False))


def _type(name: str, plane: Any) -> np.dtype[Any]:
    """Type of numbers as they are written: hits as integers, everything else as float64."""
    if name == "hits" and (plane.dtype.kind in "iu" or np.array_equal(plane, np.rint(plane))):
        return np.dtype(">i8" if np.max(plane, initial=0) > 2**31 - 1 else ">i4")
    return np.dtype(">f8")


def _beam(view: MapView) -> dict[str, tuple[Value, str]]:
    if not view.fwhm:
        return {}
    degrees = float(np.degrees(view.fwhm))
    return {"BMAJ": (degrees, "[deg] FWHM"), "BMIN": (degrees, "[deg] FWHM"), "BPA": (0.0, "[deg]")}


def _table(view: MapView, about: Provenance, cards: Cards) -> Iterator[bytes]:
    """A partial map, pixel numbers explicit; the cards are those of Gorski et al. (2005) that healpy reads."""
    import io

    from astropy.io import fits

    order = np.argsort(view.pixels, kind="stable")
    columns = [fits.Column("PIXEL", "K", array=view.pixels[order])]
    for name, plane in view.planes.items():
        values: NDArray[Any] = np.asarray(plane, _type(name, plane).newbyteorder("="))[order]
        code = "D" if values.dtype.kind == "f" else "K" if values.dtype.itemsize == 8 else "J"
        columns.append(fits.Column(name.upper(), code, unit=view.units.get(name) or None, array=values))
    table = fits.BinTableHDU.from_columns(columns, name="MAP")
    made: dict[str, tuple[Value, str]] = {
        "PIXTYPE": ("HEALPIX", "HEALPix pixelization"),
        "ORDERING": ("NESTED" if view.nest else "RING", "pixel ordering"),
        "COORDSYS": (_COORDSYS[view.frame], f"{view.frame}"),
        "NSIDE": (view.nside, "resolution"),
        "INDXSCHM": ("EXPLICIT", "pixel numbers are in the column PIXEL"),
        "OBJECT": ("PARTIAL", "not all of the sky"),
        "TEMPSCAL": ("K_RJ", "temperature scale: Rayleigh-Jeans brightness"),
        **_beam(view),
    }
    origin = _cards({"PRODUCT": (ascii_text(view.name), "product of the pipeline")}) + about.cards
    hdus = [fits.PrimaryHDU(), table]
    for hdu, text in zip(hdus, (origin, _cards(made) + origin + _cards(cards)), strict=True):
        for card in fits.Header.fromstring(text).cards:
            hdu.header.append(card, end=True)
    stream = io.BytesIO()
    fits.HDUList(hdus).writeto(stream, output_verify="exception")
    yield stream.getvalue()


def _origin(data: Data) -> dict[str, tuple[Value, str]]:
    """Where the data come from."""
    import zonda

    scene, provenance = data.scene, data.provenance
    return {
        "ORIGIN": ("zonda", "simulated, not observed"),
        "CREATOR": (f"zonda {provenance.get('versions', {}).get('zonda', zonda.__version__)}", "software"),
        "PIPELINE": (ascii_text(str(provenance.get("name", ""))), "pipeline"),
        "SEED": (int(scene.seed), "root of all random numbers"),
        "TELESCOP": (ascii_text(scene.instrument.telescope.name), ""),
        "INSTRUME": (ascii_text(scene.instrument.name), ""),
        "SITE": (ascii_text(scene.site.name), ""),
        "DATE-OBS": (str(scene.time), "start of the first scan, UTC"),
        "RESTFRQ": (scene.instrument.band.centre, "[Hz] centre of the band"),
        "NSCANS": (len(data.observations), "scans"),
    }


def _history(data: Data) -> Iterator[str]:
    """The command and the resolved YAML as HISTORY cards, 72 characters each."""
    lines = [ascii_text(str(data.provenance.get("command", "")))]
    lines = [line for line in lines if line] + [ascii_text(x) for x in str(data.provenance.get("resolved_yaml", "")).splitlines()]
    for line in lines:
        for k in range(0, max(1, len(line)), 72):
            yield f"HISTORY {line[k : k + 72]}".ljust(80)


def ascii_text(text: str) -> str:
    """FITS holds printable ASCII only: anything else becomes a Python escape (``\\xe9``)."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(c if " " <= c <= "~" else c.encode("unicode_escape").decode() for c in text)


def _tables(data: Data) -> Iterable[bytes]:
    if text := str(data.provenance.get("resolved_yaml", "")):
        yield _text_table("RESOLVED_YAML", {"LINE": text.splitlines()})
    if plan := data.provenance.get("plan"):
        names = ("EFFECT", "DECISION", "BOUND", "FORMULA")
        yield _text_table("PLAN", {n: [str(r[k]) for r in plan] for k, n in enumerate(names)})
    if rows := list(data.tally):
        who, what, value = ([str(r[k]) for r in rows] for k in range(3))
        yield _text_table("TALLY", {"STEP": who, "WHAT": what, "VALUE": value})


def _text_table(name: str, columns: dict[str, list[str]]) -> bytes:
    """FITS 4.0, section 7.3. astropy's tables take 0.1 s to import, and as long to write."""
    plain = {title: [ascii_text(t) for t in texts] for title, texts in columns.items()}
    widths = {title: max([1, *map(len, texts)]) for title, texts in plain.items()}
    rows = zip(*([t.ljust(widths[title], "\0") for t in texts] for title, texts in plain.items()), strict=True)
    cards: dict[str, tuple[Value, str]] = {
        "XTENSION": ("BINTABLE", "binary table extension"),
        "BITPIX": (8, ""),
        "NAXIS": (2, ""),
        "NAXIS1": (sum(widths.values()), ""),
        "NAXIS2": (max(map(len, plain.values())), ""),
        "PCOUNT": (0, ""),
        "GCOUNT": (1, ""),
        "TFIELDS": (len(plain), ""),
    }
    for k, (title, width) in enumerate(widths.items(), 1):
        cards |= {f"TTYPE{k}": (title, ""), f"TFORM{k}": (f"{width}A", "")}
    body = "".join("".join(row) for row in rows).encode("ascii")
    return _header(_cards({**cards, "EXTNAME": (name, "")})) + body + bytes(-len(body) % 2880)
