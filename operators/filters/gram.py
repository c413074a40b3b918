"""Leading eigenpairs of G = A A^T of a stream A (detectors x samples), which is never formed, by
Lanczos iteration (full reorthogonalization, float64).

One step reads the stream once and gives A^T q and A A^T q together. It starts near the detector
mean and stops when

    |G u_i - sigma_i^2 u_i| <= residual * sigma_i^2   for every mode that is wanted.             (1)
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import partial
from threading import Semaphore
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import contracted, kernel
from zonda.core.numerics.chunks import TILE_DETECTORS, TILE_SAMPLES, chunks, empty
from zonda.core.numerics.random import normals, stream_key
from zonda.core.stream import Stream, columns
from zonda.core.types import Bools, Floats, Indices

from .source_mask import Inside

EMPTY = 1e-13
"""Share of the stream's energy, per detector, that G cannot tell from rounding."""

NOTHING = 1e-26
"""Share of the stream's energy below which what is left after subtraction is float64 rounding:
there is no further mode.
"""


@dataclass
class Ritz:
    """Approximate leading eigenpairs of G, largest first.

    Attributes
    ----------
    values
        sigma_i^2; may be longer than ``detectors``.
    detectors, times
        u_i (k, n_det) and v_i = A^T u_i (k, n_samp).
    residuals
        Left side of (1) over sigma_i^2.
    rank
        Rank of A as far as it matters here (a lower bound).
    """

    values: Floats
    detectors: Floats
    times: Floats
    residuals: Floats
    rank: int
    steps: int
    what: str = "singular modes"
    count: int = 0
    """How many of them are removed."""

    @property
    def energies(self) -> Floats:
        """|v_i|^2 of the modes."""
        return np.asarray(np.einsum("kt,kt->k", self.times, self.times))

    @classmethod
    def nothing(cls, n_det: int, n_samples: int, why: str = "no good detector") -> Ritz:
        """No mode at all."""
        return cls(
            np.zeros(0),
            np.zeros((0, n_det)),
            np.zeros((0, n_samples)),
            np.zeros(0),
            0,
            0,
            why,
        )


def lanczos(gram: Gram, wanted: int, residual: float, gap: float | None) -> Ritz:
    """The leading ``wanted`` modes of ``gram`` to a residual, equation (1).

    ``gap``: the largest ratio of a singular value to the one before at which the modes are of use;
    where every ratio is larger the iteration ends at residuals of a tenth. None: they are wanted in
    any case.
    """
    n = gram.n_good
    if n == 0:
        return Ritz.nothing(gram.use.size, gram.n_samples)
    if gram.energy == 0:
        return Ritz.nothing(gram.use.size, gram.n_samples, "the signal is zero")
    basis: list[Floats] = [near_the_mean(gram.use)]
    times: list[Floats] = []
    projected = np.zeros((n, n)) if n <= 4096 else np.zeros((512, 512))
    while True:
        m = len(basis)
        image, time = gram.apply(basis[-1])
        times.append(time)
        space = np.array(basis)
        column = space @ image
        projected[:m, m - 1] = projected[m - 1, :m] = column
        rest = image - column @ space
        again = space @ rest
        rest -= again @ space
        rest[~gram.use] = 0.0
        beta = float(np.linalg.norm(rest))
        values, vectors = np.linalg.eigh(projected[:m, :m])
        values = values[::-1]
        vectors = vectors[:, ::-1]
        floor = EMPTY * n * gram.energy
        residuals = beta * np.abs(vectors[-1]) / np.maximum(values, floor)
        exhausted = m == min(n, len(projected)) or gram.energy - float(values.sum()) <= floor
        converged = m > wanted and bool((residuals[:wanted] <= residual).all())
        if exhausted or converged or _gaps_are_closed(values, residuals, wanted, gap):
            k = min(wanted, m)
            rank = int(np.count_nonzero(values > floor))
            if not exhausted:
                rank += 1
            elif rank < n:  # G squares what is small: look at the remainder itself
                seen = vectors[:, :rank].T
                rank += gram.left(seen @ space, _combined(seen, times)) > NOTHING * gram.energy
            leading = vectors[:, :k].T
            return Ritz(
                values,
                np.array(leading @ space),
                _combined(leading, times),
                residuals[:k],
                rank,
                m,
            )
        if beta <= 1e-14 * gram.energy:  # an invariant subspace: go on in a new direction
            rest = gram.use * directions(m, gram.use.size)
            for _ in range(2):
                rest = rest - (space @ rest) @ space
            beta = float(np.linalg.norm(rest))
        basis.append(rest / beta)


