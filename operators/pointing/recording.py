"""Recorded pointing: times and directions of a file, laid out on the comb of samples that comes
nearest.

Nothing is repaired silently: `Comb` counts what it drops and flags what was not recorded.
"""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.flags import EXCLUDE_SAMPLE, NOT_RECORDED, Flags, Intervals
from zonda.core.types import Bools, Floats, Indices, Integers

UNEVEN = 0.25
"""rms of the intervals between rows, over whole numbers of samples, beyond which they are no comb
with jitter.
"""

OUT_OF_ORDER = "rows out of order, dropped"
"""Count of rows whose time is not between those of the rows around them."""


@dataclass(frozen=True)
class Recording:
    """Rows as they are in the file.

    Attributes
    ----------
    start
        What ``seconds`` count from; None: from the scene's time.
    seconds
        (n,) s; NaN where the file has no time.
    longitude, latitude
        (n,) rad: azimuth (north through east) and elevation, or right ascension and declination
        (ICRS).
    frame
        Which of the two.
    flags
        (n,) uint8, bits of `core.flags`.
    radec
        (n, 4) quaternions of the boresight on the sky (ICRS), where the file has them beside
        azimuth and elevation.
    intervals
        Parts of the scan, counted as ``seconds``; none where the file has none.
    """

    start: Instant | None
    seconds: Floats
    longitude: Floats
    latitude: Floats
    frame: Literal["azel", "icrs"]
    flags: Flags
    radec: Floats | None = None
    intervals: Intervals = field(default_factory=dict)


@dataclass
class Scan:
    """A part of a recording without long gaps, on the comb of its samples.

    Attributes
    ----------
    seconds
        (n,) as recorded; between rows, where samples are missing, evenly spaced.
    rate
        Hz, of the comb.
    longitude, latitude
        (n,) rad, interpolated where nothing was recorded.
    flags
        (n,) bits of `core.flags`: those of the rows; `NOT_RECORDED` in a gap, and where a row is
        not a number.
    radec
        (n, 4) as recorded, interpolated where nothing was.
    """

    seconds: Floats
    rate: float
    longitude: Floats
    latitude: Floats
    flags: Flags
    radec: Floats | None = None


@dataclass
class Comb:
    """The scans of a recording, and what was counted on the way: rows dropped, samples flagged."""

    scans: list[Scan]
    counts: dict[str, int] = field(default_factory=dict)


def comb(recording: Recording, split: float, place: str) -> Comb:
    """Lay a recording out on combs of samples; a gap longer than ``split`` [s] begins another scan.

    Drops the fewest rows that leave the times in order (`longest_rising`): a single stamp that
    jumps ahead or back goes alone.

    Raises
    ------
    InputError
        Fewer than two usable rows, or intervals so uneven (`UNEVEN`) that there is no comb.
    """
    counts = dict[str, int]()
    seconds = recording.seconds
    rows = np.flatnonzero(np.isfinite(recording.seconds))

    def keep(what: str, chosen: NDArray[Any]) -> None:
        nonlocal rows
        kept = rows[chosen]
        counts[what], rows = len(rows) - len(kept), kept

    counts["rows without a time, dropped"] = len(seconds) - len(rows)
    keep("rows repeated, dropped", np.diff(seconds[rows], prepend=-np.inf) != 0)
    keep(OUT_OF_ORDER, longest_rising(seconds[rows]))
    if len(rows) < 2:
        raise InputError(
            f"has {len(rows)} rows with increasing times",
            place=place,
            cure="check the column of times and its unit",
        )
    step = float(np.median(np.diff(seconds[rows])))
    late = np.diff(seconds[rows], prepend=-np.inf) >= step / 2
    keep("rows closer than half a sample to the one before, dropped", late)
    seconds = seconds[rows]
    interval = np.diff(seconds) / step
    ahead = np.maximum(np.rint(interval), 1.0)
    near = ahead * step <= split
    uneven = float(np.sqrt(np.mean((interval - ahead)[near] ** 2))) if near.any() else 0.0
    if uneven > UNEVEN:
        raise InputError(
            f"the intervals between rows vary by {100 * uneven:.0f} % of a sample ({1e3 * step:.4g}"
            " ms): there is no sample rate",
            place=place,
            cure="resample it to equal steps first",
        )
    good = np.isfinite(recording.longitude[rows]) & np.isfinite(recording.latitude[rows])
    if recording.radec is not None:
        good &= np.isfinite(recording.radec[rows]).all(axis=1)
    scans = []
    alone = 0
    for part in np.split(np.arange(len(rows)), np.flatnonzero(~near) + 1):
        if np.count_nonzero(good[part]) < 2:
            alone += len(part)
            continue
        scans.append(
            _scan(
                recording,
                rows[part],
                seconds[part],
                ahead[part[:-1]].astype(np.int64),
                good[part],
            )
        )
    counts["rows alone between gaps, dropped"] = alone
    if not scans:
        raise InputError(
            "no two consecutive directions are numbers",
            place=place,
            cure="check the columns",
        )
    missing = sum(len(s.seconds) for s in scans) - (len(rows) - alone)
    flagged = sum(int(np.count_nonzero(s.flags & NOT_RECORDED)) for s in scans)
    counts["samples in gaps, flagged"] = missing
    counts["samples whose row is not a number, flagged"] = flagged - missing
    excluded = sum(int(np.count_nonzero(s.flags & (EXCLUDE_SAMPLE & ~NOT_RECORDED))) for s in scans)
    counts["samples flagged in the file"] = excluded
    return Comb(scans, counts)


