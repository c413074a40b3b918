"""Maps that are compared: from FITS files of any origin and from products; and their comparison as a FITS file and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.maps.grid import HealpixPixels, healpix_grid
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.noise_figures import FREE
from zonda.core.maps.stokes import IQU
from zonda.core.maps.stokes_names import along_axis, columns_of_q_and_u
from zonda.core.maps.units import KNOWN_UNITS, parse_unit
from zonda.core.numerics.angles import ARCSEC, FWHM_PER_SIGMA
from zonda.core.numerics.radiation import cmb_slope, intensity_to_kelvin, thermal_sz
from zonda.core.storage.ecsv import Column, write_ecsv
from zonda.core.storage.files import atomic_path
from zonda.core.storage.fits_files import check_size, opened
from zonda.core.storage.fits_image import Cards, image_pieces
from zonda.core.types import Floats

from .planes import Plane
from .statistics import Comparison

SAME_BAND = 1e-3
"""Relative difference of frequencies of one band."""
FRAMES = {"C": "icrs", "Q": "icrs", "ICRS": "icrs", "G": "galactic"}
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
FLUXES = ("Jy/pixel", "Jy/beam", "MJy/sr")
CURE = "give a FITS file with a two-dimensional image that has a celestial WCS, or with a HEALPix table"


@dataclass(frozen=True)
class ReadMap:
    """What a FITS file holds.

    Attributes
    ----------
    planes
        I, and Q and U where they are there, by these letters.
    frequency
        RESTFRQ, Hz; None: not stated.
    band
        BAND, its name; empty: not stated.
    notes
        Why Q and U that are in the file are not taken.
    own
        Whether zonda wrote it.
    """

    planes: dict[str, Plane]
    frequency: float | None
    band: str
    notes: list[str]
    own: bool = False

    def is_of_the_band_of(self, other: ReadMap) -> bool:
        """False where the frequencies that both state differ, or the names where one of them states no frequency."""
        if self.frequency and other.frequency:
            return math.isclose(self.frequency, other.frequency, rel_tol=SAME_BAND)
        return not (self.band and other.band) or self.band == other.band

    @property
    def band_in_words(self) -> str:
        """Name and frequency, as far as they are stated."""
        return " ".join([*([self.band] if self.band else []), *([f"{self.frequency / 1e9:.4g} GHz"] if self.frequency else [])])


def read_planes(path: Path, name: str = "") -> ReadMap:
    """The first image or HEALPix table of a FITS file with its noise (extension or column NOISE, or COV_II); Q and U beside it.

    Q and U are further planes along an axis STOKES, extensions or columns with their names. They are taken as COSMO or IAU by
    POLCCONV; of a HEALPix table without it as COSMO, of an image without it not at all. Axes of length one are dropped. A file
    without BUNIT has no unit (an empty text), one without BMAJ no known beam.

    What holds noise alone is taken from the map of all but the sky that a run wrote beside it (``source_free_NAME.fits``), else
    from HALF_DIFFERENCE; where neither is there, the factor on the noise that the header states (NOISEFAC).

    Raises
    ------
    InputError
        Unreadable; no image of the sky in it; a cube of something else; an unknown unit; a HEALPix table without NSIDE, ORDERING
        or COORDSYS.
    """
    read = _read(path, name)
    beside = path.with_name(f"source_free_{path.name}")
    if not (read.own and any(plane.noise is not None for plane in read.planes.values()) and beside.is_file()):
        return read
    free = _read(beside, name)
    made = {}
    for key, plane in read.planes.items():
        found = free.planes.get(key)
        alike = found is not None and free.own and found.unit == plane.unit and _on_one_grid(found, plane)
        made[key] = replace(plane, alone=found.values, alone_of=FREE, factor=None) if alike and found is not None else plane
    return replace(read, planes=made)


def _on_one_grid(a: Plane, b: Plane) -> bool:
    if a.values.shape != b.values.shape or (a.pixels is None) != (b.pixels is None):
        return False
    if a.pixels is None or b.pixels is None:
        return dict(a.header) == dict(b.header)
    one, two = a.pixels, b.pixels
    alike = (one.nside, one.nest, one.frame) == (two.nside, two.nest, two.frame)
    return alike and np.array_equal(one.pixels, two.pixels)


def _read(path: Path, name: str) -> ReadMap:
    place = str(path)
    with opened(path, place, "check the file, e.g. with fitsverify, or copy it again") as hdus:
        for hdu in hdus:
            image = hdu.is_image and hdu.header.get("NAXIS", 0) >= 2
            if image or ("NSIDE" in hdu.header and "ORDERING" in hdu.header):
                check_size(path, hdu, place)
                where, values, unit, stated = _images(hdus, hdu, place) if image else _healpix(hdu, place)
                return _told(name or path.name, where, values, (hdu.header, unit, stated), bool(image), place)
    raise InputError("is not a map: it holds no image of two axes and no HEALPix table", place=place, cure=CURE)


def _told(
    name: str,
    where: Any,
    values: dict[str, Floats],
    told: tuple[Any, Any, dict[str, tuple[float, str]]],
    image: bool,
    place: str,
) -> ReadMap:
    """``where``: celestial header or HEALPix pixels; ``told``: header of the file, unit, factors on the noise by plane."""
    about, unit, stated = told
    text = str(unit or "").strip()
    label, factor = parse_unit(text, place=place, temperature_scale=about.get("TEMPSCAL")) if text else ("", 1.0)
    axes = [about.get("BMAJ"), about.get("BMIN", about.get("BMAJ"))]
    good = all(isinstance(b, int | float) and math.isfinite(b) and b > 0 for b in axes)
    fwhm = math.radians(math.sqrt(axes[0] * axes[1])) if good else None
    frequency = about.get("RESTFRQ", about.get("RESTFREQ"))
    hertz = float(frequency) if isinstance(frequency, int | float) and frequency > 0 else None
    convention, notes = str(about.get("POLCCONV", "" if image else "COSMO")).strip().upper(), []
    if "Q" in values and convention not in ("COSMO", "IAU"):
        notes.append(f"not compared: {name} has them and no POLCCONV; set that header key to COSMO or IAU")
        values = {key: plane for key, plane in values.items() if key not in ("Q", "U")}
    planes: dict[str, Plane] = {}
    for key in IQU:
        if key in values:
            sign = -1.0 if key == "U" and convention == "IAU" else 1.0
            noise, alone = values.get(f"noise {key}"), values.get(f"half {key}")
            own, words = stated.get(key, (None, ""))
            if alone is not None:
                own, words = None, f"half the difference, {about.get('JACKKNIF', 'of two halves')}"
            elif own is not None and noise is not None:
                noise = noise * own
            plane = Plane(
                name if key == "I" else f"{name} {key}", sign * values[key], where if image else None, "", fwhm, noise,
                None if image else where, 0.0, alone, words, own,
            )  # fmt: skip
            planes[key] = plane.scaled(factor, label)
    origin = str(about.get("ORIGIN", "")).strip().lower() == "zonda"
    return ReadMap(planes, hertz, str(about.get("BAND", "")).strip(), notes, origin)


def _images(hdus: Any, hdu: Any, place: str) -> tuple[Any, dict[str, Floats], Any, dict[str, tuple[float, str]]]:
    """Header of the celestial axes; planes, their noise and what holds noise alone; unit; factors on the
    noise: of a plane or a cube of Stokes parameters, or of extensions."""
    from astropy.wcs import WCS

    header, values = hdu.header, np.asarray(hdu.data, np.float64)
    ny, nx = values.shape[-2:]
    long = [k for k, n in enumerate(values.shape[:-2]) if n > 1]
    axis = values.ndim - long[0] if long else 0
    if long and (len(long) > 1 or str(header.get(f"CTYPE{axis}", "")).strip().upper() != "STOKES"):
        sides = " x ".join(str(n) for n in reversed(values.shape))
        raise InputError(f"is a cube of {sides} pixels, not a map", place=place, cure="cut one plane out of it")
    wcs = WCS(header)
    if not wcs.has_celestial:
        kinds = ", ".join(str(header.get(f"CTYPE{k}", "none")) for k in (1, 2))
        raise InputError(f"is not a map: it has no celestial coordinates (CTYPE: {kinds})", place=place, cure=CURE)
    names = along_axis(header, axis, values.shape[long[0]]) if long else ["I"]
    found = {key: plane for key, plane in zip(names, values.reshape(-1, ny, nx), strict=True) if key in ("I", "Q", "U")}
    if "I" not in found:
        raise InputError(f"its axis STOKES has {', '.join(names)} and no I", place=place, cure="give a map of I, Q and U")
    alike = [other for other in hdus if other.is_image and other.shape == hdu.shape]
    letters = columns_of_q_and_u([str(other.name) for other in alike])
    for key, number in zip(("Q", "U"), letters or (), strict=False):
        found.setdefault(key, np.asarray(alike[number].data, np.float64).reshape(ny, nx))
    stated: dict[str, tuple[float, str]] = {}
    for other in alike if not long else ():
        if (of := NOISES.get(str(other.name).upper())) is not None:
            noise = np.asarray(other.data, np.float64).reshape(ny, nx)
            found[of] = np.sqrt(noise) if other.name.upper().startswith("COV") else noise
            stated |= _stated(other.header, of)
    both = found.keys() >= {"Q", "U"}
    kept = {k: v for k, v in found.items() if both or k[-1] == "I"}
    return wcs.celestial.to_header(relax=True), kept, header.get("BUNIT"), stated


def _stated(header: Any, of: str) -> dict[str, tuple[float, str]]:
    """The factor on white noise that the header of a plane of noise states (`core.maps.map_file`), and what
    it was measured in."""
    factor = header.get("NOISEFAC")
    good = of.startswith("noise") and isinstance(factor, int | float) and math.isfinite(factor) and factor > 0
    return {of[-1]: (float(factor), str(header.get("NOISEOF", "its file")))} if good else {}


def _healpix(hdu: Any, place: str) -> tuple[HealpixPixels, dict[str, Floats], Any, dict[str, tuple[float, str]]]:
    """Pixels of a HEALPix table with a value; planes, perhaps their noise and what holds noise alone; unit;
    factors on the noise."""
    import healpy

    header, names = hdu.header, [str(n).upper() for n in hdu.columns.names]
    frame, nest = FRAMES.get(str(header.get("COORDSYS", "")).strip().upper()), str(header["ORDERING"]).upper().startswith("NEST")
    if frame is None:
        cure = "set the header key COORDSYS to C (ICRS) or G (galactic)"
        raise InputError("the coordinate system of the HEALPix map is missing or unknown", place=place, cure=cure)
    explicit = names[0] in ("PIXEL", "PIXELS", "PIX", "INDEX")
    columns = {"I": int(explicit), **dict(zip(("Q", "U"), columns_of_q_and_u(names) or (), strict=False))}
    columns |= {key: names.index(name) for name, key in NOISES.items() if name in names and key[-1] in columns}
    planes = {key: np.asarray(hdu.data.field(k), np.float64).ravel() for key, k in columns.items()}
    planes = {key: np.sqrt(plane) if names[columns[key]].startswith("COV") else plane for key, plane in planes.items()}
    pixels = np.asarray(hdu.data.field(0), np.int64).ravel() if explicit else np.arange(planes["I"].size)
    seen = np.isfinite(planes["I"]) & ~healpy.mask_bad(planes["I"])
    if not seen.any():
        raise InputError("no pixel has a value", place=place, cure="give a map that is not NaN everywhere")
    order = np.flatnonzero(seen)[np.argsort(pixels[seen])]
    where = healpix_grid(int(header["NSIDE"]), nest, pixels[order], frame)
    kept = {key: np.where(healpy.mask_bad(values[order]), np.nan, values[order]) for key, values in planes.items()}
    return where, kept, header.get(f"TUNIT{1 + int(explicit)}"), {}


def plane_of(product: MapProduct | Image, name: str, alone: tuple[Floats, str] | None = None) -> Plane:
    """A product of a run, with its noise. The input image has a resolution of 0: no beam.

    ``alone``: a map of the noise alone, and what it is in words.
    Where the noise is not known and there is a map of it, it has the shape of 1 / sqrt(samples).
    """
    if isinstance(product, Image):
        return Plane(name, np.asarray(product.values, np.float64), product.header, product.unit, 0.0)
    noise: Floats | None = product.noise
    if not np.isfinite(product.noise).any():
        with np.errstate(divide="ignore"):
            noise = None if alone is None else np.where(product.known, 1 / np.sqrt(product.hits), np.nan)
    pixels = None
    if product.pixels is not None:
        pixels = healpix_grid(product.nside, product.nest, product.pixels, product.frame)
    return Plane(
        name, np.where(product.known, product.signal, np.nan), product.header, product.unit, product.resolution or None, noise,
        pixels, product.smoothed_by / FWHM_PER_SIGMA, *(alone or ()),
    )  # fmt: skip


def in_unit(plane: Plane, unit: str, frequency: float | None, beam: float = 0.0) -> Plane:
    """The plane in ``unit``, a name of `parse_unit` with a prefix (``mK_RJ``), at one frequency [Hz].

    Jy/beam are converted by the beam of the plane; what becomes Jy/beam is that of a Gaussian of FWHM ``beam`` [rad], to which
    it will be smoothed. Raises InputError where that needs a frequency or a beam that are not known, or the plane has no unit;
    for Jy/pixel, which is no brightness.
    """
    try:
        wanted, factor = parse_unit(unit, place="unit")
    except InputError as error:
        raise InputError(error.message, place="unit", cure=f"use {KNOWN_UNITS}, with a prefix where you like: mK_RJ") from error
    if wanted == "Jy/pixel":
        cure = "use MJy/sr; smoothed and interpolated maps have no flux of their own pixels"
        raise InputError("Jy/pixel depends on the pixel, and maps are compared as brightness", place="unit", cure=cure)
    if plane.unit == wanted != "Jy/beam":
        return plane.scaled(1 / factor, unit)
    if not plane.unit:
        raise InputError(f"has no unit, and {unit} is wanted", place=plane.name, cure="set the header key BUNIT")
    known = plane.unit in FLUXES and wanted in FLUXES  # their ratio depends on no frequency
    per = 1.0 if known else frequency
    ratio = _kelvin(plane, plane.unit, per, plane.fwhm or 0.0) / _kelvin(plane, wanted, per, beam)
    return plane.scaled(ratio / factor, unit)


def _kelvin(plane: Plane, unit: str, frequency: float | None, beam: float) -> float | Floats:
    """Rayleigh-Jeans kelvin of one ``unit``: a number, of Jy/pixel one for each pixel. ``beam``: FWHM of a Jy/beam."""
    if unit == "K_RJ":
        return 1.0
    if frequency is None:
        cure = "give the frequency: --frequency '93 GHz', or set the header key RESTFRQ"
        raise InputError(f"units differ ({plane.unit}), and their ratio depends on the frequency", place=plane.name, cure=cure)
    if unit in ("K_CMB", "y"):
        return float((cmb_slope if unit == "K_CMB" else thermal_sz)(frequency))
    scale = float(intensity_to_kelvin(frequency))
    if unit == "MJy/sr":
        return scale * 1e-20
    if unit == "Jy/pixel":
        return np.asarray(scale * 1e-26 / np.broadcast_to(plane.grid.areas, plane.values.shape), np.float64)
    if not beam > 0:
        raise InputError("is in Jy/beam, and its beam is not known", place=plane.name, cure="set the header keys BMAJ and BMIN")
    return scale * 1e-26 / (math.pi / math.log(16) * beam**2)


def write_comparison(found: Comparison, stem: Path, meta: Mapping[str, Any]) -> list[Path]:
    """``STEM.fits`` (an image for each plane), ``STEM_spectra.ecsv``, ``STEM_profiles.ecsv``: paths. Raises OutputError."""
    paths = [stem.with_name(stem.name + end) for end in (".fits", "_spectra.ecsv", "_profiles.ecsv")]
    world = Cards((k, v) for k, v in found.header.items() if k not in ("COMMENT", "HISTORY", "SIMPLE", "EXTEND", "BITPIX"))
    with atomic_path(paths[0]) as temporary, open(temporary, "wb") as file:
        for k, (name, values) in enumerate(found.planes.items()):
            header = world.copy()
            header["EXTNAME"] = name.upper(), "extension name"
            if name in ("reference", "map", "difference"):
                header.add(_unit_cards(found.unit))
            if found.fwhm:
                for key in ("BMAJ", "BMIN"):
                    header[key] = math.degrees(found.fwhm), "[deg] FWHM"
            if name in found.noise:
                words, factor = found.noise[name]
                if factor is not None:
                    header["NOISEFAC"] = factor, "noise of the SNR / white noise"
                header["NOISEOF"] = _ascii(words), "noise of the SNR"
            if k == 0:
                header["REFERENC"], header["COMPARED"] = (_ascii(name) for name in found.names)
                header["ORIGIN"] = "zonda", "comparison of two maps"
                header.history.extend(map(_ascii, found.notes))
            for piece in image_pieces(header, values, extension=k > 0, dtype=np.float64):
                file.write(piece)
    about = {key: value for key, value in meta.items() if value not in ("", None)}
    about |= {"REFERENCE": found.names[0], "MAP": found.names[1]}
    about |= {key.upper(): value for key, value in found.figures.items() if math.isfinite(value)}
    write_ecsv(paths[1], spectra_columns(found), about)
    p, unit = found.profiles, fits_unit(found.unit)
    columns = [Column("radius", p.radius / ARCSEC, "arcsec", "middle of the ring")]
    for name in p.mean:
        columns.append(Column(name, p.mean[name], unit, "mean in the ring"))
        columns.append(Column(f"{name}_error", p.error[name], unit, "standard error from the scatter, one value per beam"))
    write_ecsv(paths[2], columns, about)
    return paths


def spectra_columns(found: Comparison) -> list[Column]:
    """The table of radial spectra, largest scale first."""
    s, unit = found.spectra, fits_unit(found.unit)
    return [
        Column("scale", s.scale / ARCSEC, "arcsec", "1 / mean wavenumber of the ring"),
        Column("wavenumber", 1 / s.scale, "rad-1", "mean over the ring's modes"),
        *(Column(n, p, f"{unit}2 sr" if unit else "sr", "power spectral density") for n, p in s.power.items()),
        Column("coherence", s.coherence, "", "Re sum a b* / sqrt(sum |a|^2 sum |b|^2), a the reference, b the map"),
        Column("modes", s.modes, "", "independent modes; relative standard error of the power: modes^-1/2"),
    ]


def fits_unit(unit: str) -> str:
    """The unit as FITS writes it where that is one word, else none: the header's text says it."""
    return {"K_RJ": "K", "mK_RJ": "mK", "uK_RJ": "uK", "K_CMB": "K", "mK_CMB": "mK", "uK_CMB": "uK"}.get(unit, "")


def _unit_cards(unit: str) -> Cards:
    plain = fits_unit(unit)
    cards = Cards([("BUNIT", plain or unit, "brightness")] if unit else ())
    if plain:
        cards["TEMPSCAL"] = unit.lstrip("mun"), "temperature scale"
    return cards


def _ascii(text: str) -> str:
    return text.encode("ascii", "backslashreplace").decode()
