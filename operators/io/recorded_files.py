"""The parameters of `LoadTOD`, and what its files say besides their streams."""

from __future__ import annotations

import os
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, field_validator

from zonda.core import flags
from zonda.core.configuration.files import InputPath
from zonda.core.configuration.target import Target
from zonda.core.configuration.time import Instant
from zonda.core.configuration.units import Fraction
from zonda.core.errors import InputError
from zonda.core.operator import Operator

from .noise_table import NoiseTable, read_noise
from .recorded_scan import instrument_of, rows_of_band, site_of
from .save_tod import reader
from .time_ordered_data import TimeOrderedData

if TYPE_CHECKING:
    from zonda.core.instrument import Instrument

NEW_SCANS = 64
"""Files whose pointing is kept after it was read."""


@dataclass(frozen=True)
class RecordedScan:
    """A file, all but its streams; the rows of the band that is used; names of its streams."""

    path: Path
    tod: TimeOrderedData
    rows: NDArray[np.intp]
    instrument: Instrument
    noise: str


class RecordedFiles(Operator):
    """The parameters of `LoadTOD`."""

    file: InputPath | list[InputPath]
    """HDF5 in TOAST's layout or FITS of `SaveTOD`; several files are the scans of one run, in this order."""
    signal: str | None = "signal"
    """Name of the stream; none: no stream is read, the file's pointing alone is used."""
    band: str | None = None
    """Centre of the band whose detectors are used, e.g. 93 GHz, where the file has detectors of several."""
    noise: InputPath | None = None
    """Table that `zonda noise` wrote: NET, knee and slope of each detector, above those of the file."""
    celestial: Literal["recorded", "recomputed"] | None = None
    """Where the boresight is on the sky: as recorded (``boresight_radec``), or recomputed from azimuth, elevation and time. Where
    absent: as recorded where the file has it."""
    flag_mask: int = Field(flags.SAMPLE_MASK, ge=0, le=255)
    """Bits of the file's flags that exclude a sample; others do not (those of the Sun are kept)."""
    detector_mask: int = Field(flags.DETECTOR_MASK, ge=0, le=255)
    """Bits of the file's flags that exclude a detector, or a sample of one detector."""
    target: Target | None = None
    """Centre of the map; where absent the scene's target, that of the saved run, or the middle of the scan."""
    interpolation_error: Fraction = Field(1e-3, gt=0, le=0.1)
    """Largest error of interpolating the celestial transformation in time, as a fraction of the smallest beam's FWHM."""

    @field_validator("file")
    @classmethod
    def _some_files(cls, value: Any) -> Any:
        if isinstance(value, list) and not value:
            raise ValueError("give at least one file")
        return value

    @field_validator("signal", mode="before")
    @classmethod
    def _none_in_words(cls, value: Any) -> Any:
        return None if isinstance(value, str) and value.strip().lower() == "none" else value

    def own_scene(self, given: Instrument | None) -> Mapping[str, Any]:
        """Instrument, site and start of the first file; what it does not state of the instrument is that of ``given``."""
        scan = self.scan(self.files[0], given)
        return {"site": site_of(scan.tod), "instrument": scan.instrument, "time": Instant.parse(scan.tod.start)}

    def scene(self, **more: Any) -> Any:
        """A `Scene` of the file, for `Pipeline.run`: its instrument, site and start, and ``more`` (seed, target, weather).

        Raises InputError where the file cannot be read, or does not state what a scene needs.
        """
        from zonda.core.scene import Scene

        return Scene(**{**self.own_scene(more.get("instrument")), **more})

    @property
    def files(self) -> list[Path]:
        """The files in their order."""
        return list(self.file) if isinstance(self.file, list) else [self.file]

    def scan(self, path: Path, given: Instrument | None) -> RecordedScan:
        """All but the stream of a file. Raises InputError where it cannot be used."""
        place = f"{self.label}, {path}"
        tod, streams = _head(path, _stamp(path))
        if self.signal is not None and self.signal not in streams:
            have = ", ".join(sorted(streams)) or "none"
            cure = f"set signal to one of: {have}; or signal: none for the pointing alone"
            raise InputError(f"has no stream {self.signal!r}", place=place, cure=cure)
        rows = rows_of_band(tod, self.band, place)
        table = read_noise(self.noise) if self.noise is not None else None
        tod, noise = _with_noise(tod, table, rows, place)
        return RecordedScan(path, tod, rows, instrument_of(tod, rows, given, place), noise)


def _stamp(path: Path) -> tuple[int, int]:
    try:
        stat = os.stat(path)
    except OSError as err:
        raise InputError(f"cannot be read: {err.strerror}", place=str(path), cure="was it moved or removed?") from None
    return stat.st_size, stat.st_mtime_ns


@lru_cache(maxsize=NEW_SCANS)
def _head(path: Path, stamp: tuple[int, int]) -> tuple[TimeOrderedData, Mapping[str, str]]:
    """All but the streams of a file, and the names of these with their units."""
    opened = reader(path)
    opened.close()
    return opened.tod, opened.streams


def _with_noise(
    tod: TimeOrderedData, table: NoiseTable | None, rows: NDArray[np.intp], place: str
) -> tuple[TimeOrderedData, str]:
    """The file's data with the noise of a table, and where its noise comes from."""
    if table is None:
        what = "the file's" if "net" in tod.columns else "the scene's instrument's, or none: the file states none"
        return tod, what
    columns = dict(tod.columns)
    for name, values in table.of([tod.names[row] for row in rows], place).items():
        columns[name] = np.array(columns.get(name, np.full(tod.n_detectors, values[0])), np.float64)
        columns[name][rows] = values
    return replace(tod, columns=columns), str(table.path)
