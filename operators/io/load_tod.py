"""Read time-ordered data back: what was simulated and saved, or recorded at a telescope."""

from __future__ import annotations

import os
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr, field_validator

from zonda.core import flags
from zonda.core.configuration.files import InputPath
from zonda.core.configuration.target import Target
from zonda.core.configuration.time import Instant
from zonda.core.configuration.units import Fraction
from zonda.core.errors import InputError
from zonda.core.numerics.smooth import SmoothField
from zonda.core.operator import Operator
from zonda.core.signal import Component

from .noise_table import NoiseTable, read_noise
from .recorded_pointing import boresights, middle, state_celestial
from .recorded_scan import instrument_of, rows_of_band, site_of
from .recorded_stream import RecordedStream, levels
from .save_tod import reader
from .time_ordered_data import TimeOrderedData

if TYPE_CHECKING:
    from zonda.core.block import Block
    from zonda.core.data import Data
    from zonda.core.instrument import Instrument
    from zonda.core.observation import Observation

RECORDED = Component("recorded", "calibrated")
"""The stream of a file: it enters the signal as it is, calibrated."""

MOMENT = 1.0
"""s between the scene's time and the first file's from which the two are not the same."""

NEW_SCANS = 64
"""Files whose pointing is kept after it was read."""


class _Provides:
    """What a `LoadTOD` makes: no stream where none is wanted."""

    def __get__(self, operator: LoadTOD | None, owner: type) -> frozenset[str]:
        return frozenset({"boresight"} if operator is not None and operator.signal is None else {"boresight", RECORDED})


@dataclass(frozen=True)
class _Scan:
    """A file, all but its streams; the rows of the band that is used; names of its streams."""

    path: Path
    tod: TimeOrderedData
    rows: NDArray[np.intp]
    instrument: Instrument
    noise: str


class LoadTOD(Operator):
    """Recorded scans with their streams, one from each file: TOAST's HDF5 (what `SaveTOD` writes, too) or `SaveTOD`'s FITS.

    Pointing, focal plane, flags, intervals, noise and weather are those of the file, and so are instrument and site: a pipeline
    with this step needs neither. The stream enters as the component `recorded`: alone it is the signal, which filters and map
    makers then treat as any other; a `SkyMap` behind it is added to it; with `signal: none` there is the pointing alone, on which
    the other steps simulate a twin. Streams are read block by block. The mean of each detector stands beside its stream, so that
    float32 keeps what is on top of tens of kelvin.

    Samples with a bit of `flag_mask` and detectors with one of `detector_mask` are not used; a single sample of a detector that
    the file flags (``detdata/flags``) becomes NaN, which filters bridge and maps drop. Streams compressed with FLAC need the
    package flacarray (``pip install 'zonda[flac]'``).
    """

    provides: ClassVar[Any] = _Provides()
    knows_means: ClassVar[bool] = True

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

    _scans: dict[int, _Scan] = PrivateAttr(default_factory=dict)

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

    # -- the scene

    def own_scene(self, given: Instrument | None) -> Mapping[str, Any]:
        """Instrument, site and start of the first file; what it does not state of the instrument is that of ``given``."""
        scan = self._scan(self.files[0], given)
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

    # -- the steps of a pipeline

    def check(self, data: Data) -> list[str]:
        """What is in the files."""
        first = len(data.observations)
        with warnings.catch_warnings():  # observing says it again
            warnings.simplefilter("ignore")
            self.observe(data)
        found = data.observations[first:]
        lines = [_summary(o) for o in found[:8]]
        return lines + ([f"and {len(found) - 8} more scans"] if len(found) > 8 else [])

    def observe(self, data: Data) -> None:
        """Append an observation for each file; the scene's instrument and site become those of the files."""
        first, given = len(data.observations), data.scene
        own = self.own_scene(given.instrument)
        early = Instant.parse(self._scan(self.files[0], given.instrument).tod.start)
        if abs(given.time.seconds_since(early)) > MOMENT:
            raise InputError(
                f"begins {early}, the scene {given.time}: recorded data are of one night",
                place=f"{self.label}, {self.files[0].name}",
                cure="leave time out of the pipeline, and nights out of a campaign",
            )
        data.scene = given.model_copy(update={"site": own["site"], "instrument": own["instrument"]})
        for path in self.files:
            scan = self._scan(path, given.instrument)
            _check_alike(scan, own["instrument"], f"{self.label}, {path.name}")
            observation = _observation(self, data, scan)
            self._scans[observation.index] = scan
            data.observations.append(observation)
        for observation in data.observations[first:]:
            for what, one, other in (
                ("instrument", own["instrument"].name, given.instrument.name),
                ("site", own["site"].name, given.site.name),
            ):
                text = f"{one}, the file's" + ("" if one == other else f"; the scene's {other} is not used")
                observation.tally.state(self.label, what, text)

    def prepare(self, observation: Observation) -> RecordedStream | None:
        """Open the file, and find each detector's level. None: nothing of this scan is read."""
        stream = self.open(observation)
        if stream is None:
            return None
        try:
            stream.level, _ = levels(stream, observation.n_detectors, observation.n_samples)
        except BaseException:
            stream.file.close()
            raise
        stream.mean = SmoothField.constant(stream.level, observation.n_samples)
        return stream

    def open(self, observation: Observation) -> RecordedStream | None:
        """The stream of an observation, to be read; None: it is not of these files, or none is wanted."""
        scan = self._scans.get(observation.index)
        if scan is None or self.signal is None:
            return None
        order = {name: row for row, name in zip(scan.rows.tolist(), (scan.tod.names[r] for r in scan.rows), strict=True)}
        rows = np.array([order[name] for name in observation.focalplane.names], np.intp)
        opened = reader(scan.path)
        try:
            return RecordedStream(opened, self.signal, rows, np.uint8(self.detector_mask))
        except BaseException:
            opened.close()
            raise

    def exec(self, block: Block, state: RecordedStream | None) -> None:
        """Read a block; add it to ``recorded``."""
        out = block.new(RECORDED)
        if state is None:
            return
        block.means[RECORDED] = state.mean
        spoilt = state.add(block.detectors, block.samples, out)
        block.observation.tally.count(self.label, "samples of single detectors that the file flags", spoilt)

    def collect(self, data: Data, observation: Observation, state: RecordedStream | None) -> None:
        """Close the file."""
        if state is not None:
            state.file.close()

    def discard(self, observation: Observation, state: RecordedStream | None) -> None:
        """Close the file."""
        if state is not None:
            state.file.close()

    def _scan(self, path: Path, given: Instrument | None) -> _Scan:
        place = f"{self.label}, {path}"
        tod, streams = _head(path, _stamp(path))
        if self.signal is not None and self.signal not in streams:
            have = ", ".join(sorted(streams)) or "none"
            cure = f"set signal to one of: {have}; or signal: none for the pointing alone"
            raise InputError(f"has no stream {self.signal!r}", place=place, cure=cure)
        rows = rows_of_band(tod, self.band, place)
        table = read_noise(self.noise) if self.noise is not None else None
        tod, noise = _with_noise(tod, table, rows, place)
        return _Scan(path, tod, rows, instrument_of(tod, rows, given, place), noise)


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
    from dataclasses import replace

    if table is None:
        what = "the file's" if "net" in tod.columns else "the scene's instrument's, or none: the file states none"
        return tod, what
    columns = dict(tod.columns)
    for name, values in table.of([tod.names[row] for row in rows], place).items():
        columns[name] = np.array(columns.get(name, np.full(tod.n_detectors, values[0])), np.float64)
        columns[name][rows] = values
    return replace(tod, columns=columns), str(table.path)


