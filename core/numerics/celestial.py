"""Transforms between ICRS and the horizon for a whole scan, exact at coarse time nodes and
interpolated between them; and the Earth's orientation (UT1-UTC, polar motion).

An ICRS direction p becomes the horizontal direction h at time t by

    h(t) = M(t) a(d(p, e(t)), v(t))                                                              (1)

with d the light deflection by the Sun in direction e, a the aberration for the observer's velocity
v, and M a rotation: precession-nutation, Earth rotation, polar motion and the site's vertical.
There is no refraction (astropy's AltAz with pressure 0). d, a and M are ERFA's (IAU 2006/2000A): at
the nodes (1) is astropy's full transformation. Between nodes M is

    M(t) = C R_z(-(theta_0 + lambda + omega t)) B(t)                                             (2)

where all the speed is in the sidereal rotation omega t; what is left, B (a quaternion), v and e,
varies over hours and is interpolated by the cubics through the four nearest nodes. The error is
measured halfway between the nodes, which are doubled until it is met.

Horizontal vectors have the axes north, west, up: longitude is minus the azimuth, as in TOAST, so
that both frames are right-handed and M is a rotation. Aberration also scales the field by up to
1e-4 (13 mas at 2 arcmin), which a boresight rotation cannot hold; its rotation of the field is
kept.

UT1-UTC and polar motion are from the IERS tables that astropy installs with itself. Nothing is ever
downloaded. The files are read here rather than through `astropy.utils.iers`, which takes a second
of CPU and may reach for the network.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from ..configuration.time import Instant
from ..errors import PointingError
from ..site import Site
from ..types import Floats
from .chunks import chunks
from .projection import rotation_matrices
from .quaternions import Upright, conjugate, multiply, rotate, series, shortest_rotation

SIDEREAL_RATE = 2 * np.pi * 1.00273781191135448 / 86400
"""Rate of the Earth rotation angle, rad/s of UT1."""
NODE_SPACING = 600.0
"""First spacing of the nodes, s: leaves about 1e-12 rad."""
CONVERGED = 5e-11
"""Last step [rad] of an inversion: what it leaves is 1e-4 of that."""
MEAN_POLE = (0.035, 0.29)
"""Polar motion where no table reaches [arcsec]: astropy's 50-year mean."""


class _Nodes(NamedTuple):
    """Slowly varying quantities at n instants."""

    rotation: Floats
    """(n, 4) quaternion B of equation (2)."""
    velocity: Floats
    """(n, 3) of the observer, units of c."""
    sun: Floats
    """(n, 4) direction from the Sun to the observer, and their distance [au]."""


class Boresight(NamedTuple):
    """Boresight directions at n instants."""

    horizontal: Floats
    """(n, 3) unit vectors north, west, up."""
    azel: Floats
    """(n, 4) quaternions; psi is 0: eta points to the zenith."""
    radec: Floats
    """(n, 4) quaternions: the same focal plane carried to ICRS, so psi is the parallactic rotation.
    """


