"""`PixelSums`: what the partial products of all maps have in common."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.maps.beams import Beams
from zonda.core.numerics.chunks import empty
from zonda.core.product import Product

from .coverage import Coverage
from .sums import FLAGGED, VALUE, Sums

MOST = 2.0**62
"""Below what a sum must stay."""


class PixelSums(Product):
    """Sums of two halves of the samples: of the even and of the odd observations, in their order,
    or of halves of each.

    Attributes
    ----------
    signals
        Streams of the signals, the complete one first.
    of_scans
        Whether the halves are the even and the odd observations.
    scans, rates
        Names of the observations, and their sample rates, Hz.
    unknown_variance
        A scan's weights are uniform because every NET is zero.
    coverage
        Counts beside the means, and the hits of each observation.
    beams
        The detectors' beams, and what each weighs in the map.
    """

    def __init__(self, signals: Sequence[str], of_scans: bool) -> None:
        self.signals = tuple(signals)
        self.of_scans = of_scans
        self.scans: list[str] = []
        self.rates: set[float] = set()
        self.unknown_variance = False
        self.coverage = Coverage()
        self.beams = Beams()

    @property
    @abstractmethod
    def hits(self) -> Sums:
        """(2, n_pixels) samples in each pixel."""

    @property
    def shift(self) -> int:
        """The half that the next observation begins with."""
        return len(self.scans) % 2 if self.of_scans else 0

    def _added(self, observation: Observation, halves: int, dropped: Sums) -> None:
        """Note an observation that was added in so many halves."""
        # what belongs to the other half counted as flagged
        dropped[FLAGGED] -= (halves - 1) * observation.n_detectors * observation.n_samples
        self.scans.append(observation.name)
        self.rates.add(float(observation.sample_rate))

    def _joined(self, other: Self) -> None:
        """Note the observations of ``other``, which were added."""
        self.scans += other.scans
        self.rates |= other.rates
        self.unknown_variance |= other.unknown_variance
        self.coverage += other.coverage
        self.beams += other.beams
        self.coverage.check("the sum of the maps of all tasks")

    def _about(self) -> dict[str, Any]:
        """What `_with_about` takes."""
        return {
            "signals": list(self.signals),
            "of_scans": self.of_scans,
            "scans": list(self.scans),
            "rates": sorted(self.rates),
            "unknown_variance": self.unknown_variance,
            "n_pixels": self.hits.shape[1],
            "coverage": self.coverage.arrays(),
            "beams": [list(pair) for pair in sorted(self.beams.weights.items())],
        }

    def _with_about(self, arrays: Mapping[str, Any]) -> Self:
        self.scans, self.rates = list(arrays["scans"]), {float(rate) for rate in arrays["rates"]}
        self.unknown_variance = bool(arrays["unknown_variance"])
        self.coverage = Coverage.of(arrays["coverage"], int(arrays["n_pixels"]))
        self.beams = Beams({float(fwhm): int(weight) for fwhm, weight in arrays["beams"]})
        return self

    def _refuse_overflow(self, largest: float, highest: float, place: str) -> None:
        """Raise PipelineError where a sum may have overflowed: ``largest`` term of any, ``highest``
        of those of the data.
        """
        deepest = float(self.hits.sum(axis=0).max(initial=0))
        if deepest * largest >= MOST:
            raise PipelineError(
                f"{deepest:.0f} samples in one pixel, each up to {highest / VALUE:.3g} K, overflow"
                " the map's fixed-point sums",
                place=place,
                cure="make smaller pixels, or put a HighpassFilter before",
            )


def zeros(n_pixels: int, columns: int) -> NDArray[np.int64]:
    """(2, n_pixels, columns) zeros that take no memory until they are written."""
    return empty((2 * n_pixels, columns), np.int64).reshape(2, n_pixels, columns)
