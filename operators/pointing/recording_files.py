"""Recorded pointing in files: HDF5 (TOAST's layout and plain datasets), FITS tables, CSV and ASTE's
antenna logs.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zonda.core import flags
from zonda.core.configuration.time import SECOND, Instant
from zonda.core.configuration.units import factor_to
from zonda.core.errors import InputError
from zonda.core.intervals import Intervals
from zonda.core.storage import fits_files, hdf5_files
from zonda.core.storage.files import reading
from zonda.core.types import Floats

from .antenna_log import BEGINS, read_log
from .recording import Recording, longest_rising

ALIASES = {
    "time": (
        "time",
        "times",
        "t",
        "ctime",
        "timestamp",
        "mjd",
        "utc",
        "datetime",
        "date",
        "date_time",
        "iso",
        "iso_time",
        "time_utc",
        "utc_time",
        "unix",
        "unixtime",
        "unix_time",
        "posix",
    ),
    "seconds": ("seconds",),
    "az": ("az", "azimuth", "azim", "azi"),
    "el": ("el", "elevation", "elev", "alt", "altitude"),
    "ra": ("ra", "right_ascension", "raj2000"),
    "dec": ("dec", "declination", "decj2000", "dej2000"),
    "flags": ("flags", "flag"),
}
"""Our name of a column, and names that files have for it, in small letters."""

UNITS = {
    **dict.fromkeys(("deg", "degs", "degree", "degrees", "°"), "deg"),
    **dict.fromkeys(("rad", "radian", "radians"), "rad"),
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds"), "s"),
    "ms": "ms",
    "arcmin": "arcmin",
    "arcsec": "arcsec",
}
"""Units as headings write them, in small letters, and as we do."""
ISO = re.compile(r"\d{4}-\d{2}-\d{2}([T ]\d{2}:\d{2}(:\d{2}(\.\d{1,9})?)?)?")

Clock = Literal["unix", "mjd", "scene"]

CURE = "give HDF5, a FITS table, CSV or an antenna log of ASTE"

Columns = Mapping[str, tuple[Any, str | None]]
"""By name in small letters: values and unit."""


@dataclass
class RecordedTable:
    """Content of a file.

    Attributes
    ----------
    columns
        Those of one number per row.
    start
        What a column ``seconds`` counts from, where the file says it.
    bits
        What the column of flags has: TOAST's bits, those of files that an earlier zonda wrote, or
        anything.
    radec
        (n, 4) `Recording.radec`.
    intervals
        (2, n) each, as ``times`` count or, ``in_seconds``, as ``seconds`` do.
    """

    columns: Columns
    start: Instant | None = None
    bits: Literal["toast", "before", "any"] = "any"
    radec: Floats | None = None
    intervals: dict[str, Floats] = field(default_factory=dict)
    in_seconds: bool = False


def read_recording(path: Path, clock: Clock, mask: int | None = None) -> Recording:
    """Read a recording.

    Parameters
    ----------
    clock
        What its times count, where the file does not carry its own start.
    mask
        Bits of a flag that exclude a sample; None: TOAST's 15 in TOAST's layout, any bit in other
        files.

    Raises
    ------
    InputError
        Unreadable, without the columns, without units, or with directions that cannot be.
    """
    place = f"recorded pointing {path}"
    try:
        with path.open("rb") as file:
            magic = file.read(9)
        if magic == BEGINS:
            start, seconds, azimuth, elevation, bits = read_log(path, place)
            _check_latitude(elevation, "el", place)
            return Recording(
                start, seconds, azimuth, elevation, "azel", _flags(bits, "toast", mask)
            )
        kind = (
            _hdf5
            if magic.startswith(b"\x89HDF")
            else _fits
            if magic.startswith(b"SIMPLE  =")
            else _csv
        )
        return _recording(kind(path, place), clock, mask, place)
    except OSError as err:
        raise InputError(f"cannot be read: {err}", place=place, cure=CURE) from None


def _csv(path: Path, place: str) -> RecordedTable:
    """Text: columns with commas, semicolons, tabs or blanks between them, under a line of their
    names and units.
    """
    with reading(
        place,
        "CSV",
        "write rows of equally many numbers, under a line such as: time [s], az [deg], el [deg]",
    ):
        text = path.read_text(encoding="utf-8-sig")  # spreadsheets begin with a byte order mark
    header, _, rest = text.partition("\n")
    header = header.lstrip("# ").strip()
    mark = max(",;\t", key=header.count)
    comma = mark if mark in header else None
    words = header.split(comma) if comma else re.findall(r"\S+(?:\s*[\[(][^\])]*[\])])?", header)
    names = [_heading(word) for word in words]
    try:
        table = np.genfromtxt(rest.splitlines(), delimiter=comma, ndmin=2)
    except ValueError as err:
        raise InputError(
            f"cannot be read as CSV: {err}", place=place, cure="write rows of equally many numbers"
        ) from None
    if table.size == 0 or table.shape[1] != len(names):
        raise InputError(
            f"the first line names {len(names)} columns, the rows have"
            f" {table.shape[1] if table.size else 0}",
            place=place,
            cure="begin with a line such as: time [s], az [deg], el [deg]",
        )
    found = RecordedTable({name: (table[:, k], unit) for k, (name, unit) in enumerate(names)})
    for k, (name, _) in enumerate(names):
        if name in ALIASES["time"] and np.isnan(table[:, k]).all():
            texts = [
                line.split(comma)[k].strip().strip("\"'")
                for line in rest.splitlines()
                if line.strip()
            ]
            found.start, seconds = _dates(texts, place)
            found.columns = {**found.columns, name: (seconds, "s"), "seconds": (seconds, "s")}
            break
    return found


def _heading(text: str) -> tuple[str, str | None]:
    """Name in small letters and unit of ``az [deg]``, ``Azimuth(deg)``, ``az_deg`` or ``az``."""
    match = re.fullmatch(r"(.*?)\s*[\[(](.*?)[\])]", text.strip())
    known = {name for names in ALIASES.values() for name in names}
    if match is None:
        behind = re.fullmatch(r"(.*?)[_ .](\w+)", text.strip())
        match = (
            behind if behind and behind[1].lower() in known and behind[2].lower() in UNITS else None
        )
    name, unit = (match[1], match[2].strip()) if match else (text, "")
    plain = name.strip().strip("\"'").lower().replace(" ", "_")
    return plain, UNITS.get(unit.lower(), unit) or None


def _dates(texts: list[str], place: str) -> tuple[Instant, Floats]:
    """A whole second next to the first of dates (ISO 8601, UTC), and seconds since then; NaN for an
    empty text.
    """
    plain = [re.sub(r"(Z|[+-]00:?00)$", "", text) for text in texts]
    wrong = next(
        (text for text, p in zip(texts, plain, strict=True) if p and not ISO.fullmatch(p)), None
    )
    if wrong is not None or not any(plain):
        what = (
            f"time is {wrong!r}, no date"
            if wrong is not None
            else "has no time that is a number or a date"
        )
        raise InputError(
            what,
            place=place,
            cure="write dates as 2024-11-25T07:00:00.5 (UTC), or seconds since 1970",
        )
    with reading(place, "CSV", "write dates as 2024-11-25T07:00:00.5 (UTC)"):
        instants = np.array([p.replace(" ", "T") or "NaT" for p in plain], "datetime64[ns]")
    first = instants[~np.isnat(instants)][0].astype("datetime64[s]")
    seconds = (instants - first) / np.timedelta64(1, "s")
    return Instant(int(first.astype(np.int64)) * SECOND), np.asarray(seconds, np.float64)


def _fits(path: Path, place: str) -> RecordedTable:
    from astropy.io import fits

    with fits_files.opened(path, place, CURE) as file:
        for table in file:
            fits_files.check_size(table, place)
            names = (
                {name.lower() for name in getattr(table.columns, "names", [])}
                if isinstance(table, fits.BinTableHDU)
                else set()
            )
            if any(names >= {a, b} for a in ALIASES["az"] for b in ALIASES["el"]) or names >= {
                "ra",
                "dec",
            }:
                columns = {
                    c.name.lower(): (np.asarray(table.data[c.name], np.float64), c.unit)
                    for c in table.columns
                    if c.dim is None
                    and np.asarray(table.data[c.name]).ndim == 1
                    and np.asarray(table.data[c.name]).dtype.kind in "fiub"
                }
                start = file[0].header.get("DATE-OBS") if "seconds" in columns else None
                found = RecordedTable(
                    columns, Instant.parse(start) if start else None, in_seconds=True
                )
                if names >= {"boresight_azel", "boresight_radec"}:  # SaveTOD's
                    found.bits = "toast" if "FLAGBITS" in table.header else "before"
                    _check_rotation(table.data["BORESIGHT_AZEL"], place)
                    found.radec = np.asarray(table.data["BORESIGHT_RADEC"], np.float64)
                    found.intervals = (
                        _fits_intervals(file["INTERVALS"].data) if "INTERVALS" in file else {}
                    )
                return found
    raise InputError(
        "has no table with az and el, or ra and dec",
        place=place,
        cure="name the columns TIME, AZ and EL",
    )


def _hdf5(path: Path, place: str) -> RecordedTable:
    import h5py

    with hdf5_files.opened(path, place, "HDF5", CURE) as file:
        toast = "shared" in file
        group = file["shared"] if toast else file.get("pointing", file)
        columns: dict[str, tuple[Any, str | None]] = {}
        for name, values in group.items():
            if (
                not isinstance(values, h5py.Dataset)
                or values.ndim != 1
                or values.dtype.kind not in "fiub"
            ):
                continue
            hdf5_files.check_size(values, place)
            unit = values.attrs.get("units", values.attrs.get("unit"))
            known = next((ours for ours, names in ALIASES.items() if name.lower() in names), None)
            si = (
                {"time": "s", "seconds": "s", "az": "rad", "el": "rad"}.get(known or "")
                if toast
                else None
            )
            columns[name.lower()] = (values[:], str(unit) if unit is not None else si)
        found = RecordedTable(columns)
        if toast:
            other = file["metadata/other"].attrs if "metadata/other" in file else {}
            start = other.get("zonda_start_utc")
            found.start = Instant.parse(str(start)) if start is not None else None
            found.bits = "before" if start is not None and "zonda_flags" not in other else "toast"
            parts = (
                file["intervals"].items() if isinstance(file.get("intervals"), h5py.Group) else ()
            )
            for dataset in (
                group.get("boresight_azel"),
                group.get("boresight_radec"),
                *(spans for _, spans in parts),
            ):
                if isinstance(dataset, h5py.Dataset):
                    hdf5_files.check_size(dataset, place)
            if "boresight_azel" in group:
                _check_rotation(group["boresight_azel"], place)
            if (
                isinstance(radec := group.get("boresight_radec"), h5py.Dataset)
                and radec.dtype.kind == "f"
            ):
                found.radec = np.asarray(radec[()], np.float64)
            kept = (
                (name, spans)
                for name, spans in parts
                if isinstance(spans, h5py.Dataset) and spans.dtype.kind in "fiu"
            )
            found.intervals = {name: np.asarray(spans[()], np.float64) for name, spans in kept}
        return found


def _fits_intervals(rows: Any) -> dict[str, Floats]:
    """Intervals of SaveTOD's table: (2, n) by name."""
    if not {"NAME", "START", "STOP"} <= set(rows.names):
        return {}
    names = np.asarray(rows["NAME"]).astype(str)
    spans = np.array([rows["START"], rows["STOP"]], np.float64)
    return {str(name): spans[:, names == name] for name in dict.fromkeys(names)}


