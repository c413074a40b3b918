"""Maps that are compared: from FITS files of any origin and from products; and their comparison as a FITS file and tables."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.maps.image import Image
from zonda.core.maps.map_product import MapProduct
from zonda.core.maps.on_plane import on_plane
from zonda.core.maps.stokes import IQU
from zonda.core.maps.stokes_names import along_axis, columns_of_q_and_u
from zonda.core.maps.units import KNOWN_UNITS, parse_unit
from zonda.core.numerics.angles import ARCSEC
from zonda.core.numerics.radiation import cmb_slope, intensity_to_kelvin, thermal_sz
from zonda.core.numerics.sphere import angles
from zonda.core.storage.ecsv import Column, write_ecsv
from zonda.core.storage.files import atomic_path
from zonda.core.storage.fits_files import check_size, opened
from zonda.core.storage.fits_image import Cards, image_pieces
from zonda.core.types import Floats

from .planes import Plane
from .statistics import Comparison

MOST = 2000
"""Points along each side of the plane onto which a HEALPix map is brought."""
SAME_BAND = 1e-3
"""Relative difference of frequencies of one band."""
FRAMES = {"C": "icrs", "Q": "icrs", "ICRS": "icrs", "G": "galactic"}
NOISES = {"NOISE": "noise I", "COV_II": "noise I", "COV_QQ": "noise Q", "COV_UU": "noise U"}
"""Of a file's extensions and columns: standard errors, or variances."""
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
    """

    planes: dict[str, Plane]
    frequency: float | None
    band: str
    notes: list[str]

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

    Raises
    ------
    InputError
        Unreadable; no image of the sky in it; a cube of something else; an unknown unit; a HEALPix table without NSIDE, ORDERING
        or COORDSYS.
    """
    place = str(path)
    with opened(path, place, "check the file, e.g. with fitsverify, or copy it again") as hdus:
        for hdu in hdus:
            image = hdu.is_image and hdu.header.get("NAXIS", 0) >= 2
            if image or ("NSIDE" in hdu.header and "ORDERING" in hdu.header):
                check_size(path, hdu, place)
                header, values, unit = _images(hdus, hdu, place) if image else _healpix(hdu, place)
                return _read(name or path.name, (header, values), (hdu.header, unit), bool(image), place)
    raise InputError("is not a map: it holds no image of two axes and no HEALPix table", place=place, cure=CURE)


def _read(name: str, found: tuple[Any, dict[str, Floats]], told: tuple[Any, Any], image: bool, place: str) -> ReadMap:
    """``found``: celestial header and planes; ``told``: header of the file and unit."""
    (header, values), (about, unit) = found, told
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
            noise = values.get(f"noise {key}")
            plane = Plane(name if key == "I" else f"{name} {key}", sign * values[key], header, "", fwhm, noise)
            planes[key] = plane.scaled(factor, label)
    return ReadMap(planes, hertz, str(about.get("BAND", "")).strip(), notes)


def _images(hdus: Any, hdu: Any, place: str) -> tuple[Any, dict[str, Floats], Any]:
    """Header of the celestial axes, planes and their noise, unit: of a plane or a cube of Stokes parameters, or of extensions."""
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
    for other in alike if not long else ():
        if (of := NOISES.get(str(other.name).upper())) is not None:
            noise = np.asarray(other.data, np.float64).reshape(ny, nx)
            found[of] = noise if other.name.upper() == "NOISE" else np.sqrt(noise)
    both = found.keys() >= {"Q", "U"}
    return wcs.celestial.to_header(relax=True), {k: v for k, v in found.items() if both or k[-1] == "I"}, header.get("BUNIT")


def _healpix(hdu: Any, place: str) -> tuple[Any, dict[str, Floats], Any]:
    """A HEALPix table on a plane about its middle: header, planes and perhaps their noise, unit."""
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
    found = _on_plane(int(header["NSIDE"]), nest, pixels[order], {key: values[order] for key, values in planes.items()}, frame)
    return *found, header.get(f"TUNIT{1 + int(explicit)}")


