"""Emission of the atmosphere in a scan: its mean, from the levels that steps resolved, and its
spectrum over the passband.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .focalplane import Focalplane
from .numerics.smooth import SmoothField
from .types import Floats


@dataclass(frozen=True)
class LoadSpectra:
    """The atmosphere over a passband, in cells of frequency, at elevations that the scan sees.

    Attributes
    ----------
    frequency
        (n,) Hz, of the cells, those at the passband's edges in part; each the mean of what the
        passband lets through of it.
    width, square
        (n,) Hz, integrals of the transmission t and of its square over each cell.
    brightness, transmission
        (k, n) Rayleigh-Jeans brightness [K] and e^-tau at k elevations.
    """

    frequency: Floats
    width: Floats
    square: Floats
    brightness: Floats
    transmission: Floats

    @property
    def emission(self) -> Floats:
        """(k,) mean brightness over the passband, K_RJ."""
        return np.asarray(self.brightness @ self.width / self.width.sum())


INSTANTS = 64
"""Instants, evenly over a scan, that the mean is taken of: the emission follows the elevation."""


def mean_emission(
    smooth: Mapping[str, SmoothField], plane: Focalplane, good: NDArray[np.bool_], n: int
) -> dict[str, float]:
    """Means over instants and detectors that are not flagged, K_RJ; empty where the scan has no
    atmosphere.

    ``atmosphere`` is <T_atm>, before any efficiency, and ``scan`` the same on the calibrated scale,
    eps illumination and zeta main-beam efficiency:

        T_scan = < eps T_atm / (zeta e^-tau) >.                                                  (1)

    ``smooth`` and ``plane`` are those of a scan of ``n`` samples, ``good`` (n_det,) its detectors
    that are not flagged.
    """
    if not ({"atmosphere", "transmission"} <= smooth.keys() and good.any()):
        return {}
    every = slice(0, len(plane))
    found = {"atmosphere": 0.0, "scan": 0.0}
    instants = np.unique(((np.arange(INSTANTS) + 0.5) * n / INSTANTS).astype(int))
    for t in instants:
        at = slice(int(t), int(t) + 1)
        level = smooth["atmosphere"].evaluate(every, at)[:, 0].astype(np.float64)
        transmission = smooth["transmission"].evaluate(every, at)[:, 0]
        calibrated = level * (
            plane.illumination_efficiency / (plane.main_beam_efficiency * transmission)
        )
        for name, values in (("atmosphere", level), ("scan", calibrated)):
            found[name] += float(values[good].mean()) / len(instants)
    return found