def _gaps_are_closed(values: Floats, residuals: Floats, wanted: int, gap: float | None) -> bool:
    """True if no wanted mode is determined, as far as residuals of a tenth show."""
    if gap is None or len(values) < wanted + 3 or not (residuals[: wanted + 1] <= 0.1).all():
        return False
    size = np.sqrt(np.maximum(values, 0.0))
    return all(size[i + 1] > gap * size[i] for i in range(wanted))


def _combined(shares: Floats, times: list[Floats]) -> Floats:
    """Sums (k, n_samp) of series with their ``shares`` (k, m)."""
    found = empty((len(shares), times[0].size))
    for part in chunks(times[0].size):
        found[:, part] = shares @ np.array([series[part] for series in times])
    return found


MOST_COPIED = 100_000_000
"""Bytes of a tile's copy. Tiles of more detectors are shorter, down to `SHORTEST_TILE`, in memory
too: the bits are the same.
"""

SHORTEST_TILE = 64
"""Samples."""

ROWS = 16 * TILE_DETECTORS
"""Detectors of a tile that are worked on in float64 at a time."""

PARTS = 1 << 20
"""Bytes of the sums that a thread makes of several tiles before they are added."""

SEVERAL, MANY = 4, 1024
"""Tiles that are read together, and the number of detectors from which on: one tile of theirs
exceeds the cache, and long rows are read faster."""

LANES = 16
"""Partial sums: fixed, so that bits do not depend on the machine's vectors. Each takes two samples
at a time.
"""


class Usable:
    """Detectors that take part.

    Attributes
    ----------
    use
        (n_det,): those that are not flagged, until `judge` excludes some.
    n_used
        Number of good samples.
    not_finite, constant
        (n_det,): detectors that `judge` excluded.
    energy
        Sum of squares of the good detectors.
    scale
        (n_det,): by which rows are divided before modes are sought; None: by nothing.
    """

    def __init__(self, use: Bools, n_used: int) -> None:
        self.use = use
        self.n_used = n_used
        self.energy = 0.0
        self.scale: Floats | None = None
        self.not_finite = self.constant = np.zeros(use.size, bool)

    @property
    def n_good(self) -> int:
        """Number of good detectors."""
        return int(self.use.sum())

    def judge(self, total: Floats, square: Floats, noiseless: bool = False) -> bool:
        """Exclude detectors that are constant or not finite, by their sums (n_det,); returns
        whether there are any.

        ``noiseless``: without noise a constant detector is valid: it sees nothing.
        """
        finite = np.isfinite(square)
        with np.errstate(invalid="ignore"):
            spread = square - total**2 / max(1, self.n_used)
        steady = ~(spread > 1e-12 * square) & (not noiseless)
        self.not_finite, self.constant = self.use & ~finite, self.use & finite & steady
        self.use = self.use & finite & ~steady
        self.energy = float(np.where(self.use, square, 0.0).sum())
        return bool(self.not_finite.any() or self.constant.any())


