"""A pipeline for an observer who names an instrument and a site: daisy scans, high-pass filter,
common mode, one map.

    radius r       half the area's diameter, of what the boresight covers
    speed          the least of: 0.35 sqrt(a r), a the telescope's largest acceleration; half of its
    largest speed; r per second;
                   a fifth of a beam per sample                                                  (1)
    cut            speed / (2.5 r)                                                               (2)

For MUSTANG-2 on the GBT and r = 4 arcmin these are about 50 arcsec/s and 0.08 Hz, as its observers
choose them.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, TypeVar

import numpy as np
from scipy.ndimage import maximum_filter1d

from zonda.core import registry
from zonda.core.configuration.diagnostics import input_error
from zonda.core.configuration.loaded import PipelineFile
from zonda.core.configuration.target import Target
from zonda.core.configuration.time import Instant
from zonda.core.configuration.units import Unit
from zonda.core.errors import InputError, PointingError
from zonda.core.instrument import Instrument, Telescope
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.site import Site
from zonda.core.types import Floats
from zonda.core.weather import Pwv

ELEVATION = math.radians(60)
LONGEST, MOST = 600.0, 6
"""Seconds of a scan, and number of scans that are followed, at most: a longer observation averages
down as time^-1/2.
"""
ACCELERATION, SPEED, PERIOD, SAMPLED, CUT = 0.35, 0.5, 1.0, 0.2, 2.5
"""Constants of equations (1) and (2)."""
TURN, CYCLES = 20.0, 5.0
"""A scan lasts at least this many radius / speed, one turn of the petals, and this many cycles of
the cut.
"""
WIDEST = math.radians(20)
"""Largest area where none is given."""
YEAR = 2024
"""Year of the observation: the climatology does not depend on it, and the Earth's orientation is
known.
"""
HIGHEST = math.radians(80)
"""Largest elevation at which a target is observed: nearer to the zenith the azimuth axis has to
turn more than six times as fast as the beam moves."""
DAY, GRID = 86400.0, 300.0
"""Seconds in which a target's culmination is looked for, and steps."""
PLACE = "zonda sensitivity"

T = TypeVar("T")


@dataclass(frozen=True)
class Daisy:
    """Equations (1) and (2): rad, rad/s, Hz, s."""

    radius: float
    speed: float
    cut: float
    duration: float
    scans: int


def make(settings: Sequence[str] = (), **asked: Any) -> PipelineFile:
    """The pipeline for an observer's request (see `text`), with changes as `zonda run --set` takes
    them.

    Raises ZondaError for names that are not registered, contradictions, and targets that are not
    up.
    """
    from zonda.core.configuration.pipeline_file import parse

    file = parse(text(**asked), name="the pipeline of zonda sensitivity", overrides=settings)
    if file.header.description:
        warnings.warn(f"--target: {file.header.description}", stacklevel=2)
    return file


