"""`MapSums`: the partial product of a map, integer sums in pixels of two halves of the samples for
every signal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.maps.beams import Beams
from zonda.core.numerics.chunks import empty
from zonda.core.product import Product
from zonda.core.signal import MAIN
from zonda.core.types import Floats

from .binning import Binning
from .coverage import Coverage
from .intensity_kernel import FLAGGED, VALUE, WEIGHT, Sums

MOST = 2.0**62
"""Below what a sum must stay."""
JOINED = "the sum of the maps of all tasks"


class PixelSums(NamedTuple):
    """Sums of a signal in some pixels: ``hits`` (n,), ``weights`` (n, 1 or 6), ``data`` (n, 1 or
    3), ``noise`` (n, 1 or 6), equation (2) of `binning`.
    """

    hits: Sums
    weights: Sums
    data: Sums
    noise: Sums


class MapSums(Product):
    """Sums of two halves of the samples: of the even and of the odd observations, in their order,
    or of halves of each.

    Parameters
    ----------
    n_pixels
        Of the map.
    signals
        Streams of the signals, the complete one first; none where only the hits are wanted.
    polarized
        I, Q and U are wanted.
    scatter
        Each signal has noise of its own, from the scatter of its samples.
    of_scans
        The halves are the even and the odd observations.

    Attributes
    ----------
    sums
        (2, n_pixels, columns) of each half.
    columns
        Columns by name: the ``hits``, the ``weights`` (1 or 6), the ``data NAME`` of each signal
        (1 or 3), and the ``noise NAME`` (1 or 6) of each signal if ``scatter``, else of the first
        one for all; no such columns where the noise is that of the weights.
    scans, rates
        Names of the observations, and their sample rates, Hz.
    unknown_variance
        A scan's weights are uniform because every NET is zero.
    coverage
        Counts beside the means, and the hits of each observation.
    beams
        The detectors' beams, and what each weighs in the map.
    """

    def __init__(
        self,
        n_pixels: int,
        signals: Sequence[str],
        polarized: bool = False,
        scatter: bool = False,
        of_scans: bool = True,
    ) -> None:
        self.signals = tuple(signals)
        self.polarized, self.scatter, self.of_scans = polarized, scatter, of_scans
        self.scans: list[str] = []
        self.rates: set[float] = set()
        self.unknown_variance = False
        self.coverage = Coverage()
        self.beams = Beams()
        names = self.signals or (MAIN,)
        sizes = {"hits": 1, "weights": 6 if polarized else 1}
        sizes |= {f"data {name}": 3 if polarized else 1 for name in names}
        if not polarized:
            sizes |= {f"noise {name}": 1 for name in (names if scatter else names[:1])}
        ends = np.cumsum([0, *sizes.values()]).tolist()
        self.columns = {
            name: slice(*pair) for name, pair in zip(sizes, pairwise(ends), strict=True)
        }
        self.sums = zeros(n_pixels, ends[-1])
        self._rests: dict[str, Sequence[str]] = {}
        self._largest = np.zeros(2)
        self._deepest = [0, 0]

    @property
    def first(self) -> str:
        """The stream of the complete signal."""
        return self.signals[0] if self.signals else MAIN

    @property
    def hits(self) -> Sums:
        """(2, n_pixels) samples in each pixel."""
        return self.sums[:, :, 0]

    @property
    def own_noise(self) -> bool:
        """True if the noise is not that of the weights."""
        return f"noise {self.first}" in self.columns

    @property
    def halved(self) -> bool:
        """True if both halves have samples."""
        return len(self.scans) > 1 or not self.of_scans

    @property
    def _shift(self) -> int:
        """The half that the next observation begins with."""
        return len(self.scans) % 2 if self.of_scans else 0

    def add(
        self,
        observation: Observation,
        halves: Sequence[Sequence[Binning]],
        place: str,
    ) -> tuple[int, Sums]:
        """Add one observation, the binnings of either half of its samples or of all of them:
        (samples binned, dropped (4,)). Raises PipelineError where a sum may have overflowed.
        """
        inside, dropped = 0, np.zeros(4, np.int64)
        for k, half in enumerate(halves, start=self._shift):
            for n, binning in enumerate(half):
                if self.polarized and binning.own_noise:
                    self._with_noise()
                found = binning.columns((self.signals or (MAIN,))[binning.signals])
                shared = ("hits", "weights") if n else ()  # the first binning has them
                moves = [
                    (to, *source)
                    for name, sources in found.items()
                    if name in self.columns and name not in shared
                    for to, source in enumerate(sources, self.columns[name].start)
                ]
                moved, deepest, lost, largest = binning.move(self.sums[k], np.array(moves))
                if not n:
                    inside, dropped = inside + moved, dropped + lost
                self._note(k, deepest, largest)
        # what belongs to the other half counted as flagged
        dropped[FLAGGED] -= (len(halves) - 1) * observation.n_detectors * observation.n_samples
        self.scans.append(observation.name)
        self.rates.add(float(observation.sample_rate))
        self._check(f"{place}, {observation.name}")
        return inside, dropped

    def _with_noise(self) -> None:
        """Give the noise of polarized maps, which so far was that of the weights, columns of its
        own.
        """
        if not self.own_noise:
            _, n_pixels, end = self.sums.shape
            sums = zeros(n_pixels, end + 6)
            if self.scans:
                weights = self.sums[..., self.columns["weights"]]
                sums[..., :end], sums[..., end:] = self.sums, weights
            self.sums, self.columns[f"noise {self.first}"] = sums, slice(end, end + 6)

    def in_pixels(self, stream: str, pixels: slice, half: int | None = None) -> PixelSums:
        """Sums of a signal in some pixels; of one half, or of both together."""
        rows = self.sums[half or 0, pixels]
        if half is None and self.halved:
            rows = rows + self.sums[1, pixels]
        columns, (name, *parts) = self.columns, self._rests.get(stream, (stream,))
        data = rows[:, columns[f"data {name}"]]
        for part in parts:
            data = data - rows[:, columns[f"data {part}"]]
        weights = rows[:, columns["weights"]]
        noise = columns.get(f"noise {stream if self.scatter else self.first}", columns["weights"])
        return PixelSums(rows[:, 0], weights, data, rows[:, noise])

    def __iadd__(self, other: MapSums) -> MapSums:
        """Add sums whose scans follow those that are here: exact, so that their order does not
        matter but for which are even.
        """
        if self.polarized and (self.own_noise or other.own_noise):
            self._with_noise()
            other._with_noise()
        shift = self._shift
        for k in range(2):
            half, pixels = (k + shift) % 2, np.flatnonzero(other.hits[k])
            self.sums[half][pixels] += other.sums[k].take(pixels, axis=0)
            deepest = int(self.hits[half].take(pixels).max(initial=0))
            self._note(half, deepest, other._largest)
        self.scans += other.scans
        self.rates |= other.rates
        self.unknown_variance |= other.unknown_variance
        self.coverage += other.coverage
        self.beams += other.beams
        self.coverage.check(JOINED)
        self._check(JOINED)
        return self

    def arrays(self) -> dict[str, Any]:
        """Numbers of the pixels with hits, and their sums."""
        found = {
            "signals": [name for name in self.signals if name not in self._rests],
            "rests": {name: list(parts) for name, parts in self._rests.items()},
            "polarized": self.polarized,
            "scatter": self.scatter,
            "own_noise": self.own_noise,
            "of_scans": self.of_scans,
            "scans": list(self.scans),
            "rates": sorted(self.rates),
            "unknown_variance": self.unknown_variance,
            "n_pixels": self.sums.shape[1],
            "coverage": self.coverage.arrays(),
            "beams": [list(pair) for pair in sorted(self.beams.weights.items())],
            "largest": self._largest,
        }
        for k in range(2):
            pixels = np.flatnonzero(self.hits[k])
            found |= {f"pixels_{k}": pixels, f"sums_{k}": self.sums[k].take(pixels, axis=0)}
        return found

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> MapSums:
        """See `Product.of`."""
        flags = (bool(arrays[key]) for key in ("polarized", "scatter", "of_scans"))
        made = cls(int(arrays["n_pixels"]), list(arrays["signals"]), *flags)
        if arrays["own_noise"] and made.polarized:
            made._with_noise()
        for name, parts in arrays["rests"].items():
            made._rests[name] = parts
            made.signals += (name,)
        made.scans, made.rates = list(arrays["scans"]), {float(rate) for rate in arrays["rates"]}
        made.unknown_variance = bool(arrays["unknown_variance"])
        made.coverage = Coverage.of(arrays["coverage"], int(arrays["n_pixels"]))
        made.beams = Beams({float(fwhm): int(weight) for fwhm, weight in arrays["beams"]})
        for k in range(2):
            pixels, sums = arrays[f"pixels_{k}"], arrays[f"sums_{k}"]
            made.sums[k][pixels] = sums
            made._note(k, int(sums[:, 0].max(initial=0)), np.asarray(arrays["largest"]))
        return made

    def subtract(self, stream: str, parts: Sequence[str]) -> None:
        """See `Product.subtract`. The data are subtracted, exactly, when they are read."""
        self._rests[stream] = (self.first, *parts)
        self.signals += (stream,)
        self._check(stream, (len(parts) + 1) / 2)  # the first and one of them fit in 2^63

    def _note(self, half: int, deepest: int, largest: Floats) -> None:
        """Note the most samples in a pixel of a half, and the largest terms."""
        self._deepest[half] = max(self._deepest[half], deepest)
        self._largest = np.maximum(self._largest, largest)

    def _check(self, place: str, terms: float = 1.0) -> None:
        """Raise PipelineError where a sum, or ``terms`` sums of data together, may have
        overflowed.
        """
        largest = float(max(self._largest[0], terms * self._largest[1]))
        if sum(self._deepest) * largest < MOST:
            return
        deepest = float(self.hits.sum(axis=0).max(initial=0))
        if deepest * largest < MOST:
            return
        each = f"each up to {self._largest[1] / VALUE:.3g} K"
        cure = "make smaller pixels, or put a HighpassFilter before"
        if not self.scatter and self._largest[0] > terms * self._largest[1]:
            each = (
                f"with weights or variances up to {self._largest[0] / WEIGHT:.3g} times those of"
                " the first scan"
            )
            cure = "make smaller pixels, or a map of the detectors that are alike"
        raise PipelineError(
            f"{deepest:.0f} samples in one pixel, {each}, overflow the map's fixed-point sums",
            place=place,
            cure=cure,
        )


def zeros(n_pixels: int, columns: int) -> NDArray[np.int64]:
    """(2, n_pixels, columns) zeros that take no memory until they are written."""
    return empty((2 * n_pixels, columns), np.int64).reshape(2, n_pixels, columns)
