"""Forecast of a map: its depth against time, in the units that observers use."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from zonda.core.errors import InputError

from . import lines
from .depth import PARTS, Depth, times
from .survey import Survey

if TYPE_CHECKING:
    from zonda.core.configuration.loaded import PipelineFile

    from .audit import Audited
    from .calculator import Calculated


@dataclass(frozen=True)
class Forecast:
    """The depth of a map against time.

    Attributes
    ----------
    file, survey
        The pipeline, and its scans.
    depth
        White noise, 1/f noise and atmosphere behind the beam, K_RJ; of I where the map is one of I,
        Q and U.
    radius
        Of the circle that they are averaged over, rad.
    seconds
        The integration time that was asked for; that of the pipeline's scans where none was.
    factors
        By unit what a depth in K_RJ is multiplied by (`depth.factors`).
    calculated
        What the AtLAST calculator's formula gives for that time; None: the scene has no atmosphere.
    audit
        Simulated depths, see `Sensitivity.audited`; None: nothing was simulated.
    band
        Name of the band, where the camera has several.
    polarization
        The depths of Q and of U by these names, where the map is one of I, Q and U.
    """

    file: PipelineFile
    survey: Survey
    depth: Depth
    radius: float
    seconds: float
    factors: Mapping[str, float]
    calculated: Calculated | None
    audit: Audited | None = None
    band: str = ""
    polarization: Mapping[str, Depth] = field(default_factory=dict)

    @property
    def planes(self) -> dict[str, Depth]:
        """The depths of all planes of the map: of I, or of I, Q and U."""
        return {"I": self.depth, **self.polarization}

    @property
    def camera(self) -> str:
        """The camera's name, and the band's where it has several."""
        name = self.survey.scene.instrument.name
        return f"{name}, band {self.band}" if self.band else name

    def rms(
        self, seconds: float | None = None, unit: str = "K_RJ", part: str = "", stokes: str = "I"
    ) -> float:
        """The depth after an integration time [s] in a unit (`depth.UNITS`): of a part
        (`depth.PARTS`), or of all; ``stokes``: of which plane of the map. NaN of a part that is not
        forecast, and of all without it.

        Raises InputError for an unknown unit, part or plane, and a time that is not positive.
        """
        wanted = self.seconds if seconds is None else seconds
        if unit not in self.factors or part not in ("", *PARTS):
            cure = (
                f"units are {', '.join(self.factors)}; parts are {', '.join(PARTS)}, or none"
                " for all"
            )
            raise InputError(f"no depth in {unit!r} of {part!r}", place="sensitivity", cure=cure)
        if not wanted > 0:
            raise InputError(f"a time of {wanted:g} s is not positive", place="sensitivity")
        depth = self._plane(stokes)
        found = depth.part(part, wanted) if part else depth.total(wanted)
        return float(found) * self.factors[unit]

    def reach(self, rms: str | float, stokes: str = "I") -> float:
        """Integration time [s] after which the map is as deep as ``rms``: text with a unit of
        `depth.UNITS` (``10 uK``, which is K_RJ; ``10 uK_CMB``, ``0.1 mJy/beam``), or K_RJ. Beyond
        the scans of the pipeline all parts fall as time^-1/2. ``stokes``: which plane of the map.

        Raises InputError for what cannot be read or reached.
        """
        return self._plane(stokes).reach(
            lines.read_depth(rms, self.factors) if isinstance(rms, str) else rms
        )

    def _plane(self, stokes: str) -> Depth:
        if stokes not in self.planes:
            cure = f"choose from: {', '.join(self.planes)}; BinMap: {{stokes: IQU}} makes Q and U"
            raise InputError(f"the map has no {stokes!r}", place="sensitivity", cure=cure)
        return self.planes[stokes]

    @property
    def times(self) -> Any:
        """Integration times of a table, s."""
        return times(self.depth, self.seconds)
