"""What a telescope cannot do: elevations out of its reach, motions too fast. The errors say what would be possible."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import PointingError

from .transform import CelestialTransform, unit_vectors

if TYPE_CHECKING:
    from zonda.core.configuration.target import Target
    from zonda.core.instrument import Telescope

Floats = NDArray[np.float64]

DAY = 86400.0


def check_elevation(
    horizontal: Floats, transform: CelestialTransform, target: Target, telescope: Telescope, total: float, place: str
) -> None:
    """Raise PointingError where a direction (n, 3) lies outside the telescope's elevation limits; say when none would.

    ``total`` [s] is how long all scans take, for the message.
    """
    elevation = np.arctan2(horizontal[:, 2], np.hypot(horizontal[:, 0], horizontal[:, 1]))
    low, high = telescope.elevation_min, telescope.elevation_max
    under, over = low - elevation.min(), elevation.max() - high
    if max(under, over) <= 1e-12:
        return
    worst = elevation.min() if under > over else elevation.max()
    reached = f"{'down' if under > over else 'up'} to elevation {np.degrees(worst):.2f} deg"
    raise PointingError(
        f"the scan of target '{target}' goes {reached}; {telescope.name} reaches {_range(low, high)}",
        place=place,
        cure=_when(horizontal, transform, target, low, high, total),
    )


def _when(horizontal: Floats, transform: CelestialTransform, target: Target, low: float, high: float, total: float) -> str:
    if target.frame == "horizontal":
        return f"choose an elevation from {_range(low, high)}, with room for the scan"
    site, start = transform.site, transform.start
    seconds = np.arange(0.0, DAY + 1, 60.0)
    day = CelestialTransform(site, start, DAY, 1e-6).horizontal(unit_vectors(*target.icrs()), seconds)
    elevation = np.arctan2(day[:, 2], np.hypot(day[:, 0], day[:, 1]))
    below, above = _room(horizontal, transform, target)
    within = (elevation >= low + below) & (elevation <= (high - above if high < np.pi / 2 else np.pi))
    if not within.any():
        if elevation.max() < low + below:
            highest = f"highest {np.degrees(elevation.max()):.2f} deg"
            never = f"at {site.name} it never rises far enough above {np.degrees(low):g} deg ({highest})"
            return f"{never}: choose another target or site"
        return f"at {site.name} it is within the limits at no time of the next 24 h: choose another target or site"
    edges = np.flatnonzero(np.diff(np.concatenate([[0], within.astype(np.int8), [0]])))
    spans = [
        f"{start.shifted(seconds[a]).datetime:%Y-%m-%dT%H:%M:%SZ} to {start.shifted(seconds[b - 1]).datetime:%Y-%m-%dT%H:%M:%SZ}"
        for a, b in edges.reshape(-1, 2)
    ]
    need = f"the scans take {total / 60:.1f} min"
    return f"within the next 24 h it is up (UTC) from {' and from '.join(spans)}: start then ({need})"


def _room(horizontal: Floats, transform: CelestialTransform, target: Target) -> tuple[float, float]:
    """How far below and above its target the boresight (n, 3) goes in elevation, over at most 1000 samples."""
    n = len(horizontal)
    some = np.unique(np.linspace(0, n - 1, min(n, 1000)).astype(int))
    centre = transform.horizontal(unit_vectors(*target.icrs()), some * (transform.duration / max(n - 1, 1)))
    lower = np.arcsin(np.clip(centre[:, 2], -1, 1)) - np.arcsin(np.clip(horizontal[some, 2], -1, 1))
    return max(float(lower.max()), 0.0), max(float(-lower.min()), 0.0)


def check_motion(horizontal: Floats, rate: float, telescope: Telescope, place: str) -> None:
    """Raise PointingError where the boresight (n, 3), sampled at ``rate`` [Hz], outruns the telescope.

    Speed and acceleration are those of the two axes, (azimuth' cos(elevation), elevation'), by finite differences.
    """
    azimuth = np.unwrap(np.arctan2(horizontal[:, 1], horizontal[:, 0]))
    elevation = np.arctan2(horizontal[:, 2], np.hypot(horizontal[:, 0], horizontal[:, 1]))
    for order, limit, what, unit in (
        (1, telescope.speed_max, "speed", "arcsec/s"),
        (2, telescope.acceleration_max, "acceleration", "arcsec/s2"),
    ):
        if limit is None or len(horizontal) <= order:
            continue
        along = np.diff(azimuth, order) * np.cos(elevation[order - 1 : len(elevation) - 1])
        fastest = float(np.hypot(along, np.diff(elevation, order)).max()) * rate**order
        if fastest > limit * (1 + 1e-6):
            raise PointingError(
                f"the scan reaches {'a speed' if order == 1 else 'an acceleration'} of {np.degrees(fastest) * 3600:.4g} {unit}; "
                f"{telescope.name}'s largest {what} is {np.degrees(limit) * 3600:.4g} {unit}",
                place=place,
                cure="scan more slowly, or in larger curves",
            )


def _range(low: float, high: float) -> str:
    return f"{np.degrees(low):g} deg to {np.degrees(high):g} deg"