def longest_rising(values: Floats) -> Indices:
    """Indices of the longest strictly rising subsequence of ``values`` (n,); the others are out of
    order, however far.

    Of several such choices, that whose values rise least (Schensted 1961); of equal values the
    first. O(n log n).
    """
    if (np.diff(values) > 0).all():
        return np.arange(len(values))
    tails, ends = list[float](), list[int]()  # of the lowest chain of each length
    before = np.full(len(values), -1, np.intp)
    for i, value in enumerate(values.tolist()):
        k = bisect_left(tails, value)
        if tails[k : k + 1] != [value]:
            tails[k : k + 1], ends[k : k + 1] = [value], [i]
            before[i] = ends[k - 1] if k else -1
    chain = np.empty(len(tails), np.intp)
    i = ends[-1]
    for k in reversed(range(len(chain))):
        chain[k], i = i, int(before[i])
    return chain


def _scan(
    recording: Recording,
    rows: Indices,
    seconds: Floats,
    ahead: Integers,
    good: Bools,
) -> Scan:
    slot = np.r_[0, np.cumsum(ahead)]
    every = np.arange(slot[-1] + 1)
    flags = np.full(len(every), NOT_RECORDED, np.uint8)
    flags[slot[good]] = 0
    flags[slot] |= recording.flags[rows]
    longitude = np.unwrap(recording.longitude[rows][good])
    radec = (
        None if recording.radec is None else _turned(every, slot[good], recording.radec[rows][good])
    )
    return Scan(
        seconds=np.interp(every, slot, seconds),
        rate=float(slot[-1] / (seconds[-1] - seconds[0])),
        longitude=np.interp(every, slot[good], longitude),
        latitude=np.interp(every, slot[good], recording.latitude[rows][good]),
        flags=flags,
        radec=radec,
    )


def _turned(every: Indices, at: Indices, quaternions: Floats) -> Floats:
    """Quaternions (n, 4) at ``every`` slot from those known ``at`` some slots: unchanged there,
    interpolated between.
    """
    turn = np.where(np.sum(quaternions[1:] * quaternions[:-1], axis=1) < 0, -1.0, 1.0)
    steady = quaternions * np.cumprod(np.r_[1.0, turn])[:, None]  # q and -q are one rotation
    found = np.stack([np.interp(every, at, q) for q in steady.T], axis=1)
    missing = np.ones(len(every), bool)
    missing[at] = False
    found[missing] /= np.linalg.norm(found[missing], axis=1, keepdims=True)
    return found
