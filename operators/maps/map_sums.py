"""`MapSums`: the partial product of a map, integer sums in pixels of two halves of the samples for
every signal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.errors import PipelineError
from zonda.core.maps.beams import Beams
from zonda.core.numerics.chunks import empty
from zonda.core.product import Product
from zonda.core.signal import MAIN

from . import sums
from .coverage import Coverage
from .stokes_kernel import DATA, HIT
from .stokes_sums import MATRIX, StokesBinning
from .sums import FLAGGED, VALUE, Binning, Sums

MOST = 2.0**62
"""Below what a sum must stay."""
JOINED = "the sum of the maps of all tasks"


@dataclass(frozen=True)
class Columns:
    """Columns of the table of a map's pixels.

    ``right``: right sides of a signal in each pixel; ``first``: where those of the first signal
    are, None: they are not in the table.
    """

    count: int
    hits: int
    weights: slice
    noise: slice
    right: int
    first: slice | None = None


INTENSITY = Columns(
    4,
    sums.HITS,
    slice(sums.WEIGHTS, sums.WEIGHTS + 1),
    slice(sums.NOISE, sums.NOISE + 1),
    1,
    slice(sums.DATA, sums.DATA + 1),
)
"""One weight and one right side, in the order of `sums`."""
POLARIZED = Columns(DATA, HIT, MATRIX, MATRIX, 3)
"""Six weights and three right sides, in the order of `stokes_sums`; the noise is that of the
weights."""


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
        (2, n_pixels, n) `columns`: hits and weights of all signals, noise.
    right
        (2, n_pixels, 1 or 3) sums of w d of each signal that has them outside the table.
    noise
        (2, n_pixels, 1 or 6) by stream, of signals with noise of their own; under the name of the
        first signal that of all, where it is not that of the table.
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
        self.columns = POLARIZED if polarized else INTENSITY
        self.scatter, self.of_scans = scatter, of_scans
        self.scans: list[str] = []
        self.rates: set[float] = set()
        self.unknown_variance = False
        self.coverage = Coverage()
        self.beams = Beams()
        own = self.signals if polarized else self.signals[1:]
        self.table = zeros(n_pixels, self.columns.count)
        self.right = {name: zeros(n_pixels, self.columns.right) for name in own}
        self.noise = {name: zeros(n_pixels, 1) for name in own} if scatter else {}
        self._largest = 0.0
        self._largest_of = dict.fromkeys((self.first, *own), 0.0)
        self._deepest = [0, 0]

    @property
    def polarized(self) -> bool:
        """I, Q and U are wanted."""
        return self.columns is POLARIZED

    @property
    def first(self) -> str:
        """The stream of the complete signal."""
        return self.signals[0] if self.signals else MAIN

    @property
    def hits(self) -> Sums:
        """(2, n_pixels) samples in each pixel."""
        return self.table[:, :, self.columns.hits]

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
        for k, name in enumerate(self.signals or (MAIN,)):
            found |= {
                f"{what}_{k}": tables[name]
                for what, tables in (("right", self.right), ("noise", self.noise))
                if name in tables
            }
        return found

    def add(
        self,
        observation: Observation,
        halves: Sequence[Sequence[Binning] | Sequence[StokesBinning]],
        place: str,
    ) -> tuple[int, Sums]:
        """Add one observation: (samples binned, dropped (4,)). Raises PipelineError where a sum may
        have overflowed.

        ``halves``: the binnings of either half of its samples, or one list of all of them.
        """
        inside, dropped = 0, np.zeros(4, np.int64)
        for k, binnings in enumerate(halves, start=self._shift):
            add: Any = self._add_polarized if self.polarized else self._add_intensity
            binned, lost = add(k, binnings)
            inside, dropped = inside + binned, dropped + lost
        # what belongs to the other half counted as flagged
        dropped[FLAGGED] -= (len(halves) - 1) * observation.n_detectors * observation.n_samples
        self.scans.append(observation.name)
        self.rates.add(float(observation.sample_rate))
        self._check(f"{place}, {observation.name}")
        return inside, dropped

    def _add_intensity(self, k: int, binnings: Sequence[Binning]) -> tuple[int, Sums]:
        """Add binnings, one for all signals or one for each, to the half ``k``: (samples binned,
        dropped (4,)).
        """
        names = list(self.right)
        together = binnings[0].n_others == len(names)
        others = (
            np.concatenate([self.right[name][k] for name in names], axis=1)
            if names and together
            else _nothing(self.table[k])
        )
        inside, deepest, dropped, largest = binnings[0].fold(self.table[k], others)
        high = {self.first: float(largest[sums.DATA])}
        for n, name in enumerate(names):
            if together:
                self.right[name][k] = others[:, n : n + 1]
                high[name] = float(largest[sums.NOISE + 1 + n])
            else:
                own = np.zeros_like(self.table[k])
                _, _, _, found = binnings[1 + n].fold(own, _nothing(own))
                self.right[name][k] += own[:, self.columns.first]
                self.noise[name][k] += own[:, self.columns.noise]
                high[name] = float(found[sums.DATA])
                largest[sums.NOISE] = max(largest[sums.NOISE], found[sums.NOISE])
        self._note(k, deepest, float(largest[sums.WEIGHTS : sums.NOISE + 1].max()), high)
        return inside, dropped

    def _add_polarized(self, k: int, binnings: Sequence[StokesBinning]) -> tuple[int, Sums]:
        """Add a binning to the half ``k``: (samples binned, dropped (4,))."""
        inside, dropped, end = 0, np.zeros(4, np.int64), DATA + 3 * len(self.signals)
        for binning in binnings:
            if binning.own_noise:
                self._with_noise()
            for pixels, found, lost, largest in binning.taken():
                self.table[k][pixels] += found[:, :DATA]
                for n, name in enumerate(self.signals):
                    self.right[name][k][pixels] += found[:, DATA + 3 * n : DATA + 3 * n + 3]
                if self.noise:
                    own = found[:, end:] if found.shape[1] > end else found[:, MATRIX]
                    self.noise[self.first][k][pixels] += own
                deepest = self._deepest[k] + int(found[:, HIT].max(initial=0))
                high = dict.fromkeys(self.signals, float(largest[1]))
                self._note(k, deepest, float(largest[0]), high)
                inside, dropped = inside + int(found[:, HIT].sum()), dropped + lost
        return inside, dropped

    def _with_noise(self) -> None:
        """Keep the noise of polarized maps, which so far was that of the weights."""
        if not self.noise:
            self.noise[self.first] = self.table[..., MATRIX].copy()

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

        table, columns = of(self.table), self.columns
        right = of(self.right[stream]) if stream in self.right else table[:, columns.first]
        noise = self.noise.get(stream if self.scatter else self.first)
        return (
            table[:, columns.hits],
            table[:, columns.weights],
            right,
            table[:, columns.noise] if noise is None else of(noise),
        )

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
        whole = self.right.get(self.first)
        rest = (self.table[..., self.columns.first] if whole is None else whole).copy()
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


def _nothing(half: Sums) -> Sums:
    return np.empty((len(half), 0), np.int64)
