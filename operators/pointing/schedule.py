"""Pointing by an observing schedule of TOAST: version 5 (ECSV) and versions 4 to 1 (text)."""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field, field_validator

from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.time import Instant
from zonda.core.configuration.units import (
    Angle,
    AngularAcceleration,
    AngularSpeed,
    Fraction,
    SampleRate,
    Unit,
)
from zonda.core.data import Data, Observation
from zonda.core.errors import InputError, PointingError
from zonda.core.flags import IRREGULAR, intervals_of
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.numerics.quaternions import multiply
from zonda.core.numerics.sphere import angles, separation, unit_vectors
from zonda.core.scene import Scene
from zonda.core.storage.table_files import Table, read_table, read_text
from zonda.core.types import Floats

from .base import Scans
from .limits import LargestMotion, check_elevation
from .motion import POINTS, LargestDerivative, Quantity, motion
from .observed import mark_turnarounds, observed, sunlit, transform_of
from .sweep import Nod, Sweep

COLUMNS = (
    "start_time",
    "stop_time",
    "boresight_angle",
    "name",
    "azmin",
    "azmax",
    "el",
    "scan_index",
    "subscan_index",
)
"""In the order of version 4."""
ANGLES = ("boresight_angle", "azmin", "azmax", "el")
OVERLAP = 1.0
"""s: rows may overlap by as much, since schedules round their times to seconds."""
WIDEST_WRAP = np.pi
"""rad: azmax below azmin is read as a sweep through north; a wider one is taken for exchanged
limits.
"""
CURE = (
    f"give a schedule of TOAST, version 5 (ECSV with the columns {', '.join(COLUMNS)}) or version 4"
    " to 1 (text)"
)
TWO_WORDS = (11, 23, 24)
"""Fields of a row whose dates and times are two words: versions 3 and 1."""
CONCISE = {9: range(9), 21: (0, 1, 4, 5, 6, 7, 8, 19, 20), 22: (0, 1, 4, 5, 6, 7, 8, 19, 20)}
"""Where `COLUMNS` stand in a row of so many fields: of versions 4 and 3; of 2 and 1, whose last may
lack.
"""


@dataclass(frozen=True)
class Row:
    """One constant-elevation scan.

    Attributes
    ----------
    name, number
        The patch; `scan_index` and `subscan_index`.
    start, duration
        Duration in s.
    azimuth
        (least, largest) of the mount, rad; the largest above the least.
    elevation, rotation
        rad; the turn of the focal plane about the boresight.
    """

    name: str
    number: tuple[str, str]
    start: Instant
    duration: float
    azimuth: tuple[float, float]
    elevation: float
    rotation: float

    @property
    def width(self) -> float:
        """Throw, rad; 0: a stare, as in TOAST where the limits are within 1e-10."""
        low, high = self.azimuth
        return high - low if high - low >= 1e-10 else 0.0

    @property
    def label(self) -> str:
        """TOAST's name of the observation."""
        return "-".join([self.name, *self.number])


@dataclass(frozen=True)
class SchedulesSite:
    """Site for which a schedule was made: its name, and position [rad]."""

    name: str
    latitude: float
    longitude: float


def read_schedule(path: Path, nods: float = 0.0) -> tuple[list[Row], SchedulesSite | None]:
    """The rows of a schedule, and the site that it was made for: None where it states none, or one
    that is not known (TOAST's default).

    ``nods``: seconds before each scan in which the telescope nods. Raises InputError for a file
    that is none, and for a row that makes no sense.
    """
    text = _without_special(read_text(path, str(path)), str(path))
    table = read_table(path, text=text) if text.startswith("# %ECSV") else _of_text(text, str(path))
    return _rows(table, nods), _site(table)


def _without_special(text: str, place: str) -> str:
    """The text with rows of SPECIAL (cooler cycles) left empty: as in TOAST they are no scans."""
    lines = text.splitlines()
    special = [k for k, line in enumerate(lines) if "SPECIAL" in line and line[:1] != "#"]
    if special:
        told = f"{len(special)} row{'s' if len(special) > 1 else ''} with SPECIAL (cooler cycles)"
        first = f"line {special[0] + 1}{', ...' if len(special) > 1 else ''}"
        warnings.warn(f"{place}: {told} left out: {first}", stacklevel=2)
    for k in special:
        lines[k] = ""
    return "\n".join(lines)


