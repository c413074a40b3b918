"""Maps in other units, and widths to smooth them with."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any, TypeVar

from pydantic_core import PydanticCustomError

from ..configuration.units import Unit
from ..errors import InputError
from ..numerics.radiation import SURFACE_BRIGHTNESS_UNITS, to_kelvin_rj
from ..types import Floats
from .map_arrays import MapArrays
from .units import KNOWN_UNITS, parse_unit, scale_of, written_unit

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