def _check_rotation(quaternions: Any, place: str) -> None:
    """Raise InputError for a boresight that is rotated about itself: azimuth and elevation alone do
    not follow it.
    """
    x, y, z, w = np.asarray(quaternions[:], np.float64).T
    psi = np.arctan2(y * z + w * x, -(x * z - w * y))
    turned = float(np.abs(psi[np.isfinite(psi)]).max(initial=0.0))
    if turned > 1e-6:
        raise InputError(
            f"the boresight is rotated by up to {np.degrees(turned):.3g} deg about itself, which"
            " this step does not follow",
            place=place,
            cure=(
                "use LoadTOD: {file: ..., signal: none} in its place: the pointing alone, with the"
                " rotation"
            ),
        )


def _recording(table: RecordedTable, clock: Clock, mask: int | None, place: str) -> Recording:
    columns, start = table.columns, table.start
    found = {
        ours: columns[name] for ours, names in ALIASES.items() for name in names if name in columns
    }
    frame: Literal["azel", "icrs"] = "azel" if {"az", "el"} <= set(found) else "icrs"
    which = ("az", "el") if frame == "azel" else ("ra", "dec")
    lacks = [name for name in which if name not in found] + ["time"] * (
        not {"time", "seconds"} & set(found)
    )
    if lacks:
        there = ", ".join(columns) or "none"
        raise InputError(
            f"has no column {' and '.join(lacks)}; columns: {there}",
            place=place,
            cure="name them time, az and el",
        )
    longitude, latitude = (_in_si(*found[name], "rad", name, place) for name in which)
    _check_latitude(latitude, which[1], place)
    if start is not None and "seconds" in found:
        seconds = _in_si(*found["seconds"], "s", "seconds", place)
    else:
        seconds, start = _times(*found["time" if "time" in found else "seconds"], clock, place)
    if table.radec is not None and table.radec.shape != (len(seconds), 4):
        shape = " x ".join(map(str, table.radec.shape))
        raise InputError(
            f"boresight_radec is {shape}, not {len(seconds)} x 4",
            place=place,
            cure="save the file again",
        )
    radec = table.radec if frame == "azel" else None
    times = (
        seconds
        if table.in_seconds or "time" not in found
        else np.asarray(found["time"][0], np.float64)
    )
    parts = _intervals(table.intervals, times, seconds, place)
    bits, trimmed = (
        np.zeros(len(seconds), np.uint8),
        _within(parts.pop(flags.TRIMMED_INTERVALS, []), seconds),
    )
    if "flags" in found:
        bits = _flags(found["flags"][0], table.bits, mask, trimmed)
    return Recording(start, seconds, longitude, latitude, frame, bits, radec, parts)