def _site(table: Table) -> SchedulesSite | None:
    """Raises InputError for a latitude or longitude that is none."""
    name, *stated = (table.meta.get(key) for key in ("site_name", "site_lat", "site_lon"))
    if None in stated:
        return None
    try:
        latitude, longitude = (_degrees(value) for value in stated)
    except ValueError:
        text = f"its site's latitude and longitude are {stated[0]!r} and {stated[1]!r}"
        raise InputError(text, place=table.place, cure="write them in degrees") from None
    if name in (None, "Unknown") and latitude == longitude == 0:
        return None
    return SchedulesSite(str(name), math.radians(latitude), math.radians(longitude))


def _degrees(value: Any) -> float:
    """Degrees of a number, a text such as ``-22.96 deg``, or astropy's mapping of value and unit.
    Raises ValueError.
    """
    if isinstance(value, Mapping):
        unit = value.get("unit")
        value = f"{value.get('value')} {unit.get('unit') if isinstance(unit, Mapping) else unit}"
    try:
        degrees = float(str(value))
    except ValueError:
        degrees = math.degrees(Unit("rad").parse(str(value)))
    if not abs(degrees) <= 360:
        raise ValueError
    return degrees


def _of_text(text: str, place: str) -> Table:
    """The table of a text schedule: a line about the site, then the fields of a row a line, between
    bars, commas, semicolons, tabs or blanks.
    """
    lines = []
    rows = []
    for number, line in enumerate(text.splitlines(), 1):
        if line.strip() and not line.startswith("#"):
            mark = max("|,;\t", key=line.count)
            fields = [f.strip() for f in line.split(mark)] if mark in line else line.split()
            lines.append(number)
            rows.append(fields)
    if len(rows) < 2 or len(rows[0]) != 5:
        cause = "is no schedule: there is no line about the site, or none behind it"
        raise InputError(cause, place=place, cure=CURE)
    (name, _, latitude, longitude, _), *rows = rows
    meta = {"site_name": name, "site_lat": latitude, "site_lon": longitude}
    table = Table(place, {}, [*lines[1:], lines[0]], meta)
    found = []
    for k, row in enumerate(rows):
        if len(row) in TWO_WORDS:
            row = [f"{row[0]} {row[1]}", f"{row[2]} {row[3]}", *row[4:]]
        if len(row) not in CONCISE:
            table.note(k, f"has {len(row)} fields, not {len(COLUMNS)}", CURE)
            continue
        found.append([row[k] for k in CONCISE[len(row)]])
    table.check()
    units = dict.fromkeys(ANGLES, "deg")
    columns = zip(COLUMNS, map(list, zip(*found, strict=True)), strict=True)
    table.columns = {name: (column, units.get(name, "")) for name, column in columns}
    return table


def _rows(table: Table, nods: float) -> list[Row]:
    turn, low, high, elevation = (table.numbers(name, "rad") for name in ANGLES)
    name, scan, subscan = (table.texts(n) for n in ("name", "scan_index", "subscan_index"))
    begin, end = (table.instants(name) for name in ("start_time", "stop_time"))
    table.check()
    found = []
    for k, (first, last) in enumerate(zip(begin, end, strict=True)):
        assert first is not None
        assert last is not None
        row = Row(
            name=name[k],
            number=(scan[k], subscan[k]),
            start=first,
            duration=last.seconds_since(first),
            azimuth=(float(low[k]), float(high[k]) + (2 * np.pi if high[k] < low[k] else 0.0)),
            elevation=float(elevation[k]),
            rotation=float(turn[k]),
        )
        if wrong := _what_is_wrong(row, float(high[k])):
            table.note(k, f"{row.label}: {wrong[0]}", wrong[1])
        found.append(row)
    _note_overlaps(found, nods, table)
    table.check()
    if empty := [k for k, row in enumerate(found) if row.duration == 0]:
        told = ", ".join(f"{found[k].label} (line {table.lines[k]})" for k in empty[:3])
        more = ", ..." if len(empty) > 3 else ""
        warnings.warn(
            f"{table.place}: stop_time is start_time in {told}{more}: left out",
            stacklevel=2,
        )
    if len(empty) == len(found):
        table.note(None, "has no row that lasts", "give rows whose stop_time is later")
        table.check()
    return [row for row in found if row.duration]


