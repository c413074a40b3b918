"""Maps that are compared: from FITS files of any origin and from products; and their comparison as
a FITS file and tables.

I, Q and U are compared each for itself, Q and U of both from the meridians of one frame.
Where the frames differ, Q and U of the reference are turned on its own pixels, before anything is
smoothed or interpolated:

    Q' + i U' = (Q + i U) exp(-2 i delta),   (1)

delta the angle from the meridian of its own frame to that of the map's
(`core.polarization.between_meridians`).
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.maps.beams import check_width
from zonda.core.maps.grid import HealpixPixels
from zonda.core.maps.header import FileHeader
from zonda.core.maps.image import Image
from zonda.core.maps.map_file import ascii_text
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.map_reading import (
    STOKES,
    HealpixTable,
    celestial,
    chosen,
    is_healpix,
    polarized_letter,
    q_and_u,
)
from zonda.core.maps.noise_figures import FREE
from zonda.core.maps.planes import ELSEWHERE, IQU
from zonda.core.maps.units import KNOWN_UNITS, parse_unit, scale_of
from zonda.core.numerics.radiation import cmb_slope, intensity_to_kelvin, thermal_sz
from zonda.core.numerics.sphere import ARCSEC, FWHM_PER_SIGMA, beam_area
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.storage.files import atomic_path
from zonda.core.storage.fits_files import check_size, header_of, joined, opened, write_image
from zonda.core.storage.table_files import Column, write_ecsv
from zonda.core.types import Floats

from .planes import EMPTY, NOT_EMPTY, Plane
from .statistics import Comparison

NORTH = np.array([0.0, 0.0, 1.0])
SAME = 1e-12
"""1 - cos of the angle between poles that count as one."""


def products_of(
    product: MapProduct | Image,
    name: str,
) -> dict[str, tuple[str, MapProduct | Image]]:
    """(name, product) of I, and of Q and U where there are some: ``name``, ``name_Q``,
    ``name_U``.
    """
    if product.polarization is None:
        return {"I": (name, product)}
    return {
        plane: (name if plane == "I" else f"{name}_{plane}", product.stokes(plane)) for plane in IQU
    }


def planes_of(product: MapProduct | Image, name: str) -> dict[str, Plane]:
    """The planes of a product of a run, with their noise."""
    return {
        plane: plane_of(one, its_name)
        for plane, (its_name, one) in products_of(product, name).items()
    }


def on_meridians_of(other: Plane, planes: Mapping[str, Plane]) -> dict[str, Plane]:
    """The planes with Q and U from the meridians of another map's frame, equation (1); as they are
    where it is their own.

    The covariance of Q and U counts as 0 in their noise.
    """
    if "Q" not in planes:
        return dict(planes)
    q = planes["Q"]
    u = planes["U"]
    pole = q.grid.turn @ other.grid.turn[2]
    if 1 - float(pole @ NORTH) < SAME:
        return dict(planes)
    turn = between_meridians(q.grid.directions(), NORTH, pole)
    values, alone = (_turned(turn, a, b) for a, b in ((q.values, u.values), (q.alone, u.alone)))
    noise: list[Floats | None] = [None, None]
    if q.noise is not None and u.noise is not None:
        noise = [
            np.hypot(turn.real * a, turn.imag * b)
            for a, b in ((q.noise, u.noise), (u.noise, q.noise))
        ]
    q = replace(q, values=values[0], noise=noise[0], alone=alone[0])
    u = replace(u, values=values[1], noise=noise[1], alone=alone[1])
    return {**planes, "Q": q, "U": u}


def _turned(turn: Any, q: Floats | None, u: Floats | None) -> Any:
    return (None, None) if q is None or u is None else turned_by(np.stack([q, u]), turn)


SAME_BAND = 1e-3
"""Relative difference of frequencies of one band."""
NOISES = {
    "NOISE": "noise I",
    "COV_II": "noise I",
    "COV_QQ": "noise Q",
    "COV_UU": "noise U",
    "HALF_DIFFERENCE": "half I",
    "HALF_DIFFERENCE_Q": "half Q",
    "HALF_DIFFERENCE_U": "half U",
}
"""Of a file's extensions and columns: standard errors, or variances; and noise alone."""


