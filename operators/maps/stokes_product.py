"""`StokesSums`: the partial product of a map of I, Q and U."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation

from .pixel_sums import PixelSums, zeros
from .stokes_kernel import DATA, HIT
from .stokes_sums import MATRIX, StokesBinning
from .sums import Sums


class StokesSums(PixelSums):
    """Sums for a map of I, Q and U, those of `stokes_sums`.

    Attributes
    ----------
    matrix
        (2, n_pixels, 7) hits and A.
    data
        By stream of a signal, (2, n_pixels, 3) b.
    noise
        (2, n_pixels, 6) N; None: it is A.
    """

    def __init__(self, n_pixels: int, signals: Sequence[str], of_scans: bool = True) -> None:
        super().__init__(signals, of_scans)
        self.matrix = zeros(n_pixels, DATA)
        self.data = {name: zeros(n_pixels, 3) for name in self.signals}
        self.noise: NDArray[np.int64] | None = None
        self._largest = 0.0
        self._largest_of = dict.fromkeys(self.signals, 0.0)

    @property
    def hits(self) -> Sums:
        """See `PixelSums.hits`."""
        return self.matrix[:, :, HIT]

    def add(
        self, observation: Observation, halves: Sequence[StokesBinning], place: str
    ) -> tuple[int, Sums]:
        """Add one observation: (samples binned, dropped (4,)). Raises PipelineError where a sum may
        have overflowed.

        ``halves``: the binning of either half of its samples, or one of all of them.
        """
        inside, dropped = 0, np.zeros(4, np.int64)
        for k, binning in enumerate(halves, start=self.shift):
            if binning.own_noise:
                self._with_noise()
            for pixels, found, lost, largest in binning.taken():
                self._add_part(k, pixels, found)
                self._note(float(largest[0]), dict.fromkeys(self.signals, float(largest[1])))
                inside, dropped = inside + int(found[:, HIT].sum()), dropped + lost
        self._added(observation, len(halves), dropped)
        self._check(f"{place}, {observation.name}")
        return inside, dropped

    def _add_part(self, k: int, pixels: NDArray[np.int64], found: Sums) -> None:
        """Add sums of ``pixels``, columns as in `stokes_sums`, to the half ``k``."""
        self.matrix[k][pixels] += found[:, :DATA]
        for n, name in enumerate(self.signals):
            self.data[name][k][pixels] += found[:, DATA + 3 * n : DATA + 3 * n + 3]
        if self.noise is not None:
            end = DATA + 3 * len(self.signals)
            self.noise[k][pixels] += found[:, end:] if found.shape[1] > end else found[:, MATRIX]

    def _with_noise(self) -> NDArray[np.int64]:
        """N, which so far was A."""
        if self.noise is None:
            self.noise = self.matrix[..., MATRIX].copy()
        return self.noise

    def parts(self, stream: str, pixels: slice, half: int | None = None) -> tuple[Sums, Sums, Sums]:
        """(hits and A (n, 7), b (n, 3), N (n, 6)) in some pixels of a signal; of one half, or of
        both together.
        """
        noise = self.matrix[..., MATRIX] if self.noise is None else self.noise
        found = [array[:, pixels] for array in (self.matrix, self.data[stream], noise)]
        a, b, n = (x[0] + x[1] if half is None else x[half] for x in found)
        return a, b, n

    def __iadd__(self, other: StokesSums) -> StokesSums:
        """Add sums whose scans follow those that are here: exact."""
        shift = self.shift
        if other.noise is not None:
            self._with_noise()
        for k in range(2):
            half, pixels = (k + shift) % 2, np.flatnonzero(other.matrix[k, :, HIT])
            self.matrix[half][pixels] += other.matrix[k].take(pixels, axis=0)
            for name, mine in self.data.items():
                mine[half][pixels] += other.data[name][k].take(pixels, axis=0)
            if self.noise is not None:
                theirs = other.matrix[k][:, MATRIX] if other.noise is None else other.noise[k]
                self.noise[half][pixels] += theirs.take(pixels, axis=0)
        self._note(other._largest, other._largest_of)
        self._joined(other)
        self._check("the sum of the maps of all tasks")
        return self

    def arrays(self) -> dict[str, Any]:
        """Numbers of the pixels with hits, and their sums."""
        found = self._about() | {
            "largest": self._largest,
            "largest_of": dict(self._largest_of),
            "own_noise": self.noise is not None,
        }
        for k in range(2):
            pixels = np.flatnonzero(self.matrix[k, :, HIT])
            found |= {f"pixels_{k}": pixels, f"matrix_{k}": self.matrix[k].take(pixels, axis=0)}
            found |= {
                f"data_{k}_{n}": data[k].take(pixels, axis=0)
                for n, data in enumerate(self.data.values())
            }
            if self.noise is not None:
                found[f"noise_{k}"] = self.noise[k].take(pixels, axis=0)
        return found

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> StokesSums:
        """See `Product.of`."""
        made = cls(int(arrays["n_pixels"]), list(arrays["signals"]), bool(arrays["of_scans"]))
        made._with_about(arrays)
        made._note(
            float(arrays["largest"]),
            {name: float(high) for name, high in arrays["largest_of"].items()},
        )
        if arrays["own_noise"]:
            made._with_noise()
        for k in range(2):
            pixels = arrays[f"pixels_{k}"]
            made.matrix[k][pixels] = arrays[f"matrix_{k}"]
            for n, name in enumerate(made.signals):
                made.data[name][k][pixels] = arrays[f"data_{k}_{n}"]
            if made.noise is not None:
                made.noise[k][pixels] = arrays[f"noise_{k}"]
        return made

    def subtract(self, stream: str, parts: Sequence[str]) -> None:
        """b is subtracted, exactly. Its largest term is at most the sum of theirs."""
        rest = self.data[self.signals[0]].copy()
        for part in parts:
            rest -= self.data[part]
        self.data[stream] = rest
        self._largest_of[stream] = self._largest_of[self.signals[0]] + sum(
            self._largest_of[part] for part in parts
        )
        self.signals += (stream,)
        self._check(stream)

    def _note(self, largest: float, largest_of: Mapping[str, float]) -> None:
        """Largest terms: of A and N, and of b of each signal."""
        self._largest = max(self._largest, largest)
        for name, high in largest_of.items():
            self._largest_of[name] = max(self._largest_of[name], high)

    def _check(self, place: str) -> None:
        """No sum can have overflowed."""
        highest = max(self._largest_of.values())
        self._refuse_overflow(max(self._largest, highest), highest, place)
