"""Planning of the pointing: bounds on what it leaves out or carries exactly (`core.plan`).

A shift delta of the beam changes a point source by at most 1.43 delta / FWHM of its peak, the
steepest slope of a Gaussian.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from zonda.core.data import Observation
from zonda.core.operator import Operator
from zonda.core.plan.bounds import Context, Estimate, evenly, exact, not_simulated, single
from zonda.core.plan.planning import Knob, Planning
from zonda.core.types import AnyFloats

from .base import Pointing
from .limits import LargestMotion
from .mispointing import Mispointing
from .motion import SamplesPerBeam
from .recorded import PointingRecorded
from .schedule import PointingSchedule

MOTION = LargestMotion.TOPICS + SamplesPerBeam.TOPICS
"""Beginnings of the log's entries about the telescope's motion."""

STEEPEST = math.sqrt(8 * math.log(2)) * math.exp(-0.5)
"""Largest slope of a Gaussian beam, in peaks per FWHM."""

REFRACTIVITY = 2.9e-4
"""Refractivity N of dry air at sea level, for radio waves: refraction is N cot(elevation) rad.
Moist air adds up to a third.
"""

INSTANTS = 4096
"""Instants of a scan that are looked at for its extremes."""

ABERRATION = 1.0e-4
"""v / c of the Earth's orbit and rotation."""


class PointingPlanning(Planning[Pointing | PointingRecorded | PointingSchedule]):
    """Planning of the pointing: refraction, aberration, rotation of the field, sampling in time,
    precision.
    """

    of: ClassVar[type[Operator]] = Pointing
    knobs = (
        Knob(
            "interpolation_error",
            (0.1, 0.01, 1e-3, 1e-4),
            "celestial transformation interpolated between nodes in time",
        ),
    )

    def estimate(self, context: Context) -> Estimate:
        """Each effect by the shift of the beam that it makes."""
        o = context.first
        error = self.operator.interpolation_error
        fwhm = float(o.focalplane.fwhm.min())
        radius = o.focalplane.radius
        speed = context.coverage.speed if context.coverage else _speed(o)
        seen = [_thin(x) for x in context.observations]
        turn = max(float(np.ptp(np.unwrap(x.derotate("boresight_radec")[2]))) for x in seen)
        smear = (speed / o.sample_rate) ** 2 / 24 * 8 * math.log(2) / fwhm**2
        aberration = ABERRATION * _extent(context, seen)
        per_beam = "1.43 / FWHM x "
        effects = (
            not_simulated(
                "refraction",
                "the pointing model takes out its mean",
                _shift(context, _bend(o, [x.elevation for x in seen])),
                f"{per_beam}1.33 N cosec^2(el) x throw in elevation: what a constant correction"
                " leaves",
            ),
            exact(
                "aberration",
                _shift(context, aberration),
                f"{per_beam}v/c x reach of the scan; a shift common to all is in the target's"
                " coordinates",
            ),
            not_simulated(
                "aberration across the field",
                "scale of the focal plane",
                _shift(context, ABERRATION * radius),
                f"{per_beam}v/c x radius of the field",
            ),
            exact(
                "sky rotation",
                _shift(context, turn * radius),
                f"{per_beam}rotation during a scan x radius of the field",
            ),
            exact(
                "pointing interpolation",
                _shift(context, error * fwhm),
                "1.43 x interpolation_error",
                f"within {error:g} of a beam",
            ),
            not_simulated(
                "sample integration",
                "samples are instants",
                context.sky_error(smear),
                "(v / f_s)^2 8 ln 2 / (24 FWHM^2): loss of a point source's peak along the scan",
            ),
            *(exact(what, {}, text, "checked") for what, text in _motion(context)),
            exact(
                "time stamps",
                _shift(context, float(np.spacing(o.seconds[-1])) * speed),
                f"{per_beam}spacing of float64 at the scan's end x speed",
                "float64 seconds",
            ),
        )
        return Estimate(effects)


def _shift(context: Context, delta: float) -> dict[str, float]:
    """Bound on the error of a shift [rad] of the beam."""
    fwhm = float(context.first.focalplane.fwhm.min())
    return context.sky_error(min(STEEPEST * delta / fwhm, 1.0))


def _motion(context: Context) -> list[tuple[str, str]]:
    """The telescope's motion: (what, text). Samples per beam are those of the planned band."""
    topics = LargestMotion.TOPICS if context.band else MOTION
    found = [(what, text) for _, what, text in context.first.log if what.startswith(topics)]
    sampled = SamplesPerBeam()
    for o in context.observations if context.band else ():
        sampled.add(o, o.sample_rate)
    return found + sampled.statements()


class RecordedPlanning(PointingPlanning):
    """Planning of `PointingRecorded`, like that of other pointing steps."""

    of: ClassVar[type[Operator]] = PointingRecorded


class SchedulePlanning(PointingPlanning):
    """Planning of `PointingSchedule`, like that of other pointing steps."""

    of: ClassVar[type[Operator]] = PointingSchedule


class MispointingPlanning(Planning[Mispointing]):
    """It has no coarser form."""

    of: ClassVar[type[Operator]] = Mispointing
    per_sample = 100
    """The true boresight, and what it is made from."""

    def estimate(self, context: Context) -> Estimate:
        """Error of leaving the step out, by the shift of the beam, three standard deviations."""
        step = self.operator
        rms = math.hypot(step.scan_rms, step.jitter_rms)
        delta = math.hypot(*(step.offset or (0.0, 0.0))) + 3 * rms
        return single("mispointing", _shift(context, delta), "1.43 / FWHM x (offset + 3 rms)")


def _bend(o: Observation, elevations: list[AnyFloats]) -> float:
    """Differential refraction [rad] over the elevations of all scans and the field."""
    throw = max(float(np.ptp(e)) for e in elevations) + 2 * o.focalplane.radius
    lowest = min(float(e.min()) for e in elevations)
    pressure = math.exp(-o.site.altitude / 8000)
    return 1.33 * REFRACTIVITY * pressure / math.sin(lowest) ** 2 * throw


def _thin(o: Observation) -> Observation:
    """At most `INSTANTS` of it, evenly taken: none of what is bounded changes between them by more
    than a part in 1000.
    """
    return o.thinned(evenly(o.n_samples, INSTANTS))


def _extent(context: Context, seen: list[Observation]) -> float:
    """Largest distance of the boresight from the first centre, and the field's radius, rad."""
    ra, dec = context.first.centre
    least = 1.0  # of its cosine
    for o in seen:
        there, lat, _ = o.derotate("boresight_radec")
        cosine = np.sin(dec) * np.sin(lat) + np.cos(dec) * np.cos(lat) * np.cos(there - ra)
        least = min(least, float(cosine.min()))
    return math.acos(max(least, -1.0)) + context.first.focalplane.radius


def _speed(o: Observation) -> float:
    """Median speed of the boresight on the sky, rad/s."""
    if o.n_samples < 2:
        return 0.0
    step = np.hypot(np.diff(o.dec), np.diff(np.unwrap(o.ra)) * np.cos(o.dec[1:]))
    return float(np.median(step)) * o.sample_rate
