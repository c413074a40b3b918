"""Units of maps of the sky, as headers write them and as people type them."""

from __future__ import annotations

import re

from ..errors import InputError

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
