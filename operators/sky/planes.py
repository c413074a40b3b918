"""Choice of the image of a file and the plane of a cube: the one that the user names, or the only
possible one.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from zonda.core.errors import InputError

from . import stokes
from .geometry import is_celestial
from .healpix import is_healpix

# --------------------------------------------------------------------------------------------------
# extensions


def chosen(hdus: Any, wanted: int | str | None, place: str) -> tuple[Any, dict[str, str]]:
    """The extension ``wanted`` (`inputs.Wanted.hdu`) of a FITS file, else its first image or
    HEALPix table; notes.

    Raises
    ------
    InputError
        There is none, or it is neither.
    """
    maps = [hdu for hdu in hdus if is_map(hdu)]
    if wanted is None:
        if not maps:
            one = any(hdu.is_image and hdu.header.get("NAXIS", 0) == 1 for hdu in hdus)
            what = (
                "the image has one axis (a spectrum?)"
                if one
                else "holds no image and no HEALPix table"
            )
            raise InputError(
                f"{what}; in the file: {_contents(hdus)}",
                place=place,
                cure="give a FITS file with a two-dimensional image",
            )
        several = len(maps) > 1
        note = (
            {"extension": f"the first of {len(maps)} maps is read; in the file: {_contents(hdus)}"}
            if several
            else {}
        )
        return maps[0], note
    found = [
        hdu
        for k, hdu in enumerate(hdus)
        if wanted in (k, hdu.name) or str(wanted).upper() in (str(k), hdu.name.upper())
    ]
    if not found:
        raise InputError(
            f"there is no extension {wanted}",
            place=place,
            cure=f"set hdu to one of these: {_contents(hdus)}",
        )
    if not is_map(found[0]):
        raise InputError(
            f"the extension {wanted} is neither an image of two axes nor a HEALPix table",
            place=place,
            cure=f"set hdu to another of these: {_contents(hdus)}",
        )
    return found[0], {}


def is_map(hdu: Any) -> bool:
    """True for a HEALPix table or an image of two axes or more."""
    return is_healpix(hdu) or bool(hdu.is_image and hdu.header.get("NAXIS", 0) > 1)


def _contents(hdus: Any) -> str:
    return "; ".join(
        f"{k}{f' {hdu.name}' if hdu.name else ''}: {_kind(hdu)}" for k, hdu in enumerate(hdus)
    )


def _kind(hdu: Any) -> str:
    header = hdu.header
    if is_healpix(hdu):
        return "HEALPix table"
    if not hdu.is_image:
        return f"table of {header.get('NAXIS2', 0)} rows"
    if not header.get("NAXIS", 0):
        return "empty"
    return "image of " + " x ".join(
        str(header.get(f"NAXIS{k + 1}")) for k in range(header["NAXIS"])
    )


# --------------------------------------------------------------------------------------------------
# planes


def plane_of_cube(
    header: Any, shape: Sequence[int], wanted: tuple[int, ...] | None, place: str
) -> tuple[tuple[int, ...], dict[str, str]]:
    """Index of a plane among the axes before the last two, and notes about the others.

    Parameters
    ----------
    shape
        Of the image, slowest axis first.
    wanted
        `inputs.Wanted.plane`, in FITS's order of the axes. An axis STOKES may be left out: of it I
        is read.

    Raises
    ------
    InputError
        A cube of which no plane is wanted, or one that is not there; no I; axes of the sky that are
        not the first two.
    """
    axes = {
        len(shape) - k: length for k, length in enumerate(shape[:-2])
    }  # FITS counts from the fastest
    names = {axis: str(header.get(f"CTYPE{axis}", "")).strip().upper() for axis in axes}
    if stray := [f"{axis} ({name})" for axis, name in names.items() if is_celestial(name)]:
        raise InputError(
            "the axes of the sky are not the first two of the cube, but"
            f" {', '.join(sorted(stray))}",
            place=place,
            cure="transpose it, so that axes 1 and 2 are longitude and latitude",
        )
    numbers = _numbers(axes, names, shape, wanted, place)
    notes: dict[str, str] = {}
    for axis, length in axes.items():
        if names[axis] == "STOKES":
            numbers[axis], note = stokes.plane(header, axis, length, numbers.get(axis), place)
            notes |= note
        elif length > 1:
            notes["plane"] = "; ".join(
                [
                    *([notes["plane"]] if "plane" in notes else []),
                    _which(header, axis, length, numbers[axis]),
                ]
            )
    return tuple(numbers.get(axis, 1) - 1 for axis in axes), notes


def _numbers(
    axes: dict[int, int],
    names: dict[int, str],
    shape: Sequence[int],
    wanted: tuple[int, ...] | None,
    place: str,
) -> dict[int, int]:
    """The number of the plane by axis, where one is wanted."""
    sides = " x ".join(str(n) for n in reversed(shape))
    long = sorted(axis for axis, length in axes.items() if length > 1) or sorted(axes)
    asked = [axis for axis in long if names[axis] != "STOKES" and axes[axis] > 1]
    ranges = [
        f"1 to {axes[axis]}{f' along {names[axis]}' if names[axis] else f' along axis {axis}'}"
        for axis in asked
    ]
    example = "1" if len(asked) == 1 else f"[{', '.join('1' for _ in asked)}]"
    if wanted is None:
        if asked:
            more = (
                ""
                if all(names[axis] for axis in asked)
                else ", or CTYPE3 to STOKES if its planes are I, Q, U"
            )
            cure = f"set the operator's parameter plane: {example} ({', '.join(ranges)}){more}"
            raise InputError(f"the image is a cube of {sides} pixels", place=place, cure=cure)
        return {}
    numbered = next((counted for counted in (long, asked) if len(counted) == len(wanted)), None)
    if not numbered:
        cure = f"set plane: {example} ({', '.join(ranges)})" if asked else "remove plane"
        raise InputError(
            f"plane has {len(wanted)} numbers, and the image has {sides} pixels",
            place=place,
            cure=cure,
        )
    for axis, number in zip(numbered, wanted, strict=True):
        if not 1 <= number <= axes[axis]:
            where = f" along {names[axis]}" if names[axis] else ""
            raise InputError(
                f"there is no plane {number} of {axes[axis]}{where}",
                place=place,
                cure="planes are counted from 1",
            )
    return dict(zip(numbered, wanted, strict=True))


def _which(header: Any, axis: int, length: int, number: int) -> str:
    name, unit = (
        str(header.get(f"CTYPE{axis}", "")).strip(),
        str(header.get(f"CUNIT{axis}", "")).strip(),
    )
    text = f"{number} of {length}{f' along {name}' if name else ''}"
    try:
        step = header.get(f"CDELT{axis}", header.get(f"CD{axis}_{axis}"))
        value = float(header[f"CRVAL{axis}"]) + (
            number - float(header.get(f"CRPIX{axis}", 0.0))
        ) * float(step)
    except (KeyError, TypeError, ValueError):
        return text
    return f"{text}, at {value:.6g}{f' {unit}' if unit else ''}"
