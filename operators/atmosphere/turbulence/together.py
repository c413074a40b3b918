"""Layers that several bands see at the same points and times, evaluated once for all of them."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

from zonda.core.types import Floats

from .lines_of_sight import LinesOfSight
from .sampling import DriftingLayers

_Key = tuple[bytes, bytes, int, int]


class Layers(Protocol):
    """What evaluates the layers for one band, as `DriftingLayers` does."""

    @property
    def paths(self) -> dict[int, LinesOfSight]:
        """By step in time."""

    def __call__(self, xi: Floats, eta: Floats, first: int, count: int) -> tuple[Floats, Floats]:
        """The sum of the layers and the sine of the elevation."""


class Together:
    """`DriftingLayers` of several bands, which come one after the other. What one of them asks for is kept for those after it.

    Parameters
    ----------
    claim
        Tells whether so many bytes may be kept; a negative number gives back. Without room a band evaluates its own layers alone.
    """

    def __init__(self, layers: DriftingLayers, bands: int, claim: Callable[[int], bool]) -> None:
        self.layers, self._bands, self._claim = layers, bands, claim
        self._kept: dict[_Key, tuple[Floats, dict[int, Floats]]] = {}
        self._lock = threading.Lock()

    def of(self, band: int) -> OfBand:
        """The layers as one of the bands, by number, sees them."""
        return OfBand(self, band)

    def evaluate(self, band: int, xi: Floats, eta: Floats, first: int, count: int) -> tuple[Floats, Floats]:
        """As a call of `DriftingLayers`."""
        key = xi.tobytes(), eta.tobytes(), first, count
        size = 8 * len(xi) * count
        with self._lock:
            sine, sums = self._kept.get(key, (None, {}))
            if sine is not None and band in sums:
                total = sums.pop(band)
                if not sums:
                    del self._kept[key]
                self._claim(-size * (1 if sums else 2))
                return total, sine
        later = range(band + 1, self._bands) if sine is None else ()
        wanted = size * (len(later) + 1)  # the sine too
        if not later or not self._claim(wanted):
            totals, sine = self.layers.of_bands((band,), xi, eta, first, count)
            return totals[0], sine
        totals, sine = self.layers.of_bands((band, *later), xi, eta, first, count)
        with self._lock:
            if key in self._kept:  # another thread was quicker
                self._claim(-wanted)
            else:
                self._kept[key] = sine, {one: totals[k].copy() for k, one in enumerate(later, 1)}
        return totals[0], sine


class OfBand:
    """One band's view of `Together`."""

    def __init__(self, together: Together, band: int) -> None:
        self._together, self._band = together, band

    @property
    def paths(self) -> dict[int, LinesOfSight]:
        """By step in time."""
        return self._together.layers.paths

    def __call__(self, xi: Floats, eta: Floats, first: int, count: int) -> tuple[Floats, Floats]:
        """As of `DriftingLayers`."""
        return self._together.evaluate(self._band, xi, eta, first, count)
