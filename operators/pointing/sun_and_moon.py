"""Distances of scans from the Sun and the Moon."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.numerics.bodies import Track, tracks

from .sun import looking

if TYPE_CHECKING:
    from zonda.core.data import Observation

LOOKED_AT = 256
"""Instants of all scans together."""


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
