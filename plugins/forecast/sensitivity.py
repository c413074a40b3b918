"""How deep a map becomes: `zonda.sensitivity`, without a run."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.configuration.units import Unit
from zonda.core.errors import InputError
from zonda.core.notebook import html_table
from zonda.core.numerics.angles import ARCMIN

from . import calculator, default_pipeline, lines
from .depth import PARTS, Depth, depth_of, factors, times
from .survey import Survey, survey_of

if TYPE_CHECKING:
    from zonda.core.configuration.loaded import PipelineFile

    from .audit import Audited
    from .calculator import Calculated

RADIUS, BEAMS = 0.5 * ARCMIN, 2.0
"""Radius of the circle that the depth is averaged over where none is given: the central arcmin, or this many FWHM if that is
more."""


@dataclass(frozen=True)
class Sensitivity:
    """The depth of a map against time.

    Attributes
    ----------
    file, survey
        The pipeline, and its scans.
    depth
        White noise, 1/f noise and atmosphere behind the beam, K_RJ.
    radius
        Of the circle that they are averaged over, rad.
    seconds
        The integration time that was asked for; that of the pipeline's scans where none was.
    factors
        By unit what a depth in K_RJ is multiplied by (`depth.factors`).
    calculated
        What the AtLAST calculator's formula gives for that time; None: the scene has no atmosphere.
    audit
        Simulated depths, see `audited`; None: nothing was simulated.
    """

    file: PipelineFile
    survey: Survey
    depth: Depth
    radius: float
    seconds: float
    factors: Mapping[str, float]
    calculated: Calculated | None
    audit: Audited | None = None

    def rms(self, seconds: float | None = None, unit: str = "K_RJ", part: str = "") -> float:
        """The depth after an integration time [s] in a unit (`depth.UNITS`): of a part (`depth.PARTS`), or of all.

        Raises InputError for an unknown unit or part, and a time that is not positive.
        """
        wanted = self.seconds if seconds is None else seconds
        if unit not in self.factors or part not in ("", *PARTS):
            cure = f"units are {', '.join(self.factors)}; parts are {', '.join(PARTS)}, or none for all"
            raise InputError(f"no depth in {unit!r} of {part!r}", place="sensitivity", cure=cure)
        if not wanted > 0:
            raise InputError(f"a time of {wanted:g} s is not positive", place="sensitivity")
        found = self.depth.part(part, wanted) if part else self.depth.total(wanted)
        return float(found) * self.factors[unit]

    def reach(self, rms: str | float) -> float:
        """Integration time [s] after which the map is as deep as ``rms``: text with a unit of `depth.UNITS` (``10 uK``, which is
        K_RJ; ``10 uK_CMB``, ``0.1 mJy/beam``), or K_RJ. Beyond the scans of the pipeline all parts fall as time^-1/2.

        Raises InputError for what cannot be read or reached.
        """
        return self.depth.reach(lines.read_depth(rms, self.factors) if isinstance(rms, str) else rms)

    def audited(self, seeds: int, threads: int | None = None) -> Sensitivity:
        """With the depth that ``seeds`` simulations of the pipeline find, see `audit`."""
        from .audit import audit

        return replace(self, audit=audit(self.file, self.depth, self.radius, seeds, threads))

    @property
    def times(self) -> Any:
        """Integration times of a table, s."""
        return times(self.depth, self.seconds)

    def as_dict(self) -> dict[str, Any]:
        """Everything as numbers and text, for JSON."""
        from .report import as_dict

        return as_dict(self)

    def write(self, folder: str | Path) -> list[Path]:
        """Write ``sensitivity.ecsv``, ``sensitivity.png`` and ``pipeline.yaml`` to a folder; their paths."""
        from .report import write

        return write(self, Path(folder))

    def plot(self) -> Any:
        """Depth against time, split into its parts: a matplotlib figure, not pyplot's."""
        from .picture import figure

        return figure(self)

    def __str__(self) -> str:
        from .report import text

        return text(self)

    def _repr_html_(self) -> str:
        rows = [(lines.duration(t), lines.in_unit(float(self.depth.total(t)), "K_RJ")) for t in self.times.tolist()]
        return html_table(f"Depth of {self.file.header.name}, behind the beam", rows)


