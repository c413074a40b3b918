"""Von Karman covariance of a turbulent layer, seen through point-like and through Gaussian beams.

A layer of unit variance and outer scale r0 has, with nu = 5/6 (van Marrewijk et al. 2024; Tatarskii
1961),

    C(r) = 2^(1-nu) / Gamma(nu) x^nu K_nu(x),   x = r / r0                                    (1)
    P(k) = 4 pi nu r0^(-2 nu) (k^2 + r0^-2)^(-nu-1)           (two-dimensional spectrum)         (2)
         = int_0^inf w(s) exp(-s k^2) ds,
         w(s) = 4 pi nu r0^(-2 nu) / Gamma(nu+1) s^nu exp(-s / r0^2)   (3)

A Gaussian beam of standard deviation sigma turns exp(-s k^2) into exp(-(s + sigma^2) k^2) and
leaves w alone, so

    C(r; sigma) = int w(s) exp(-r^2 / 4e) / (4 pi e) ds,
    e = s + sigma^2                               (4)

The structure function S = C(0) - C(r) (half the mean squared difference of two points) is never
formed by subtraction.
"""

from __future__ import annotations

import math
from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike

from zonda.core.types import Floats

NU = 5 / 6
"""Smoothness of frozen Kolmogorov turbulence seen through a layer."""

_TERMS = 16


def structure(x: ArrayLike) -> Floats:
    """1 - C of equation (1) at x = r / r0 >= 0; relative error < 1e-13 for any x.

    Below x = 2 by two power series (DLMF 10.25.2, 10.27.4), q = x^2 / 4:
    S = Gamma(1-nu)/Gamma(1+nu) (x/2)^(2 nu) sum_{k>=0} q^k / (k! (1+nu)_k) - sum_{k>=1} q^k / (k!
    (1-nu)_k).
    """
    x = np.atleast_1d(np.asarray(x, np.float64))
    out = np.empty(x.shape)
    near = x < 2
    y = x[near]
    q = (y / 2) ** 2
    plus = np.ones_like(y)
    minus = np.zeros_like(y)
    up = np.ones_like(y)
    down = np.ones_like(y)
    for k in range(1, _TERMS):
        up = up * q / (k * (k + NU))
        down = down * q / (k * (k - NU))
        plus = plus + up
        minus = minus + down
    out[near] = math.gamma(1 - NU) / math.gamma(1 + NU) * (y / 2) ** (2 * NU) * plus - minus
    out[~near] = 1 - _tail(x[~near])
    return out


def correlation(x: ArrayLike) -> Floats:
    """C of equation (1) at x = r / r0 >= 0; relative error < 1e-13 where C > 1e-300."""
    x = np.atleast_1d(np.asarray(x, np.float64))
    out = np.empty(x.shape)
    near = x < 2
    out[near] = 1 - structure(x[near])
    out[~near] = _tail(x[~near])
    return out


def _tail(x: Floats) -> Floats:
    from scipy.special import kve

    return np.asarray(2 ** (1 - NU) / math.gamma(NU) * x**NU * kve(NU, x) * np.exp(-x), np.float64)


def mixture(
    outer_scale: float,
    sigma: float,
    step: float = 0.25,
    depth: float = 1e-19,
) -> tuple[Floats, Floats]:
    """Nodes e = s + sigma^2 [m2] and weights of equation (4), sigma > 0: C(r; sigma) = sum weight
    exp(-r^2 / 4e).

    Trapezoidal rule in ln s from ``depth`` times the smaller of sigma^2 and r0^2. It converges like
    exp(-pi^2 / step) (the integrand is analytic for |Im ln s| < pi / 2): relative error < 1e-14 of
    C and S, 3e-8 with step 0.5 and depth 1e-6.
    """
    low = math.log(depth) + 2 * math.log(min(sigma, outer_scale))
    high = math.log(45.0) + 2 * math.log(outer_scale)
    s = np.exp(np.arange(low, high, step))
    e = s + sigma**2
    return e, _density(s, outer_scale) * step / (4 * np.pi * e)


def _density(s: Floats, outer_scale: float) -> Floats:
    """s w(s) of equation (3): the weight per unit of ln s, m2."""
    t = s / outer_scale**2
    return 4 * np.pi * NU / math.gamma(NU + 1) * t ** (NU + 1) * np.exp(-t) * outer_scale**2


def beam_correlation(r: ArrayLike, outer_scale: float, sigma: float) -> Floats:
    """Covariance of the unit-variance layer after the beam, equation (4). ``r``, ``outer_scale``,
    ``sigma`` in m.
    """
    r = np.atleast_1d(np.asarray(r, np.float64))
    if sigma == 0:
        return correlation(r / outer_scale)
    e, w = mixture(outer_scale, sigma)
    return np.asarray(np.exp(-np.multiply.outer(r * r, 1 / (4 * e))) @ w, np.float64)


def beam_structure(r: ArrayLike, outer_scale: float, sigma: float) -> Floats:
    """C(0) - C(r) after the beam: half the mean squared difference between two lines of sight ``r``
    metres apart.
    """
    r = np.atleast_1d(np.asarray(r, np.float64))
    if sigma == 0:
        return structure(r / outer_scale)
    e, w = mixture(outer_scale, sigma)
    return np.asarray(-np.expm1(-np.multiply.outer(r * r, 1 / (4 * e))) @ w, np.float64)


def mixture_between(
    outer_scale: float,
    sigma: float,
    low: float,
    high: float,
    nodes: int = 32,
) -> tuple[Floats, Floats]:
    """The part of the mixture with low <= e < high [m2]: nodes e and weights w(s) ds (m2, equation
    3), Gauss-Legendre in ln s.
    """
    bottom = low - sigma**2
    if bottom <= 0:
        bottom = 1e-13 * min(sigma, outer_scale) ** 2
        nodes *= 2
    a = math.log(bottom)
    b = math.log(high - sigma**2)
    x, weight = _gauss_legendre(nodes)
    s = np.exp((a + b) / 2 + (b - a) / 2 * x)
    return s + sigma**2, _density(s, outer_scale) * weight * (b - a) / 2


def spectrum_between(k2: Floats, outer_scale: float, split: float) -> tuple[Floats, Floats]:
    """The parts of the spectrum P (equation 2) with s below and above ``split`` [m2] (equation 3),
    at squared wave numbers k2.

    Incomplete gamma functions of nu + 1 at split (k^2 + r0^-2).
    """
    from scipy.special import gammainc, gammaincc

    total = k2 + outer_scale**-2
    power = 4 * np.pi * NU * outer_scale ** (-2 * NU) * total ** (-NU - 1)
    return power * gammainc(NU + 1, split * total), power * gammaincc(NU + 1, split * total)


@lru_cache(maxsize=4)
def _gauss_legendre(nodes: int) -> tuple[Floats, Floats]:
    x, weight = np.polynomial.legendre.leggauss(nodes)
    return x, weight
