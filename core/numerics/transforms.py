"""Transforms that `scipy.fft` and `scipy.ndimage` have too, which take 0.3 s to import.

Cosines, B-splines, good lengths, images convolved with a Gaussian.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike

from ..types import AnyFloats, Floats


def cosine_transform(values: Floats) -> Floats:
    """DCT-I of rows (..., n), n > 1: y_k = x_0 + (-1)^k x_(n-1) + 2 sum_(0 < j < n - 1) x_j cos(pi
    j k / (n - 1)).
    """
    return np.asarray(np.fft.rfft(_mirrored(values)).real)


def spline_filter(values: ArrayLike, axis: int = -1) -> Floats:
    """Cubic B-spline coefficients of values (..., n, ...), mirrored about their first and their
    last: interpolation is exact.

    (c_(k-1) + 4 c_k + c_(k+1)) / 6 = v_k is a division in the transform of the mirrored values.
    """
    rows = np.moveaxis(np.asarray(values, np.float64), axis, -1)
    if rows.shape[-1] < 2:
        return np.array(values, np.float64)
    transform = np.fft.rfft(_mirrored(rows)) / spline_response(
        np.arange(rows.shape[-1]) / (2 * rows.shape[-1] - 2)
    )
    return np.moveaxis(
        np.fft.irfft(transform, 2 * rows.shape[-1] - 2)[..., : rows.shape[-1]], -1, axis
    )


def spline_response(frequency: Floats) -> Floats:
    """Fourier transform of (1, 4, 1) / 6, the cubic B-spline at its knots; ``frequency`` in cycles
    per knot.
    """
    return np.asarray((2 + np.cos(2 * np.pi * frequency)) / 3)


def fast_length(n: int, primes: tuple[int, ...] = (2, 3, 5)) -> int:
    """The least length >= ``n`` without other prime factors: its transform is quick."""
    while True:
        rest = n
        for p in primes:
            while rest % p == 0:
                rest //= p
        if rest == 1:
            return n
        n += 1


def _mirrored(rows: Floats) -> Floats:
    """One period (..., 2 n - 2) of rows (..., n) that are mirrored about both ends."""
    return np.concatenate([rows, rows[..., -2:0:-1]], axis=-1)


def gaussian_taps(sigma: float) -> Floats:
    """(n,) the middle and one side of a Gaussian of ``sigma`` pixels, cut at 5 sigma, of sum 1 over
    both sides.
    """
    reach = math.ceil(5 * sigma)
    kernel = (
        np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * sigma**2)) if sigma > 0 else np.ones(1)
    )
    return np.asarray(kernel / kernel.sum())[reach:]


def convolved(values: AnyFloats, taps: AnyFloats, along: AnyFloats | None = None) -> AnyFloats:
    """An image (ny, nx) convolved along both axes with a symmetric kernel; nothing lies outside.
    All of one type.

    ``along``: taps along x, where they are not those along y.
    """
    across = np.ascontiguousarray(_along_columns(values, taps).T)
    return np.ascontiguousarray(_along_columns(across, taps if along is None else along).T)


def convolved_rows(values: Floats, taps: Floats, rows: list[Floats]) -> Floats:
    """Convolve as `convolved` does, with a kernel of its own along each row (``rows``); ``taps`` is
    for the columns.
    """
    n = values.shape[1]
    along = np.empty_like(values)
    for values_of, kernel, out in zip(values, rows, along, strict=True):
        reach = min(len(kernel) - 1, n - 1)
        out[:] = np.convolve(values_of, np.concatenate([kernel[reach:0:-1], kernel[: reach + 1]]))[
            reach : reach + n
        ]
    return np.asarray(_along_columns(along, taps))


def _along_columns(values: AnyFloats, taps: AnyFloats) -> AnyFloats:
    """sum_k taps[|k|] values[j + k] along the first axis; zeros beyond the ends."""
    out: AnyFloats = values * taps[0]
    part = np.empty_like(values)
    for k in range(1, min(len(taps), len(values))):
        np.multiply(values, taps[k], out=part)
        out[k:] += part[:-k]
        out[:-k] += part[k:]
    return out
