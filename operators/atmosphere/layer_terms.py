"""Layers whose water absorbs and emits as it does at its height, where the column's does as it does
on average.

With f'_l(s) the derivative of the band's emission (or opacity) with respect to a relative change of
the PWV that is made at the height of layer l, f'(0, s) that of the column, kappa_l = f'_l / f',
what `response` gives for the column gains

    f'(0, s) sum_l (kappa_l - 1) p a_l g_l = (1 / s) sum_j S^j sum_l c_jl p a_l g_l,
    S in [-1, 1] over the scan      (1)

the first order of what each layer's water changes more than the column's. s (f'_l - f') is nearly
constant where the air is clear; the c_jl are its polynomials in S, of the degree that the range of
elevations needs. The quotient kappa_l is not formed: where a line is saturated f' vanishes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from zonda.core.types import Floats

from .weather.bands import BandAtmosphere
from .weather.radiative_transfer import ELEVATION_MAX, ELEVATION_MIN

NAMES = ("emission", "opacity")
"""Responses that depend on the height of the water."""
ERROR = 5e-4
"""Largest error of s (f'_l - f') in elevation, of the largest s f'_l."""
DEGREES = (0, 1, 2, 4, 6, 8)
"""Of the polynomials in S; the last one is taken where none meets `ERROR`."""
LOOKED_AT = 13
"""Elevations at which a polynomial is judged."""


@dataclass(frozen=True)
class LayerTerms:
    """Equation (1) for one band, mean PWV and scan.

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
        low, high = (
            max(sines[0], math.sin(ELEVATION_MIN) * (1 + 1e-12)),
            min(sines[1], math.sin(ELEVATION_MAX)),
        )
        looked_at = np.cos(np.linspace(0, math.pi, LOOKED_AT))
        points = [np.cos(np.pi * (np.arange(n + 1) + 0.5) / (n + 1)) for n in DEGREES]
        places = np.concatenate([looked_at, *points])
        s = (low + high) / 2 + places * (high - low) / 2
        water = band.transfer.of_water(pwv, np.arcsin(np.clip(s, low, high)).tolist())
        weights, degrees = [], []
        for name in NAMES:
            own = pwv * s[:, None] * water.at(name, heights)
            excess = own - pwv * s[:, None] * water.of_column(name)[:, None]
            truth, first = excess[:LOOKED_AT], LOOKED_AT
            for degree, known in zip(DEGREES, points, strict=True):
                matrix = np.linalg.inv(np.vander(known, degree + 1, increasing=True))
                found = matrix @ excess[first : first + degree + 1]
                first += degree + 1
                error = np.abs(
                    np.vander(looked_at, degree + 1, increasing=True) @ found - truth
                ).max()
                if error <= ERROR * np.abs(own[:LOOKED_AT]).max():
                    break
            weights.append(scale * found)
            degrees.append(degree)
        return cls(np.concatenate(weights), tuple(degrees), (low, high))

    def add(self, name: str, sums: Floats, s: Floats, out: Floats) -> None:
        """Add equation (1) to the response called ``name``; ``sums`` (k, n, m) over all layers,
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