@dataclass(frozen=True)
class ReadMap:
    """The planes of a FITS file, and what its header states of them.

    Attributes
    ----------
    planes
        I, and Q and U where they are there, by these letters.
    frequency
        RESTFRQ, Hz; None: not stated.
    band
        BAND, its name; empty: not stated.
    notes
        What was chosen, and why Q and U that are in the file are not taken: ``what: text``.
    own
        Whether zonda wrote it.
    measured_in
        By plane, what its header says that its noise was measured in (NOISEOF).
    """

    planes: dict[str, Plane]
    frequency: float | None
    band: str
    notes: list[str]
    own: bool = False
    measured_in: dict[str, str] = field(default_factory=dict)

    def is_of_the_band_of(self, other: ReadMap) -> bool:
        """False where the frequencies that both state differ, or the names where one of them states
        no frequency.
        """
        if self.frequency and other.frequency:
            return math.isclose(self.frequency, other.frequency, rel_tol=SAME_BAND)
        return not (self.band and other.band) or self.band == other.band

    @property
    def band_in_words(self) -> str:
        """Name and frequency, as far as they are stated."""
        hertz = f"{self.frequency / 1e9:.4g} GHz" if self.frequency else ""
        return f"{self.band} {hertz}".strip()


@dataclass(frozen=True)
class Wanted:
    """Choice of a map of a file.

    Attributes
    ----------
    hdu
        Extension by name or number; None: the first image or HEALPix table.
    plane
        Of a cube, counted from 1, in FITS's order of the axes behind the first two; None: it has to
        be the only one, or I of Stokes parameters.
    coordsys
        Of a HEALPix table: C, G or E; None: that of its header.
    column
        Of a HEALPix table, by name or counted from 1: the column of I; None: that of a known name.
    shared
        Plane, system and column are those of another file, too: where they do not apply to this
        one, they are left out.
    """

    hdu: int | str | None = None
    plane: tuple[int, ...] | None = None
    coordsys: str | None = None
    column: int | str | None = None
    shared: bool = False


def read_planes(path: Path, name: str = "", wanted: Wanted | None = None) -> ReadMap:
    """An image or HEALPix table of a FITS file with its noise (extension or column NOISE, or
    COV_II); Q and U beside it.

    Q and U are further planes along an axis STOKES, extensions or columns with their names. They
    are taken as COSMO or IAU by POLCCONV; of a HEALPix table without it as COSMO, of an image
    without it not at all. Axes of length one are dropped. A file without BUNIT has no unit (an
    empty text), one without BMAJ no known beam.

    What holds noise alone is taken from the map of all but the sky that a run wrote beside it
    (``source_free_NAME.fits``), else from HALF_DIFFERENCE; where neither is there, the factor on
    the noise that the header states (NOISEFAC).

    Raises
    ------
    InputError
        Unreadable; no image of the sky in it; a cube of which no plane is wanted; an unknown unit
        or frame; a HEALPix table without NSIDE, ORDERING or COORDSYS, or of which no column is I;
        cards that are no numbers; a beam far wider than the image.
    """
    read = _read(path, name, wanted or Wanted())
    beside = path.with_name(f"source_free_{path.name}")
    if not (read.own and FREE in read.measured_in.values() and beside.is_file()):
        return read
    free = _read(beside, name, wanted or Wanted())
    for key, plane in read.planes.items():
        other = free.planes.get(key)
        if other is None or plane.noise is None or read.measured_in.get(key) != FREE:
            continue
        if free.own and other.unit == plane.unit and _on_one_grid(other, plane):
            noise = plane.noise / (plane.factor or 1.0)
            alone: Any = {"alone": other.values, "alone_of": FREE, "factor": None}
            read.planes[key] = replace(plane, noise=noise, **alone)
    return read


