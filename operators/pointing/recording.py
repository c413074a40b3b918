"""Recorded pointing: times and directions from a file, laid out on the comb of samples that comes nearest.

Readers know HDF5 (TOAST's layout and plain datasets), FITS tables and CSV. Nothing is repaired silently: `Comb` counts what it
drops and flags what was not recorded.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zonda.core.configuration.time import SECOND, Instant
from zonda.core.configuration.units import read_unit
from zonda.core.errors import InputError

Floats = NDArray[np.float64]

NOT_RECORDED = 16
"""Flag bit of a sample in a gap of the record, or whose row is not a number: its direction is interpolated, and not used."""

FLAGGED = 1
"""Flag bit of a sample that the file flags."""

UNEVEN = 0.25
"""rms of the intervals between rows, over whole numbers of samples, beyond which they are no comb with jitter."""

OUT_OF_ORDER = "rows out of order, dropped"
"""Count of rows whose time is not between those of the rows around them."""

ALIASES = {
    "time": ("time", "times", "t", "ctime", "timestamp", "mjd"),
    "seconds": ("seconds",),
    "az": ("az", "azimuth"),
    "el": ("el", "elevation", "alt", "altitude"),
    "ra": ("ra",),
    "dec": ("dec",),
    "flags": ("flags", "flag"),
}
"""Our name of a column, and names that files have for it, in small letters."""

Clock = Literal["unix", "mjd", "scene"]


@dataclass(frozen=True)
class Recording:
    """Rows as they are in the file.

    Attributes
    ----------
    start
        What ``seconds`` count from; None: from the scene's time.
    seconds
        (n,) s; NaN where the file has no time.
    longitude, latitude
        (n,) rad: azimuth (north through east) and elevation, or right ascension and declination (ICRS).
    frame
        Which of the two.
    flags
        (n,) bool: flagged in the file.
    """

    start: Instant | None
    seconds: Floats
    longitude: Floats
    latitude: Floats
    frame: Literal["azel", "icrs"]
    flags: NDArray[np.bool_]


@dataclass
class Scan:
    """A part of a recording without long gaps, on the comb of its samples.

    Attributes
    ----------
    seconds
        (n,) as recorded; between rows, where samples are missing, evenly spaced.
    rate
        Hz, of the comb.
    longitude, latitude
        (n,) rad, interpolated where nothing was recorded.
    flags
        (n,) `NOT_RECORDED`, `FLAGGED`.
    """

    seconds: Floats
    rate: float
    longitude: Floats
    latitude: Floats
    flags: NDArray[np.uint8]


@dataclass
class Comb:
    """The scans of a recording, and what was counted on the way: rows dropped, samples flagged."""

    scans: list[Scan]
    counts: dict[str, int] = field(default_factory=dict)


def comb(recording: Recording, split: float, place: str) -> Comb:
    """Lay a recording out on combs of samples; a gap longer than ``split`` [s] begins another scan.

    As few rows are dropped as leave the times in order (`longest_rising`): one stamp that jumps, ahead or back, goes alone.

    Raises
    ------
    InputError
        Fewer than two usable rows, or intervals so uneven (`UNEVEN`) that there is no comb.
    """
    counts: dict[str, int] = {}
    keep = np.isfinite(recording.seconds)
    counts["rows without a time, dropped"] = int(np.count_nonzero(~keep))
    rows = np.flatnonzero(keep)
    rising = longest_rising(recording.seconds[rows])
    rest = np.setdiff1d(np.arange(len(rows)), rising, assume_unique=True)
    kept_before = rising[np.maximum(np.searchsorted(rising, rest) - 1, 0)]
    repeated = int(np.count_nonzero(recording.seconds[rows[rest]] == recording.seconds[rows[kept_before]]))
    counts[OUT_OF_ORDER], counts["rows repeated, dropped"] = len(rest) - repeated, repeated
    rows = rows[rising]
    seconds = recording.seconds[rows]
    if len(rows) < 2:
        raise InputError(
            f"has {len(rows)} rows with increasing times", place=place, cure="check the column of times and its unit"
        )
    step = float(np.median(np.diff(seconds)))
    apart = np.r_[True, np.diff(seconds) >= step / 2]
    counts["rows closer than half a sample to the one before, dropped"] = int(np.count_nonzero(~apart))
    rows, seconds = rows[apart], seconds[apart]
    interval = np.diff(seconds) / step
    ahead = np.maximum(np.rint(interval), 1.0)
    near = ahead * step <= split
    uneven = float(np.sqrt(np.mean((interval - ahead)[near] ** 2))) if near.any() else 0.0
    if uneven > UNEVEN:
        raise InputError(
            f"the intervals between rows vary by {100 * uneven:.0f} % of a sample ({1e3 * step:.4g} ms): there is no sample rate",
            place=place,
            cure="resample it to equal steps first",
        )
    good = np.isfinite(recording.longitude[rows]) & np.isfinite(recording.latitude[rows])
    scans, alone = [], 0
    for part in np.split(np.arange(len(rows)), np.flatnonzero(~near) + 1):
        if np.count_nonzero(good[part]) < 2:
            alone += len(part)
            continue
        scans.append(_scan(recording, rows[part], seconds[part], ahead[part[:-1]].astype(np.int64), good[part]))
    counts["rows alone between gaps, dropped"] = alone
    if not scans:
        raise InputError("no two directions next to each other are numbers", place=place, cure="check the columns")
    missing = sum(len(s.seconds) for s in scans) - (len(rows) - alone)
    flagged = sum(int(np.count_nonzero(s.flags & NOT_RECORDED)) for s in scans)
    counts["samples in gaps, flagged"] = missing
    counts["samples whose row is not a number, flagged"] = flagged - missing
    counts["samples flagged in the file"] = sum(int(np.count_nonzero(s.flags & FLAGGED)) for s in scans)
    return Comb(scans, counts)


def longest_rising(values: Floats) -> NDArray[np.intp]:
    """Indices of as many of ``values`` (n,) as there are in strictly rising order: what is left out is out of order, however far.

    Of several such choices, that whose values rise least (Schensted 1961); of equal values the first. O(n log n).
    """
    if (np.diff(values) > 0).all():
        return np.arange(len(values))
    tails: list[float] = []  # of the lowest chain of each length: its last value ...
    ends: list[int] = []  # ... and index
    before = np.full(len(values), -1, np.intp)
    for i, value in enumerate(values.tolist()):
        k = len(tails) if not tails or value > tails[-1] else bisect_left(tails, value)
        if k == len(tails):
            tails.append(value)
            ends.append(i)
        elif value < tails[k]:
            tails[k], ends[k] = value, i
        else:
            continue
        before[i] = ends[k - 1] if k else -1
    chain = np.empty(len(tails), np.intp)
    i = ends[-1]
    for k in reversed(range(len(chain))):
        chain[k], i = i, int(before[i])
    return chain


def _scan(
    recording: Recording, rows: NDArray[np.intp], seconds: Floats, ahead: NDArray[np.int64], good: NDArray[np.bool_]
) -> Scan:
    slot = np.r_[0, np.cumsum(ahead)]
    every = np.arange(slot[-1] + 1)
    flags = np.full(len(every), NOT_RECORDED, np.uint8)
    flags[slot[good]] = 0
    flags[slot[recording.flags[rows]]] |= FLAGGED
    longitude = np.unwrap(recording.longitude[rows][good])
    return Scan(
        seconds=np.interp(every, slot, seconds),
        rate=float(slot[-1] / (seconds[-1] - seconds[0])),
        longitude=np.interp(every, slot[good], longitude),
        latitude=np.interp(every, slot[good], recording.latitude[rows][good]),
        flags=flags,
    )


# -- files --


def read(path: Path, clock: Clock) -> Recording:
    """Read a recording; ``clock``: what its times count, where the file does not carry its own start.

    Raises
    ------
    InputError
        Unreadable, without the columns, without units, or with directions that cannot be.
    """
    place = f"recorded pointing {path}"
    try:
        with path.open("rb") as file:
            magic = file.read(9)
        kind = _hdf5 if magic.startswith(b"\x89HDF") else _fits if magic.startswith(b"SIMPLE  =") else _csv
        return _recording(*kind(path, place), clock, place)
    except OSError as err:
        raise InputError(f"cannot be read: {err}", place=place, cure="give HDF5, a FITS table or CSV") from None


Columns = Mapping[str, tuple[Any, str | None]]
"""By name in small letters: values and unit."""


def _csv(path: Path, place: str) -> tuple[Columns, Instant | None]:
    try:
        with path.open(encoding="utf-8-sig") as file:  # spreadsheets begin with a byte order mark
            header = file.readline().lstrip("# ").strip()
            names = [name.strip() for name in header.split(",")]
            table = np.genfromtxt(file, delimiter=",", ndmin=2)
    except (UnicodeDecodeError, ValueError) as err:
        raise InputError(f"cannot be read as CSV: {err}", place=place, cure="write rows of equally many numbers") from None
    if table.size == 0 or table.shape[1] != len(names):
        raise InputError(
            f"the first line names {len(names)} columns, the rows have {table.shape[1] if table.size else 0}",
            place=place,
            cure="begin with a line such as: time [s], az [deg], el [deg]",
        )
    columns = {}
    for k, name in enumerate(names):
        word, _, unit = name.partition("[")
        columns[word.strip().lower()] = (table[:, k], unit.rstrip("] ") or None)
    return columns, None


def _fits(path: Path, place: str) -> tuple[Columns, Instant | None]:
    from astropy.io import fits

    with fits.open(path) as file:
        for table in file:
            names = (
                {name.lower() for name in getattr(table.columns, "names", [])} if isinstance(table, fits.BinTableHDU) else set()
            )
            if any(names >= {a, b} for a in ALIASES["az"] for b in ALIASES["el"]) or names >= {"ra", "dec"}:
                columns = {
                    c.name.lower(): (np.asarray(table.data[c.name], np.float64), c.unit) for c in table.columns if c.dim is None
                    and np.asarray(table.data[c.name]).ndim == 1 and np.asarray(table.data[c.name]).dtype.kind in "fiub"
                }  # fmt: skip
                start = file[0].header.get("DATE-OBS") if "seconds" in columns else None
                return columns, Instant.parse(start) if start else None
    raise InputError("has no table with az and el, or ra and dec", place=place, cure="name the columns TIME, AZ and EL")


def _hdf5(path: Path, place: str) -> tuple[Columns, Instant | None]:
    import h5py

    with h5py.File(path, "r") as file:
        toast = "shared" in file
        group = file["shared"] if toast else file.get("pointing", file)
        columns: dict[str, tuple[Any, str | None]] = {}
        for name, values in group.items():
            if not isinstance(values, h5py.Dataset) or values.ndim != 1 or values.dtype.kind not in "fiub":
                continue
            unit = values.attrs.get("units", values.attrs.get("unit"))
            known = next((ours for ours, names in ALIASES.items() if name.lower() in names), None)
            si = {"time": "s", "seconds": "s", "az": "rad", "el": "rad"}.get(known or "") if toast else None
            columns[name.lower()] = (values[:], str(unit) if unit is not None else si)
        start = file["metadata/other"].attrs.get("zonda_start_utc") if toast and "metadata/other" in file else None
        if toast and "boresight_azel" in group:
            _check_rotation(group["boresight_azel"], place)
        return columns, Instant.parse(str(start)) if start is not None else None


def _check_rotation(quaternions: Any, place: str) -> None:
    """zonda's mount keeps the focal plane upright; a file whose boresight is rotated about itself would not be followed."""
    x, y, z, w = np.asarray(quaternions[:], np.float64).T
    psi = np.arctan2(y * z + w * x, -(x * z - w * y))
    turned = float(np.abs(psi[np.isfinite(psi)]).max(initial=0.0))
    if turned > 1e-6:
        raise InputError(
            f"the boresight is rotated by up to {np.degrees(turned):.3g} deg about itself, which is not simulated",
            place=place,
            cure="give azimuth and elevation alone",
        )


