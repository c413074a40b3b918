"""Smoothing with a kernel of its own for each pixel, compiled: equation (2) of `core.maps.grid`."""

from __future__ import annotations

import math

import numpy as np

from ..kernels import kernel
from ..types import Floats

STEPS = 8192
"""Of the table of the Gaussian: linear interpolation is right to (12.5 power / STEPS)^2 / 8, some
1e-6.
"""
DEEPEST = 12.5
"""r^2 / 2 sigma^2 at which kernels end: 5 sigma."""


def table(power: float) -> Floats:
    """(STEPS + 2,) exp(-power u) at u = 0 ... `DEEPEST`."""
    return np.asarray(np.exp(-power * DEEPEST / STEPS * np.arange(STEPS + 2)), np.float64)


@kernel
def smooth_directly(  # type: ignore[no-untyped-def]
    values, d, areas, reach, whole, sigma, power, gaussian, first, stop
):
    """sum_q K_pq^power values_q (ny, nx) for pixels from (row, column) ``first`` to before
    ``stop``; others are 0.

    ``d`` (ny, nx, 3) directions, NaN off the sky; ``areas`` (ny, nx) [sr]; ``reach`` (2, ny, nx)
    columns and rows to look at on either side; ``whole``: the last column is beside the first one.
    """
    ny, nx = values.shape
    out = np.zeros((ny, nx))
    for y in range(first[0], stop[0]):
        for x in range(first[1], stop[1]):
            scale = areas[y, x] / (2 * math.pi * sigma * sigma)
            if not scale > 0.0:
                continue
            a, b, c = d[y, x, 0], d[y, x, 1], d[y, x, 2]
            wide, high, found = reach[0, y, x], reach[1, y, x], 0.0
            left, right = x - wide, x + wide
            if whole:  # each column once
                right = min(right, left + nx - 1)
            else:
                left, right = max(left, 0), min(right, nx - 1)
            for j in range(max(y - high, 0), min(y + high, ny - 1) + 1):
                for k in range(left, right + 1):
                    i = k + nx if k < 0 else k - nx if k >= nx else k
                    p, q, r = d[j, i, 0] - a, d[j, i, 1] - b, d[j, i, 2] - c
                    chord = p * p + q * q + r * r
                    at = chord * (1.0 + chord / 12.0) / (2 * sigma * sigma) * (STEPS / DEEPEST)
                    if at < STEPS:
                        n = int(at)
                        found += (
                            gaussian[n] + (at - n) * (gaussian[n + 1] - gaussian[n])
                        ) * values[j, i]
            out[y, x] = found * scale**power
    return out
