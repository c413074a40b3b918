"""Strength of a turbulent slab's fluctuation along a line of sight, by elevation.

The water along a path through three-dimensional turbulence of local strength proportional to the
vapour density rho_v has the variance

    sigma^2(el) ~ sin^-2(el) int int rho_v(h) rho_v(h') C(|h - h'| / sin el) dh dh'              (1)

with C the von Karman covariance of the air itself, nu = 1/3, of the same outer scale as the layers
(Tatarskii 1961). Of a slab that is deep beside the outer scale sigma rises as airmass^(1/2), of one
that is shallow as the airmass: relative to the water along the line of sight it falls as
airmass^(-1/2), or stays.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from zonda.core.types import Floats

from .weather.profiles import Profile

SEPARATIONS, NODES = 600, 32
"""Of the integral over |h - h'|, and of that over h for each."""


@dataclass(frozen=True, eq=False)
class Slab:
    """Water between two heights above the site [m]; ``profile`` None: evenly spread."""

    profile: Profile | None
    lowest: float
    highest: float
    outer_scale: float

    def share(self, sine: Floats | float) -> Floats:
        """rms relative to the water along the line of sight, over that at the zenith, at sines of
        the elevation (any shape).
        """
        sines = np.atleast_1d(np.asarray(sine, np.float64))
        squares = np.array([self._integral(s) for s in sines.ravel().tolist()]) / self._integral(
            1.0
        )
        return np.sqrt(squares).reshape(np.shape(sine))

    def _integral(self, sine: float) -> float:
        """The double integral of equation (1), up to a factor."""
        r, weight = self._overlap
        return float(np.trapezoid(weight * air_correlation(r / (sine * self.outer_scale)), r))

    @cached_property
    def _overlap(self) -> tuple[Floats, Floats]:
        """Separations r [m], and int rho_v(h) rho_v(h + r) dh at each, any unit."""
        depth = self.highest - self.lowest
        r = np.concatenate(
            [[0.0], np.geomspace(1e-5 * min(self.outer_scale, depth), depth, SEPARATIONS)]
        )
        x, w = np.polynomial.legendre.leggauss(NODES)
        h = self.lowest + (depth - r)[:, None] * (1 + x) / 2
        both = self._density(h) * self._density(np.minimum(h + r[:, None], self.highest))
        return r, both @ w * (depth - r) / 2

    def _density(self, height: Floats) -> Floats:
        if self.profile is None:
            return np.ones(height.shape)
        return np.asarray(self.profile.at(height).vapour_density)


def air_correlation(x: Floats) -> Floats:
    """Von Karman covariance in three dimensions, 2^(2/3) / Gamma(1/3) x^(1/3) K_1/3(x), of x = r /
    r0 >= 0.
    """
    from scipy.special import kv

    x = np.asarray(x, np.float64)
    safe = np.maximum(x, 1e-30)
    return np.where(
        x < 1e-12, 1.0, 2 ** (2 / 3) / math.gamma(1 / 3) * safe ** (1 / 3) * kv(1 / 3, safe)
    )
