"""Flags of samples and of detectors, one table of bits (TOAST's where TOAST has one); and named
intervals of a scan.

TOAST calls flags of samples *shared*. Its map-making leaves out samples with a bit of 15 and
detectors with a bit of 7 ("non-science"). zonda leaves out these and its own, `OPAQUE`,
`NOT_RECORDED` and `DEAD`, which become *invalid* in a file. The bits of the Sun do not exclude a
sample.

What a file flags says nothing of the signal there: no filter uses it, turnarounds excepted. What a
filter of this run trims has a signal (`TRIMMED`). TOAST knows one bit for both, *processing*; a
file of zonda names what was trimmed by the intervals `TRIMMED_INTERVALS`.

Intervals of a scan have TOAST's names: scanning, turnaround, throw, throw_leftright,
throw_rightleft, scan_leftright, scan_rightleft, turn_leftright, turn_rightleft, elnod, sun_up,
sun_close. Times are seconds since the start of the scan. An interval holds the samples from its
start up to, but not including, its stop; where it stops at the last sample, or between the last
two, it holds the last one too.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .types import AnyFloats, Bools

Intervals = dict[str, list[tuple[float, float]]]
"""Intervals by name: (start, stop) [s], in order and disjoint."""


def intervals_of(inside: Bools, seconds: AnyFloats) -> list[tuple[float, float]]:
    """The intervals of those samples (n,) that are ``inside``, taken at ``seconds`` (n,).

    A run of the last sample alone has no length, and is left out: TOAST's rule gives that sample to
    the interval before.
    """
    edges = np.flatnonzero(np.diff(np.r_[False, inside, False]))
    stops = np.minimum(edges[1::2], len(seconds) - 1)
    spans = zip(seconds[edges[::2]].tolist(), seconds[stops].tolist(), strict=True)
    return [(start, stop) for start, stop in spans if stop > start]


def slices_in(spans: list[tuple[float, float]], seconds: AnyFloats) -> list[slice]:
    """The samples of each of the intervals ``spans``."""
    found = np.searchsorted(seconds, np.reshape(spans, (-1, 2))).tolist()
    return [slice(first, last + (last == len(seconds) - 1)) for first, last in found]


def samples_in(spans: list[tuple[float, float]], seconds: AnyFloats) -> Bools:
    """(n,) True for the samples in any of the intervals ``spans``."""
    inside = np.zeros(len(seconds), bool)
    for samples in slices_in(spans, seconds):
        inside[samples] = True
    return inside


def cut_intervals(
    intervals: Mapping[str, list[tuple[float, float]]],
    begin: float,
    end: float,
) -> Intervals:
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


Flags = NDArray[np.uint8]

INVALID, PROCESSING = 1, 2
"""Flag of samples and detectors that a file or TOAST has set."""
TURNAROUND, IRREGULAR, SUN_UP, SUN_CLOSE = 4, 8, 16, 32
"""Of samples."""
SOLAR_SYSTEM_OBJECT = 4
"""Of detectors."""
OPAQUE = 64
"""Of samples and of detectors; zonda's own: no signal comes through."""
NOT_RECORDED = OPAQUE
"""Of samples; zonda's own: there is no signal either, and the same bit says it."""
TRIMMED = 128
"""Of samples; zonda's own: a filter trims them. They have a signal."""
DEAD = 128
"""Of detectors; zonda's own."""

SAMPLE_MASK, DETECTOR_MASK = 15, 7
"""Bits that exclude a sample or a detector in TOAST."""


@dataclass(frozen=True)
class Flag:
    """A bit: its name, what it means, whether what has it is left out, and the bit that it becomes
    in a file.
    """

    bit: int
    name: str
    meaning: str
    excludes: bool
    in_file: int


