"""What all scans share: target, times, offsets, the telescope's limits, and the `Observation`s they append."""

from __future__ import annotations

import math
import warnings
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Discriminator, Field, Tag, model_validator

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.target import Target
from zonda.core.configuration.units import Angle, Fraction, Hertz, Seconds
from zonda.core.data import Observation
from zonda.core.errors import PointingError
from zonda.core.knobs import Knob
from zonda.core.operator import Operator

from .limits import check_elevation, check_motion
from .transform import CelestialTransform, unit_vectors

if TYPE_CHECKING:
    from zonda.core.configuration.time import Instant
    from zonda.core.data import Data
    from zonda.core.plan.context import Context
    from zonda.core.plan.estimate import Estimate

Floats = NDArray[np.float64]

_OFFSET_SIZE = math.radians(1 / 60)
_BOX = ((0.5, 0.5), (-0.5, 0.5), (-0.5, -0.5), (0.5, -0.5))


def _kind(value: Any) -> str:
    return "name" if isinstance(value, str) else "list"


Offsets = Annotated[
    Annotated[Literal["none", "box"], Tag("name")] | Annotated[list[tuple[Angle, Angle]], Tag("list")], Discriminator(_kind)
]
"""A named pattern of offsets, or the offsets themselves."""


class Pointing(Operator):
    """Base of the pointing operators: `scans` observations of `scan_duration`, `gap` apart, around one target.

    The mount is alt-azimuth without a field derotator: the focal plane's eta points to the zenith, so the parallactic
    rotation is in ``boresight_radec``. No refraction. A subclass gives `path`, the offsets from the target, or `directions`.
    """

    provides: ClassVar[frozenset[str]] = frozenset({"boresight"})
    knobs: ClassVar[tuple[Knob, ...]] = (
        Knob("interpolation_error", (0.1, 0.01, 1e-3, 1e-4), "celestial transformation interpolated between nodes in time"),
    )

    target: Target | None = None
    """Centre of the scans; the scene's target where absent."""
    scan_duration: Seconds = quantity("8.6 min", gt=0, le=86400 * 31)
    """Length of one scan."""
    scans: int = Field(1, ge=1, le=1_000_000)
    """Number of scans; each becomes an observation."""
    gap: Seconds = quantity("30 s", ge=0)
    """Time between the end of a scan and the start of the next (slew and settle)."""
    offsets: Offsets = "none"
    """Where the scans are centred, in turn: all on the target; on the corners of a box of side `offset_size`, so that each
    scan moves by that much; or a list of offsets on the sky (towards east and north, for az/el towards azimuth and up)."""
    offset_size: Angle = quantity("1 arcmin", gt=0, le=0.1)
    """Side of the box of `offsets: box`."""
    sample_rate: Hertz | None = Field(None, gt=0, le=1e6)
    """Read-out rate; the instrument's where absent."""
    interpolation_error: Fraction = Field(1e-3, gt=0, le=0.1)
    """Largest error of interpolating the celestial transformation in time, as a fraction of the smallest beam's FWHM."""

    @model_validator(mode="after")
    def _offsets_are_used(self) -> Pointing:
        if self.offsets != "box" and abs(self.offset_size - _OFFSET_SIZE) > 1e-15:
            raise ValueError("offset_size is the side of the box: set offsets: box with it, or leave it out")
        if isinstance(self.offsets, list):
            if not self.offsets:
                raise ValueError("the list of offsets is empty; write none instead")
            if max(abs(v) for pair in self.offsets for v in pair) > 0.1:
                raise ValueError("offsets must be below 0.1 rad (5.7 deg)")
        return self

    # -- what a subclass gives --

    def path(self, seconds: Floats) -> tuple[Floats, Floats]:
        """Offsets (x, y) [rad] from the scan's centre on its tangent plane, each (n,)."""
        raise NotImplementedError

    def directions(self, transform: CelestialTransform, target: Target, offset: tuple[float, float], seconds: Floats) -> Floats:
        """Horizontal unit vectors (n, 3) north, west, up at ``seconds`` (n,) since the start of the scan."""
        x, y = self.path(seconds)
        x, y = x + offset[0], y + offset[1]
        if target.frame == "horizontal":
            return _on_tangent_plane(-target.longitude, target.latitude, -x, y)
        return transform.horizontal(_on_tangent_plane(*target.icrs(), x, y), seconds)

    def flag(self, seconds: Floats) -> NDArray[np.uint8]:
        """Sample flags (n,); nonzero means: do not use."""
        return np.zeros(len(seconds), np.uint8)

    def state(self, observation: Observation) -> None:
        """Tell the tally what else should be known of this scan."""

    def estimate(self, context: Context) -> Estimate:
        """What the pointing carries exactly, and what it leaves out."""
        from .estimate import pointing_estimate

        return pointing_estimate(self, context)

    # -- the scans --

    def observe(self, data: Data) -> None:
        scene = data.scene
        target = self.target or scene.target
        if target is None:
            raise PointingError(
                "there is no target",
                place=self.label,
                cure="give the scene or this operator a target, e.g. 05h00m00s +20d00m00s",
            )
        begin = scene.time
        if data.observations:
            last = data.observations[-1]
            begin = last.start.shifted(last.duration + self.gap)
        for k in range(self.scans):
            start = begin.shifted(k * (self.scan_duration + self.gap))
            data.observations.append(self._scan(data, target, start, self._offset(k), len(data.observations)))

    def _scan(self, data: Data, target: Target, start: Instant, offset: tuple[float, float], index: int) -> Observation:
        scene, instrument = data.scene, data.scene.instrument
        focalplane = instrument.focalplane()
        rate = self.sample_rate or instrument.sample_rate
        seconds = np.arange(max(round(self.scan_duration * rate), 1)) / rate
        beam = float(focalplane.fwhm.min())
        transform = CelestialTransform(scene.site, start, seconds[-1], self.interpolation_error * beam)

        horizontal = self.directions(transform, target, offset, seconds)
        middle = np.array([(seconds[0] + seconds[-1]) / 2])
        if target.frame == "horizontal":
            towards = transform.icrs(unit_vectors([-target.longitude], [target.latitude]), middle)[0]
            centre = (math.atan2(towards[1], towards[0]) % (2 * math.pi), math.atan2(towards[2], math.hypot(*towards[:2])))
        else:
            centre = target.icrs()
        place = f"{self.label}, scan {index} from {start}"
        total = self.scans * self.scan_duration + (self.scans - 1) * self.gap
        check_elevation(horizontal, transform, target, instrument.telescope, total, place)
        check_motion(horizontal, rate, instrument.telescope, place)

        azel, radec = transform.boresight(horizontal, seconds)
        observation = Observation(
            name=f"scan-{index:03d}",
            index=index,
            site=scene.site,
            instrument=instrument,
            focalplane=focalplane,
            start=start,
            seconds=seconds,
            sample_rate=rate,
            boresight_azel=azel,
            boresight_radec=radec,
            centre=centre,
            seed=scene.seed,
            flags=self.flag(seconds),
        )
        error = f"{transform.error:.1e} rad, {transform.error / beam:.1e} of a beam (nodes every {transform.spacing:g} s)"
        observation.tally.state(self.label, "interpolation error of the pointing", error)
        observation.tally.state(self.label, "Earth orientation", transform.source)
        if not transform.orientation_known:
            warnings.warn(f"{self.label}: Earth orientation at {start}: {transform.source}", stacklevel=2)
        if (wanted := self.scan_duration * rate) < 0.5:
            observation.tally.state(
                self.label, f"{observation.name}: shorter than a sample", f"{wanted:.2g} of one; one is taken"
            )
        self.state(observation)
        return observation

    def _offset(self, k: int) -> tuple[float, float]:
        if self.offsets == "none":
            return 0.0, 0.0
        if self.offsets == "box":
            x, y = _BOX[k % len(_BOX)]
            return x * self.offset_size, y * self.offset_size
        return self.offsets[k % len(self.offsets)]


def _on_tangent_plane(longitude: float, latitude: float, x: Floats, y: Floats) -> Floats:
    """Unit vectors (n, 3) at gnomonic offsets x (towards increasing longitude) and y (latitude) [rad]."""
    east = np.array([-math.sin(longitude), math.cos(longitude), 0.0])
    centre = unit_vectors(longitude, latitude)
    north = np.cross(centre, east)
    plane = centre + np.multiply.outer(x, east) + np.multiply.outer(y, north)
    directions: Floats = plane / np.sqrt(1 + x * x + y * y)[:, None]
    return directions
