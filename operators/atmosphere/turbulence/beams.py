"""Near-field footprints of a telescope in a layer: the paper's Gaussian, and apertures with a rim.

Within the Rayleigh distance a telescope collects from a column as wide as its aperture, weighted by
the power illumination

    A(r) = exp(-beta (r / a)^2),   r <= a,
    beta = edge taper [dB] ln(10) / 10                               (1)

(a top hat where the taper is 0). The column widens with distance as the paper's Gaussian does, D(z)
= D sqrt(1 + (z / z_r)^2). With B(k) the transform of A, normalized to B(0) = 1, a layer of spectrum
P (`covariance`, equation 2) is seen as P B^2:

    S(r) = int P(k) B(k)^2 (1 - J_0(k r)) k dk / 2 pi                                            (2)

The pyramid (`turbulence`) sees large scales through two Gaussians that match B^2 up to k^4,

    B^2 = 2 exp(-u k^2) - exp(-(2 u - m) k^2) + O(k^6),
    u = m + sqrt((m^2 - m2) / 2)                          (3)

with m and m2 the first two moments: B^2 = 1 - m k^2 + m2 k^4 / 2 + ... What is left goes into the
finest level. Interpolation errors are bounded with (1 + 2 m k^2 / 3)^(-3/2) >= B^2, which is a
mixture of Gaussians (`bound`).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import ArrayLike

from zonda.core.types import Floats

from .covariance import NU


def widened(diameter: float, wavelength: float, distance: float) -> float:
    """D sqrt(1 + (z / z_r)^2), z_r = pi (D / 2)^2 / lambda: width [m] of the column at ``distance``
    along the line of sight.
    """
    return diameter * math.hypot(1.0, distance / rayleigh_distance(diameter, wavelength))


def rayleigh_distance(diameter: float, wavelength: float) -> float:
    """z_r = pi (D / 2)^2 / lambda, m."""
    return math.pi * (diameter / 2) ** 2 / wavelength


@dataclass(frozen=True)
class Aperture:
    """A footprint of equation (1): ``diameter`` in m, ``taper`` of the power at its rim in dB (0:
    top hat).
    """

    diameter: float
    taper: float = 0.0

    def transform(self, k: ArrayLike) -> Floats:
        """B(k), k in rad/m: 2 J_1(x) / x for the top hat, x = k D / 2; error < 1e-8 for x < 250."""
        from scipy.special import j1

        x = np.asarray(k, np.float64) * self.diameter / 2
        if self.taper == 0:
            small = x < 1e-4
            return np.where(small, 1 - x * x / 8, 2 * j1(x) / np.where(small, 1.0, x))
        return np.asarray(_tapered(self.taper)(np.minimum(x, _LARGEST_X)), np.float64)

    @cached_property
    def moments(self) -> tuple[float, float]:
        """(m, m2) of equation (3), m2 and m4."""
        u, w = _illumination(self.taper)
        two = float(w @ u**2)
        four = float(w @ u**4)
        a = self.diameter / 2
        return two / 2 * a**2, (four / 16 + two**2 / 8) * a**4

    @property
    def sigma(self) -> float:
        """Standard deviation of the Gaussian footprint of equal second moment, m (D / 4 for the top
        hat).
        """
        return math.sqrt(self.moments[0])

    @property
    def gaussians(self) -> tuple[tuple[float, float], ...]:
        """(coefficient, sigma^2 [m2]) of equation (3)."""
        first, second = self.moments
        u = first + math.sqrt(max(first**2 - second, 0.0) / 2)
        return (2.0, u), (-1.0, 2 * u - first)

    def bound(self) -> tuple[Floats, Floats]:
        """(sigma^2 [m2], weights): sum weight exp(-sigma^2 k^2) = (1 + 2 m k^2 / 3)^(-3/2), nowhere
        below B^2 up to k a = 40.

        (1 + q)^(-3/2) = int t^(3/2) exp(-t (1 + q)) d ln t / Gamma(3/2), by the trapezoidal rule.
        """
        t = np.exp(np.arange(-7.0, 3.6, 1.0))
        w = t**1.5 * np.exp(-t)
        return np.asarray(2 / 3 * self.moments[0] * t, np.float64), np.asarray(
            w / w.sum(),
            np.float64,
        )

    def structure(self, r: ArrayLike, outer_scale: float) -> Floats:
        """Equation (2): half the mean squared difference of two lines of sight ``r`` metres apart.
        Relative error < 1e-6.
        """
        from scipy.special import j0

        r = np.atleast_1d(np.asarray(r, np.float64))
        power, k = self._power(outer_scale, float(r.max()))
        x = np.multiply.outer(r, k)
        return np.asarray(np.where(x < 1e-3, x * x / 4, 1 - j0(x)) @ power, np.float64)

    def variance(self, outer_scale: float) -> float:
        """Variance behind the footprint of a layer of unit variance."""
        return float(self._power(outer_scale)[0].sum())

    def _power(self, outer_scale: float, r: float = 0.0) -> tuple[Floats, Floats]:
        """P B^2 k dk / 2 pi at nodes k, close enough for J_0(k r): panels even in ln x below x = k
        a = 0.5, in x to 200.
        """
        a = self.diameter / 2
        x, weight = np.polynomial.legendre.leggauss(24)
        low = math.log(1e-4 * min(1.0, a / outer_scale))
        panel = min(2.0, 12 * a / max(r, a))
        edges = np.concatenate(
            [
                np.exp(np.arange(low, math.log(0.5), 0.25)),
                np.arange(0.5, 30.0, panel),
                np.arange(30.0, 201.0, 2.0),
            ]
        )
        middle = (edges[1:] + edges[:-1]) / 2
        half = np.diff(edges) / 2
        k = (middle[:, None] + half[:, None] * x).ravel() / a
        dk = (half[:, None] * weight).ravel() / a
        power = (
            2
            * NU
            * outer_scale ** (-2 * NU)
            * (k**2 + outer_scale**-2) ** (-NU - 1)
            * self.transform(k) ** 2
            * k
            * dk
        )
        return power, k


_LARGEST_X = 300.0


@lru_cache(maxsize=8)
def _illumination(taper: float) -> tuple[Floats, Floats]:
    """Nodes u = r / a and weights (unit sum) of the integral over the footprint."""
    x, w = np.polynomial.legendre.leggauss(240)
    u = (x + 1) / 2
    weight = w * u * np.exp(-taper * math.log(10) / 10 * u * u)
    return u, weight / weight.sum()


@lru_cache(maxsize=8)
def _tapered(taper: float):  # type: ignore[no-untyped-def]
    """B as a function of x = k a, from a table."""
    from scipy.interpolate import CubicSpline
    from scipy.special import j0

    x = np.linspace(0, _LARGEST_X, 12001)
    u, w = _illumination(taper)
    return CubicSpline(x, j0(np.multiply.outer(x, u)) @ w)
