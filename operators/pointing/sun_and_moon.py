"""The Sun and the Moon during scans: distances, and flags and intervals of samples while the Sun is
up or close to the boresight, as TOAST's `SimGround` makes them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zonda.core.flags import SUN_CLOSE, SUN_UP, Intervals, intervals_of
from zonda.core.numerics.bodies import Track, tracks
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.quaternions import directions
from zonda.core.types import Floats

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.data import Observation
    from zonda.core.site import Site

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
) -> tuple[NDArray[np.uint8], Intervals]:
    """Flags (n,) and intervals of samples at ``seconds`` (n,) with boresights ``azel`` (n, 4).

    *sun_up*: the Sun's centre is above the horizon, without refraction; *sun_close*: it is within
    ``close`` [rad] of the boresight, whether it is up or not.
    """
    nodes = np.linspace(seconds[0], seconds[-1], int((seconds[-1] - seconds[0]) // SPACING) + 2)
    (sun,) = tracks(site, start.posix + nodes, "sun")
    near, above = np.zeros(len(seconds), bool), np.zeros(len(seconds), bool)
    for part in chunks(len(seconds)):
        towards = np.stack(
            [np.interp(seconds[part], nodes, one) for one in sun.direction.T], axis=1
        )
        above[part] = towards[:, 2] > 0
        near[part] = Track(looking(azel[part])).distance(Track(towards)) < close
    flags = np.where(above, SUN_UP, 0) | np.where(near, SUN_CLOSE, 0)
    found = {"sun_up": intervals_of(above, seconds), "sun_close": intervals_of(near, seconds)}
    return flags.astype(np.uint8), {name: spans for name, spans in found.items() if spans}


def mark_sun(observation: Observation) -> None:
    """Give an observation the flags and intervals of `sunlit`."""
    flags, intervals = sunlit(
        observation.site, observation.start, observation.seconds, observation.boresight_azel
    )
    observation.flags |= flags
    observation.intervals.update(intervals)


def looking(azel: Floats) -> Floats:
    """(n, 3) unit vectors north, east, up of boresights (n, 4), whose own axes are north, west,
    up.
    """
    return np.asarray(directions(azel) * [1.0, -1.0, 1.0])


def distances(observations: Sequence[Observation]) -> list[str]:
    """One line for each body: its distance from the boresight over the scans, and whether it is
    up.
    """
    each = max(LOOKED_AT // max(len(observations), 1), 3)
    times, directions = [], []
    for o in observations:
        at = np.unique(np.linspace(0, o.n_samples - 1, min(each, o.n_samples)).astype(int))
        times.append(o.start.posix + o.seconds[at])
        directions.append(looking(o.boresight_azel[at]))
    when, track = np.concatenate(times), Track(np.concatenate(directions))
    lines = []
    for name, body in zip(
        ("Sun", "Moon"), tracks(observations[0].site, when, "sun", "moon"), strict=True
    ):
        apart, up = np.degrees(track.distance(body)), body.elevation > math.radians(-0.5)
        where = "up" if up.all() else "up part of the time" if up.any() else "below the horizon"
        lines.append(f"distance of the {name}: {apart.min():.1f} to {apart.max():.1f} deg, {where}")
    return lines
