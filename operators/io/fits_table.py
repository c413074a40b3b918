"""Time-ordered data as FITS binary tables: ``TOD`` (one row per detector), ``SAMPLES``, ``DETECTORS``, ``PROVENANCE``,
``INTERVALS``."""

from __future__ import annotations

import contextlib
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.flags import of_before
from zonda.core.intervals import Intervals
from zonda.core.maps.map_file import ascii_text
from zonda.core.storage.files import writing
from zonda.core.storage.fits_files import check_size, opened
from zonda.core.stream_names import UNITS
from zonda.core.types import AnyFloats
from zonda.core.weather import GroundWeather

from .time_ordered_data import TimeOrderedData
from .toast_hdf5 import azimuth_elevation

SUFFIX = ".fits"

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
    """Writes one observation, streams in rectangles and in any order; same interface as `toast_hdf5.Writer`.

    The table ``TOD`` comes first, at a place known beforehand, so that rectangles go straight to their bytes; the tables
    ``SAMPLES``, ``DETECTORS`` (with the flags as they are at the end), ``PROVENANCE`` and ``INTERVALS`` are appended by `finish`.
    """

    def __init__(self, path: Path, tod: TimeOrderedData, streams: list[str], dtype: str) -> None:
        from astropy.io import fits

        self.path, self._tod = path, tod
        self._dtype = np.dtype(dtype).newbyteorder(">")
        self._streams = list(streams)
        self._name_bytes = max(len(d.encode()) for d in tod.names)
        n, code = tod.n_samples, {"float64": "D", "float32": "E"}[dtype]
        columns = [fits.Column("DETECTOR", f"{self._name_bytes}A")]
        columns += [fits.Column(s.upper(), f"{n}{code}", unit=UNITS.get(s, "K") or None) for s in streams]
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
        column = self._name_bytes + (self._streams.index(stream) * self._tod.n_samples + samples.start) * self._dtype.itemsize
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
                for table in (_samples_table, _detectors_table, _provenance_table, _intervals_table):
                    self._file.write(_bytes_of(table(self._tod)))
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

    azimuth, elevation = azimuth_elevation(tod.boresight_azel)
    column = fits.Column
    columns = [
        column("SECONDS", "D", unit="s", array=tod.seconds),
        column("TIME", "D", unit="s", array=tod.times),
        column("AZ", "D", unit="rad", array=azimuth),
        column("EL", "D", unit="rad", array=elevation),
        column("BORESIGHT_AZEL", "4D", array=tod.boresight_azel),
        column("BORESIGHT_RADEC", "4D", array=tod.boresight_radec),
        column("FLAGS", "B", array=tod.flags),
    ]
    table = fits.BinTableHDU.from_columns(columns, name="SAMPLES")
    table.header["FLAGBITS"] = ("TOAST", "bits of FLAGS")
    for key, name, unit, meaning in _WEATHER if tod.weather is not None else ():
        table.header[key] = (getattr(tod.weather, name), f"[{unit}] {meaning}" if unit else meaning)
    table.header.add_comment(
        "SECONDS counts from DATE-OBS of the primary header; TIME is POSIX. Quaternions are x, y, z, w as TOAST's."
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
    columns += [column(k.upper(), "D", unit=_DETECTOR_UNITS.get(k), array=v) for k, v in tod.columns.items()]
    table = fits.BinTableHDU.from_columns(columns, name="DETECTORS")
    table.header["FLAGBITS"] = ("TOAST", "bits of FLAGS")
    table.header.add_comment("XI and ETA are tangents (a gnomonic plane); sotodlib's are sines.")
    return table


def _provenance_table(tod: TimeOrderedData) -> Any:
    from astropy.io import fits

    keys, values = list(tod.metadata), [json.dumps(v) for v in tod.metadata.values()]
    columns = [
        fits.Column(name, f"{max(map(len, [*texts, ' ']))}A", array=texts) for name, texts in (("KEY", keys), ("VALUE", values))
    ]
    return fits.BinTableHDU.from_columns(columns, name="PROVENANCE")


def _bytes_of(table: Any) -> bytes:
    import io

    from astropy.io import fits

    stream = io.BytesIO()
    fits.HDUList([fits.PrimaryHDU(), table]).writeto(stream)
    return stream.getvalue()[2880:]  # without the primary header, which the file has already


def read(path: str | os.PathLike[str]) -> TimeOrderedData:
    """Read what `Writer` writes.

    Raises
    ------
    InputError
        No such file, not FITS, or one of the tables is missing.
    """
    place = f"time-ordered data {path}"
    with opened(path, place, "give a file that SaveTOD wrote, whole") as file:
        for hdu in file:
            check_size(path, hdu, place)
        tod = _read(file)
    tod.check(place)
    return tod


def _read(file: Any) -> TimeOrderedData:
    header, tod = file[0].header, file["TOD"]
    samples, detectors, provenance = (file[name].data for name in ("SAMPLES", "DETECTORS", "PROVENANCE"))
    fixed = {"NAME", "QUAT", "XI", "ETA", "FLAGS"}

    def native(values: Any) -> Any:
        array = np.asarray(values)
        return array.astype(array.dtype.newbyteorder("="))

    shape = len(detectors), len(samples)
    about = file["SAMPLES"].header
    flags, detector_flags = native(samples["FLAGS"]), native(detectors["FLAGS"])
    if "FLAGBITS" not in about:
        flags, detector_flags = of_before(flags, samples=True), of_before(detector_flags, samples=False)
    intervals: Intervals = {}
    for row in file["INTERVALS"].data if "INTERVALS" in file else ():
        intervals.setdefault(str(row["NAME"]), []).append((float(row["START"]), float(row["STOP"])))
    weather = GroundWeather(**{name: float(about[key]) for key, name, _, _ in _WEATHER}) if "WEATHERT" in about else None
    return TimeOrderedData(
        name=header["OBJECT"],
        start=header["DATE-OBS"],
        seconds=native(samples["SECONDS"]),
        times=native(samples["TIME"]),
        sample_rate=header["SAMPRATE"],
        telescope=header["TELESCOP"],
        field_of_view=float(np.radians(header["FOV"])),
        site=(header["SITE"], float(np.radians(header["SITELAT"])), float(np.radians(header["SITELON"])), header["SITEALT"]),
        boresight_azel=native(samples["BORESIGHT_AZEL"]),
        boresight_radec=native(samples["BORESIGHT_RADEC"]),
        flags=flags,
        detector_flags=detector_flags,
        names=[str(d) for d in detectors["NAME"]],
        quats=native(detectors["QUAT"]),
        columns={c.lower(): native(detectors[c]) for c in detectors.names if c not in fixed},
        streams={c.lower(): native(tod.data[c]).reshape(shape) for c in tod.columns.names if c != "DETECTOR"},
        intervals=intervals,
        weather=weather,
        metadata={str(key): json.loads(value) for key, value in zip(provenance["KEY"], provenance["VALUE"], strict=True)},
    )
