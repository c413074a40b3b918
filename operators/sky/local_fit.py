"""Interpolation between scattered points of a plane by local polynomials."""

from __future__ import annotations

from typing import Any

import numpy as np

from zonda.core.numerics.chunks import chunks
from zonda.core.types import Floats

NEIGHBOURS = 24
"""Points in each local fit: of HEALPix pixels, two rings and a few more."""
AT_ONCE = 16384
"""Positions that are fitted together."""


def local_fit(points: Floats, data: Floats, at: Floats) -> tuple[Floats, int]:
    """Moving least squares of third degree at ``at`` (n, 2) from scattered ``data`` (k, m) at
    ``points`` (m, 2).

    Each value comes from the polynomial of third degree that best fits the `NEIGHBOURS` nearest
    points, with weights 1 / distance^4: it passes through the data. Where the neighbours do not
    determine it, it is their weighted mean. Of fewer points all are neighbours.

    Returns the values (k, n), and how many of them are means.
    """
    from scipy.spatial import cKDTree

    tree: Any = cKDTree(points)
    poor = 0
    found = np.empty((len(data), len(at)))
    for part in chunks(len(at), AT_ONCE):
        distance, index = tree.query(at[part], np.arange(1, min(NEIGHBOURS, tree.n) + 1))
        scale = np.maximum(distance[:, -1:], 1e-300)
        u, v = np.moveaxis((points[index] - at[part, None, :]) / scale[:, :, None], 2, 0)
        weight = 1.0 / ((distance / scale) ** 2 + 1e-6)
        square = weight**2
        mean = np.sum(square * data[:, index], axis=2) / np.sum(square, axis=1)
        found[:, part] = mean
        if tree.n < 10:  # fewer than the coefficients
            poor += mean.shape[1]
            continue
        powers = [np.ones_like(u), u, v, u * u, u * v, v * v, u**3, u * u * v, u * v * v, v**3]
        q, r = np.linalg.qr(np.stack(powers, axis=2) * weight[:, :, None])
        pivots = np.abs(np.diagonal(r, axis1=1, axis2=2))
        fitted = pivots.min(axis=1) >= 1e-6 * pivots.max(axis=1)
        poor += int(np.count_nonzero(~fitted))
        for value, plane in zip(found[:, part], data, strict=True):
            right = np.einsum("nkj,nk->nj", q, weight * plane[index])[:, :, None]
            solved = np.linalg.solve(r + 1e-300 * np.eye(10), right)[:, 0, 0]
            value[fitted] = solved[fitted]
    return found, poor
