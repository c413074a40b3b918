"""By how much calibration multiplies what enters at a detector, for bounds."""

from __future__ import annotations

import numpy as np

from ..numerics.radiation import LEAST_TRANSMISSION
from ..observation import Observation


def calibration(observation: Observation) -> float:
    """Largest factor 1 / (zeta <e^-tau>) over the detectors, of the scan's mean transmission."""
    passed = observation.focalplane.main_beam_efficiency
    if (transmission := observation.smooth.get("transmission")) is not None:
        passed = passed * np.maximum(transmission.time_mean(), LEAST_TRANSMISSION)
    return float(1 / passed.min()) if passed.size else 1.0
