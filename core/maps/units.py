"""Units of maps of the sky, as headers write them and people type them; maps in other units."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from typing import Any, TypeVar

from pydantic_core import PydanticCustomError

from ..configuration.units import Unit
from ..errors import InputError
from ..numerics.radiation import SURFACE_BRIGHTNESS_UNITS, to_kelvin_rj
from ..types import Floats
from .map_arrays import MapArrays

Map = TypeVar("Map", bound=MapArrays)


def converted(product: Map, unit: str, spectral_index: float) -> Map:
    """`MapProduct.to`: values times K_RJ per old unit over K_RJ per new unit."""
    scale = scale_of(product.unit)[1] or "K_RJ"
    try:
        name = written_unit(str(unit), place="map.to", temperature_scale=scale)
    except InputError as err:
        cure = f"use {KNOWN_UNITS}, with a prefix where you like: mK_RJ"
        raise InputError(err.message, place="map.to", cure=cure) from None
    factor = _kelvin_per(product, product.unit, spectral_index) / _kelvin_per(
        product, name, spectral_index
    )
    planes = {key: plane.scaled(factor) for key, plane in product.planes.items()}
    return replace(product, unit=name, planes=planes)


def _kelvin_per(product: MapArrays, unit: str, spectral_index: float) -> float | Floats:
    """K_RJ of one ``unit`` of a map; of Jy/pixel where pixels differ an array."""
    plain, prefix = parse_unit(unit, place="map")
    if plain == "K_RJ":
        return prefix
    if product.band is None:
        cure = "convert a map that a run made, or set map.band = zonda.Band(...)"
        raise InputError(f"the band of the map is not known: no {unit}", place="map", cure=cure)
    beam = math.pi / (4 * math.log(2)) * product.resolution**2 if plain == "Jy/beam" else None
    index = spectral_index if plain in SURFACE_BRIGHTNESS_UNITS else 0.0
    return (
        to_kelvin_rj(plain, product.band, 1.0, index, beam)
        * prefix
        / (product.areas() if plain == "Jy/pixel" else 1.0)
    )


def smoothing_width(given: Any, beam: float) -> float:
    """FWHM [rad] as text or quantity; None: the ``beam``. Raises InputError for what is none."""
    if given is None:
        if not beam > 0:
            raise InputError(
                "the beam of the map is not known", place="map", cure="write map.smooth('9 arcsec')"
            )
        return beam
    try:
        width = Unit("rad").parse(given)
    except PydanticCustomError as err:
        raise InputError(
            err.message(), place="map.smooth", cure="write map.smooth('9 arcsec')"
        ) from None
    if not width > 0:
        raise InputError(
            f"{given} cannot be the width of a smoothing",
            place="map.smooth",
            cure="write map.smooth('9 arcsec')",
        )
    return width


KNOWN_UNITS = "Jy/pixel, Jy/beam, MJy/sr, K_RJ, K_CMB or y (Compton-y)"
_PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6}
_PER = {
    "pixel": "Jy/pixel",
    "pix": "Jy/pixel",
    "px": "Jy/pixel",
    "beam": "Jy/beam",
    "bm": "Jy/beam",
    "sr": "MJy/sr",
}
_SCALES = {
    "k_rj": "K_RJ",
    "rj": "K_RJ",
    "rayleigh-jeans": "K_RJ",
    "k_cmb": "K_CMB",
    "cmb": "K_CMB",
    "thermodynamic": "K_CMB",
}


def parse_unit(text: str, *, place: str, temperature_scale: str | None = None) -> tuple[str, float]:
    """(unit, factor) with value * factor in ``unit``, one of `KNOWN_UNITS`: ``mK_CMB`` is ("K_CMB",
    1e-3).

    ``temperature_scale`` (the header key TEMPSCAL: K_RJ or K_CMB) tells what a plain kelvin is.
    Raises InputError.
    """
    plain = text.strip().replace("\N{MICRO SIGN}", "u").replace("\N{GREEK SMALL LETTER MU}", "u")
    if re.fullmatch(
        r"(y|y[_ -]?sz|(y[_ -])?compton([_ -]?y)?|compton[_ -]?(y[_ -]?)?parameter)",
        plain,
        re.IGNORECASE,
    ):
        return "y", 1.0
    match = re.fullmatch(
        r"(?-i:([num]?))(?:K|Kelvin)\s*[_ ]?\s*\(?(RJ|CMB|thermodynamic)?\)?", plain, re.IGNORECASE
    )
    if match and match[1] in _PREFIXES:
        scale = match[2] or temperature_scale
        if scale is None or not scale.strip():
            raise InputError(
                f"the unit '{text}' does not say on which temperature scale",
                place=place,
                cure=(
                    "set the header key TEMPSCAL to 'K_RJ' or 'K_CMB', or the operator's parameter"
                    " unit: K_RJ"
                ),
            )
        if scale.strip().lower() not in _SCALES:
            raise InputError(
                f"unknown temperature scale TEMPSCAL = '{scale}'",
                place=place,
                cure="use K_RJ or K_CMB",
            )
        return _SCALES[scale.strip().lower()], _PREFIXES[match[1]]
    match = re.fullmatch(
        r"(?-i:([numkM]?))Jy\s*(?:/|\s|\*|\.)?\s*(pixel|pix|px|beam|bm|sr)"
        r"\s*(?:(?:\^|\*\*)?\(?-1\)?)?",
        plain,
        re.IGNORECASE,
    )
    if match and match[1] in _PREFIXES:
        unit = _PER[match[2].lower()]
        return unit, _PREFIXES[match[1]] * (1e-6 if unit == "MJy/sr" else 1.0)
    raise InputError(
        f"unknown unit '{text}'",
        place=place,
        cure=f"set the header key BUNIT or the operator's parameter unit to {KNOWN_UNITS}",
    )


def written_unit(text: str, *, place: str, temperature_scale: str | None = None) -> str:
    """The unit as it is written in products: ``uK_CMB`` for ``uK (CMB)``. Raises InputError as
    `parse_unit`.
    """
    unit, factor = parse_unit(text, place=place, temperature_scale=temperature_scale)
    if unit in ("K_RJ", "K_CMB"):
        return next(prefix for prefix, size in _PREFIXES.items() if size == factor) + unit
    return unit if factor == 1.0 else "".join(text.split())


def scale_of(unit: str) -> tuple[str, str]:
    """A `written_unit` as FITS has it, and its temperature scale: ("uK", "K_CMB"); ("MJy/sr", "")
    where it has none.
    """
    plain, _, scale = unit.partition("_")
    return (plain, f"K_{scale}") if scale else (unit, "")
