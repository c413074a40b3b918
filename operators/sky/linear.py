"""Sampling a convolved map at every detector and instant by bilinear interpolation: less work than
`sampling`, less exact.

Between grid points h apart it errs by h^2 / 2 u (1 - u) f'' along each axis, u the fraction, h^2 /
12 f'' in the mean over u. The mean is taken out beforehand, by dividing the map's transform by
sinc^2(k h) (`beam.convolve`), which leaves

    |e| <= h^2 / 12 (|f_xx| + |f_yy|)                                                            (1)

and no mean attenuation (Blu, Thevenaz & Unser 2001 call it quasi-interpolation).
"""

from __future__ import annotations

import numpy as np
from numba import int32, uint64

from zonda.core.kernels import kernel

from .sampling import CHUNK, count_covered, locate, misses, span_on_grid


@kernel(fastmath={"contract", "nsz"})
def add_lines(  # type: ignore[no-untyped-def]
    h, box, limits, ones, xi, eta, rows, f, nx, covered, constants, over, out
):
    """Add samples as `sampling.add_splines`, from the grid's values. Samples within two points of
    its border are left as they are.
    """
    place = np.empty(CHUNK, np.int32)
    u, v = np.empty(CHUNK, out.dtype), np.empty(CHUNK, out.dtype)
    beyond, behind = 0, 0
    for k in range(len(h)):
        start = k * CHUNK
        count = min(CHUNK, out.shape[1] - start)
        for d in range(rows.size):
            row = out[rows[d], start : start + count]
            for t in range(count if over else 0):
                row[t] = constants[6]
            if misses(box[k], xi[d], eta[d], limits[k]):
                beyond += count
                continue
            inside, front = locate(
                h[k], xi[d], eta[d], count, limits[k], constants, ones[k], int32(nx), place, u, v
            )
            if covered.size > 0:
                inside = count_covered(place, u, v, count, nx, covered)
            beyond += count - inside
            behind += count - front
            first, stop = span_on_grid(place, count)
            stop = min(stop, count)
            _add_bilinear(f, place, u, v, first, stop, uint64(nx), constants, row)
    return beyond, behind


@kernel(fastmath={"contract", "nsz"}, inline="always")
def _add_bilinear(f, place, u, v, first, stop, nx, constants, row):  # type: ignore[no-untyped-def]
    """The four grid points around each sample, one right and one up of its first spline
    coefficient; 0 off the grid.
    """
    one, zero = constants[3], constants[6]
    for t in range(uint64(first), uint64(stop)):
        on = one if place[t] >= 0 else zero
        p = uint64(max(place[t], int32(0))) + nx + uint64(1)
        a, b, c, d = f[p], f[p + uint64(1)], f[p + nx], f[p + nx + uint64(1)]
        low, high = a + u[t] * (b - a), c + u[t] * (d - c)
        row[t] += on * (low + v[t] * (high - low))
