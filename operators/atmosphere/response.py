"""The band's response to a fluctuation of the PWV, as polynomials valid for one scan: fast, and
smooth.

With y the relative fluctuation of the PWV and s the sine of the elevation,

    f(y, s) = y sum_ij c_ij Y^i S^j,
    Y, S in [-1, 1] over the ranges of y and s                               (1)

stands for the difference of the emission [K_RJ] and of the opacity from those at y = 0, fitted to
`BandAtmosphere` at Chebyshev points; the relative transmission, which spans decades in opaque
bands, is expm1 of minus the latter. The factor y makes it exact where nothing fluctuates. Where
layers have a response of their own (`LayerTerms`), its first order is added. Ranges too wide for
polynomials of `_DEGREES` (strong log-normal fluctuations) are left to `BandAtmosphere` itself.

A layer's water absorbs and emits as it does at its height, the column's as it does on average. With
f'_l(s) the derivative of the band's emission (or opacity) with respect to a relative change of the
PWV that is made at the height of layer l, f'(0, s) that of the column, kappa_l = f'_l / f', what
(1) gives for the column gains

    f'(0, s) sum_l (kappa_l - 1) p a_l g_l = (1 / s) sum_j S^j sum_l c_jl p a_l g_l,
    S in [-1, 1] over the scan      (2)

the first order of what each layer's water changes more than the column's. s (f'_l - f') is nearly
constant where the air is clear; the c_jl are its polynomials in S, of the degree that the range of
elevations needs. The quotient kappa_l is not formed: where a line is saturated f' vanishes.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache

import numba as nb
import numpy as np

from zonda.core.kernels import kernel
from zonda.core.types import Floats

from .weather.bands import BandAtmosphere, chebyshev_points
from .weather.radiative_transfer import EARTH_RADIUS, ELEVATION_MAX, ELEVATION_MIN

WATER_DENSITY = 1000.0  # kg / m3
VAPOUR_GAS_CONSTANT = 461.52  # J / (kg K)
K2, K3 = 0.221, 3739.0  # K / Pa, K2 / Pa: k_2' and k_3

ERROR = 1e-5
"""Largest error of f / y, of the largest |f / y|."""

LOOKED_AT = 13
"""Points along each axis at which a fit of low degree is judged; twice as many for others."""

_DEGREES = ((2, 2), (3, 3), (4, 4), (5, 6), (7, 8), (10, 12), (14, 16))


NAMES = ("emission", "opacity")
"""Responses that depend on the height of the water."""
TERM_ERROR = 5e-4
"""Largest error of s (f'_l - f') in elevation, of the largest s f'_l."""
TERM_DEGREES = (0, 1, 2, 4, 6, 8)
"""Of the polynomials in S; the last one is taken where none meets `TERM_ERROR`."""


@dataclass(frozen=True)
class LayerTerms:
    """Equation (2) for one band, mean PWV and scan.

    Attributes
    ----------
    weights
        (k, n_layer) c_jl times y / (a_l g_l): the weights of the sums over the layers' a_l g_l,
        those of the emission first.
    degrees
        Highest power of S of each of `NAMES`.
    sines
        Least and largest sine of the elevation.
    """

    weights: Floats
    degrees: tuple[int, ...]
    sines: tuple[float, float]

    @classmethod
    def of(
        cls,
        band: BandAtmosphere,
        pwv: float,
        heights: Floats,
        scale: float,
        sines: tuple[float, float],
    ) -> LayerTerms:
        """Compute the terms of layers at ``heights`` (n_layer,) above the site [m]; ``scale``: y /
        sum_l a_l g_l.
        """
        low = max(sines[0], math.sin(ELEVATION_MIN) * (1 + 1e-12))
        high = min(sines[1], math.sin(ELEVATION_MAX))
        looked_at = np.cos(np.linspace(0, math.pi, LOOKED_AT))
        points = [chebyshev_points(n + 1) for n in TERM_DEGREES]
        places = np.concatenate([looked_at, *points])
        s = (low + high) / 2 + places * (high - low) / 2
        water = band.transfer.of_water(pwv, np.arcsin(np.clip(s, low, high)).tolist())
        weights = []
        degrees = []
        for name in NAMES:
            own = pwv * s[:, None] * water.at(name, heights)
            excess = own - pwv * s[:, None] * water.of_column(name)[:, None]
            truth = excess[:LOOKED_AT]
            first = LOOKED_AT
            for degree, known in zip(TERM_DEGREES, points, strict=True):
                matrix = np.linalg.inv(np.vander(known, degree + 1, increasing=True))
                found = matrix @ excess[first : first + degree + 1]
                first += degree + 1
                error = np.abs(
                    np.vander(looked_at, degree + 1, increasing=True) @ found - truth
                ).max()
                if error <= TERM_ERROR * np.abs(own[:LOOKED_AT]).max():
                    break
            weights.append(scale * found)
            degrees.append(degree)
        return cls(np.concatenate(weights), tuple(degrees), (low, high))

    def add(self, name: str, sums: Floats, s: Floats, out: Floats) -> None:
        """Add equation (2) to the response called ``name``; ``sums`` (k, n, m) over all layers,
        ``s`` and ``out`` (n, m).
        """
        if name not in NAMES:
            return
        which = NAMES.index(name)
        first = sum(self.degrees[:which]) + which
        low, high = self.sines
        own = np.clip(s, low, high)  # beyond lies the margin of a spline
        place = (2 * own - (low + high)) / max(high - low, 1e-9)
        total = sums[first + self.degrees[which]].copy()
        for j in range(self.degrees[which] - 1, -1, -1):
            total *= place
            total += sums[first + j]
        out += total / own


