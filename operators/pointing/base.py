"""Base of the simulated scans: target, times, offsets, the telescope's limits, and the
`Observation`s that they append.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from pydantic import Discriminator, Field, Tag, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.time import Instant
from zonda.core.configuration.units import Angle, Fraction, SampleRate, Seconds
from zonda.core.data import Data, Observation
from zonda.core.errors import PointingError
from zonda.core.flags import Intervals
from zonda.core.instrument import Instrument
from zonda.core.numerics.celestial import Boresight, CelestialTransform
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.quaternions import series
from zonda.core.numerics.random import Key, normals, stream_key
from zonda.core.numerics.sphere import unit_vectors
from zonda.core.operator import Operator
from zonda.core.scene import Scene
from zonda.core.types import Floats

from .limits import LargestMotion, check_elevation, excess, what_fits, when_up
from .motion import POINTS, LargestDerivative, Quantity, SamplesPerBeam, motion
from .observed import centre_of, distances, observed, plot_step, report, state_times, transform_of

SCANS_LOOKED_AT, INSTANTS_LOOKED_AT = 12, 1 << 14
"""By `Pointing.check`: scans of a step, and instants of all of them."""

LONG = 3_000_000
"""Instants of all scans [samples] above which `Pointing.check` comes first: a second of work."""

MOST_SCANS = 1_000_000
_OFFSET_SIZE = math.radians(1 / 60)
_BOX = ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))


def kind(value: Any) -> str:
    """Kind of a parameter that is a name or a list."""
    return "name" if isinstance(value, str) else "list"


Offsets = Annotated[
    Annotated[Literal["none", "box"], Tag("name")]
    | Annotated[list[tuple[Angle, Angle]], Tag("list")],
    Discriminator(kind),
]
"""A named pattern of offsets, or the offsets themselves."""


class Aim(NamedTuple):
    """Centre of a scan."""

    transform: CelestialTransform
    target: Target
    offset: tuple[float, float]
    """rad on the sky, towards east and north; for az/el targets towards azimuth and up."""


class Scans(Operator):
    """Base of the steps that simulate scans within the telescope's limits, one after the other."""

    if TYPE_CHECKING:
        sample_rate: float | None
        check_limits: Literal["error", "warn"]
        interpolation_error: float

    provides = frozenset({"boresight"})

    def every(self) -> Sequence[Any]:
        """Scans of the step, in their order."""
        raise NotImplementedError

    def some(self, scans: Sequence[Any]) -> list[Any]:
        """Scans that `check` looks at."""
        raise NotImplementedError

    def length(self, scan: Any) -> float:
        """Duration of a scan, s."""
        raise NotImplementedError

    def maker(self, data: Data) -> Callable[[Any, float, LargestMotion], Observation]:
        """A function of a scan and a sample rate [Hz] that makes the observation, and adds its
        motion.
        """
        raise NotImplementedError

    def summary(self, scans: Sequence[Any], made: Sequence[Observation]) -> str:
        """The first line of what `check` says; ``made``: observations of those that it looks at."""
        raise NotImplementedError

    def observe(self, data: Data) -> None:
        """Append an observation for each scan."""
        self._observe(data, self.every(), self._rate(data))

    def check(self, data: Data) -> list[str]:
        """A selection of scans and instants: elevation, speed and acceleration, samples per beam,
        distances from Sun and Moon.
        """
        rate = self._rate(data)
        first = len(data.observations)
        scans = self.every()
        looked = self.some(scans)
        lengths = [self.length(scan) for scan in looked]
        self._observe(
            data,
            looked,
            min(rate, max(INSTANTS_LOOKED_AT / sum(lengths), 1 / max(lengths))),
        )
        made = data.observations[first:]
        for observation, length in zip(made, lengths, strict=True):
            observation.seen_of = max(round(length * rate), 1), rate
        elevations = np.degrees([(o.elevation.min(), o.elevation.max()) for o in made])
        part = "" if len(looked) == len(scans) else f" ({len(looked)} of them looked at)"
        topics = LargestMotion.TOPICS + SamplesPerBeam.TOPICS
        return [
            self.summary(scans, made) + part,
            f"elevation: {elevations.min():.2f} to {elevations.max():.2f} deg",
            *distances(made),
            *(f"{what}: {text}" for _, what, text in made[0].log if what.startswith(topics)),
        ]

    def plot(self, scene: Scene, ax: Any = None) -> Any:
        """Draw the scans of a scene, as `Observation.plot` does."""
        return plot_step(self, scene, ax)

    def _rate(self, data: Data) -> float:
        """Read-out rate, Hz."""
        return self.sample_rate or float(data.scene.instrument.sample_rate)

    def _observe(self, data: Data, scans: Sequence[Any], rate: float) -> None:
        """Append observations of scans, sampled at ``rate`` [Hz]."""
        make = self.maker(data)
        before = len(data.observations)
        moved = LargestMotion(data.scene.instrument.telescope)
        sampled = SamplesPerBeam()
        for scan in scans:
            observation = make(scan, rate, moved)
            sampled.add(observation, self._rate(data))
            data.observations.append(observation)
        report(self.label, data.observations[before:], moved, sampled)