def _on_one_grid(a: Plane, b: Plane) -> bool:
    if a.values.shape != b.values.shape:
        return False
    if a.pixels is None or b.pixels is None:
        return a.pixels is b.pixels and dict(a.header) == dict(b.header)
    one = a.pixels
    two = b.pixels
    alike = (one.nside, one.nest, one.frame) == (two.nside, two.nest, two.frame)
    return alike and np.array_equal(one.pixels, two.pixels)


def _read(path: Path, name: str, wanted: Wanted) -> ReadMap:
    place = str(path)
    name = name or path.name
    with opened(path, place, "check the file, e.g. with fitsverify, or copy it again") as hdus:
        hdu, _ = chosen(hdus, wanted.hdu, place)
        check_size(hdu, place)
        healpix = is_healpix(hdu)
        if not wanted.shared:
            if healpix and wanted.plane is not None:
                what = "plane is for images, and this is a HEALPix table"
                cure = "remove it"
                raise InputError(what, place=place, cure=cure)
            if not healpix and wanted.coordsys is not None:
                what = "coordsys is for HEALPix maps"
                cure = "remove it: CTYPE says what an image's are"
                raise InputError(what, place=place, cure=cure)
            if not healpix and wanted.column is not None:
                what = "column is for HEALPix maps"
                raise InputError(what, place=place, cure="remove it, or choose plane or hdu")
        found = _healpix(hdu, wanted, place) if healpix else _images(hdus, hdu, wanted, place)
        return found.read(name, FileHeader(hdu.header, place))


@dataclass(frozen=True)
class Found:
    """Planes of a file as they are: ``where`` they are (celestial header, or HEALPix pixels), their
    ``unit``, and factors on the noise that headers state, by plane."""

    where: Any
    values: dict[str, Floats]
    unit: Any
    stated: dict[str, tuple[float, str]]
    notes: list[str] = field(default_factory=list)
    halves: str = "of two halves"

    def read(self, name: str, about: FileHeader) -> ReadMap:
        """The planes with what the header ``about`` says of them."""
        image = not isinstance(self.where, HealpixPixels)
        unit = ""
        factor = 1.0
        if written := str(self.unit or "").strip():
            scale = about.text("TEMPSCAL") or None
            try:
                unit, factor = parse_unit(written, place=about.place, temperature_scale=scale)
            except InputError as error:
                key = "BUNIT" if image else "TUNIT of the column"
                cure = f"set {key} to {KNOWN_UNITS}; of kelvin, TEMPSCAL to K_RJ or K_CMB, too"
                raise about.error(error.message, cure) from None
        major = about.number("BMAJ") or 0.0
        minor = about.number("BMIN") or major
        fwhm = math.radians(math.sqrt(major * minor)) if min(major, minor) > 0 else None
        hertz = about.number("RESTFRQ") or about.number("RESTFREQ") or 0.0
        convention = (about.text("POLCCONV") or ("" if image else "COSMO")).upper()
        letters = [key for key in IQU if key in self.values]
        notes = list(self.notes)
        if "Q" in letters and convention not in ("COSMO", "IAU"):
            unknown = f"{name} has them and no POLCCONV; set that header key to COSMO or IAU"
            notes.append(f"Q and U: not compared: {unknown}")
            letters = ["I"]
        planes = {}
        for key in letters:
            sign = -1.0 if key == "U" and convention == "IAU" else 1.0
            noise = self.values.get(f"noise {key}")
            alone = self.values.get(f"half {key}")
            own, words = self.stated.get(key, (None, ""))
            if quiet := words == ELSEWHERE:
                own = None
                words = ""
            if alone is not None:
                own = None
                words = f"half the difference, {self.halves}"
            elif own is not None and noise is not None:
                noise = noise * own
            planes[key] = Plane(
                name if key == "I" else f"{name} {key}",
                sign * self.values[key],
                self.where if image else None,
                fwhm=fwhm,
                noise=noise,
                pixels=None if image else self.where,
                alone=alone,
                alone_of=words,
                factor=own,
                quiet=quiet,
            ).scaled(factor, unit)
        if fwhm and image:
            shape = planes["I"].values.shape
            sides = planes["I"].grid.sides
            cure = "BMAJ and BMIN are degrees (of 18 arcsec 0.005); correct them"
            check_width(
                fwhm,
                max(n * side for n, side in zip(shape, sides, strict=True)),
                about.place,
                cure,
            )
        return ReadMap(
            planes,
            hertz if hertz > 0 else None,
            about.text("BAND"),
            notes,
            about.text("ORIGIN").lower() == "zonda",
            {key: words for key, (_, words) in self.stated.items()},
        )


