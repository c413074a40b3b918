"""Positions of targets, the Sun, the Moon and planets above the horizon of a site, by astropy.

Without refraction; with its built-in ephemeris, and the Earth's orientation of the tables that are
installed with it: nothing is downloaded.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from ..types import Floats
from .sphere import unit_vectors

if TYPE_CHECKING:
    from ..configuration.target import Target
    from ..site import Site

BODIES = ("sun", "moon", "mercury", "venus", "mars", "jupiter", "saturn", "uranus", "neptune")


@dataclass(frozen=True)
class Track:
    """Horizontal position at n instants.

    Attributes
    ----------
    direction
        (n, 3) unit vectors north, east, up.
    azimuth, elevation
        (n,) rad, north through east.
    """

    direction: Floats

    @property
    def azimuth(self) -> Floats:
        return np.asarray(np.arctan2(self.direction[:, 1], self.direction[:, 0]) % (2 * np.pi))

    @property
    def elevation(self) -> Floats:
        return np.asarray(
            np.arctan2(self.direction[:, 2], np.hypot(self.direction[:, 0], self.direction[:, 1]))
        )

    def distance(self, other: Track) -> Floats:
        """(n,) angle to another track, rad."""
        apart = np.linalg.norm(np.cross(self.direction, other.direction), axis=1)
        return np.asarray(np.arctan2(apart, (self.direction * other.direction).sum(axis=1)))


def tracks(site: Site, times: Floats, *what: Target | str) -> list[Track]:
    """Tracks of targets and bodies (`BODIES`) at ``times`` (n,), POSIX seconds, from a site."""
    from astropy import units as u
    from astropy.coordinates import AltAz, EarthLocation, SkyCoord, get_body
    from astropy.time import Time
    from astropy.utils import iers

    found = []
    place = EarthLocation.from_geodetic(
        site.longitude * u.rad, site.latitude * u.rad, site.altitude * u.m
    )
    there = AltAz(obstime=Time(times, format="unix"), location=place)
    with (
        warnings.catch_warnings(),
        iers.conf.set_temp("auto_download", False),
        iers.conf.set_temp("iers_degraded_accuracy", "ignore"),
    ):
        warnings.simplefilter("ignore")  # "dubious year": leap seconds to come are unknown
        for one in what:
            if not isinstance(one, str) and one.frame == "horizontal":
                fixed = unit_vectors(one.longitude, one.latitude)
                found.append(Track(np.tile(fixed, (len(times), 1))))
                continue
            source = (
                get_body(one, there.obstime, place, ephemeris="builtin")
                if isinstance(one, str)
                else SkyCoord(*one.icrs(), unit="rad")
            )
            seen = source.transform_to(there)
            found.append(Track(unit_vectors(seen.az.rad, seen.alt.rad)))
    return found
