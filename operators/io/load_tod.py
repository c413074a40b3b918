"""Read time-ordered data back: what was simulated and saved, or recorded at a telescope."""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from pydantic import PrivateAttr

from zonda.core import flags
from zonda.core.configuration.time import Instant
from zonda.core.errors import InputError
from zonda.core.observation import Observation
from zonda.core.signal import Component

from .recorded_files import RecordedFiles, RecordedScan
from .recorded_pointing import boresights, middle, state_celestial
from .recorded_stream import RecordedStream
from .save_tod import reader
from .time_ordered_data import TimeOrderedData

if TYPE_CHECKING:
    from zonda.core.block import Block
    from zonda.core.data import Data
    from zonda.core.instrument import Instrument

RECORDED = Component("recorded", "calibrated")
"""The stream of a file: it enters the signal as it is, calibrated."""

MOST_TOLD = 8
"""Scans that `zonda check` tells one by one."""

MOMENT = 1.0
"""s between the scene's time and the first file's from which the two are not the same."""


class _Provides:
    """What a `LoadTOD` makes: no stream where none is wanted."""

    def __get__(self, operator: LoadTOD | None, owner: type) -> frozenset[str]:
        return frozenset({"boresight"} if operator is not None and operator.signal is None else {"boresight", RECORDED})


class LoadTOD(RecordedFiles):
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

    _scans: dict[int, RecordedScan] = PrivateAttr(default_factory=dict)

    def check(self, data: Data) -> list[str]:
        """What is in the files."""
        return _look(self, data)

    def observe(self, data: Data) -> None:
        """Append an observation for each file; the scene's instrument and site become those of the files."""
        self._scans.update(_append(self, data))

    def prepare(self, observation: Observation) -> RecordedStream | None:
        """Open the file, and find each detector's level. None: nothing of this scan is read."""
        stream = self.open(observation)
        return stream and stream.levelled(observation.n_detectors, observation.n_samples)

    def open(self, observation: Observation) -> RecordedStream | None:
        """The stream of an observation, to be read; None: it is not of these files, or none is wanted."""
        scan = self._scans.get(observation.index)
        return None if scan is None or self.signal is None else _opened(self, scan, observation)

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


def _look(step: LoadTOD, data: Data) -> list[str]:
    """What is in the first files, in words."""
    first = len(data.observations)
    with warnings.catch_warnings():  # observing says it again
        warnings.simplefilter("ignore")
        step.observe(data)
    found = data.observations[first:]
    lines = [_summary(o) for o in found[:MOST_TOLD]]
    return lines + ([f"and {len(found) - MOST_TOLD} more scans"] if len(found) > MOST_TOLD else [])


def _append(step: LoadTOD, data: Data) -> dict[int, RecordedScan]:
    """Append the observations; the scans by the observations' numbers."""
    given, found = data.scene, dict[int, RecordedScan]()
    own = step.own_scene(given.instrument)
    if abs(given.time.seconds_since(own["time"])) > MOMENT:
        raise InputError(
            f"begins {own['time']}, the scene {given.time}: recorded data are of one night",
            place=f"{step.label}, {step.files[0].name}",
            cure="leave time out of the pipeline, and nights out of a campaign",
        )
    data.scene = given.model_copy(update={"site": own["site"], "instrument": own["instrument"]})
    for path in step.files:
        scan = step.scan(path, given.instrument)
        _check_alike(scan, own["instrument"], f"{step.label}, {path.name}")
        observation = _observation(step, data, scan)
        for what in ("instrument", "site"):
            one, other = own[what].name, getattr(given, what).name
            text = f"{one}, the file's" + ("" if one == other else f"; the scene's {other} is not used")
            observation.tally.state(step.label, what, text)
        found[observation.index] = scan
        data.observations.append(observation)
    return found


def _opened(step: LoadTOD, scan: RecordedScan, observation: Observation) -> RecordedStream:
    """The open stream, with the rows of the observation's detectors."""
    order = {scan.tod.names[row]: row for row in scan.rows.tolist()}
    rows = np.array([order[name] for name in observation.focalplane.names], np.intp)
    opened = reader(scan.path)
    try:
        return RecordedStream(opened, str(step.signal), rows, np.uint8(step.detector_mask))
    except BaseException:
        opened.close()
        raise


def _check_alike(scan: RecordedScan, instrument: Instrument, place: str) -> None:
    """Refuse files of several instruments in one run."""
    own = scan.instrument
    same = own.name == instrument.name and np.isclose(own.band.centre, instrument.band.centre, rtol=1e-3)
    if not same:
        what = f"{own.name} at {own.band.centre / 1e9:.4g} GHz"
        first = f"{instrument.name} at {instrument.band.centre / 1e9:.4g} GHz"
        cure = "load the files of one instrument and band; one run for each"
        raise InputError(f"was recorded with {what}, the first file with {first}", place=place, cure=cure)


def _observation(step: LoadTOD, data: Data, scan: RecordedScan) -> Observation:
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
        hwp_angle=tod.hwp_angle,
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