def _on_plane(nside: int, nest: bool, pixels: Any, planes: Mapping[str, Floats], frame: str) -> tuple[Any, dict[str, Floats]]:
    """Planes of HEALPix pixels on a plane with points as far apart as the pixels are, each with the pixel's value."""
    import healpy

    directions = np.stack(healpy.pix2vec(nside, pixels, nest=nest), axis=1)
    middle = directions.mean(axis=0)
    centre = tuple(float(a) for a in angles(middle))
    side = healpy.nside2resol(nside)
    reach = float(np.arccos(np.clip((directions @ middle).min() / np.linalg.norm(middle), -1, 1)))
    ones = np.ones(len(pixels))
    product = MapProduct(
        next(iter(planes.values())), ones.astype(np.int64), ones, ones, None, None, (centre[0], centre[1]), side, frame,
        nside=nside, nest=nest, pixels=pixels,
    )  # fmt: skip
    made, wcs = on_plane(product, dict(planes), size=int(min(MOST, max(8.0, 2 * reach / side + 2))))
    return wcs.to_header(relax=True), {key: np.asarray(values, np.float64) for key, values in made.items()}


def plane_of(product: MapProduct | Image, name: str) -> Plane:
    """A product of a run, with its noise. The input image has a resolution of 0: no beam."""
    if isinstance(product, Image):
        return Plane(name, np.asarray(product.values, np.float64), product.header, product.unit, 0.0)
    fwhm = math.hypot(product.fwhm, product.smoothed_by) or None
    planes = {"signal": np.where(product.known, product.signal, np.nan), "noise": product.noise}
    if product.projection == "TAN":
        return Plane(name, planes["signal"], product.header, product.unit, fwhm, planes["noise"])
    if product.pixels is not None:
        header, found = _on_plane(product.nside, product.nest, product.pixels, planes, product.frame)
    else:
        made, wcs = on_plane(product, planes, size=min(MOST, max(product.signal.shape)))
        header, found = wcs.to_header(relax=True), {key: np.asarray(values, np.float64) for key, values in made.items()}
    return Plane(name, found["signal"], header, product.unit, fwhm, found["noise"])


def in_unit(plane: Plane, unit: str, frequency: float | None) -> Plane:
    """The plane in ``unit``, a name of `parse_unit` with a prefix (``mK_RJ``), at one frequency [Hz].

    Raises InputError where that needs a frequency or a beam that are not known, or the plane has no unit.
    """
    try:
        wanted, factor = parse_unit(unit, place="unit")
    except InputError as error:
        raise InputError(error.message, place="unit", cure=f"use {KNOWN_UNITS}, with a prefix where you like: mK_RJ") from error
    if plane.unit == wanted:
        return plane.scaled(1 / factor, unit)
    if not plane.unit:
        raise InputError(f"has no unit, and {unit} is wanted", place=plane.name, cure="set the header key BUNIT")
    ratio = _kelvin(plane, plane.unit, frequency) / _kelvin(plane, wanted, frequency)
    return plane.scaled(ratio / factor, unit)


def _kelvin(plane: Plane, unit: str, frequency: float | None) -> float:
    """Rayleigh-Jeans kelvin of one ``unit``."""
    if unit == "K_RJ":
        return 1.0
    if frequency is None:
        cure = "give the frequency: --frequency '93 GHz', or set the header key RESTFRQ"
        raise InputError(f"units differ ({plane.unit}), and their ratio depends on the frequency", place=plane.name, cure=cure)
    if unit in ("K_CMB", "y"):
        return float((cmb_slope if unit == "K_CMB" else thermal_sz)(frequency))
    area = {"Jy/pixel": math.prod(plane.sides), "Jy/beam": math.pi / math.log(16) * (plane.fwhm or 0.0) ** 2}.get(unit)
    if area == 0:
        raise InputError("is in Jy/beam, and its beam is not known", place=plane.name, cure="set the header keys BMAJ and BMIN")
    return float(intensity_to_kelvin(frequency)) * (1e-20 if area is None else 1e-26 / area)


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
