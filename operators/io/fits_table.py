"""Time-ordered data as FITS binary tables: ``TOD`` (one row per detector), ``SAMPLES``,
``DETECTORS``, ``PROVENANCE``, ``INTERVALS``."""

from __future__ import annotations

import io
import json
import os
import threading
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits

from zonda.core.errors import InputError
from zonda.core.maps.map_file import ascii_text
from zonda.core.storage.files import UNPACKED_MAX, AnyPath, is_packed, unpacked, writing
from zonda.core.storage.fits_files import check_size, opened, table_bytes
from zonda.core.stream import UNITS
from zonda.core.types import AnyFloats, Floats, Indices
from zonda.core.weather import GroundWeather

from .time_ordered_data import OF_DETECTORS, TimeOrderedData, TodWriter
from .toast_hdf5 import COLUMNS

SUFFIX = ".fits"

TABLES = ("TOD", "SAMPLES", "DETECTORS", "PROVENANCE")
CURE = "give a file that SaveTOD wrote, whole"

SAMPLES = (  # column, format, unit, ours
    ("SECONDS", "D", "s", "seconds"),
    ("TIME", "D", "s", "times"),
    ("AZ", "D", "rad", "azimuth"),
    ("EL", "D", "rad", "elevation"),
    ("BORESIGHT_AZEL", "4D", "", "boresight_azel"),
    ("BORESIGHT_RADEC", "4D", "", "boresight_radec"),
    ("FLAGS", "B", "", "flags"),
    ("HWP_ANGLE", "D", "rad", "hwp_angle"),
)
"""The table ``SAMPLES``; columns that a scan lacks are left out."""
DETECTORS = {"NAME", "QUAT", "XI", "ETA", "FLAGS"}
"""Columns of ``DETECTORS`` beside those of `TimeOrderedData.columns`."""
_WEATHER = (  # key, our name, unit, meaning
    ("WEATHERT", "time", "s", "POSIX time of the weather"),
    ("PWV", "pwv", "m", "precipitable water vapour at zenith"),
    ("PRESSURE", "pressure", "Pa", "at the ground"),
    ("TEMPAIR", "temperature", "K", "10 m above the ground"),
    ("TEMPGRND", "ground_temperature", "K", "at the ground"),
    ("HUMIDITY", "humidity", "", "specific, kg / kg, 10 m above the ground"),
    ("WINDEAST", "wind_east", "m/s", "towards east, 10 m above the ground"),
    ("WINDNRTH", "wind_north", "m/s", "towards north, 10 m above the ground"),
)