def _recording(columns: Columns, start: Instant | None, clock: Clock, place: str) -> Recording:
    found = {ours: columns[name] for ours, names in ALIASES.items() for name in names if name in columns}
    frame: Literal["azel", "icrs"] = "azel" if {"az", "el"} <= set(found) else "icrs"
    which = ("az", "el") if frame == "azel" else ("ra", "dec")
    lacks = [name for name in which if name not in found] + ["time"] * (not {"time", "seconds"} & set(found))
    if lacks:
        there = ", ".join(columns) or "none"
        raise InputError(f"has no column {' and '.join(lacks)}; columns: {there}", place=place, cure="name them time, az and el")
    longitude, latitude = (_in_si(*found[name], "rad", name, place) for name in which)
    if (worst := np.nanmax(np.abs(latitude), initial=0.0)) > np.pi / 2 + 1e-9:
        row = int(np.nanargmax(np.abs(latitude)))
        raise InputError(f"{which[1]} is {np.degrees(worst):.6g} deg in row {row}", place=place, cure="check its unit")
    if start is not None and "seconds" in found:
        seconds = _in_si(*found["seconds"], "s", "seconds", place)
    else:
        seconds, start = _times(*found["time" if "time" in found else "seconds"], clock, place)
    flags = np.asarray(found["flags"][0]) != 0 if "flags" in found else np.zeros(len(seconds), bool)
    return Recording(start, seconds, longitude, latitude, frame, flags)


