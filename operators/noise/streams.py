"""White noise of every detector through a recursive filter, in blocks of any shape and order."""

from __future__ import annotations

import threading
from collections.abc import Mapping
from dataclasses import dataclass, field
from itertools import pairwise

import numba as nb
import numpy as np
from numba import uint64
from numpy.typing import NDArray

from zonda.core.kernels import contracted
from zonda.core.numerics.chunks import TILE_DETECTORS
from zonda.core.numerics.random import (
    TILE,
    Key,
    fill_normals,
    normal_scratch,
    normal_tile,
    normals,
)
from zonda.core.numerics.smooth import Series, SmoothField, series_into
from zonda.core.types import AnyFloats, Floats

from .one_over_f import PowerLawFilter

NOTHING = np.zeros(0, np.float32)

CHECKPOINT = 1 << 16
"""Samples between the filter states that are kept, so that blocks may be asked for in any order."""

_CHUNK = 256
"""Samples filtered together; their 16 x 256 deviates stay in the first-level cache."""


@dataclass
class _Tile:
    """Filter states of 16 detectors, (K, 16) float32, by the sample before which they stand."""

    kept: dict[int, NDArray[np.float32]]
    last: int = 0
    lock: threading.Lock = field(default_factory=threading.Lock)


class Streams:
    """Filtered white noise of every detector at every sample, of unit innovations.

    Detectors are made in absolute tiles of 16, side by side in vector registers. A state is kept
    every `CHECKPOINT` samples and where the latest request ended: visits in order cost nothing
    extra, any other order gives the same bits.

    Parameters
    ----------
    law
        The filter.
    key, start_key
        Random-stream keys of the white noise and of the stationary first states.
    """

    def __init__(
        self,
        law: PowerLawFilter,
        key: Key,
        start_key: Key,
    ) -> None:
        self.law = law
        self.key = key
        self.start_key = start_key
        padding = (
            -law.poles.size % 4
        )  # the kernel takes sections four at a time; a section with z = q passes its input on
        self._rate = np.append(law.poles, np.ones(padding)).astype(np.float32)
        self._tap = np.append(law.zeros - law.poles, np.zeros(padding)).astype(np.float32)
        self._pairs = np.ascontiguousarray(law.pairs, np.float32)
        self._tiles: dict[int, _Tile] = {}
        self._lock = threading.Lock()

    @property
    def variance(self) -> float:
        """Variance of the filter's output."""
        return float(self.law.variance)

    def add(
        self,
        detector: int,
        sample: int,
        out: AnyFloats,
        level: Series | None = None,
        common: NDArray[np.float32] = NOTHING,
        shared: float = 0.0,
        over: bool = False,
    ) -> None:
        """Add level * noise to ``out`` (n_det, n_samp), whose first element is (detector, sample).
        Thread-safe.

        ``level``: of the same detectors and samples; absent: 1. ``common`` (n_samp,): a stream that
        makes up the share ``shared`` of the variance. ``over``: put it into ``out``, whatever is
        there.
        """
        n_det, n_samp = out.shape
        if level is None:
            ones = SmoothField.constant(np.ones(n_det), sample + n_samp)
            level = ones.series(slice(0, n_det), slice(sample, sample + n_samp), out.dtype)
        shares = np.sqrt(np.array([1 - shared, shared])).astype(out.dtype)
        for low, high in _pieces(detector, detector + n_det, TILE_DETECTORS):
            rows = slice(low - detector, high - detector)
            part = Series(level.lines[rows], level.first, level.inside)
            self._add_tile(low, sample, out[rows], part, common, shares, over)

    def _add_tile(
        self,
        detector: int,
        sample: int,
        out: AnyFloats,
        level: Series,
        common: NDArray[np.float32],
        shares: AnyFloats,
        over: bool,
    ) -> None:
        """`add` for detectors of one tile."""
        number, lane = divmod(detector, TILE_DETECTORS)
        with self._lock:
            tile = self._tiles.get(number)
            if tile is None:
                tile = self._tiles[number] = _Tile({0: self._first_state(number)})
        with tile.lock:
            nearest = max(k for k in tile.kept if k <= sample)
            state = tile.kept[nearest].copy()
            law = (self._rate, self._tap, self._pairs)
            stop = sample + out.shape[1]
            pieces = [(nearest, sample), (sample, stop)]
            for begin, end in (p for piece in pieces for p in _pieces(*piece, CHECKPOINT)):
                part = slice(begin - sample, end - sample)
                rows = out
                if begin < sample:  # on the way there
                    part = slice(0, 0)
                    rows = out[:0]
                these = common[part], shares, over, rows[:, part]
                _filter(self.key, number, begin, end - begin, state, *law, lane, *level, *these)
                self._keep(tile, end, state)

    def _keep(self, tile: _Tile, sample: int, state: NDArray[np.float32]) -> None:
        if tile.last % CHECKPOINT and tile.last != sample:
            del tile.kept[tile.last]
        tile.kept[sample], tile.last = state.copy(), sample

    def _first_state(self, number: int) -> NDArray[np.float32]:
        n = len(self.law.start)
        sections = self.law.poles.size
        deviates = normals(self.start_key, 0, n * TILE_DETECTORS, stream=number).reshape(
            n,
            TILE_DETECTORS,
        )
        begun = self.law.start @ deviates
        state = np.zeros((self._rate.size + n - sections, TILE_DETECTORS), np.float32)
        state[:sections], state[self._rate.size :] = begun[:sections], begun[sections:]
        return state


