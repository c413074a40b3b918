"""What would make a scan fit its telescope: values of its own parameters, each tried on the scan itself."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TypeVar

from zonda.core.configuration.parameters import Parameters
from zonda.core.errors import PointingError

from .limits import lower_elevation
from .motion import LargestDerivative, Quantity, rate_text

Scan = TypeVar("Scan", bound=Parameters)


def what_fits(
    scan: Scan,
    slows: Mapping[str, tuple[int, int]],
    found: Mapping[Quantity, LargestDerivative],
    over: Mapping[Quantity, float],
    fits: Callable[[Scan], bool],
) -> str:
    """The cure of a scan that is too fast: values of its parameters ``slows`` (`Pointing.slows`) at which it exceeds no limit.

    ``found`` are its largest derivatives, ``over`` those beyond their limits (`limits.excess`).
    """
    alone = [_slower(scan, {name: slows[name]}, fits) for name in slows]
    cures = [text for text in alone if text] or [text for text in (_slower(scan, slows, fits),) if text]
    if (elevation := lower_elevation(found, over)) is not None:
        cures.append(f"an elevation below {math.floor(10 * math.degrees(elevation)) / 10:g} deg")
    other = "scan more slowly, or in larger curves" if slows else "choose another target or time"
    fitting = f"this would fit: {', or '.join(cures)}" if cures else other
    return f"{fitting} (check_limits: warn simulates it as it is)"


def _slower(scan: Scan, slows: Mapping[str, tuple[int, int]], fits: Callable[[Scan], bool]) -> str:
    """Parameters with values, all changed by one factor (at most 1000), at which the scan fits; empty where none does."""

    def values(share: float) -> dict[str, float]:
        found = {}
        for name, (sign, _) in slows.items():
            value = math.degrees(getattr(scan, name)) * 3600 * 10.0 ** (3 * share * sign)
            unit = 10.0 ** (math.floor(math.log10(value)) - 2)  # three digits, on the safe side
            found[name] = math.radians((math.floor if sign < 0 else math.ceil)(value / unit) * unit / 3600)
        return found

    def allowed(name: str, value: float) -> bool:
        return all(value <= getattr(m, "le", math.inf) for m in type(scan).model_fields[name].metadata)

    def good(share: float) -> bool:
        tried = values(share)
        with suppress(PointingError):  # e.g. turnarounds so long that they reach round the sky
            return all(allowed(*item) for item in tried.items()) and fits(scan.model_copy(update=tried))
        return False

    enough = next((share for share in (1 / 8, 1 / 4, 1 / 2, 1.0) if slows and good(share)), None)
    if enough is None:
        return ""
    too_little = 0.0
    for _ in range(8):
        middle = (enough + too_little) / 2
        enough, too_little = (middle, too_little) if good(middle) else (enough, middle)
    return " with ".join(f"{name} {rate_text(value, slows[name][1])}" for name, value in values(enough).items())