def _images(hdus: Any, hdu: Any, wanted: Wanted, place: str) -> Found:
    """A plane or a cube of Stokes parameters, or extensions: with their noise and what holds noise
    alone.
    """
    shape = hdu.shape
    cube, wcs, frame = celestial(hdu, place)
    index, told = cube.plane(wanted.plane if cube.asked or not wanted.shared else None)
    polarized = cube.q_and_u(index)
    planes = {"I": index, **dict(zip("QU", polarized, strict=False))}
    found = {key: np.asarray(hdu.data[at], np.float64) for key, at in planes.items()}
    stated: dict[str, tuple[float, str]] = {}
    halves = "of two halves"
    alike = []
    if wanted.hdu is None and STOKES not in told and not polarized:  # extensions beside are of it
        alike = [other for other in hdus if other.is_image and other.shape == shape]
    letters = q_and_u([str(other.name) for other in alike])
    noises: Any = {k: NOISES.get(str(other.name).upper()) for k, other in enumerate(alike)}
    for k, key in (noises | dict(zip(letters, "QU", strict=False))).items():
        if key is not None:
            values = np.asarray(alike[k].data[index], np.float64).reshape(shape[-2:])
            found[key] = _root(values) if alike[k].name.upper().startswith("COV") else values
        if noises[k] is not None:
            about = FileHeader(alike[k].header, place)
            stated |= _stated(about, noises[k])
            halves = about.text("JACKKNIF") or halves
    both = found.keys() >= {"Q", "U"}
    kept = {k: v for k, v in found.items() if both or k[-1] == "I"}
    told["frame"] = frame
    notes = [f"{what}: {told[what]}" for what in ("plane", "frame") if told.get(what)]
    where = wcs.to_header(relax=True)
    return Found(where, kept, hdu.header.get("BUNIT"), stated, notes, halves)


def _root(variance: Floats) -> Floats:
    """Standard errors; NaN where a variance is negative."""
    return np.sqrt(np.where(variance >= 0, variance, np.nan))


def _stated(header: FileHeader, of: str) -> dict[str, tuple[float, str]]:
    """The factor on white noise that the header of a plane of noise states, and what it was
    measured in.
    """
    if not of.startswith("noise"):
        return {}
    words = header.text("NOISEOF")
    factor = 1.0 if words == ELSEWHERE else header.number("NOISEFAC") or 0.0
    return {of[-1]: (factor, words or "its file")} if factor > 0 else {}


