"""The turbulence's lattice: its implied covariance over the whole range of outer scales, its
limits, narrow strips, regions.
"""

from __future__ import annotations

import math
from functools import cache

import numpy as np
from numpy.typing import NDArray

from zonda.core.checks import Family, Measured
from zonda.operators.atmosphere.turbulence.covariance import beam_correlation, beam_structure
from zonda.operators.atmosphere.turbulence.lattice import Turbulence
from zonda.operators.atmosphere.turbulence.levels import FIDELITIES
from zonda.plugins.checks.scenes import BLOCKS, differing, largest

from .cases import FAR, OVERLAP, STRIP
from .implied import implied_covariance
from .scenes import unrefused

checks = Family("lattice")

SIGMA = 30.0

RATIOS = (1e-3, 0.06, 1.0, 30.0, 400.0, 2e4, 1e6)
"""r0 / sigma; a cell is 0.3 to 0.6 sigma, so r0 / cell runs from below 1e-1 to 1e6 and beyond."""


@cache
def implied_error(ratio: float, fidelity: str, sigma: float = SIGMA) -> tuple[float, float]:
    """Largest error of the covariance (of the variance) and of the structure function (of itself),
    0 to 400 cells apart.
    """
    layer = Turbulence(0, outer_scale=ratio * sigma, sigma=sigma, fidelity=fidelity)
    start = np.array([(0, 0), (1, 0), (1, 1), (22, 41)])
    lags, ways = np.array([0, 1, 2, 5, 20, 130, 400]), np.array([(0, 1), (1, 0), (1, 1)])
    step = (lags[:, None, None] * ways).reshape(-1, 2)
    a = np.repeat(start, len(step), axis=0)
    b = a + np.tile(step, (len(start), 1))
    here, there, between = (implied_covariance(layer, p, q) for p, q in ((a, a), (b, b), (a, b)))
    r = np.hypot(*(b - a).T) * layer.spacing
    c, s = (
        beam_correlation(r, layer.outer_scale, sigma),
        beam_structure(r, layer.outer_scale, sigma),
    )
    apart = r > 0
    worst_c = largest(abs(between - c).max(), abs(there - layer.variance).max()) / layer.variance
    return float(worst_c), float(abs(((here + there) / 2 - between)[apart] / s[apart] - 1).max())


@checks.add(FAR, reference="analytic covariance behind the beam", limit=FIDELITIES["default"].error)
def covariance() -> float:
    """error of the implied covariance over the variance, r0 / sigma = 30, along, across and
    oblique
    """
    return implied_error(30.0, "default")[0]


@checks.add(
    FAR, reference="analytic structure function", limit=FIDELITIES["default"].structure_error
)
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


@checks.add(FAR, reference="analytic covariance", limit=FIDELITIES["default"].error)
def covariance_over_the_range() -> float:
    """error of the implied covariance over the variance, r0 / sigma from 1e-3 to 1e6, fidelity
    default
    """
    return largest(*(implied_error(ratio, "default")[0] for ratio in RATIOS))


@checks.add(
    FAR, reference="analytic structure function", limit=FIDELITIES["default"].structure_error
)
def structure_function_over_the_range() -> float:
    """error of the implied structure function, r0 / sigma from 1e-3 to 1e6, fidelity default"""
    return largest(*(implied_error(ratio, "default")[1] for ratio in RATIOS))


@checks.add(FAR, reference="analytic covariance", limit=FIDELITIES["fine"].error)
def fine_covariance_over_the_range() -> float:
    """error of the implied covariance over the variance, r0 / sigma from 1e-3 to 1e6, fidelity
    fine
    """
    return largest(*(implied_error(ratio, "fine")[0] for ratio in RATIOS))


@checks.add(FAR, reference="analytic structure function", limit=FIDELITIES["fine"].structure_error)
def fine_structure_function_over_the_range() -> float:
    """error of the implied structure function, r0 / sigma from 1e-3 to 1e6, fidelity fine"""
    return largest(*(implied_error(ratio, "fine")[1] for ratio in RATIOS))


