"""Q and U of a map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ..types import Floats

COVARIANCES = ("ii", "iq", "iu", "qq", "qu", "uu")
"""Rows of `Polarization.covariance`."""


@dataclass
class Polarization:
    """Q and U beside the I of a map, arrays of the shape of its ``signal``, ``unit`` that of the
    map.

    Attributes
    ----------
    q, u
        COSMO, from the meridians of the map's frame; NaN where the angles of the samples do not
        determine I, Q and U.
    covariance
        (6, ...) of (I, Q, U), `COVARIANCES`, unit^2. After smoothing, which takes I, Q and U one by
        one, only the variances are known, and the others NaN.
    weights
        (2, ...) of Q and of U: 1 / (A^-1)_QQ and 1 / (A^-1)_UU (`MapArrays.weights` is that of I).
    condition
        Condition number of the samples' angles in each pixel, largest over smallest eigenvalue: 2
        at best, infinite where they do not determine I, Q and U; NaN where there are no samples.
    hits
        `MapArrays.hits`: the samples in each pixel, also in those that are not solved.
    half_difference
        (2, ...) of Q and U, as `MapArrays.half_difference`, each with the variance of the map
        there; None: not made.
    """

    q: Floats
    u: Floats
    covariance: Floats
    weights: Floats
    condition: Floats
    hits: NDArray[np.int64]
    half_difference: Floats | None = None

    def scaled(self, factor: float | Floats, weighs: bool) -> Polarization:
        """In another unit: values times ``factor``; ``weighs``: weights are inverse variances."""
        half = None if self.half_difference is None else self.half_difference * factor
        weights = self.weights / factor**2 if weighs else self.weights
        covariance = self.covariance * factor**2
        return replace(
            self,
            q=self.q * factor,
            u=self.u * factor,
            covariance=covariance,
            weights=weights,
            half_difference=half,
        )
