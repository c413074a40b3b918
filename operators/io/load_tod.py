"""Read time-ordered data back: what was simulated and saved, or recorded at a telescope."""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from zonda.core import flags
from zonda.core.configuration.time import Instant
from zonda.core.data import Block, Data, Observation
from zonda.core.errors import InputError
from zonda.core.instrument import Instrument
from zonda.core.numerics.celestial import CelestialTransform
from zonda.core.numerics.quaternions import conjugate, directions, middle, multiply
from zonda.core.signal import Component
from zonda.core.site import Site
from zonda.core.types import Floats

from .recorded_files import File, RecordedBand, RecordedFiles, Scan
from .recorded_scan import joined
from .recorded_stream import RecordedStream
from .time_ordered_data import TimeOrderedData

RECORDED = Component("recorded", "calibrated")
"""The stream of a file: it enters the signal as it is, calibrated."""

MOST_TOLD = 8
"""Scans that `zonda check` tells one by one."""

MOMENT = 1.0
"""s between the scene's time and the first file's from which the two are not the same."""


SAME_DIRECTION = 1e-9
"""Largest difference of the boresights (quaternions) of files that are bands of one scan."""

SAME_AZIMUTH = np.radians(1.0)
"""Largest distance of the azimuth that a file states from that of its boresight: more than any
pointing model.
"""

GAP = 1.5
"""Sample intervals from which two samples are a gap apart."""

SAME_NUMBER = 1e-6
"""Largest relative difference of the sites and sample rates of such files."""


class LoadTOD(RecordedFiles):
    """Recorded scans with their streams: TOAST's HDF5 (what `SaveTOD` writes, too) or `SaveTOD`'s
    FITS.

    Pointing, focal plane, flags, intervals, noise and weather are those of the file, and so are
    instrument and site: a pipeline with this step needs neither. The stream enters as the component
    `recorded`: alone it is the signal, which filters and map makers then treat as any other; a
    `SkyMap` behind it is added to it; with `signal: none` there is the pointing alone, on which the
    other steps simulate a twin. Streams are read block by block. A mean that is large beside the
    scatter stands beside the stream, so that float32 keeps what is on top of tens of kelvin.

    Samples with a bit of `flag_mask` and detectors with one of `detector_mask` are not used; a
    single sample of a detector that the file flags (``detdata/flags``) becomes NaN, which filters
    bridge and maps drop. Streams compressed with FLAC need the package flacarray (``pip install
    'zonda[flac]'``).
    """

    knows_means = True

    @property
    def provides(self) -> frozenset[str]:
        """The pointing, and the recorded stream if it is wanted."""
        return frozenset({"boresight"} if self.signal is None else {"boresight", RECORDED})

    def check(self, data: Data) -> list[str]:
        """Describe the first scans in the files."""
        first = len(data.observations)
        with warnings.catch_warnings():  # observing says it again
            warnings.simplefilter("ignore")
            self.observe(data)
        found = data.observations[first:]
        lines = [_summary(o) for o in found[:MOST_TOLD]]
        more = len(found) - MOST_TOLD
        return lines + ([f"and {more} more scans"] if more > 0 else [])

    def observe(self, data: Data) -> None:
        """Append an observation for each scan; the scene's instrument and site become those of the
        files.

        Where the camera has several bands, the scans of each band then get the flags, intervals,
        weather and half-wave plate of their own files.
        """
        if not data.band:
            _Scans(self, data).append()
            return
        for observation in data.observations:
            if file := self.file_of(observation):
                file.state(observation)
                _tell(self.label, observation, file)

    def prepare(self, observation: Observation) -> RecordedStream | None:
        """Open the file, and find each detector's level. None: nothing of this scan is read."""
        stream = self.open(observation)
        return stream and stream.levelled(observation.n_detectors, observation.n_samples)

    def exec(self, block: Block, state: RecordedStream | None) -> None:
        """Read a block; add it to ``recorded``."""
        out = block.new(RECORDED)
        if state is None:
            return
        if state.mean is not None:
            block.means[RECORDED] = state.mean
        spoilt = state.add(block.detectors, block.samples, out)
        block.observation.log.count(
            self.label,
            "samples of single detectors that the file flags",
            spoilt,
        )

    def collect(self, data: Data, observation: Observation, state: RecordedStream | None) -> None:
        """Close the file."""
        if state is not None:
            state.file.close()

    def discard(self, observation: Observation, state: RecordedStream | None) -> None:
        """Close the file."""
        if state is not None:
            state.file.close()


