"""Mean emission of the atmosphere in a scan, from the levels that its steps resolved."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from .observation import Observation

INSTANTS = 64
"""Instants, evenly over a scan, that the mean is taken of: the emission follows the elevation."""


def mean_emission(observation: Observation) -> dict[str, float]:
    """Means over instants and detectors that are not flagged, K_RJ; empty where the scan has no atmosphere.

    ``atmosphere`` is <T_atm>, before any efficiency, and ``scan`` the same on the calibrated scale, eps illumination and zeta
    main-beam efficiency:

        T_scan = < eps T_atm / (zeta e^-tau) >.                                                              (1)
    """
    plane, good, n = observation.focalplane, observation.good_detectors, observation.n_samples
    if not ({"atmosphere", "transmission"} <= observation.smooth.keys() and good.any()):
        return {}
    every = slice(0, observation.n_detectors)
    found = {"atmosphere": 0.0, "scan": 0.0}
    instants = np.unique(((np.arange(INSTANTS) + 0.5) * n / INSTANTS).astype(int))
    for t in instants:
        at = slice(int(t), int(t) + 1)
        level = observation.smooth["atmosphere"].evaluate(every, at)[:, 0].astype(np.float64)
        transmission = observation.smooth["transmission"].evaluate(every, at)[:, 0]
        calibrated = level * (plane.illumination_efficiency / (plane.main_beam_efficiency * transmission))
        for name, values in (("atmosphere", level), ("scan", calibrated)):
            found[name] += float(values[good].mean()) / len(instants)
    return found
