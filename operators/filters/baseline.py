"""Smooth functions of time that are fitted to each detector's scan and removed.

With B (K, N) the functions, and B_g, x_g their values and the data at the samples that are used,

    y = x - B^T (B_g B_g^T)^-1 B_g x_g,                                                                    (1)

a linear least-squares fit, in float64. Samples that are flagged, not finite or in a source mask are not used, but the fit is
subtracted there too. Functions that no used sample determines get the coefficient 0 (pseudoinverse).

A mask leaves a detector that looks into it most of the time too little to go by: the fit would be an extrapolation. The mask of a
detector is not used where fewer functions are determined without its samples, or where at these the variance of the fit,

    mean over the masked samples of b_t^T (B_g B_g^T)^-1 b_t,                                              (2)

is larger than that of a sample.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.compilation.jit import nb
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.smooth import spline_basis
from zonda.core.types import Floats

from .source_mask import MASKED, Inside

SPOILT = "samples not finite"
"""Count of samples that are left as they are."""

ROWS = 32
"""Detectors that are worked on in float64 at a time."""

AT_ONCE = 1024
"""Samples whose functions stay in the first cache for all rows: those of a scan of half an hour exceed the second."""

DETERMINED = 1e-14
"""Eigenvalues of B_g B_g^T below this share of the largest count as zero."""

Mask = NDArray[np.bool_]


@dataclass(frozen=True)
class Basis:
    """Functions of time of which few reach a sample.

    Attributes
    ----------
    first
        (N,) number of the first function that reaches each sample.
    weights
        (N, taps): the values of the functions first .. first + taps - 1.
    size
        K, the number of functions.
    """

    first: NDArray[np.int64]
    weights: Floats
    size: int

    def inverse(self, use: Mask) -> Floats:
        """(K, K): the pseudoinverse of B_g B_g^T for the samples ``use`` (N,)."""
        return np.asarray(np.linalg.pinv(self.normal(use), rcond=DETERMINED, hermitian=True))

    def normal(self, use: Mask) -> Floats:
        """(K, K): B_g B_g^T for the samples ``use`` (N,)."""
        normal = np.zeros((self.size, self.size))
        _normal(use, self.first, self.weights, normal)
        return normal


def polynomials(n: int, order: int) -> Basis:
    """Legendre polynomials up to ``order`` over a scan of ``n`` samples."""
    time = (2 * np.arange(n) + 1) / n - 1
    return Basis(np.zeros(n, np.int64), np.asarray(np.polynomial.legendre.legvander(time, order), np.float64), order + 1)


def splines(n: int, spacing: float) -> Basis:
    """Cubic B-splines with knots every ``spacing`` samples, a whole number of intervals centred on a scan of ``n`` samples."""
    inner = max(1, math.ceil((n - 1) / spacing))  # knots inside the scan, half of an interval or less from either end
    position = (np.arange(n) - (n - 1) / 2) / spacing + (inner - 1) / 2 + 1
    first = np.clip(np.floor(position).astype(np.int64), 0, inner)
    return Basis(first, np.ascontiguousarray(spline_basis(position - first).T), inner + 4)


@dataclass(frozen=True)
class Fit:
    """Equation (1) for scans whose samples ``use`` (N,) are used; ``inverse`` (K, K): `Basis.inverse` of these."""

    basis: Basis
    use: Mask
    inverse: Floats

    @classmethod
    def of(cls, basis: Basis, use: Mask) -> Fit:
        """A fit of these functions to the samples ``use`` (N,)."""
        return cls(basis, use, basis.inverse(use))

    def remove(self, rows: Floats, masked: Mask | None = None) -> int:
        """Equation (1) on ``rows`` (n_det, N) in place. ``masked`` (n_det, N): samples that are not used, of each detector, where
        equation (2) allows it.

        Returns how many samples were not finite; they stay as they were.
        """
        plain, spoilt = np.ones(len(rows), bool), 0
        for d, row in enumerate(rows):
            finite = np.isfinite(row)
            plain[d] = finite.all() and not (masked is not None and masked[d].any())
            if plain[d]:
                continue
            use, inverse = self.use, self.inverse
            if not finite.all():
                use = use & finite
                inverse = self.basis.inverse(use)
                spoilt += int(np.count_nonzero(~finite))
            if masked is not None and masked[d].any():
                use, inverse = self._outside(use, inverse, masked[d])
            self._remove(rows, np.array([d]), use, inverse)
        self._remove(rows, np.flatnonzero(plain), self.use, self.inverse)
        return spoilt

    def _remove(self, rows: Floats, which: NDArray[np.intp], use: Mask, inverse: Floats) -> None:
        """Equation (1) on the ``rows`` of these numbers, all of which use the same samples."""
        basis, sums = self.basis, np.zeros((len(which), self.basis.size))
        _sums(rows, which, use, basis.first, basis.weights, sums)
        for own in sums:
            own[:] = inverse @ own
        _subtract(rows, which, basis.first, basis.weights, sums)

    def _outside(self, use: Mask, inverse: Floats, masked: Mask) -> tuple[Mask, Floats]:
        """Samples to use outside of a mask (N,), and their inverse; those that are given where equation (2) forbids it."""
        left, basis = use & ~masked, self.basis
        found, inside = basis.inverse(left), basis.normal(use & masked)
        lost = np.trace(inverse @ basis.normal(use)) - np.trace(found @ basis.normal(left))
        if lost > 0.5 or np.trace(found @ inside) > np.count_nonzero(use & masked):
            return use, inverse
        return left, found


def in_double(label: str, block: Block, remove: Callable[[Floats, Mask | None], int], inside: Inside | None = None) -> None:
    """Let ``remove`` change the signal of a block in float64, its mean included; no mean is left beside it.

    ``remove(rows, masked)`` changes samples (n_det, n_samp) of up to `ROWS` detectors in place and returns how many were not
    finite; ``masked``: which of them are ``inside`` a source mask. The step ``label`` counts both.
    """
    signal, mean, tally = block.detdata["signal"], block.means.pop("signal", None), block.observation.tally
    masked = inside.at(block.detectors, block.samples) if inside is not None else None
    if masked is not None:
        tally.count(label, MASKED, int(masked.sum()), masked.size)
    spoilt = 0
    for part in chunks(len(signal), ROWS):
        rows = signal[part].astype(np.float64)
        if mean is not None:
            first = block.detectors.start
            rows += mean.evaluate(slice(first + part.start, first + part.stop), block.samples)
        spoilt += remove(rows, None if masked is None else masked[part])
        signal[part] = rows
    tally.count(label, SPOILT, spoilt)


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _normal(use, first, weights, normal):  # type: ignore[no-untyped-def]
    """normal += B_g B_g^T."""
    taps = weights.shape[1]
    for t in range(use.size):
        if use[t]:
            k = first[t]
            for i in range(taps):
                for j in range(taps):
                    normal[k + i, k + j] += weights[t, i] * weights[t, j]


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _sums(rows, which, use, first, weights, sums):  # type: ignore[no-untyped-def]
    """sums (n_row, K) += B_g x_g of the ``rows`` of the numbers ``which`` (n_row,)."""
    taps, n = weights.shape[1], use.size
    for low in range(0, n, AT_ONCE):
        high = min(low + AT_ONCE, n)
        k = 0
        while k + 4 <= which.size:  # side by side: a sum waits for its last term
            a, b, c, d = rows[which[k]], rows[which[k + 1]], rows[which[k + 2]], rows[which[k + 3]]
            p, q, r, s = sums[k], sums[k + 1], sums[k + 2], sums[k + 3]
            for t in range(low, high):
                if use[t]:
                    for i in range(taps):
                        at, w = first[t] + i, weights[t, i]
                        p[at] += w * a[t]
                        q[at] += w * b[t]
                        r[at] += w * c[t]
                        s[at] += w * d[t]
            k += 4
        while k < which.size:
            row, own = rows[which[k]], sums[k]
            for t in range(low, high):
                if use[t]:
                    for i in range(taps):
                        own[first[t] + i] += weights[t, i] * row[t]
            k += 1


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _subtract(rows, which, first, weights, coefficients):  # type: ignore[no-untyped-def]
    """Subtract B^T ``coefficients`` (n_row, K) from the ``rows`` of the numbers ``which`` (n_row,)."""
    taps, n = weights.shape[1], first.size
    for low in range(0, n, AT_ONCE):
        high = min(low + AT_ONCE, n)
        for k in range(which.size):
            row, own = rows[which[k]], coefficients[k]
            for t in range(low, high):
                value = row[t]
                for i in range(taps):
                    value -= weights[t, i] * own[first[t] + i]
                row[t] = value
