"""Pointing that was recorded at a telescope."""

from __future__ import annotations

import warnings
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import Field

from zonda.core import flags
from zonda.core.configuration.input_paths import InputPath
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.time import Instant
from zonda.core.configuration.units import Fraction, Seconds
from zonda.core.data import Data, Observation
from zonda.core.errors import InputError
from zonda.core.flags import cut_intervals
from zonda.core.numerics.quaternions import directions, middle
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.operator import Operator
from zonda.core.scene import Scene
from zonda.core.types import Bools, Floats

from .limits import check_elevation
from .motion import SamplesPerBeam
from .observed import centre_of, observed, plot_step, report, state_times, transform_of
from .recording import OUT_OF_ORDER, Comb, Recording, Scan, comb
from .recording_files import Clock, read_recording

MOST_CHECKED = 100_000
"""Samples of a scan that `zonda check` looks at."""

ANOTHER_DAY = 86400.0
"""s between the record and the scene's time from which a run warns: the weather is the scene's."""


FAR = np.radians(0.1)
"""rad between recorded and recomputed directions on the sky from which a run warns: no difference
of conventions is as large.
"""


class PointingRecorded(Operator):
    """Recorded scan: times and directions of the boresight, read from a file.

    HDF5 in TOAST's layout (what `SaveTOD` writes, too) or with datasets ``time``, ``az`` and ``el``
    (or ``ra`` and ``dec``, ICRS; attribute ``units``), a FITS table with such columns, CSV that
    begins with ``time [s], az [deg], el [deg]``; a column ``flags`` is kept, and TOAST's intervals.
    An antenna log of ASTE (DESHIMA's ``.ant``): scans alone are used. Azimuth and elevation are
    where the beam looks: the pointing model is applied.

    Times need not be a perfect comb. Pointing and atmosphere follow them as they are; noise and
    filters count samples. Gaps and rows that are not numbers become flagged samples: their noise
    and atmosphere go on, no map uses them, filters bridge them. All is counted. The telescope's
    limits of speed are not checked: it did move like that.
    """

    provides = frozenset({"boresight"})

    file: InputPath
    """HDF5, FITS table, CSV or antenna log of ASTE."""
    clock: Clock = "unix"
    """What times count: seconds since 1970 UTC (unix), days (mjd, UTC), or seconds since the
    scene's time (scene). Files of `SaveTOD` carry their own start."""
    split: Seconds = quantity("60 s", gt=0)
    """A longer gap ends the scan; what follows is another observation. Shorter ones are flagged
    samples.
    """
    target: Target | None = None
    """Centre of the map; the scene's target where absent, or else the middle of the scan."""
    flag_mask: int | None = Field(None, ge=0, le=255)
    """Bits of the file's flags that exclude a sample; others do not (those of the Sun are kept).
    Where absent: 15 in TOAST's layout and `SaveTOD`'s files (invalid, processing, turnaround,
    irregular); any bit in other files."""
    celestial: Literal["recorded", "recomputed"] | None = None
    """Where the boresight is on the sky: as recorded (``boresight_radec`` in TOAST's layout and
    `SaveTOD`'s files), or recomputed from azimuth, elevation and time. Where absent: as recorded
    where the file has it."""
    interpolation_error: Fraction = Field(1e-3, gt=0, le=0.1)
    """Largest error of interpolating the celestial transformation in time, as a fraction of the
    smallest beam's FWHM.
    """

    def check(self, data: Data) -> list[str]:
        """Summary of the file. Raises PointingError if the telescope cannot look there."""
        recording, found = self._read()
        for scan in found.scans:
            data.observations.append(self._observation(data, _thinned(scan), recording))
            data.observations[-1].seen_of = len(scan.seconds), scan.rate
        lines = [_summary(scan, recording.frame) for scan in found.scans]
        return lines + [f"{what}: {number}" for what, number in found.counts.items() if number]

    def observe(self, data: Data) -> None:
        """Append an observation for each part of the record without long gaps."""
        recording, found = self._read()
        first = len(data.observations)
        for text in _doubts(recording, found, data.scene.time, self.file):
            warnings.warn(f"{self.label}: {text}", stacklevel=2)
        sampled = SamplesPerBeam()
        for scan in found.scans:
            observation = self._observation(data, scan, recording)
            sampled.add(observation, observation.sample_rate)
            data.observations.append(observation)
        for what, number in found.counts.items():
            data.observations[first].log.count(self.label, what, number)
        report(self.label, data.observations[first:], sampled)

    def plot(self, scene: Scene, ax: Any = None) -> Any:
        """Draw the recorded scans, as `Observation.plot` does."""
        return plot_step(self, scene, ax)

    def _read(self) -> tuple[Recording, Comb]:
        place = f"{self.label}, {self.file}"
        recording = _on_the_sky(
            read_recording(self.file, self.clock, self.flag_mask),
            self.celestial,
            place,
        )
        return recording, comb(recording, self.split, place)

    def _observation(self, data: Data, scan: Scan, recording: Recording) -> Observation:
        """The observation of one scan. Raises PointingError if the telescope cannot look there."""
        scene = data.scene
        start = (recording.start or scene.time).shifted(float(scan.seconds[0]))
        seconds = scan.seconds - scan.seconds[0]
        transform = transform_of(scene, start, seconds[-1], self.interpolation_error)
        if recording.frame == "azel":
            horizontal = unit_vectors(-scan.longitude, scan.latitude)
        else:
            horizontal = transform.horizontal(unit_vectors(scan.longitude, scan.latitude), seconds)
        good = flags.good(scan.flags, flags.EXCLUDE_SAMPLE)
        check_elevation(
            "the boresight",
            horizontal[good],
            scene.instrument.telescope,
            f"{self.label}, {self.file}",
            lambda: "flag these rows, or correct site, clock, units or the telescope's limits",
            lambda row: f", {seconds[good][row]:.4g} s after {start}",
        )
        _, azel, computed = transform.boresight(horizontal, seconds)
        radec = computed if scan.radec is None else scan.radec
        target = self.target or scene.target
        centre = centre_of(transform, target, seconds) if target else middle(radec, good)
        observation = observed(
            self.label,
            scene,
            len(data.observations),
            transform,
            seconds=seconds,
            sample_rate=scan.rate,
            boresight_azel=azel,
            boresight_radec=radec,
            centre=centre,
            flags=scan.flags.copy(),
            intervals=cut_intervals(
                recording.intervals,
                float(scan.seconds[0]),
                float(scan.seconds[-1]),
            ),
        )
        state_times(self.label, observation)
        if recording.frame == "azel":
            observation.recorded_azimuth = scan.longitude
            _state_celestial(self.label, observation, computed, good)
        return observation


