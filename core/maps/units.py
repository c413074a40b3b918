"""Units of maps of the sky, as headers write them and people type them; maps in other units, and
outputs of such maps.
"""

from __future__ import annotations

import math
import re
import unicodedata
from dataclasses import replace
from typing import Any, Self, TypeVar

from astropy.units import UnitBase
from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from ..configuration.diagnostics import input_error
from ..configuration.units import Unit, read_unit
from ..data import Data
from ..errors import InputError
from ..numerics.radiation import SURFACE_BRIGHTNESS_UNITS, to_kelvin_rj
from ..output import Output, output_folder
from ..types import Floats
from .map_arrays import MapArrays

Map = TypeVar("Map", bound=MapArrays)


def converted(product: Map, unit: str, spectral_index: float | None) -> Map:
    """`MapProduct.to`: values times K_RJ per old unit over K_RJ per new unit."""
    scale = scale_of(product.unit)[1] or "K_RJ"
    try:
        name = written_unit(str(unit), place="map.to", temperature_scale=scale)
    except InputError as err:
        cure = f"use {KNOWN_UNITS}, with a prefix where you like: mK_RJ"
        raise InputError(err.message, place="map.to", cure=cure) from None
    own = product.spectral_index or 0.0
    index = own if spectral_index is None else float(spectral_index)
    factor = _kelvin_per(product, product.unit, own) / _kelvin_per(product, name, index)
    planes = {key: plane.scaled(factor) for key, plane in product.planes.items()}
    plain, _ = parse_unit(name, place="map.to")
    stated = index if plain in SURFACE_BRIGHTNESS_UNITS else None
    return replace(product, unit=name, planes=planes, spectral_index=stated)


def _kelvin_per(product: MapArrays, unit: str, spectral_index: float) -> float | Floats:
    """K_RJ of one ``unit`` of a map; of Jy/pixel where pixels differ an array."""
    plain, prefix = parse_unit(unit, place="map")
    if plain == "K_RJ":
        return prefix
    if product.band is None:
        cure = (
            "convert a map that a run made, or give zonda.read_map(band=) or map.band a zonda.Band"
        )
        raise InputError(f"the band of the map is not known: no {unit}", place="map", cure=cure)
    if plain == "Jy/beam" and not product.resolution > 0:
        cure = "use MJy/sr, or set map.fwhm, the FWHM of its beam in radian"
        raise InputError(f"the beam of the map is not known: no {unit}", place="map", cure=cure)
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
                "the beam of the map is not known",
                place="map",
                cure="write map.smooth('9 arcsec')",
            )
        return beam
    return angle_of(given, "map.smooth('9 arcsec')")


def angle_of(given: Any, call: str) -> float:
    """Angle above 0 [rad] as text or quantity. Raises InputError for what is none; ``call``: how it
    is written.
    """
    place = call.partition("(")[0]
    cure = f"write {call}"
    try:
        angle = Unit("rad").parse(given)
    except PydanticCustomError as err:
        raise input_error(err, place, cure) from None
    if not angle > 0:
        raise InputError(f"{given} is no angle above 0", place=place, cure=cure)
    return angle


