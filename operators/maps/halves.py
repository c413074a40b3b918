"""The two halves of the samples whose difference is a map of noise (a jackknife)."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from zonda.core.observation import Observation

Split = Literal["scans", "detectors", "halves", "directions", "radii"]

DIFFERENCES: dict[Split, str] = {
    "scans": "even - odd scans",
    "detectors": "even - odd detectors",
    "halves": "first - second half of each scan",
    "directions": "rising - falling azimuth",
    "radii": "inner - outer detectors",
}
"""What is subtracted from what."""

Mask = NDArray[np.bool_]


def halves_of(split: Split, observation: Observation) -> list[tuple[Mask, Mask]]:
    """(detectors (n_det,), samples (n_samp,)) of either half of an observation; of `scans` one
    part, which is all of it.

    Detectors are counted as in the focal plane, azimuth is that of the boresight. `radii`: the half
    of the detectors nearest to the middle of the focal plane, and the rest; detectors at one radius
    are counted as in the focal plane.
    """
    detectors, samples = (
        np.ones(observation.n_detectors, np.bool_),
        np.ones(observation.n_samples, np.bool_),
    )
    if split == "scans":
        return [(detectors, samples)]
    if split == "detectors":
        even = np.arange(detectors.size) % 2 == 0
        return [(even, samples), (~even, samples)]
    if split == "radii":
        order = np.argsort(
            np.hypot(observation.focalplane.xi, observation.focalplane.eta), kind="stable"
        )
        inner = np.zeros_like(detectors)
        inner[order[: (order.size + 1) // 2]] = True
        return [(inner, samples), (~inner, samples)]
    first = np.arange(samples.size) < samples.size / 2
    if split == "directions" and samples.size > 1:
        first = np.gradient(np.unwrap(observation.azimuth)) > 0
    return [(detectors, first), (detectors, ~first)]
