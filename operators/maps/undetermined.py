"""Patterns that the data hardly determine: eigenvectors of the smallest eigenvalues of W^-1 A.

With A = P^T Q P and the weights W of pixels (those of white noise alone), an eigenvector x of

    A x = theta W x,   x^T W x = 1                                                           (1)

is a pattern of the map whose noise is theta^(-1/2) times that of white noise. The block method of
Knyazev (2001, SIAM J. Sci. Comput. 23, 517) is begun with the suspects, mean and plane of I (Q, U),
and a random map. The right side of a map lies in the range of A: its conjugate gradients do not see
what is not determined at all.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from zonda.core.numerics.random import normals, stream_key
from zonda.core.types import Floats

from .normal_equations import NormalEquations, times
from .preconditioner import UNDETERMINED, orthonormal

ITERATIONS = 60
"""Each takes a product with A for each pattern of the block."""
ACCURACY = 1e-3
"""Norm of the residual W^-1 A x - theta x, squared, as a share of theta."""
DEPENDENT = 1e-12
"""Share of a vector's norm that is not that of those before it, squared."""
TINY = 1e-300


class Patterns(NamedTuple):
    """Eigenvalues (k,), rising, and eigenvectors (k, n_stokes, n_pixels), largest value 1."""

    values: Floats
    maps: Floats


def undetermined(equations: NormalEquations, number: int) -> Patterns:
    """Find so many solutions of equation (1)."""
    suspects = _with_products(equations, _suspects(equations, number))
    values, share = _lowest(equations, suspects, suspects.shape[1])
    x, size = _combined(share, suspects), len(values)
    step = x[:, :0]
    for _ in range(ITERATIONS):
        rest = np.array([times(equations.inverse, one) for one in x[1]])
        rest -= values[:, None, None] * x[0]
        left = _gram(equations, rest).diagonal()
        if (left[:number] < ACCURACY * np.maximum(values[:number], UNDETERMINED)).all():
            break
        rest /= np.sqrt(np.maximum(left, TINY))[:, None, None]
        basis = np.concatenate([x, _with_products(equations, rest), step], axis=1)
        values, share = _lowest(equations, basis, size)
        x, step = _combined(share, basis), _combined(share[:, size:], basis[:, size:])
    flat = x[0].reshape(size, -1)
    peaks = flat[np.arange(size), np.abs(flat).argmax(axis=1)]
    return Patterns(np.maximum(values, 0.0)[:number], (x[0] / peaks[:, None, None])[:number])


def _suspects(equations: NormalEquations, number: int) -> Floats:
    """Means and planes of each Stokes parameter, and random maps, ``number`` + 1 at least."""
    n, size = equations.n_stokes, equations.n_pixels
    seen = np.flatnonzero(equations.weights[0] > 0)
    rows = [np.ones(seen.size)]
    if equations.places is not None:
        at = equations.places(seen)
        rows += list(at - at.mean(axis=1, keepdims=True))
    more = max(number + 1 - n * len(rows), 1)
    found = np.zeros((n * len(rows) + more, n, size))
    for k, row in enumerate(rows):
        for j in range(n):
            found[n * k + j, j, seen] = row
    key = stream_key(0, "MaximumLikelihoodMap", 1)
    found[-more:] = normals(key, 0, more * n * size).reshape(more, n, size)
    projected = [times(equations.inverse, times(equations.weights, one)) for one in found]
    return np.array(projected)


def _with_products(equations: NormalEquations, maps: Floats) -> Floats:
    """(2, k, n_stokes, n_pixels) maps, and their products with A."""
    return np.stack([maps, [equations.apply(one) for one in maps]])


def _gram(equations: NormalEquations, maps: Floats) -> Floats:
    """Products (k, k) of maps in the metric W."""
    weighed = np.array([times(equations.weights, one) for one in maps])
    return np.asarray(np.einsum("iap,jap->ij", maps, weighed))


def _lowest(equations: NormalEquations, basis: Floats, size: int) -> tuple[Floats, Floats]:
    """The ``size`` smallest Ritz values, and their vectors as combinations of a basis."""
    gram = _gram(equations, basis[0])
    rows = orthonormal(gram, DEPENDENT * gram.diagonal())
    matrix = np.einsum("iap,jap->ij", *basis)
    values, vectors = np.linalg.eigh(rows @ (matrix + matrix.T) @ rows.T / 2)
    return values[:size], (vectors.T @ rows)[:size]


def _combined(share: Floats, basis: Floats) -> Floats:
    return np.asarray(np.einsum("ij,tjap->tiap", share, basis))