def _what_is_wrong(row: Row, stated: float) -> tuple[str, str] | None:
    """Cause and cure. ``stated``: azmax as it is written [rad]."""
    cure = "mend or remove that row"
    if row.duration < 0:
        return "stop_time is earlier than start_time", cure
    if not 0 < row.elevation <= np.pi / 2:
        return f"el is {np.degrees(row.elevation):g} deg, not between 0 and 90 deg", cure
    low, high = row.azimuth
    text = f"azmin is {np.degrees(low):g} deg and azmax {np.degrees(stated):g} deg"
    if high - low > 2 * np.pi * (1 + 1e-12):
        return "azmin and azmax are more than a turn apart", cure
    if stated < low and high - low > WIDEST_WRAP * (1 + 1e-12):
        wide = f"azmax: {np.degrees(high):g} deg where the sweep is as wide"
        sweep = f"that is a sweep of {np.degrees(high - low):g} deg through north"
        return f"{text}: {sweep}", f"exchange them, or write {wide}"
    return None


def _note_overlaps(rows: list[Row], nods: float, table: Table) -> None:
    """Note each row that begins, with its ``nods`` [s] before it, before an earlier one stops: the
    telescope is in one place at a time."""
    sound = [k for k, row in enumerate(rows) if row.duration > 0]
    begins = {k: rows[k].start.seconds_since(rows[sound[0]].start) for k in sound}
    before = -1
    stops = -math.inf
    for k in sorted(sound, key=begins.__getitem__):
        early = stops - begins[k]
        what = "begins"
        cure = "shift or shorten one of them, or remove one"
        if early <= OVERLAP + 1e-6 and nods:
            early += nods
            cure = f"leave {nods:.6g} s between the rows for the nods, or change elevation_nods"
            what = f"its elevation nods of {nods:.6g} s begin"
        if early > OVERLAP + 1e-6:
            other = f"{rows[before].label} (line {table.lines[before]})"
            table.note(k, f"{rows[k].label}: {what} {early:.6g} s before {other} stops", cure)
        if begins[k] + rows[k].duration > stops:
            before = k
            stops = begins[k] + rows[k].duration


EARTH, NEAR, FAR = 6.371e6, 5e3, 1e5
"""m: the Earth's radius; how far from the scene a schedule's site is another one, and how far its
azimuths make no sense.
"""

ANOTHER_DAY = 86400.0
"""s between the schedule and the scene's time from which a run warns: the weather is the scene's.
"""

MOST_LOOKED_AT = 64
"""Rows of a schedule that `zonda check` looks at."""

Track = Callable[[Floats], Floats]
"""Directions (n, 3) at seconds (n,)."""


class ScheduleParameters(Scans):
    """Parameters that all scans of a schedule share."""

    schedule: InputPath
    """Version 5 (ECSV) or 4 to 1 (text between bars, commas, semicolons, tabs or blanks) of
    TOAST's schedules."""
    speed: AngularSpeed = quantity("1 deg/s", gt=0)
    """Constant speed on the sky between the limits."""
    acceleration: AngularAcceleration = quantity("1 deg/s2", gt=0)
    """Acceleration of the mount's azimuth in turnarounds (the largest, where they are smooth)."""
    turnaround: Literal["smooth", "constant_acceleration"] = "constant_acceleration"
    """Constant acceleration as in TOAST, or a continuous one (twice as long)."""
    flag_turnarounds: bool = True
    """Flag the samples in turnarounds, so that no map uses them."""
    sun_close: Angle = quantity("45 deg", gt=0, le=math.pi)
    """Distance of the Sun below which samples are flagged *sun close*. They are used all the same,
    as are those while the Sun is up: both are flags and intervals of files."""
    elevation_nods: list[Angle] = Field(default_factory=list, max_length=100, examples=["1 deg"])
    """Offsets in elevation to which the telescope goes in turn before each scan, the last of them
    0, e.g. [1 deg, -1 deg, 0 deg]; flagged irregular."""
    elevation_speed: AngularSpeed = quantity("1 deg/s", gt=0)
    """Largest speed of nods."""
    elevation_acceleration: AngularAcceleration = quantity("1 deg/s2", gt=0)
    """Acceleration of nods."""
    sample_rate: SampleRate | None = Field(None, gt=0, le=1e6)
    """Read-out rate; the instrument's where absent."""
    check_limits: Literal["error", "warn"] = "error"
    """Whether a scan beyond the telescope's largest speed, acceleration or jerk is an error, or a
    warning.
    """
    interpolation_error: Fraction = Field(1e-3, gt=0, le=0.1)
    """Largest error of interpolating the celestial transformation in time, as a fraction of the
    smallest beam's FWHM.
    """

    @field_validator("elevation_nods")
    @classmethod
    def _to_the_scan(cls, value: list[float]) -> list[float]:
        if value and value[-1] != 0:
            raise ValueError(
                "nods end at the elevation of the scan: write 0 deg as the last of them"
            )
        return value