def kappa(band: BandAtmosphere, pwv: float, elevation: float, heights: Floats) -> dict[str, Floats]:
    """kappa of the emission and of the opacity, (n,) each, at ``heights`` above the site [m]. PWV
    in m, elevation in rad.

    Of the whole column, int kappa rho_v dh = PWV.
    """
    water = band.transfer.of_water(pwv, [elevation])
    found = {}
    for name in NAMES:
        column = float(water.of_column(name)[0])
        found[name] = water.at(name, heights)[0] / (column if abs(column) > 1e-30 else 1e-30)
    return found


def delay_per_vapour(temperature: Floats, weights: Floats) -> float:
    """Excess path length per PWV, Pi = 1e-6 rho R_v (k_3 / T_m + k_2'), of vapour at temperatures
    [K] with weights (any unit).

    T_m = int rho_v dz / int (rho_v / T) dz, rho the density of water, R_v the gas constant of
    vapour (Bevis et al. 1994, J. Appl. Meteor. 33, 379, after Thayer). Pi is 6.4 at T_m = 273 K and
    falls with temperature, 0.35 % per K. It holds for radio waves far from water lines; dispersion
    in the submillimetre windows (some per cent, more beside 557 GHz) is not in it.
    """
    mean = float(weights.sum() / (weights / temperature).sum())
    return 1e-6 * WATER_DENSITY * VAPOUR_GAS_CONSTANT * (K3 / mean + K2)


class Response:
    """Equation (1) for one band, mean PWV [m] and scan.

    Parameters
    ----------
    band, pwv
        The band's atmosphere and the mean PWV.
    y_range
        Smallest and largest fluctuation.
    sines
        Smallest and largest sine of the elevation.
    vapour_height
        Height of the vapour [m], for the airmass of ``pwv``.
    delay_per_vapour
        Path delay per line-of-sight PWV.
    names
        The responses wanted, of ``emission, transmission, opacity, pwv, path_delay``.
    terms
        What layers add to the column's response; None: nothing.

    Raises
    ------
    InputError
        Elevations outside the limits of the radiative transfer.
    """

    def __init__(
        self,
        band: BandAtmosphere,
        pwv: float,
        y_range: tuple[float, float],
        sines: tuple[float, float],
        vapour_height: float,
        delay_per_vapour: float,
        names: tuple[str, ...],
        terms: LayerTerms | None = None,
    ) -> None:
        self.names = names
        self._terms = terms
        self._range = y_low, y_high = y_range
        bottom, top = np.sin(ELEVATION_MIN) * (1 + 1e-12), np.sin(ELEVATION_MAX)
        self._y = ((y_low + y_high) / 2, 2 / max(y_high - y_low, 1e-9))
        low = max(sines[0], bottom)
        high = min(sines[1], top)
        self._s = ((low + high) / 2, 2 / max(high - low, 1e-9))

        def elevation(
            s: Floats,
        ) -> Floats:  # lines of sight beyond are refused: this cuts the widened range, and rounding
            return np.asarray(np.arcsin(np.clip(s, bottom, top)), np.float64)

        def column(y: Floats, s: Floats) -> Floats:
            return pwv * y * airmass(elevation(s), vapour_height)

        def depth(y: Floats, s: Floats) -> Floats:
            return band.log_transmission_difference(pwv, pwv * y, elevation(s))

        every: dict[str, Callable[[Floats, Floats], Floats]] = {
            "emission": lambda y, s: band.emission_difference(pwv, pwv * y, elevation(s)),
            "opacity": lambda y, s: -depth(y, s),
            "pwv": column,
            "path_delay": lambda y, s: delay_per_vapour * column(y, s),
        }
        needed = dict.fromkeys("opacity" if name == "transmission" else name for name in names)
        self._direct = {name: every[name] for name in needed}
        self._coefficients = {name: self._fit(self._direct[name]) for name in needed}

    def __call__(self, name: str, y: Floats, s: Floats, weighted: Floats | None = None) -> Floats:
        """The difference called ``name`` at fluctuations ``y`` and sines of the elevation ``s``,
        both (n, m).

        ``weighted``: (k, n, m) sums over the layers, with the weights of `LayerTerms`.
        """
        if name == "transmission":
            return np.asarray(np.expm1(-self("opacity", y, s, weighted)), np.float64)
        found = self._of_column(name, y, s)
        if self._terms is not None and weighted is not None:
            self._terms.add(name, weighted, s, found)
        return found

    def _of_column(self, name: str, y: Floats, s: Floats) -> Floats:
        coefficients = self._coefficients[name]
        if coefficients is None:
            return self._direct[name](y, s)
        out = np.empty(y.shape)
        beyond = _polynomials(y, s, coefficients, *self._y, *self._s, *self._range, out)
        if beyond:  # 8 sigma
            far = (y < self._range[0]) | (y > self._range[1])
            out[far] = self._direct[name](y[far], s[far])
        return out

    def _fit(self, function: Callable[[Floats, Floats], Floats]) -> Floats | None:
        """(n_y, n_s) power coefficients, or None."""

        def over_y(y: Floats, s: Floats) -> Floats:
            y = np.where(abs(y) < 1e-7, 1e-7, y)
            return function(y, s) / y

        known: dict[int, Floats] = {}
        for n_y, n_s in _DEGREES:
            looked_at = LOOKED_AT if max(n_y, n_s) <= 4 else 2 * LOOKED_AT
            if looked_at not in known:
                known[looked_at] = over_y(
                    *self._unscaled(*np.meshgrid(*_ends(looked_at), indexing="ij"))
                )
            truth, (a, b) = known[looked_at], (chebyshev_points(n) for n in (n_y, n_s))
            values = over_y(*self._unscaled(*np.meshgrid(a, b, indexing="ij")))
            series = np.einsum("iu,uv,jv->ij", _to_series(n_y), values, _to_series(n_s))
            found = np.einsum(
                "pi,ij,qj->pq", *(_vander(looked_at, 0, n_y), series, _vander(looked_at, 1, n_s))
            )
            if abs(found - truth).max() <= ERROR * abs(truth).max():
                return np.ascontiguousarray(
                    np.einsum("ki,ij,lj->kl", _to_powers(n_y), series, _to_powers(n_s))
                )
        return None

    def _unscaled(self, a: Floats, b: Floats) -> tuple[Floats, Floats]:
        return self._y[0] + a / self._y[1], self._s[0] + b / self._s[1]


