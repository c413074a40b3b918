"""Second level of the preconditioner: smooth patterns of I over the whole map.

Scans that cross the sky in few directions tell its large scales poorly: of P^T Q P, preconditioned
with the inverse weights W of pixels, the smallest eigenvalues belong to smooth patterns of I. With
Z (k, n_pixels) products of cosines over the map, up to `DEGREE` half-waves in all,

    M = W^-1 + Z^T E^-1 Z,   E = Z A Z^T,   A = P^T Q P                                      (1)

corrects them at once (additive two-level preconditioner; Dryja & Widlund 1987; for maps Grigori et
al. 2012, Szydlarski et al. 2014). M is symmetric and positive definite, whatever E is. E takes one
product with A for each pattern. Patterns are made orthonormal in W, then in A; those that depend on
others, and those that the data do not determine, are left out.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel
from zonda.core.types import Floats

DEGREE = 6
"""Half-waves over the map, of both axes together."""
PATTERNS = (DEGREE + 1) * (DEGREE + 2) // 2
"""Patterns, and products with A that E takes."""
DEPENDENT = 1e-4
"""Share of a pattern's norm that is not that of patterns before it, squared."""
UNDETERMINED = 1e-8
"""A direction p with less information p^T A p, as a share of that of white noise, p^T W p with the
weights W of pixels, holds rounding alone."""


@dataclass(frozen=True)
class SmoothPatterns:
    """Second term of equation (1).

    Attributes
    ----------
    pixels
        (n,) those with samples.
    cosine
        (2, n) cosine of the first half-wave along either axis.
    waves
        (k, 2) half-waves of each pattern along either axis.
    rows
        (j, k) combinations of patterns for which E is 1.
    information
        (j,) eigenvalues of E for patterns that are orthonormal in W, rising: Ritz values of W^-1 A.
    """

    pixels: NDArray[np.intp]
    cosine: Floats
    waves: NDArray[np.intp]
    rows: Floats
    information: Floats

    @classmethod
    def of(
        cls,
        places: Callable[[NDArray[np.intp]], Floats],
        weights: Floats,
        apply: Callable[[Floats], Floats],
    ) -> SmoothPatterns:
        """Find E.

        Parameters
        ----------
        places
            Coordinates (2, n) of pixels.
        weights
            (n_pixels,) of I.
        apply
            Product of A with a map of I, (n_pixels,).
        """
        pixels = np.flatnonzero(weights > 0)
        at = places(pixels)
        low = at.min(axis=1, keepdims=True)
        cosine = np.cos(np.pi * (at - low) / np.maximum(np.ptp(at, axis=1, keepdims=True), 1e-30))
        waves = np.array([(i, n - i) for n in range(DEGREE + 1) for i in range(n + 1)])
        raw = cls(pixels, cosine, waves, np.eye(len(waves)), np.zeros(0))
        gram = [raw.amplitudes(weights * raw.pattern(row, weights.size)) for row in raw.rows]
        independent = orthonormal(np.array(gram), DEPENDENT * np.diag(gram))
        products = [raw.amplitudes(apply(raw.pattern(row, weights.size))) for row in independent]
        matrix = np.einsum("ik,jk->ij", independent, np.array(products))
        matrix = (matrix + matrix.T) / 2
        known = orthonormal(matrix, np.full(len(matrix), UNDETERMINED))
        rows = np.einsum("ij,jk->ik", known, independent)
        values = np.linalg.eigvalsh(matrix)
        return cls(pixels, cosine, waves, rows, values[values > UNDETERMINED])

    def amplitudes(self, m: Floats) -> Floats:
        """(k,) sums of a map (n_pixels,) times each pattern."""
        return np.asarray(_sum(self.cosine, self.waves, m[self.pixels]))

    def pattern(self, amplitudes: Floats, n_pixels: int) -> Floats:
        """The map (n_pixels,) of ``amplitudes`` (k,); 0 without samples."""
        m = np.zeros(n_pixels)
        m[self.pixels] = _made(self.cosine, self.waves, amplitudes)
        return m

    def correct(self, r: Floats) -> Floats:
        """Z^T E^-1 Z r of a map of I, (n_pixels,)."""
        amplitudes = np.einsum("jk,k->j", self.rows, self.amplitudes(r))
        return self.pattern(np.einsum("jk,j->k", self.rows, amplitudes), r.size)


def orthonormal(matrix: Floats, least: Floats) -> Floats:
    """Rows (j, k) with rows matrix rows^T = 1, by Gram-Schmidt in the order of the k unit vectors.
    One is left out whose norm, squared, without those before it is not above ``least`` (k,).
    """
    rows, products = list[Floats](), list[Floats]()
    for row, floor in zip(np.eye(len(matrix)), least, strict=True):
        for _ in range(2):
            for other, product in zip(rows, products, strict=True):
                row = row - (row * product).sum() * other
        product = (matrix * row).sum(axis=1)
        if (size := float((row * product).sum())) > floor:
            rows.append(row / np.sqrt(size))
            products.append(product / np.sqrt(size))
    return np.array(rows).reshape(-1, len(matrix))


@kernel(inline="always")
def _at(cosine, waves, p, table, values):  # type: ignore[no-untyped-def]
    """Values (k,) of the patterns in pixel p, by cos(n + 1) x = 2 cos x cos n x - cos(n - 1) x."""
    for axis in range(2):
        x = cosine[axis, p]
        table[axis, 0], table[axis, 1] = 1.0, x
        for n in range(2, table.shape[1]):
            table[axis, n] = 2 * x * table[axis, n - 1] - table[axis, n - 2]
    for k in range(waves.shape[0]):
        values[k] = table[0, waves[k, 0]] * table[1, waves[k, 1]]


@kernel
def _sum(cosine, waves, m):  # type: ignore[no-untyped-def]
    """Sums (k,) of a map times each pattern."""
    table, values = np.empty((2, waves.max() + 1)), np.empty(waves.shape[0])
    out = np.zeros(waves.shape[0])
    for p in range(m.size):
        _at(cosine, waves, p, table, values)
        for k in range(out.size):
            out[k] += values[k] * m[p]
    return out


@kernel
def _made(cosine, waves, amplitudes):  # type: ignore[no-untyped-def]
    """Map (n,) of patterns with ``amplitudes`` (k,)."""
    table, values = np.empty((2, waves.max() + 1)), np.empty(waves.shape[0])
    m = np.zeros(cosine.shape[1])
    for p in range(m.size):
        _at(cosine, waves, p, table, values)
        for k in range(values.size):
            m[p] += values[k] * amplitudes[k]
    return m
