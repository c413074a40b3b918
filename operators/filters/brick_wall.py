"""The arithmetic of a brick-wall high-pass filter of whole scans, without phase.

A detector's scan x_n, n = 0 .. N - 1, loses a polynomial and then every cosine below the cut:

    y = x - P x,   P x = p + sum_{k < K} a_k cos(pi k (n + 1/2) / N),   K = ceil(2 N f / f_s),
    (1)

p the least-squares polynomial, a_k the DCT-II of x - p: the brick wall on the evenly extended scan,
which has no jump at its ends (a periodic brick wall wraps a drift around). The low part is smooth,
so it is formed on a coarse series: with B the cubic B-spline and knots every q = N / M samples,

    s_m = sum_n x_n B((n + 1/2) / q - m),   P x = sum_m c_m B((n + 1/2) / q - m),   (2)

where c follows from s by a DCT-I of length M + 1 and a division by sinc(k / 2M)^8, the B-spline's
response both ways. The error of the low part is (K / 2M)^4 at the cut, less below it; the
polynomial is exact, because cubic B-splines hold it.
"""

from __future__ import annotations

import math
import threading
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from scipy.fft import dct, next_fast_len

from zonda.core.kernels import contracted
from zonda.core.numerics.chunks import TILE_DETECTORS, chunks, empty
from zonda.core.numerics.smooth import product, spline_basis
from zonda.core.types import AnyFloats, Indices, Integers

SHORTEST_STEP = 8
"""Samples per coarse knot below which the full DCT is cheaper and is used instead."""

GROUP = 16
"""Samples that are worked on together: five knots reach all of them, or six where knots lie closer.
"""

FEW, CLOSE = 128, 1 << 12
"""Largest numbers of cosines and knots for which sums over them are faster than transforms, and
their matrices small (4 MB).
"""

ABREAST = TILE_DETECTORS
"""Rows whose sums are formed side by side."""

NONE = np.zeros(0, np.intp)