def airmass(elevation: Floats, height: float) -> Floats:
    """Airmass of a spherical shell at ``height`` [m]: equation (1) of `radiative_transfer`."""
    return np.asarray(
        1 / np.sqrt(1 - (np.cos(elevation) / (1 + height / EARTH_RADIUS)) ** 2),
        np.float64,
    )


def _ends(number: int) -> tuple[Floats, Floats]:
    """Points of Y and of S at which a fit is judged, the ends among them."""
    return np.cos(np.linspace(0.1, 3.1, number)), np.cos(np.linspace(0, 3.14, number))


@lru_cache
def _to_series(n: int) -> Floats:
    """Matrix (n, n) from values at `chebyshev_points` to Chebyshev coefficients."""
    return np.asarray(
        np.linalg.inv(np.polynomial.chebyshev.chebvander(chebyshev_points(n), n - 1)),
        np.float64,
    )


@lru_cache
def _vander(number: int, which: int, n: int) -> Floats:
    """Matrix (number, n) from Chebyshev coefficients to values at the points of `_ends`."""
    return np.asarray(np.polynomial.chebyshev.chebvander(_ends(number)[which], n - 1), np.float64)


@lru_cache
def _to_powers(n: int) -> Floats:
    """Matrix (n, n) from Chebyshev to power coefficients, lowest first."""
    matrix = np.zeros((n, n))
    for k in range(n):
        powers = np.polynomial.chebyshev.cheb2poly(np.eye(n)[k])
        matrix[: len(powers), k] = powers
    return matrix


@kernel
def _polynomials(  # type: ignore[no-untyped-def]
    y, s, coefficients, y0, y_scale, s0, s_scale, y_low, y_high, out
):
    """Equation (1); the number of values of ``y`` outside its range.

    S outside its range belongs to the path beyond the ends of a scan, which only feeds the margin
    of a spline: held at its end.
    """
    m = nb.uint64(y.shape[1])
    n_y, n_s = coefficients.shape
    a, b, inner = np.empty(y.shape[1]), np.empty(y.shape[1]), np.empty(y.shape[1])
    beyond = 0
    for n in range(y.shape[0]):
        row, at, total = y[n], s[n], out[n]
        for t in range(m):
            a[t], b[t] = (row[t] - y0) * y_scale, min(max((at[t] - s0) * s_scale, -1.0), 1.0)
            beyond += nb.int64(row[t] < y_low) + nb.int64(row[t] > y_high)
        for t in range(m):
            total[t] = 0.0
        for i in range(n_y - 1, -1, -1):
            last = coefficients[i, n_s - 1]
            for t in range(m):
                inner[t] = last
            for j in range(n_s - 2, -1, -1):
                term = coefficients[i, j]
                for t in range(m):
                    inner[t] = inner[t] * b[t] + term
            for t in range(m):
                total[t] = total[t] * a[t] + inner[t]
        for t in range(m):
            total[t] *= row[t]
    return beyond
