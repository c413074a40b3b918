"""`MapSums`: the partial product of a map, sums in pixels of two halves of the samples for every
signal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from zonda.core.data import Observation
from zonda.core.types import Floats

from .pixel_sums import MOST, PixelSums, zeros
from .sums import DATA, HITS, NOISE, Binning, Sums


class MapSums(PixelSums):
    """Sums for a map of I.

    Parameters
    ----------
    n_pixels
        Of the map.
    signals
        Streams of the signals, the complete one first; none where only the hits are wanted.
    scatter
        Whether each signal has noise of its own, from the scatter of its samples.
    of_scans
        Whether the halves are the even and the odd observations.

    Attributes
    ----------
    sums
        (2, n_pixels, 4) of the complete signal, columns as in `sums`; hits and weights are those of
        all signals.
    others
        By stream of the further signals, (2, n_pixels): the sums of w d; ``scatters``: their noise
        terms, where they differ.
    """

    def __init__(
        self, n_pixels: int, signals: Sequence[str], scatter: bool = False, of_scans: bool = True
    ) -> None:
        super().__init__(signals, of_scans)
        self.sums = zeros(n_pixels, 4)
        self.others = {name: zeros(n_pixels, 1)[..., 0] for name in self.signals[1:]}
        self.scatters = (
            {name: zeros(n_pixels, 1)[..., 0] for name in self.others} if scatter else {}
        )
        self._largest = np.zeros(4)
        self._largest_of = dict.fromkeys(self.others, 0.0)
        self._deepest = [0, 0]

    @property
    def hits(self) -> Sums:
        """See `PixelSums.hits`."""
        return self.sums[:, :, HITS]

    def add(
        self, observation: Observation, halves: Sequence[Sequence[Binning]], place: str
    ) -> tuple[int, Sums]:
        """Add one observation: (samples binned, dropped (4,)). Raises PipelineError where a sum may
        have overflowed.

        ``halves``: the binnings of either half of its samples, or one list of all of them.
        """
        inside, dropped = 0, np.zeros(4, np.int64)
        for k, binnings in enumerate(halves, start=self.shift):
            binned, lost = self._add_half(k, binnings)
            inside, dropped = inside + binned, dropped + lost
        self._added(observation, len(halves), dropped)
        self._check(f"{place}, {observation.name}")
        return inside, dropped

    def _add_half(self, k: int, binnings: Sequence[Binning]) -> tuple[int, Sums]:
        """Add binnings to the half ``k``: (samples binned, dropped (4,))."""
        names = list(self.others)
        together = binnings[0].n_others == len(names)
        others = (
            np.stack([self.others[name][k] for name in names], axis=1)
            if names and together
            else _nothing(self.sums[k])
        )
        inside, deepest, dropped, largest = binnings[0].fold(self.sums[k], others)
        for n, name in enumerate(names):
            if together:
                self.others[name][k] = others[:, n]
                high = float(largest[NOISE + 1 + n])
            else:
                own = np.zeros_like(self.sums[k])
                _, _, _, found = binnings[1 + n].fold(own, _nothing(own))
                self.others[name][k] += own[:, DATA]
                self.scatters[name][k] += own[:, NOISE]
                high, largest[NOISE] = float(found[DATA]), max(largest[NOISE], found[NOISE])
            self._largest_of[name] = max(self._largest_of[name], high)
        self._note(k, deepest, largest[:4])
        return inside, dropped

    def total(self, stream: str, pixels: slice) -> Sums:
        """Both halves together of some pixels of a signal, (n, 4)."""
        both = len(self.scans) > 1 or not self.of_scans
        return (
            self.half(stream, 0, pixels) + self.half(stream, 1, pixels)
            if both
            else self.half(stream, 0, pixels)
        )

    def half(self, stream: str, k: int, pixels: slice) -> Sums:
        """Sums of the first (0: even scans) or the second half (1: odd scans) in some pixels of a
        signal, (n, 4).
        """
        found: Sums = self.sums[k, pixels]
        if stream in self.others:
            found = found.copy()
            found[:, DATA] = self.others[stream][k, pixels]
            if stream in self.scatters:
                found[:, NOISE] = self.scatters[stream][k, pixels]
        return found

    def __iadd__(self, other: MapSums) -> MapSums:
        """Add sums whose scans follow those that are here: exact, so that their order does not
        matter but for which are even.
        """
        shift = self.shift
        for k in range(2):
            half, pixels = (k + shift) % 2, np.flatnonzero(other.sums[k, :, HITS])
            merged = other.sums[k].take(pixels, axis=0) + (
                self.sums[half].take(pixels, axis=0) if self.scans else 0
            )
            self.sums[half][pixels] = merged
            for mine, theirs in ((self.others, other.others), (self.scatters, other.scatters)):
                for name in mine:
                    mine[name][half][pixels] += theirs[name][k].take(pixels)
            self._note(half, int(merged[:, HITS].max(initial=0)), other._largest)
        for name, high in other._largest_of.items():
            self._largest_of[name] = max(self._largest_of[name], high)
        self._joined(other)
        self._check("the sum of the maps of all tasks")
        return self

    def arrays(self) -> dict[str, Any]:
        """Numbers of the pixels with hits, and their sums."""
        found = self._about() | {
            "largest": self._largest,
            "largest_of": dict(self._largest_of),
            "scatter": bool(self.scatters),
        }
        for k in range(2):
            pixels = np.flatnonzero(self.sums[k, :, HITS])
            found |= {f"pixels_{k}": pixels, f"sums_{k}": self.sums[k].take(pixels, axis=0)}
            for n, name in enumerate(self.others):
                found[f"others_{k}_{n}"] = self.others[name][k].take(pixels)
                if name in self.scatters:
                    found[f"scatters_{k}_{n}"] = self.scatters[name][k].take(pixels)
        return found

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> MapSums:
        """See `Product.of`."""
        made = cls(
            int(arrays["n_pixels"]),
            list(arrays["signals"]),
            bool(arrays["scatter"]),
            bool(arrays["of_scans"]),
        )
        made._with_about(arrays)
        made._largest_of = {name: float(high) for name, high in arrays["largest_of"].items()}
        for k in range(2):
            pixels, sums = arrays[f"pixels_{k}"], arrays[f"sums_{k}"]
            made.sums[k][pixels] = sums
            for n, name in enumerate(made.others):
                made.others[name][k][pixels] = arrays[f"others_{k}_{n}"]
                if made.scatters:
                    made.scatters[name][k][pixels] = arrays[f"scatters_{k}_{n}"]
            made._note(
                k, int(sums[:, HITS].max(initial=0)), np.asarray(arrays["largest"], np.float64)
            )
        return made

    def subtract(self, stream: str, parts: Sequence[str]) -> None:
        """The sums of w d are subtracted, exactly. Its largest term is at most the sum of
        theirs.
        """
        rest = self.sums[..., DATA].copy()
        for part in parts:
            rest -= self.others[part]
        self.others[stream] = rest
        self._largest_of[stream] = float(self._largest[DATA]) + sum(
            self._largest_of[part] for part in parts
        )
        self.signals += (stream,)
        self._check(stream)

    def _note(self, half: int, deepest: int, largest: Floats) -> None:
        """Most samples in a pixel of a half, largest terms."""
        self._deepest[half] = max(self._deepest[half], deepest)
        self._largest = np.maximum(self._largest, largest)

    def _check(self, place: str) -> None:
        """No sum can have overflowed."""
        largest = max(float(self._largest.max()), *self._largest_of.values(), 0.0)
        if sum(self._deepest) * largest >= MOST:
            highest = max(float(self._largest[DATA]), *self._largest_of.values(), 0.0)
            self._refuse_overflow(largest, highest, place)


def _nothing(half: Sums) -> Sums:
    return np.empty((len(half), 0), np.int64)