class Pointing(Scans):
    """Base of the pointing operators: `scans` observations of `scan_duration`, `gap` apart, around
    one target.

    The mount is alt-azimuth without a field derotator: the focal plane's eta points to the zenith,
    so the parallactic rotation is in ``boresight_radec``. No refraction. A subclass gives `path`,
    the offsets from the target, or `directions`.
    """

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
    jitter: Seconds = quantity("0 s", ge=0, le=1, examples=["1 ms"])
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
        """Offsets (x, y) [rad] from the scan's centre on its tangent plane, each (n,); by default
        none.

        Each instant is independent of the others: a long scan is worked on in chunks.
        """
        return np.zeros(len(seconds)), np.zeros(len(seconds))

    def directions(self, aim: Aim, seconds: Floats) -> Floats:
        """Horizontal unit vectors (n, 3) north, west, up at ``seconds`` (n,) since the start of the
        scan.
        """
        target = aim.target
        offset = aim.offset
        found = series(3, len(seconds))
        for chunk in chunks(len(seconds)):
            if target.frame == "horizontal":
                x, y = self.path(seconds[chunk])
                found[chunk] = _on_tangent_plane(
                    -target.longitude,
                    target.latitude,
                    -(x + offset[0]),
                    y + offset[1],
                )
            else:
                found[chunk] = aim.transform.horizontal(
                    self._on_the_sky(aim, seconds[chunk]),
                    seconds[chunk],
                )
        return found

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

    def every(self) -> Sequence[int]:
        return range(self.number)

    def some(self, scans: Sequence[int]) -> list[int]:
        last = len(scans) - 1
        most = min(len(scans), SCANS_LOOKED_AT)
        return sorted({round(k) for k in np.linspace(0, last, most)})

    def length(self, scan: int) -> float:
        return self.scan_duration

    def summary(self, scans: Sequence[int], made: Sequence[Observation]) -> str:
        several = f" of {len(self.targets)} targets" if self.targets else ""
        return f"{len(scans)} scan{'s' if len(scans) > 1 else ''}{several} from {made[0].start}"

    def observe(self, data: Data) -> None:
        if self.number * self.scan_duration * self._rate(data) > LONG:
            from zonda.core.data import Data

            with warnings.catch_warnings():  # observing warns again, with better figures
                warnings.simplefilter("ignore")
                self.check(Data(scene=data.scene, observations=list(data.observations)))
        super().observe(data)

    def check(self, data: Data) -> list[str]:
        if self.jitter:
            rate = self._rate(data)
            n = max(min(round(self.scan_duration * rate), POINTS), 1)
            self._seconds(n, rate, self._jitter_key(data, 0))
            return self.model_copy(update={"jitter": 0.0}).check(data)
        return super().check(data)

    def maker(self, data: Data) -> Callable[[int, float, LargestMotion], Observation]:
        scene = data.scene
        targets = self.targets or [t for t in (self.target or scene.target,) if t is not None]
        if not targets:
            raise PointingError(
                "there is no target",
                place=self.label,
                cure="give the scene or this operator a target, e.g. 05h00m00s +20d00m00s",
            )
        begin = scene.time
        before = data.n_scans
        if data.observations:
            last = data.observations[-1]
            begin = last.start.shifted(last.duration + self.gap)

        def make(k: int, rate: float, moved: LargestMotion) -> Observation:
            start = begin.shifted(k * (self.scan_duration + self.gap))
            scan = self.of_scan(k, scene.instrument)
            target = targets[k // self.scans]
            return scan._scan(data, target, start, before + k, self._offset(k), rate, moved)

        return make

    def _jitter_key(self, data: Data, index: int) -> Key:
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
        scene = data.scene
        telescope = data.scene.instrument.telescope
        n = max(round(self.scan_duration * rate), 1)
        seconds = self._seconds(n, rate, self._jitter_key(data, index))
        transform = transform_of(scene, start, seconds[-1], self.interpolation_error)
        aim = Aim(transform, target, offset)
        horizontal, azel, radec = self.boresight(aim, seconds)
        place = f"{self.label}, scan {index} from {start}"
        total = self.number * self.scan_duration + (self.number - 1) * self.gap
        check_elevation(
            f"the scan of target '{target}'",
            horizontal,
            telescope,
            place,
            lambda: when_up(horizontal, transform, target, telescope, total),
        )
        observation = observed(
            self.label,
            scene,
            index,
            transform,
            seconds=seconds,
            sample_rate=rate,
            boresight_azel=azel,
            boresight_radec=radec,
            centre=centre_of(transform, target, seconds),
            flags=np.zeros(n, np.uint8),
            intervals=self.intervals(seconds),
        )
        self._check_motion(observation, aim, None if self.jitter else horizontal, place, moved)
        if self.jitter > 0:
            state_times(self.label, observation)
        if (wanted := self.scan_duration * rate) < 0.5:
            observation.log.state(
                self.label,
                f"{observation.name}: shorter than a sample",
                f"{wanted:.2g} of one; one is taken",
            )
        self.describe(observation)
        return observation

    def _seconds(self, n: int, rate: float, key: Key) -> Floats:
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
        rate = observation.sample_rate
        limits = moved.limits
        length = observation.n_samples / rate

        def track(scan: Pointing, step: float) -> Floats:
            return scan.directions(
                aim,
                np.arange(max(round(length / step), 1), dtype=np.float64) * step,
            )

        def of(scan: Pointing) -> dict[Quantity, LargestDerivative]:
            coarse = min(rate, POINTS / length)
            return motion(track(scan, 1 / coarse), coarse, limits, lambda step: track(scan, step))

        found = (
            of(self)
            if horizontal is None
            else motion(horizontal, rate, limits, lambda step: track(self, step))
        )
        moved.add(
            observation.name,
            found,
            place if self.check_limits == "error" else "",
            lambda over: what_fits(
                self,
                self.slows,
                found,
                over,
                lambda scan: not excess(of(scan), limits),
            ),
        )

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


class PointingStare(Pointing):
    """Boresight fixed on the target: tracking if it is ICRS or Galactic, at rest if it is az/el."""
