"""Bounds on what the pointing leaves out or carries exactly, see `core.plan`.

A shift delta of the beam changes a point source by at most 1.43 delta / FWHM of its peak, the steepest slope of a Gaussian.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.plan.estimate import Cost, Effect, Estimate, full, not_simulated

from .limits import Moved
from .samples_per_beam import Sampled

if TYPE_CHECKING:
    from zonda.core.data import Observation
    from zonda.core.plan.context import Context

    from .base import Pointing
    from .recorded import PointingRecorded

STEEPEST = math.sqrt(8 * math.log(2)) * math.exp(-0.5)
"""Largest slope of a Gaussian beam, in peaks per FWHM."""

REFRACTIVITY = 2.9e-4
"""Of air at sea level, for radio waves in dry air: refraction is N cot(elevation) rad. Moist air adds up to a third."""

INSTANTS = 4096
"""Of a scan that are looked at for its extremes."""

ABERRATION = 1.0e-4
"""v / c of the Earth's orbit and rotation."""


def pointing_estimate(operator: Pointing | PointingRecorded, context: Context) -> Estimate:
    """Refraction, aberration, sky rotation, sampling in time, precision."""
    o = context.first
    fwhm = float(o.focalplane.fwhm.min())
    radius = max(o.focalplane.radius, 0.0)
    reached = [np.asarray(_thin(x).elevation) for x in context.observations]
    elevation = min(float(e.min()) for e in reached)
    slope = STEEPEST / fwhm
    speed = context.coverage.speed if context.coverage else _speed(context)

    def shift(delta: float) -> dict[str, float]:
        return context.sky_error(min(slope * delta, 1.0))

    throw = max(float(np.ptp(e)) for e in reached) + 2 * radius
    pressure = math.exp(-o.site.altitude / 8000)
    bend = 1.33 * REFRACTIVITY * pressure / math.sin(elevation) ** 2 * throw
    rotation = max(_rotation(x) for x in context.observations) * radius
    smear = (speed / o.sample_rate) ** 2 / 24 * 8 * math.log(2) / fwhm**2
    resolution = float(np.spacing(o.seconds[-1])) * speed
    accuracy = operator.interpolation_error * fwhm
    effects = (
        not_simulated(
            "refraction", "the pointing model takes out its mean", shift(bend),
            "1.43 / FWHM x 1.33 N cosec^2(el) x throw in elevation: what a constant correction leaves",
        ),
        Effect("aberration", (full("exact"),), shift(ABERRATION * _extent(context)),
               "1.43 / FWHM x v/c x reach of the scan; a shift common to all is in the target's coordinates"),
        not_simulated("aberration across the field", "scale of the focal plane", shift(ABERRATION * radius),
                      "1.43 / FWHM x v/c x radius of the field"),
        Effect("sky rotation", (full("exact"),), shift(rotation), "1.43 / FWHM x rotation during a scan x radius of the field"),
        Effect("pointing interpolation", (full(f"within {operator.interpolation_error:g} of a beam"),), shift(accuracy),
               "1.43 x interpolation_error"),
        not_simulated("sample integration", "samples are instants", context.sky_error(smear),
                      "(v / f_s)^2 8 ln 2 / (24 FWHM^2): loss of a point source's peak along the scan"),
        *(Effect(what, (full("checked"),), {}, text) for _, what, text in o.tally if what.startswith(Moved.SAID + Sampled.SAID)),
        Effect("time stamps", (full("float64 seconds since the start"),), shift(resolution),
               "1.43 / FWHM x spacing of float64 at the scan's end x speed"),
    )  # fmt: skip
    return Estimate(effects, Cost(fixed=0.01, per_time=0.5e-6, bytes=200.0 * context.times, kernel="python"))


def _thin(o: Observation) -> Observation:
    """At most `INSTANTS` of it, evenly taken: none of what is bounded changes between them by more than a part in 1000."""
    at = np.unique(np.linspace(0, o.n_samples - 1, min(INSTANTS, o.n_samples)).astype(int))
    return replace(
        o, seconds=o.seconds[at], boresight_azel=o.boresight_azel[at], boresight_radec=o.boresight_radec[at], flags=o.flags[at]
    )


def _rotation(o: Observation) -> float:
    """Turn of the focal plane on the sky during a scan, rad."""
    psi = np.unwrap(_thin(o).derotate("boresight_radec")[2])
    return float(np.ptp(psi))


def _extent(context: Context) -> float:
    """Largest distance of the boresight from the first centre, and the field's radius, rad."""
    ra, dec = context.first.centre
    worst = 0.0
    for o in context.observations:
        there, lat, _ = _thin(o).derotate("boresight_radec")
        cosine = np.sin(dec) * np.sin(lat) + np.cos(dec) * np.cos(lat) * np.cos(there - ra)
        worst = max(worst, float(np.arccos(np.clip(cosine, -1, 1)).max()))
    return worst + context.first.focalplane.radius


def _speed(context: Context) -> float:
    o = context.first
    if o.n_samples < 2:
        return 0.0
    step = np.hypot(np.diff(o.dec), np.diff(np.unwrap(o.ra)) * np.cos(o.dec[1:]))
    return float(np.median(step)) * o.sample_rate