class StreamsOfSlopes:
    """`Streams` of detectors with filters of their own, each in the tiles where it is wanted.

    Parameters
    ----------
    slopes
        (n_det,) which of the filters a detector has.
    made
        By slope.
    """

    def __init__(self, slopes: Floats, made: Mapping[float, Streams]) -> None:
        self._slopes = slopes
        self._made = made
        self.variance = np.array([made[slope].variance for slope in slopes.tolist()])

    def add(
        self,
        detector: int,
        sample: int,
        out: AnyFloats,
        level: Series,
        common: NDArray[np.float32],
        shared: float,
        over: bool,
    ) -> None:
        """Add noise as `Streams.add`; ``common`` (number of slopes, n_samp): one for each filter,
        in the order of ``made``.
        """
        n_det, n_samp = out.shape
        for low, high in _pieces(detector, detector + n_det, TILE_DETECTORS):
            rows = slice(low - detector, high - detector)
            part = Series(level.lines[rows], level.first, level.inside)
            tile = np.empty((high - low, n_samp), out.dtype)
            for slope in np.unique(self._slopes[low:high]).tolist():
                mine = common[list(self._made).index(slope)]
                self._made[slope].add(low, sample, tile, part, mine, shared, over=True)
                for row in np.flatnonzero(self._slopes[low:high] == slope):
                    if over:
                        out[rows][row] = tile[row]
                    else:
                        out[rows][row] += tile[row]


def _pieces(start: int, stop: int, size: int) -> list[tuple[int, int]]:
    """Cut a range at the multiples of ``size``."""
    cuts = [start, *range((start // size + 1) * size, stop, size), stop]
    return list(pairwise(cuts)) if stop > start else []


@contracted
def _filter(  # type: ignore[no-untyped-def]
    key,
    tile,
    start,
    n,
    state,
    rate,
    tap,
    pairs,
    lane,
    lines,
    cell,
    inside,
    common,
    shares,
    over,
    out,
):
    """Equations (2), (3) of `one_over_f` for 16 detectors x n samples; adds level * y of those from
    ``lane`` on to ``out`` (``over``: puts it there).

    ``state`` (K + 2 M, 16), K a multiple of 4, M the number of ``pairs`` (M, 4), is moved on by n
    samples. Deviate 16 t + lane of stream ``tile`` drives sample t. ``lines, cell, inside``: the
    `Series` of the level. shares[0] y + shares[1] common takes the place of y; an empty ``common``
    stream is 0.
    """
    x = np.empty(16 * _CHUNK, np.float32)
    words, bits, _ = normal_scratch()
    level, mixed, nothing = (
        np.empty(_CHUNK, out.dtype),
        np.empty(_CHUNK, out.dtype),
        np.zeros(_CHUNK, np.float32),
    )
    for done in range(0, n, _CHUNK):
        m = min(_CHUNK, n - done)
        origin = nb.int64(16) * (nb.int64(start) + done)
        if origin % TILE == 0 and 16 * m % TILE == 0:
            for k in range(16 * m // TILE):
                normal_tile(
                    key,
                    tile,
                    origin // TILE + k,
                    words,
                    bits,
                    x[k * TILE : (k + 1) * TILE],
                )
        else:
            fill_normals(key, tile, origin, x[: 16 * m])
        for k in range(0, rate.size, 4):
            _four_sections(x[: 16 * m], state[k : k + 4].ravel(), rate[k : k + 4], tap[k : k + 4])
        for k in range(pairs.shape[0]):
            _pair(x[: 16 * m], state[rate.size + 2 * k : rate.size + 2 * k + 2].ravel(), pairs[k])
        for d in range(uint64(out.shape[0])):
            row, size = out[d, done : done + m], level[:m]
            series_into(lines[d], cell, inside, start + done, size)
            if over:
                row[:] = 0
            shared = common[done : done + m] if common.size else nothing[:m]
            for t in range(uint64(m)):
                mixed[t] = shares[0] * x[uint64(16) * t + uint64(lane) + d] + shares[1] * shared[t]
            for t in range(uint64(m)):
                row[t] += size[t] * mixed[t]


@contracted
def _pair(x, s, pair):  # type: ignore[no-untyped-def]
    """Equation (3) in place on x (m, 16) and the pair's state s (2, 16), both flat."""
    a, b, to_real, to_imaginary = pair[0], pair[1], pair[2], pair[3]
    for t in range(uint64(x.size // 16)):
        now = uint64(16) * t
        for d in range(uint64(16)):
            y, r, i = x[now + d], s[d], s[d + uint64(16)]
            s[d] = r + (y - a * r + b * i)
            s[d + uint64(16)] = i - (a * i + b * r)
            x[now + d] = y + (to_real * r + to_imaginary * i)


@contracted
def _four_sections(x, s, rate, tap):  # type: ignore[no-untyped-def]
    """Four sections in place on x (m, 16) and their states s (4, 16), both flat. The inner loop
    fills vector registers.
    """
    q0, q1, q2, q3 = rate[0], rate[1], rate[2], rate[3]
    c0, c1, c2, c3 = tap[0], tap[1], tap[2], tap[3]
    for t in range(uint64(x.size // 16)):
        now = uint64(16) * t
        for d in range(uint64(16)):
            y, a = x[now + d], s[d]
            s[d] = a + (y - q0 * a)
            y, a = y + c0 * a, s[d + uint64(16)]
            s[d + uint64(16)] = a + (y - q1 * a)
            y, a = y + c1 * a, s[d + uint64(32)]
            s[d + uint64(32)] = a + (y - q2 * a)
            y, a = y + c2 * a, s[d + uint64(48)]
            s[d + uint64(48)] = a + (y - q3 * a)
            x[now + d] = y + c3 * a
