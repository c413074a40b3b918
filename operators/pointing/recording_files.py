"""Recorded pointing in files: HDF5 (TOAST's layout and plain datasets), FITS tables, CSV and ASTE's
antenna logs.

The antenna logs of the ASTE telescope, as DESHIMA's observations have them (``.ant``), are text,
one row every 0.1 s. A line of names begins with ``#time``; rows have the UTC time
(``20171113070543.1``), 17 numbers in degrees and millimetres and what the telescope did. The beam
is where the programme without the pointing model's corrections wanted it, plus the error of
tracking (as DESHIMA's own package demerge takes it):

    azimuth = az-prog(no-cor) + az-real - az-prg,      the same for the elevation.          (1)
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from zonda.core import flags
from zonda.core.configuration.time import SECOND, Instant
from zonda.core.errors import InputError
from zonda.core.flags import Flags, Intervals
from zonda.core.storage import fits_files, hdf5_files
from zonda.core.storage.files import reading
from zonda.core.storage.table_files import Table, read_table, read_text
from zonda.core.types import Bools, Floats

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

TOAST_UNITS = {"time": "s", "seconds": "s", "az": "rad", "el": "rad"}
"""Of TOAST's layout, which does not state them."""

STATES = {"SCAN": 0, "ON": 0, "ACC": flags.TURNAROUND, "TRAN": flags.TURNAROUND}
"""What ASTE did, and the flags of such a row; of others: `flags.IRREGULAR` (slews, off-source
positions). The row "END" is no measurement.
"""

Clock = Literal["unix", "mjd", "scene"]

CURE = "give HDF5, a FITS table, CSV or an antenna log of ASTE"


