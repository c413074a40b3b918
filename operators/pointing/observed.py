"""Observations of all pointing steps, from directions at instants, with their entries in the log;
the distances of the Sun and the Moon during scans, and flags and intervals of samples while the Sun
is up or close to the boresight, as TOAST's `SimGround` makes them.
"""

from __future__ import annotations

import math
import re
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.configuration.target import Target
from zonda.core.configuration.time import Instant
from zonda.core.data import Data, Observation
from zonda.core.flags import SUN_CLOSE, SUN_UP, TURNAROUND, Flags, Intervals, intervals_of
from zonda.core.numerics.bodies import Track, tracks
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.quaternions import directions
from zonda.core.numerics.sphere import position, unit_vectors
from zonda.core.operator import Operator
from zonda.core.plots import plot_scans
from zonda.core.scene import Scene
from zonda.core.site import Site
from zonda.core.types import Bools, Floats

if TYPE_CHECKING:
    from .limits import LargestMotion
    from .motion import SamplesPerBeam

CLOSE = math.radians(45.0)
"""Distance within which the Sun is close, where nothing else is said (TOAST's default)."""
SPACING = 60.0
"""s between the instants at which the Sun's place is computed; between them its elevation is linear
to 3e-6 rad.
"""
LOOKED_AT = 256
"""Instants of all scans together at which `distances` looks."""


