"""Map files: FITS images with world coordinates or partial HEALPix tables, and where they come
from.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from astropy.io import fits
from astropy.io.fits import Header
from numpy.typing import NDArray

from ..data import Data
from ..errors import OutputError
from ..storage.files import atomic_path
from ..storage.fits_files import header_of, joined, table_bytes, write_image
from .header import exact_header
from .map_arrays import MapArrays
from .measured_noise import stated
from .planes import Plane
from .units import scale_of

CONVENTION = "COSMO"
"""In which Q and U of maps are: angles from south to east."""
LONGEST = 66
"""Letters of a text in a card."""
_SCALES = {"K_RJ": "Rayleigh-Jeans brightness", "K_CMB": "temperature of the CMB"}
_COORDSYS = {"icrs": "C", "galactic": "G", "barycentricmeanecliptic": "E"}


@dataclass(frozen=True)
class Provenance:
    """Statements that all map files of a run have in common.

    Attributes
    ----------
    cards
        For the first header: who made it, with what; the resolved YAML as HISTORY.
    tables
        The resolved YAML (a row per line), the plan and the tally: binary tables of text, as they
        stand at a file's end.
    """

    cards: Header
    tables: bytes

    @classmethod
    def of_a_map(cls, product: MapArrays) -> Provenance:
        """Provenance of a map apart from its run."""
        from zonda import __version__

        cards = header_of(
            [
                ("ORIGIN", "zonda", "simulated, not observed"),
                ("CREATOR", f"zonda {__version__}", "software"),
                ("NSCANS", len(product.scans), "scans"),
            ]
        )
        return cls(cards, b"")

    @classmethod
    def of(cls, data: Data) -> Provenance:
        """Provenance of a run that has ended."""
        return cls(_origin(data), b"".join(_tables(data)))


@dataclass(frozen=True)
class MapFile:
    """The part of a product that a file shows.

    Attributes
    ----------
    name
        Of what is shown, e.g. ``noiseless/map``.
    product
        Whose pixels, frame and beam these are.
    planes
        Those that are written, by name; NaN where nothing is known.
    cards
        More of the header of the first image, or of the table.
    noise
        `noise_figures.noise_stated`.
    """

    name: str
    product: MapArrays
    planes: Mapping[str, Plane]
    cards: Header = field(default_factory=Header)
    noise: Mapping[str, tuple[float | None, str]] = field(default_factory=dict)

    @classmethod
    def of(
        cls,
        name: str,
        product: MapArrays,
        noise: Mapping[str, tuple[float | None, str]] | None = None,
    ) -> MapFile:
        """With the planes that a product has."""
        return cls(name, product, product.planes, noise=noise or {})

    @property
    def rows(self) -> Iterator[tuple[str, str, Plane, Any]]:
        """Name, meaning, plane and values of each row of the planes."""
        for plane in self.planes.values():
            for name, meaning, values in plane.rows:
                yield name, meaning, plane, values

    @property
    def beam(self) -> Header:
        """The resolution of the map."""
        product = self.product
        degrees = float(np.degrees(product.resolution))
        what = (
            "[deg] FWHM: beam, smoothing in quadrature"
            if product.smoothed_by
            else "[deg] FWHM of the beam"
        )
        cards = [("BMAJ", degrees, what), ("BMIN", degrees, what), ("BPA", 0.0, "[deg]")]
        narrow, wide = (float(np.degrees(fwhm)) for fwhm in product.beams)
        if narrow < wide:
            cards += [
                ("BEAMLOW", narrow, "[deg] narrowest FWHM of the beams in BMAJ"),
                ("BEAMHIGH", wide, "[deg] widest; BMAJ: peak x beam is the flux"),
            ]
        return header_of(cards if degrees else ())

    @property
    def convention(self) -> Header:
        """In which Q and U are, where there are some."""
        stated = ("POLCCONV", CONVENTION, "Q, U: angles from south to east")
        return header_of([stated] if any(name in "qu" for name, *_ in self.rows) else ())

    @property
    def halves(self) -> Header:
        """Card of the halves that were subtracted in `half_difference`."""
        return header_of(
            [("JACKKNIF", ascii_text(self.product.difference), "halves that were subtracted")]
        )

    def noise_cards(self, plane: str = "") -> Header:
        """Cards on the origin of the noise, for the header of a ``plane`` of it; of a table, for
        its columns together.
        """
        cards: dict[str, tuple[Any, ...]] = {}
        for key, (factor, words) in self.noise.items():
            if (
                plane
                and plane not in {"I": ("noise", "cov_ii"), "Q": ("cov_qq",), "U": ("cov_uu",)}[key]
            ):
                continue
            if factor is not None:
                name = "NOISEFAC" if plane else f"NOISFAC{key}"
                cards[name] = factor, "measured noise / this white noise"
            if plane or key == "I":
                cards["NOISEOF"] = ascii_text(words), "what the noise was measured in"
        return header_of((key, *card) for key, card in cards.items())

    def first(self, about: Provenance) -> Header:
        """Cards of the first header: the name, its origin and its band."""
        found = joined(
            header_of([("PRODUCT", ascii_text(self.name), "product of the pipeline")]), about.cards
        )
        if (band := self.product.band) is not None:
            named = ("BAND", ascii_text(band.name), "name of the band")
            centre = ("RESTFRQ", float(f"{band.centre:.12g}"), "[Hz] centre of the band")
            found = joined(found, header_of([centre, named]))
        return found

    def write(self, path: Path, about: Provenance) -> Path:
        """Write it atomically; its path. Raises `OutputError` where it cannot be written."""
        with atomic_path(path) as temporary:
            if self.product.header is None:
                self._write_table(temporary, about)
            with open(temporary, "ab") as file:
                if self.product.header is not None:
                    self._write_images(file, about)
                for table in self._scan_tables():
                    file.write(table)
                file.write(about.tables)
        return path

    def _scan_tables(self) -> Iterator[bytes]:
        """Hits of each scan: its number, pixel (HEALPix, or y nx + x) and samples, a row each; and
        the names of the scans.
        """
        if (found := self.product.scan_hits) is not None and "hits" in self.planes:
            columns: dict[str, NDArray[Any]] = {**found.table}
            if self.product.pixels is not None:
                columns["PIXEL"] = self.product.pixels[columns["PIXEL"]]
            yield _table("SCAN_HITS", columns)
            yield _text_table("SCANS", {"NAME": found.scans})

    def _write_images(self, file: IO[bytes], about: Provenance) -> None:
        world = exact_header(self.product.wcs)
        unit, scale = scale_of(self.product.unit)
        for k, (name, meaning, plane, values) in enumerate(self.rows):
            cards = [("EXTNAME", name.upper(), "extension name")]
            if own := plane.fits_unit(unit):
                cards.append(("BUNIT", own, meaning))
            if plane.scale > 0 and scale:
                cards.append(("TEMPSCAL", scale, f"temperature scale: {_SCALES[scale]}"))
            parts = [world, header_of(cards)]
            if plane.scale > 0:
                parts.append(self.beam)
            if name.startswith("half_difference"):
                parts.append(self.halves)
            if name == "noise" or name.startswith("cov_"):
                parts.append(self.noise_cards(name))
            parts.append(self.convention)
            if k == 0:
                parts += [self.first(about), self.cards]
            write_image(file, joined(*parts), values, _type(values))

    def _write_table(self, path: Path, about: Provenance) -> None:
        """A partial map, pixel numbers explicit; the cards are those of Gorski et al. (2005) that
        healpy reads.
        """
        product = self.product
        columns = [fits.Column("PIXEL", "K", array=product.pixels)]
        unit, scale = scale_of(product.unit)
        for name, _, plane, row in self.rows:
            values: NDArray[Any] = np.asarray(row, _type(row))
            code = "D" if values.dtype.kind == "f" else "K" if values.dtype.itemsize == 8 else "J"
            columns.append(
                fits.Column(name.upper(), code, unit=plane.fits_unit(unit) or None, array=values)
            )
        table = fits.BinTableHDU.from_columns(columns, name="MAP")
        cards = [
            ("PIXTYPE", "HEALPIX", "HEALPix pixelization"),
            ("ORDERING", "NESTED" if product.nest else "RING", "pixel ordering"),
            ("COORDSYS", _COORDSYS[product.frame], f"{product.frame}"),
            ("NSIDE", product.nside, "resolution"),
            ("INDXSCHM", "EXPLICIT", "pixel numbers are in the column PIXEL"),
            ("OBJECT", "PARTIAL", "not all of the sky"),
        ]
        if scale:
            cards.append(("TEMPSCAL", scale, f"temperature scale: {_SCALES[scale]}"))
        parts = [header_of(cards), self.beam]
        if "half_difference" in self.planes:
            parts.append(self.halves)
        parts += [self.convention, self.noise_cards(), self.first(about), self.cards]
        primary = fits.PrimaryHDU()
        primary.header.extend(self.first(about))
        table.header.extend(joined(*parts))
        fits.HDUList([primary, table]).writeto(path, output_verify="exception")


def write_map(product: MapArrays, path: str | Path, overwrite: bool) -> Path:
    """`MapProduct.write`."""
    path = Path(path).expanduser()
    if path.exists() and not overwrite:
        raise OutputError(
            "exists already", place=str(path), cure="choose another name, or write overwrite=True"
        )
    noise = {}
    for key, plane in product.by_stokes().items():
        half = plane.half_difference
        if np.isfinite(plane.noise).any():
            noise[key] = stated(
                plane.noise,
                None if half is None else (half, f"half the difference, {plane.difference}"),
            )
    return MapFile.of("map", product, noise).write(path, Provenance.of_a_map(product))


def _type(values: NDArray[Any]) -> np.dtype[Any]:
    """Type of numbers as they are written: counts as integers, everything else as float64."""
    if values.dtype.kind in "iu":
        return np.dtype(np.int64 if np.max(values, initial=0) > 2**31 - 1 else np.int32)
    return np.dtype(np.float64)


def _origin(data: Data) -> Header:
    """Cards of the origin of the data; the command and the resolved YAML as history."""
    import zonda

    scene, provenance = data.scene, data.provenance
    version = provenance.get("versions", {}).get("zonda", zonda.__version__)
    start = str(min((o.start for o in data.scans), default=scene.time))
    cards: list[tuple[Any, ...]] = [
        ("ORIGIN", "zonda", "simulated, not observed"),
        ("CREATOR", f"zonda {version}", "software"),
        ("PIPELINE", ascii_text(str(provenance.get("name", ""))), "pipeline"),
        ("SEED", int(scene.seed), "root of all random numbers"),
        ("DATE-OBS", start, "start of the first scan, UTC"),
        ("NSCANS", len(data.scans), "scans"),
    ]
    history: list[str] = []
    names = (scene.instrument.telescope.name, scene.instrument.name, scene.site.name)
    found = (
        zip(*(o.origin for o in data.scans), strict=True)
        if data.scans
        else ((name,) for name in names)
    )
    for key, every in zip(("TELESCOP", "INSTRUME", "SITE"), found, strict=True):
        name, more = _names(every)
        cards.append((key, name))
        history += [f"{key}: {name}" for name in more]
    if command := str(provenance.get("command", "")):
        history.append(ascii_text(command))
    history += map(ascii_text, str(provenance.get("resolved_yaml", "")).splitlines())
    return header_of(cards, history)


def _names(every: Iterable[str]) -> tuple[str, list[str]]:
    """The different names, and those that HISTORY tells where a card does not hold them."""
    names = sorted({ascii_text(name) for name in every})
    text = ", ".join(names)
    return (text, []) if len(text) <= LONGEST else (f"{len(names)} of them, see HISTORY", names)


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
    plain = {title: [ascii_text(t) for t in texts] for title, texts in columns.items()}
    widths = {title: max([1, *map(len, texts)]) for title, texts in plain.items()}
    return _table(
        name,
        {
            title: np.array([t.encode("ascii") for t in plain[title]], f"S{widths[title]}")
            for title in plain
        },
    )


def _table(name: str, columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Columns of texts (``S``), int32 or int64 as a binary table."""
    kinds = [(title, values.dtype) for title, values in columns.items()]
    rows = np.rec.fromarrays(list(columns.values()), dtype=kinds)
    return table_bytes(fits.BinTableHDU(rows, name=name))