def text(
    instrument: str,
    site: str,
    pwv: str | None = None,
    month: int | None = None,
    quantile: float | None = None,
    elevation: str | None = None,
    target: str | None = None,
    area: str | None = None,
    integration: str | None = None,
) -> str:
    """YAML of the pipeline for an observer's request.

    Values are text with units; None: not stated.

    Parameters
    ----------
    instrument, site
        Registered names.
    pwv, month, quantile
        PWV, or the month (1 to 12) and quantile (0 to 1) of the climatology; the median of the
        present month where nothing is said.
    elevation, target
        Elevation of a target that culminates in the middle of the night, or a target, observed when
        it culminates; one that culminates too near the zenith for the azimuth axis to follow, when
        it is below `HIGHEST`: the description of the pipeline says so.
    area
        Diameter of the field that the boresight covers; twice the field of view where it is not
        said.
    integration
        Integration time.

    Raises
    ------
    ZondaError
        As `make`.
    """
    if pwv is not None and quantile is not None:
        wrong = "the PWV is given twice, as a value and as a quantile"
        raise InputError(wrong, place=PLACE, cure="give --pwv or --quantile")
    if elevation is not None and target is not None:
        wrong = "a target has an elevation of its own"
        cure = "give --target or --elevation"
        raise InputError(wrong, place=PLACE, cure=cure)
    if month is not None and not 1 <= month <= 12:
        raise InputError(f"there is no month {month}", place="--month", cure="give 1 to 12")
    if quantile is not None and not 0 < quantile < 1:
        wrong = f"a quantile of {quantile} is outside the limits, above 0 and below 1"
        raise InputError(wrong, place="--quantile")
    camera = registry.instruments.create(instrument)
    place = registry.sites.create(site)
    height = positive("--elevation", Unit("rad", "60 deg"), elevation, ELEVATION)
    if height > math.pi / 2:
        wrong = f"an elevation of {elevation} is outside the limits, 0 to 90 deg"
        raise InputError(wrong, place="--elevation")
    wanted = positive("--integration", Unit("s", "3 h"), integration, 3600.0)
    usual = min(2 * max(camera.field_of_view, 10 * camera.beam_fwhm), WIDEST)
    size = positive("--area", Unit("rad"), area, usual)
    middle = _midnight(place, month)
    day = None
    note = ""
    if target is not None:
        centre = parsed("--target", Target.parse, target)
        day = Day.of(place, middle, centre)
        most = min(HIGHEST, camera.telescope.elevation_max) - size / 2
        height = min(float(day.elevation.max()), most)
    scan = daisy(camera, height, size, wanted)
    if not scan.duration <= DAY:
        wrong = (
            f"at an elevation of {math.degrees(height):.6g} deg the azimuth axis lets the beam scan"
            f" with {math.degrees(scan.speed) * 3600:.3g} arcsec/s at most"
        )
        raise InputError(wrong, place="--elevation", cure="give a lower one")
    half = (scan.scans * (scan.duration + 30) - 30) / 2
    if day is None:
        centre = _culminating(place, middle, height)
    else:
        middle, note = day.best(half, most)
    start = middle.shifted(-half)
    if quantile is not None:
        pwv = f"{100 * quantile:.12g} %"
    angle = Unit("rad")
    rate = Unit("rad / s")
    lines = [
        f"name: sensitivity_{instrument}",
        f"description: {note}" if note else "",
        f"site: {site}",
        f"instrument: {instrument}",
        f"time: {start}",
        f"target: {centre}",
        "" if pwv is None else f"weather: {{pwv: {parsed('--pwv', Pwv.parse, pwv)}}}",
        "operators:",
        "  - PointingDaisy:",
        f"      radius: {_in(angle, scan.radius, 'arcmin', 'deg')}",
        f"      speed: {_in(rate, scan.speed, 'arcsec/s', 'arcmin/s', 'deg/s')}",
        f"      scan_duration: {scan.duration:.6g} s",
        f"      scans: {scan.scans}",
        "  - AtmosphereLayers",
        "  - WhiteNoise",
        "  - PinkNoise",
        "  - Efficiency",
        f"  - HighpassFilter: {{frequency: {scan.cut:.3g} Hz}}",
        "  - CommonModeFilter" if camera.detectors > 1 else "",
        f"  - BinMap: {{pixel: {_in(angle, camera.beam_fwhm / 4, 'arcsec', 'arcmin')}}}",
        "  - SaveMap",
    ]
    return "".join(f"{line}\n" for line in lines if line)


def daisy(instrument: Instrument, elevation: float, area: float, seconds: float) -> Daisy:
    """Equations (1) and (2) for an area of diameter ``area`` [rad] at an ``elevation`` [rad], and
    the scans that fill ``seconds``."""
    radius = area / 2
    telescope = instrument.telescope
    acceleration, fastest = _limits(telescope, elevation)
    speed = min(
        ACCELERATION * math.sqrt(acceleration * radius),
        SPEED * fastest,
        radius / PERIOD,
        SAMPLED * instrument.beam_fwhm * instrument.sample_rate,
    )
    if speed < 1e-12:  # rad/s, at the zenith
        return Daisy(radius, speed, 0.0, math.inf, 1)
    cut = speed / (CUT * radius)
    scans = max(1, min(MOST, math.ceil(seconds / LONGEST - 1e-9)))
    least = max(TURN * radius / speed, CYCLES / cut)
    return Daisy(radius, speed, cut, max(min(seconds / scans, LONGEST), least), scans)


def _limits(telescope: Telescope, elevation: float) -> tuple[float, float]:
    """Largest acceleration and speed on the sky in any direction, rad/s2 and rad/s; infinite where
    none is known.
    """
    t = telescope
    across = math.cos(elevation)
    acceleration, speed = (
        min([azimuth * across if azimuth else math.inf, *filter(None, others)])
        for azimuth, *others in (
            (t.azimuth_acceleration_max, t.acceleration_max, t.elevation_acceleration_max),
            (t.azimuth_speed_max, t.speed_max, t.elevation_speed_max),
        )
    )
    return acceleration, speed


