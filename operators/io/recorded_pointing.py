"""Boresight of a recorded scan, on the sky and above the horizon: as recorded, or one from the
other.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np

from zonda.core.errors import InputError
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.numerics.quaternions import conjugate, directions, multiply
from zonda.core.types import Floats

from .time_ordered_data import TimeOrderedData

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.observation import Observation
    from zonda.core.site import Site

GAP = 1.5
"""Sample intervals from which two samples are a gap apart."""


@dataclass(frozen=True)
class Found:
    """Boresights (n, 4) above the horizon and on the sky, and in words where the latter come
    from.
    """

    azel: Floats
    radec: Floats
    source: str


def boresights(
    tod: TimeOrderedData,
    start: Instant,
    site: Site,
    celestial: Literal["recorded", "recomputed"] | None,
    tolerance: float,
    place: str,
) -> Found:
    """The boresights of a file; the rotation of the focal plane about the boresight is kept.

    Raises InputError where those that are asked for cannot be had.
    """
    azel, radec = tod.boresight_azel, tod.boresight_radec
    for name, values in (("boresight_azel", azel), ("boresight_radec", radec)):
        far = np.flatnonzero(np.abs(np.einsum("ij,ij->i", values, values) - 1) > 1e-6)
        if far.size:
            raise InputError(
                f"{name} is no rotation at sample {far[0]}",
                place=place,
                cure="make quaternions of length 1",
            )
    if celestial == "recorded" and not len(radec):
        cure = "set celestial: recomputed, or leave it out"
        raise InputError("has no boresight_radec", place=place, cure=cure)
    if celestial == "recomputed" and not len(azel):
        raise InputError("has no boresight_azel", place=place, cure="leave celestial out")
    if len(radec) and len(azel) and celestial != "recomputed":
        return Found(azel, radec, "as recorded")
    transform = CelestialTransform(site, start, float(tod.seconds[-1]), tolerance)
    known = azel if len(azel) else radec
    looking = directions(known)
    horizontal = looking if len(azel) else transform.horizontal(looking, tod.seconds)
    _, upright_azel, upright_radec = transform.boresight(horizontal, tod.seconds)
    # what the boresight is turned about itself: Rz(psi) of R = R_upright Rz(psi)
    turn = multiply(conjugate(upright_azel if len(azel) else upright_radec), known)
    if len(azel):
        return Found(
            azel, multiply(upright_radec, turn), "recomputed from azimuth, elevation and time"
        )
    return Found(
        multiply(upright_azel, turn), radec, "as recorded; azimuth and elevation are computed"
    )


def state_celestial(label: str, observation: Observation, found: Found, rate: float) -> None:
    """State where directions come from, how even the times are, and how many gaps there are."""
    observation.tally.state(label, f"{observation.name}: directions on the sky", found.source)
    steps = np.diff(observation.seconds) * rate
    if steps.size and (gaps := int(np.count_nonzero(steps > GAP))):
        what = f"{observation.name}: gaps between samples, which filters and noise do not see"
        observation.tally.count(label, what, gaps, steps.size)
    if observation.jitter * rate > 1e-3:
        text = (
            f"depart from a comb of {rate:.6g} Hz by {observation.jitter * 1e3:.3g} ms rms; noise"
            " and filters count samples"
        )
        observation.tally.state(label, f"{observation.name}: times of the samples", text)