def _check_latitude(latitude: Floats, name: str, place: str) -> None:
    """Raise InputError for an elevation or a declination beyond 90 deg."""
    if (worst := np.nanmax(np.abs(latitude), initial=0.0)) > np.pi / 2 + 1e-9:
        row = int(np.nanargmax(np.abs(latitude)))
        raise InputError(
            f"{name} is {np.degrees(worst):.6g} deg in row {row}",
            place=place,
            cure="check its unit",
        )


def _within(spans: list[tuple[float, float]], seconds: Floats) -> NDArray[np.bool_]:
    """(n,) which rows lie in the intervals."""
    last = np.nanmax(seconds, initial=-np.inf)
    inside = [(seconds >= a) & ((seconds < b) | (b >= last)) for a, b in spans]
    return np.any(inside, axis=0) if inside else np.zeros(len(seconds), np.bool_)


def _flags(
    values: Any,
    bits: Literal["toast", "before", "any"],
    mask: int | None,
    trimmed: NDArray[np.bool_] | None = None,
) -> NDArray[np.uint8]:
    """Flags in bits of `core.flags`. A value that is not a number excludes the sample."""
    number = np.asarray(values, np.float64)
    whole = np.where(np.isfinite(number), number, 255).astype(np.int64)
    if bits == "any":
        excluded = number != 0 if mask is None else (whole & mask) != 0
        return np.where(excluded, flags.INVALID, 0).astype(np.uint8)
    byte = (whole & 255).astype(np.uint8)
    if bits == "before":
        byte = flags.of_before(byte, samples=True)
        trimmed = np.ones(len(byte), np.bool_)
    return flags.from_file(byte, flags.SAMPLE_MASK if mask is None else mask, trimmed)


