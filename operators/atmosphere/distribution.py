"""Distribution of the PWV along a line of sight about its mean, and its strength by elevation.

It is normal, or log-normal for strong fluctuations. The water along a path through
three-dimensional turbulence of local strength proportional to the vapour density rho_v has the
variance

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

from zonda.core.errors import InputError
from zonda.core.types import Floats
from zonda.core.weather import PWV_MAX

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
        return self.profile.at(height).vapour_density


def air_correlation(x: Floats) -> Floats:
    """Von Karman covariance in three dimensions, 2^(2/3) / Gamma(1/3) x^(1/3) K_1/3(x), of x = r /
    r0 >= 0.
    """
    from scipy.special import kv

    x = np.asarray(x, np.float64)
    safe = np.maximum(x, 1e-30)
    return np.where(
        x < 1e-12,
        1.0,
        2 ** (2 / 3) / math.gamma(1 / 3) * safe ** (1 / 3) * kv(1 / 3, safe),
    )


LOG_NORMAL_FROM = 0.15
"""PWV rms from which y is exp(s g - s^2 var(g) / 2) - 1, so that the PWV stays positive (below, 1 +
y < 0 takes 6.7 sigma).
"""

CERTAIN = 5.0
"""Sigma up to which the PWV must lie inside the table: what is beyond is clipped, and counted."""

LARGEST_DEVIATION = 8
"""Sigma of the PWV that `response` covers by polynomials; beyond, it takes the slow way."""


def largest_pwv(pwv: float, rms: float) -> float:
    """The PWV [m] up to which a band is tabulated, for a mean and a relative rms."""
    rise = (
        math.exp(7 * _log_width(rms, 1.0))
        if rms >= LOG_NORMAL_FROM
        else 1 + LARGEST_DEVIATION * rms
    )
    return min(pwv * max(rise, 1.05), PWV_MAX)


@dataclass(frozen=True)
class Fluctuation:
    """The relative fluctuation y of the PWV, from the sum g of the layers' fields.

    Attributes
    ----------
    rms
        Relative, of the ensemble.
    after_beam
        Whether that is what the telescope sees, or what a pencil beam would see.
    variance
        Of g behind the beam.
    """

    rms: float
    after_beam: bool
    variance: float

    @property
    def scale(self) -> float:
        """y / g where y is normal."""
        return self.rms / math.sqrt(self.variance) if self.after_beam else self.rms

    @property
    def log_normal(self) -> bool:
        """True if 1 + y is log-normal."""
        return self.rms >= LOG_NORMAL_FROM

    @property
    def _width(self) -> float:
        return _log_width(self.rms, self.variance if self.after_beam else 1.0)

    def __call__(self, g: Floats) -> Floats:
        """y, of the same mean and rms whether normal or log-normal."""
        if not self.log_normal:
            return self.scale * g
        s = self._width
        return np.expm1(s * g - s * s * self.variance / 2)

    def limits(self, top: float) -> tuple[float, float]:
        """Least and largest y that may occur, up to ``top``."""
        ends = self(LARGEST_DEVIATION * math.sqrt(self.variance) * np.array([-1.0, 1.0]))
        return max(float(ends[0]), -1.0), min(float(ends[1]), top)

    def before_and_after(self) -> tuple[float, float]:
        """rms of y before and after the beam."""
        if not self.log_normal:
            return self.scale, self.scale * math.sqrt(self.variance)
        s = self._width
        return math.sqrt(math.expm1(s * s)), math.sqrt(math.expm1(s * s * self.variance))

    def check(self, pwv: float, place: str) -> None:
        """Refuse a PWV [m] and rms whose distribution `PWV_MAX` would cut (`InputError`)."""
        most = pwv * (1 + float(self(np.array([CERTAIN * math.sqrt(self.variance)]))[0]))
        if most <= PWV_MAX:
            return
        width = CERTAIN - math.sqrt(max(CERTAIN**2 - 2 * math.log(max(PWV_MAX / pwv, 1.0)), 0.0))
        fits = (PWV_MAX / pwv - 1) / CERTAIN
        fits = fits if fits < LOG_NORMAL_FROM else math.sqrt(math.expm1(width**2))
        raise InputError(
            f"a PWV of {pwv * 1e3:.3g} mm with a rms of {self.rms:.3g} of it reaches"
            f" {most * 1e3:.3g} mm at {CERTAIN:g} sigma; the limit is {PWV_MAX * 1e3:.0f} mm",
            place=place,
            cure=f"lower pwv_rms to {fits:.1%} or less, or the PWV",
        )


def _log_width(rms: float, variance: float) -> float:
    """s of the log-normal law: exp(s g) has the relative rms where g has the given variance."""
    return math.sqrt(math.log1p(rms**2) / variance)
