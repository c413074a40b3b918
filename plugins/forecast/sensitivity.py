"""The forecast of `zonda sensitivity` (`zonda.sensitivity`), of a pipeline or of an instrument at
a site.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from zonda.core.configuration.loaded import PipelineFile
from zonda.core.configuration.units import Unit
from zonda.core.errors import InputError
from zonda.core.numerics.sphere import ARCMIN
from zonda.core.registry import instruments

from . import calculator, default_pipeline, detector_noise
from .depth import depths_of, factors
from .report import Sensitivity, SensitivityOfBands
from .source import FORMS, Placed, Source
from .survey import survey_of

RADIUS, BEAMS = 0.5 * ARCMIN, 2.0
"""Radius of the circle that the depth is averaged over where none is given: the central arcmin, or
this many FWHM if that is more."""


def sensitivity(
    pipeline: Any = None,
    *,
    radius: str | float | None = None,
    source: str | None = None,
    peak: str | None = None,
    flux: str | None = None,
    settings: Sequence[str] = (),
    **asked: Any,
) -> Sensitivity | SensitivityOfBands:
    """Forecast the depth of a map without a run, of a camera with several bands that of each band's
    map.

    >>> zonda.sensitivity("mustang2_cluster")                                            # doctest:
    +SKIP
    >>> zonda.sensitivity(instrument="mustang2", site="green_bank", pwv="7.7 mm",
    integration="1 h").reach("20 uK")    # doctest: +SKIP

    Parameters
    ----------
    pipeline
        A pipeline file (`zonda.load`), its path or name; None: one is made for an instrument and a
        site.
    radius
        Of the circle about the map's centre that the depth is averaged over, with a unit or in rad;
        the central arcmin or two beams where it is not given.
    source
        A source in the map: ``point``, ``gaussian 1 arcmin`` (FWHM), ``beta 1 arcmin 0.7`` (core
        radius and beta), ``disc 30 arcsec`` (diameter), each at the map's centre, or a FITS map.
    peak, flux
        Its brightness at the peak as the beam sees it, or its flux density, with a unit; of a file
        neither is needed.
    settings
        Changes to the pipeline as `zonda run --set` takes them; of a path or name, or of the
        pipeline that is made.
    asked
        ``integration`` (time), and without a pipeline ``instrument``, ``site``, ``pwv``, ``month``,
        ``quantile``, ``elevation``, ``target``, ``area`` (`default_pipeline.text`).

    Raises
    ------
    ZondaError
        For a pipeline that the forecast does not cover, with the step's name; and what loading and
        pointing raise.
    """
    file = _file(pipeline, settings, asked)
    wanted = None if source is None else Source.parse(source, peak, flux)
    if wanted is None and (given := [f"--{k}" for k, v in (("peak", peak), ("flux", flux)) if v]):
        cure = f"give --source, {FORMS}"
        raise InputError("it is the brightness of no source", place=", ".join(given), cure=cure)
    how = radius, wanted, asked
    bands = [band.name for band in file.scene().instrument.bands]
    if bands:
        return SensitivityOfBands(file, {band: _forecast(file, *how, band) for band in bands})
    return _forecast(file, *how)


def _forecast(
    file: PipelineFile,
    radius: str | float | None,
    source: Source | None,
    asked: Mapping[str, Any],
    band: str = "",
) -> Sensitivity:
    """The depth of one band's map, and the source in it."""
    survey = survey_of(file, band)
    units = factors(survey.scene.instrument.band, survey.fwhm)
    placed = None if source is None else Placed.of(survey, source, units)
    if placed is not None and placed.away > survey.fwhm / 2 and not survey.polarized:
        survey = replace(survey, centre=placed.centre, _tracks={})
    size = max(RADIUS, BEAMS * survey.fwhm)
    if isinstance(radius, str):
        size = default_pipeline.positive("--radius", Unit("rad"), radius, size)
    elif radius is not None:
        size = float(radius)
    planes = depths_of(survey, size)
    depth = planes.pop("I")
    end = float(depth.seconds[-1])
    seconds = default_pipeline.positive(
        "--integration",
        Unit("s", "3 h"),
        asked.get("integration"),
        end,
    )
    seen = None
    if placed is not None:
        noisy = 1.0
        if survey.polarized:
            alone = detector_noise.variances(survey, size)
            noisy = sum(float(depth.variance[p][-1]) for p in alone) / sum(
                float(each[-1]) for each in alone.values()
            )
        seen = placed.seen(survey, noisy, "atmosphere" in depth.known)
    formula = calculator.of_survey(survey, seconds)
    return Sensitivity(
        file,
        survey,
        depth,
        size,
        seconds,
        units,
        formula,
        band=band,
        polarization=planes,
        source=seen,
    )


def _file(pipeline: Any, settings: Sequence[str], asked: Mapping[str, Any]) -> PipelineFile:
    """The pipeline that is named, or one that is made for an instrument and a site."""
    from zonda.core.configuration.pipeline_file import PipelineFile, load

    if asked.get("time") is not None:
        wrong = "a time is a moment in zonda, as in `zonda when`"
        cure = f"give the integration time as --integration '{asked['time']}'"
        raise InputError(wrong, place="--time", cure=cure)
    unknown = sorted(asked.keys() - default_pipeline.text.__annotations__.keys())
    if unknown:
        raise TypeError(f"sensitivity() got an unexpected keyword argument {unknown[0]!r}")
    given = {key: value for key, value in asked.items() if value is not None}
    text = cure = ""
    if pipeline is None:
        if missing := [key for key in ("instrument", "site") if key not in given]:
            text = f"neither a pipeline nor --{missing[0]} is given"
            cure = "name a pipeline, or --instrument and --site (`zonda plugins` lists them)"
    elif beside := sorted(given.keys() - {"integration"}):
        text = f"--{beside[0]} is part of a pipeline, and cannot be given beside one"
        cure = f"change the pipeline with --set, or leave it or --{beside[0]} out"
        if pipeline in {found.name for found in instruments.candidates()}:
            cure = f"{pipeline} is an instrument: write --instrument {pipeline}"
    elif isinstance(pipeline, PipelineFile) and settings:
        text = "settings change a pipeline when it is loaded"
        cure = "give them to zonda.load"
    if text:
        raise InputError(text, place=default_pipeline.PLACE, cure=cure)
    if pipeline is None:
        return default_pipeline.make(settings, **given)
    return pipeline if isinstance(pipeline, PipelineFile) else load(pipeline, settings)