def _healpix(hdu: Any, wanted: Wanted, place: str) -> Found:
    """Pixels of a HEALPix table with a value, with their noise and what holds noise alone."""
    table = HealpixTable(hdu, place)
    header = hdu.header
    given = (table.text("COORDSYS") or wanted.coordsys) if wanted.shared else wanted.coordsys
    frame, _ = table.frame(given or None)
    names = [name.upper() for name in table.names]
    first = table.intensity(wanted.column)
    others = [] if polarized_letter(table.names[first]) else q_and_u(names)
    columns = dict(zip("IQU", (first, *others), strict=False))
    columns |= {
        key: names.index(name)
        for name, key in NOISES.items()
        if name in names and key[-1] in columns
    }
    planes, pixels, nside = table.read(columns)
    seen = np.isfinite(planes["I"])
    if not seen.any():
        raise InputError(EMPTY, place=place, cure=NOT_EMPTY)
    pixels = np.flatnonzero(seen) if pixels is None else pixels[seen]
    where = HealpixPixels(nside, table.nest, pixels, frame)
    stated: dict[str, tuple[float, str]] = {}
    for key in IQU if "Q" in columns else "I":
        cards = {"NOISEFAC": header.get(f"NOISFAC{key}"), "NOISEOF": header.get("NOISEOF")}
        stated |= _stated(FileHeader(cards, place), f"noise {key}")
    values_of = {
        key: (_root(v) if names[columns[key]].startswith("COV") else v)[seen]
        for key, v in planes.items()
    }
    unit = header.get(f"TUNIT{1 + columns['I']}")
    halves = table.text("JACKKNIF")
    return Found(where, values_of, unit, stated, halves=halves or "of two halves")


def plane_of(
    product: MapProduct | Image,
    name: str,
    alone: tuple[Floats, str] | None = None,
) -> Plane:
    """A map of a run as the plane to be compared, with its noise. The input image has no beam, but
    where its pixels were spread (BMAJ).

    ``alone``: a map of the noise alone, and what it is in words.
    Where the noise is not known and there is a map of it, it has the shape of 1 / sqrt(samples).
    """
    if isinstance(product, Image):
        return Plane(
            name,
            np.asarray(product.values, np.float64),
            product.header,
            product.unit,
            product.fwhm,
        )
    noise: Floats | None = product.noise
    if not np.isfinite(product.noise).any():
        with np.errstate(divide="ignore"):
            shape = np.where(product.known, 1 / np.sqrt(product.hits), np.nan)
        noise = None if alone is None else shape
    pixels = None
    if product.pixels is not None:
        pixels = HealpixPixels(product.nside, product.nest, product.pixels, product.frame)
    return Plane(
        name,
        np.where(product.known, product.signal, np.nan),
        product.header,
        product.unit,
        product.resolution or None,
        noise,
        pixels,
        product.smoothed_by / FWHM_PER_SIGMA,
        *(alone or ()),
    )


def in_unit(plane: Plane, unit: str, frequency: float | None, beam: float = 0.0) -> Plane:
    """The plane in ``unit``, a name of `parse_unit` with a prefix (``mK_RJ``), at one frequency
    [Hz].

    Jy/beam are converted by the beam of the plane; what becomes Jy/beam is that of a Gaussian of
    FWHM ``beam`` [rad], to which it will be smoothed. Raises InputError where that needs a
    frequency or a beam that are not known, or the plane has no unit; for Jy/pixel, which is no
    brightness.
    """
    try:
        wanted, factor = parse_unit(unit, place="unit")
    except InputError as error:
        cure = f"use {KNOWN_UNITS}, with a prefix where you like: mK_RJ"
        raise InputError(error.message, place="unit", cure=cure) from error
    if wanted == "Jy/pixel":
        raise InputError(
            "Jy/pixel depends on the pixel, and maps are compared as brightness",
            place="unit",
            cure="use MJy/sr; smoothed and interpolated maps have no flux of their own pixels",
        )
    if plane.unit == wanted != "Jy/beam":
        return plane.scaled(1 / factor, unit)
    if not plane.unit:
        what = f"has no unit, and {unit} is wanted"
        raise InputError(what, place=plane.name, cure="set the header key BUNIT")
    if "Jy" in plane.unit and "Jy" in wanted:
        frequency = 1.0  # their ratio depends on none
    own = _kelvin(plane, plane.unit, frequency, plane.fwhm or 0.0)
    return plane.scaled(own / _kelvin(plane, wanted, frequency, beam) / factor, unit)


