"""Reading sky maps from FITS files: images with or without a celestial WCS, and HEALPix tables.

Nothing is guessed: where the unit, the scale or the position is neither in the file nor given, the
error lists the header keys and the parameters that would mend it.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.errors import InputError
from zonda.core.maps.header import text
from zonda.core.maps.map_reading import (
    STOKES,
    chosen,
    is_healpix,
    plane_of_cube,
    planes_of_q_and_u,
)
from zonda.core.maps.stokes_names import columns_of_q_and_u
from zonda.core.storage.files import reading
from zonda.core.storage.fits_files import check_size, opened
from zonda.core.types import Floats

from . import stokes
from .array import GIVEN, ArrayMap
from .geometry import geometry
from .healpix import read_healpix
from .input_map import ImageMap, InputMap, Wanted
from .units import beam_solid_angle, check_beam, filled, made_with, unit_of


def read_map(path: Path, **options: Any) -> InputMap:
    """An image or HEALPix table of a FITS file; of Stokes parameters I, and a note names those that
    are not used.

    Parameters
    ----------
    options
        `Wanted`'s attributes.

    Raises
    ------
    InputError
        Unreadable file; no map in it; unit, scale or position missing; unknown unit; NaN; a cube of
        which no plane is wanted; no I; options that do not apply.
    """
    wanted = Wanted(**options)
    place = f"sky map {path}"
    cure = "check the file, e.g. with fitsinfo or fitsverify, or copy it again"
    with opened(path, place, cure) as hdus:
        hdu, notes = chosen(hdus, wanted.hdu, place)
        check_size(hdu, place, whole=not wanted.header_alone)
        if is_healpix(hdu):
            found: InputMap = read_healpix(hdu, place, wanted)
        else:
            q_and_u = None
            if wanted.hdu is None:
                notes |= stokes.of_extensions(
                    hdu.name, [other.name for other in hdus if other.is_image], place
                )
                q_and_u = _extensions(hdus, hdu, wanted, place) if wanted.polarized else None
            found = _image(place, _pixels(hdu, wanted), hdu.header, wanted, q_and_u)
        found.notes = notes | found.notes
        if found.polarization is not None:
            found.notes.pop(STOKES, None)
        return _told(found, hdu.header.get(GIVEN))


def read_array(array: ArrayMap, place: str, **options: Any) -> InputMap:
    """Read an array or HDU in memory as `read_map` reads a file."""
    wanted = Wanted(**options)
    if array.table is not None:
        with reading(place, "FITS", "check the table"):
            return _told(read_healpix(array.table, place, wanted), array.text)
    return _told(_image(place, array.values, array.header, wanted), array.text)


def _told(found: InputMap, given: object) -> InputMap:
    """The map, with a note of the array that it was in Python."""
    if given:
        found.notes["input"] = f"{given}, in {found.unit}, given in Python"
    return found


def _pixels(hdu: Any, wanted: Wanted) -> Floats:
    """The array of an image; of the header alone one of zeros that takes no memory."""
    return (
        np.broadcast_to(np.float64(0.0), hdu.shape) if wanted.header_alone else np.asarray(hdu.data)
    )


def _extensions(hdus: Any, first: Any, wanted: Wanted, place: str) -> Floats | None:
    """(2, ny, nx) Q and U of a file that has them as extensions beside its ``first`` image; None
    where it has none.
    """
    images = [hdu for hdu in hdus if hdu.is_image and hdu.header.get("NAXIS", 0) == 2]
    found = columns_of_q_and_u([hdu.name for hdu in images])
    if found is None:
        return None
    if any(images[k].shape != first.shape for k in found):
        raise InputError(
            "its images of I, Q and U differ in size",
            place=place,
            cure="give three images of one grid",
        )
    for k in found:
        check_size(images[k], place, whole=not wanted.header_alone)
        _check_extension(images[k], first, wanted, place)
    return np.stack([np.asarray(_pixels(images[k], wanted), np.float64) for k in found])


def _check_extension(hdu: Any, first: Any, wanted: Wanted, place: str) -> None:
    """Refuse an image of Q or U in another unit than that of I."""
    units = [text(h.header, "BUNIT", place) for h in (first, hdu)]
    if wanted.unit is None and units[1] not in ("", units[0]):
        cure = (
            "write all three in one unit, or set the operator's parameter unit, which then holds"
            " for all"
        )
        raise InputError(
            f"its image {hdu.name} is in {units[1]}, and I in {units[0] or '(none)'}",
            place=place,
            cure=cure,
        )


def _image(
    place: str, values: Floats, header: Any, wanted: Wanted, q_and_u: Floats | None = None
) -> ImageMap:
    if values.ndim < 2 or values.size == 0:
        raise InputError(
            "the image has no pixels", place=place, cure="give a two-dimensional image"
        )
    if values.dtype.kind not in "iuf":
        raise InputError(
            f"its pixels are {values.dtype}, not numbers",
            place=place,
            cure="give an image of numbers",
        )
    for name, is_given in (
        ("coordsys", wanted.coordsys is not None),
        ("column", wanted.column is not None),
    ):
        if is_given:
            cure = f"remove {name}" + (
                ": CTYPE says what an image's are" if name == "coordsys" else ""
            )
            raise InputError(f"{name} is for HEALPix maps", place=place, cure=cure)
    plane, notes = plane_of_cube(header, values.shape, wanted.plane, place)
    planes = planes_of_q_and_u(header, values.shape, plane) if wanted.polarized else None
    unit, factor = unit_of(place, header, "BUNIT", wanted.unit, notes)
    beam = beam_solid_angle(place, header, unit, wanted.input_beam, notes)
    wcs, placeless = geometry(place, header, values.shape, wanted.pixel_size, wanted.centred, notes)
    found = ImageMap(
        values=values[plane],
        unit=unit,
        beam_solid_angle=beam,
        notes=notes,
        beam=made_with(header, wanted.input_beam),
        wcs=wcs,
        placeless=placeless,
    )
    check_beam(place, beam, found.sides, found.shape, wanted.input_beam is not None, notes)
    if planes is not None and not wanted.header_alone:
        q_and_u = np.stack([np.array(values[k], np.float64) for k in planes])
    if planes is not None or q_and_u is not None:
        notes.pop(STOKES, None)
        sign = stokes.sign_of_u(header, wanted.convention, True, place, notes)
    if wanted.header_alone:
        return found
    found.values = np.array(values[plane], np.float64)
    where = "row {}, column {} (counted from 1)"
    found.zeroed = filled(place, found.values, wanted.missing, where)
    found.values *= factor
    if q_and_u is not None:
        found.zeroed += filled(place, q_and_u, wanted.missing, f"plane {{}} of Q and U, {where}")
        q_and_u *= factor
        q_and_u[1] *= sign
        found.polarization = q_and_u
    return found
