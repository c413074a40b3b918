"""Map files: FITS images with world coordinates or partial HEALPix tables, and where they come
from.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any

import numpy as np
from astropy.io import fits
from astropy.io.fits import Header
from numpy.typing import NDArray

from ..configuration.time import SECOND
from ..data import Data
from ..errors import OutputError
from ..machine import versions
from ..storage.files import atomic_path
from ..storage.fits_files import header_of, joined, table_bytes, write_image
from .header import exact_header
from .map_arrays import NOISE_MODELS, MapArrays
from .planes import ELSEWHERE, Plane, stated
from .units import scale_of

CONVENTION = "COSMO"
"""In which Q and U of maps are: angles from south to east."""
MJD_OF_1970 = 40587.0
LONGEST = 66
"""Letters of a text in a card."""
_SCALES = {"K_RJ": "Rayleigh-Jeans brightness", "K_CMB": "temperature of the CMB"}
_COORDSYS = {"icrs": "C", "galactic": "G", "barycentricmeanecliptic": "E"}

Cards = list[tuple[Any, ...]]


@dataclass(frozen=True)
class Provenance:
    """Statements that all map files of a run have in common.

    Attributes
    ----------
    cards, history
        For the first header: who made it, with what; the resolved YAML as HISTORY.
    tables
        The resolved YAML (a row per line), the plan and the log: binary tables of text, as they
        stand at a file's end.
    product
        Name of the map among those of its run.
    quiet
        True for a map of a signal without noise (`Signal.is_quiet`).
    """

    cards: Cards
    history: list[str] = field(default_factory=list)
    tables: bytes = b""
    product: str = "map"
    quiet: bool = False

    @classmethod
    def of_a_map(cls, product: MapArrays) -> Provenance:
        """Provenance of a map apart from its run."""
        return cls([*_origin(versions()["zonda"]), ("NSCANS", len(product.scans), "scans")])

    @classmethod
    def of(cls, data: Data, tables: bool = True) -> Provenance:
        """Provenance of a run whose scans are mapped: cards of its origin; the command and the
        resolved YAML as history. ``tables``: with these.
        """
        scene = data.scene
        provenance = data.provenance
        version = provenance.get("versions", {}).get("zonda") or versions()["zonda"]
        start = min((o.start for o in data.scans), default=scene.time)
        days = start.nanoseconds / (86400 * SECOND)
        cards = [
            *_origin(version),
            ("PIPELINE", ascii_text(str(provenance.get("name", ""))), "pipeline"),
            ("SEED", int(scene.seed), "root of all random numbers"),
            ("DATE-OBS", start.isoformat().rstrip("Z"), "start of the first scan, UTC"),
            ("MJD-OBS", MJD_OF_1970 + days, "[d] the same"),
            ("EXPTIME", sum(o.duration for o in data.scans), "[s] of all scans, without gaps"),
            ("NSCANS", len(data.scans), "scans"),
        ]
        history: list[str] = []
        camera = scene.instrument
        origins = [o.origin for o in data.scans] or [
            (camera.telescope.name, camera.name, scene.site.name)
        ]
        named: dict[str, Any] = dict(
            zip(("TELESCOP", "INSTRUME", "SITE"), zip(*origins, strict=True), strict=True)
        )
        named["OBJECT"] = _positions({o.centre for o in data.scans})
        for key, every in named.items():
            text, names = listed(every)
            history += [f"{key}: {name}" for name in names]
            cards.append((key, text))
        yaml = str(provenance.get("resolved_yaml", ""))
        history += map(ascii_text, filter(None, (str(provenance.get("command", "")),)))
        history += map(ascii_text, yaml.splitlines())
        if not tables:
            return cls(cards, history)
        texts: list[tuple[str, tuple[str, ...], Any]] = [
            ("RESOLVED_YAML", ("LINE",), [(line,) for line in yaml.splitlines()]),
            ("PLAN", ("EFFECT", "DECISION", "BOUND", "FORMULA"), provenance.get("plan")),
            ("TALLY", ("STEP", "WHAT", "VALUE"), list(data.log)),
        ]
        written = (
            _table(name, dict(zip(keys, map(_texts, zip(*rows, strict=True)), strict=False)))
            for name, keys, rows in texts
            if rows
        )
        return cls(cards, history, b"".join(written))


def _positions(centres: Collection[tuple[float, float]]) -> list[str]:
    """ICRS directions (ra, dec) [rad] as text: ``05h00m00.00s +20d00m00.0s``."""
    from astropy.coordinates import Angle

    if not centres:
        return []
    longitudes, latitudes = Angle(np.transpose(sorted(centres)), "rad")
    return [
        f"{a} {b}"
        for a, b in zip(
            longitudes.to_string("hourangle", precision=2, pad=True),
            latitudes.to_string("deg", precision=1, pad=True, alwayssign=True),
            strict=True,
        )
    ]


def _origin(version: str) -> Cards:
    return [
        ("ORIGIN", "zonda", "simulated, not observed"),
        ("CREATOR", f"zonda {version}", "software"),
    ]


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
    def rows(self) -> list[tuple[str, str, Plane, Any]]:
        """Name, meaning, plane and values of each row of the planes."""
        return [
            (name, meaning, plane, values)
            for plane in self.planes.values()
            for name, meaning, values in plane.rows
        ]

    @property
    def beam(self) -> Cards:
        """The resolution of the map."""
        product = self.product
        narrow, wide, degrees = (
            float(np.degrees(fwhm)) for fwhm in (*product.beams, product.resolution)
        )
        if not degrees:
            return []
        more = ": beam, smoothing in quadrature" if product.smoothed_by else " of the beam"
        cards: Cards = [(key, degrees, f"[deg] FWHM{more}") for key in ("BMAJ", "BMIN")]
        cards.append(("BPA", 0.0, "[deg]"))
        if narrow < wide:
            cards += [
                ("BEAMLOW", narrow, "[deg] narrowest FWHM of the beams in BMAJ"),
                ("BEAMHIGH", wide, "[deg] widest; BMAJ: peak x beam is the flux"),
            ]
        return cards

    def about(self, rows: Sequence[tuple[str, str, Plane, Any]], one: bool) -> Cards:
        """Cards about rows in one header: temperature scale, beam, halves, origin of the noise, and
        in which convention Q and U of the file are. ``one``: the header is that of one row.
        """
        cards: Cards = []
        if any(plane.scale > 0 for _, _, plane, _ in rows):
            if scale := scale_of(self.product.unit)[1]:
                cards.append(("TEMPSCAL", scale, f"temperature scale: {_SCALES[scale]}"))
            cards += self.beam
        if any(plane.of_halves for _, _, plane, _ in rows):
            halves = ascii_text(self.product.difference)
            cards.append(("JACKKNIF", halves, "halves that were subtracted"))
        noisy = (plane.noise_of.get(name) for name, _, plane, _ in rows)
        for key in filter(self.noise.__contains__, noisy):
            factor, words = self.noise[str(key)]
            if factor is not None:
                stated = "NOISEFAC" if one else f"NOISFAC{key}"
                cards.append((stated, factor, "measured noise / this white noise"))
            if one or key == "I":
                cards.append(("NOISEOF", ascii_text(words), "what the noise was measured in"))
        if any(name in "qu" for name, *_ in self.rows):
            cards.append(("POLCCONV", CONVENTION, "Q, U: angles from south to east"))
        return cards

    def first(self, about: Provenance) -> Header:
        """Cards of the first header: the name, its origin and its band."""
        cards = [("PRODUCT", ascii_text(self.name), "product of the pipeline"), *about.cards]
        if (band := self.product.band) is not None:
            cards.append(("RESTFRQ", float(f"{band.centre:.12g}"), "[Hz] centre of the band"))
            cards.append(("BAND", ascii_text(band.name), "name of the band"))
        if taken := self.product.taken_off:
            cards.append(("TAKENOFF", taken, "of I, which the data hardly determine"))
        if any(chi2 := self.product.chi2):
            cards.append(("CHI2", chi2[0], "of samples minus map, per degree of freedom"))
            cards.append(("CHI2ERR", chi2[1], "standard error, if noise is as modelled"))
            model = NOISE_MODELS[self.product.noise_from]
            cards.append(("NOISEMOD", model, "origin of the noise model"))
        if (index := self.product.spectral_index) is not None:
            cards.append(("SPECINDX", index, "of the flux density, for the unit: at RESTFRQ"))
        return header_of(cards, about.history)

    def write(self, path: Path, about: Provenance) -> Path:
        """Write it atomically; its path. Raises `OutputError` where it cannot be written."""
        with atomic_path(path) as temporary:
            if self.product.header is None:
                self._write_table(temporary, about)
            with open(temporary, "ab") as file:
                if self.product.header is not None:
                    self._write_images(file, about)
                file.write(b"".join(self._scan_tables()) + about.tables)
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
            yield _table("SCANS", {"NAME": _texts(found.scans)})

    def _write_images(self, file: IO[bytes], about: Provenance) -> None:
        world = exact_header(self.product.wcs)
        unit, _ = scale_of(self.product.unit)
        for k, row in enumerate(self.rows):
            name, meaning, plane, values = row
            cards: Cards = [("EXTNAME", name.upper(), "extension name")]
            if own := plane.fits_unit(unit):
                cards.append(("BUNIT", own, meaning))
            header = joined(world, header_of(cards + self.about([row], one=True)))
            if k == 0:
                header = joined(header, self.first(about), self.cards)
            write_image(file, header, values, _type(values))

    def _write_table(self, path: Path, about: Provenance) -> None:
        """A partial map, pixel numbers explicit; the cards are those of Gorski et al. (2005) that
        healpy reads.
        """
        product, (unit, _) = self.product, scale_of(self.product.unit)
        columns = [fits.Column("PIXEL", "K", array=product.pixels)]
        for name, _, plane, row in self.rows:
            values: NDArray[Any] = np.asarray(row, _type(row))
            code = {"f8": "D", "i8": "K", "i4": "J"}[values.dtype.str[1:]]
            own = plane.fits_unit(unit) or None
            columns.append(fits.Column(name.upper(), code, unit=own, array=values))
        table = fits.BinTableHDU.from_columns(columns, name="MAP")
        cards: Cards = [
            ("PIXTYPE", "HEALPIX", "HEALPix pixelization"),
            ("ORDERING", "NESTED" if product.nest else "RING", "pixel ordering"),
            ("COORDSYS", _COORDSYS[product.frame], f"{product.frame}"),
            ("NSIDE", product.nside, "resolution"),
            ("INDXSCHM", "EXPLICIT", "pixel numbers are in the column PIXEL"),
            *self.about(self.rows, one=False),
        ]
        part = header_of([("OBJECT", "PARTIAL", "not all of the sky")])
        primary = fits.PrimaryHDU()
        primary.header.extend(self.first(about))
        table.header.extend(joined(header_of(cards), self.first(about), self.cards, part))
        fits.HDUList([primary, table]).writeto(path, output_verify="exception")


def write_map(product: MapArrays, path: str | Path, overwrite: bool) -> Path:
    """`MapProduct.write`."""
    path = Path(path).expanduser()
    if path.exists() and not overwrite:
        raise OutputError(
            "exists already",
            place=str(path),
            cure="choose another name, or write overwrite=True",
        )
    about: Provenance = product.origin or Provenance.of_a_map(product)
    noise: dict[str, tuple[float | None, str]] = {}
    for key, plane in product.by_stokes().items():
        half = plane.half_difference
        if about.quiet:
            noise[key] = None, ELSEWHERE
        elif np.isfinite(plane.noise).any():
            noise[key] = stated(
                plane.noise,
                None if half is None else (half, f"half the difference, {plane.difference}"),
            )
    return MapFile.of(about.product, product, noise).write(path, about)


def _type(values: NDArray[Any]) -> np.dtype[Any]:
    """Type of numbers as they are written: counts as integers, everything else as float64."""
    if values.dtype.kind in "iu":
        return np.dtype(np.int64 if np.max(values, initial=0) > 2**31 - 1 else np.int32)
    return np.dtype(np.float64)


def ascii_text(text: str) -> str:
    """FITS holds printable ASCII only: anything else becomes a Python escape (``\\xe9``)."""
    if text.isascii() and text.isprintable():
        return text
    return "".join(c if " " <= c <= "~" else c.encode("unicode_escape").decode() for c in text)


def _texts(column: Sequence[Any]) -> NDArray[np.bytes_]:
    return np.array([ascii_text(str(text)) for text in column] or [""], "S")[: len(column)]


def _table(name: str, columns: Mapping[str, NDArray[Any]]) -> bytes:
    """Columns of texts (``S``), int32 or int64 as a binary table."""
    kinds = [(title, values.dtype) for title, values in columns.items()]
    rows = np.rec.fromarrays(list(columns.values()), dtype=kinds)
    return table_bytes(fits.BinTableHDU(rows, name=name))


def listed(every: Iterable[str]) -> tuple[str, list[str]]:
    """Text of a card for some names, and those that stand in the history if it is too long."""
    names = sorted({ascii_text(name) for name in every})
    text = ", ".join(names)
    if len(text) <= LONGEST:
        return text, []
    return f"{len(names)} of them, see HISTORY", names