def sensitivity(
    pipeline: Any = None,
    *,
    radius: str | float | None = None,
    settings: Sequence[str] = (),
    **asked: Any,
) -> Sensitivity:
    """Forecast the depth of a map without a run.

    >>> zonda.sensitivity("mustang2_cluster")                                            # doctest: +SKIP
    >>> zonda.sensitivity(instrument="mustang2", site="green_bank", pwv="7.7 mm", time="1 h").reach("20 uK")    # doctest: +SKIP

    Parameters
    ----------
    pipeline
        A pipeline file (`zonda.load`), its path or name; None: one is made for an instrument and a site.
    radius
        Of the circle about the map's centre that the depth is averaged over, with a unit or in rad; the central arcmin or two
        beams where it is not given.
    settings
        Changes to the pipeline as `zonda run --set` takes them; of a path or name, or of the pipeline that is made.
    asked
        ``time``, and without a pipeline ``instrument``, ``site``, ``pwv``, ``month``, ``quantile``, ``elevation``, ``target``,
        ``area`` (`default_pipeline.Asked`).

    Raises
    ------
    ZondaError
        For a pipeline that the forecast does not cover, with the step's name; and what loading and pointing raise.
    """
    file = _file(pipeline, settings, asked)
    survey = survey_of(file)
    size = max(RADIUS, BEAMS * survey.fwhm)
    if isinstance(radius, str):
        size = default_pipeline.positive("--radius", Unit("rad"), radius, size)
    elif radius is not None:
        size = float(radius)
    depth = depth_of(survey, size)
    seconds = default_pipeline.positive("--time", Unit("s", "3 h"), asked.get("time"), float(depth.seconds[-1]))
    instrument = survey.scene.instrument
    units = factors(instrument.band, survey.fwhm)
    return Sensitivity(file, survey, depth, size, seconds, units, calculator.of_survey(survey, seconds))


def _file(pipeline: Any, settings: Sequence[str], asked: Mapping[str, Any]) -> PipelineFile:
    from zonda.core.configuration.pipeline_file import PipelineFile, load

    unknown = sorted(asked.keys() - default_pipeline.Asked.__dataclass_fields__.keys())
    if unknown:
        raise TypeError(f"sensitivity() got an unexpected keyword argument {unknown[0]!r}")
    given = {key: value for key, value in asked.items() if value is not None}
    if pipeline is None:
        if missing := [key for key in ("instrument", "site") if key not in given]:
            cure = "name a pipeline, or --instrument and --site (`zonda plugins` lists them)"
            raise InputError(f"neither a pipeline nor --{missing[0]} is given", place=default_pipeline.PLACE, cure=cure)
        return default_pipeline.make(default_pipeline.Asked(**given), settings)
    if beside := sorted(given.keys() - {"time"}):
        cure = f"change the pipeline with --set, or leave it or --{beside[0]} out"
        raise InputError(f"a pipeline says itself what --{beside[0]} is", place=default_pipeline.PLACE, cure=cure)
    if isinstance(pipeline, PipelineFile):
        if settings:
            cure = "give them to zonda.load"
            raise InputError("settings change a pipeline when it is loaded", place=default_pipeline.PLACE, cure=cure)
        return pipeline
    return load(pipeline, settings)


def elevations(survey: Survey) -> tuple[float, float]:
    """Lowest and highest elevation of the boresight, rad."""
    ends = [(float(e.min()), float(e.max())) for e in (o.elevation for o in (survey.observations[0], survey.observations[-1]))]
    return min(np.array(ends)[:, 0]), max(np.array(ends)[:, 1])