def _intervals(
    given: Mapping[str, Floats], times: Floats, seconds: Floats, place: str
) -> Intervals:
    """Intervals that count as ``times`` (n,), in order and in ``seconds``; of times that samples
    have to the last bit.
    """
    finite = np.flatnonzero(np.isfinite(times) & np.isfinite(seconds))
    rows = finite[longest_rising(times[finite])]
    found: Intervals = {}
    for name, spans in given.items():
        if spans.ndim != 2 or spans.shape[0] != 2 or not np.isfinite(spans).all():
            raise InputError(
                f"the intervals {name} are no times of start and stop",
                place=place,
                cure="save the file again",
            )
        if len(rows):
            begin, end = (np.interp(t, times[rows], seconds[rows]).tolist() for t in spans)
            found[name] = sorted((a, b) for a, b in zip(begin, end, strict=True) if b > a)
    return found


def _times(
    values: Any, unit: str | None, clock: Clock, place: str
) -> tuple[Floats, Instant | None]:
    """Seconds, and what they count from: a whole second or day next to the first, so that
    differences are exact.
    """
    days = clock == "mjd"
    times = (
        np.asarray(values, np.float64) if days else _in_si(values, unit or "s", "s", "time", place)
    )
    if clock == "scene":
        return times, None
    finite = times[np.isfinite(times)]
    if not len(finite):
        raise InputError(
            "has no time that is a number", place=place, cure="check the column of times"
        )
    first = int(np.floor(finite[0]))
    since = first * SECOND if not days else (first - 40587) * 86400 * SECOND
    try:
        start = Instant(since)
        year = start.datetime.year
    except (OverflowError, ValueError):
        year = 0
    if not 1980 <= year <= 2150:
        raise InputError(
            f"the first time, {finite[0]:.10g}, is not a plausible date as"
            f" {'an MJD' if days else 'seconds since 1970'}",
            place=place,
            cure=(
                "set clock: unix (seconds since 1970), mjd, or scene (seconds since the scene's"
                " time)"
            ),
        )
    return (times - first) * (86400.0 if days else 1.0), start


def _in_si(values: Any, unit: str | None, si: str, name: str, place: str) -> Floats:
    if not unit:
        raise InputError(
            f"{name} has no unit",
            place=place,
            cure=f"write one, e.g. {name} [deg] in the first line of a CSV",
        )
    factor = factor_to(si, unit)
    if factor is None:
        raise InputError(
            f"{unit!r} is no unit of {name}",
            place=place,
            cure=f"use {'deg or rad' if si == 'rad' else 's'}",
        )
    return np.asarray(values, np.float64) * factor
