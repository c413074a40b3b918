"""Reading sky maps from FITS files: images with or without a celestial WCS, and HEALPix tables.

Nothing is guessed: where the unit, the scale or the position is neither in the file nor given, the error lists the header
keys and the parameters that would mend it.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.numerics import tangent
from zonda.core.storage.files import check_memory, first_line, reading
from zonda.core.storage.fits_files import check_size, opened
from zonda.core.storage.fits_image import read_image

from . import stokes

Floats = NDArray[np.float64]

KNOWN_UNITS = "Jy/pixel, Jy/beam, MJy/sr, K_RJ, K_CMB or y (Compton-y)"
_PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6}
_PER = {"pixel": "Jy/pixel", "pix": "Jy/pixel", "px": "Jy/pixel", "beam": "Jy/beam", "bm": "Jy/beam", "sr": "MJy/sr"}
_SCALES = {
    "k_rj": "K_RJ",
    "rj": "K_RJ",
    "rayleigh-jeans": "K_RJ",
    "k_cmb": "K_CMB",
    "cmb": "K_CMB",
    "thermodynamic": "K_CMB",
}
_ANGLES = {
    **dict.fromkeys(("deg", "degree", "degrees"), "deg"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    **dict.fromkeys(("arcmin", "arcminute", "arcminutes"), "arcmin"),
    **dict.fromkeys(("arcsec", "arcsecond", "arcseconds", "asec"), "arcsec"),
    "mas": "mas",
}
_FRAMES: dict[str, Literal["icrs", "galactic", "barycentricmeanecliptic"]] = {
    **dict.fromkeys(("C", "Q", "EQ", "ICRS", "CELESTIAL", "EQUATORIAL"), "icrs"),
    **dict.fromkeys(("G", "GALACTIC"), "galactic"),
    **dict.fromkeys(("E", "ECLIPTIC"), "barycentricmeanecliptic"),
}
_IN_RADIANS = {"deg": np.pi / 180, "rad": 1.0, "arcmin": np.pi / 10800, "arcsec": np.pi / 648000, "mas": np.pi / 648e6}


@dataclass
class WcsMap:
    """An image as its file has it.

    Attributes
    ----------
    values
        (ny, nx) float64 in `unit`; row 0 is the file's first row.
    unit
        ``Jy/pixel``, ``Jy/beam``, ``MJy/sr``, ``K_RJ``, ``K_CMB`` or ``y``.
    wcs
        Two-dimensional celestial `astropy.wcs.WCS`; None where the file has none: then `scale` says how large pixels are.
    scale
        (2, 2) rad, where there is no WCS: a step of one pixel along (x, y) moves (east, north) by its columns.
    beam_solid_angle
        sr, of the beam in the header (``Jy/beam`` maps).
    notes
        What was chosen or changed, for the tally.
    zeroed
        Missing pixels set to zero on request.
    """

    values: Floats
    unit: str
    wcs: Any
    scale: Floats | None
    beam_solid_angle: float | None = None
    notes: dict[str, str] = field(default_factory=dict)
    zeroed: int = 0

    @property
    def nbytes(self) -> int:
        return self.values.nbytes


@dataclass
class HealpixMap:
    """A HEALPix map: ``values[k]`` float64 belongs to pixel ``pixels[k]`` (sorted; the others are not covered).

    ``pixels`` are numbers in the ordering ``nest``; ``frame`` is an astropy frame name. Other attributes as `WcsMap`.
    """

    values: Floats
    pixels: NDArray[np.int64]
    nside: int
    nest: bool
    frame: Literal["icrs", "galactic", "barycentricmeanecliptic"]
    unit: str
    notes: dict[str, str] = field(default_factory=dict)
    zeroed: int = 0

    @property
    def nbytes(self) -> int:
        return self.values.nbytes + self.pixels.nbytes


def read_map(
    path: Path,
    *,
    unit: str | None = None,
    pixel_size: float | None = None,
    centred: bool = False,
    missing: Literal["error", "zero"] = "error",
) -> WcsMap | HealpixMap:
    """The first image or HEALPix table of a FITS file; of Stokes parameters I, and a note names those that are not used.

    Parameters
    ----------
    unit
        Unit of the pixels; None: the header's BUNIT (TUNIT1 of a HEALPix table).
    pixel_size
        rad; replaces the header's scale, its orientation (signs, rotation) is kept.
    centred
        True where the caller says where the map's centre lies: then the header's position is not needed.
    missing
        What a NaN or infinite pixel does: an error, or it becomes zero.

    Raises
    ------
    InputError
        Unreadable file; no map in it; unit, scale or position missing; unknown unit; NaN; a cube without an axis STOKES; no I.
    """
    place = f"sky map {path}"
    cure = "check the file, e.g. with fitsinfo or fitsverify, or copy it again"
    plain = read_image(path)
    if plain is not None and tangent.plain(plain[0]) is not None:  # nothing that astropy need be asked
        with reading(place, "FITS", cure):
            check_memory(8 * plain[1].size, "the array or table", place)
            return _image(place, plain[1].astype(np.float64), plain[0], unit, pixel_size, centred, missing)
    with opened(path, place, cure) as hdus:
        for hdu in hdus:
            if _is_healpix(hdu):
                check_size(path, hdu, place)
                table, notes = _columns(hdu, place)
                found = _healpix(place, hdu.header, *table, unit, pixel_size, centred, missing)
                found.notes |= notes
                return found
            if hdu.is_image and hdu.header.get("NAXIS", 0) > 0:
                check_size(path, hdu, place)
                notes = stokes.of_extensions(hdu.name, [other.name for other in hdus if other.is_image], place)
                image = _image(place, np.asarray(hdu.data, np.float64), hdu.header, unit, pixel_size, centred, missing)
                image.notes |= notes
                return image
    raise InputError("holds no image and no HEALPix table", place=place, cure="give a FITS file with a two-dimensional image")


# -------------------------------------------------------------------------------------------------------------- units


def parse_unit(text: str, *, place: str, temperature_scale: str | None = None) -> tuple[str, float]:
    """(unit, factor) with value * factor in ``unit``, one of `KNOWN_UNITS`: ``mK_CMB`` is ("K_CMB", 1e-3).

    ``temperature_scale`` (the header key TEMPSCAL: K_RJ or K_CMB) tells what a plain kelvin is. Raises InputError.
    """
    plain = text.strip().replace("\N{MICRO SIGN}", "u").replace("\N{GREEK SMALL LETTER MU}", "u")
    if re.fullmatch(r"(y|y[_ -]?sz|(y[_ -])?compton([_ -]?y)?|compton[_ -]?(y[_ -]?)?parameter)", plain, re.IGNORECASE):
        return "y", 1.0
    match = re.fullmatch(r"(?-i:([num]?))(?:K|Kelvin)\s*[_ ]?\s*\(?(RJ|CMB|thermodynamic)?\)?", plain, re.IGNORECASE)
    if match and match[1] in _PREFIXES:
        scale = match[2] or temperature_scale
        if scale is None or not scale.strip():
            raise InputError(
                f"the unit '{text}' does not say on which temperature scale",
                place=place,
                cure="set the header key TEMPSCAL to 'K_RJ' or 'K_CMB', or the operator's parameter unit: K_RJ",
            )
        if scale.strip().lower() not in _SCALES:
            raise InputError(f"unknown temperature scale TEMPSCAL = '{scale}'", place=place, cure="use K_RJ or K_CMB")
        return _SCALES[scale.strip().lower()], _PREFIXES[match[1]]
    match = re.fullmatch(
        r"(?-i:([numkM]?))Jy\s*(?:/|\s|\*|\.)?\s*(pixel|pix|px|beam|bm|sr)\s*(?:(?:\^|\*\*)?\(?-1\)?)?", plain, re.IGNORECASE
    )
    if match and match[1] in _PREFIXES:
        unit = _PER[match[2].lower()]
        return unit, _PREFIXES[match[1]] * (1e-6 if unit == "MJy/sr" else 1.0)
    raise InputError(
        f"unknown unit '{text}'", place=place, cure=f"set the header key BUNIT or the operator's parameter unit to {KNOWN_UNITS}"
    )


def _unit(place: str, header: Any, key: str, given: str | None, notes: dict[str, str]) -> tuple[str, float]:
    written = str(header.get(key, "") or "").strip()
    text = given if given is not None else written
    if not text:
        raise InputError(
            "the unit of the map is missing",
            place=place,
            cure=f"set the header key {key}, or the operator's parameter unit, to {KNOWN_UNITS}",
        )
    if given is not None and written and given != written:
        notes["unit"] = f"{given} as given; {key} = '{written}' is overridden"
    return parse_unit(text, place=place, temperature_scale=header.get("TEMPSCAL"))


def _beam_solid_angle(place: str, header: Any) -> float:
    major, minor = header.get("BMAJ"), header.get("BMIN", header.get("BMAJ"))
    if not all(isinstance(b, int | float) and np.isfinite(b) and b > 0 for b in (major, minor)):
        raise InputError(
            "a map in Jy/beam needs the beam it was made with",
            place=place,
            cure="set the header keys BMAJ and BMIN (FWHM in degrees)",
        )
    return float(np.pi / (4 * np.log(2)) * np.radians(major) * np.radians(minor))


def _filled(place: str, values: Floats, missing: str, first: str) -> int:
    """Zero the non-finite values in place on request; their number. ``first``: how to name the first one, by its indices."""
    bad = ~np.isfinite(values)
    count = int(bad.sum())
    if count and missing == "error":
        where = np.unravel_index(int(np.flatnonzero(bad)[0]), values.shape)
        raise InputError(
            f"{count} of {values.size} pixels are NaN or infinite, the first at {first.format(*(int(k) + 1 for k in where))}",
            place=place,
            cure="mend the map, or set the operator's parameter missing: zero to take them as zero (they are counted)",
        )
    values[bad] = 0.0
    return count


# -------------------------------------------------------------------------------------------------------------- images


def _image(
    place: str, values: Floats, header: Any, given: str | None, pixel_size: float | None, centred: bool, missing: str
) -> WcsMap:
    if values.ndim < 2:
        raise InputError("the image has one axis", place=place, cure="give a two-dimensional image")
    if values.size == 0:
        raise InputError("the image has no pixels", place=place, cure="give a two-dimensional image")
    plane, notes = stokes.plane_of_cube(header, values.shape, place)
    values = values[plane].copy()
    unit, factor = _unit(place, header, "BUNIT", given, notes)
    beam = _beam_solid_angle(place, header) if unit == "Jy/beam" else None
    if beam is not None:
        notes["resolution"] = "the map is in Jy/beam, so convolved already; it is convolved with the detector's beam once more"
    zeroed = _filled(place, values, missing, "row {}, column {} (counted from 1)")
    values *= factor
    wcs, scale = _geometry(place, header, pixel_size, centred, notes)
    return WcsMap(values, unit, wcs, scale, beam, notes, zeroed)


def _geometry(
    place: str, header: Any, pixel_size: float | None, centred: bool, notes: dict[str, str]
) -> tuple[Any, Floats | None]:
    """(wcs, scale) of `WcsMap`, or the error that says what is missing."""
    header = header.copy()
    for key in ("CUNIT1", "CUNIT2"):
        text = str(header.get(key, "") or "").strip()
        if text and text.lower() in _ANGLES:
            header[key] = _ANGLES[text.lower()]
        elif text and _celestial(header, key[-1]):
            raise InputError(f"{key} = '{text}' is no angle", place=place, cure=f"set {key} to 'deg' or 'rad'")
    scaled = _has_scale(header)
    if not scaled and pixel_size is None:
        raise InputError(
            "the pixel size is missing",
            place=place,
            cure="set the header keys CDELT1, CDELT2 and CUNIT1, CUNIT2 ('deg' or 'rad'), or the operator's parameter "
            "pixel_size: 1 arcsec",
        )
    if not all(_celestial(header, axis) for axis in "12"):
        if pixel_size is None and not header.get("CUNIT1"):
            raise InputError(
                "the unit of the pixel size is missing",
                place=place,
                cure="set the header keys CUNIT1 and CUNIT2 ('deg' or 'rad'), or the operator's parameter pixel_size: 1 arcsec",
            )
        if pixel_size is None and not centred:
            raise _no_position(place, "CTYPE1, CTYPE2, CRVAL1, CRVAL2, CRPIX1, CRPIX2")
        notes["position"] = "the file has no WCS: its centre is put on the target, its first axis runs west, its second north"
        return None, _plain_scale(place, header, scaled, pixel_size)
    kinds = {str(header[f"CTYPE{axis}"]).upper()[:4] for axis in "12"}
    if kinds == {"GLON", "GLAT"}:
        for key in ("RADESYS", "RADECSYS", "EQUINOX", "EPOCH"):  # they are for equatorial axes; astropy would take ICRS
            if key in header:
                del header[key]
    elif kinds != {"RA--", "DEC-"}:
        raise InputError(
            f"the axes {header['CTYPE1']}, {header['CTYPE2']} are neither equatorial nor Galactic",
            place=place,
            cure="give a map in ICRS, FK5, FK4 or Galactic coordinates",
        )
    absent = [k for k in ("CRVAL1", "CRVAL2", "CRPIX1", "CRPIX2") if k not in header]
    if absent and not centred:
        raise _no_position(place, ", ".join(absent))
    try:
        wcs = tangent.plain(header)
        if wcs is None:
            from astropy.wcs import WCS

            wcs = WCS(header, naxis=2)
            wcs.wcs.set()
        matrix = np.asarray(wcs.pixel_scale_matrix)
    except Exception as err:  # wcslib has a dozen exception classes of its own
        raise InputError(
            f"the WCS is broken: {first_line(err)}", place=place, cure="check CTYPE, CRVAL, CRPIX, CDELT, PC or CD"
        ) from err
    if not np.isfinite([*matrix.ravel(), *wcs.wcs.crval, *wcs.wcs.crpix]).all() or np.linalg.det(matrix) == 0.0:
        raise InputError("the WCS is singular: its pixels have no area", place=place, cure="check CDELT1, CDELT2, PC and CD")
    if pixel_size is None:
        return wcs, None
    if not is_plain_tan(wcs):
        raise InputError(
            f"pixel_size cannot replace the scale of a map in projection {', '.join(wcs.wcs.ctype)}",
            place=place,
            cure="remove pixel_size, or give a TAN map",
        )
    notes["pixel size"] = f"{np.degrees(pixel_size) * 3600:g} arcsec as given; the header's scale is overridden"
    cd = matrix if scaled else np.diag([-1.0, 1.0])
    return linear(wcs, cd / np.linalg.norm(cd, axis=0) * np.degrees(pixel_size)), None


def linear(wcs: Any, matrix: Floats) -> Any:
    """A copy of a plain TAN ``wcs`` with the pixel scale matrix (2, 2) [deg], whether it had CD, PC, CDELT or CROTA."""
    from astropy.wcs import WCS

    made = WCS(naxis=2)
    for key in ("ctype", "crval", "crpix", "radesys", "equinox", "lonpole", "latpole"):
        setattr(made.wcs, key, getattr(wcs.wcs, key))
    made.wcs.cdelt = [1.0, 1.0]
    made.wcs.pc = matrix
    made.wcs.set()
    return made


def _celestial(header: Any, axis: str) -> bool:
    return re.match(r"(RA--|DEC-|[GESH]L(ON|AT)|[A-Z]{2}L[NT])", str(header.get(f"CTYPE{axis}", "")).upper()) is not None


def _has_scale(header: Any) -> bool:
    cd = any(f"CD{i}_{j}" in header for i in (1, 2) for j in (1, 2))
    return cd or all(f"CDELT{k}" in header for k in (1, 2))


def _no_position(place: str, keys: str) -> InputError:
    return InputError(
        "the map has no world coordinates, so its position on the sky is unknown",
        place=place,
        cure=f"set the header keys {keys}, or the operator's parameter centre (a position, or 'target')",
    )


def _plain_scale(place: str, header: Any, scaled: bool, pixel_size: float | None) -> Floats:
    """(2, 2) rad for a map without celestial axes: the first axis runs west whatever the sign of its CDELT."""
    if pixel_size is not None:
        return np.diag([-pixel_size, pixel_size])
    sizes = []
    for k in (1, 2):
        unit = _IN_RADIANS[str(header.get(f"CUNIT{k}") or header.get("CUNIT1"))]
        step = header.get(f"CDELT{k}")
        if step is None:
            step = np.hypot(header.get(f"CD1_{k}", 0.0), header.get(f"CD2_{k}", 0.0))
        sizes.append(abs(float(step)) * unit)
    if not all(np.isfinite(s) and s > 0 for s in sizes):
        raise InputError("the pixel size is zero or not finite", place=place, cure="check CDELT1 and CDELT2")
    return np.diag([-sizes[0], sizes[1]])


def is_plain_tan(wcs: Any) -> bool:
    """True for a gnomonic projection without distortions, which needs no resampling; in a frame that is a rotation of ICRS."""
    from zonda.core.numerics.projection import wcs_frame_rotation

    if not all(str(c).endswith("-TAN") for c in wcs.wcs.ctype) or wcs.has_distortion or len(wcs.wcs.get_pv()):
        return False
    try:
        wcs_frame_rotation(wcs)
    except InputError:
        return False
    return True


# -------------------------------------------------------------------------------------------------------------- HEALPix


def _is_healpix(hdu: Any) -> bool:
    header = hdu.header
    return header.get("XTENSION") == "BINTABLE" and (
        str(header.get("PIXTYPE", "")).upper() == "HEALPIX" or ("NSIDE" in header and "ORDERING" in header)
    )


def _columns(hdu: Any, place: str) -> tuple[tuple[Floats, NDArray[np.int64] | None], dict[str, str]]:
    """Values of the first map of a table, with the pixels they belong to where the table says; the note about other maps."""
    names = hdu.columns.names
    explicit = names[0].upper() in ("PIXEL", "PIXELS", "PIX", "INDEX")
    notes = stokes.of_columns(names, int(explicit), place)
    values = np.asarray(hdu.data.field(int(explicit)), np.float64).ravel()
    return (values, np.asarray(hdu.data.field(0), np.int64).ravel() if explicit else None), notes


def _healpix(
    place: str,
    header: Any,
    values: Floats,
    pixels: NDArray[np.int64] | None,
    given: str | None,
    pixel_size: float | None,
    centred: bool,
    missing: Literal["error", "zero"],
) -> HealpixMap:
    import healpy

    if pixel_size is not None or centred:
        name = "centre" if centred else "pixel_size"
        raise InputError(f"{name} does not apply to a HEALPix map", place=place, cure=f"remove {name}")
    ordering = str(header.get("ORDERING", "")).upper()
    if not ordering.startswith(("RING", "NEST")):
        raise InputError(
            "the ordering of the HEALPix map is missing", place=place, cure="set the header key ORDERING to RING or NESTED"
        )
    system = str(header.get("COORDSYS", "")).strip().upper()
    if system not in _FRAMES:
        raise InputError(
            "the coordinate system of the HEALPix map is missing",
            place=place,
            cure="set the header key COORDSYS to C (ICRS), G or E",
        )
    notes: dict[str, str] = {}
    unit, factor = _unit(place, header, "TUNIT1" if pixels is None else "TUNIT2", given, notes)
    if unit == "Jy/beam":
        raise InputError("HEALPix maps in Jy/beam are not read", place=place, cure="convert the map to MJy/sr or K_RJ")
    if pixels is not None:
        nside = int(header.get("NSIDE", 0))
        order = np.argsort(pixels, kind="stable")
        pixels, values = pixels[order], values[order]
        if len(pixels) and (pixels[0] < 0 or pixels[-1] >= 12 * nside * nside or (np.diff(pixels) == 0).any()):
            raise InputError(
                "the pixel numbers are out of range or twice there", place=place, cure="check NSIDE and the PIXEL column"
            )
    else:
        pixels = np.arange(len(values))
        nside = round((len(values) / 12) ** 0.5)
        if 12 * nside * nside != len(values):
            raise InputError(f"{len(values)} values are no HEALPix map", place=place, cure="a full map has 12 nside^2 of them")
    if not healpy.isnsideok(nside, nest=ordering.startswith("NEST")) or nside < 1:
        raise InputError(f"NSIDE = {nside} is not valid", place=place, cure="set the header key NSIDE")
    seen = ~healpy.mask_bad(values) if len(values) else np.zeros(0, bool)
    seen |= ~np.isfinite(values)
    pixels, values = pixels[seen], values[seen]
    zeroed = _filled(place, values, missing, "entry {} of those that are seen (counted from 1)")
    return HealpixMap(values * factor, pixels, nside, ordering.startswith("NEST"), _FRAMES[system], unit, notes, zeroed)
