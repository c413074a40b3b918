"""Base of the simulated scans: target, times, offsets, the telescope's limits, and the
`Observation`s that they append.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle, Fraction, SampleRate, Seconds
from zonda.core.errors import PointingError
from zonda.core.intervals import Intervals
from zonda.core.numerics.celestial import Boresight, CelestialTransform
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.quaternions import series
from zonda.core.numerics.random import normals, stream_key
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.operator import Operator
from zonda.core.types import Floats

from .limits import LargestMotion, check_elevation, excess, what_fits
from .motion import POINTS, LargestDerivative, Quantity, motion
from .observed import Samples, centre_of, observed, report, state_times
from .samples_per_beam import SamplesPerBeam
from .sun_and_moon import distances

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.data import Data, Observation
    from zonda.core.instrument import Instrument

SCANS_LOOKED_AT, INSTANTS_LOOKED_AT = 12, 1 << 14
"""By `Pointing.check`: scans of a step, and instants of all of them."""

LONG = 3_000_000
"""Instants of all scans [samples] above which `Pointing.check` comes first: a second of work."""

MOST_SCANS = 1_000_000
_OFFSET_SIZE = math.radians(1 / 60)
_BOX = ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))


def _kind(value: Any) -> str:
    return "name" if isinstance(value, str) else "list"


Offsets = Annotated[
    Annotated[Literal["none", "box"], Tag("name")]
    | Annotated[list[tuple[Angle, Angle]], Tag("list")],
    Discriminator(_kind),
]
"""A named pattern of offsets, or the offsets themselves."""


class Aim(NamedTuple):
    """Centre of a scan."""

    transform: CelestialTransform
    target: Target
    offset: tuple[float, float]
    """rad on the sky, towards east and north; for az/el targets towards azimuth and up."""


class Pointing(Operator):
    """Base of the pointing operators: `scans` observations of `scan_duration`, `gap` apart, around
    one target.

    The mount is alt-azimuth without a field derotator: the focal plane's eta points to the zenith,
    so the parallactic rotation is in ``boresight_radec``. No refraction. A subclass gives `path`,
    the offsets from the target, or `directions`.
    """

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})

    target: Target | None = None
    """Centre of the scans; the scene's target where absent."""
    targets: list[Target] | None = Field(None, min_length=1, max_length=10_000)
    """Several targets instead, for a mosaic in one map: `scans` of the first, then as many of the
    next, and so on.
    """
    scan_duration: Seconds = quantity("8.6 min", gt=0, le=86400 * 31)
    """Length of one scan."""
    scans: int = Field(1, ge=1, le=1_000_000)
    """Number of scans of each target; each becomes an observation."""
    gap: Seconds = quantity("30 s", ge=0)
    """Time between the end of a scan and the start of the next (slew and settle)."""
    offsets: Offsets = "none"
    """Where the scans are centred, in turn: all on the target; on the corners of a box of side
    `offset_size`, so that each scan moves by that much; or a list of offsets on the sky (towards
    east and north, for az/el towards azimuth and up)."""
    offset_size: Angle = quantity("1 arcmin", gt=0, le=0.1)
    """Side of the box of `offsets: box`."""
    sample_rate: SampleRate | None = Field(None, gt=0, le=1e6)
    """Read-out rate; the instrument's where absent."""
    jitter: Seconds = quantity("0 s", ge=0, le=1)
    """rms by which samples are taken early or late (Gaussian, known: the times in the products are
    the true ones).
    """
    check_limits: Literal["error", "warn"] = "error"
    """Whether a scan beyond the telescope's largest speed, acceleration or jerk is an error, or a
    warning.
    """
    interpolation_error: Fraction = Field(1e-3, gt=0, le=0.1)
    """Largest error of interpolating the celestial transformation in time, as a fraction of the
    smallest beam's FWHM.
    """

    @model_validator(mode="after")
    def _one_or_several_targets(self) -> Pointing:
        if self.target is not None and self.targets is not None:
            raise ValueError("give target, or targets for a mosaic")
        if self.number > MOST_SCANS:
            raise ValueError(f"{self.number} scans; at most {MOST_SCANS}")
        return self

    @model_validator(mode="after")
    def _offsets_are_used(self) -> Pointing:
        if self.offsets != "box" and abs(self.offset_size - _OFFSET_SIZE) > 1e-15:
            raise ValueError(
                "offset_size is the side of the box: set offsets: box with it, or leave it out"
            )
        if isinstance(self.offsets, list):
            if not self.offsets:
                raise ValueError("the list of offsets is empty; write none instead")
            if max(abs(v) for pair in self.offsets for v in pair) > 0.1:
                raise ValueError("offsets must be below 0.1 rad (5.7 deg)")
        return self

    slows: ClassVar[dict[str, tuple[int, int]]] = {}
    """Parameters that make a scan easier for the telescope: -1 to lower, 1 to raise it; and the
    power of 1/s in its unit.
    """

    # -- what a subclass gives --

    def of_scan(self, number: int, instrument: Instrument) -> Pointing:
        """The step as it is in the scan ``number``, counted from 0: itself, where scans do not
        differ.
        """
        return self

    def path(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Offsets (x, y) [rad] from the scan's centre on its tangent plane, each (n,).

        Each instant is independent of the others: a long scan is worked on in chunks.
        """
        raise NotImplementedError

    def directions(self, aim: Aim, seconds: Floats) -> Floats:
        """Horizontal unit vectors (n, 3) north, west, up at ``seconds`` (n,) since the start of the
        scan.
        """
        target, offset = aim.target, aim.offset
        found = series(3, len(seconds))
        for chunk in chunks(len(seconds)):
            if target.frame == "horizontal":
                x, y = self.path(seconds[chunk])
                found[chunk] = _on_tangent_plane(
                    -target.longitude, target.latitude, -(x + offset[0]), y + offset[1]
                )
            else:
                found[chunk] = aim.transform.horizontal(
                    self._on_the_sky(aim, seconds[chunk]), seconds[chunk]
                )
        return found

    def flag(self, seconds: Floats) -> NDArray[np.uint8]:
        """Sample flags (n,), bits of `core.flags`."""
        return np.zeros(len(seconds), np.uint8)

    def intervals(self, seconds: Floats) -> Intervals:
        """Parts of a scan whose samples are taken at ``seconds`` (n,), by TOAST's names; by default
        all is *scanning*.
        """
        return {}

    def describe(self, observation: Observation) -> None:
        """Note what else is known of this scan: in the log, its flags and its intervals."""

    def _on_the_sky(self, aim: Aim, seconds: Floats) -> Floats:
        """ICRS unit vectors (n, 3) of a `path` about a celestial target."""
        x, y = self.path(seconds)
        return _on_tangent_plane(*aim.target.icrs(), x + aim.offset[0], y + aim.offset[1])

    def boresight(self, aim: Aim, seconds: Floats) -> Boresight:
        """Boresight at ``seconds`` (n,) since the start of the scan."""
        if type(self).directions is Pointing.directions and aim.target.frame != "horizontal":
            return aim.transform.follow(lambda chunk: self._on_the_sky(aim, chunk), seconds)
        return aim.transform.boresight(self.directions(aim, seconds), seconds)

    # -- the scans --

    @property
    def number(self) -> int:
        """Number of scans of all targets."""
        return self.scans * len(self.targets or [None])

    def observe(self, data: Data) -> None:
        rate = self.sample_rate or data.scene.instrument.sample_rate
        if self.number * self.scan_duration * rate > LONG:
            from zonda.core.data import Data

            with warnings.catch_warnings():  # observing warns again, with better figures
                warnings.simplefilter("ignore")
                self.check(Data(scene=data.scene, observations=list(data.observations)))
        self._observe(data, range(self.number), rate)

    def check(self, data: Data) -> list[str]:
        """A selection of scans and instants: elevation, speed and acceleration, samples per
        beam.
        """
        rate = self.sample_rate or data.scene.instrument.sample_rate
        looked = sorted(
            {round(k) for k in np.linspace(0, self.number - 1, min(self.number, SCANS_LOOKED_AT))}
        )
        coarse = min(
            rate,
            max(INSTANTS_LOOKED_AT / (len(looked) * self.scan_duration), 1 / self.scan_duration),
        )
        self._seconds(
            max(min(round(self.scan_duration * rate), POINTS), 1), rate, self._jitter_key(data, 0)
        )
        first = len(data.observations)
        self.model_copy(update={"jitter": 0.0})._observe(data, looked, coarse)
        made = data.observations[first:]
        for observation in made:
            observation.seen_of = max(round(self.scan_duration * rate), 1), rate
        elevations = np.degrees([(o.elevation.min(), o.elevation.max()) for o in made])
        part = "" if len(looked) == self.number else f" ({len(looked)} of them looked at)"
        several = f" of {len(self.targets)} targets" if self.targets else ""
        lines = [
            f"{self.number} scan{'s' if self.number > 1 else ''}{several} from"
            f" {made[0].start}{part}"
        ]
        lines.append(f"elevation: {elevations.min():.2f} to {elevations.max():.2f} deg")
        motion = LargestMotion.TOPICS + SamplesPerBeam.TOPICS
        lines += distances(made)
        return lines + [
            f"{what}: {text}" for _, what, text in made[0].tally if what.startswith(motion)
        ]

    def _observe(self, data: Data, which: Sequence[int], rate: float) -> None:
        """Append the scans ``which``, sampled at ``rate`` [Hz]."""
        scene = data.scene
        targets = self.targets or [t for t in (self.target or scene.target,) if t is not None]
        if not targets:
            raise PointingError(
                "there is no target",
                place=self.label,
                cure="give the scene or this operator a target, e.g. 05h00m00s +20d00m00s",
            )
        begin, before, first = scene.time, data.n_scans, len(data.observations)
        if data.observations:
            last = data.observations[-1]
            begin = last.start.shifted(last.duration + self.gap)
        moved, sampled = LargestMotion(scene.instrument.telescope), SamplesPerBeam()
        for k in which:
            start = begin.shifted(k * (self.scan_duration + self.gap))
            target = targets[k // self.scans]
            observation = self.of_scan(k, scene.instrument)._scan(
                data, target, start, before + k, self._offset(k), rate, moved
            )
            sampled.add(observation, self.sample_rate or scene.instrument.sample_rate)
            data.observations.append(observation)
        report(self.label, data.observations[first:], moved, sampled)

    def _jitter_key(self, data: Data, index: int) -> NDArray[np.uint32]:
        return stream_key(data.scene.seed, self.label, "jitter", index)

    def _scan(
        self,
        data: Data,
        target: Target,
        start: Instant,
        index: int,
        offset: tuple[float, float],
        rate: float,
        moved: LargestMotion,
    ) -> Observation:
        """The observation ``index``, sampled at ``rate`` [Hz]."""
        scene, instrument = data.scene, data.scene.instrument
        seconds = self._seconds(
            max(round(self.scan_duration * rate), 1), rate, self._jitter_key(data, index)
        )
        beam = float(instrument.focalplane().fwhm.min())
        transform = CelestialTransform(
            scene.site, start, seconds[-1], self.interpolation_error * beam
        )
        aim = Aim(transform, target, offset)
        horizontal, *boresight = self.boresight(aim, seconds)
        place = f"{self.label}, scan {index} from {start}"
        total = self.number * self.scan_duration + (self.number - 1) * self.gap
        check_elevation(horizontal, transform, target, instrument.telescope, total, place)
        samples = Samples(
            seconds, rate, (boresight[0], boresight[1]), self.flag(seconds), self.intervals(seconds)
        )
        observation = observed(
            self.label, scene, index, transform, centre_of(transform, target, seconds), samples
        )
        self._check_motion(observation, aim, None if self.jitter else horizontal, place, moved)
        if self.jitter > 0:
            state_times(self.label, observation)
        if (wanted := self.scan_duration * rate) < 0.5:
            observation.tally.state(
                self.label,
                f"{observation.name}: shorter than a sample",
                f"{wanted:.2g} of one; one is taken",
            )
        self.describe(observation)
        return observation

    def _seconds(self, n: int, rate: float, key: NDArray[np.uint32]) -> Floats:
        """When the samples are taken."""
        seconds = np.arange(n) / rate
        if self.jitter == 0:
            return seconds
        seconds += self.jitter * normals(key, 0, n).astype(np.float64)
        if (np.diff(seconds) <= 0).any():
            raise PointingError(
                f"a jitter of {self.jitter * 1e3:.4g} ms would reorder samples: they come every"
                f" {1e3 / rate:.4g} ms",
                place=self.label,
                cure=f"lower jitter to {100 / rate:.3g} ms",
            )
        return seconds

    # -- what the telescope can do --

    def _check_motion(
        self,
        observation: Observation,
        aim: Aim,
        horizontal: Floats | None,
        place: str,
        moved: LargestMotion,
    ) -> None:
        """Compare the track with the telescope's limits; raise where it exceeds one that it must
        keep.
        """
        rate, limits = observation.sample_rate, moved.limits
        length = observation.n_samples / rate

        def track(scan: Pointing, step: float) -> Floats:
            return scan.directions(
                aim, np.arange(max(round(length / step), 1), dtype=np.float64) * step
            )

        def of(scan: Pointing) -> dict[Quantity, LargestDerivative]:
            coarse = min(rate, POINTS / length)
            return motion(track(scan, 1 / coarse), coarse, limits, lambda step: track(scan, step))

        found = (
            of(self)
            if horizontal is None
            else motion(horizontal, rate, limits, lambda step: track(self, step))
        )
        over = excess(found, limits)
        if over and self.check_limits == "error":
            cure = what_fits(
                self, self.slows, found, over, lambda scan: not excess(of(scan), limits)
            )
            raise PointingError(moved.too_fast(next(iter(over)), found), place=place, cure=cure)
        moved.add(observation.name, found)

    def _offset(self, k: int) -> tuple[float, float]:
        if self.offsets == "none":
            return 0.0, 0.0
        if self.offsets == "box":
            x, y = _BOX[k % len(_BOX)]
            return x * self.offset_size, y * self.offset_size
        return self.offsets[k % len(self.offsets)]


def _on_tangent_plane(longitude: float, latitude: float, x: Floats, y: Floats) -> Floats:
    """Unit vectors (n, 3) at gnomonic offsets x (towards increasing longitude) and y (latitude)
    [rad].
    """
    east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
    centre = unit_vectors(longitude, latitude)
    north = np.cross(centre, east)
    scale = 1 / np.sqrt(1 + x * x + y * y)
    directions = np.empty((len(x), 3))
    for k in range(3):
        np.multiply(centre[k] + x * east[k] + y * north[k], scale, out=directions[:, k])
    return directions
