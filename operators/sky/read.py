"""Reading sky maps from FITS files: images with or without a celestial WCS, and HEALPix tables.

Nothing is guessed: where the unit, the scale or the position is neither in the file nor given, the
error lists the header keys and the parameters that would mend it.
"""

from __future__ import annotations

import math
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.maps.header import FileHeader
from zonda.core.maps.map_reading import (
    STOKES,
    Cube,
    HealpixTable,
    chosen,
    is_healpix,
    polarized_letter,
    q_and_u,
    unused,
)
from zonda.core.storage.fits_files import check_size, opened
from zonda.core.types import Floats

from .array_map import GIVEN, ArrayMap
from .geometry import ImageHeader
from .input_map import HealpixMap, ImageMap, InputMap
from .map_header import MapHeader, Wanted


def read_map(source: Path | ArrayMap, **options: Any) -> InputMap:
    """An image or HEALPix table of a FITS file or in memory; of Stokes parameters I, and a note
    names those that are not used.

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
    cure = "check the file, e.g. with fitsinfo or fitsverify, or copy it again"
    hdus: AbstractContextManager[Any]
    made: InputMap
    if isinstance(source, ArrayMap):
        place, hdus = f"sky map {source.name}", nullcontext([source.hdu])
    else:
        place = f"sky map {source}"
        hdus = opened(source, place, cure)
    with hdus as found:
        hdu, notes = chosen(found, wanted.hdu, place)
        check_size(hdu, place, whole=not wanted.header_alone)
        if is_healpix(hdu):
            made = _healpix(HealpixTable(hdu, place), MapHeader(hdu.header, place, wanted, notes))
        else:
            made = _image(hdu, found, ImageHeader(hdu.header, place, wanted, notes))
        given = source.text if isinstance(source, ArrayMap) else hdu.header.get(GIVEN)
    if made.polarization is not None:
        notes.pop(STOKES, None)
    if given:
        notes["input"] = f"{given}, in {made.unit}, given in Python"
    return made


def _filled(header: MapHeader, found: InputMap, planes: Floats, factor: float, where: str) -> None:
    """Put ``planes`` (1 or 3, ...) of I, or I, Q and U in COSMO's convention, into a map; in its
    unit they are times ``factor``. ``where`` names a pixel by its indices.
    """
    found.zeroed = header.filled(planes[0], where)
    if len(planes) > 1:
        found.zeroed += header.filled(planes[1:], f"plane {{}} of Q and U, {where}")
        found.polarization = planes[1:]
    planes *= factor
    found.values = planes[0]


def _image(hdu: Any, hdus: Any, header: ImageHeader) -> ImageMap:
    place, wanted, notes = header.place, header.wanted, header.notes
    beside = _beside(hdu, hdus, header) if wanted.hdu is None else []
    images = [hdu, *beside]
    values = [_pixels(image, wanted) for image in images]
    if values[0].ndim < 2 or values[0].size == 0:
        raise header.error("the image has no pixels", "give a two-dimensional image")
    if values[0].dtype.kind not in "iuf":
        message = f"its pixels are {values[0].dtype}, not numbers"
        raise header.error(message, "give an image of numbers")
    header.refuse("{} is for HEALPix maps", coordsys=wanted.coordsys, column=wanted.column)
    shape = values[0].shape
    cube = Cube(header.header, place, shape)
    plane, more = cube.plane(wanted.plane)
    notes |= more
    planes = [values[0][plane], *values[1:]]
    if wanted.polarized and (found := cube.q_and_u(plane)):
        planes = [values[0][k] for k in (plane, *found)]
    units = [FileHeader(image.header, place).text("BUNIT") for image in beside]
    unit, factor = header.unit("BUNIT", units, "images")
    beam = header.beam(unit)
    wcs, placeless = header.geometry(shape)
    image = ImageMap(
        values=planes[0],
        unit=unit,
        beam=beam,
        notes=notes,
        wcs=wcs,
        placeless=placeless,
    )
    header.check_beam(image, float((image.sides[::-1] * image.shape).max()))
    sign = header.sign_of_u(True) if len(planes) > 1 else 1.0
    if not wanted.header_alone:
        stack = np.array(planes, np.float64)
        stack[2:] *= sign
        _filled(header, image, stack, factor, "row {}, column {} (counted from 1)")
    return image


def _pixels(hdu: Any, wanted: Wanted) -> Floats:
    """The array of an image; of the header alone one of zeros that takes no memory."""
    if wanted.header_alone:
        return np.broadcast_to(np.float64(0.0), hdu.shape)
    return np.asarray(hdu.data)


def _beside(first: Any, hdus: Any, header: MapHeader) -> list[Any]:
    """Images of Q and U beside the ``first`` one, if they are wanted and there; a note names them
    otherwise.
    """
    if polarized_letter(first.name):
        raise header.error(
            f"its first image, {first.name}, is no intensity",
            "put the image of I first, or name it by the operator's parameter hdu",
        )
    what = f"the first image{f', {first.name},' if first.name else ''}"
    header.notes |= unused(what, [hdu.name for hdu in hdus if hdu.is_image])
    images = [hdu for hdu in hdus if hdu.is_image and hdu.header.get("NAXIS", 0) == 2]
    found = q_and_u([hdu.name for hdu in images]) if header.wanted.polarized else []
    beside = [images[k] for k in found]
    if any(hdu.shape != first.shape for hdu in beside):
        raise header.error(
            "its images of I, Q and U differ in size",
            "give three images of one grid",
        )
    for hdu in beside:
        check_size(hdu, header.place, whole=not header.wanted.header_alone)
    return beside


def _healpix(table: HealpixTable, header: MapHeader) -> HealpixMap:
    """The map of a table in its column of I (`HealpixTable.intensity`)."""
    wanted, notes = header.wanted, header.notes
    header.refuse(
        "{} does not apply to a HEALPix map",
        centre=wanted.centred,
        pixel_size=wanted.pixel_size,
        plane=wanted.plane,
    )
    nest, names = table.nest, table.names
    frame, more = table.frame(wanted.coordsys)
    first = table.intensity(wanted.column)
    notes |= more | unused(f"column {names[first]}", names, first)
    if len(names) > 1 + (table.pixel_column is not None) or wanted.column is not None:
        notes["column"] = f"{names[first]} ({first + 1} of {len(names)}: {', '.join(names)})"
    wanted_too = wanted.polarized and not polarized_letter(names[first])
    others = q_and_u(names) if wanted_too else []
    units = [str(header.header.get(f"TUNIT{1 + k}", "") or "").strip() for k in others]
    unit, factor = header.unit(f"TUNIT{1 + first}", units, "columns")
    beam = header.beam(unit)
    sign = header.sign_of_u(False) if others else 1.0
    columns = dict(zip("IQU", (first, *others), strict=False))
    planes, pixels, nside = table.read(columns, wanted.header_alone)
    values = np.stack(list(planes.values()))
    found = HealpixMap(
        values=values[0],
        unit=unit,
        beam=beam,
        notes=notes,
        pixels=pixels,
        nside=nside,
        nest=nest,
        frame=frame,
    )
    header.check_beam(found, math.pi)
    values[2:] *= sign
    _filled(header, found, values, factor, "entry {} of those that are seen (counted from 1)")
    return found
