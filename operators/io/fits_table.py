"""Time-ordered data as FITS binary tables: ``TOD`` (one row per detector), ``SAMPLES``,
``DETECTORS``, ``PROVENANCE``, ``INTERVALS``."""

from __future__ import annotations

import contextlib
import json
import os
import threading
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.flags import PROCESSING, TRIMMED_INTERVALS, of_before
from zonda.core.intervals import Intervals, runs
from zonda.core.maps.map_file import ascii_text
from zonda.core.storage import packed
from zonda.core.storage.files import writing
from zonda.core.storage.fits_files import check_size, opened, table_bytes
from zonda.core.stream_names import UNITS
from zonda.core.types import AnyFloats, Floats
from zonda.core.weather import GroundWeather

from .time_ordered_data import TimeOrderedData
from .toast_hdf5 import tod_azimuth_elevation

SUFFIX = ".fits"

TABLES = ("TOD", "SAMPLES", "DETECTORS", "PROVENANCE")
CURE = "give a file that SaveTOD wrote, whole"

_DETECTOR_UNITS = {
    "fwhm": "rad",
    "polarization_angle": "rad",
    "band_centre": "Hz",
    "band_width": "Hz",
    "net": "K s(1/2)",
    "knee": "Hz",
    "minimum_frequency": "Hz",
}


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


class Writer:
    """Writes one observation, streams in rectangles and in any order; same interface as
    `toast_hdf5.Writer`.

    The table ``TOD`` comes first, at a place known beforehand, so that rectangles go straight to
    their bytes; the tables ``SAMPLES``, ``DETECTORS`` (with the flags as they are at the end),
    ``PROVENANCE`` and ``INTERVALS`` are appended by `finish`.
    """

    def __init__(self, path: Path, tod: TimeOrderedData, streams: list[str], dtype: str) -> None:
        from astropy.io import fits

        self.path, self._tod = path, tod
        self._dtype = np.dtype(dtype).newbyteorder(">")
        self._streams = list(streams)
        self._name_bytes = max(len(d.encode()) for d in tod.names)
        n, code = tod.n_samples, {"float64": "D", "float32": "E"}[dtype]
        columns = [fits.Column("DETECTOR", f"{self._name_bytes}A")]
        columns += [
            fits.Column(s.upper(), f"{n}{code}", unit=UNITS.get(s, "K") or None) for s in streams
        ]
        table = fits.BinTableHDU.from_columns(columns, nrows=0, name="TOD")
        table.header["NAXIS2"] = tod.n_detectors
        primary = fits.PrimaryHDU(header=_primary_header(tod)).header
        head = (primary.tostring() + table.header.tostring()).encode("ascii")
        self._data_start = len(head)
        self._row = self._name_bytes + len(streams) * n * self._dtype.itemsize
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
            + (self._streams.index(stream) * self._tod.n_samples + samples.start)
            * self._dtype.itemsize
        )
        rows = np.ascontiguousarray(values, self._dtype)
        with writing(self.path):
            for d, row in zip(range(detectors.start, detectors.stop), rows, strict=True):
                self._file.seek(self._data_start + d * self._row + column)
                self._file.write(row.tobytes())

    def finish(self) -> None:
        """Append the other tables and close the file."""
        with writing(self.path):
            try:
                self._file.seek(0, os.SEEK_END)
                for table in (
                    _samples_table,
                    _detectors_table,
                    _provenance_table,
                    _intervals_table,
                ):
                    self._file.write(table_bytes(table(self._tod)))
            finally:
                self._file.close()

    def close(self) -> None:
        """Close an unfinished file."""
        with contextlib.suppress(OSError):  # nothing is lost: the caller removes the file
            self._file.close()


def _primary_header(tod: TimeOrderedData) -> Any:
    from astropy.io import fits

    header = fits.Header()
    site, latitude, longitude, altitude = tod.site
    header["OBJECT"] = (ascii_text(tod.name), "observation")
    header["TELESCOP"] = ascii_text(tod.telescope)
    header["SITE"] = ascii_text(site)
    header["SITELAT"] = (float(np.degrees(latitude)), "[deg] geodetic latitude")
    header["SITELON"] = (float(np.degrees(longitude)), "[deg] longitude, east positive")
    header["SITEALT"] = (float(altitude), "[m] height above the ellipsoid")
    header["DATE-OBS"] = (tod.start, "UTC, start of the scan")
    header["TIMESYS"] = "UTC"
    header["SAMPRATE"] = (float(tod.sample_rate), "[Hz]")
    header["FOV"] = (float(np.degrees(tod.field_of_view)), "[deg] diameter")
    header["TEMPSCAL"] = ("K_RJ", "temperature scale of the streams")
    return header