@dataclass
class RecordedTable:
    """Columns, start time and flags of one file of recorded pointing.

    Attributes
    ----------
    table
        Columns of one number per row, by their names in small letters.
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

    table: Table
    start: Instant | None = None
    bits: Literal["toast", "before", "any"] = "any"
    radec: Floats | None = None
    intervals: dict[str, Any] = field(default_factory=dict)
    in_seconds: bool = False

    @classmethod
    def of(cls, columns: Mapping[str, tuple[NDArray[Any], str]], place: str) -> RecordedTable:
        """Build the table from arrays with units: those with one number per row become columns."""
        plain: dict[str, tuple[Any, str]] = {
            name: (values, unit)
            for name, (values, unit) in columns.items()
            if values.ndim == 1 and values.dtype.kind in "fiub"
        }
        plain |= {  # times may be dates
            name: ([str(text) for text in values.tolist()], unit)
            for name, (values, unit) in columns.items()
            if values.ndim == 1 and values.dtype.kind == "U"
        }
        lines = [0] * (1 + max((len(values) for values, _ in plain.values()), default=0))
        found = cls(Table(place, plain, lines))
        if "boresight_azel" in columns:
            _check_rotation(columns["boresight_azel"][0], place)
        if "boresight_radec" in columns:
            found.radec = np.asarray(columns["boresight_radec"][0], np.float64)
        return found


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
    with reading(place, "a recording", CURE), path.open("rb") as file:
        magic = file.read(9)
    kinds = ((b"#time ra-", _antenna_log), (b"\x89HDF", _hdf5), (b"SIMPLE  =", _fits), (b"", _text))
    read = next(read for begins, read in kinds if magic.startswith(begins))
    with reading(place, "a recording", CURE):
        return _recording(read(path, place), clock, mask, place)


def _text(path: Path, place: str) -> RecordedTable:
    """Text (CSV, ECSV, IPAC, VOTable): names as ``az [deg]``, ``Azimuth(deg)``, ``az_deg`` or
    ``az``; times as numbers or dates.
    """
    table = read_table(path, place)
    table.rename(ALIASES)
    return _dated(RecordedTable(table))


def _dated(found: RecordedTable) -> RecordedTable:
    """The table with times that are dates as ``seconds``, from a whole second before the first."""
    table = found.table
    for name in ALIASES["time"]:
        if name in table.columns and np.isnan(table.values(name)).all():
            times = table.instants(name, optional=True)
            first = next((time.nanoseconds for time in times if time), 0) // SECOND * SECOND
            if not first:
                table.note(-1, f"{name} has no number and no date", "write seconds since 1970")
            table.check()
            seconds = [np.nan if t is None else (t.nanoseconds - first) / SECOND for t in times]
            found.start = Instant(first)
            table.columns = {**table.columns, **dict.fromkeys((name, "seconds"), (seconds, "s"))}
    return found


def _antenna_log(path: Path, place: str) -> RecordedTable:
    """A log of ASTE. Two column names of its files are mended: one says `prog` for `prg`, that of
    el-prog(center) is missing.
    """
    text = read_text(path, place).replace("(center) type", "(center) el-prog(center) type", 1)
    table = read_table(path, place, text)
    states = table.texts("type")
    rows = [row for row, state in enumerate(states) if state != "END"]
    table.lines = [table.lines[row] for row in (*rows, -1)]
    table.columns = {
        name.replace("prog(no-cor)", "prg(no-cor)"): ([texts[row] for row in rows], unit)
        for name, (texts, unit) in table.columns.items()
    }
    if not rows:
        table.note(None, "has no row of a scan", "give the log of another observation")
    wanted, real, own = (
        [np.radians(table.numbers(f"{axis}-{kind}")) for axis in ("az", "el")]
        for kind in ("prg", "real", "prg(no-cor)")
    )
    table.check()
    late = (real[0] - wanted[0] + np.pi) % (2 * np.pi) - np.pi  # within half a turn
    bits = [STATES.get(states[row], flags.IRREGULAR) for row in rows]
    dates = [
        f"{t[:4]}-{t[4:6]}-{t[6:8]}T{t[8:10]}:{t[10:12]}:{t[12:]}" for t in table.texts("time")
    ]
    table.columns = {
        "time": (dates, ""),
        "az": (own[0] + late, "rad"),
        "el": (own[1] + real[1] - wanted[1], "rad"),
        "flags": (np.array(bits), ""),
    }
    return _dated(RecordedTable(table, bits="toast"))


def _fits(path: Path, place: str) -> RecordedTable:
    from astropy.io import fits

    with fits_files.opened(path, place, CURE) as file:
        for hdu in file:
            fits_files.check_size(hdu, place)
            columns = hdu.columns if isinstance(hdu, fits.BinTableHDU) else ()
            names = {column.name.lower() for column in columns}
            azel = any(names >= {a, b} for a in ALIASES["az"] for b in ALIASES["el"])
            if not azel and not names >= {"ra", "dec"}:
                continue
            given = {
                c.name.lower(): (np.asarray(hdu.data[c.name]), str(c.unit or "")) for c in columns
            }
            found = _dated(RecordedTable.of(given, place))
            found.in_seconds = True
            start = file[0].header.get("DATE-OBS")
            if "seconds" in names and start:
                found.start = Instant.parse(start)
            if found.radec is not None:  # SaveTOD's
                found.bits = "toast" if "FLAGBITS" in hdu.header else "before"
                spans: dict[str, list[Any]] = {}
                for row in file["INTERVALS"].data if "INTERVALS" in file else ():
                    spans.setdefault(str(row["NAME"]), []).append([row["START"], row["STOP"]])
                found.intervals = {name: np.array(rows).T for name, rows in spans.items()}
            return found
    raise InputError(
        "has no table with az and el, or ra and dec",
        place=place,
        cure="name the columns TIME, AZ and EL",
    )


def _hdf5(path: Path, place: str) -> RecordedTable:
    import h5py

    def read(item: Any) -> Any:
        """The numbers of a data set; None for something else."""
        if not isinstance(item, h5py.Dataset) or item.dtype.kind not in "fiub":
            return None
        hdf5_files.check_size(item, place)
        return item[()]

    with hdf5_files.opened(path, place, "HDF5", CURE) as file:
        toast = "shared" in file
        group = file["shared"] if toast else file.get("pointing", file)
        ours = {name: our for our, names in ALIASES.items() for name in names}
        columns = {}
        for name, item in group.items():
            if (values := read(item)) is not None:
                si = TOAST_UNITS.get(ours.get(name.lower(), ""), "") if toast else ""
                unit = item.attrs.get("units", item.attrs.get("unit", si))
                columns[name.lower()] = (np.asarray(values), str(unit))
        found = RecordedTable.of(columns, place)
        if toast:
            other = file["metadata/other"].attrs if "metadata/other" in file else {}
            start = other.get("zonda_start_utc")
            found.start = Instant.parse(str(start)) if start is not None else None
            found.bits = "before" if start is not None and "zonda_flags" not in other else "toast"
            spans = {name: read(item) for name, item in file.get("intervals", {}).items()}
            found.intervals = {name: v for name, v in spans.items() if v is not None}
        return found


def _check_rotation(quaternions: Any, place: str) -> None:
    """Raise InputError for a boresight that is rotated about itself: azimuth and elevation alone do
    not follow it.
    """
    x, y, z, w = np.asarray(quaternions, np.float64).T
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


def _recording(given: RecordedTable, clock: Clock, mask: int | None, place: str) -> Recording:
    table = given.table
    start = given.start
    found = {
        ours: name for ours, names in ALIASES.items() for name in names if name in table.columns
    }
    frame: Literal["azel", "icrs"] = "azel" if {"az", "el"} <= set(found) else "icrs"
    which = ("az", "el") if frame == "azel" else ("ra", "dec")
    lacks = [name for name in which if name not in found]
    lacks += ["time"] * (not {"time", "seconds"} & set(found))
    if lacks:
        there = ", ".join(table.columns) or "none"
        raise InputError(
            f"has no column {' and '.join(lacks)}; columns: {there}",
            place=place,
            cure="name them time, az and el",
        )
    longitude, latitude = (
        table.angles(found[name], hours=name == "ra", gaps=True) for name in which
    )
    times: dict[str, Floats] = {}
    for name in {"time", "seconds"} & set(found):
        factor = 1.0 if clock == "mjd" else table.factor(found[name], "s", "s")
        times[name] = table.values(found[name]) * factor
    table.check()
    _check_latitude(latitude, which[1], place)
    if start is not None and "seconds" in found:
        seconds = times["seconds"]
    else:
        seconds, start = _times(times["time" if "time" in times else "seconds"], clock, place)
    if not len(longitude) == len(latitude) == len(seconds):
        cure = "give time, az and el of each instant"
        raise InputError("its columns have different lengths", place=place, cure=cure)
    if given.radec is not None and given.radec.shape != (len(seconds), 4):
        shape = " x ".join(map(str, given.radec.shape))
        raise InputError(
            f"boresight_radec is {shape}, not {len(seconds)} x 4",
            place=place,
            cure="save the file again",
        )
    counted = seconds if given.in_seconds else times.get("time", seconds)
    parts = _intervals(given.intervals, counted, seconds, place)
    trimmed = _within(parts.pop(flags.TRIMMED_INTERVALS, []), seconds)
    bits = np.zeros(len(seconds), np.uint8)
    if "flags" in found:
        bits = _flags(table.values(found["flags"]), given.bits, mask, trimmed)
    radec = given.radec if frame == "azel" else None
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


def _within(spans: list[tuple[float, float]], seconds: Floats) -> Bools:
    """(n,) which rows lie in the intervals."""
    last = np.nanmax(seconds, initial=-np.inf)
    inside = [(seconds >= a) & ((seconds < b) | (b >= last)) for a, b in spans]
    return np.any(inside, axis=0) if inside else np.zeros(len(seconds), np.bool_)


def _flags(
    number: Floats,
    bits: str,
    mask: int | None,
    trimmed: Bools,
) -> Flags:
    """Flags in bits of `core.flags`. A value that is not a number excludes the sample."""
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
    given: Mapping[str, Floats],
    times: Floats,
    seconds: Floats,
    place: str,
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


def _times(times: Floats, clock: Clock, place: str) -> tuple[Floats, Instant | None]:
    """Seconds, and what they count from: a whole second or day next to the first, so that
    differences are exact.
    """
    if clock == "scene":
        return times, None
    finite = times[np.isfinite(times)]
    if not len(finite):
        raise InputError(
            "has no time that is a number",
            place=place,
            cure="check the column of times",
        )
    first = int(np.floor(finite[0]))
    days = clock == "mjd"
    try:
        start = Instant((first - 40587) * 86400 * SECOND if days else first * SECOND)
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
