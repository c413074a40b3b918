"""From directions at instants to an `Observation` with its entries in the tally: what all pointing
steps share.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zonda.core.data import Observation
from zonda.core.intervals import Intervals
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.types import Floats

if TYPE_CHECKING:
    from zonda.core.configuration.target import Target
    from zonda.core.numerics.celestial import CelestialTransform
    from zonda.core.scene import Scene

    from .limits import LargestMotion
    from .samples_per_beam import SamplesPerBeam


@dataclass(frozen=True)
class Samples:
    """The samples of a scan: when they are taken, where the boresight is then, and which are
    flagged.

    Attributes
    ----------
    seconds
        (n,) since the start.
    rate
        Hz.
    boresight
        (n, 4), (n, 4) `Boresight.azel` and `Boresight.radec`.
    flags, intervals
        Of `Observation`.
    """

    seconds: Floats
    rate: float
    boresight: tuple[Floats, Floats]
    flags: NDArray[np.uint8]
    intervals: Intervals


def observed(
    label: str,
    scene: Scene,
    index: int,
    transform: CelestialTransform,
    centre: tuple[float, float],
    samples: Samples,
    called: str = "",
) -> Observation:
    """The scan of ``samples`` that begins where ``transform`` does, about ``centre``, ICRS (ra,
    dec) [rad].

    ``called``: what its name says beside its number; what files cannot be called becomes an
    underscore.
    """
    more = re.sub(r"[^A-Za-z0-9.+-]+", "_", called).strip("_.")
    observation = Observation(
        name=f"scan-{index:03d}" + (f"-{more}" if more else ""),
        index=index,
        site=scene.site,
        instrument=scene.instrument,
        focalplane=scene.instrument.focalplane(),
        start=transform.start,
        seconds=samples.seconds,
        sample_rate=samples.rate,
        boresight_azel=samples.boresight[0],
        boresight_radec=samples.boresight[1],
        centre=centre,
        seed=scene.seed,
        flags=samples.flags,
        intervals=samples.intervals,
    )
    beam = float(observation.focalplane.fwhm.min())
    error = (
        f"{transform.error:.1e} rad, {transform.error / beam:.1e} of a beam (nodes every"
        f" {transform.spacing:g} s)"
    )
    observation.tally.state(label, "interpolation error of the pointing", error)
    observation.tally.state(label, "Earth orientation", transform.source)
    if not transform.orientation_known:
        warnings.warn(
            f"{label}: Earth orientation at {transform.start}: {transform.source}", stacklevel=4
        )
    return observation


def centre_of(
    transform: CelestialTransform, target: Target, seconds: Floats
) -> tuple[float, float]:
    """ICRS (ra, dec) of a target; of an az/el one where it points to in the middle of the scan."""
    if target.frame != "horizontal":
        return target.icrs()
    middle = np.array([(seconds[0] + seconds[-1]) / 2])
    x, y, z = transform.icrs(unit_vectors([-target.longitude], [target.latitude]), middle)[0]
    return math.atan2(y, x) % (2 * math.pi), math.atan2(z, math.hypot(x, y))


def state_times(label: str, observation: Observation) -> None:
    """State how far the samples' times are from a comb, and what those steps make of it that count
    samples.
    """
    late = observation.departures
    rms, most, rate = observation.jitter, float(abs(late).max()), observation.sample_rate
    step = np.diff(observation.seconds) * rate
    at_nyquist = math.pi * rate * rms
    observation.tally.state(
        label,
        f"{observation.name}: times of the samples",
        f"depart from a comb of {rate:.6g} Hz by {rms * 1e3:.3g} ms rms, {most * 1e3:.3g} ms at"
        f" most (intervals of {step.min():.3g} to {step.max():.3g} of the mean); pointing and"
        " atmosphere follow them",
    )
    observation.tally.state(
        label,
        f"{observation.name}: noise and filters take the samples as a comb",
        f"a component at frequency f is off by at most 2 pi f {rms * 1e3:.3g} ms of its rms: "
        f"{2 * math.pi * rms:.1e} at 1 Hz, {min(at_nyquist, 2.0):.1e} at {rate / 2:.4g} Hz",
    )


def report(
    label: str, observations: Sequence[Observation], *findings: LargestMotion | SamplesPerBeam
) -> None:
    """Enter findings in the tally of each observation, and warn."""
    for found in findings:
        for what, text in found.statements():
            for observation in observations:
                observation.tally.state(label, what, text)
    for found in findings:
        for text in found.warnings():
            warnings.warn(f"{label}: {text}", stacklevel=4)
