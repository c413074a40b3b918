"""Numbers of a report as people read them."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

import numpy as np


def scaled(
    value: float, units: Sequence[tuple[float, str]], digits: int = 3, least: float = 1.0
) -> str:
    """``value`` in the first unit (factor, name) in which it is at least ``least``, else in the
    last.
    """
    factor, name = next((u for u in units if abs(value) * u[0] >= least), units[-1])
    return f"{value * factor:.{digits}g}{name}"


def spread(values: Any, unit: str = "") -> str:
    """One number where all are the same, else the range and the mean."""
    low, high = float(np.min(values)), float(np.max(values))
    same = math.isclose(low, high, rel_tol=1e-9)
    return (
        f"{low:.4g}{unit}"
        if same
        else f"{low:.4g} to {high:.4g}{unit}, mean {float(np.mean(values)):.4g}"
    )


def sexagesimal(ra: float, dec: float) -> str:
    """``02h32m11.00s −04°40′00.0″``, from rad."""
    seconds, arcseconds = (
        round(ra % (2 * math.pi) * 43200 / math.pi, 2) % 86400,
        round(abs(dec) * 648000 / math.pi, 1),
    )
    hours, degrees = (
        f"{seconds // 3600:02.0f}h{seconds % 3600 // 60:02.0f}m",
        f"{arcseconds // 3600:02.0f}°",
    )
    sign = "−" if dec < 0 else "+"
    return (
        f"{hours}{seconds % 60:05.2f}s"
        f" {sign}{degrees}{arcseconds % 3600 // 60:02.0f}′{arcseconds % 60:04.1f}″"
    )


_NUMBER = re.compile(r"([-+]?\d+\.?\d*(?:e[-+]?\d+)?) ([A-Za-z][A-Za-z0-9 /()]*)", re.IGNORECASE)
_UNITS = {
    "rad": [(180 / math.pi, "deg"), (10800 / math.pi, "arcmin"), (648000 / math.pi, "arcsec")],
    "rad / s": [
        (180 / math.pi, "deg/s"),
        (10800 / math.pi, "arcmin/s"),
        (648000 / math.pi, "arcsec/s"),
    ],
    "s": [(1 / 60, "min"), (1, "s"), (1e3, "ms")],
    "Hz": [(1e-9, "GHz"), (1e-3, "kHz"), (1, "Hz")],
    "m": [(1e-3, "km"), (1, "m"), (1e3, "mm")],
    "K": [(1, "K"), (1e3, "mK"), (1e6, "uK")],
    "K s(1/2)": [(1, "K s(1/2)"), (1e3, "mK s(1/2)"), (1e6, "uK s(1/2)")],
}


def readable(text: str) -> str:
    """``0.0011635528346628863 rad`` as ``4 arcmin``; other text as it is."""
    match = _NUMBER.fullmatch(text.strip())
    if match is None or match[2].strip() not in _UNITS:
        return text
    value, unit = float(match[1]), match[2].strip()
    if value == 0:
        return f"0 {unit.replace(' / ', '/')}"
    fitting = [(f, n) for f, n in _UNITS[unit] if abs(value) * f >= 0.9999995] or _UNITS[unit][-1:]
    factor, name = next(((f, n) for f, n in fitting if len(f"{value * f:.6g}") < 6), fitting[0])
    return f"{value * factor:.6g} {name}"
