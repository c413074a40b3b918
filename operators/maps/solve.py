"""Brightness of pixels from the sums of a map: equation (1) of `bin_map`, and equations (1) and (2)
of `binning`, solved in each pixel.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zonda.core.types import AnyFloats, Floats

from .map_sums import MapSums
from .stokes_kernel import PLACES
from .sums import VALUE, WEIGHT, Sums

TRIANGLE = (0, 0, 0, 1, 1, 2), (0, 1, 2, 1, 2, 2)
"""Rows and columns of the elements of a symmetric matrix: ii, iq, iu, qq, qu, uu."""
SINGULAR = 1e-8
"""Of the smallest eigenvalue, as a share of the largest: below it is the rounding of the sums."""


@dataclass(frozen=True)
class Solver:
    """Makes planes (n, pixels) of a signal from its sums.

    Attributes
    ----------
    variance
        Of the reference weight, K^2.
    unit
        Of the weights: ``variance``, or 1 where they are uniform.
    scatter
        The noise is that of the samples' scatter.
    condition_limit
        Largest condition number of pixels that are solved for I, Q and U.
    halves
        The difference of two halves is wanted.
    """

    sums: MapSums
    variance: float
    unit: float
    scatter: bool
    condition_limit: float
    halves: bool

    def planes(self, stream: str, part: slice) -> dict[str, AnyFloats]:
        """Planes by name, each (rows, n), of the signal ``stream`` in some pixels."""
        found = self._polarized(stream, part) if self.sums.polarized else self._plain(stream, part)
        return {name: np.atleast_2d(values) for name, values in found.items()}

    def _plain(self, stream: str, part: slice) -> dict[str, AnyFloats]:
        hits, weights, data, noise = self.sums.parts(stream, part)
        signal, weight = _mean(hits, weights, data)
        term = noise[:, 0] / WEIGHT * self.variance
        with np.errstate(invalid="ignore", divide="ignore"):
            if self.scatter:
                # equal samples leave the rounding of their squares, of either sign: a scatter below
                # it is counted, and 0
                rest = np.maximum(term / weight - signal**2, 0.0)
                error = np.where(hits > 1, np.sqrt(rest / (hits - 1)), np.nan)
            else:
                error = np.where(hits > 0, np.sqrt(term) / weight, np.nan)
        found = {"signal": signal, "hits": hits, "weights": weight / self.unit, "noise": error}
        if self.halves:
            (one, w), (two, v) = (
                _mean(*self.sums.parts(stream, part, half)[:3]) for half in (0, 1)
            )
            with np.errstate(invalid="ignore", divide="ignore"):
                found["half_difference"] = (one - two) * np.sqrt(w * v) / (w + v)
        return found

    def _polarized(self, stream: str, part: slice) -> dict[str, AnyFloats]:
        whole, own_noise = self.sums.parts(stream, part), bool(self.sums.noise)
        solved = _Solved.of(whole, self.condition_limit, self.variance, own_noise)
        covariance = solved.covariance[:, TRIANGLE[0], TRIANGLE[1]].T
        found = {
            "signal": solved.values.T,
            "hits": whole[0],
            "weights": np.nan_to_num(1 / solved.spread.T / self.unit),
            "noise": np.sqrt(covariance[[0, 3, 5]]),
            "covariance": covariance,
            "condition": solved.condition,
        }
        if self.halves:
            one, two = (
                _Solved.of(self.sums.parts(stream, part, half), self.condition_limit, 1.0, False)
                for half in (0, 1)
            )
            share = solved.spread / (one.spread + two.spread)
            found["half_difference"] = ((one.values - two.values) * np.sqrt(share)).T
        return found


def _mean(hits: Sums, weights: Sums, data: Sums) -> tuple[Floats, Floats]:
    """(signal, weight) of fixed-point sums; NaN where there are no hits."""
    weight = weights[:, 0] / WEIGHT
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(hits > 0, data[:, 0] / VALUE / weight, np.nan), weight


@dataclass(frozen=True)
class _Solved:
    """I, Q and U of some pixels.

    Attributes
    ----------
    values, covariance
        (n, 3) K; (n, 3, 3) K^2; NaN where they are not determined. ``spread``: (n, 3) diagonal of
        A^-1.
    condition
        (n,) NaN without hits.
    """

    values: Floats
    covariance: Floats
    spread: Floats
    condition: Floats

    @classmethod
    def of(
        cls, sums: tuple[Sums, Sums, Sums, Sums], limit: float, variance: float, own_noise: bool
    ) -> _Solved:
        """``limit`` of the condition number, ``variance`` of the reference weight."""
        hits, weights, data, noise = sums
        n = len(hits)
        values, spread = np.full((2, n, 3), np.nan)
        covariance, condition = np.full((n, 3, 3), np.nan), np.full(n, np.nan)
        hit = np.flatnonzero(hits)
        a = weights[hit][:, PLACES].reshape(-1, 3, 3) / WEIGHT
        low, axes = np.linalg.eigh(a)
        with np.errstate(divide="ignore"):
            condition[hit] = np.where(
                low[:, 0] > SINGULAR * low[:, 2], low[:, 2] / low[:, 0], np.inf
            )
        fine = condition[hit] <= limit
        pixels, axes, low = hit[fine], axes[fine], low[fine]
        inverse = (axes / low[:, None, :]) @ axes.transpose(0, 2, 1)
        values[pixels] = np.einsum("nij,nj->ni", inverse, data[pixels] / VALUE)
        values[pixels] += np.einsum(
            "nij,nj->ni", inverse, _rest(a[fine], values[pixels], data[pixels] / VALUE)
        )
        spread[pixels] = np.einsum("nii->ni", inverse)
        covariance[pixels] = inverse * variance
        if own_noise:
            middle = noise[pixels][:, PLACES].reshape(-1, 3, 3) / WEIGHT
            covariance[pixels] = inverse @ middle @ inverse * variance
        return cls(values, covariance, spread, condition)


def _rest(a: Floats, values: Floats, data: Floats) -> Floats:
    """Residual b - A m, for one step of refinement."""
    return np.asarray(data - np.einsum("nij,nj->ni", a, values))
