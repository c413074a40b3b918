"""Named intervals of a scan, TOAST's names and TOAST's rule of which samples belong to them.

Names: scanning, turnaround, throw, throw_leftright, throw_rightleft, scan_leftright,
scan_rightleft, turn_leftright, turn_rightleft, elnod, sun_up, sun_close. Times are seconds since
the start of the scan. An interval holds the samples from its start up to, but not including, its
stop; where it stops at the last sample, or between the last two, it holds the last one too.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from .types import AnyFloats

Intervals = dict[str, list[tuple[float, float]]]
"""Intervals by name: (start, stop) [s], in order and disjoint."""


def runs(inside: NDArray[np.bool_], seconds: AnyFloats) -> list[tuple[float, float]]:
    """The intervals of those samples (n,) that are ``inside``, taken at ``seconds`` (n,).

    A run of the last sample alone has no length, and is left out: TOAST's rule gives that sample to
    the interval before.
    """
    edges = np.flatnonzero(np.diff(np.r_[False, inside, False]))
    stops = np.minimum(edges[1::2], len(seconds) - 1)
    spans = zip(seconds[edges[::2]].tolist(), seconds[stops].tolist(), strict=True)
    return [(start, stop) for start, stop in spans if stop > start]


def ranges(spans: list[tuple[float, float]], seconds: AnyFloats) -> list[slice]:
    """The samples of each of the intervals ``spans``."""
    found = np.searchsorted(seconds, np.reshape(spans, (-1, 2))).tolist()
    return [slice(first, last + (last == len(seconds) - 1)) for first, last in found]


def samples_in(spans: list[tuple[float, float]], seconds: AnyFloats) -> NDArray[np.bool_]:
    """(n,) True for the samples in any of the intervals ``spans``."""
    inside = np.zeros(len(seconds), bool)
    for samples in ranges(spans, seconds):
        inside[samples] = True
    return inside


def part(intervals: Mapping[str, list[tuple[float, float]]], begin: float, end: float) -> Intervals:
    """Parts of intervals between ``begin`` and ``end`` [s], counted from ``begin``; names without
    any part are kept.
    """
    return {
        name: [
            (max(a, begin) - begin, min(b, end) - begin)
            for a, b in spans
            if min(b, end) > max(a, begin)
        ]
        for name, spans in intervals.items()
    }
