"""The parameters of `LoadTOD`, and what its files say besides their streams."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Discriminator, Field, PrivateAttr, Tag, field_serializer, field_validator

from zonda.core import flags
from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.target import Target
from zonda.core.configuration.time import Instant
from zonda.core.configuration.units import Fraction, RadioFrequency
from zonda.core.errors import InputError
from zonda.core.flags import Intervals, intervals_of
from zonda.core.instrument import Instrument
from zonda.core.observation import Observation
from zonda.core.operator import Operator
from zonda.core.types import Floats, Indices
from zonda.core.weather import GroundWeather

from .recorded_scan import (
    RecordedInstrument,
    instrument_of,
    is_near,
    joined,
    rows_of_bands,
    site_of,
)
from .recorded_stream import RecordedStream, check_unit, kelvin_per
from .save_tod import reader
from .time_ordered_data import TimeOrderedData
from .toast_noise import DEFAULT_MODEL

NEW_SCANS = 8
"""Files whose pointing is kept after it was read."""

MOST_FILES = 4096
"""Files of which it is kept to which scan they belong."""


@dataclass(frozen=True)
class RecordedBand:
    """A band of a file, all but its streams: the camera, the rows of its detectors, and whose noise
    they have in words.
    """

    path: Path
    tod: TimeOrderedData
    camera: RecordedInstrument
    rows: Indices
    noise: str


@dataclass(frozen=True)
class File:
    """A file of a band that is read: the rows of its detectors, what it states of the scan, whose
    noise it has in words.
    """

    path: Path
    rows: dict[str, int]
    flags: flags.Flags
    intervals: Intervals
    weather: GroundWeather | None
    hwp_angle: Floats | None
    noise: str

    @classmethod
    def of(cls, band: RecordedBand, mask: int) -> File:
        """``mask``: bits of the flags that exclude a sample."""
        tod = band.tod
        rows = {band.tod.names[row]: row for row in band.rows.tolist()}
        every = {"scanning": intervals_of(np.ones(tod.n_samples, bool), tod.seconds)}
        said = tod.sample_flags(mask), tod.scan_intervals or every, tod.weather, tod.hwp_angle
        return cls(band.path, rows, *said, band.noise)

    def state(self, observation: Observation) -> None:
        """Give an observation of one band what its own file states of the scan."""
        observation.flags, observation.intervals = self.flags.copy(), dict(self.intervals)
        observation.weather, observation.hwp_angle = self.weather, self.hwp_angle


Files = Annotated[
    Annotated[InputPath, Tag("one")] | Annotated[list[InputPath], Tag("several")],
    Discriminator(
        lambda value: "several" if isinstance(value, list | tuple) else "one"
    ),  # so that mistakes are of one of them
]
"""A file, or several."""

Scan = list[RecordedBand]
"""The bands of one scan, of one file or several."""


class RecordedFiles(Operator):
    """The parameters of `LoadTOD`."""

    file: Files
    """HDF5 in TOAST's layout or of sotodlib's `AxisManager.save`, or FITS of `SaveTOD`; several
    files, [a.h5, b.h5], are the scans of one run, in this order. Files with the same times and
    other bands are one scan."""
    signal: str | None = "signal"
    """Name of the stream; none: no stream is read, the file's pointing alone is used."""
    unit: str | None = None
    """Unit of the stream, e.g. K_RJ, mK_RJ or K_CMB; absent: the file's. Most AxisManagers state
    none. K is K_RJ."""
    band: RadioFrequency | None = Field(None, gt=0)
    """Centre of the only band whose detectors are used, e.g. 93 GHz; none: all bands, each with
    maps of its own.
    """
    noise: InputPath | None = None
    """Table that `zonda noise` wrote: NET, knee and slope of each detector, above those of the
    file.
    """
    noise_model: str | None = None
    """Noise model of a TOAST file, e.g. el_noise: its spectra give NET, knee and slope. Where
    absent: what the focal plane states, or else fitted to `noise_model`."""
    celestial: Literal["recorded", "recomputed"] | None = None
    """Where the boresight is on the sky: as recorded (``boresight_radec``), or recomputed from
    azimuth, elevation and time. Where absent: as recorded where the file has it."""
    flag_mask: int = Field(flags.SAMPLE_MASK, ge=0, le=255)
    """Bits of the file's flags that exclude a sample; others do not (those of the Sun are kept)."""
    detector_mask: int = Field(flags.DETECTOR_MASK, ge=0, le=255)
    """Bits of the file's flags that exclude a detector, or a sample of one detector."""
    target: Target | None = None
    """Centre of the map; where absent the scene's target, that of the saved run, or the middle of
    the scan.
    """
    interpolation_error: Fraction = Field(1e-3, gt=0, le=0.1)
    """Largest error of interpolating the celestial transformation in time, as a fraction of the
    smallest beam's FWHM.
    """

    _scans: dict[int, list[File]] = PrivateAttr(default_factory=dict)
    """By the observations' numbers."""

    @field_serializer("file", when_used="json")
    def _as_text(self, file: Path | list[Path]) -> str | list[str]:
        """pydantic 2.9 would write a list as one text."""
        return [str(one) for one in file] if isinstance(file, list) else str(file)

    @field_validator("file")
    @classmethod
    def _some_files(cls, value: Any) -> Any:
        if isinstance(value, list) and not value:
            raise ValueError("give at least one file")
        return value

    @field_validator("unit")
    @classmethod
    def _of_temperature(cls, unit: str | None) -> str | None:
        if unit is not None and kelvin_per(unit) is None:
            raise ValueError("give a unit of temperature: K_RJ, mK_RJ, uK_CMB, ...")
        return unit

    @field_validator("signal", mode="before")
    @classmethod
    def _none_in_words(cls, value: Any) -> Any:
        return None if isinstance(value, str) and value.strip().lower() == "none" else value

    def own_scene(self, given: Instrument | None) -> Mapping[str, Any]:
        """Instrument, site and start of the first scan; what it does not state of the instrument is
        that of ``given``.

        The camera has all bands of that scan; only one where ``given`` is the camera of a band.
        """
        scan = next(self.scans(given))
        cameras = [band.camera for band in scan]
        chosen = next((camera for camera in cameras if camera.has_the_detectors_of(given)), None)
        instrument = chosen or joined(cameras, f"{self.label}, {scan[0].path}")
        return {
            "site": site_of(scan[0].tod),
            "instrument": instrument,
            "time": Instant.parse(scan[0].tod.start),
        }

    def scene(self, **more: Any) -> Any:
        """A `Scene` of the file, for `Pipeline.run`: its instrument, site and start, and ``more``
        (seed, target, weather).

        Raises InputError where the file cannot be read, or does not state what a scene needs.
        """
        from zonda.core.scene import Scene

        given = more.get("instrument")
        if given is not None:  # a name or a variant, too: as of any scene
            given = Scene(site="cerro_toco", time="2000-01-01T00:00", instrument=given).instrument
        return Scene(**{**self.own_scene(given), **more})

    @property
    def files(self) -> list[Path]:
        """The files in their order."""
        return list(self.file) if isinstance(self.file, list) else [self.file]

    def open(self, observation: Observation) -> RecordedStream | None:
        """The stream of an observation of one band, to be read; None: it is not of these files, or
        none is wanted.
        """
        file = self.file_of(observation)
        if file is None or self.signal is None:
            return None
        opened = reader(file.path)
        try:
            rows = np.array([file.rows[name] for name in observation.focalplane.names], np.intp)
            good = flags.good(file.flags, flags.EXCLUDE_SAMPLE)
            usable = flags.has_a_signal(file.flags)
            return RecordedStream(
                opened,
                self.signal,
                rows,
                np.uint8(self.detector_mask),
                good,
                usable,
                self.unit,
                observation.instrument.band,
            )
        except BaseException:
            opened.close()
            raise

    def file_of(self, observation: Observation) -> File | None:
        """The file with the detectors of an observation of one band; None: it is not of these
        files.
        """
        first = observation.focalplane.names[0]
        return next(
            (file for file in self._scans.get(observation.index, ()) if first in file.rows),
            None,
        )

    def scans(self, given: Instrument | None) -> Iterator[Scan]:
        """The scans in the order of their first files."""
        for paths in self._by_scan():
            yield [band for path in paths for band in self._bands(path, given)]

    def _by_scan(self) -> list[list[Path]]:
        """The files of each scan: those with the same times and other bands."""
        told = [(path, *_told(path, _stamp(path))) for path in self.files]
        if (wanted := self.band) is not None:  # where no file has it, the first is refused
            told = [
                one
                for one in told
                if not one[2] or any(is_near(mhz * 1e6, wanted) for mhz in one[2])
            ] or told[:1]
        found: list[tuple[Any, set[int], list[Path]]] = []
        for path, times, bands in told:
            beside = next((s for s in found if bands and s[0] == times and not s[1] & bands), None)
            if beside is None:
                found.append(beside := (times, set(), []))
            beside[1].update(bands)
            beside[2].append(path)
        return [paths for _, _, paths in found]

    def _bands(self, path: Path, given: Instrument | None) -> Scan:
        """Everything but the stream of a file. Raises InputError for a file that cannot be used."""
        place = f"{self.label}, {path}"
        tod, streams = _head(path, _stamp(path))
        if self.signal is not None and self.signal not in streams:
            have = ", ".join(sorted(streams)) or "none"
            cure = f"set signal to one of: {have}; or signal: none for the pointing alone"
            raise InputError(f"has no stream {self.signal!r}", place=place, cure=cure)
        if self.signal is not None:
            check_unit(self.unit or streams[self.signal], self.signal, place)
        rows = rows_of_bands(tod, self.band, place)
        used = (tod.detector_flags & np.uint8(self.detector_mask)) == 0
        use = np.concatenate([r[used[r]] for r in rows])
        columns, noise = self._noise(tod, path, use)
        tod = replace(tod, columns=columns)
        return [
            RecordedBand(path, tod, instrument_of(tod, r, used[r], given, place), r, noise)
            for r in rows
        ]

    def _noise(
        self,
        tod: TimeOrderedData,
        path: Path,
        rows: Indices,
    ) -> tuple[dict[str, Floats], str]:
        """Columns with the noise of the table, for the detectors ``rows``, of a model of the file
        or the file's own, and which of these it is in words.
        """
        columns = dict(tod.columns)
        said = "the file's"
        if self.noise_model is not None or "net" not in columns:
            said = "the scene's instrument's, or none: the file states none"
            try:
                fitted = _fitted(path, _stamp(path), self.noise_model, self.detector_mask)
            except InputError:
                if self.noise is None or self.noise_model is not None:
                    raise
                fitted = {}
            if fitted:
                columns |= fitted
                said = f"fitted to the file's {self.noise_model or DEFAULT_MODEL}"
        if self.noise is None:
            return columns, said
        from zonda.core.detector_files import read_noise

        names = [tod.names[row] for row in rows]
        for name, values in read_noise(self.noise).of(names, f"{self.label}, {path}").items():
            column = columns.get(name, np.full(tod.n_detectors, np.append(values, 0.0)[0]))
            columns[name] = np.array(column, np.float64)
            columns[name][rows] = values
        return columns, str(self.noise)


