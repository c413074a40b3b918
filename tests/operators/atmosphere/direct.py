"""A layer at any points, directly: cubic B-spline through its lattice, in float64, a box of it at a
time.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline

from zonda.operators.atmosphere.turbulence.lattice import Turbulence

Floats = NDArray[np.float64]


def at_points(field: Turbulence, across: Floats, along: Floats, cells: int = 1 << 24) -> Floats:
    """The field at (across, along) [m], of any equal shape."""
    x, y = across.ravel() / field.spacing, along.ravel() / field.spacing
    out = np.empty(x.shape)
    _fill(field, x, y, np.arange(x.size), out, cells)
    return out.reshape(across.shape)


def _fill(
    field: Turbulence, x: Floats, y: Floats, which: NDArray[np.int64], out: Floats, cells: int
) -> None:
    i, j = np.floor(x[which]).astype(int), np.floor(y[which]).astype(int)
    i0, i1, j0, j1 = i.min() - 1, i.max() + 3, j.min() - 1, j.max() + 3
    if (i1 - i0) * (j1 - j0) > cells and len(which) > 1:
        longer = x if i1 - i0 > j1 - j0 else y
        order = which[np.argsort(longer[which])]
        _fill(field, x, y, order[: len(order) // 2], out, cells)
        _fill(field, x, y, order[len(order) // 2 :], out, cells)
        return
    coefficients = field.coefficients(i0, i1, j0, j1).astype(np.float64)
    u, v = weights(x[which] - i), weights(y[which] - j)
    total = np.zeros(len(which))
    for k in range(4):
        for m in range(4):
            total += u[k] * v[m] * coefficients[i - i0 - 1 + k, j - j0 - 1 + m]
    out[which] = total


def weights(u: Floats) -> list[Floats]:
    """Of the four cubic B-splines over [0, 1), from scipy's."""
    spline = BSpline.basis_element(np.arange(5.0), extrapolate=False)
    return [np.nan_to_num(spline(3 - k + u)) for k in range(4)]