def sunlit(
    site: Site,
    start: Instant,
    seconds: Floats,
    azel: Floats,
    close: float = CLOSE,
) -> tuple[Flags, Intervals]:
    """Flags (n,) and intervals of samples at ``seconds`` (n,) with boresights ``azel`` (n, 4).

    *sun_up*: the Sun's centre is above the horizon, without refraction; *sun_close*: it is within
    ``close`` [rad] of the boresight, whether it is up or not.
    """
    nodes = np.linspace(seconds[0], seconds[-1], int((seconds[-1] - seconds[0]) // SPACING) + 2)
    (sun,) = tracks(site, start.posix + nodes, "sun")
    near = np.zeros(len(seconds), bool)
    above = np.zeros(len(seconds), bool)
    for part in chunks(len(seconds)):
        towards = np.stack(
            [np.interp(seconds[part], nodes, one) for one in sun.direction.T],
            axis=1,
        )
        above[part] = towards[:, 2] > 0
        near[part] = Track(looking(azel[part])).distance(Track(towards)) < close
    flags = np.where(above, SUN_UP, 0) | np.where(near, SUN_CLOSE, 0)
    found = {"sun_up": intervals_of(above, seconds), "sun_close": intervals_of(near, seconds)}
    return flags.astype(np.uint8), {name: spans for name, spans in found.items() if spans}


def mark_sun(observation: Observation) -> None:
    """Give an observation the flags and intervals of `sunlit`."""
    flags, intervals = sunlit(
        observation.site,
        observation.start,
        observation.seconds,
        observation.boresight_azel,
    )
    observation.flags |= flags
    observation.intervals.update(intervals)


def looking(azel: Floats) -> Floats:
    """(n, 3) unit vectors north, east, up of boresights (n, 4), whose own axes are north, west,
    up.
    """
    return directions(azel) * [1.0, -1.0, 1.0]


def distances(observations: Sequence[Observation]) -> list[str]:
    """One line for each body: its distance from the boresight over the scans, and whether it is
    up.
    """
    each = max(LOOKED_AT // max(len(observations), 1), 3)
    times = []
    directions = []
    for o in observations:
        at = np.unique(np.linspace(0, o.n_samples - 1, min(each, o.n_samples)).astype(int))
        times.append(o.start.posix + o.seconds[at])
        directions.append(looking(o.boresight_azel[at]))
    when = np.concatenate(times)
    track = Track(np.concatenate(directions))
    lines = []
    for name, body in zip(
        ("Sun", "Moon"),
        tracks(observations[0].site, when, "sun", "moon"),
        strict=True,
    ):
        apart = np.degrees(track.distance(body))
        up = body.elevation > math.radians(-0.5)
        where = "up" if up.all() else "up part of the time" if up.any() else "below the horizon"
        lines.append(f"distance of the {name}: {apart.min():.1f} to {apart.max():.1f} deg, {where}")
    return lines


def transform_of(
    scene: Scene,
    start: Instant,
    duration: float,
    interpolation_error: float,
) -> CelestialTransform:
    """The celestial transformation of a scan; its error as a fraction of the smallest beam."""
    beam = float(scene.instrument.focalplane().fwhm.min())
    return CelestialTransform(scene.site, start, duration, interpolation_error * beam)


def plot_step(pointing: Operator, scene: Scene, ax: Any) -> Any:
    """Draw the scans that a pointing step alone makes of a scene (`plot_scans`)."""
    data = Data(scene)
    pointing.observe(data)
    return plot_scans(data.observations, ax)


def observed(
    label: str,
    scene: Scene,
    index: int,
    transform: CelestialTransform,
    called: str = "",
    **fields: Any,
) -> Observation:
    """The scan that begins where ``transform`` does; ``fields`` are those of `Observation` that
    differ between scans.

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
        seed=scene.seed,
        **fields,
    )
    beam = float(observation.focalplane.fwhm.min())
    error = (
        f"{transform.error:.1e} rad, {transform.error / beam:.1e} of a beam (nodes every"
        f" {transform.spacing:g} s)"
    )
    observation.log.state(label, "interpolation error of the pointing", error)
    observation.log.state(label, "Earth orientation", transform.source)
    if not transform.orientation_known:
        warnings.warn(
            f"{label}: Earth orientation at {transform.start}: {transform.source}",
            stacklevel=4,
        )
    return observation


def centre_of(
    transform: CelestialTransform,
    target: Target,
    seconds: Floats,
) -> tuple[float, float]:
    """ICRS (ra, dec) of a target; of an az/el one where it points to in the middle of the scan."""
    if target.frame != "horizontal":
        return target.icrs()
    middle = np.array([(seconds[0] + seconds[-1]) / 2])
    ray = unit_vectors([-target.longitude], [target.latitude])
    return position(transform.icrs(ray, middle)[0])


def mark_turnarounds(
    label: str,
    observation: Observation,
    turning: Bools,
    flagged: bool,
) -> None:
    """Count the samples ``turning`` (n,), and flag them if that is asked for."""
    what = "samples in turnarounds" + (", flagged" if flagged else ", used")
    observation.log.count(label, what, int(turning.sum()), observation.n_samples)
    observation.flags |= np.where(flagged & turning, TURNAROUND, 0).astype(np.uint8)


def state_times(label: str, observation: Observation) -> None:
    """State how far the samples' times are from a comb, and what those steps make of it that count
    samples.
    """
    late = observation.departures
    rms = observation.jitter
    most = float(abs(late).max())
    rate = observation.sample_rate
    step = np.diff(observation.seconds) * rate
    at_nyquist = math.pi * rate * rms
    observation.log.state(
        label,
        f"{observation.name}: times of the samples",
        f"depart from a comb of {rate:.6g} Hz by {rms * 1e3:.3g} ms rms, {most * 1e3:.3g} ms at"
        f" most (intervals of {step.min():.3g} to {step.max():.3g} of the mean); pointing and"
        " atmosphere follow them",
    )
    observation.log.state(
        label,
        f"{observation.name}: noise and filters take the samples as a comb",
        f"a component at frequency f is off by at most 2 pi f {rms * 1e3:.3g} ms of its rms: "
        f"{2 * math.pi * rms:.1e} at 1 Hz, {min(at_nyquist, 2.0):.1e} at {rate / 2:.4g} Hz",
    )


def report(
    label: str, observations: Sequence[Observation], *findings: LargestMotion | SamplesPerBeam
) -> None:
    """Enter findings in the log of each observation, and warn."""
    for found in findings:
        for what, text in found.statements():
            for observation in observations:
                observation.log.state(label, what, text)
    for found in findings:
        for text in found.warnings():
            warnings.warn(f"{label}: {text}", stacklevel=4)
