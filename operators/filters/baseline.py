"""Smooth functions of time that are fitted to each detector's scan and removed.

With B (K, N) the functions, and B_g, x_g their values and the data at the samples that are used,

    y = x - B^T (B_g B_g^T)^-1 B_g x_g,   (1)

a linear least-squares fit, in float64. Samples that are flagged, not finite or in a source mask are
not used, but the fit is subtracted there too. Functions that no used sample determines get the
coefficient 0 (pseudoinverse).

A mask leaves a detector that looks into it most of the time too little to go by: the fit would be
an extrapolation. The mask of a detector is not used where fewer functions are determined without
its samples, or where at these the variance of the fit,

    mean over the masked samples of b_t^T (B_g B_g^T)^-1 b_t,   (2)

is larger than that of a sample.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba as nb
import numpy as np

from zonda.core.kernels import contracted, kernel
from zonda.core.numerics.smooth import spline_basis
from zonda.core.types import Floats, Integers

from .rows import AT_ONCE, Mask, Rows, read, write

DETERMINED = 1e-14
"""Eigenvalues of B_g B_g^T below this share of the largest count as zero."""

MANY = 100
"""Functions from which those that overlap with few others are solved for by a factor with as few
diagonals.
"""


Bins = tuple[Integers, Integers]
"""End of each run of samples in one bin (`runs`), and its bin."""
NO_BINS: Bins = np.empty(0, np.int64), np.empty(0, np.int64)


@dataclass(frozen=True)
class Basis:
    """Functions of time of which the same few reach all samples of a run.

    Attributes
    ----------
    functions
        (taps, N): the values of the functions that reach each sample.
    stops
        (n_run,) end of each run of samples, at most `AT_ONCE` of them.
    firsts
        (n_run,) number of the first function that reaches the run; those that follow it are the
        next taps - 1.
    size
        K, the number of functions.
    """

    functions: Floats
    stops: Integers
    firsts: Integers
    size: int

    @classmethod
    def of(cls, functions: Floats, first: Integers, size: int) -> Basis:
        """From the number (N,) of the first function that reaches each sample."""
        stops = runs(first)
        return cls(np.ascontiguousarray(functions), stops, first[stops - 1], size)

    def inverse(self, use: Mask) -> Floats:
        """(K, K): the pseudoinverse of B_g B_g^T for the samples ``use`` (N,)."""
        return _inverse(self.normal(use))

    def solver(self, use: Mask) -> Floats:
        """Matrix that `solved` takes for the samples ``use`` (N,): `inverse`, or for `MANY`
        functions, all of them determined and each overlapping with few, a factor (taps, K).
        """
        normal = self.normal(use)
        factor = np.zeros((len(self.functions), self.size))
        if self.size < max(MANY, len(factor) + 1) or not _factor(
            normal,
            DETERMINED * normal.diagonal().max(),
            factor,
        ):
            return _inverse(normal)
        return factor

    def normal(self, use: Mask) -> Floats:
        """(K, K): B_g B_g^T for the samples ``use`` (N,)."""
        normal = np.zeros((self.size, self.size))
        _normal(use, self.functions, self.stops, self.firsts, normal)
        return normal

    def sums(self, rows: Rows, use: Mask) -> Floats:
        """(n_det, K): B_g x_g; not finite where a sample of the row is not, used or not."""
        return self.sums_of_bins(rows, use, NO_BINS, 0)[0]

    def sums_of_bins(self, rows: Rows, use: Mask, bins: Bins, number: int) -> tuple[Floats, Floats]:
        """(n_det, K): `sums`, and (n_det, number) sums over bins, in one reading."""
        n = len(rows.values)
        sums = np.zeros((n, self.size))
        totals = np.zeros((n, number))
        _sums(*rows, use, self.functions, self.stops, self.firsts, *bins, sums, totals)
        return sums, totals

    def subtract(
        self,
        rows: Rows,
        coefficients: Floats,
        bins: Bins = NO_BINS,
        means: Floats | None = None,
    ) -> None:
        """Subtract B^T ``coefficients`` (n_det, K), and ``means`` (n_det, number) of bins."""
        means = np.empty((0, 0)) if means is None else means
        arrays = self.functions, self.stops, self.firsts, *bins
        _subtract(*rows, *arrays, coefficients, means)


def runs(value: Integers) -> Integers:
    """Ends of runs of `AT_ONCE` samples or less, each within one chunk, whose ``value`` (N,) is the
    same.
    """
    starts = np.append(True, value[1:] != value[:-1])
    starts[::AT_ONCE] = True
    return np.append(np.flatnonzero(starts)[1:], len(value))


def polynomials(n: int, order: int) -> Basis:
    """Legendre polynomials up to ``order`` over a scan of ``n`` samples."""
    time = (2 * np.arange(n) + 1) / n - 1
    return Basis.of(
        np.asarray(np.polynomial.legendre.legvander(time, order).T, np.float64),
        np.zeros(n, np.int64),
        order + 1,
    )


def splines(n: int, spacing: float) -> Basis:
    """Cubic B-splines with knots every ``spacing`` samples, a whole number of intervals centred on
    a scan of ``n`` samples.
    """
    # knots inside the scan, half of an interval or less from either end
    inner = max(1, math.ceil((n - 1) / spacing))
    position = (np.arange(n) - (n - 1) / 2) / spacing + (inner - 1) / 2 + 1
    first = np.clip(np.floor(position).astype(np.int64), 0, inner)
    return Basis.of(spline_basis(position - first), first, inner + 4)


@dataclass(frozen=True)
class Fit:
    """Equation (1) for scans whose samples ``use`` (N,) are used; ``inverse``: `Basis.inverse` of
    these, or `Basis.solver`.
    """

    basis: Basis
    use: Mask
    inverse: Floats

    @classmethod
    def of(cls, basis: Basis, use: Mask) -> Fit:
        """A fit of these functions to the samples ``use`` (N,)."""
        return cls(basis, use, basis.solver(use))

    def remove(self, rows: Rows, masked: Mask | None = None) -> int:
        """Equation (1) on rows in place. ``masked`` (n_det, N): samples that are not used, of each
        detector, where equation (2) allows it.

        Returns how many samples were not finite; they stay as they were.
        """
        found, spoilt = self.coefficients(rows, masked)
        self.basis.subtract(rows, found)
        return spoilt

    def coefficients(self, rows: Rows, masked: Mask | None = None) -> tuple[Floats, int]:
        """Coefficients that `remove` subtracts, (n_det, K), and the number of samples that are not
        finite.
        """
        sums = self.basis.sums(rows, self.use)
        spoilt = 0
        found = solved(self.inverse, sums)
        other = ~np.isfinite(sums).all(axis=1)
        if masked is not None:
            other |= masked.any(axis=1)
        for d in np.flatnonzero(other):
            row = rows.double(slice(d, d + 1), len(self.use))
            finite = np.isfinite(row[0])
            row[0, ~finite] = 0.0
            use = self.use
            inverse = self.inverse
            if not finite.all():
                use = use & finite
                inverse = self.basis.solver(use)
                spoilt += int(np.count_nonzero(~finite))
            if masked is not None and masked[d].any():
                use, inverse = self._outside(use, inverse, masked[d])
            found[d] = solved(inverse, self.basis.sums(Rows.of(row), use))[0]
        return found, spoilt

    def adjoint(self, rows: Rows, masked: Mask | None = None, more: Floats | None = None) -> None:
        """Transpose of equation (1), x - B_g^T (B_g B_g^T)^-1 (B x + ``more``), of float64 rows in
        place; ``more``: (n_det, K), or None.
        """
        sums = self.basis.sums(rows, np.ones(len(self.use), bool))
        for d, total in enumerate(sums if more is None else sums + more):
            use = self.use
            inverse = self.inverse
            if masked is not None and masked[d].any():
                use, inverse = self._outside(use, inverse, masked[d])
            kept = rows.values[d, ~use]
            self.basis.subtract(Rows.of(rows.values[d : d + 1]), solved(inverse, total[None]))
            rows.values[d, ~use] = kept

    def _outside(self, use: Mask, inverse: Floats, masked: Mask) -> tuple[Mask, Floats]:
        """Samples to use outside of a mask (N,), and their inverse; those that are given where
        equation (2) forbids it.
        """
        left = use & ~masked
        basis = self.basis
        whole = inverse if len(inverse) == basis.size else basis.inverse(use)
        outside = basis.normal(left)
        inside = basis.normal(use & masked)
        found = _inverse(outside)
        lost = np.trace(whole @ basis.normal(use)) - np.trace(found @ outside)
        if lost > 0.5 or np.trace(found @ inside) > np.count_nonzero(use & masked):
            return use, inverse
        return left, found


def solved(inverse: Floats, sums: Floats) -> Floats:
    """(n_det, K): ``inverse`` (K, K), symmetric, times each row of ``sums`` (n_det, K); or the
    solutions by a factor (taps, K).

    Not by BLAS, whose bits depend on how many rows there are.
    """
    if len(inverse) < inverse.shape[1]:
        out = sums.copy()
        _substitute(inverse, out)
        return out
    out = np.zeros(sums.shape)
    _solve(inverse, sums, out)
    return out


def _inverse(normal: Floats) -> Floats:
    """The pseudoinverse (K, K)."""
    found = np.linalg.pinv(normal, rcond=DETERMINED, hermitian=True)
    return np.asarray((found + found.T) / 2, np.float64)


# A sum may be formed in any order within a chunk of one row: the compiler chooses it once, whatever
# rows stand beside it.


@kernel(fastmath={"contract", "nsz", "reassoc"})
def dot(a, b):  # type: ignore[no-untyped-def]
    """sum_t a_t b_t of two chunks."""
    total = 0.0
    for t in range(nb.uint64(a.size)):
        total += a[t] * b[t]
    return total


@kernel(fastmath={"contract", "nsz", "reassoc"})
def _total(x):  # type: ignore[no-untyped-def]
    total = 0.0
    for t in range(nb.uint64(x.size)):
        total += x[t]
    return total


@contracted
def lessen(x, c, f):  # type: ignore[no-untyped-def]
    """x -= c f, of two chunks."""
    for t in range(nb.uint64(x.size)):
        x[t] -= c * f[t]


@kernel
def _solve(inverse, sums, out):  # type: ignore[no-untyped-def]
    """Solve for all detectors row by row of the matrix, which may exceed the cache."""
    for k in range(sums.shape[1]):
        for d in range(sums.shape[0]):
            lessen(out[d], -sums[d, k], inverse[k])


@kernel
def _factor(normal, least, factor):  # type: ignore[no-untyped-def]
    """Cholesky's factor L of a matrix (K, K) with few diagonals: factor[i, j] = L[j + i, j], and 1
    / L[j, j] at i = 0.

    False where a square of L[j, j] is not above ``least``: there are functions that no used sample
    determines.
    """
    taps, size = factor.shape
    for j in range(size):
        for i in range(j, min(j + taps, size)):
            value = normal[i, j]
            for k in range(max(0, i - taps + 1), j):
                value -= factor[i - k, k] * factor[j - k, k]
            if i > j:
                factor[i - j, j] = value * factor[0, j]
            elif value > least:
                factor[0, j] = 1 / math.sqrt(value)
            else:
                return False
    return True


@kernel
def _substitute(factor, rows):  # type: ignore[no-untyped-def]
    """Solve L L^T c = row for each of the ``rows`` (n_row, K), in place."""
    taps, size = factor.shape
    for d in range(rows.shape[0]):
        row = rows[d]
        for j in range(size):
            value = row[j]
            for i in range(1, min(taps, j + 1)):
                value -= factor[i, j - i] * row[j - i]
            row[j] = value * factor[0, j]
        for j in range(size - 1, -1, -1):
            value = row[j]
            for i in range(1, min(taps, size - j)):
                value -= factor[i, j] * row[j + i]
            row[j] = value * factor[0, j]


@kernel
def keep_used(x, use):  # type: ignore[no-untyped-def]
    """x = 0 where it is not used, unless it is not finite."""
    for t in range(nb.uint64(x.size)):
        x[t] *= use[t]


@kernel
def _normal(use, functions, stops, firsts, normal):  # type: ignore[no-untyped-def]
    """normal += B_g B_g^T."""
    taps, low, x = functions.shape[0], 0, np.empty(AT_ONCE)
    for r in range(stops.size):
        high, k = stops[r], firsts[r]
        used = x[: high - low]
        for i in range(taps):
            for t in range(nb.uint64(used.size)):
                used[t] = functions[i, low + t] * use[low + t]
            for j in range(i + 1):
                normal[k + i, k + j] += dot(used, functions[j, low:high])
        low = high
    for i in range(normal.shape[0]):
        for j in range(i):
            normal[j, i] = normal[i, j]


@kernel
def _sums(  # type: ignore[no-untyped-def]
    values,
    lines,
    cell,
    inside,
    start,
    begin,
    use,
    functions,
    stops,
    firsts,
    ends,
    bins,
    out,
    totals,
):
    """out (n_row, K) += B_g x_g, and totals (n_row, n_bin) += the sums of x_g over ``bins``, of
    samples up to ``ends``, which each lie in one run; the first arguments are those of `Rows`.
    """
    low, first, last, chunk = 0, 0, 0, np.empty(AT_ONCE)
    for r in range(stops.size):
        high = stops[r]
        x = chunk[: high - low]
        while last < ends.size and ends[last] <= high:
            last += 1
        for d in range(values.shape[0]):
            read(values, lines, cell, inside, start, d, begin + low, x)
            keep_used(x, use[low:high])
            for i in range(functions.shape[0]):
                out[d, firsts[r] + i] += dot(x, functions[i, low:high])
            at = 0
            for k in range(first, last):
                totals[d, bins[k]] += _total(x[at : ends[k] - low])
                at = ends[k] - low
        low, first = high, last


@kernel
def _subtract(  # type: ignore[no-untyped-def]
    values,
    lines,
    cell,
    inside,
    start,
    begin,
    functions,
    stops,
    firsts,
    ends,
    bins,
    coefficients,
    means,
):
    """Subtract B^T ``coefficients`` (n_row, K), and of each of the bins of `_sums` its ``means``
    (n_row, n_bin).
    """
    low, first, last, chunk = 0, 0, 0, np.empty(AT_ONCE)
    for r in range(stops.size):
        high = stops[r]
        x = chunk[: high - low]
        while last < ends.size and ends[last] <= high:
            last += 1
        for d in range(values.shape[0]):
            read(values, lines, cell, inside, start, d, begin + low, x)
            for i in range(functions.shape[0]):
                lessen(x, coefficients[d, firsts[r] + i], functions[i, low:high])
            at = 0
            for k in range(first, last):
                mean = means[d, bins[k]]
                for t in range(nb.uint64(at), nb.uint64(ends[k] - low)):
                    x[t] -= mean
                at = ends[k] - low
            write(values, d, begin + low, x)
        low, first = high, last
