"""Air that drifts through the field: winds, scans and stares."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.checks import Family
from zonda.core.data import Observation
from zonda.operators.atmosphere.layers import AtmosphereLayers
from zonda.plugins.checks.scenes import largest, run, scan

from .cases import STRIP, WIND

checks = Family("geometry")

RMS = 0.005
"""Of the water, as a share of its mean."""


def _atmosphere(observation: Observation, **parameters: Any) -> NDArray[np.float64]:
    """The stream ``atmosphere`` (n_det, n_samp), K_RJ, float64."""
    layers = AtmosphereLayers(**{"pwv": "7.7 mm", "pwv_rms": RMS, "layers": 2, **parameters})
    return np.asarray(
        run([layers], observation, keep=("atmosphere",)).observations[0].detdata["atmosphere"]
    )


@checks.add(WIND, reference="the first sample", limit=1e-12)
def frozen_stare() -> float:
    """largest change of any detector over a stare without wind, over the rms of the field"""
    values = _atmosphere(scan(radius=0), wind={"speed": "0 m/s"})
    return float(np.ptp(values, axis=1).max() / abs(values).max())


@checks.add(WIND, reference="no turn", limit=1e-9, unit="K")
def turned_together() -> float:
    """largest change when scan, wind and field turn together by 37, 180 and 271 deg, in short steps
    and in such as reach far beyond the ends of the scan
    """
    worst = 0.0
    for seen in ({}, {"detectors": 7, "samples": 2500, "elevation": 30.0}):
        one, *others = (
            _atmosphere(
                scan(azimuth=40 + by, **seen),
                wind={"speed": "12 m/s", "direction": f"{200 + by} deg"},
            )
            for by in (0.0, 37.0, 180.0, 271.0)
        )
        worst = largest(worst, *(float(abs(one - other).max()) for other in others))
    return worst


@checks.add(WIND, reference="the detector upwind, r / v earlier", limit=2e-3)
def frozen_flow() -> float:
    """what a detector 20 m downwind sees, winds along, against, across and oblique to the azimuth,
    over the field's rms

    Looking north at 50 deg. xi grows to the right; a wind from the south drifts down, at v
    sin(elevation) across the line of sight. The water along a line of sight is divided by its
    airmass.
    """
    elevation, speed, late = np.radians(50.0), 20.0, 100
    c, s = np.cos(elevation), np.sin(elevation)
    worst = 0.0
    for direction in (270.0, 90.0, 180.0, 225.0):
        to = np.radians(direction + 180)
        xi, eta = speed * late / 100.0 / (2000 / s) * np.array([np.sin(to), -np.cos(to) * s])
        o = scan(2, 2000, azimuth=0, elevation=50, radius=0, offsets=([0.0, xi], [0.0, eta]))
        wind = {"speed": f"{speed} m/s", "direction": f"{direction} deg"}
        steps = [
            AtmosphereLayers(
                pwv="1 mm",
                pwv_rms=RMS,
                layers=1,
                lowest="2000 m",
                wind=wind,
                tolerance="0.1 %",
                outputs=["pwv"],
            )
        ]
        water = run(list(steps), o, keep=("pwv",)).observations[0].detdata["pwv"] / 1e-3
        up, down = (
            water[0, :-late] * s,
            water[1, late:] * (s + eta * c) / np.sqrt(1 + xi * xi + eta * eta),
        )
        worst = largest(worst, float(abs(up - down).max()) / RMS)
    return worst


@checks.add(STRIP, reference="finite, and there", limit=0, unit="values")
def one_detector_one_sample() -> int:
    """values missing, zero or not finite for one detector and 1, 2 and 50 samples, with and without
    wind
    """
    wrong = 0
    for samples in (1, 2, 50):
        for speed in (0, 10):
            values = _atmosphere(scan(1, samples, radius=0), wind={"speed": f"{speed} m/s"})
            wrong += int(values.shape != (1, samples)) + int(
                (~np.isfinite(values) | (values == 0)).sum()
            )
    return wrong