def _check_alike(scan: _Scan, instrument: Instrument, place: str) -> None:
    """Refuse files of several instruments in one run."""
    own = scan.instrument
    same = own.name == instrument.name and np.isclose(own.band.centre, instrument.band.centre, rtol=1e-3)
    if not same:
        what = f"{own.name} at {own.band.centre / 1e9:.4g} GHz"
        first = f"{instrument.name} at {instrument.band.centre / 1e9:.4g} GHz"
        cure = "load the files of one instrument and band; one run for each"
        raise InputError(f"was recorded with {what}, the first file with {first}", place=place, cure=cure)


def _observation(step: LoadTOD, data: Data, scan: _Scan) -> Observation:
    from zonda.core.observation import Observation

    tod, scene, place = scan.tod, data.scene, f"{step.label}, {scan.path}"
    start, plane = Instant.parse(tod.start), scan.instrument.focalplane()
    if (np.diff(tod.seconds) <= 0).any():
        row = int(np.flatnonzero(np.diff(tod.seconds) <= 0)[0]) + 1
        raise InputError(f"the times do not increase at sample {row}", place=place, cure="leave out the samples that repeat")
    tolerance = step.interpolation_error * float(plane.fwhm.min())
    found = boresights(tod, start, scene.site, step.celestial, tolerance, place)
    good = flags.good(sample_flags := flags.from_file(tod.flags, step.flag_mask), flags.EXCLUDE_SAMPLE)
    centre = _centre(step, tod, scene, found.radec, good)
    dead = np.where(tod.detector_flags[scan.rows] & np.uint8(step.detector_mask), np.uint8(flags.INVALID), np.uint8(0))
    observation = Observation(
        name=_unique(tod.name, [o.name for o in data.observations]),
        index=len(data.observations),
        site=scene.site,
        instrument=scan.instrument,
        focalplane=plane,
        start=start,
        seconds=tod.seconds,
        sample_rate=tod.sample_rate,
        boresight_azel=found.azel,
        boresight_radec=found.radec,
        centre=centre,
        seed=scene.seed,
        flags=sample_flags,
        detector_flags=dead,
        intervals=dict(tod.intervals),
        weather=tod.weather,
    )
    tally = observation.tally
    tally.state(step.label, "noise of the detectors", scan.noise)
    tally.count(step.label, "samples that the file's flags exclude", int((~good).sum()), good.size)
    tally.count(step.label, "detectors that the file's flags exclude", int(np.count_nonzero(dead)), len(dead))
    state_celestial(step.label, observation, found, tod.sample_rate)
    return observation


def _centre(step: LoadTOD, tod: TimeOrderedData, scene: Any, radec: Any, good: Any) -> tuple[float, float]:
    """ICRS (ra, dec) [rad] of the centre of the map."""
    target = step.target or scene.target
    if target is not None and target.frame != "horizontal":
        found: tuple[float, float] = target.icrs()
        return found
    if {"centre_ra", "centre_dec"} <= set(tod.metadata):
        return float(tod.metadata["centre_ra"]), float(tod.metadata["centre_dec"])
    return middle(radec, good)


def _unique(name: str, others: Iterable[str]) -> str:
    taken, number, found = {*others}, 2, name
    while found in taken:
        found, number = f"{name}.{number}", number + 1
    return found


def _summary(o: Observation) -> str:
    good = o.good_samples
    text = f"{o.name}: {o.n_detectors} detectors x {o.n_samples} samples at {o.sample_rate:.6g} Hz, {o.start}"
    if good.any():
        low, high = np.degrees([o.elevation[good].min(), o.elevation[good].max()])
        text += f", elevation {low:.2f} to {high:.2f} deg"
    return f"{text}; {int(good.sum())} samples and {int(o.good_detectors.sum())} detectors are used"