@dataclass(frozen=True)
class _Scans:
    """Observations that a step makes of its files."""

    step: LoadTOD
    data: Data

    def append(self) -> None:
        """Append the observations."""
        step = self.step
        given = self.data.scene
        if self.data.observations:
            cure = (
                "give all files to one LoadTOD, file: [FILE, ...], and leave out other steps that"
                " point the telescope"
            )
            raise InputError(
                "stands behind a step that has made scans",
                place=step.label,
                cure=cure,
            )
        own = step.own_scene(given.instrument)
        if abs(given.time.seconds_since(own["time"])) > MOMENT:
            raise InputError(
                f"begins {own['time']}, the scene {given.time}: recorded data are of one night",
                place=f"{step.label}, {step.files[0].name}",
                cure="leave time out of the pipeline, and nights out of a campaign",
            )
        self.data.scene = given.model_copy(
            update={"site": own["site"], "instrument": own["instrument"]}
        )
        most = 0
        known = dict[Any, RecordedBand]()
        for scan in step.scans(given.instrument):
            for band in scan:
                self._check_new(band, known)
            most = most or len(scan)
            observation = self._observation(self._of_bands(scan, own["instrument"], most))
            step._scans[observation.index] = [File.of(band, step.flag_mask) for band in scan]
            file = step.file_of(observation)
            if file is not None and not own["instrument"].bands:
                _tell(step.label, observation, file)
            self.data.observations.append(observation)

    def _check_new(self, part: RecordedBand, known: dict[Any, RecordedBand]) -> None:
        """Note the used detectors of a band: start, name and direction.

        Raises InputError if a file before it has one of them.
        """
        tod = part.tod
        xi = part.tod.xi.tolist()
        eta = part.tod.eta.tolist()
        unused = (tod.detector_flags & np.uint8(self.step.detector_mask)) != 0
        for row in part.rows[~unused[part.rows]].tolist():
            key = str(tod.start), tod.names[row], xi[row], eta[row]
            if (other := known.setdefault(key, part)) is not part:
                what = (
                    f"the detector {tod.names[row]} at the times at which {other.path.name} has it"
                )
                cure = "give each file once"
                raise InputError(
                    f"has {what}: the same data would count twice",
                    place=f"{self.step.label}, {part.path}",
                    cure=cure,
                )

    def _of_bands(self, scan: Scan, instrument: Instrument, most: int) -> Scan:
        """The parts of a scan for each of the camera's bands; ``most``: bands of the first scan.

        Raises InputError if it is of another camera, lacks a band, or has one more.
        """
        place = f"{self.step.label}, {scan[0].path.name}"
        bands = {band.camera.band.name: band for band in scan}
        for name, camera in instrument.cameras.items():
            of = bands.get(name)
            if (
                of is None
                or of.camera.name != camera.name
                or not np.isclose(of.camera.band.centre, camera.band.centre, rtol=1e-3)
            ):
                what, first = (
                    ", ".join(f"{c.name} at {c.band.centre / 1e9:.4g} GHz" for c in cameras)
                    for cameras in ([band.camera for band in scan], [camera])
                )
                cure = "load the files of one instrument, all bands of each scan; or choose a band"
                raise InputError(
                    f"was recorded with {what}, the first scan with {first}",
                    place=place,
                    cure=cure,
                )
        if len(scan) > most:
            text = (
                f"has the bands {', '.join(bands)}, the first scan {', '.join(instrument.cameras)}"
            )
            raise InputError(
                text,
                place=place,
                cure="begin with a scan of all bands; or choose a band",
            )
        for part in (band for band in scan if band.path != scan[0].path):
            _check_same_scan(scan[0], part, f"{self.step.label}, {part.path.name}")
        return [bands[name] for name in instrument.cameras]

    def _observation(self, bands: Scan) -> Observation:
        """A scan; where the camera has several bands, their detectors follow each other."""
        tod = bands[0].tod
        scene = self.data.scene
        place = f"{self.step.label}, {bands[0].path}"
        start = Instant.parse(tod.start)
        plane = joined([b.camera for b in bands], place).focalplane()
        if (np.diff(tod.seconds) <= 0).any():
            row = int(np.flatnonzero(np.diff(tod.seconds) <= 0)[0]) + 1
            raise InputError(
                f"the times do not increase at sample {row}",
                place=place,
                cure="leave out the samples that repeat",
            )
        fwhm = tod.columns.get(
            "fwhm",
            plane.fwhm,
        )  # of all bands of the file, whichever are used; these alone have been checked
        tolerance = self.step.interpolation_error * float(fwhm[fwhm > 0].min())
        azel, radec, source = boresights(
            tod,
            start,
            scene.site,
            self.step.celestial,
            tolerance,
            place,
        )
        sample_flags = tod.sample_flags(self.step.flag_mask)
        good = flags.good(sample_flags, flags.EXCLUDE_SAMPLE)
        flagged = np.concatenate([b.tod.detector_flags[b.rows] for b in bands])
        dead = np.where(
            flagged & np.uint8(self.step.detector_mask),
            np.uint8(flags.INVALID),
            np.uint8(0),
        )
        observation = Observation(
            name=self._unique(tod.name, bands),
            index=len(self.data.observations),
            site=scene.site,
            instrument=bands[0].camera if len(bands) == 1 else scene.instrument,
            focalplane=plane,
            start=start,
            seconds=tod.seconds,
            sample_rate=tod.sample_rate,
            boresight_azel=azel,
            boresight_radec=radec,
            centre=self._centre(tod, radec, good),
            seed=scene.seed,
            flags=sample_flags,
            detector_flags=dead,
            intervals=tod.scan_intervals,
            weather=tod.weather,
            hwp_angle=tod.hwp_angle,
        )
        observation.recorded_azimuth = _recorded_azimuth(self.step.label, observation, tod)
        state_celestial(self.step.label, observation, source, tod.sample_rate)
        return observation

    def _centre(self, tod: TimeOrderedData, radec: Any, good: Any) -> tuple[float, float]:
        """ICRS (ra, dec) [rad] of the centre of the map."""
        target = self.step.target or self.data.scene.target
        if target is not None and target.frame != "horizontal":
            found: tuple[float, float] = target.icrs()
            return found
        if {"centre_ra", "centre_dec"} <= set(tod.metadata):
            return float(tod.metadata["centre_ra"]), float(tod.metadata["centre_dec"])
        return middle(radec, good)

    def _unique(self, name: str, bands: Scan) -> str:
        """The scan's name, of several bands without the first band's, with a number if another scan
        has it.
        """
        if len(bands) > 1:
            name = name.removesuffix(f"-{bands[0].camera.band.name}")
        taken = {o.name for o in self.data.observations}
        number = 2
        found = name
        while found in taken:
            found = f"{name}.{number}"
            number = number + 1
        return found


