"""Positions of targets, the Sun, the Moon and planets above the horizon of a site.

Directions are ERFA's, without refraction: aberration, precession-nutation (IAU 2006/2000A), Earth
rotation, polar motion. Planets are those of Simon et al. 1994 (plan94), the Moon that of Meeus 1998
(moon98), as in astropy's built-in ephemeris: nothing is downloaded. Topocentric: the Moon's
parallax is in. Light is not bent by the Sun (below 2 arcsec).
"""

from __future__ import annotations

import math
import warnings
from dataclasses import dataclass
from typing import Any

import numpy as np

from ..configuration.target import Target
from ..site import Site
from ..types import Floats
from .celestial import orientation
from .sphere import unit_vectors

PLANETS = {
    "mercury": 1,
    "venus": 2,
    "mars": 4,
    "jupiter": 5,
    "saturn": 6,
    "uranus": 7,
    "neptune": 8,
}
"""Planets, with their numbers in ERFA's plan94."""
BODIES = ("sun", "moon", *PLANETS)
LIGHT = 173.14463267424
"""Speed of light, au/day (IAU 2012)."""
DAY = 86400.0


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
        return np.arctan2(self.direction[:, 1], self.direction[:, 0]) % (2 * np.pi)

    @property
    def elevation(self) -> Floats:
        return np.arctan2(
            self.direction[:, 2], np.hypot(self.direction[:, 0], self.direction[:, 1])
        )

    def distance(self, other: Track) -> Floats:
        """(n,) angle to another track, rad."""
        apart = np.linalg.norm(np.cross(self.direction, other.direction), axis=1)
        return np.asarray(np.arctan2(apart, (self.direction * other.direction).sum(axis=1)))


def tracks(site: Site, times: Floats, *what: Target | str) -> list[Track]:
    """Tracks of targets and bodies (`BODIES`) at ``times`` (n,), POSIX seconds, from a site."""
    import erfa

    with warnings.catch_warnings():
        warnings.simplefilter(
            "ignore",
            erfa.ErfaWarning,
        )  # "dubious year": leap seconds to come are unknown
        jd = np.full(len(times), 2440587.5)
        days = times / DAY
        earth = orientation(jd - 2400000.5 + days)
        place = (site.longitude, site.latitude, site.altitude, earth.x, earth.y)
        star, _ = erfa.apco13(jd, days, earth.ut1_utc, *place, 0.0, 0.0, 0.0, 1.0)
        when = erfa.taitt(*erfa.utctai(jd, days))
        return [_track(one, star, when, len(times)) for one in what]


def _track(one: Target | str, star: Any, when: Any, n: int) -> Track:
    import erfa

    if not isinstance(one, str) and one.frame == "horizontal":
        c = math.cos(one.latitude)
        fixed = [c * math.cos(one.longitude), c * math.sin(one.longitude), math.sin(one.latitude)]
        return Track(np.tile(fixed, (n, 1)))
    natural = (
        _of_body(one, star, when)
        if isinstance(one, str)
        else np.tile(unit_vectors(*one.icrs()), (n, 1))
    )
    distance = np.ascontiguousarray(star["em"])
    seen = erfa.ab(
        natural,
        np.ascontiguousarray(star["v"]),
        distance,
        np.ascontiguousarray(star["bm1"]),
    )
    azimuth, zenith, *_ = erfa.atioq(
        *erfa.c2s(erfa.rxp(np.ascontiguousarray(star["bpn"]), seen)), star
    )
    sine = np.sin(zenith)
    return Track(np.stack([sine * np.cos(azimuth), sine * np.sin(azimuth), np.cos(zenith)], axis=1))


def _of_body(name: str, star: Any, when: Any) -> Floats:
    """(n, 3) unit vectors from the observer to a body, BCRS axes."""
    import erfa

    from_sun = star["eh"] * star["em"][:, None]  # of the observer, au
    if name == "moon":
        _, earth = erfa.epv00(*when)
        vector = erfa.moon98(*when)["p"] - (star["eb"] - earth["p"])
        vector -= (
            np.linalg.norm(vector, axis=1)[:, None] * star["v"]
        )  # it moves with the Earth while its light is on the way
    elif name == "sun":
        vector = -from_sun
    else:
        late = np.zeros(len(from_sun))
        for _ in range(2):  # the light's way
            vector = erfa.plan94(when[0], when[1] - late, PLANETS[name])["p"] - from_sun
            late = np.linalg.norm(vector, axis=1) / LIGHT
    return np.ascontiguousarray(vector / np.linalg.norm(vector, axis=1)[:, None])
