"""The turbulence's lattice: its implied covariance (from the algorithm's own weights, not sampled), random access."""

from __future__ import annotations

from functools import cache

import numpy as np

from zonda.core.checks import Family
from zonda.operators.atmosphere.turbulence.covariance import beam_correlation, beam_structure
from zonda.operators.atmosphere.turbulence.implied import implied_covariance
from zonda.operators.atmosphere.turbulence.lattice import Turbulence
from zonda.operators.atmosphere.turbulence.levels import FIDELITIES

from .cases import BLOCKS, FAR
from .scenes import differing, largest

checks = Family("lattice")

SIGMA = 30.0


@cache
def implied_error(ratio: float, fidelity: str, sigma: float = SIGMA) -> tuple[float, float]:
    """Largest error of the covariance (of the variance) and of the structure function (of itself), 0 to 400 cells apart."""
    layer = Turbulence(0, outer_scale=ratio * sigma, sigma=sigma, fidelity=fidelity)
    start = np.array([(0, 0), (1, 0), (1, 1), (22, 41)])
    lags, ways = np.array([0, 1, 2, 5, 20, 130, 400]), np.array([(0, 1), (1, 0), (1, 1)])
    step = (lags[:, None, None] * ways).reshape(-1, 2)
    a = np.repeat(start, len(step), axis=0)
    b = a + np.tile(step, (len(start), 1))
    here, there, between = (implied_covariance(layer, p, q) for p, q in ((a, a), (b, b), (a, b)))
    r = np.hypot(*(b - a).T) * layer.spacing
    c, s = beam_correlation(r, layer.outer_scale, sigma), beam_structure(r, layer.outer_scale, sigma)
    apart = r > 0
    worst_c = largest(abs(between - c).max(), abs(there - layer.variance).max()) / layer.variance
    return float(worst_c), float(abs(((here + there) / 2 - between)[apart] / s[apart] - 1).max())


@checks.add(FAR, reference="analytic covariance behind the beam", limit=FIDELITIES["default"].error)
def covariance() -> float:
    """error of the implied covariance over the variance, r0 / sigma = 30, along, across and oblique"""
    return implied_error(30.0, "default")[0]


@checks.add(FAR, reference="analytic structure function", limit=FIDELITIES["default"].structure_error)
def structure_function() -> float:
    """relative error of the implied structure function from one cell up, r0 / sigma = 30"""
    return implied_error(30.0, "default")[1]


@checks.add(BLOCKS, reference="one large region", limit=0, unit="values")
def any_region() -> int:
    """spline coefficients that differ when the plane is asked for in small regions"""
    layer = Turbulence(3, outer_scale=500.0, sigma=21.0)
    whole = layer.coefficients(-37, 63, 1000, 1100)
    wrong = 0
    for i in range(-37, 63, 33):
        for j in range(1000, 1100, 27):
            part = layer.coefficients(i, min(i + 33, 63), j, min(j + 27, 1100))
            wrong += differing(part, whole[i + 37 : i + 70, j - 1000 : j - 973])
    return wrong