def boresights(
    tod: TimeOrderedData,
    start: Instant,
    site: Site,
    celestial: Literal["recorded", "recomputed"] | None,
    tolerance: float,
    place: str,
) -> tuple[Floats, Floats, str]:
    """The boresights (n, 4) of a file above the horizon and on the sky, and in words where the
    latter come from; the rotation of the focal plane about the boresight is kept.

    Raises InputError where those that are asked for cannot be had.
    """
    azel = tod.boresight_azel
    radec = tod.boresight_radec
    for name, values in (("boresight_azel", azel), ("boresight_radec", radec)):
        far = np.flatnonzero(np.abs(np.einsum("ij,ij->i", values, values) - 1) > 1e-6)
        if far.size:
            raise InputError(
                f"{name} is no rotation at sample {far[0]}",
                place=place,
                cure="make quaternions of length 1",
            )
    if celestial == "recorded" and not len(radec):
        cure = "set celestial: recomputed, or leave it out"
        raise InputError("has no boresight_radec", place=place, cure=cure)
    if celestial == "recomputed" and not len(azel):
        raise InputError("has no boresight_azel", place=place, cure="leave celestial out")
    if len(radec) and len(azel) and celestial != "recomputed":
        return azel, radec, "as recorded"
    transform = CelestialTransform(site, start, float(tod.seconds[-1]), tolerance)
    known = azel if len(azel) else radec
    looking = directions(known)
    horizontal = looking if len(azel) else transform.horizontal(looking, tod.seconds)
    _, upright_azel, upright_radec = transform.boresight(horizontal, tod.seconds)
    # what the boresight is turned about itself: Rz(psi) of R = R_upright Rz(psi)
    turn = multiply(conjugate(upright_azel if len(azel) else upright_radec), known)
    if len(azel):
        return azel, multiply(upright_radec, turn), "recomputed from azimuth, elevation and time"
    return multiply(upright_azel, turn), radec, "as recorded; azimuth and elevation are computed"