class Writer(TodWriter):
    """Writes one observation, streams in rectangles and in any order; same interface as
    `toast_hdf5.Writer`.

    The table ``TOD`` comes first, at a place known beforehand, so that rectangles go straight to
    their bytes; the tables ``SAMPLES``, ``DETECTORS`` (with the flags as they are at the end),
    ``PROVENANCE`` and ``INTERVALS`` are appended by `finish`.
    """

    def __init__(self, path: Path, tod: TimeOrderedData, streams: list[str], dtype: str) -> None:
        super().__init__(path, tod)
        self._dtype = np.dtype(dtype).newbyteorder(">")
        self._streams = list(streams)
        self._name_bytes = max(len(d.encode()) for d in tod.names)
        form = f"{tod.n_samples}{'D' if dtype == 'float64' else 'E'}"
        columns = [
            (s.upper(), form, UNITS.get(s, "K"), np.empty((0, tod.n_samples))) for s in streams
        ]
        table = _table("TOD", [("DETECTOR", f"{self._name_bytes}A", "", []), *columns])
        table.header["NAXIS2"] = tod.n_detectors
        primary = fits.PrimaryHDU(header=_primary_header(tod)).header
        head = (primary.tostring() + table.header.tostring()).encode("ascii")
        self._data_start = len(head)
        self._row = self._name_bytes + len(streams) * tod.n_samples * self._dtype.itemsize
        size = tod.n_detectors * self._row
        with writing(path):
            self._file = path.open("w+b")
            self._file.write(head)
            self._file.truncate(self._data_start + -(-size // 2880) * 2880)
            for d, name in enumerate(tod.names):
                self._file.seek(self._data_start + d * self._row)
                self._file.write(name.encode().ljust(self._name_bytes, b"\0"))

    def write(self, stream: str, detectors: slice, samples: slice, values: AnyFloats) -> None:
        """A rectangle of a stream."""
        column = (
            self._name_bytes
            + (self._streams.index(stream) * self.tod.n_samples + samples.start)
            * self._dtype.itemsize
        )
        rows = np.ascontiguousarray(values, self._dtype)
        with writing(self.path):
            for d, row in zip(range(detectors.start, detectors.stop), rows, strict=True):
                self._file.seek(self._data_start + d * self._row + column)
                self._file.write(row.tobytes())

    def _finish(self) -> None:
        self._file.seek(0, os.SEEK_END)
        for table in _tables(self.tod):
            self._file.write(table_bytes(table))

    def _close(self) -> None:
        self._file.close()


def _primary_header(tod: TimeOrderedData) -> fits.Header:
    header = fits.Header()
    site, latitude, longitude, altitude = tod.site
    header["OBJECT"] = (ascii_text(tod.name), "observation")
    header["TELESCOP"] = ascii_text(tod.telescope)
    header["SITE"] = ascii_text(site)
    header["SITELAT"] = (float(np.degrees(latitude)), "[deg] geodetic latitude")
    header["SITELON"] = (float(np.degrees(longitude)), "[deg] longitude, east positive")
    header["SITEALT"] = (float(altitude), "[m] height above the ellipsoid")
    header["DATE-OBS"] = (tod.start.rstrip("Z"), "UTC, start of the scan")
    header["TIMESYS"] = "UTC"
    header["SAMPRATE"] = (float(tod.sample_rate), "[Hz]")
    header["FOV"] = (float(np.degrees(tod.field_of_view)), "[deg] diameter")
    header["TEMPSCAL"] = ("K_RJ", "temperature scale of the streams")
    return header


def _table(name: str, columns: Iterable[tuple[str, str, str, Any]], comment: str = "") -> Any:
    """A table of (name, format, unit, values); an ``A`` without a number is as long as its longest
    text.
    """
    made = []
    for key, form, unit, values in columns:
        form = f"{max([len(v.encode()) for v in values] or [1])}A" if form == "A" else form
        made.append(fits.Column(key, form, unit=unit or None, array=values))
    table = fits.BinTableHDU.from_columns(made, name=name)
    if comment:
        table.header.add_comment(comment)
    return table


def _tables(tod: TimeOrderedData) -> Iterator[Any]:
    """Tables beside that of the streams."""
    known = tod.of_samples()
    samples = _table(
        "SAMPLES",
        [(name, form, unit, known[k]) for name, form, unit, k in SAMPLES if k in known],
    )
    samples.header["FLAGBITS"] = ("TOAST", "bits of FLAGS")
    for key, name, unit, meaning in _WEATHER if tod.weather is not None else ():
        value = getattr(tod.weather, name)
        samples.header[key] = (value, f"[{unit}] {meaning}" if unit else meaning)
    samples.header.add_comment(
        "SECONDS counts from DATE-OBS of the primary header; TIME is POSIX. Quaternions are x, y,"
        " z, w as TOAST's."
    )
    yield samples
    columns = [
        ("NAME", "A", "", tod.names),
        ("QUAT", "4D", "", tod.quats),
        ("XI", "D", "", tod.xi),
        ("ETA", "D", "", tod.eta),
        ("FLAGS", "B", "", tod.detector_flags),
        *((k.upper(), "D", COLUMNS[k][2], v) for k, v in tod.columns.items()),
    ]
    detectors = _table("DETECTORS", columns)
    detectors.header["FLAGBITS"] = ("TOAST", "bits of FLAGS")
    detectors.header.add_comment(
        "XI and ETA are tangents (a gnomonic plane); sotodlib's are sines."
    )
    yield detectors
    texts = list(tod.metadata), [json.dumps(value) for value in tod.metadata.values()]
    yield _table("PROVENANCE", [("KEY", "A", "", texts[0]), ("VALUE", "A", "", texts[1])])
    rows = [(name, *span) for name, spans in tod.intervals.items() for span in spans]
    names, starts, stops = zip(*rows, strict=True) if rows else ([], [], [])
    yield _table(
        "INTERVALS",
        [("NAME", "A", "", names), ("START", "D", "s", starts), ("STOP", "D", "s", stops)],
        "TOAST's names; START and STOP count as SECONDS.",
    )


class Reader:
    """An open file, as `toast_hdf5.Reader`; streams are read from their bytes.

    ``whole``: a compressed file is unpacked into memory.

    Raises
    ------
    InputError
        No such file, not FITS, one of the tables is missing, or the file is compressed.
    """

    def __init__(self, path: AnyPath, *, whole: bool = False) -> None:
        self.place = f"time-ordered data {path}"
        with opened(path, self.place, CURE) as file:
            for hdu in file:
                check_size(hdu, self.place, whole=hdu.name != "TOD")
            missing = [name for name in TABLES if name not in file]
            if missing:
                raise InputError(f"has no table {missing[0]}", place=self.place, cure=CURE)
            self.tod = _read(file)
            table = file["TOD"]
            columns = table.columns
            begin = table.fileinfo()["datLoc"]
            self._row = int(table.header["NAXIS1"])
            if int(table.header["NAXIS2"]) != self.tod.n_detectors:
                raise InputError(
                    "TOD and DETECTORS have other numbers of rows",
                    place=self.place,
                    cure=CURE,
                )
            self.tod.check(self.place)
            self.streams: dict[str, str] = {}
            self._at: dict[str, tuple[int, Any]] = {}
            for column in columns:
                kind = {"D": ">f8", "E": ">f4"}.get(column.format[-1:])
                if kind and (column.format[:-1] or "1") == str(self.tod.n_samples):
                    name = column.name.lower()
                    self.streams[name] = str(column.unit or "")
                    self._at[name] = begin + columns.dtype.fields[column.name][1], np.dtype(kind)
        self._lock = threading.Lock()
        self._file: Any = None
        if not is_packed(path):
            self._file = open(path, "rb", buffering=0)  # noqa: SIM115
        elif whole:
            content = unpacked(path, self.place, UNPACKED_MAX)
            self._file = io.BytesIO(content)
        else:
            text = "is compressed: its streams cannot be read in parts"
            raise InputError(text, place=self.place, cure="unpack it first")

    def read(self, stream: str, detectors: Indices, samples: slice) -> AnyFloats:
        """(n, m) values of a stream: rows ``detectors`` (n,) of the file, in its own units and
        type.
        """
        begin, kind = self._at[stream]
        found = np.empty((len(detectors), samples.stop - samples.start), kind)
        for row, detector in zip(found, detectors.tolist(), strict=True):
            with self._lock:
                self._file.seek(begin + detector * self._row + samples.start * kind.itemsize)
                size = self._file.readinto(row.data.cast("B"))
            if size != row.nbytes:
                raise InputError("is truncated", place=self.place, cure=CURE)
        return found.astype(kind.newbyteorder("="))

    def flags(self, detectors: Indices, samples: slice) -> None:
        """The file has no flags of single samples of detectors."""

    def noise(self, model: str | None, mask: int) -> dict[str, Floats]:
        """The file has no noise models. Raises InputError where one is asked for."""
        if model is not None:
            raise InputError(
                "is FITS, which has no noise models",
                place=self.place,
                cure="leave noise_model out",
            )
        return {}

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def _native(values: Any) -> Any:
    """The same numbers in the machine's order of bytes."""
    array = np.asarray(values)
    return array.astype(array.dtype.newbyteorder("="))


def _read(file: Any) -> TimeOrderedData:
    """Read everything but the streams."""
    header = file[0].header
    samples, detectors, provenance = (
        file[name].data for name in ("SAMPLES", "DETECTORS", "PROVENANCE")
    )
    about = file["SAMPLES"].header
    intervals = dict[str, list[tuple[float, float]]]()
    given = {k: _native(samples[name]) for name, _, _, k in SAMPLES if name in samples.names}
    given.pop("elevation", None)
    if "FLAGBITS" in about and "INTERVALS" not in file:
        raise KeyError("there is no table INTERVALS")
    for row in file["INTERVALS"].data if "INTERVALS" in file else ():
        intervals.setdefault(str(row["NAME"]), []).append((float(row["START"]), float(row["STOP"])))
    weather = (
        GroundWeather(**{name: float(about[key]) for key, name, _, _ in _WEATHER})
        if "WEATHERT" in about
        else None
    )
    tod = TimeOrderedData(
        name=header["OBJECT"],
        start=f"{str(header['DATE-OBS']).rstrip('Z')}Z",  # UTC: FITS writes no Z
        sample_rate=header["SAMPRATE"],
        telescope=header["TELESCOP"],
        field_of_view=float(np.radians(header["FOV"])),
        site=(
            header["SITE"],
            float(np.radians(header["SITELAT"])),
            float(np.radians(header["SITELON"])),
            header["SITEALT"],
        ),
        detector_flags=_native(detectors["FLAGS"]),
        names=[str(d) for d in detectors["NAME"]],
        quats=_native(detectors["QUAT"]),
        columns={
            c.lower(): _native(detectors[c])
            for c in detectors.names
            if c not in DETECTORS
            and (c.lower() in OF_DETECTORS or detectors[c].dtype.kind in "fiu")
        },
        intervals=intervals,
        weather=weather,
        metadata={
            str(key): json.loads(value)
            for key, value in zip(provenance["KEY"], provenance["VALUE"], strict=True)
        },
        offsets=np.stack([_native(detectors["XI"]), _native(detectors["ETA"])], axis=1),
        **given,
    )
    if "FLAGBITS" not in about:
        tod.update_flags()
    return tod