@dataclass
class HighpassPlan:
    """Everything equation (2) needs for scans of one length.

    Attributes
    ----------
    n, cut
        Samples N, and the number K of cosines removed (0: the scan is shorter than one cycle;
        polynomial only).
    knots
        M; 0: use the full DCT.
    first
        (n_group,): column of s and c, m + 1, of the first knot that the `GROUP` samples from GROUP
        g on reach.
    taps
        Knots from there on that the samples of a group reach, 5 or 6.
    modes
        (degree + 1, M + 3): coarse coefficients of orthonormal polynomials; `spread_modes`, the
        same shape, their s.
    polynomials
        (degree + 1, N): the polynomials themselves where the full DCT is used.
    response
        (K,): factor from the DCT-I of s to that of c.
    sums
        Where cosines are few, matrices that make c of s in the place of transforms: see `_sums`.
    """

    n: int
    cut: int
    knots: int
    first: Integers
    taps: int
    modes: AnyFloats
    spread_modes: AnyFloats
    polynomials: AnyFloats
    response: AnyFloats
    sums: tuple[tuple[AnyFloats, AnyFloats], ...] = ()
    _weights: dict[np.dtype[Any], AnyFloats] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock, repr=False, compare=False)

    def apply(self, rows: AnyFloats, bad: Indices = NONE) -> int:
        """Filter ``rows`` (n_det, N), C order, in place. Returns how many samples were not finite;
        they stay as they were.

        ``bad``: flagged samples, bridged before filtering.
        """
        done = np.zeros(len(rows), bool)
        if self.knots and not bad.size:
            coarse = self._spread(rows)
            done[:] = np.isfinite(coarse).all(axis=1)
            coarse[~done] = 0
            self._subtract(rows, self._low(coarse))
        return sum(self._bridged(rows[d], bad) for d in np.flatnonzero(~done))

    def _bridged(self, row: AnyFloats, bad: Indices) -> int:
        """`apply` to one row (N,) that has gaps or no coarse series."""
        lost = np.flatnonzero(~np.isfinite(row))
        gaps = np.union1d(bad, lost)
        if gaps.size == self.n:
            return int(lost.size)
        kept = row[lost]
        bridge(row, gaps)
        if self.knots:
            self._subtract(row[None], self._low(self._spread(row[None])))
        else:
            row -= self._low_exact(row.astype(np.float64)).astype(row.dtype)
        row[lost] = kept
        return int(lost.size)

    def _spread(self, rows: AnyFloats) -> AnyFloats:
        s = np.empty((len(rows), self.knots + 3))
        for start in range(0, len(rows), ABREAST):
            part = rows[start : start + ABREAST]
            sums = np.zeros((self._columns, ABREAST))
            _spread(part, self.first, self.weights(rows.dtype), sums)
            s[start : start + ABREAST] = sums[: s.shape[1], : len(part)].T
        return s

    def _subtract(self, rows: AnyFloats, low: AnyFloats) -> None:
        c = np.zeros((len(rows), self._columns), rows.dtype)
        c[:, : low.shape[1]] = low
        _subtract(rows, self.first, self.weights(rows.dtype), c)

    @property
    def _columns(self) -> int:
        """Columns of s and c, with those of no weight."""
        return self.knots - 1 + self.taps

    def weights(self, kind: np.dtype[Any]) -> AnyFloats:
        """(n_group, taps, `GROUP`) of type ``kind``: B at the groups' knots at their samples; 0
        past the end.
        """
        with self._lock:
            if kind not in self._weights:
                self._weights[kind] = _weights(self.n, self.knots, self.first, self.taps, kind)
        return self._weights[kind]

    def _low(self, s: AnyFloats) -> AnyFloats:
        """Coarse coefficients c_m, m = -1 .. M + 1, of P x from s, (n_det, M + 3) each."""
        if self.sums:
            half = -(-s.shape[1] // 2)
            left = s[:, :half]
            right = s[:, : -half - 1 : -1]
            even, odd = (
                product(product(x, a), b)
                for x, (a, b) in zip((left + right, left - right), self.sums, strict=True)
            )
            c = np.empty_like(s)
            c[:, :half], c[:, : -half - 1 : -1] = even + odd, even - odd
            return c
        # not with BLAS, whose bits in one row depend on how many rows there are and where it stands
        # among them
        amplitude = np.einsum("dm,km->dk", s, self.modes)
        rest = s - np.einsum("dk,km->dm", amplitude, self.spread_modes)
        return np.asarray(np.einsum("dk,km->dm", amplitude, self.modes) + self._cosines(rest))

    def _cosines(self, s: AnyFloats) -> AnyFloats:
        """The part of c that cosines make of s, (n_det, M + 3) each: a symmetric matrix."""
        c = np.zeros(s.shape)
        if self.cut:
            folded = s[:, 1:-1].copy()
            folded[:, [0, -1]] *= 2
            folded[:, 1] += s[:, 0]
            folded[:, -2] += s[:, -1]
            spectrum = dct(folded, 1)
            spectrum[:, self.cut :] = 0
            spectrum[:, : self.cut] *= self.response
            c[:, 1:-1] = dct(spectrum, 1)
            c[:, 0], c[:, -1] = c[:, 2], c[:, -3]
        return c

    def adjoint(self, rows: AnyFloats) -> None:
        """Subtract P^T x from float64 ``rows`` (n_det, N) in place; with m the polynomials of
        `modes`, S what they spread and R `_cosines`, that of equation (2) is

            P^T x = B^T c,   c = R s + m^T (m s - S R s),   s = B x.
        """
        if not self.knots:
            for row in rows:
                low = self._cosines_exact(row)
                row -= low + (self.polynomials @ (row - low)) @ self.polynomials
            return
        s = self._spread(rows)
        c = self._cosines(s)
        amplitude = np.einsum("dm,km->dk", s, self.modes)
        amplitude -= np.einsum("dm,km->dk", c, self.spread_modes)
        self._subtract(rows, c + np.einsum("dk,km->dm", amplitude, self.modes))

    def _low_exact(self, x: AnyFloats) -> AnyFloats:
        """P x of equation (1), directly."""
        fit = (self.polynomials @ x) @ self.polynomials
        return fit + self._cosines_exact(x - fit)

    def _cosines_exact(self, x: AnyFloats) -> AnyFloats:
        """The cosines below the cut of a row (N,)."""
        from scipy.fft import dct, idct

        spectrum = dct(x, type=2)
        spectrum[self.cut :] = 0
        return idct(spectrum, type=2)


def first_kept(n: int, frequency: float) -> int:
    """Number of the first cosine that a cut at ``frequency`` cycles per sample keeps of ``n``; 0:
    all but means and lines.
    """
    cycles = n * frequency
    return max(1, math.ceil(2 * cycles - 1e-9)) if cycles >= 1 else 0


@lru_cache(maxsize=2)
def plan_highpass(n: int, frequency: float, degree: int, oversampling: float) -> HighpassPlan:
    """The plan for scans of ``n`` samples and a cut at ``frequency`` cycles per sample; the rest as
    in `HighpassFilter`.

    Kept for the next scan of that length: not to be changed.
    """
    cut = first_kept(n, frequency)
    degree = min(degree if cut else min(degree, 1), n - 1)
    if cut:
        degree = min(degree, cut - 1)
    knots = next_fast_len(max(16, math.ceil(oversampling * cut / 2)))
    if not cut or n < SHORTEST_STEP * knots:
        knots = 0
    if not knots:
        powers = np.polynomial.legendre.legvander((2 * np.arange(n) + 1) / n - 1, degree)
        basis = np.linalg.qr(powers)[0].T.copy()
        none = np.zeros((0, 0))
        return HighpassPlan(n, cut, 0, np.zeros(0, np.int64), 5, none, none, basis, np.zeros(0))
    # polynomials through their B-spline coefficients: B * (t^2) = t^2 + 1/3, B * (t^3) = t^3 + t
    t = (np.arange(knots + 3) - 1) * (2 / knots) - 1
    third = (2 / knots) ** 2 / 3
    raw = np.array([np.ones_like(t), t, t * t - third, t**3 - 3 * third * t])[: degree + 1]
    spread = np.zeros_like(raw)
    for part in chunks(n):
        cell, weights = _around(part, n, knots)
        time = (np.arange(part.start, part.stop) + 0.5) * (2 / n) - 1
        edges = np.flatnonzero(np.diff(cell, prepend=-1))  # of the knots' intervals
        for j, weight in enumerate(weights):
            for s in spread:
                s[cell[edges] + j] += np.add.reduceat(weight, edges)
                weight *= time
    norm = np.linalg.inv(np.linalg.cholesky(raw @ spread.T))
    sinc = np.sinc(np.arange(cut) / (2 * knots)) ** 4
    response = 1 / (2 * n * sinc**2)
    modes = norm @ raw
    spread = norm @ spread
    sums = _sums(modes, spread, response) if 0 < cut <= FEW and knots <= CLOSE else ()
    return HighpassPlan(
        n, cut, knots, *_groups(n, knots), modes, spread, np.zeros((0, n)), response, sums
    )


def _sums(
    modes: AnyFloats,
    spread: AnyFloats,
    response: AnyFloats,
) -> tuple[tuple[AnyFloats, AnyFloats], ...]:
    """For what is even and what is odd about the middle, matrices A (h, k) and B (k, h), h the half
    of the M + 3 knots: (s_j +- s_(M - j)) A B is that part of c, where equation (2) is written out
    in polynomials p and cosines C,

        c = a p + r (s - a S) C^T C,   a = s p^T,   S what p spreads,
        r = 2 (response), and twice that for k > 0.   (3)
    """
    knots = modes.shape[1]
    cosines = np.cos(
        np.pi * np.multiply.outer(np.arange(response.size), (np.arange(knots) - 1) / (knots - 3))
    )
    factor = np.where(np.arange(response.size) > 0, 4.0, 2.0) * response
    half = -(-knots // 2)
    found = []
    for parity in range(2):
        p = modes[parity::2]
        c = cosines[parity::2]
        r = factor[parity::2, None]
        into = np.concatenate([p, c])[:, :half].T.copy()
        if knots % 2:
            into[-1] /= 2  # the knot in the middle comes twice
        out = np.concatenate([p - product(product(spread[parity::2], c.T), r * c), r * c])
        found.append((into, out[:, :half].copy()))
    return tuple(found)


def _around(samples: slice, n: int, knots: int) -> tuple[Integers, AnyFloats]:
    """Each sample's interval (m,), counted from the first knot, and B at the four knots around it
    (4, m).
    """
    position = (np.arange(samples.start, samples.stop) + 0.5) * (knots / n)
    cell = position.astype(np.int64)
    return cell, spline_basis(position - cell)


def _groups(n: int, knots: int) -> tuple[Integers, int]:
    """`HighpassPlan.first` and ``taps``."""
    begin = np.arange(0, n, GROUP)
    first, last = (
        ((at + 0.5) * (knots / n)).astype(np.int64)
        for at in (begin, np.minimum(begin + GROUP, n) - 1)
    )
    return first, max(5, 4 + int((last - first).max()))


def _weights(
    n: int,
    knots: int,
    first: Integers,
    taps: int,
    kind: np.dtype[Any],
) -> AnyFloats:
    """See `HighpassPlan.weights`."""
    found: AnyFloats = empty((first.size, taps * GROUP), kind).reshape(first.size, taps, GROUP)
    for samples in chunks(first.size * GROUP):
        cell, weights = _around(samples, n, knots)
        weights[:, max(n - samples.start, 0) :] = 0.0
        part = slice(samples.start // GROUP, samples.stop // GROUP)
        later = cell.reshape(-1, GROUP) - first[part, None]
        each = weights.reshape(4, -1, GROUP)
        for k in range(taps):
            found[part, k] = sum(
                np.where(later == k - j, each[j], 0.0)
                for j in range(max(0, k + 4 - taps), min(4, k + 1))
            )
    return found


def bridge(row: AnyFloats, gaps: Indices) -> None:
    """Replace the samples ``gaps`` by straight lines between their good neighbours (held constant
    at the ends).
    """
    good = np.ones(row.size, bool)
    good[gaps] = False
    known = np.flatnonzero(good)
    row[gaps] = np.interp(gaps, known, row[known])


def bridge_adjoint(row: AnyFloats, gaps: Indices) -> None:
    """Transpose of `bridge`: the samples ``gaps`` are shared out to their good neighbours."""
    known = np.delete(np.arange(row.size), gaps)
    behind = np.searchsorted(known, gaps)
    left, right = (known[np.clip(k, 0, known.size - 1)] for k in (behind - 1, behind))
    share = np.where(right > left, (gaps - left) / np.maximum(right - left, 1), 0.0)
    values = row[gaps]
    row[gaps] = 0.0
    np.add.at(row, left, (1 - share) * values)
    np.add.at(row, right, share * values)


@contracted
def _spread(rows, first, weights, s):  # type: ignore[no-untyped-def]
    """s[first + j, d] += sum_n weights[j, n] rows[d, n] of up to `ABREAST` rows (n_det, N): s
    (n_knot, ABREAST).

    Groups are turned round, so that rows are neighbours: no vector is ever summed up.
    """
    n_det, n, w = np.uintp(rows.shape[0]), np.uintp(rows.shape[1]), weights
    x = np.zeros((GROUP, ABREAST), rows.dtype)
    for g in range(np.uintp(first.size)):
        start = g * np.uintp(GROUP)
        length = min(np.uintp(GROUP), n - start)
        if length < np.uintp(GROUP):
            x[:] = 0
        for d in range(n_det):
            for t in range(length):
                x[t, d] = rows[d, start + t]
        m = np.uintp(first[g])
        for j in range(np.uintp(w.shape[1])):
            for d in range(np.uintp(ABREAST)):
                a = (x[0, d] * w[g, j, 0] + x[1, d] * w[g, j, 1]) + (
                    x[2, d] * w[g, j, 2] + x[3, d] * w[g, j, 3]
                )
                b = (x[4, d] * w[g, j, 4] + x[5, d] * w[g, j, 5]) + (
                    x[6, d] * w[g, j, 6] + x[7, d] * w[g, j, 7]
                )
                e = (x[8, d] * w[g, j, 8] + x[9, d] * w[g, j, 9]) + (
                    x[10, d] * w[g, j, 10] + x[11, d] * w[g, j, 11]
                )
                f = (x[12, d] * w[g, j, 12] + x[13, d] * w[g, j, 13]) + (
                    x[14, d] * w[g, j, 14] + x[15, d] * w[g, j, 15]
                )
                s[m + j, d] += np.float64((a + b) + (e + f))


AT_ONCE = 64
"""Groups that all rows pass through together, while their weights are in the cache."""


@contracted
def _subtract(rows, first, weights, c):  # type: ignore[no-untyped-def]
    """rows[d, n] -= sum_j weights[j, n] c[d, first + j]."""
    n_det, n, w = np.uintp(rows.shape[0]), np.uintp(rows.shape[1]), weights
    one, two, three, four, five = np.uintp(1), np.uintp(2), np.uintp(3), np.uintp(4), np.uintp(5)
    whole = n // np.uintp(GROUP)
    for begin in range(np.uintp(0), whole, np.uintp(AT_ONCE)):
        for d in range(n_det):
            for g in range(begin, min(begin + np.uintp(AT_ONCE), whole)):
                m, start = np.uintp(first[g]), g * np.uintp(GROUP)
                c0, c1, c2, c3, c4 = (
                    c[d, m],
                    c[d, m + one],
                    c[d, m + two],
                    c[d, m + three],
                    c[d, m + four],
                )
                for i in range(np.uintp(GROUP)):
                    low = (
                        c0 * w[g, 0, i]
                        + c1 * w[g, 1, i]
                        + c2 * w[g, 2, i]
                        + c3 * w[g, 3, i]
                        + c4 * w[g, 4, i]
                    )
                    rows[d, start + i] -= low
                if w.shape[1] > 5:
                    c5 = c[d, m + five]
                    for i in range(np.uintp(GROUP)):
                        rows[d, start + i] -= c5 * w[g, 5, i]
    for d in range(n_det):
        for t in range(whole * np.uintp(GROUP), n):
            for j in range(np.uintp(w.shape[1])):
                rows[d, t] -= (
                    c[d, np.uintp(first[whole]) + j] * w[whole, j, t - whole * np.uintp(GROUP)]
                )
