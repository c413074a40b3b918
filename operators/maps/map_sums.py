"""`MapSums`: the partial product of a map, integer sums in pixels of two halves of the samples for
every signal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.maps.beams import Beams
from zonda.core.numerics.chunks import empty
from zonda.core.product import Product
from zonda.core.signal import MAIN

from .binning import Binning
from .coverage import Coverage
from .sums import FLAGGED, VALUE, Sums

MOST = 2.0**62
"""Below what a sum must stay."""
JOINED = "the sum of the maps of all tasks"


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
    table
        (2, n_pixels, 2 or 7): hits, and the weights of all signals.
    right
        (2, n_pixels, 1 or 3) sums of w d of each signal.
    noise
        (2, n_pixels, 1 or 6) by stream, of signals with noise of their own; under the name of the
        first signal that of all, where it is not that of the weights.
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
        own = self.signals or (MAIN,)
        self.table = zeros(n_pixels, 7 if polarized else 2)
        self.right = {name: zeros(n_pixels, 3 if polarized else 1) for name in own}
        noisy = () if polarized else own if scatter else own[:1]
        self.noise = {name: zeros(n_pixels, 1) for name in noisy}
        self._largest = 0.0
        self._largest_of = dict.fromkeys(own, 0.0)
        self._deepest = [0, 0]

    @property
    def first(self) -> str:
        """The stream of the complete signal."""
        return self.signals[0] if self.signals else MAIN

    @property
    def hits(self) -> Sums:
        """(2, n_pixels) samples in each pixel."""
        return self.table[:, :, 0]

    @property
    def halved(self) -> bool:
        """True if both halves have samples."""
        return len(self.scans) > 1 or not self.of_scans

    @property
    def _shift(self) -> int:
        """The half that the next observation begins with."""
        return len(self.scans) % 2 if self.of_scans else 0

    @property
    def _tables(self) -> dict[str, Sums]:
        """Sums by their names in files, (2, n_pixels, columns) each."""
        found = {"table": self.table}
        for k, name in enumerate(self.right):
            found |= {
                f"{what}_{k}": tables[name]
                for what, tables in (("right", self.right), ("noise", self.noise))
                if name in tables
            }
        return found

    def add(
        self, observation: Observation, halves: Sequence[Sequence[Binning]], place: str
    ) -> tuple[int, Sums]:
        """Add one observation, the binnings of either half of its samples or of all of them:
        (samples binned, dropped (4,)). Raises PipelineError where a sum may have overflowed.
        """
        inside, dropped = 0, np.zeros(4, np.int64)
        for k, half in enumerate(halves, start=self._shift):
            names = list(self.right)
            for n, binning in enumerate(half):
                if self.polarized and binning.own:
                    self._with_noise()
                own, names = names[: binning.signals], names[binning.signals :]
                threads, most = len(binning.parts), 0
                for found in binning.folded():
                    if not n:
                        self.table[k, found.pixels, 0] += found.hits
                        self.table[k, found.pixels, 1:] += found.weights
                        inside, dropped = inside + int(found.hits.sum()), dropped + found.dropped
                    for name, right in zip(own, found.right, strict=True):
                        self.right[name][k][found.pixels] += right
                    if own[0] in self.noise:
                        noise = found.weights if found.noise is None else found.noise
                        self.noise[own[0]][k][found.pixels] += noise
                    most = max(most, int(found.hits.max(initial=0)))
                    high, every = found.largest
                    self._note(k, 0, high, dict(zip(own, every, strict=True)))
                if not n:  # each thread may have its most in the same pixel
                    self._note(k, self._deepest[k] + threads * most, 0.0, {})
        # what belongs to the other half counted as flagged
        dropped[FLAGGED] -= (len(halves) - 1) * observation.n_detectors * observation.n_samples
        self.scans.append(observation.name)
        self.rates.add(float(observation.sample_rate))
        self._check(f"{place}, {observation.name}")
        return inside, dropped

    def _with_noise(self) -> None:
        """Keep the noise of polarized maps, which so far was that of the weights."""
        if not self.noise:
            self.noise[self.first] = self.table[..., 1:].copy()

    def parts(
        self, stream: str, pixels: slice, half: int | None = None
    ) -> tuple[Sums, Sums, Sums, Sums]:
        """Hits (n,), weights (n, 1 or 6), right sides (n, 1 or 3) and noise (n, 1 or 6) of a signal
        in some pixels; of one half, or of both together.
        """

        def of(table: Sums) -> Sums:
            if half is not None or not self.halved:
                return table[half or 0, pixels]
            return np.asarray(table[0, pixels] + table[1, pixels])

        table = of(self.table)
        noise = self.noise.get(stream if self.scatter else self.first)
        weights = table[:, 1:]
        return table[:, 0], weights, of(self.right[stream]), weights if noise is None else of(noise)

    def __iadd__(self, other: MapSums) -> MapSums:
        """Add sums whose scans follow those that are here: exact, so that their order does not
        matter but for which are even.
        """
        if self.polarized and (self.noise or other.noise):
            self._with_noise()
            other._with_noise()
        theirs, shift = other._tables, self._shift
        for k in range(2):
            half, pixels = (k + shift) % 2, np.flatnonzero(other.hits[k])
            for name, table in self._tables.items():
                table[half][pixels] += theirs[name][k].take(pixels, axis=0)
            deepest = int(self.hits[half].take(pixels).max(initial=0))
            self._note(half, deepest, other._largest, other._largest_of)
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
            "signals": list(self.signals),
            "polarized": self.polarized,
            "scatter": self.scatter,
            "own_noise": bool(self.noise),
            "of_scans": self.of_scans,
            "scans": list(self.scans),
            "rates": sorted(self.rates),
            "unknown_variance": self.unknown_variance,
            "n_pixels": self.table.shape[1],
            "coverage": self.coverage.arrays(),
            "beams": [list(pair) for pair in sorted(self.beams.weights.items())],
            "largest": self._largest,
            "largest_of": dict(self._largest_of),
        }
        for k in range(2):
            pixels = np.flatnonzero(self.hits[k])
            found[f"pixels_{k}"] = pixels
            for name, table in self._tables.items():
                found[f"{name}_of_{k}"] = table[k].take(pixels, axis=0)
        return found

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> MapSums:
        """See `Product.of`."""
        flags = (bool(arrays[key]) for key in ("polarized", "scatter", "of_scans"))
        made = cls(int(arrays["n_pixels"]), list(arrays["signals"]), *flags)
        if arrays["own_noise"] and made.polarized:
            made._with_noise()
        made.scans, made.rates = list(arrays["scans"]), {float(rate) for rate in arrays["rates"]}
        made.unknown_variance = bool(arrays["unknown_variance"])
        made.coverage = Coverage.of(arrays["coverage"], int(arrays["n_pixels"]))
        made.beams = Beams({float(fwhm): int(weight) for fwhm, weight in arrays["beams"]})
        highest = {name: float(high) for name, high in arrays["largest_of"].items()}
        for k in range(2):
            pixels = arrays[f"pixels_{k}"]
            for name, table in made._tables.items():
                table[k][pixels] = arrays[f"{name}_of_{k}"]
            deepest = int(made.hits[k].take(pixels).max(initial=0))
            made._note(k, deepest, float(arrays["largest"]), highest)
        return made

    def subtract(self, stream: str, parts: Sequence[str]) -> None:
        """The right sides are subtracted, exactly. The largest term is at most the sum of
        theirs.
        """
        rest = self.right[self.first].copy()
        for part in parts:
            rest -= self.right[part]
        self.right[stream] = rest
        terms = (self._largest_of[name] for name in (self.first, *parts))
        self._largest_of[stream] = sum(terms)
        self.signals += (stream,)
        self._check(stream)

    def _note(self, half: int, deepest: int, largest: float, of: Mapping[str, float]) -> None:
        """Most samples in a pixel of a half; largest terms, of weights and noise and of each
        signal.
        """
        self._deepest[half] = max(self._deepest[half], deepest)
        self._largest = max(self._largest, largest)
        for name, high in of.items():
            self._largest_of[name] = max(self._largest_of[name], high)

    def _check(self, place: str) -> None:
        """Raise PipelineError where a sum may have overflowed."""
        highest = max(self._largest_of.values())
        largest = max(self._largest, highest)
        if sum(self._deepest) * largest < MOST:
            return
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