class CelestialTransform:
    """Equation (1) between ``start`` and ``start + duration`` at one site.

    Parameters
    ----------
    site
        Where the telescope stands.
    start
        Exact start; times below are float64 seconds since it.
    duration
        Length [s] of the interval it must hold for.
    tolerance
        Largest interpolation error [rad].

    Attributes
    ----------
    error
        Interpolation error reached [rad]: the largest found halfway between nodes.
    spacing
        Seconds between nodes.
    source
        Where the Earth's orientation comes from, in words.
    orientation_known
        False where no bundled table reaches the date.
    """

    def __init__(
        self,
        site: Site,
        start: Instant,
        duration: float,
        tolerance: float = 1e-9,
    ) -> None:
        self.site = site
        self.start = start
        self.duration = duration
        self.source = ""
        self.orientation_known = True
        self._theta0 = self._rotation_angle()
        self.spacing = NODE_SPACING
        for _ in range(8):
            times = np.arange(-1, max(np.ceil(duration / self.spacing), 1) + 2) * self.spacing
            nodes = np.hstack(self._exact(times))
            self._cubics = _cubics(nodes)
            middles = times[1:-2] + self.spacing / 2
            self.error = self._difference(self._exact(middles), self._interpolated(middles))
            if self.error <= tolerance:
                return
            self.spacing /= 2
        raise PointingError(
            f"interpolation cannot reach {tolerance:.1e} rad (reached {self.error:.1e} rad)",
            place="celestial transformation",
            cure="allow a larger interpolation_error",
        )

    def horizontal(self, icrs: Floats, seconds: Floats) -> Floats:
        """Directions (n, 3) north, west, up of ICRS unit vectors (n, 3) or (3,) at ``seconds``
        (n,).
        """
        out = np.empty((len(seconds), 3))
        for part in chunks(len(seconds)):
            now = self._interpolated(seconds[part])
            observed = _observed(icrs if icrs.ndim == 1 else icrs[part], now)
            out[part] = rotate(self._rotation(now, seconds[part]), observed)
        return out

    def icrs(self, horizontal: Floats, seconds: Floats) -> Floats:
        """ICRS unit vectors (n, 3) of horizontal directions (n, 3) or (3,) at ``seconds`` (n,)."""
        out = np.empty((len(seconds), 3))
        for part in chunks(len(seconds)):
            now = self._interpolated(seconds[part])
            turn = conjugate(self._rotation(now, seconds[part]))
            out[part] = _natural(
                rotate(turn, horizontal if horizontal.ndim == 1 else horizontal[part]),
                now,
            )
        return out

    def boresight(self, horizontal: Floats, seconds: Floats) -> Boresight:
        """The boresight in directions (n, 3) north, west, up at ``seconds``.

        Signs are such that neighbouring samples have neighbouring quaternions.
        """
        n = len(seconds)
        upright = Upright()
        azel = series(4, n)
        radec = series(4, n)
        for part in chunks(n):
            now = self._interpolated(seconds[part])
            turn = conjugate(self._rotation(now, seconds[part]))
            observed = rotate(turn, horizontal[part])
            azel[part] = upright(horizontal[part])
            radec[part] = _carried(turn, observed, _natural(observed, now), azel[part])
        return Boresight(horizontal, azel, radec)

    def follow(self, icrs: Callable[[Floats], Floats], seconds: Floats) -> Boresight:
        """The `boresight` along a celestial path, at half the cost: nothing is inverted.

        ``icrs``: the unit vectors (m, 3) at a chunk of the ``seconds`` (n,).
        """
        n = len(seconds)
        upright = Upright()
        horizontal, azel, radec = (series(k, n) for k in (3, 4, 4))
        for part in chunks(n):
            now = self._interpolated(seconds[part])
            turn = self._rotation(now, seconds[part])
            natural = icrs(seconds[part])
            observed = _observed(natural, now)
            horizontal[part] = rotate(turn, observed)
            azel[part] = upright(horizontal[part])
            radec[part] = _carried(conjugate(turn), observed, natural, azel[part])
        return Boresight(horizontal, azel, radec)

    def _exact(self, seconds: Floats) -> _Nodes:
        """ERFA's full model at ``seconds`` (n,)."""
        import erfa

        with warnings.catch_warnings():
            warnings.simplefilter(
                "ignore",
                erfa.ErfaWarning,
            )  # "dubious year": leap seconds to come are unknown
            utc1, utc2 = self._utc(seconds)
            earth = orientation(utc1 - 2400000.5 + utc2)
            self.source = earth.source
            self.orientation_known = earth.known
            site = self.site
            # no refraction: pressure, temperature, humidity 0; the wavelength [um] then has no
            # effect
            star, _ = erfa.apco13(
                utc1,
                utc2,
                earth.ut1_utc,
                site.longitude,
                site.latitude,
                site.altitude,
                earth.x,
                earth.y,
                0.0,
                0.0,
                0.0,
                1.0,
            )
        # columns of the rotation from CIRS to the horizon, from its three axes
        azimuth, zenith, *_ = erfa.atioq(
            np.array([[0.0], [np.pi / 2], [0.0]]),
            np.array([[0.0], [0.0], [np.pi / 2]]),
            star,
        )
        sine = np.sin(zenith)
        axes = np.array(
            [sine * np.cos(azimuth), -sine * np.sin(azimuth), np.cos(zenith)]
        )  # (component, axis, node)
        whole = np.einsum("can,nab->ncb", axes, star["bpn"])
        rigid = self._spin(seconds)
        slow = np.einsum("nki,nkj->nij", rotation_matrices(rigid), whole)
        return _Nodes(_near_identity(slow), star["v"], np.column_stack([star["eh"], star["em"]]))

    def _utc(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Two-part UTC Julian dates. Seconds are SI seconds: counted in TAI, so leap seconds are
        right.
        """
        import erfa

        days, rest = divmod(self.start.nanoseconds, 86_400_000_000_000)
        year, month, day, _ = erfa.jd2cal(2440587.5, days)
        minutes, rest = divmod(rest, 60_000_000_000)
        # by calendar: a day that ends in a leap second has 86401 s, and ERFA counts its fractions
        # of those
        tai1, tai2 = erfa.utctai(
            *erfa.dtf2d("UTC", year, month, day, minutes // 60, minutes % 60, rest / 1e9)
        )
        utc1, utc2 = erfa.taiutc(np.full(len(seconds), tai1), tai2 + seconds / 86400.0)
        return utc1, utc2

    def _rotation_angle(self) -> float:
        """theta_0 of equation (2), Earth rotation angle at the start; B absorbs what is left of
        UT1-UTC.
        """
        import erfa

        with warnings.catch_warnings():
            warnings.simplefilter("ignore", erfa.ErfaWarning)
            return float(erfa.era00(*self._utc(np.zeros(1)))[0])

    def _spin(self, seconds: Floats) -> Floats:
        """C R_z of equation (2), quaternions (n, 4); C turns (meridian, east, pole) axes into
        (north, west, up).
        """
        half = -(self._theta0 + self.site.longitude + SIDEREAL_RATE * seconds) / 2
        tilt = np.pi / 4 - self.site.latitude / 2
        a = np.sin(tilt)
        b = np.cos(tilt)
        sine = np.sin(half)
        cosine = np.cos(half)
        return np.stack([a * cosine, -a * sine, b * cosine, -b * sine]).T

    def _interpolated(self, seconds: Floats) -> _Nodes:
        at = np.empty((11, len(seconds)))
        where = seconds / self.spacing
        interval = np.clip(where.astype(np.int64), 0, len(self._cubics) - 1)
        edges = np.flatnonzero(np.diff(interval, prepend=-1, append=-1))
        for first, last in pairwise(edges.tolist()):
            k = interval[first]
            part, s, (c0, c1, c2, c3) = (
                at[:, first:last],
                where[first:last] - k,
                self._cubics[k].T[:, :, None],
            )
            np.multiply(c3, s, out=part)
            for c in (c2, c1):
                part += c
                part *= s
            part += c0
        rotation = at[:4] / np.sqrt((at[:4] ** 2).sum(axis=0))
        return _Nodes(rotation.T, at[4:7].T, at[7:].T)

    def _rotation(self, now: _Nodes, seconds: Floats) -> Floats:
        """M of equation (2), quaternions (n, 4)."""
        return multiply(self._spin(seconds), now.rotation)

    @staticmethod
    def _difference(exact: _Nodes, other: _Nodes) -> float:
        """Bound on the angle [rad] between directions transformed with the one and the other."""
        turn = 2 * np.linalg.norm(
            multiply(exact.rotation, conjugate(other.rotation))[:, :3],
            axis=1,
        )
        velocity = np.linalg.norm(exact.velocity - other.velocity, axis=1)
        sun = 1e-5 * np.abs(exact.sun - other.sun).sum(
            axis=1
        )  # deflection is below 1e-5 rad everywhere
        return float((turn + velocity + sun).max())


def _carried(turn: Floats, observed: Floats, natural: Floats, azel: Floats) -> Floats:
    """ICRS quaternions (n, 4): ``turn`` from the horizon to the observed direction, then along a
    great circle to the natural.
    """
    return multiply(shortest_rotation(observed, natural), multiply(turn, azel))


def _observed(icrs: Floats, now: _Nodes) -> Floats:
    """Deflection and aberration: ICRS unit vectors -> observed ones, BCRS axes."""
    import erfa

    sun = np.ascontiguousarray(now.sun[:, :3])
    distance = now.sun[:, 3]
    reciprocal_gamma = np.sqrt(1 - np.einsum("ni,ni->n", now.velocity, now.velocity))
    bent = erfa.ldsun(icrs, sun, distance)
    observed: Floats = erfa.ab(bent, np.ascontiguousarray(now.velocity), distance, reciprocal_gamma)
    return observed


def _natural(observed: Floats, now: _Nodes) -> Floats:
    """Inverse of `_observed`, a fixed point: errors shrink by 1e-4 per step, from those of one bend
    for all directions.
    """
    middle = observed.mean(axis=0, keepdims=True)
    then = _Nodes(*(part[:1] for part in now))
    middle = middle / (np.linalg.norm(middle) or 1.0)
    natural = observed - (_observed(middle, then) - middle)
    for _ in range(5):
        before = natural
        natural = observed - (_observed(_unit(natural), now) - natural)
        if np.abs(natural - before).max() < CONVERGED:
            break
    return _unit(natural)


def _unit(vectors: Floats) -> Floats:
    """Vectors (n, 3) of length one."""
    return np.asarray(vectors / np.sqrt(np.einsum("ni,ni->n", vectors, vectors))[:, None])


def _cubics(nodes: Floats) -> Floats:
    """Coefficients (m, k, 4) of the cubics through four neighbours of n = m + 3 equidistant nodes
    (n, k).

    v(s) = c_0 + c_1 s + c_2 s^2 + c_3 s^3 between the second of the four, at s = 0, and the third,
    at s = 1.
    """
    a, b, c, d = (nodes[k : k + len(nodes) - 3] for k in range(4))
    return np.stack(
        [b, c - a / 3 - b / 2 - d / 6, (a + c) / 2 - b, (d - a) / 6 + (b - c) / 2],
        axis=2,
    )


def _near_identity(matrix: Floats) -> Floats:
    """Quaternions (n, 4) of rotation matrices (n, 3, 3) by well under pi."""
    w = np.sqrt(1 + np.trace(matrix, axis1=1, axis2=2)) / 2
    x, y, z = (matrix[:, i, j] - matrix[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    return np.stack([x / (4 * w), y / (4 * w), z / (4 * w), w], axis=1)


class Orientation(NamedTuple):
    """Earth orientation at n instants."""

    ut1_utc: Floats
    """(n,) s."""
    x: Floats
    """(n,) polar motion, rad."""
    y: Floats
    """(n,) polar motion, rad."""
    source: str
    """Name and last day of the table, or the assumption that replaces it."""
    known: bool
    """False where the tables do not reach: then UT1 = UTC and the mean pole are assumed, as astropy
    does.
    """


def orientation(mjd: Floats) -> Orientation:
    """Linear interpolation (as astropy's) at UTC modified Julian dates (n,), all from one table."""
    first = int(np.floor(mjd.min()))
    last = int(np.floor(mjd.max())) + 1
    for name, read in (
        ("IERS C04", _c04),
        ("IERS finals2000A, the latest values of which are predictions", _finals),
    ):
        values = read(first, last)
        if values is not None:
            x, y, ut1_utc = _interpolate(mjd - first, values)
            return Orientation(ut1_utc, x, y, name, True)
    x, y = np.radians(np.array(MEAN_POLE) / 3600.0)[:, None] * np.ones_like(mjd)
    return Orientation(
        np.zeros_like(mjd),
        x,
        y,
        "none for this date: UT1 = UTC (within 0.9 s) and the mean pole assumed",
        False,
    )


def _interpolate(days: Floats, values: Floats) -> Floats:
    """(3, n): x, y [rad], UT1-UTC [s] at days since the first row; a leap second between two rows
    is no change of UT1.
    """
    lower = np.floor(days).astype(int)
    step = values[lower + 1] - values[lower]
    step[:, 2] -= np.round(step[:, 2])
    at = values[lower] + (days - lower)[:, None] * step
    at[:, :2] = np.radians(at[:, :2] / 3600.0)
    return np.ascontiguousarray(at.T)


def _c04(first: int, last: int) -> Floats | None:
    """Final values x ["], y ["], UT1-UTC [s] of the days ``first`` to ``last``, (last - first + 1,
    3): fields 4 to 7.
    """
    from astropy_iers_data import IERS_B_FILE  # type: ignore[import-untyped]

    return _rows(IERS_B_FILE, first, last, lambda line: line[16:62].split())


def _finals(first: int, last: int) -> Floats | None:
    """Table of fixed columns, as from `_c04`: Bulletin B where it is given, else Bulletin A, which
    ends in a year of predictions.
    """
    from astropy_iers_data import IERS_A_FILE

    def fields(line: bytes) -> list[bytes]:
        bulletin_a = (line[18:27], line[37:46], line[58:68])
        bulletin_b = (line[134:144], line[144:154], line[154:165])
        return [
            line[7:15],
            *(bulletin_b if all(part.strip() for part in bulletin_b) else bulletin_a),
        ]

    return _rows(IERS_A_FILE, first, last, fields)


def _rows(
    file: str,
    first: int,
    last: int,
    fields: Callable[[bytes], list[bytes]],
) -> Floats | None:
    """The rows of ``first`` to ``last`` of a file with one line per day, or None where it does not
    hold them all.
    """
    with open(file, "rb") as table:
        while (line := table.readline())[:1] == b"#":
            pass
        begin = table.tell() - len(line)
        even = (os.stat(file).st_size - begin) % max(len(line), 1) == 0
        try:
            offset = max(first - int(float(fields(line)[0])), 0)
            table.seek(
                begin + offset * len(line) if even else begin
            )  # lines of one length: 5 MB of days gone by are passed over
            lines = table.read((last - first + 1) * len(line) if even else -1).splitlines()
            found = [fields(line) for line in lines[0 if even else offset :][: last - first + 1]]
            rows = np.array(found, dtype="S").astype(float)
        except (IndexError, ValueError):  # blank columns: days to come
            return None
    if rows.ndim != 2 or not np.array_equal(rows[:, 0], np.arange(first, last + 1)):
        return None
    return np.ascontiguousarray(rows[:, 1:])
