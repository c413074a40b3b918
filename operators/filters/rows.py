"""Rows of a stream in float64, with the mean that stands beside it.

Tens of kelvin of mean emission stand beside microkelvins: their sum is formed in float64, and what
is removed from it is removed before it is rounded. `read` forms it a chunk at a time, where it is
used: a copy of whole rows would not stay in the cache.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numba as nb
import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.kernels import kernel
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.smooth import series_into
from zonda.core.types import AnyFloats, Floats

from .source_mask import MASKED, Inside

SPOILT = "samples not finite"
"""Count of samples that are left as they are."""

ROWS = 8
"""Detectors that are worked on at a time: what they share is read once for all, and their scans
stay in the last cache.
"""

AT_ONCE = 512
"""Samples of a chunk: what all rows share of them stays in the first cache."""

Mask = NDArray[np.bool_]


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


def by_rows(
    label: str,
    block: Block,
    remove: Callable[[Rows, Mask | None], int],
    inside: Inside | None = None,
) -> None:
    """Let ``remove`` change the signal of a block, its mean included; no mean is left beside it.

    ``remove(rows, masked)`` changes up to `ROWS` detectors in place and returns how many samples
    were not finite; ``masked`` (n_det, n_samp): which of them are ``inside`` a source mask. The
    step ``label`` counts both.
    """
    signal, mean, tally = (
        block.detdata["signal"],
        block.means.pop("signal", None),
        block.observation.tally,
    )
    spoilt, inside_mask = 0, 0
    for part in chunks(len(signal), ROWS):
        detectors = slice(block.detectors.start + part.start, block.detectors.start + part.stop)
        rows, masked = Rows.of(signal[part]), None
        if mean is not None:
            lines, cell, between = mean.series(detectors, block.samples, np.dtype(np.float64))
            rows = Rows(signal[part], lines, cell, between, block.samples.start, 0)
        if inside is not None:
            masked = inside.at(detectors, block.samples)
            inside_mask += int(masked.sum())
        spoilt += remove(rows, masked)
    if inside is not None:
        tally.count(label, MASKED, inside_mask, signal.size)
    tally.count(label, SPOILT, spoilt)


def in_double(
    label: str,
    block: Block,
    remove: Callable[[Floats, Mask | None], int],
    inside: Inside | None = None,
) -> None:
    """Act as `by_rows` with a function that changes samples (n_det, n_samp) of whole rows in
    float64.
    """

    def on_a_copy(rows: Rows, masked: Mask | None) -> int:
        copy = rows.double(slice(None), rows.values.shape[1])
        spoilt = remove(copy, masked)
        rows.values[...] = copy
        return spoilt

    by_rows(label, block, on_a_copy, inside)


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
