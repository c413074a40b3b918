"""Directions of an image's pixels by its header (the WCS, or pixels of a known size), or as the
user places them.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
from astropy.wcs import WCS

from zonda.core.errors import InputError
from zonda.core.maps.header import number, text, with_known_frame
from zonda.core.maps.map_reading import is_celestial
from zonda.core.numerics.projection import wcs_frame_rotation
from zonda.core.numerics.sphere import angles, local_axes
from zonda.core.storage.files import first_line
from zonda.core.types import Floats

from .input_map import ImageMap
from .limits import check_geometry, check_sides

_ANGLES = {
    **dict.fromkeys(("deg", "degree", "degrees"), "deg"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    **dict.fromkeys(("arcmin", "arcminute", "arcminutes"), "arcmin"),
    **dict.fromkeys(("arcsec", "arcsecond", "arcseconds", "asec"), "arcsec"),
    "mas": "mas",
}
ROUNDED = 1e-12
"""rad by which a map that is moved along is not turned."""
_IN_RADIANS = {
    "deg": np.pi / 180,
    "rad": 1.0,
    "arcmin": np.pi / 10800,
    "arcsec": np.pi / 648000,
    "mas": np.pi / 648e6,
}


def geometry(
    place: str,
    header: Any,
    shape: tuple[int, ...],
    pixel_size: float | None,
    centred: bool,
    notes: dict[str, str],
) -> tuple[Any, bool]:
    """`ImageMap`'s ``wcs`` and ``placeless`` of an image of ``shape`` (..., ny, nx), or the error
    that says what is missing.
    """
    header = _with_known_units(header, place)
    scaled = _has_scale(header)
    if not scaled and pixel_size is None:
        raise InputError(
            "the pixel size is missing",
            place=place,
            cure=(
                "set the header keys CDELT1, CDELT2 and CUNIT1, CUNIT2 ('deg' or 'rad'), or the"
                " operator's parameter pixel_size: 1 arcsec"
            ),
        )
    if not all(_celestial(header, axis) for axis in "12"):
        if pixel_size is None and not header.get("CUNIT1"):
            raise InputError(
                "the unit of the pixel size is missing",
                place=place,
                cure=(
                    "set the header keys CUNIT1 and CUNIT2 ('deg' or 'rad'), or the operator's"
                    " parameter pixel_size: 1 arcsec"
                ),
            )
        if pixel_size is None and not centred:
            raise _no_position(place, "CTYPE1, CTYPE2, CRVAL1, CRVAL2, CRPIX1, CRPIX2")
        notes["position"] = (
            "the file has no WCS: its centre is put on the target, its first axis runs west, its"
            " second north"
        )
        bare = WCS(naxis=2)
        bare.wcs.ctype, bare.wcs.radesys = ["RA---TAN", "DEC--TAN"], "ICRS"
        bare.wcs.crpix = (np.array(shape[:-3:-1]) + 1) / 2
        return rescaled(bare, np.degrees(_plain_scale(place, header, pixel_size))), True
    header, note = _with_frame(header, place)
    if note:
        notes["coordinates"] = note
    absent = [k for k in ("CRVAL1", "CRVAL2", "CRPIX1", "CRPIX2") if k not in header]
    if absent and not centred:
        raise _no_position(place, ", ".join(absent))
    wcs, matrix = _wcs(header, place)
    check_geometry(matrix if pixel_size is None else np.eye(2) / 60, wcs.wcs.crpix, header, place)
    if pixel_size is None:
        return wcs, False
    if not is_plain_tan(wcs):
        raise InputError(
            "pixel_size cannot replace the scale of a map in projection"
            f" {', '.join(wcs.wcs.ctype)}",
            place=place,
            cure="remove pixel_size, or give a TAN map",
        )
    notes["pixel size"] = (
        f"{np.degrees(pixel_size) * 3600:g} arcsec as given; the header's scale is overridden"
    )
    cd = matrix if scaled else np.diag([-1.0, 1.0])
    return rescaled(wcs, cd / np.linalg.norm(cd, axis=0) * np.degrees(pixel_size)), False


def _with_known_units(header: Any, place: str) -> Any:
    """A copy of the header whose celestial axes have units that FITS knows."""
    header = header.copy()
    for key in ("CUNIT1", "CUNIT2"):
        written = text(header, key, place)
        if written and written.lower() in _ANGLES:
            header[key] = _ANGLES[written.lower()]
        elif written and _celestial(header, key[-1]):
            raise InputError(
                f"{key} = '{written}' is no angle", place=place, cure=f"set {key} to 'deg' or 'rad'"
            )
    return header


def _with_frame(header: Any, place: str) -> tuple[Any, str]:
    """`with_known_frame`; axes that are neither equatorial nor Galactic are refused."""
    kinds = {str(header[f"CTYPE{axis}"]).upper()[:4] for axis in "12"}
    if kinds not in ({"GLON", "GLAT"}, {"RA--", "DEC-"}):
        raise InputError(
            f"the axes {header['CTYPE1']}, {header['CTYPE2']} are neither equatorial nor Galactic",
            place=place,
            cure="give a map in ICRS, FK5, FK4 or Galactic coordinates",
        )
    return with_known_frame(header, place)


def _wcs(header: Any, place: str) -> tuple[Any, Floats]:
    """The WCS of a header and its pixel scale matrix (2, 2) [deg]."""
    try:
        wcs = WCS(header, naxis=2)
        wcs.wcs.set()
        matrix = np.asarray(wcs.pixel_scale_matrix)
    except Exception as err:  # wcslib has a dozen exception classes of its own
        raise InputError(
            f"the WCS is broken: {first_line(err)}",
            place=place,
            cure="check CTYPE, CRVAL, CRPIX, CDELT, PC or CD",
        ) from err
    with np.errstate(over="ignore"):
        area = np.linalg.det(matrix)
    if not np.isfinite([*matrix.ravel(), *wcs.wcs.crval, *wcs.wcs.crpix]).all() or area == 0.0:
        raise InputError(
            "the WCS is singular: its pixels have no area",
            place=place,
            cure="check CDELT1, CDELT2, PC and CD",
        )
    return wcs, matrix


def rescaled(wcs: Any, matrix: Floats) -> Any:
    """A copy of a plain TAN ``wcs`` with the pixel scale matrix (2, 2) [deg], whether it had CD,
    PC, CDELT or CROTA.
    """
    made = WCS(naxis=2)
    for key in ("ctype", "crval", "crpix", "radesys", "equinox", "lonpole", "latpole"):
        setattr(made.wcs, key, getattr(wcs.wcs, key))
    made.wcs.cdelt = [1.0, 1.0]
    made.wcs.pc = matrix
    made.wcs.set()
    return made


def _celestial(header: Any, axis: str) -> bool:
    return is_celestial(str(header.get(f"CTYPE{axis}", "")))


def _has_scale(header: Any) -> bool:
    cd = any(f"CD{i}_{j}" in header for i in (1, 2) for j in (1, 2))
    return cd or all(f"CDELT{k}" in header for k in (1, 2))


def _no_position(place: str, keys: str) -> InputError:
    return InputError(
        "the map has no world coordinates, so its position on the sky is unknown",
        place=place,
        cure=(
            f"set the header keys {keys}, or the operator's parameter centre (a position, or"
            " 'target')"
        ),
    )


def _plain_scale(place: str, header: Any, pixel_size: float | None) -> Floats:
    """(2, 2) rad for a map without celestial axes: the first axis runs west whatever the sign of
    its CDELT.
    """
    if pixel_size is not None:
        return np.diag([-pixel_size, pixel_size])
    sizes = []
    for k in (1, 2):
        written = str(header.get(f"CUNIT{k}") or header.get("CUNIT1")).strip()
        if written not in _IN_RADIANS:
            raise InputError(
                f"CUNIT{k} = '{written}' is no angle",
                place=place,
                cure=f"set CUNIT{k} to 'deg' or 'rad'",
            )
        step = number(header, f"CDELT{k}", place)
        if step is None:
            step = math.hypot(*(number(header, f"CD{i}_{k}", place) or 0.0 for i in (1, 2)))
        sizes.append(abs(step) * _IN_RADIANS[written])
    if not all(np.isfinite(s) and s > 0 for s in sizes):
        raise InputError(
            "the pixel size is zero or not finite", place=place, cure="check CDELT1 and CDELT2"
        )
    check_sides(np.degrees(sizes), place, "check CDELT1 and CDELT2")
    return np.diag([-sizes[0], sizes[1]])


def is_plain_tan(wcs: Any) -> bool:
    """True for a gnomonic projection without distortions, which needs no resampling; in a frame
    that is a rotation of ICRS.
    """
    if (
        not all(str(c).endswith("-TAN") for c in wcs.wcs.ctype)
        or wcs.has_distortion
        or len(wcs.wcs.get_pv())
    ):
        return False
    try:
        wcs_frame_rotation(wcs)
    except InputError:
        return False
    return True


def placed(image: ImageMap, centre: tuple[float, float] | None) -> Any:
    """The TAN `WCS` of an image, or None where it must be resampled (another projection,
    distortions).

    Parameters
    ----------
    centre
        ICRS (ra, dec) [rad]: the image's centre, pixel ((nx + 1) / 2, (ny + 1) / 2) counted from 1,
        is put there. An image that has a place is moved as a whole (`moved`); one that has none
        touches the sky there, its second axis north. None: where the header puts it.

    """
    if not is_plain_tan(image.wcs):
        return None
    if centre is None:
        return image.wcs
    rows, columns = image.shape
    wcs, old = WCS(naxis=2), image.wcs.wcs
    wcs.wcs.radesys, wcs.wcs.lonpole = "ICRS", 180.0
    wcs.wcs.ctype = ["DEC--TAN", "RA---TAN"] if old.lng == 1 else ["RA---TAN", "DEC--TAN"]
    wcs.wcs.crpix = np.asarray(old.crpix[:2], np.float64)
    # the axes of the tangent point, in ICRS there
    own = local_axes(*np.radians([old.crval[old.lng], old.crval[old.lat]])) @ _turned(image, centre)
    is_middle = (wcs.wcs.crpix == [(columns + 1) / 2, (rows + 1) / 2]).all()
    ra, dec = centre if is_middle else (float(v) for v in angles(own[0]))
    _, east, north = local_axes(ra, dec)
    angle = float(np.arctan2(own[2] @ east, own[2] @ north)) + np.radians(
        float(old.lonpole) - 180.0
    )
    matrix = np.asarray(image.wcs.pixel_scale_matrix, np.float64)
    if abs(angle) > ROUNDED:
        # east and north of the image's matrix are its own: each is turned from north to east
        c, s = np.cos(angle), np.sin(angle)
        matrix = np.array([[c, s], [-s, c]] if old.lng == 0 else [[c, -s], [s, c]]) @ matrix
    wcs.wcs.crval = np.degrees([dec, ra] if old.lng == 1 else [ra, dec])
    return rescaled(wcs, matrix)


def moved(image: ImageMap, centre: tuple[float, float], place: str) -> ImageMap:
    """An image of any projection moved over the sky with its centre to ``centre``, ICRS (ra, dec)
    [rad].

    The sphere is turned, so that the image keeps its shape, and directions at its centre keep their
    angles from ICRS north: what lies east stays east, whatever the frame of the image. Its Q and U
    turn with it; those of an image without a place are counted from the meridians there.

    Raises InputError where the image's centre is beyond its projection.
    """
    if image.placeless:
        return replace(image, wcs=placed(image, centre), placeless=False)
    turn = _turned(image, centre)
    if not np.isfinite(turn).all():
        raise InputError(
            f"the middle of the map is beyond its projection {', '.join(image.wcs.wcs.ctype)}",
            place=place,
            cure="remove centre, or cut the map",
        )
    return replace(image, moved=turn)


def _turned(image: ImageMap, centre: tuple[float, float]) -> Floats:
    """(3, 3) from ICRS directions about ``centre`` to the image's own about its middle."""
    middle = local_axes(*(float(v) for v in angles(image.directions(image.middle))))
    return np.asarray(image.turn @ (middle.T @ local_axes(*centre)))
