"""Time and the sphere, against ERFA's own transformation of catalogue positions (`eraAtco13`),
epoch by epoch.
"""

from __future__ import annotations

import math
import warnings
from fractions import Fraction
from typing import Any

import numpy as np

from zonda.core.checks import Family
from zonda.core.configuration.time import Instant
from zonda.core.data import Data, Observation
from zonda.core.numerics.celestial import CelestialTransform, orientation
from zonda.core.numerics.projection import rotation_matrices
from zonda.core.numerics.sphere import unit_vectors
from zonda.operators.pointing.azimuth_scan import PointingBackAndForth
from zonda.operators.pointing.base import PointingStare
from zonda.operators.pointing.daisy import PointingDaisy
from zonda.plugins.checks.numerics import ERROR, SITES, angle, erfa_horizontal
from zonda.plugins.checks.scenes import camera, differing, largest, scene

from .cases import SPHERE, TIME

checks = Family("pointing")

WHEN = Instant.parse("2024-11-25T07:00:00.123456789Z")


def _observe(operator: Any, **more: Any) -> tuple[Observation, Data]:
    data = Data(scene(camera(7), **{"site": SITES[0], "time": WHEN, **more}))
    operator.observe(data)
    return data.observations[0], data


@checks.add(TIME, reference="ERFA across 2016-12-31T23:59:60", limit=ERROR, unit="rad")
def leap_second() -> float:
    """pointing error 10 s before to 10 s after a leap second"""
    import erfa

    start, site = Instant.parse("2016-12-31T23:59:50Z"), SITES[0]
    sky = unit_vectors(np.array([0.5]), np.array([0.2]))
    worst = 0.0
    transform = CelestialTransform(site, start, 20.0)
    for elapsed in (0.0, 9.5, 10.5, 11.5, 20.0):
        if elapsed < 11:
            utc1, utc2 = erfa.dtf2d("UTC", 2016, 12, 31, 23, 59, 50 + elapsed)
        else:
            utc1, utc2 = erfa.dtf2d("UTC", 2017, 1, 1, 0, 0, elapsed - 11)
        earth = orientation(np.atleast_1d(utc1 - 2400000.5 + utc2))
        azimuth, zenith, *_ = erfa.atco13(
            0.5,
            0.2,
            0.0,
            0.0,
            0.0,
            0.0,
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
        worst = largest(
            worst,
            angle(
                transform.horizontal(sky, np.array([elapsed])),
                unit_vectors(-azimuth, np.pi / 2 - zenith),
            ),
        )
    return worst


@checks.add(TIME, reference="rational arithmetic", limit=1e-9, unit="s")
def sample_times() -> float:
    """error of the time of any sample of a day at 0.9 Hz"""
    o, _ = _observe(
        PointingStare(scan_duration="86400 s", sample_rate="0.9 Hz", target="az 0 deg el 45 deg")
    )
    some = np.unique(np.linspace(0, o.n_samples - 1, 1000).astype(int))
    return largest(
        *(float(abs(Fraction(float(o.seconds[k])) - Fraction(int(k) * 10, 9))) for k in some)
    )


@checks.add(SPHERE, reference="ERFA eraAtco13", limit=ERROR, unit="rad")
def poles_of_the_sky() -> float:
    """pointing error at declinations of 90, -90 and within 0.4 mas of them, over a day"""
    transform, worst = CelestialTransform(SITES[0], WHEN, 86400.0), 0.0
    seconds = np.linspace(0, 86400, 25)
    for declination in (90.0, -90.0, 89.9999999, -89.9999999):
        sky = unit_vectors(np.full(25, 1.0), np.full(25, math.radians(declination)))
        up = transform.horizontal(sky, seconds)
        *_, radec = transform.boresight(up, seconds)
        worst = largest(
            worst,
            angle(up, erfa_horizontal(sky, WHEN, seconds, SITES[0])),
            angle(rotation_matrices(radec)[:, :, 2], sky),
        )
    return worst


@checks.add(SPHERE, reference="ERFA eraAtco13", limit=ERROR, unit="rad")
def zenith_crossing() -> float:
    """pointing error of a star that culminates 1 arcsec from the zenith, while its azimuth turns by
    180 deg
    """
    overhead = CelestialTransform(SITES[0], WHEN, 0.0).icrs(np.array([0.0, 0.0, 1.0]), np.zeros(1))[
        0
    ]
    ra, dec = math.atan2(overhead[1], overhead[0]), math.asin(overhead[2]) + math.radians(1 / 3600)
    o, _ = _observe(
        PointingStare(scan_duration="60 s", target=f"{ra!r} rad {dec!r} rad"),
        time=WHEN.shifted(-30),
    )
    sky = unit_vectors(np.full(o.n_samples, ra), np.full(o.n_samples, dec))
    some = slice(None, None, 50)
    up = erfa_horizontal(sky[some], o.start, o.seconds[some], SITES[0])
    return largest(
        angle(rotation_matrices(o.boresight_azel)[some, :, 2], up),
        angle(rotation_matrices(o.boresight_radec)[:, :, 2], sky),
    )


@checks.add(SPHERE, reference="ERFA eraAtco13", limit=ERROR, unit="rad")
def low_and_wrapping() -> float:
    """pointing error of scans at 5 deg of elevation, due north and due south, through azimuth 0 and
    RA 0
    """
    worst = 0.0
    for operator, target in (
        (PointingStare(scan_duration="60 s"), "az 123 deg el 5 deg"),
        (
            PointingBackAndForth(scan_duration="60 s", throw="4 deg", speed="0.5 deg/s"),
            "az 0 deg el 40 deg",
        ),
        (
            PointingBackAndForth(scan_duration="60 s", throw="4 deg", speed="0.5 deg/s"),
            "az 180 deg el 40 deg",
        ),
        (PointingDaisy(scan_duration="60 s", speed="1 arcmin/s"), "0 deg 20 deg"),
    ):
        o, _ = _observe(operator, target=target, time="2024-11-25T00:30Z")
        some = slice(None, None, 60)
        azel, radec = (
            rotation_matrices(q)[some, :, 2] for q in (o.boresight_azel, o.boresight_radec)
        )
        worst = largest(
            worst, angle(azel, erfa_horizontal(radec, o.start, o.seconds[some], SITES[0]))
        )
    return worst


@checks.add(SPHERE, reference="the target at 75 deg", limit=0, unit="values")
def right_ascension_wrap() -> int:
    """quaternions that change when the target is given at 435 and at -285 deg"""
    daisy, wrong = PointingDaisy(scan_duration="30 s"), 0
    one, _ = _observe(daisy, target="75 deg 20 deg")
    for target in ("435 deg 20 deg", "-285 deg 20 deg"):
        other, _ = _observe(daisy, target=target)
        wrong += differing(one.boresight_azel, other.boresight_azel) + differing(
            one.boresight_radec, other.boresight_radec
        )
    return wrong


@checks.add(
    SPHERE, reference="a warning, a line in the log, finite directions", limit=0, unit="dates"
)
def beyond_the_tables() -> int:
    """dates beyond the bundled IERS tables that pass without a word, 1950 and 2090; dates inside
    that warn
    """
    wrong = 0
    for year, known in ((1950, False), (2090, False), (2024, True)):
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            o, _ = _observe(
                PointingStare(scan_duration="1 s", target="az 0 deg el 45 deg"),
                time=f"{year}-11-25T12:00Z",
            )
        said = {what: text for _, what, text in o.log}["Earth orientation"]
        warned = any("Earth orientation" in str(w.message) for w in caught)
        told = "none for this date" in said
        wrong += int(
            not (warned != known and told != known and np.isfinite(o.boresight_radec).all())
        )
    return wrong
