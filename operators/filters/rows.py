"""Rows of a stream in float64, with the mean that stands beside it.

Tens of kelvin of mean emission stand beside microkelvins: their sum is formed in float64, and what
is removed from it is removed before it is rounded. `read` forms it a chunk at a time, where it is
used: a copy of whole rows would not stay in the cache.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal, NamedTuple, Protocol

import numba as nb
import numpy as np

from zonda.core.data import Block, Data, Observation
from zonda.core.kernels import kernel
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.smooth import series_into
from zonda.core.operator import Operator
from zonda.core.types import AnyFloats, Bools, Floats

from .source_mask import MASKED, Inside, SourceMask

SPOILT = "samples not finite"
"""Count of samples that are left as they are."""

ROWS = 8
"""Detectors that are worked on at a time: what they share is read once for all, and their scans
stay in the last cache.
"""

AT_ONCE = 512
"""Samples of a chunk: what all rows share of them stays in the first cache."""

Mask = Bools


class Rows(NamedTuple):
    """Samples of several detectors, and the series of their mean (`core.numerics.smooth.Series`).
    Kernels take the fields.
    """

    values: AnyFloats
    """(n_det, N), C order. What is changed is written here, without the mean."""
    lines: AnyFloats
    """(n_det, n): B-spline coefficients of the mean; without rows where there is none."""
    cell: int
    inside: AnyFloats
    start: int
    """Sample of the scan at which the rows begin."""
    begin: int
    """Sample of the rows at which work begins."""

    @classmethod
    def of(cls, values: AnyFloats) -> Rows:
        """Rows (n_det, N) without a mean."""
        return cls(values, np.empty((0, 0)), 0, np.empty(0), 0, 0)

    def at(self, begin: int) -> Rows:
        """The same rows; work begins at this sample of them."""
        return self._replace(begin=begin)

    def double(self, which: slice, length: int) -> Floats:
        """(n, length): the rows ``which`` in float64, with their mean, from ``begin`` on."""
        out = np.empty((len(self.values[which]), length))
        _read_all(*self._replace(values=self.values[which], lines=self.lines[which]), out)
        return out


class Removal(Protocol):
    """A linear fit to each detector's scan, and its subtraction."""

    def remove(self, rows: Rows, masked: Mask | None = None) -> int:
        """Change up to `ROWS` detectors in place; return how many samples were not finite.

        ``masked`` (n_det, n_samp): samples in a source mask.
        """

    def adjoint(self, rows: Rows, masked: Mask | None = None) -> None:
        """Change float64 rows in place by the transpose of `remove`, of finite samples."""


class LinearFilter(Operator):
    """Base of the filters of the signal, each detector's whole scan by itself.

    ``prepare`` returns the `Removal` that acts on every row and the samples in the source mask.
    """

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})
    knows_means = True
    linear = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "time"

    def check(self, data: Data) -> list[str]:
        """Refuse a source mask that cannot be used."""
        for observation in data.observations:
            self._inside(observation)
        return []

    def _inside(self, observation: Observation) -> Inside | None:
        """Samples of a scan in the filter's source mask; None: it has none.

        Raises InputError for a file that cannot be used, PipelineError for a mask that covers the
        scan.
        """
        mask: SourceMask | None = getattr(self, "mask", None)
        return mask.of_part(observation, self.label) if mask else None

    def exec(self, block: Block, state: Any) -> None:
        """Subtract the fit from each row and its mean; no mean is left beside the rows."""
        (fit, inside), signal, log = state, block.detdata["signal"], block.observation.log
        mean = block.means.pop("signal", None)
        spoilt = 0
        n_masked = 0
        for part in chunks(len(signal), ROWS):
            detectors = slice(block.detectors.start + part.start, block.detectors.start + part.stop)
            rows = Rows.of(signal[part])
            masked = None
            if mean is not None:
                lines, cell, between = mean.series(detectors, block.samples, np.dtype(np.float64))
                rows = Rows(signal[part], lines, cell, between, block.samples.start, 0)
            if inside is not None:
                masked = inside.at(detectors, block.samples)
                n_masked += int(masked.sum())
            spoilt += fit.remove(rows, masked)
        if inside is not None:
            log.count(self.label, MASKED, n_masked, signal.size)
        log.count(self.label, SPOILT, spoilt)

    def adjoint(self, block: Block, state: Any) -> None:
        """The transpose of `exec`, of a block in float64 without means (`zonda.linear.filters`)."""
        (fit, inside), signal = state, block.detdata["signal"]
        for part in chunks(len(signal), ROWS):
            detectors = slice(block.detectors.start + part.start, block.detectors.start + part.stop)
            masked = None if inside is None else inside.at(detectors, block.samples)
            fit.adjoint(Rows.of(signal[part]), masked)


@kernel(fastmath=False)
def read(values, lines, cell, inside, start, d, low, into):  # type: ignore[no-untyped-def]
    """Samples low .. low + into.size - 1 of row ``d`` in float64, with the mean; the other
    arguments are those of `Rows`.
    """
    n, row = nb.uint64(into.size), values[d, low : low + into.size]
    if lines.shape[0]:
        series_into(lines[d], cell, inside, start + low, into)
        for t in range(n):
            into[t] += row[t]
    else:
        for t in range(n):
            into[t] = row[t]


@kernel
def write(values, d, low, x):  # type: ignore[no-untyped-def]
    """Round ``x`` to the samples from ``low`` on of row ``d``."""
    row = values[d, low : low + x.size]
    for t in range(nb.uint64(x.size)):
        row[t] = x[t]


@kernel
def _read_all(values, lines, cell, inside, start, begin, out):  # type: ignore[no-untyped-def]
    for d in range(out.shape[0]):
        read(values, lines, cell, inside, start, d, begin, out[d])
