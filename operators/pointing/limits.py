"""Limits of a telescope: elevations, and speed, acceleration and jerk of its axes. Errors say what
would be possible.

What would make a scan fit is found by trying values of its own parameters on the scan itself.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Mapping
from contextlib import suppress
from typing import TypeVar

import numpy as np

from zonda.core.configuration.parameters import Parameters
from zonda.core.configuration.target import Target
from zonda.core.errors import PointingError
from zonda.core.instrument import Telescope
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.numerics.sphere import angles, unit_vectors
from zonda.core.plan.bounds import evenly
from zonda.core.types import Floats

from .motion import QUANTITIES, LargestDerivative, Quantity, rate_text

Scan = TypeVar("Scan", bound=Parameters)

DAY = 86400.0

STILL = 1e-9
"""An axis that is slower [rad/s^order] stands still: rounding, 0.2 mas/s."""


def check_elevation(
    what: str,
    horizontal: Floats,
    telescope: Telescope,
    place: str,
    cure: Callable[[], str],
    when: Callable[[int], str] = lambda row: "",
) -> None:
    """Raise PointingError where a direction (n, 3) of ``what`` lies outside the telescope's
    elevation limits. ``when``: the instant of a direction, in words.
    """
    if not len(horizontal):
        return
    rows = int(horizontal[:, 2].argmin()), int(horizontal[:, 2].argmax())
    _, elevation = angles(horizontal[[*rows]])
    low = telescope.elevation_min
    high = telescope.elevation_max
    under = low - elevation.min()
    over = elevation.max() - high
    if max(under, over) > 1e-9:
        reached, way = (elevation.min(), "down") if under > over else (elevation.max(), "up")
        where = f"goes {way} to elevation {np.degrees(reached):.2f} deg{when(rows[way == 'up'])}"
        limits = f"{telescope.name} reaches {_range(low, high)}"
        raise PointingError(f"{what} {where}; {limits}", place=place, cure=cure())


def when_up(
    horizontal: Floats,
    transform: CelestialTransform,
    target: Target,
    telescope: Telescope,
    total: float,
) -> str:
    """The cure for a scan outside the limits of elevation: when it would be within them.

    ``horizontal`` (n, 3): its directions. ``total`` [s]: how long all scans take.
    """
    low = telescope.elevation_min
    high = telescope.elevation_max
    if target.frame == "horizontal":
        return f"choose an elevation from {_range(low, high)}, with room for the scan"
    centre = unit_vectors(*target.icrs())
    site = transform.site
    start = transform.start
    samples = evenly(len(horizontal), 1000)
    step = transform.duration / max(len(horizontal) - 1, 1)
    _, along = angles(transform.horizontal(centre, samples.astype(np.float64) * step))
    below = along - angles(horizontal[samples])[1]  # how far the boresight is below its target
    seconds = np.arange(0.0, DAY + 1, 60.0)
    _, day = angles(CelestialTransform(site, start, DAY, 1e-6).horizontal(centre, seconds))
    least = low + max(float(below.max()), 0.0)
    most = high + min(float(below.min()), 0.0) if high < np.pi / 2 else np.pi
    within = (day >= least) & (day <= most)
    if not within.any():
        never = "is within the limits at no time of the next 24 h"
        if day.max() < least:
            highest = f"(highest {np.degrees(day.max()):.2f} deg)"
            never = f"never rises far enough above {np.degrees(low):g} deg {highest}"
        return f"at {site.name} it {never}: choose another target or site"
    edges = np.flatnonzero(np.diff(within, prepend=False, append=False)).reshape(-1, 2) - [0, 1]
    times = [[f"{start.shifted(seconds[k]).datetime:%Y-%m-%dT%H:%M:%SZ}" for k in e] for e in edges]
    spans = " and from ".join(map(" to ".join, times))
    need = f"{total / 60:.1f} min" if total < 7200 else f"{total / 3600:.1f} h"
    return f"within the next 24 h it is up (UTC) from {spans}: start then (the scans take {need})"


WORDS = {1: "speed", 2: "acceleration", 3: "jerk"}

LIMITS = {
    (axis, order): f"{axis}_{WORDS[order]}_max".removeprefix("sky_") for axis, order in QUANTITIES
}
"""Fields of a `Telescope`."""

SLOWER = "lower speed or acceleration, or set check_limits: warn"

STEPS = 2048
"""Of a factor of 1000, by which parameters are changed to find a scan that fits."""

ROUNDING = 1e-6
"""Share by which a figure may exceed its limit: a scan that was laid out to reach it exactly is
none too fast.
"""


def excess(
    found: dict[Quantity, LargestDerivative],
    limits: dict[Quantity, float],
) -> dict[Quantity, float]:
    """Factors > 1 by which limits are exceeded, the worst first."""
    ratio = {q: found[q].figure / limit for q, limit in limits.items() if q in found}
    over = {q: r for q, r in ratio.items() if r > 1 + ROUNDING}
    return dict(sorted(over.items(), key=lambda item: -(item[1] ** (1 / item[0][1]))))


class LargestMotion:
    """The largest speeds, accelerations and jerks of several scans, and the telescope's limits to
    them.
    """

    TOPICS = ("largest speed", "largest acceleration", "over the limit")
    """How its statements begin."""

    def __init__(self, telescope: Telescope) -> None:
        self.telescope = telescope
        self.limits = {
            q: limit
            for q, name in LIMITS.items()
            if (limit := getattr(telescope, name)) is not None
        }
        """Those that the telescope states, rad/s^order."""
        self._found: dict[Quantity, LargestDerivative] = {}
        self._where: dict[Quantity, str] = {}

    def add(
        self,
        name: str,
        found: dict[Quantity, LargestDerivative],
        place: str = "",
        cure: Callable[[dict[Quantity, float]], str] = lambda over: SLOWER,
    ) -> None:
        """Take a scan into account. Raises PointingError at ``place`` where it exceeds a limit;
        where that is empty, it is a warning.
        """
        over = excess(found, self.limits)
        if over and place:
            text = self.too_fast(next(iter(over)), found)
            raise PointingError(text, place=place, cure=cure(over))
        for q, peak in found.items():
            if q not in self._found or peak.figure > self._found[q].figure:
                self._found[q], self._where[q] = peak, name

    def too_fast(
        self,
        quantity: Quantity,
        found: dict[Quantity, LargestDerivative],
        name: str = "the scan",
    ) -> str:
        """The message about a limit that the scan exceeds."""
        (axis, order), peak, word = quantity, found[quantity], WORDS[quantity[1]]
        whose = f"{word} {'on the sky' if axis == 'sky' else f'of the {axis} axis'}"
        reaches = f"{'an' if order == 2 else 'a'} {whose} of {rate_text(peak.figure, order)}"
        where = (
            f"{peak.second:.4g} s after its start, at elevation"
            f" {np.degrees(peak.elevation):.2f} deg"
        )
        limit = f"{self.telescope.name}'s largest {whose} is"
        return (
            f"{name} reaches {reaches} ({where}); {limit} {rate_text(self.limits[quantity], order)}"
        )

    def warnings(self) -> list[str]:
        """Each limit that is exceeded (with ``check_limits: warn``)."""
        return [
            self.too_fast(q, self._found, self._where[q]) for q in excess(self._found, self.limits)
        ]

    def statements(self) -> list[tuple[str, str]]:
        """(what, text) for the log."""
        said = []
        for order in (1, 2):
            parts = []
            for axis in ("azimuth", "elevation", "sky"):
                peak = self._found.get((axis, order))
                limit = self.limits.get((axis, order))
                if peak is not None and (limit or axis != "sky"):
                    figure = peak.figure if peak.figure > STILL else 0.0
                    share = (
                        limit and f" ({100 * figure / limit:.3g} % of {rate_text(limit, order)})"
                    )
                    parts.append(f"{axis} {rate_text(figure, order)}{share or ''}")
            if parts:
                none = "" if self.limits else f"; {self.telescope.name} states no limits"
                said.append((f"largest {WORDS[order]} of the axes", ", ".join(parts) + none))
        over = (
            f"over the limit of {axis} {WORDS[order]} (check_limits: warn)"
            for axis, order in excess(self._found, self.limits)
        )
        return [*said, *zip(over, self.warnings(), strict=True)]


def _range(low: float, high: float) -> str:
    return f"{np.degrees(low):g} deg to {np.degrees(high):g} deg"


def what_fits(
    scan: Scan,
    slows: Mapping[str, tuple[int, int]],
    found: Mapping[Quantity, LargestDerivative],
    over: Mapping[Quantity, float],
    fits: Callable[[Scan], bool],
) -> str:
    """The cure of a scan that is too fast: values of its parameters ``slows`` (`Pointing.slows`) at
    which it exceeds no limit.

    ``found`` are its largest derivatives, ``over`` those beyond their limits (`limits.excess`).
    """
    alone = [{name: by} for name, by in slows.items()]
    cures = [text for some in alone if (text := _slower(scan, some, fits))]
    cures = cures or [text for text in [_slower(scan, slows, fits)] if text]
    # the azimuth axis turns by 1 / cos(elevation)
    cosine = max(r * math.cos(found[q].elevation) for q, r in over.items())
    if all(axis == "azimuth" for axis, _ in over) and cosine < 0.99:
        cures.append(
            f"an elevation below {math.floor(10 * math.degrees(math.acos(cosine))) / 10:g} deg"
        )
    other = "scan more slowly, or in larger curves" if slows else "choose another target or time"
    fitting = f"this would fit: {', or '.join(cures)}" if cures else other
    return f"{fitting} (check_limits: warn simulates it as it is)"


def _slower(scan: Scan, slows: Mapping[str, tuple[int, int]], fits: Callable[[Scan], bool]) -> str:
    """Parameters with values, all changed by one factor (at most 1000), at which the scan fits;
    empty where none does.
    """

    def values(step: int) -> dict[str, float]:
        found = {}
        for name, (sign, _) in slows.items():
            factor = 10.0 ** (3 * sign * step / STEPS)
            value = math.degrees(getattr(scan, name)) * 3600 * factor
            unit = 10.0 ** (math.floor(math.log10(value)) - 2)  # three digits, on the safe side
            rounded = (math.floor if sign < 0 else math.ceil)(value / unit) * unit
            found[name] = math.radians(rounded / 3600)
        return found

    def good(step: int) -> bool | None:
        """True if the scan fits, None for values that are too far to be allowed."""
        tried = values(step)
        for name, value in tried.items():
            for limit in type(scan).model_fields[name].metadata:
                if value > getattr(limit, "le", math.inf):
                    return None
        with suppress(PointingError):  # e.g. turnarounds so long that they reach round the sky
            return fits(scan.model_copy(update=tried))
        return None

    enough = bisect_left(range(STEPS), True, 1, key=lambda step: good(step) is not False)
    if not slows or not good(enough):
        return ""
    return " with ".join(
        f"{name} {rate_text(value, slows[name][1])}" for name, value in values(enough).items()
    )