@checks.add(FAR, reference="an error that names the outer scale", limit=0, unit="not refused")
def refusals() -> Measured:
    """outer scales and beams that the stated error does not cover"""
    beyond = (
        (1e9, 21.0),
        (0.01, 21.0),
        (np.inf, 21.0),
        (np.nan, 21.0),
        (0.0, 21.0),
        (-500.0, 21.0),
        (500.0, 0.0),
    )
    return unrefused(
        [(lambda r=r, s=s: Turbulence(0, outer_scale=r, sigma=s), "outer scale") for r, s in beyond]
    )  # type: ignore[misc]


@checks.add(OVERLAP, reference="analytic structure function", limit=1e-2)
def neighbours() -> float:
    """relative error of the implied structure function of lines of sight 0.2 m apart behind D = 100
    m, anywhere in a cell
    """
    sigma, r, n = 42.5, 0.2, 18
    layer = Turbulence(0, outer_scale=500.0, sigma=sigma)
    i, j = (v.ravel() for v in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    exact, worst = beam_structure(r, 500.0, sigma)[0], 0.0
    at = (np.arange(5) + 0.5) / 5 + n // 2 - 3
    w = _cardinal(at + r / layer.spacing, n) - _cardinal(at, n)
    for row, column in ((0, 0), (1, 0), (2, 5)):
        ends = (np.stack([v + row, np.full(v.shape, column)], axis=1) for v in (i, j))
        among = implied_covariance(layer, *ends).reshape(n, n)
        implied = np.einsum("an,nm,am->a", w, among, w) / 2
        worst = largest(worst, float(abs(implied / exact - 1).max()))
    return worst


def _cardinal(at: NDArray[np.float64], n: int) -> NDArray[np.float64]:
    """(len(at), n): weight of each lattice point in the cubic spline through all of them."""
    from scipy.interpolate import make_interp_spline

    return np.asarray(make_interp_spline(np.arange(n), np.eye(n), k=3)(at), np.float64)


@checks.add(STRIP, reference="the same points inside a wide region", limit=0, unit="values")
def narrow_strip() -> int:
    """values that differ at both ends of a strip 2 cells wide and 1e6 long"""
    n = 1_000_000
    layer, strip = Turbulence(2, outer_scale=500.0, sigma=SIGMA), _strip()
    return differing(strip[:, :300], layer.region(-40, 40, -50, 300)[40:42, 50:]) + differing(
        strip[:, -300:], layer.region(-40, 40, n - 300, n + 50)[40:42, :300]
    )


@checks.add(STRIP, reference="analytic structure function", limit=5, unit="standard errors")
def across_a_narrow_strip() -> float:
    """mean squared difference across that strip, whose relative standard error is 0.5 %

    The mean of d^2 over n cells has the relative variance 2 / n_eff, 1 / n_eff = sum of rho^2 over
    lags, rho that of d.
    """
    strip = _strip()
    spacing = Turbulence(2, outer_scale=500.0, sigma=SIGMA).spacing
    lag = spacing * np.arange(2000)
    s = beam_structure(spacing, 500.0, SIGMA)[0]
    rho = (
        beam_structure(np.hypot(lag, spacing), 500.0, SIGMA) - beam_structure(lag, 500.0, SIGMA)
    ) / s
    error = math.sqrt(2 * (2 * float((rho**2).sum()) - 1) / strip.shape[1])
    return float(abs(np.mean(np.diff(strip.astype(np.float64), axis=0) ** 2) / (2 * s) - 1) / error)


@cache
def _strip() -> NDArray[np.float32]:
    return Turbulence(2, outer_scale=500.0, sigma=SIGMA).region(0, 2, 0, 1_000_000)


@checks.add(STRIP, reference="the same point inside a region", limit=0, unit="values")
def one_point() -> int:
    """a region of one lattice point, 1e12 cells away"""
    layer, far = Turbulence(1, outer_scale=500.0, sigma=21.0), 10**12
    alone, among = (
        layer.region(far, far + 1, -far, -far + 1),
        layer.region(far - 9, far + 40, -far - 3, -far + 70),
    )
    return differing(alone, among[9:10, 3:4])