def _midnight(site: Site, month: int | None) -> Instant:
    """Local mean midnight on the 15th of a month of `YEAR`; of the present month where none is
    given.
    """
    day = datetime(YEAR, month or datetime.now(UTC).month, 15, tzinfo=UTC)
    hours = (-site.longitude / (2 * math.pi) * 24) % 24
    return Instant.parse(day).shifted(round(hours * 3600))


def _culminating(site: Site, middle: Instant, elevation: float) -> Target:
    """The ICRS position that is highest at ``middle``, at an elevation: south of a northern site,
    north of a southern one.
    """
    from zonda.core.numerics.celestial import CelestialTransform

    azimuth = math.pi if site.latitude >= 0 else 0.0
    transform = CelestialTransform(site, middle, 1.0)
    x, y, z = transform.icrs(unit_vectors(-azimuth, elevation), np.zeros(1))[0]
    right_ascension = math.degrees(math.atan2(y, x)) % 360
    declination = math.degrees(math.atan2(z, math.hypot(x, y)))
    return Target.parse(f"{right_ascension:.4f} deg {declination:.4f} deg")


@dataclass(frozen=True)
class Day:
    """Elevations (n,) [rad] of a target on the day about an instant, each `GRID` seconds."""

    start: Instant
    elevation: Floats

    @classmethod
    def of(cls, site: Site, middle: Instant, target: Target) -> Day:
        """Elevations on the day about ``middle``. Raises PointingError where the target never
        rises.
        """
        from zonda.core.numerics.celestial import CelestialTransform

        if target.frame == "horizontal":
            cure = "give --elevation, or a position on the sky"
            raise InputError(
                "a target in azimuth and elevation moves over the sky",
                place="--target",
                cure=cure,
            )
        start = middle.shifted(-DAY / 2)
        transform = CelestialTransform(site, start, DAY, 1e-6)
        seconds: Floats = np.arange(0.0, DAY + 1, GRID)
        height = transform.horizontal(unit_vectors(*target.icrs()), seconds)[:, 2]
        if height.max() <= 0:
            raise PointingError(
                f"{target} never rises at {site.name}",
                place="--target",
                cure="choose another site",
            )
        return cls(start, np.arcsin(np.clip(height, -1, 1)))

    def best(self, half: float, most: float) -> tuple[Instant, str]:
        """Middle of an observation of 2 ``half`` seconds when the target culminates; with a note,
        nearest to that where it stays below an elevation ``most`` [rad].
        """
        top = int(np.argmax(self.elevation))
        middle = top
        note = ""
        if self.elevation[top] > most:
            reach = math.ceil(half / GRID)
            highest = maximum_filter1d(self.elevation, 2 * reach + 1, mode="wrap")
            low = np.flatnonzero((highest <= most) & (self.elevation > 0))
            if not low.size:
                wrong = f"it stays above {math.degrees(most):.3g} deg for longer than that"
                raise PointingError(wrong, place="--target", cure="give a shorter --integration")
            middle = int(low[np.argmin(abs(low - top))])
            hours = (middle - top) * GRID / 3600
            note = (
                f"the target culminates at {math.degrees(self.elevation[top]):.1f} deg, too near"
                f" the zenith to be followed; it is observed {abs(hours):.1f} h"
                f" {'later' if hours > 0 else 'earlier'}, below {math.degrees(most):.3g} deg"
            )
        return self.start.shifted(middle * GRID), note


def _in(unit: Unit, value: float, *names: str) -> str:
    """A quantity [SI] with three digits, in the first of some units of rising size in which it is
    below 100.
    """
    texts = [(value / unit.parse(f"1 {name}"), name) for name in names]
    number, name = next((t for t in texts if t[0] < 100), texts[-1])
    return f"{number:.3g} {name}"


def positive(place: str, unit: Unit, given: str | None, usual: float) -> float:
    """A quantity above 0 in SI; ``usual`` where none is given. Raises InputError about
    ``place``.
    """
    value = usual if given is None else parsed(place, unit.parse, given)
    if not value > 0:
        raise InputError(f"{given} is not positive", place=place, cure=f"write e.g. {unit.example}")
    return value


def parsed(place: str, parse: Callable[[Any], T], given: str) -> T:
    """Parse a text; InputError about ``place`` if ``parse`` refuses it."""
    from pydantic_core import PydanticCustomError

    try:
        return parse(given)
    except PydanticCustomError as err:
        raise input_error(err, place) from None