SAMPLE_FLAGS = (
    Flag(INVALID, "invalid", "do not use", True, INVALID),
    Flag(PROCESSING, "processing", "left out by a step of another run", True, PROCESSING),
    Flag(TURNAROUND, "unstable scan rate", "in a turnaround", True, TURNAROUND),
    Flag(IRREGULAR, "irregular", "no regular scan: an elevation nod", True, IRREGULAR),
    Flag(SUN_UP, "sun up", "the Sun is above the horizon", False, SUN_UP),
    Flag(SUN_CLOSE, "sun close", "the Sun is near", False, SUN_CLOSE),
    Flag(
        OPAQUE,
        "no signal",
        "opaque air in the band of a detector; a gap of a recorded scan",
        True,
        INVALID,
    ),
    Flag(
        TRIMMED,
        "trimmed",
        "left out by a filter of this run, which has used its signal",
        True,
        PROCESSING,
    ),
)
"""Of samples (`Observation.flags`)."""
DETECTOR_FLAGS = (
    Flag(INVALID, "invalid", "do not use", True, INVALID),
    Flag(PROCESSING, "processing", "left out by a step", True, PROCESSING),
    Flag(
        SOLAR_SYSTEM_OBJECT,
        "solar-system object",
        "a planet is in the beam",
        True,
        SOLAR_SYSTEM_OBJECT,
    ),
    Flag(OPAQUE, "opaque", "the atmosphere is opaque in its band most of the time", True, INVALID),
    Flag(
        DEAD,
        "dead",
        "its signal is constant or not finite, or the focal plane says so",
        True,
        INVALID,
    ),
)
"""Of detectors (`Observation.detector_flags`)."""

EXCLUDE_SAMPLE = sum(flag.bit for flag in SAMPLE_FLAGS if flag.excludes)
EXCLUDE_DETECTOR = sum(flag.bit for flag in DETECTOR_FLAGS if flag.excludes)

HAS_A_SIGNAL = TRIMMED | TURNAROUND
"""Bits of samples that no map uses but whose signal is one: filters take it as it is, and bridge
the other excluded samples.
"""
TRIMMED_INTERVALS = "zonda_trimmed"
"""Name of the intervals of a file in which *processing* means `TRIMMED`."""


def good(flags: Flags, exclude: int) -> Bools:
    """Mask of elements with none of the bits ``exclude``."""
    return np.asarray((flags & np.uint8(exclude)) == 0, np.bool_)


def in_file(flags: Flags, table: tuple[Flag, ...]) -> Flags:
    """Flags as files have them: TOAST's bits alone."""
    found = np.zeros_like(flags)
    for flag in table:
        found |= np.where(flags & np.uint8(flag.bit), np.uint8(flag.in_file), np.uint8(0))
    return found


def has_a_signal(flags: Flags) -> Bools:
    """Samples in which filters take the signal as it is: those that maps use, turnarounds, and
    those that a filter of this run trims.
    """
    return good(flags, EXCLUDE_SAMPLE & ~HAS_A_SIGNAL)


def from_file(flags: Flags, mask: int, trimmed: Bools | None = None) -> Flags:
    """Flags of samples as a file in TOAST's layout has them; only those with a bit of ``mask`` are
    excluded.

    Bits that do not exclude a sample (the Sun's) are kept. A bit of ``mask`` that is none of ours
    becomes *invalid*; other bits that are not in ``mask`` are dropped. ``trimmed`` (n,): where
    *processing* means that a filter of zonda trimmed the sample.
    """
    passing = np.uint8(SUN_UP | SUN_CLOSE)
    other = np.uint8(mask & ~SAMPLE_MASK)
    found = flags & (np.uint8(mask & SAMPLE_MASK) | passing)
    found[(flags & other) != 0] |= np.uint8(INVALID)
    if trimmed is not None:
        found[trimmed & ((found & PROCESSING) != 0)] ^= np.uint8(PROCESSING | TRIMMED)
    return found


def of_before(flags: Flags, *, samples: bool) -> Flags:
    """Flags in a file that an earlier zonda wrote, in today's bits.

    Its bits were 1 invalid, 2 trimmed or in a turnaround (which of the two is not known: both
    became 2), 4 opaque, 8 dead, 16 not recorded; any of them excluded.
    """
    processing = np.uint8(PROCESSING if samples else 0)
    return (flags & processing) | np.where(flags & ~processing, np.uint8(INVALID), np.uint8(0))