def _samples_table(tod: TimeOrderedData) -> Any:
    from astropy.io import fits

    azimuth, elevation = tod_azimuth_elevation(tod)
    pointing = [
        ("AZ", "D", "rad", azimuth),
        ("EL", "D", "rad", elevation),
        ("BORESIGHT_AZEL", "4D", None, tod.boresight_azel),
        ("BORESIGHT_RADEC", "4D", None, tod.boresight_radec),
    ]
    column = fits.Column
    columns = [
        column("SECONDS", "D", unit="s", array=tod.seconds),
        column("TIME", "D", unit="s", array=tod.times),
        *(
            column(name, kind, unit=unit, array=values)
            for name, kind, unit, values in pointing
            if len(values)
        ),
        column("FLAGS", "B", array=tod.flags),
        *(
            []
            if tod.hwp_angle is None
            else [column("HWP_ANGLE", "D", unit="rad", array=tod.hwp_angle)]
        ),
    ]
    table = fits.BinTableHDU.from_columns(columns, name="SAMPLES")
    table.header["FLAGBITS"] = ("TOAST", "bits of FLAGS")
    for key, name, unit, meaning in _WEATHER if tod.weather is not None else ():
        table.header[key] = (getattr(tod.weather, name), f"[{unit}] {meaning}" if unit else meaning)
    table.header.add_comment(
        "SECONDS counts from DATE-OBS of the primary header; TIME is POSIX. Quaternions are x, y,"
        " z, w as TOAST's."
    )
    return table


def _intervals_table(tod: TimeOrderedData) -> Any:
    from astropy.io import fits

    rows = [(name, *span) for name, spans in tod.intervals.items() for span in spans]
    width = max([len(name) for name in tod.intervals] or [1])
    columns = [
        fits.Column("NAME", f"{width}A", array=[row[0] for row in rows]),
        fits.Column("START", "D", unit="s", array=[row[1] for row in rows]),
        fits.Column("STOP", "D", unit="s", array=[row[2] for row in rows]),
    ]
    table = fits.BinTableHDU.from_columns(columns, name="INTERVALS")
    table.header.add_comment("TOAST's names; START and STOP count as SECONDS.")
    return table


def _detectors_table(tod: TimeOrderedData) -> Any:
    from astropy.io import fits

    column = fits.Column
    columns = [
        column("NAME", f"{max(len(d.encode()) for d in tod.names)}A", array=tod.names),
        column("QUAT", "4D", array=tod.quats),
        column("XI", "D", array=tod.xi),
        column("ETA", "D", array=tod.eta),
        column("FLAGS", "B", array=tod.detector_flags),
    ]
    columns += [
        column(k.upper(), "D", unit=_DETECTOR_UNITS.get(k), array=v) for k, v in tod.columns.items()
    ]
    table = fits.BinTableHDU.from_columns(columns, name="DETECTORS")
    table.header["FLAGBITS"] = ("TOAST", "bits of FLAGS")
    table.header.add_comment("XI and ETA are tangents (a gnomonic plane); sotodlib's are sines.")
    return table


def _provenance_table(tod: TimeOrderedData) -> Any:
    from astropy.io import fits

    keys, values = list(tod.metadata), [json.dumps(v) for v in tod.metadata.values()]
    columns = [
        fits.Column(name, f"{max(map(len, [*texts, ' ']))}A", array=texts)
        for name, texts in (("KEY", keys), ("VALUE", values))
    ]
    return fits.BinTableHDU.from_columns(columns, name="PROVENANCE")