def _kelvin(plane: Plane, unit: str, frequency: float | None, beam: float) -> float | Floats:
    """Rayleigh-Jeans kelvin of one ``unit``: a number, of Jy/pixel one for each pixel. ``beam``:
    FWHM of a Jy/beam.
    """
    if unit == "K_RJ":
        return 1.0
    if frequency is None:
        raise InputError(
            f"units differ ({plane.unit}), and their ratio depends on the frequency",
            place=plane.name,
            cure="give the frequency: --frequency '93 GHz', or set the header key RESTFRQ",
        )
    if unit in ("K_CMB", "y"):
        return float((cmb_slope if unit == "K_CMB" else thermal_sz)(frequency))
    jansky = float(intensity_to_kelvin(frequency)) * 1e-26
    if unit == "Jy/beam" and not beam > 0:
        cure = "set the header keys BMAJ and BMIN"
        raise InputError("is in Jy/beam, and its beam is not known", place=plane.name, cure=cure)
    area: float | Floats = {"MJy/sr": 1e-6, "Jy/beam": beam_area(beam)}.get(unit, 0.0)
    if unit == "Jy/pixel":
        area = np.broadcast_to(plane.grid.areas, plane.values.shape)
    return jansky / area


def write_comparison(found: Comparison, stem: Path, meta: Mapping[str, Any]) -> list[Path]:
    """``STEM.fits`` (an image for each plane), ``STEM_spectra.ecsv``, ``STEM_profiles.ecsv``:
    paths. Raises OutputError.
    """
    paths = [
        stem.with_name(stem.name + end) for end in (".fits", "_spectra.ecsv", "_profiles.ecsv")
    ]
    structure = ("COMMENT", "HISTORY", "SIMPLE", "EXTEND", "BITPIX")
    world = header_of((k, v) for k, v in found.header.items() if k not in structure)
    with atomic_path(paths[0]) as temporary, open(temporary, "wb") as file:
        for k, (name, values) in enumerate(found.planes.items()):
            cards: list[tuple[Any, ...]] = [("EXTNAME", name.upper(), "extension name")]
            if name in ("reference", "map", "difference"):
                cards += _unit_cards(found.unit)
            if found.fwhm:
                cards += [(key, math.degrees(found.fwhm), "[deg] FWHM") for key in ("BMAJ", "BMIN")]
            if name in found.noise:
                words, factor = found.noise[name]
                if factor is not None:
                    cards.append(("NOISEFAC", factor, "noise of the SNR / white noise"))
                cards.append(("NOISEOF", ascii_text(words), "noise of the SNR"))
            if k == 0:
                names = zip(("REFERENC", "COMPARED"), map(ascii_text, found.names), strict=True)
                cards += [*names, ("ORIGIN", "zonda", "comparison of two maps")]
            header = header_of(cards, map(ascii_text, found.notes if k == 0 else ()))
            write_image(file, joined(world, header), values, np.float64)
    about = {key: value for key, value in meta.items() if value not in ("", None)}
    about |= {"REFERENCE": found.names[0], "MAP": found.names[1]}
    about |= {key.upper(): value for key, value in found.values.items() if math.isfinite(value)}
    unit = fits_unit(found.unit)
    write_ecsv(paths[1], found.spectra.columns(unit, coherence=True), about)
    p = found.profiles
    error = "standard error from the scatter, one value per beam"
    columns = [Column("radius", p.radius / ARCSEC, "arcsec", "middle of the ring")]
    for name, mean in p.mean.items():
        columns.append(Column(name, mean, unit, "mean in the ring"))
        columns.append(Column(f"{name}_error", p.error[name], unit, error))
    write_ecsv(paths[2], columns, about)
    return paths


def fits_unit(unit: str) -> str:
    """The unit as FITS writes it where that is one word, else none: the header's text says it."""
    plain, scale = scale_of(unit)
    return plain if scale else ""


def _unit_cards(unit: str) -> list[tuple[str, str, str]]:
    plain, scale = scale_of(unit)
    cards = [("BUNIT", plain, "brightness"), ("TEMPSCAL", scale, "temperature scale")]
    return [card for card in cards if card[1]]