class Gram(Usable):
    """G = A A^T as an operator on vectors over detectors, without flagged samples, flagged and dead
    detectors.

    Work is cut into absolute tiles of `tile_length` samples, whose parts are added in order: the
    bits do not depend on the number of threads. A spilled stream is read from its file, tile by
    tile, by as many threads as there is memory for copies: pages that are touched in a mapping
    count as the process's memory, and the system maps those around them too.

    Samples inside a source mask are replaced, in the copy of a tile, by the mean of the other
    detectors at that instant (each in units of its `scale`), 0 where there is none: linear in the
    data.

    The detectors' moments, which identify dead ones, come with the product that the iteration
    begins with; where no detector is dead, `apply` returns that product.
    """

    def __init__(
        self,
        stream: Stream,
        pool: ThreadPoolExecutor,
        use: Bools | None = None,
        noiseless: bool = False,
        inside: Inside | None = None,
        unit_rms: bool = False,
    ) -> None:
        """``use``: the detectors to use, where they are known; they are found otherwise.
        ``noiseless``: see `Usable.judge`. ``inside``: a source mask. ``unit_rms``: let `scale` be
        the detectors' rms about their means, where ``use`` is found."""
        self.good_samples = stream.observation.good_samples
        super().__init__(
            stream.observation.good_detectors if use is None else use,
            int(self.good_samples.sum()),
        )
        self.stream = stream
        self.pool = pool
        self.n_samples = stream.shape[1]
        self.length = tile_length(stream.shape[0], stream.dtype.itemsize)
        self.copied = isinstance(stream.array, np.memmap)
        self.inside, self.copied = inside, self.copied or inside is not None
        self.whole = (
            stream.means.get("signal") is None and bool(self.good_samples.all()) and not self.copied
        )
        copy = stream.shape[0] * min(self.length, self.n_samples) * stream.dtype.itemsize
        self._copies = Semaphore(max(1, min(stream.threads, 1 + stream.room // max(1, copy))))
        self._known: tuple[Floats, Floats, Floats] | None = None
        if use is None:
            if inside is not None:  # what fills the mask would bring the dead to life
                self.inside = None
                self.judge(
                    *self._pass(near_the_mean(self.use), np.flatnonzero(self.use), moments=True)[
                        :2
                    ],
                    noiseless,
                )
                self.inside = inside
            vector = near_the_mean(self.use)
            total, square, image, times = self._pass(vector, np.flatnonzero(self.use), moments=True)
            if inside is not None:
                self.energy = float(np.where(self.use, square, 0.0).sum())
            if (inside is not None or not self.judge(total, square, noiseless)) and not unit_rms:
                self._known = vector, image, times
            if unit_rms:
                self._scale_to_unit_rms(total, square)

    def _scale_to_unit_rms(self, total: Floats, square: Floats) -> None:
        """Set `scale` and the energy in its units; the sums (n_det,) are of all good samples. 1
        where nothing varies.
        """
        with np.errstate(invalid="ignore"):
            variance = square / max(1, self.n_used) - (total / max(1, self.n_used)) ** 2
        self.scale = np.sqrt(np.where(self.use & (variance > 0), variance, 1.0))
        self.energy = float(np.where(self.use, square / self.scale**2, 0.0).sum())

    def _on_tile(self, samples: slice, act: Callable[[NDArray[Any], int, int], Any]) -> Any:
        """``act(array, start, stop)`` on an array that has these samples, mean emission included
        and zero where flagged, from ``start`` to ``stop``. Waits until there is memory for a copy,
        if it needs one."""
        mean = self.stream.means.get("signal")
        good = self.good_samples[samples]
        if not self.copied and mean is None and good.all():
            return act(np.asarray(self.stream.array), samples.start, samples.stop)
        with self._copies:
            copy = columns(self.stream.array, samples)
            if mean is not None:
                for rows in chunks(copy.shape[0], ROWS):
                    copy[rows] += mean.evaluate(rows, samples)
            if self.inside is not None:
                self._fill(copy, samples, self.inside)
            copy[:, ~good] = 0
            return act(copy, 0, copy.shape[1])

    def _fill(self, tile: NDArray[Any], samples: slice, inside: Inside) -> None:
        """Replace the samples of a tile (n_det, n) that are inside the mask."""
        total = np.zeros(tile.shape[1])
        count = np.zeros(tile.shape[1], np.int64)
        masks = []
        unit = np.ones(len(tile)) if self.scale is None else self.scale
        for rows in chunks(len(tile), ROWS):
            masks.append(inside.at(rows, samples))
            fine = self.use[rows, None] & ~masks[-1] & np.isfinite(tile[rows])
            total += np.where(fine, tile[rows] / unit[rows, None], 0.0).sum(axis=0)
            count += fine.sum(axis=0)
        mean = total / np.maximum(count, 1)
        for rows, masked in zip(chunks(len(tile), ROWS), masks, strict=True):
            tile[rows] = np.where(masked, unit[rows, None] * mean, tile[rows])

    def _pass(
        self,
        q: Floats,
        rows: Indices,
        moments: bool = False,
    ) -> tuple[Floats, Floats, Floats, Floats]:
        """(A 1, squares, G q, A^T q), the first two (n_det,) only where wanted: one reading of the
        stream.
        """
        times, tiles = np.zeros(self.n_samples), chunks(self.n_samples, self.length)
        found = np.zeros((3, q.size))

        def work(group: list[slice]) -> Floats:
            parts = np.zeros((len(group), 3, q.size))
            if self.whole and self.length == TILE_SAMPLES:  # no tile needs a copy: all in one call
                at = slice(group[0].start, group[-1].stop)
                _products(
                    np.asarray(self.stream.array),
                    at.start,
                    at.stop,
                    q,
                    rows,
                    times[at],
                    moments,
                    parts,
                )
                return parts
            for samples, part in zip(group, parts, strict=True):
                self._on_tile(
                    samples,
                    partial(
                        _products,
                        q=q,
                        rows=rows,
                        v=times[samples],
                        moments=moments,
                        out=part[None],
                    ),
                )
            return parts

        threads = self.stream.threads
        most = max(1, PARTS // (24 * q.size))
        at_least = min(SEVERAL, most, -(-len(tiles) // threads))
        size = max(1, at_least, min(len(tiles) // (4 * threads), most) // SEVERAL * SEVERAL)
        for parts in self._each(work, [tiles[k : k + size] for k in range(0, len(tiles), size)]):
            for part in parts:
                found += part
        total, square, image = found
        return total, square, image, times

    def apply(self, q: Floats) -> tuple[Floats, Floats]:
        """(G q, A^T q): shapes (n_det,) and (n_samp,); A^T q is 0 at flagged samples. Rows of A are
        divided by `scale`.
        """
        if self._known is not None and np.array_equal(q, self._known[0]):
            return self._known[1], self._known[2]
        if self.scale is None:
            return self._pass(q, np.flatnonzero(self.use))[2:]
        image, times = self._pass(q / self.scale, np.flatnonzero(self.use))[2:]
        return image / self.scale, times

    def left(self, detectors: Floats, times: Floats) -> float:
        """Energy of A - sum u v^T, formed without cancellation."""

        def energy(samples: slice, array: NDArray[Any], start: int, stop: int) -> float:
            total = 0.0
            for rows in chunks(array.shape[0], ROWS):
                use = self.use[rows]
                rest = array[rows, start:stop][use].astype(np.float64)
                if self.scale is not None:
                    rest /= self.scale[rows][use, None]
                for u, v in zip(detectors, times, strict=True):
                    rest -= np.outer(u[rows][use], v[samples])
                total += float(np.einsum("dt,dt->", rest, rest))
            return total

        tiles = chunks(self.n_samples, self.length)
        return float(
            sum(self._each(lambda samples: self._on_tile(samples, partial(energy, samples)), tiles))
        )

    def _each(self, work: Callable[[Any], Any], items: list[Any]) -> Iterable[Any]:
        """Results of ``work``, in order."""
        return map(work, items) if self.stream.threads == 1 else self.pool.map(work, items)


def tile_length(n_detectors: int, itemsize: int) -> int:
    """Samples of a tile: as many as `MOST_COPIED` allows, `TILE_SAMPLES` or less by a power of
    two.
    """
    length = TILE_SAMPLES
    while n_detectors * length * itemsize > MOST_COPIED and length > SHORTEST_TILE:
        length //= 2
    return length


def near_the_mean(use: Bools) -> Floats:
    """A unit vector (n_det,) close to the mean that no mode is orthogonal to."""
    start = use * (1.0 + 0.01 * directions(0, use.size))
    return np.asarray(start / max(float(np.sqrt(start @ start)), 1e-300), np.float64)


def directions(number: int, n_detectors: int) -> Floats:
    """Fixed pseudo-random numbers over detectors (n_det,)."""
    return normals(stream_key(0, "CommonModeFilter", number), 0, n_detectors).astype(np.float64)


@kernel
def _products(array, start, stop, q, rows, v, moments, out):  # type: ignore[no-untyped-def]
    """v = A^T q of the samples start .. stop - 1, tile by tile: out (n_tile, 3, n_det) takes each
    tile's sums and squares, where wanted, and A v, of the detectors ``rows``."""
    together = SEVERAL if rows.size >= MANY else 1
    for k in range(0, -(-(stop - start) // TILE_SAMPLES), together):
        low = start + k * TILE_SAMPLES
        high = min(low + together * TILE_SAMPLES, stop)
        series = v[low - start : high - start]
        _project(array, low, high, q, rows, series)
        if moments:
            _image(array, low, high, rows, series, True, out[k:])
        else:
            _image(array, low, high, rows, series, None, out[k:])


@contracted
def _project(array, start, stop, q, rows, v):  # type: ignore[no-untyped-def]
    """v = A^T q at samples start .. stop - 1, eight detectors at a time."""
    n = stop - start
    v[:] = 0.0
    eights = rows.size // 8 * 8
    for k in range(0, eights, 8):
        q0, q1, q2, q3 = q[rows[k]], q[rows[k + 1]], q[rows[k + 2]], q[rows[k + 3]]
        q4, q5, q6, q7 = q[rows[k + 4]], q[rows[k + 5]], q[rows[k + 6]], q[rows[k + 7]]
        a, b = array[rows[k], start:stop], array[rows[k + 1], start:stop]
        c, d = array[rows[k + 2], start:stop], array[rows[k + 3], start:stop]
        e, f = array[rows[k + 4], start:stop], array[rows[k + 5], start:stop]
        g, h = array[rows[k + 6], start:stop], array[rows[k + 7], start:stop]
        for t in range(n):
            x = (q0 * np.float64(a[t]) + q1 * np.float64(b[t])) + (
                q2 * np.float64(c[t]) + q3 * np.float64(d[t])
            )
            y = (q4 * np.float64(e[t]) + q5 * np.float64(f[t])) + (
                q6 * np.float64(g[t]) + q7 * np.float64(h[t])
            )
            v[t] += x + y
    for k in range(eights, rows.size):
        q0, a = q[rows[k]], array[rows[k], start:stop]
        for t in range(n):
            v[t] += q0 * np.float64(a[t])


@contracted
def _image(array, begin, end, rows, series, moments, out):  # type: ignore[no-untyped-def]
    """out[:, 2] = A v of each tile of the samples begin .. end - 1, four detectors at a time;
    unless ``moments`` is None, out[:, 0] = A 1 and out[:, 1] = squares in the same reading."""
    half, last = np.uintp(LANES), rows.size - 1
    lanes = np.empty((4, 3, LANES))
    for k in range(0, rows.size, 4):
        for start in range(begin, end, TILE_SAMPLES):
            stop = min(start + TILE_SAMPLES, end)
            v, to = series[start - begin : stop - begin], out[(start - begin) // TILE_SAMPLES]
            a, b = array[rows[k], start:stop], array[rows[min(k + 1, last)], start:stop]
            c, d = (
                array[rows[min(k + 2, last)], start:stop],
                array[rows[min(k + 3, last)], start:stop],
            )
            n = np.uintp(stop - start)
            whole = n // (half + half) * (half + half)
            lanes[:] = 0.0
            for t in range(np.uintp(0), whole, half + half):
                for i in range(half):
                    x, y = v[t + i], v[t + half + i]
                    a0, a1 = np.float64(a[t + i]), np.float64(a[t + half + i])
                    b0, b1 = np.float64(b[t + i]), np.float64(b[t + half + i])
                    c0, c1 = np.float64(c[t + i]), np.float64(c[t + half + i])
                    d0, d1 = np.float64(d[t + i]), np.float64(d[t + half + i])
                    lanes[0, 2, i] += a0 * x + a1 * y
                    lanes[1, 2, i] += b0 * x + b1 * y
                    lanes[2, 2, i] += c0 * x + c1 * y
                    lanes[3, 2, i] += d0 * x + d1 * y
                    if moments is not None:  # decided when it is compiled
                        lanes[0, 0, i] += a0 + a1
                        lanes[1, 0, i] += b0 + b1
                        lanes[2, 0, i] += c0 + c1
                        lanes[3, 0, i] += d0 + d1
                        lanes[0, 1, i] += a0 * a0 + a1 * a1
                        lanes[1, 1, i] += b0 * b0 + b1 * b1
                        lanes[2, 1, i] += c0 * c0 + c1 * c1
                        lanes[3, 1, i] += d0 * d0 + d1 * d1
            for j in range(min(4, rows.size - k)):
                row, first, second, third = array[rows[k + j], start:stop], 0.0, 0.0, 0.0
                for i in range(LANES):
                    first += lanes[j, 0, i]
                    second += lanes[j, 1, i]
                    third += lanes[j, 2, i]
                for t in range(whole, n):
                    p = np.float64(row[t])
                    first += p
                    second += p * p
                    third += p * v[t]
                if moments is not None:
                    to[0, rows[k + j]] = first
                    to[1, rows[k + j]] = second
                to[2, rows[k + j]] = third