def _on_the_sky(recording: Recording, celestial: str | None, place: str) -> Recording:
    """The recording with those directions on the sky that ``celestial`` (`PointingRecorded`) asks
    for.
    """
    if celestial == "recorded" and recording.frame == "azel" and recording.radec is None:
        raise InputError(
            "has azimuth and elevation and no boresight_radec",
            place=place,
            cure="set celestial: recomputed, or leave it out",
        )
    return replace(recording, radec=None) if celestial == "recomputed" else recording


def _doubts(recording: Recording, found: Comb, time: Instant, file: Path) -> list[str]:
    """Warnings of a run: a record of another day than the scene's, rows out of order."""
    texts = []
    start = recording.start or time
    if abs(time.seconds_since(start)) > ANOTHER_DAY:
        texts.append(
            f"the record begins {start}, the weather is that of {time}: set the scene's time"
        )
    if number := found.counts[OUT_OF_ORDER]:
        texts.append(
            f"{number} rows of {file} were dropped: their times jump ahead or back; is its clock"
            " right?"
        )
    return texts


def _thinned(scan: Scan) -> Scan:
    """At most about `MOST_CHECKED` samples of a scan."""
    thin = slice(None, None, -(-len(scan.seconds) // MOST_CHECKED))
    series = {k: getattr(scan, k)[thin] for k in ("seconds", "longitude", "latitude", "flags")}
    return replace(
        scan,
        rate=scan.rate / thin.step,
        radec=None if scan.radec is None else scan.radec[thin],
        **series,
    )


def _summary(scan: Scan, frame: str) -> str:
    """Samples, length and elevations of a scan."""
    text = (
        f"{len(scan.seconds)} samples at {scan.rate:.6g} Hz,"
        f" {scan.seconds[-1] - scan.seconds[0]:.1f} s"
    )
    good = flags.good(scan.flags, flags.EXCLUDE_SAMPLE)
    if frame == "azel" and good.any():
        low, high = np.degrees([scan.latitude[good].min(), scan.latitude[good].max()])
        text += f", elevation {low:.2f} to {high:.2f} deg"
    return text


def _state_celestial(
    label: str,
    observation: Observation,
    computed: Floats,
    good: Bools,
) -> None:
    """State which directions on the sky are used, and how far recorded ones are from those that
    follow from az and el.
    """
    text = "recomputed from azimuth, elevation and time"
    if observation.boresight_radec is not computed:
        looked = np.flatnonzero(good)[:: max(1, int(good.sum()) // MOST_CHECKED)]
        apart = np.linalg.norm(
            directions(observation.boresight_radec[looked]) - directions(computed[looked]),
            axis=1,
        )
        most = 2 * float(np.arcsin(apart.max(initial=0.0) / 2))
        text = f"as recorded, up to {np.degrees(most) * 3600:.3g} arcsec from those {text}"
        if most > FAR:
            cure = "are site and clock right? celestial: recomputed takes azimuth and elevation"
            warnings.warn(
                f"{label}: {observation.name}: directions on the sky are {text}: {cure}",
                stacklevel=4,
            )
    observation.log.state(label, f"{observation.name}: directions on the sky", text)
