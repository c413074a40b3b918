"""Images convolved with a Gaussian."""

from __future__ import annotations

import math

import numpy as np

from ..types import AnyFloats, Floats


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
