"""Depth of a map without a run: `zonda.sensitivity`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zonda.core.configuration.units import Unit
from zonda.core.errors import InputError
from zonda.core.numerics.angles import ARCMIN
from zonda.core.registry import instruments

from . import calculator, default_pipeline
from .depth import depths_of, factors
from .result import Sensitivity, audited, write
from .survey import survey_of

if TYPE_CHECKING:
    from zonda.core.configuration.loaded import PipelineFile

RADIUS, BEAMS = 0.5 * ARCMIN, 2.0
"""Radius of the circle that the depth is averaged over where none is given: the central arcmin, or
this many FWHM if that is more."""


@dataclass(frozen=True)
class SensitivityOfBands:
    """The depths of the maps of a camera with several bands, by their names; what is written and
    said is each band's.
    """

    file: PipelineFile
    bands: Mapping[str, Sensitivity]

    def __getitem__(self, band: str) -> Sensitivity:
        """The depth of a band's map. Raises InputError for a band that the camera has not."""
        if band not in self.bands:
            raise InputError(
                f"there is no band {band!r}",
                place="sensitivity",
                cure=f"choose from: {', '.join(self.bands)}",
            )
        return self.bands[band]

    def reach(self, rms: str | float) -> float:
        """Integration time [s] after which the maps of all bands are as deep, see
        `Sensitivity.reach`.
        """
        return max(found.reach(rms) for found in self.bands.values())

    def audited(self, seeds: int, threads: int | None = None) -> SensitivityOfBands:
        """With the depths that ``seeds`` simulations of the pipeline find, see `audit`."""
        found = audited([*self.bands.values()], seeds, threads)
        return replace(self, bands=dict(zip(self.bands, found, strict=True)))

    def as_dict(self) -> dict[str, Any]:
        """Everything as numbers and text, for JSON."""
        return {"bands": {name: found.as_dict() for name, found in self.bands.items()}}

    def write(self, folder: str | Path) -> list[Path]:
        """Write ``sensitivity_BAND.ecsv`` and ``sensitivity_BAND.png`` of all bands, and
        ``pipeline.yaml``; their paths.
        """
        return write([*self.bands.values()], Path(folder))

    def __str__(self) -> str:
        return "\n\n".join(map(str, self.bands.values()))

    def _repr_html_(self) -> str:
        return "".join(found._repr_html_() for found in self.bands.values())


def sensitivity(
    pipeline: Any = None,
    *,
    radius: str | float | None = None,
    settings: Sequence[str] = (),
    **asked: Any,
) -> Sensitivity | SensitivityOfBands:
    """Forecast the depth of a map without a run, of a camera with several bands that of each band's
    map.

    >>> zonda.sensitivity("mustang2_cluster")                                            # doctest:
    +SKIP
    >>> zonda.sensitivity(instrument="mustang2", site="green_bank", pwv="7.7 mm", time="1
    h").reach("20 uK")    # doctest: +SKIP

    Parameters
    ----------
    pipeline
        A pipeline file (`zonda.load`), its path or name; None: one is made for an instrument and a
        site.
    radius
        Of the circle about the map's centre that the depth is averaged over, with a unit or in rad;
        the central arcmin or two beams where it is not given.
    settings
        Changes to the pipeline as `zonda run --set` takes them; of a path or name, or of the
        pipeline that is made.
    asked
        ``time``, and without a pipeline ``instrument``, ``site``, ``pwv``, ``month``, ``quantile``,
        ``elevation``, ``target``, ``area`` (`default_pipeline.text`).

    Raises
    ------
    ZondaError
        For a pipeline that the forecast does not cover, with the step's name; and what loading and
        pointing raise.
    """
    file = _file(pipeline, settings, asked)
    bands = [band.name for band in file.scene().instrument.bands]
    if bands:
        return SensitivityOfBands(
            file, {band: _forecast(file, radius, asked, band) for band in bands}
        )
    return _forecast(file, radius, asked)


def _forecast(
    file: PipelineFile, radius: str | float | None, asked: Mapping[str, Any], band: str = ""
) -> Sensitivity:
    """The depth of one band's map."""
    survey = survey_of(file, band)
    size = max(RADIUS, BEAMS * survey.fwhm)
    if isinstance(radius, str):
        size = default_pipeline.positive("--radius", Unit("rad"), radius, size)
    elif radius is not None:
        size = float(radius)
    planes = depths_of(survey, size)
    depth = planes.pop("I")
    end = float(depth.seconds[-1])
    seconds = default_pipeline.positive("--time", Unit("s", "3 h"), asked.get("time"), end)
    units = factors(survey.scene.instrument.band, survey.fwhm)
    formula = calculator.of_survey(survey, seconds)
    return Sensitivity(
        file, survey, depth, size, seconds, units, formula, band=band, polarization=planes
    )


def _file(pipeline: Any, settings: Sequence[str], asked: Mapping[str, Any]) -> PipelineFile:
    """The pipeline that is named, or one that is made for an instrument and a site."""
    from zonda.core.configuration.pipeline_file import PipelineFile, load

    unknown = sorted(asked.keys() - default_pipeline.text.__annotations__.keys())
    if unknown:
        raise TypeError(f"sensitivity() got an unexpected keyword argument {unknown[0]!r}")
    given = {key: value for key, value in asked.items() if value is not None}
    text = cure = ""
    if pipeline is None:
        if missing := [key for key in ("instrument", "site") if key not in given]:
            text = f"neither a pipeline nor --{missing[0]} is given"
            cure = "name a pipeline, or --instrument and --site (`zonda plugins` lists them)"
    elif beside := sorted(given.keys() - {"time"}):
        text = f"--{beside[0]} is part of a pipeline, and cannot be given beside one"
        cure = f"change the pipeline with --set, or leave it or --{beside[0]} out"
        if pipeline in {found.name for found in instruments.candidates()}:
            cure = f"{pipeline} is an instrument: write --instrument {pipeline}"
    elif isinstance(pipeline, PipelineFile) and settings:
        text, cure = "settings change a pipeline when it is loaded", "give them to zonda.load"
    if text:
        raise InputError(text, place=default_pipeline.PLACE, cure=cure)
    if pipeline is None:
        return default_pipeline.make(settings, **given)
    return pipeline if isinstance(pipeline, PipelineFile) else load(pipeline, settings)
