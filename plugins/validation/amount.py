"""Numbers with units as a claims file writes them: ``148 uK``, ``69 m``, ``13.97 uJy``, ``0.5``."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Any

from zonda.core.configuration.diagnostics import TextValue, mistake
from zonda.core.configuration.units import read_unit

FURTHER = ("", "sigma", "samples")
"""Units of counts, which astropy does not know."""

_TEXT = re.compile(r"\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*(.*?)\s*$", re.DOTALL)


@dataclass(frozen=True)
class Amount(TextValue):
    """A number and its unit.

    Attributes
    ----------
    value
        In SI.
    unit, factor
        The unit it was written in, and that in SI.
    """

    value: float
    unit: str = ""
    factor: float = 1.0

    @classmethod
    def parse(cls, value: Any) -> Amount:
        """From text, a number without a unit, or an amount."""
        if isinstance(value, Amount):
            return value
        match = None if isinstance(value, bool) else _TEXT.match(str(value))
        if not match:
            raise mistake(f"expected a number and its unit such as '148 uK', got {value!r:.60}")
        unit = match[2]
        try:
            factor = 1.0 if unit in FURTHER else float(read_unit(unit).si.scale)
        except ValueError:
            known = ", ".join(filter(None, FURTHER))
            raise mistake(
                f"unknown unit '{unit}'", help=f"a unit that astropy reads, or one of: {known}"
            ) from None
        return cls(float(match[1]) * factor, unit, factor)

    def write(self, value: float, digits: int = 4) -> str:
        """``value`` (SI) as a number in this unit."""
        return "" if math.isnan(value) else f"{value / self.factor:.{digits}g}"

    def __str__(self) -> str:
        return f"{self.value / self.factor:.10g} {self.unit}".strip()
