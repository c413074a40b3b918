"""Depths and times as text with units, and back."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping

from zonda.core.errors import InputError

PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "": 1.0, "k": 1e3}
ALIASES = {"K": "K_RJ"}
_DEPTH = re.compile(
    r"\s*(?P<number>[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(?P<unit>[^\s\d.]\S*)?\s*"
)


def read_depth(text: str, factors: Mapping[str, float]) -> float:
    """A depth such as ``10 uK``, ``10 uK_CMB``, ``0.2 mJy/beam``, ``3 kJy/sr``, ``0.1 mJy`` (a
    point source) in K_RJ.

    Raises InputError.
    """
    cure = (
        "write e.g. '10 uK', '10 uK_CMB', '0.2 mJy/beam', '0.01 MJy/sr', or '0.1 mJy' of a point"
        " source"
    )
    match = _DEPTH.fullmatch(text)
    if match is None:
        raise InputError(f"cannot read '{text}' as a depth", place="--reach", cure=cure)
    if match["unit"] is None:
        raise InputError(f"{text.strip()} has no unit", place="--reach", cure=cure)
    units = {**ALIASES, **{unit: unit for unit in factors}}
    known = {
        prefix + name: (size, units[name])
        for name in units
        for prefix, size in PREFIXES.items()
        if "MJy" not in name
    }
    known |= {"MJy/sr": (1.0, "MJy/sr"), "kJy/sr": (1e-3, "MJy/sr"), "Jy/sr": (1e-6, "MJy/sr")}
    if match["unit"] not in known:
        raise InputError(f"'{match['unit']}' is no unit of a depth", place="--reach", cure=cure)
    size, unit = known[match["unit"]]
    value = float(match["number"]) * size / factors[unit]
    if not (math.isfinite(value) and value > 0):
        raise InputError(
            f"no observation reaches a depth of {text}",
            place="--reach",
            cure="give a positive depth",
        )
    return value


def prefixed(value: float, unit: str) -> tuple[float, str]:
    """Factor and name of the unit in which a value reads well: 1e6, ``uK_RJ``."""
    if unit == "MJy/sr":
        return next(
            (
                (f, n)
                for least, f, n in ((0.1, 1.0, "MJy/sr"), (1e-4, 1e3, "kJy/sr"))
                if abs(value) >= least
            ),
            (1e6, "Jy/sr"),
        )
    for factor, prefix in ((1.0, ""), (1e3, "m"), (1e6, "u")):
        if abs(value) * factor >= 1:
            return factor, prefix + unit
    return (1e6, f"u{unit}") if abs(value) >= 1e-8 or value == 0 else (1e9, f"n{unit}")


def number(value: float) -> str:
    """Three digits, without an exponent where it is large."""
    return f"{value:.0f}" if abs(value) >= 1000 else f"{value:.3g}"


def in_unit(value: float, unit: str) -> str:
    """``158 uK_RJ``."""
    factor, name = prefixed(value, unit)
    return f"{number(value * factor)} {name}"


def duration(seconds: float) -> str:
    """``8.6 min``, ``1 h``, ``20 s``."""
    for size, name in ((3600.0, "h"), (60.0, "min")):
        if seconds >= size * (1 - 1e-9):
            return f"{seconds / size:.4g} {name}"
    return f"{seconds:.3g} s"