def _stamp(path: Path) -> tuple[int, int]:
    try:
        stat = os.stat(path)
    except OSError as err:
        raise InputError(
            f"cannot be read: {err.strerror}",
            place=str(path),
            cure="was it moved or removed?",
        ) from None
    return stat.st_size, stat.st_mtime_ns


@lru_cache(maxsize=MOST_FILES)
def _told(path: Path, stamp: tuple[int, int]) -> tuple[tuple[str, bytes], frozenset[int]]:
    """Telescope and times of a file, in short; its bands, MHz."""
    tod, _ = _head(path, stamp)
    every = rows_of_bands(tod, None, str(path)) if "band_centre" in tod.columns else []
    centres = (round(float(np.median(tod.columns["band_centre"][rows])) / 1e6) for rows in every)
    return (tod.telescope, hashlib.sha256(tod.times.tobytes()).digest()), frozenset(centres)


@lru_cache(maxsize=NEW_SCANS)
def _head(path: Path, stamp: tuple[int, int]) -> tuple[TimeOrderedData, Mapping[str, str]]:
    """Everything but the streams of a file, and their names with their units."""
    opened = reader(path)
    opened.close()
    return opened.tod, opened.streams


@lru_cache(maxsize=NEW_SCANS)
def _fitted(
    path: Path,
    stamp: tuple[int, int],
    model: str | None,
    mask: int,
) -> Mapping[str, Floats]:
    """The noise of a model of a file, of detectors without a bit of ``mask``."""
    opened = reader(path)
    try:
        return opened.noise(model, mask)
    finally:
        opened.close()