def _times(values: Any, unit: str | None, clock: Clock, place: str) -> tuple[Floats, Instant | None]:
    """Seconds, and what they count from: a whole second or day next to the first, so that differences are exact."""
    days = clock == "mjd"
    times = np.asarray(values, np.float64) if days else _in_si(values, unit or "s", "s", "time", place)
    if clock == "scene":
        return times, None
    finite = times[np.isfinite(times)]
    if not len(finite):
        raise InputError("has no time that is a number", place=place, cure="check the column of times")
    first = int(np.floor(finite[0]))
    since = first * SECOND if not days else (first - 40587) * 86400 * SECOND
    try:
        start = Instant(since)
        year = start.datetime.year
    except (OverflowError, ValueError):
        year = 0
    if not 1980 <= year <= 2150:
        raise InputError(
            f"the first time, {finite[0]:.10g}, is not of our days as {'an MJD' if days else 'seconds since 1970'}",
            place=place,
            cure="set clock: unix (seconds since 1970), mjd, or scene (seconds since the scene's time)",
        )
    return (times - first) * (86400.0 if days else 1.0), start


def _in_si(values: Any, unit: str | None, si: str, name: str, place: str) -> Floats:
    if not unit:
        raise InputError(f"{name} has no unit", place=place, cure=f"write one, e.g. {name} [deg] in the first line of a CSV")
    measure, own = read_unit(unit), read_unit(si)
    if measure is None or own is None or measure.powers != own.powers:
        raise InputError(f"{unit!r} is no unit of {name}", place=place, cure=f"use {'deg or rad' if si == 'rad' else 's'}")
    return np.asarray(values, np.float64) * measure.factor
