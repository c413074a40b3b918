"""The covariance that the pyramid of a turbulent layer implies, exactly: tests and benchmarks
compare it with the one wanted.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from zonda.core.types import Floats
from zonda.operators.atmosphere.turbulence.lattice import Turbulence


def implied_covariance(field: Turbulence, a: NDArray[np.integer], b: NDArray[np.integer]) -> Floats:
    """(n,) covariance of the algorithm, but for rounding to float32, between lattice points ``a``
    and ``b``, each (n, 2).
    """
    a, b = np.atleast_2d(a), np.atleast_2d(b)
    out = np.zeros(len(a))
    for k, level in enumerate(field.levels):
        if level.kernel is None:
            continue
        r = len(level.kernel) - 1
        h = np.zeros((4 * r + 2, 4 * r + 2))
        index = np.arange(-r, r + 1)
        h[np.ix_(index, index)] = level.kernel[np.ix_(abs(index), abs(index))]
        auto = np.fft.irfft2(abs(np.fft.rfft2(h)) ** 2, h.shape)
        known: dict[tuple[int, int], tuple[NDArray[np.int64], Floats]] = {}
        for n in range(len(a)):
            ends = [(int(a[n, axis]), int(b[n, axis])) for axis in (0, 1)]
            for pair in set(ends) - set(known):
                known[pair] = _lags(field, *pair, k)
            lags = [known[pair] for pair in ends]
            (u, wu), (v, wv) = ((lag[abs(lag) <= 2 * r], w[abs(lag) <= 2 * r]) for lag, w in lags)
            out[n] += wu @ auto[np.ix_(u, v)] @ wv
    return out


def _lags(field: Turbulence, a: int, b: int, k: int) -> tuple[NDArray[np.int64], Floats]:
    """Lags on level k between the lattice points that a and b of level 0 are interpolated from (one
    axis), and weights.
    """
    (xa, wa), (xb, wb) = _sources(field, a, k), _sources(field, b, k)
    lag, inverse = np.unique(np.subtract.outer(xa, xb), return_inverse=True)
    weight = np.bincount(inverse.ravel(), np.multiply.outer(wa, wb).ravel())
    return np.asarray(lag, np.int64), np.asarray(weight, np.float64)


def _sources(field: Turbulence, index: int, k: int) -> tuple[NDArray[np.int64], Floats]:
    weights, half = field.weights.astype(np.float64), field.fidelity.taps // 2
    points = {index: 1.0}
    for _ in range(k):
        coarse: dict[int, float] = {}
        for i, w in points.items():
            if i & 1 == 0:
                coarse[i >> 1] = coarse.get(i >> 1, 0.0) + w
            else:
                for tap in range(2 * half):
                    at = (i >> 1) - half + 1 + tap
                    coarse[at] = coarse.get(at, 0.0) + w * weights[tap]
        points = coarse
    return np.array(list(points), np.int64), np.array(list(points.values()))