KNOWN_UNITS = "Jy/pixel, Jy/beam, MJy/sr, K_RJ, K_CMB or y (Compton-y)"
_PREFIXES = {"": 1.0, "n": 1e-9, "u": 1e-6, "m": 1e-3, "k": 1e3, "M": 1e6}
_OF_KELVIN = {prefix: size for prefix, size in _PREFIXES.items() if size <= 1}
_SCALES = {
    **dict.fromkeys(("rj", "rayleighjeans", "tb", "tmb", "trj"), "K_RJ"),
    **dict.fromkeys(("cmb", "thermo", "thermodynamic", "tcmb"), "K_CMB"),
}
"""Temperature scales without blanks and dashes; the main-beam temperature is that of a map."""
_COMPTON = re.compile(
    r"y|y[_ -]?sz|(y[_ -])?compton([_ -]?y)?|compton[_ -]?(y[_ -]?)?parameter",
    re.IGNORECASE,
)
_KELVIN = re.compile(
    r"(?-i:([num]|))(?:K|Kelvins?)[\s_,]*\(?\s*"
    r"(RJ|CMB|T_?CMB|T_?RJ|T_?M?B|Rayleigh[ -]Jeans|thermo(?:dynamic)?)?\s*\)?",
    re.IGNORECASE,
)
_POWER_OF_TEN = re.compile(
    r"(?:10\s*(?:\*\*|\^)\s*\(?([+-]?\d{1,2})\)?|10([+-]\d{1,2})"
    r"|((?:\d{1,9}(?:\.\d{0,18})?|\.\d{1,18})(?:E[+-]?\d{1,2})?))(?![\d.])",
    re.IGNORECASE,
)
"""A number before a unit: 10**-3, 10^(-3), 10-3 (FITS 4.0, section 4.3), 1e-3, 0.001."""
_WORDS = {
    **dict.fromkeys(("jy", "jansky", "janskys", "janskies"), "Jy"),
    **dict.fromkeys(("beam", "beams", "bm"), "beam"),
    **dict.fromkeys(("pixel", "pixels", "pix", "px"), "pix"),
    **dict.fromkeys(("sr", "ster", "steradian", "steradians"), "sr"),
    **dict.fromkeys(("arcsec", "asec", "arcsecond", "arcseconds"), "arcsec"),
    **dict.fromkeys(("arcmin", "amin", "arcminute", "arcminutes"), "arcmin"),
    **dict.fromkeys(("deg", "degree", "degrees"), "deg"),
}
"""Names of units, whatever their case, as astropy has them."""
_WORD = re.compile(
    rf"(sq(?:uare)?[\s._]*)?(?-i:([numkM]?))({'|'.join(_WORDS)})(?![a-z])",
    re.IGNORECASE,
)
_BASES = {"Jy/pixel": "Jy / pix", "Jy/beam": "Jy / beam", "MJy/sr": "MJy / sr"}


def parse_unit(text: str, *, place: str, temperature_scale: str | None = None) -> tuple[str, float]:
    """(unit, factor) with value * factor in ``unit``, one of `KNOWN_UNITS`: ``mK_CMB`` is ("K_CMB",
    1e-3), ``10**-3 beam-1 Jy`` ("Jy/beam", 1e-3), ``mJy/arcsec^2`` ("MJy/sr", 42.5).

    Intensities may be written in any way that astropy reads, names of units in any case.
    ``temperature_scale`` (the header key TEMPSCAL: K_RJ or K_CMB) tells what a plain kelvin is;
    K (Tb) and K (Tmb) are K_RJ. Raises InputError.
    """
    number, plain = _number_before(_plain(text))
    found: tuple[str, float] | None
    if _COMPTON.fullmatch(plain):
        found = "y", 1.0
    elif match := _KELVIN.fullmatch(plain):
        found = _scale(text, match[2] or temperature_scale, place), _PREFIXES[match[1]]
    else:
        found = _intensity(plain)
    if found is not None and 0 < (factor := number * found[1]) < math.inf:
        return found[0], factor
    cure = f"set the header key BUNIT or the operator's parameter unit to {KNOWN_UNITS}"
    if re.fullmatch(r".*\bT_?a\b.*", plain, re.IGNORECASE):
        cure = "divide the map by the main-beam efficiency (Tmb = Ta* / efficiency): K (Tmb)"
        raise InputError(f"'{text:.60}' is an antenna temperature", place=place, cure=cure)
    raise InputError(f"unknown unit '{text:.60}'", place=place, cure=cure)


def _scale(text: str, scale: str | None, place: str) -> str:
    """K_RJ or K_CMB of the unit ``text``. Raises InputError where it is neither, or not stated."""
    if scale is None or not scale.strip():
        raise InputError(
            f"the unit '{text}' does not say on which temperature scale",
            place=place,
            cure=(
                "set the header key TEMPSCAL to 'K_RJ' or 'K_CMB', or the parameter unit: K_RJ of"
                " the step that reads it"
            ),
        )
    known = _SCALES.get(re.sub(r"^k_?(?=rj|cmb)|[\s_-]", "", scale.strip().lower()))
    if known is None:
        raise InputError(
            f"unknown temperature scale TEMPSCAL = '{scale}'",
            place=place,
            cure="use K_RJ or K_CMB",
        )
    return known


def _plain(text: str) -> str:
    """The text with ASCII signs for micro, minus, dots, raised digits and brackets, without
    brackets around all of it; empty if it is too long for a unit."""
    powers = re.sub(r"([⁺⁻]?[⁰¹²³⁴-⁹]+)", r"^\1", text if len(text) < 100 else "")
    plain = unicodedata.normalize("NFKC", powers).translate(_SIGNS).strip()
    plain = re.sub(r"^\(([^()]*)\)$", r"\1", plain).strip()
    for prefix, words in (("u", "mu|micro"), ("m", "milli")):
        plain = re.sub(rf"\b(?:{words})(?=\s?(K|J))", prefix, plain, flags=re.IGNORECASE)
    return plain