def state_celestial(label: str, observation: Observation, source: str, rate: float) -> None:
    """State where directions come from, how even the times are, and how many gaps there are."""
    observation.log.state(label, f"{observation.name}: directions on the sky", source)
    steps = np.diff(observation.seconds) * rate
    if steps.size and (gaps := int(np.count_nonzero(steps > GAP))):
        what = f"{observation.name}: gaps between samples, which filters and noise do not see"
        observation.log.count(label, what, gaps, steps.size)
    if observation.jitter * rate > 1e-3:
        text = (
            f"depart from a comb of {rate:.6g} Hz by {observation.jitter * 1e3:.3g} ms rms; noise"
            " and filters count samples"
        )
        observation.log.state(label, f"{observation.name}: times of the samples", text)


def _check_same_scan(first: RecordedBand, part: RecordedBand, place: str) -> None:
    """Raise InputError if a file has the times of another, and other directions, site or rate."""
    stated: tuple[tuple[str, Any, float], ...] = (
        ("boresight_azel", lambda tod: tod.boresight_azel, 0.0),
        ("boresight_radec", lambda tod: tod.boresight_radec, 0.0),
        ("site", lambda tod: (*np.degrees(tod.site[1:3]), tod.site[3]), SAME_NUMBER),
        ("sample rate", lambda tod: tod.sample_rate, SAME_NUMBER),
    )
    for what, of, tolerance in stated:
        one = np.array(of(first.tod))
        own = np.array(of(part.tod))
        if one.shape != own.shape or not np.allclose(one, own, tolerance, SAME_DIRECTION):
            text = f"states another {what} than {first.path.name}, which has the same times"
            text += f": {own}, not {one}" if own.size <= 3 else ""
            cure = "correct the one that is wrong, load them one after the other, or choose a band"
            raise InputError(text, place=place, cure=cure)


def _tell(label: str, observation: Observation, file: File) -> None:
    """State what an observation of one band has of its file, and what is left out of it."""
    good = flags.good(file.flags, flags.EXCLUDE_SAMPLE)
    dead = observation.detector_flags != 0
    observation.log.state(label, "noise of the detectors", file.noise)
    observation.log.count(
        label,
        "samples that the file's flags exclude",
        int((~good).sum()),
        good.size,
    )
    observation.log.count(
        label,
        "detectors that the file's flags exclude",
        int(np.count_nonzero(dead)),
        len(dead),
    )


def _recorded_azimuth(label: str, observation: Observation, tod: TimeOrderedData) -> Floats | None:
    """The azimuth that a file states (n_samp,) [rad], and that of the boresight where it is no
    number; None: it states none, or one that is not the boresight's."""
    if tod.azimuth is None:
        return None
    own = np.asarray(observation.azimuth, np.float64)
    away = np.abs(np.angle(np.exp(1j * (tod.azimuth - own))))
    known = np.isfinite(away)
    if away[known].max(initial=0.0) > SAME_AZIMUTH:
        what = f"{observation.name}: the column azimuth is not used; it is not the boresight's"
        observation.log.state(label, what, f"{np.degrees(away[known].max()):.3g} deg away")
        return None
    return np.where(known, tod.azimuth, own)


def _summary(o: Observation) -> str:
    good = o.good_samples
    text = (
        f"{o.name}: {o.n_detectors} detectors x {o.n_samples} samples at {o.sample_rate:.6g} Hz,"
        f" {o.start}"
    )
    if good.any():
        low, high = np.degrees([o.elevation[good].min(), o.elevation[good].max()])
        text += f", elevation {low:.2f} to {high:.2f} deg"
    return f"{text}; {int(good.sum())} samples and {int(o.good_detectors.sum())} detectors are used"
