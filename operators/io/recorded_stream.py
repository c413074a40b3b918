"""One stream of an open file, read in blocks, in kelvin."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.units import read_unit
from zonda.core.errors import InputError
from zonda.core.numerics.smooth import SmoothField
from zonda.core.numerics.tiles import TILE_DETECTORS
from zonda.core.types import Floats

if TYPE_CHECKING:
    from zonda.core.observation import Observation

STRETCHES, LENGTH = 5, 64
"""Parts of a scan, and samples of each, of which a detector's level is the median."""


@dataclass
class RecordedStream:
    """A stream of an open file.

    Attributes
    ----------
    file
        The reader (`save_tod.reader`).
    name
        Of the stream.
    rows
        (n_det,) rows of the file.
    mask
        Bits of the flags of a detector's samples that make one NaN.
    level
        (n_det,) K, constant, that stands beside the stream; ``mean``: the same as a field.
    """

    file: Any
    name: str
    rows: NDArray[np.intp]
    mask: np.uint8
    level: Floats = field(default_factory=lambda: np.zeros(0))
    mean: SmoothField = field(init=False)

    def __post_init__(self) -> None:
        self._factor = _kelvin(self.file.streams[self.name], self.name, self.file.place)

    def read(self, detectors: slice, samples: slice) -> tuple[Floats, int]:
        """(n, m) float64 K at absolute detectors and samples, NaN where the file flags one; how many these are."""
        rows = self.rows[detectors]
        values = np.array(self.file.read(self.name, rows, samples), np.float64)
        if self._factor != 1.0:
            values *= self._factor
        flagged = self.file.flags(rows, samples)
        if flagged is None:
            return values, 0
        bad = (flagged & self.mask) != 0
        values[bad] = np.nan
        return values, int(np.count_nonzero(bad & ~bad.all(axis=1, keepdims=True)))


def level_of(stream: RecordedStream, observation: Observation) -> Floats:
    """(n_det,) K, about the mean of each detector: the median of a few hundred finite samples, 0 where there is none.

    It depends on the file alone. Any number would do: it is subtracted in float64 and added again.
    """
    n, found = observation.n_samples, np.zeros(observation.n_detectors)
    begins = np.unique(np.linspace(0, max(n - LENGTH, 0), STRETCHES).astype(int))
    for first in range(0, len(found), TILE_DETECTORS):
        rows = slice(first, min(first + TILE_DETECTORS, len(found)))
        parts = np.hstack([stream.read(rows, slice(int(b), min(int(b) + LENGTH, n)))[0] for b in begins])
        for number, values in enumerate(parts, first):
            finite = values[np.isfinite(values)]
            found[number] = np.median(finite) if finite.size else 0.0
    return found


def _kelvin(unit: str, name: str, place: str) -> float:
    """Kelvin per unit of a stream."""
    kelvin = read_unit("K")
    measure = read_unit(unit.replace("K_RJ", "K")) if unit.strip() else None
    if measure is None or kelvin is None or measure.powers != kelvin.powers:
        cure = "calibrate it to a Rayleigh-Jeans temperature, and state its units, e.g. K"
        raise InputError(f"the stream {name} is in {unit or 'no unit'!r}, not in kelvin", place=place, cure=cure)
    return float(measure.factor)