class Reader:
    """An open file, as `toast_reading.Reader`; streams are read from their bytes.

    Raises
    ------
    InputError
        No such file, not FITS, one of the tables is missing, or the file is compressed.
    """

    def __init__(self, path: str | os.PathLike[str]) -> None:
        self.place = f"time-ordered data {path}"
        with opened(path, self.place, CURE) as file:
            for hdu in file:
                check_size(hdu, self.place, whole=hdu.name != "TOD")
            missing = [name for name in TABLES if name not in file]
            if missing:
                raise InputError(f"has no table {missing[0]}", place=self.place, cure=CURE)
            self.tod = _read(file)
            columns, row, begin = (
                file["TOD"].columns,
                int(file["TOD"].header["NAXIS1"]),
                file["TOD"].fileinfo()["datLoc"],
            )
            shape = self.tod.n_detectors, self.tod.n_samples
            if int(file["TOD"].header["NAXIS2"]) != shape[0]:
                raise InputError(
                    "TOD and DETECTORS have other numbers of rows", place=self.place, cure=CURE
                )
        self.streams, self._at = {}, {}
        for column in columns:
            kind = {"D": ">f8", "E": ">f4"}.get(column.format[-1:])
            if kind and (column.format[:-1] or "1") == str(shape[1]):
                self.streams[column.name.lower()] = column.unit or ""
                self._at[column.name.lower()] = (
                    begin + columns.dtype.fields[column.name][1],
                    np.dtype(kind),
                )
        self._row, self._lock = row, threading.Lock()
        if packed.is_packed(path):
            raise InputError(
                "is compressed: its streams cannot be read in parts",
                place=self.place,
                cure="unpack it first",
            )
        self.tod.check(self.place)
        self._file = open(path, "rb", buffering=0)  # noqa: SIM115

    def read(self, stream: str, detectors: NDArray[np.intp], samples: slice) -> AnyFloats:
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

    def flags(self, detectors: NDArray[np.intp], samples: slice) -> None:
        """The file has no flags of single samples of detectors."""

    def noise(self, model: str | None, mask: int) -> dict[str, Floats]:
        """The file has no noise models. Raises InputError where one is asked for."""
        if model is not None:
            raise InputError(
                "is FITS, which has no noise models", place=self.place, cure="leave noise_model out"
            )
        return {}

    def close(self) -> None:
        """Close the file."""
        self._file.close()


def read(path: str | os.PathLike[str]) -> TimeOrderedData:
    """Read what `Writer` writes.

    Raises
    ------
    InputError
        No such file, not FITS, or one of the tables is missing.
    """
    place = f"time-ordered data {path}"
    with opened(path, place, CURE) as file:
        for hdu in file:
            check_size(hdu, place)
        tod = _read(file)
        table = file["TOD"]
        shape = tod.n_detectors, tod.n_samples
        names = (c for c in table.columns.names if c != "DETECTOR")
        tod.streams = {c.lower(): _native(table.data[c]).reshape(shape) for c in names}
    tod.check(place)
    return tod


def _quaternions(samples: Any, name: str) -> Floats:
    return np.asarray(
        _native(samples[name]) if name in samples.names else np.zeros((0, 4)), np.float64
    )


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
    fixed = {"NAME", "QUAT", "XI", "ETA", "FLAGS"}
    about = file["SAMPLES"].header
    flags, detector_flags = _native(samples["FLAGS"]), _native(detectors["FLAGS"])
    if "FLAGBITS" in about and "INTERVALS" not in file:
        raise KeyError("there is no table INTERVALS")
    intervals: Intervals = {}
    if "FLAGBITS" not in about:
        flags, detector_flags = (
            of_before(flags, samples=True),
            of_before(detector_flags, samples=False),
        )
        intervals[TRIMMED_INTERVALS] = runs(
            (flags & np.uint8(PROCESSING)) != 0, _native(samples["SECONDS"])
        )
    for row in file["INTERVALS"].data if "INTERVALS" in file else ():
        intervals.setdefault(str(row["NAME"]), []).append((float(row["START"]), float(row["STOP"])))
    weather = (
        GroundWeather(**{name: float(about[key]) for key, name, _, _ in _WEATHER})
        if "WEATHERT" in about
        else None
    )
    return TimeOrderedData(
        name=header["OBJECT"],
        start=header["DATE-OBS"],
        seconds=_native(samples["SECONDS"]),
        times=_native(samples["TIME"]),
        sample_rate=header["SAMPRATE"],
        telescope=header["TELESCOP"],
        field_of_view=float(np.radians(header["FOV"])),
        site=(
            header["SITE"],
            float(np.radians(header["SITELAT"])),
            float(np.radians(header["SITELON"])),
            header["SITEALT"],
        ),
        boresight_azel=_quaternions(samples, "BORESIGHT_AZEL"),
        boresight_radec=_quaternions(samples, "BORESIGHT_RADEC"),
        flags=flags,
        detector_flags=detector_flags,
        names=[str(d) for d in detectors["NAME"]],
        quats=_native(detectors["QUAT"]),
        columns={c.lower(): _native(detectors[c]) for c in detectors.names if c not in fixed},
        intervals=intervals,
        weather=weather,
        hwp_angle=_native(samples["HWP_ANGLE"]) if "HWP_ANGLE" in samples.names else None,
        azimuth=_native(samples["AZ"]) if "AZ" in samples.names else None,
        metadata={
            str(key): json.loads(value)
            for key, value in zip(provenance["KEY"], provenance["VALUE"], strict=True)
        },
        offsets=np.stack([_native(detectors["XI"]), _native(detectors["ETA"])], axis=1),
    )