_SIGNS = str.maketrans("μ−·⋅×{}[]", "u-..*()()")


def _number_before(text: str) -> tuple[float, str]:
    """A factor before a unit (1 without one), and the rest."""
    if (match := _POWER_OF_TEN.match(text)) is None:
        return 1.0, text
    power = match[1] or match[2]
    number = 10.0 ** int(power) if power else float(match[3])
    return number, text[match.end() :].lstrip(" *")


def _intensity(text: str) -> tuple[str, float] | None:
    """A unit of `_BASES` and the factor to it; None for a text that is none."""

    def known(word: re.Match[str]) -> str:
        square, prefix, name = word.groups()
        found = _WORDS[name.lower()]
        if prefix and found != "Jy":
            return word[0]
        return f" {prefix}{found}{'2 ' if square else ''}"

    first, *others = re.sub(r"\bper\b", "/", text).split("/")
    if len(others) > 1 and "(" not in text:  # astropy warns of several
        others = [f"({' '.join(others)})"]
    words = _WORD.sub(known, "/".join([first, *others]))
    words = re.sub(r"(Jy)\s*(beam|pix|sr)$", r"\1 / \2", words)  # "Jy beam"
    try:
        unit = read_unit(words)
        for name, base in _BASES.items():
            if isinstance(unit, UnitBase) and unit.is_equivalent(base):
                return name, float(unit.to(base))
    except (ValueError, ZeroDivisionError):
        pass
    return None


def written_unit(text: str, *, place: str, temperature_scale: str | None = None) -> str:
    """The unit as it is written in products: ``uK_CMB`` for ``uK (CMB)``, ``mJy/beam`` for ``10**-3
    beam-1 Jy``. Raises InputError as `parse_unit`.
    """
    unit, factor = parse_unit(text, place=place, temperature_scale=temperature_scale)
    plain, size = ("Jy/sr", factor * 1e6) if unit == "MJy/sr" else (unit, factor)
    prefixes = _PREFIXES if "Jy" in unit else {"": 1.0} if unit == "y" else _OF_KELVIN
    for prefix, value in prefixes.items():
        if math.isclose(size, value, rel_tol=1e-12):
            return prefix + plain
    return " ".join(text.split()) if "Jy" in unit else f"{factor:g} {unit}"


def scale_of(unit: str) -> tuple[str, str]:
    """A `written_unit` as FITS has it, and its temperature scale: ("uK", "K_CMB"); ("MJy/sr", "")
    where it has none.
    """
    plain, _, scale = unit.partition("_")
    return (plain, f"K_{scale}") if scale else (unit, "")


class MapOutput(Output):
    """An output of maps, in a unit of the user's choice."""

    unit: str | None = None
    """Unit of the maps: K_RJ, K_CMB, Jy/beam, Jy/pixel, MJy/sr or y (Compton-y), with a prefix
    (mJy/beam), at the centre of the band. The beam is the map's resolution, smoothing included.
    Default: that of the maps, K_RJ.
    """
    spectral_index: float = Field(0.0, ge=-100, le=100)
    """Slope of the flux density, S ~ frequency^index, within the band, for `unit` Jy/beam,
    Jy/pixel and MJy/sr.
    """

    @model_validator(mode="after")
    def _known_unit(self) -> Self:
        try:
            plain, _ = parse_unit(self.unit or "K_RJ", place="unit", temperature_scale="K_RJ")
        except InputError as error:
            raise ValueError(f"{error.message}; use {KNOWN_UNITS}") from None
        if self.spectral_index and plain not in SURFACE_BRIGHTNESS_UNITS:
            raise ValueError(f"spectral_index is for {', '.join(SURFACE_BRIGHTNESS_UNITS)}")
        return self

    def observe(self, data: Data) -> None:
        """Refuse a missing or unwritable output folder before anything is simulated."""
        output_folder(data, self.label)

    def in_unit(self, product: Map) -> Map:
        """The map in `unit`. Raises InputError where it cannot be converted."""
        if self.unit is None:
            return product
        try:
            return converted(product, self.unit, self.spectral_index)
        except InputError as error:
            raise InputError(error.message, place=self.label, cure=error.cure) from None