class PointingSchedule(ScheduleParameters):
    """Constant-elevation scans of an observing schedule in TOAST's formats, one observation a row.

    Azimuth limits and `acceleration` are those of the mount, `speed` is on the sky (the mount turns
    1 / cos(elevation) as fast): as in TOAST's `SimGround`, whose turnarounds, flags and intervals
    are the default. A scan begins at the lesser azimuth, towards larger ones, and has as many whole
    samples as fit. Its name ends with the patch, scan and subscan of the row. A row whose azmin is
    its azmax is a stare; rows with SPECIAL (cooler cycles) and rows without duration are left out
    with a warning. A schedule that states its site is compared with the scene's: 5 km apart are a
    warning, 100 km an error.
    """

    def every(self) -> Sequence[Row]:
        return self._read()[0]

    def some(self, scans: Sequence[Row]) -> list[Row]:
        """Rows evenly over the schedule, with the lowest and the highest (where the mount turns
        fastest), the widest and the narrowest throw, and the longest and the shortest scan: a limit
        of the telescope that any row exceeds, one of these does.
        """
        if len(scans) <= MOST_LOOKED_AT:
            return list(scans)
        found = {round(k) for k in np.linspace(0, len(scans) - 1, MOST_LOOKED_AT - 6)}
        sizes = [(row.elevation, row.width, row.duration) for row in scans]
        found.update(np.argmin(sizes, axis=0).tolist(), np.argmax(sizes, axis=0).tolist())
        return [scans[k] for k in sorted(found)]

    def length(self, scan: Row) -> float:
        return scan.duration + self.nod.duration

    def summary(self, scans: Sequence[Row], made: Sequence[Observation]) -> str:
        end = max(row.start.shifted(row.duration) for row in scans)
        total = sum(row.duration for row in scans) / 3600
        several = f"{len(scans)} scan{'s' if len(scans) > 1 else ''}"
        if stares := sum(not row.width for row in scans):
            several += f", {stares} of them stares (azmin is azmax),"
        return f"{several} from {scans[0].start} to {end}, {total:.3g} h in all"

    def maker(self, data: Data) -> Callable[[Row, float, LargestMotion], Observation]:
        rows, site = self._read()
        self._compare_sites(data, site)
        if abs(data.scene.time.seconds_since(rows[0].start)) > ANOTHER_DAY:
            text = (
                f"the schedule begins {rows[0].start}, the weather is that of {data.scene.time}:"
                " set the scene's time"
            )
            warnings.warn(f"{self.label}: {text}", stacklevel=3)
        return partial(self._observation, data)

    @property
    def nod(self) -> Nod:
        """The motion before each scan."""
        return Nod(tuple(self.elevation_nods), self.elevation_speed, self.elevation_acceleration)

    def _read(self) -> tuple[list[Row], SchedulesSite | None]:
        return read_schedule(self.schedule, self.nod.duration)

    def _compare_sites(self, data: Data, stated: SchedulesSite | None) -> None:
        """Warn where the schedule was made for another site; PointingError where that is far
        away.
        """
        site = data.scene.site
        if stated is None:
            return
        there = np.array([stated.longitude]), np.array([stated.latitude])
        apart = EARTH * float(separation(*there, (site.longitude, site.latitude))[0])
        if apart > NEAR:
            place = f"{np.degrees(stated.latitude):.4f} deg, {np.degrees(stated.longitude):.4f} deg"
            text = (
                f"the schedule was made for {stated.name} ({place}), {apart / 1e3:.4g} km from the"
                f" scene's site {site.name}"
            )
            cure = (
                "set the scene's site, or give a schedule of this site (or remove the site from its"
                " header)"
            )
            if apart > FAR:
                raise PointingError(
                    f"{text}: its azimuths look elsewhere from here",
                    place=f"{self.label}, {self.schedule}",
                    cure=cure,
                )
            warnings.warn(f"{self.label}: {text}: {cure}", stacklevel=4)

    def _observation(self, data: Data, row: Row, rate: float, moved: LargestMotion) -> Observation:
        """The observation of a row, sampled at ``rate`` [Hz]."""
        scene = data.scene
        place = f"{self.label}, {self.schedule}, {row.label}"
        mount = self.speed / math.cos(row.elevation) if row.width else 0.0
        smooth = self.turnaround == "smooth"
        sweep = Sweep(row.width, mount, self.acceleration, smooth)
        nod = self.nod
        ahead = math.ceil(nod.duration * rate * (1 - 1e-12))
        seconds = np.arange(ahead + max(int(row.duration * rate * (1 + 1e-12)), 1)) / rate
        delay = ahead / rate
        start = row.start.shifted(-delay)

        def track(at: Floats) -> Floats:
            azimuth = row.azimuth[0] + np.where(
                at >= delay,
                sweep.path(np.maximum(at - delay, 0.0)),
                0.0,
            )
            elevation = row.elevation + np.where(at < delay, nod.path(at), 0.0)
            return unit_vectors(-azimuth, elevation)

        horizontal = track(seconds)
        check_elevation(
            "the scan",
            horizontal,
            scene.instrument.telescope,
            place,
            lambda: "change the row, the elevation_nods, or the telescope's limits",
        )
        transform = transform_of(scene, start, seconds[-1], self.interpolation_error)
        _, azel, radec = transform.boresight(horizontal, seconds)
        lit, suns = sunlit(scene.site, start, seconds, azel, self.sun_close)
        turned = np.array([[0, 0, math.sin(row.rotation / 2), math.cos(row.rotation / 2)]])
        if row.rotation:
            azel = multiply(azel, turned)
            radec = multiply(radec, turned)
        scanning = seconds >= delay
        intervals = {
            name: [(a + delay, b + delay) for a, b in spans]
            for name, spans in sweep.intervals(seconds - delay, scanning).items()
        }
        if ahead:
            intervals["elnod"] = intervals_of(~scanning, seconds)
        observation = observed(
            self.label,
            scene,
            len(data.observations),
            transform,
            row.label,
            seconds=seconds,
            sample_rate=rate,
            boresight_azel=azel,
            boresight_radec=radec,
            centre=_centre(scene, row, transform, delay),
            flags=np.where(scanning, 0, IRREGULAR).astype(np.uint8) | lit,
            intervals=intervals | suns,
        )
        refused = place if self.check_limits == "error" else ""
        for begin, end, bounded in ((0.0, delay, False), (delay, len(seconds) / rate, smooth)):
            if end > begin:
                limits = {q: v for q, v in moved.limits.items() if bounded or q[1] < 3}
                found = _motion(track, begin, end, limits)
                known = {q: peak for q, peak in found.items() if bounded or q[1] < 3}
                moved.add(observation.name, known, refused)
        log = observation.log
        log.state(self.label, f"{observation.name}: row of the schedule", row.label)
        turning = sweep.turning(seconds - delay) & scanning
        mark_turnarounds(self.label, observation, turning, self.flag_turnarounds)
        if ahead:
            what = "samples in elevation nods, flagged"
            log.count(self.label, what, ahead, len(seconds))
        return observation


def _centre(
    scene: Scene,
    row: Row,
    transform: CelestialTransform,
    delay: float,
) -> tuple[float, float]:
    """ICRS (ra, dec) of the scene's target; of the middle of the scan where it has none, or one
    fixed on the ground.
    """
    if scene.target is not None and scene.target.frame != "horizontal":
        return scene.target.icrs()
    middle = unit_vectors([-sum(row.azimuth) / 2], [row.elevation])
    ra, dec = angles(transform.icrs(middle, np.array([delay + row.duration / 2]))[0])
    return float(ra % (2 * math.pi)), float(dec)


def _motion(
    track: Track,
    begin: float,
    end: float,
    limits: dict[Quantity, float],
) -> dict[Quantity, LargestDerivative]:
    """The largest derivatives of a part of the track, from begin to end [s].

    A scan begins at full speed: from the nod to the scan there is no motion to compare.
    """

    def at(interval: float) -> Floats:
        number = max(round((end - begin) / interval), 1)
        return track(begin + np.arange(number, dtype=np.float64) * interval)

    coarse = POINTS / (end - begin)
    found = motion(at(1 / coarse), coarse, limits, at)
    return {q: peak._replace(second=begin + peak.second) for q, peak in found.items()}
