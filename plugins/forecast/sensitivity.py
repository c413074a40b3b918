"""The forecast of `zonda sensitivity` (`zonda.sensitivity`), of a pipeline or of an instrument at
a site.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from zonda.core.configuration.units import Unit
from zonda.core.errors import InputError
from zonda.core.numerics.sphere import ARCMIN, ARCSEC
from zonda.core.registry import instruments
from zonda.core.tables import html_table

from . import calculator, default_pipeline, detector_noise
from .audit import Audited, Forecasted, audit
from .calculator import Calculated
from .depth import (
    PARTS,
    UNITS,
    WITHIN,
    Depth,
    depths_of,
    duration,
    factors,
    in_unit,
    read_depth,
    scatter,
    times,
    unit_of,
)
from .report import figure, report, write
from .source import FORMS, OF, Placed, Seen, Source, sigmas
from .survey import Survey, elevations, survey_of

if TYPE_CHECKING:
    from zonda.core.configuration.loaded import PipelineFile


RADIUS, BEAMS = 0.5 * ARCMIN, 2.0
"""Radius of the circle that the depth is averaged over where none is given: the central arcmin, or
this many FWHM if that is more."""
USUAL = ("point", "gaussian 1 arcmin")
"""Sources whose loss is told where none is asked for."""


def _or_null(value: float) -> float | None:
    return value if math.isfinite(value) else None


@dataclass(frozen=True)
class Sensitivity:
    """The depth of a map against time, as numbers, text, table and picture.

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
    source
        The source that was asked for, behind the filters; None: none was.
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
    source: Seen | None = None

    @cached_property
    def keeps(self) -> dict[str, float]:
        """Share of its peak that a source at the map's centre keeps behind the filters, by source:
        of `USUAL` those that fit into the map.
        """
        found = {}
        for name in USUAL:
            with suppress(InputError):
                placed = Placed.of(self.survey, Source.parse(name))
                found[placed.source.words] = float(placed.seen(self.survey, 0.0).kept[-1])
        return found

    def snr(self, seconds: float | None = None, of: str = "peak") -> float:
        """Signal-to-noise ratio of the source after an integration time [s]: of its ``peak`` in the
        map that is smoothed with the beam, or of its ``template``
        (`zonda.plugins.forecast.source`). NaN: not forecast.

        Raises InputError where no source was given, for another ``of``, and for a time that is not
        positive.
        """
        wanted = self.seconds if seconds is None else seconds
        if not wanted > 0:
            raise InputError(f"a time of {wanted:g} s is not positive", place="sensitivity")
        return float(self._source("sensitivity").snr(self.depth, wanted, of))

    def _source(self, place: str) -> Seen:
        if self.source is None:
            cure = f"give --source ({FORMS}) with --peak or --flux"
            raise InputError("a signal-to-noise ratio is that of a source", place=place, cure=cure)
        return self.source

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
        self,
        seconds: float | None = None,
        unit: str = "K_RJ",
        part: str = "",
        stokes: str = "I",
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

    def reach(self, rms: str | float, stokes: str = "I", of: str = "peak") -> float:
        """Integration time [s] after which the map is as deep as ``rms``: text with a unit of
        `depth.UNITS` (``10 uK``, which is K_RJ; ``10 uK_CMB``, ``0.1 mJy/beam``), or K_RJ. Beyond
        the scans of the pipeline all parts fall as time^-1/2. ``stokes``: which plane of the map.
        Or ``5 sigma``: after which the source has that signal-to-noise ratio, see `snr`.

        Raises InputError for what cannot be read or reached.
        """
        if isinstance(rms, str) and (sigma := sigmas(rms)):
            return self._source("--reach").reach(self.depth, sigma, of)
        return self._plane(stokes).reach(
            read_depth(rms, self.factors) if isinstance(rms, str) else rms
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

    def audited(self, seeds: int, threads: int | None = None) -> Sensitivity:
        """With the depth that ``seeds`` simulations of the pipeline find, see `audit`."""
        return audited([self], seeds, threads)[0]

    def as_dict(self) -> dict[str, Any]:
        """Everything as numbers and text, for JSON."""
        survey, c = self.survey, self.calculated
        scene, end = survey.scene, float(self.depth.seconds[-1])
        return {
            "pipeline": self.file.header.name,
            "instrument": scene.instrument.name,
            "band": scene.instrument.band.name,
            "site": scene.site.name,
            "start": str(survey.observations[0].start),
            "scans": len(survey.observations),
            "scan_seconds": end,
            "elevation_deg": [math.degrees(e) for e in elevations(survey)],
            "fwhm_arcsec": survey.fwhm / ARCSEC,
            "radius_arcmin": self.radius / ARCMIN,
            "seconds": self.seconds,
            "units_per_K_RJ": dict(self.factors),
            "relative_error": dict(self.depth.error),
            "audited_within": WITHIN,
            "scatter_of_one_map": scatter(survey.sigma, self.radius),
            "table": self._rows(self.depth),
            **({"stokes": {p: self._rows(d) for p, d in self.polarization.items()}}
               if self.polarization else {}),
            "calculator": c and {
                "Jy_at_centre": c.centre,
                "Jy_over_band": c.band,
                "seconds": c.seconds,
                "pwv_m": c.pwv,
            },
            "audit": self.audit and self.audit.as_dict(),
            **({"keeps": self.keeps} if self.source is None else {"source": self._of_source()}),
        }  # fmt: skip

    def _of_source(self) -> dict[str, Any]:
        """The source, for JSON."""
        s = self._source("sensitivity")
        rows = [
            {"seconds": t, **{of: _or_null(self.snr(t, of)) for of in OF}}
            for t in self.times.tolist()
        ]
        return {
            "source": s.source.text,
            "peak": {u: s.peak * self.factors[u] for u in UNITS if u != "Jy"},
            "smoothed_K_RJ": s.smoothed,
            "kept": float(s.kept[-1]),
            "arcmin_from_centre": s.away / ARCMIN,
            "snr": rows,
        }

    def _rows(self, depth: Depth) -> list[dict[str, Any]]:
        """Rows of a plane's table, for JSON; null: not forecast."""
        return [
            {
                "seconds": t,
                "followed": depth.followed(t),
                "depth": {u: float(depth.total(t)) * self.factors[u] for u in UNITS},
                "K_RJ": {p: float(depth.part(p, t)) if p in depth.known else None for p in PARTS},
                "relative_error": depth.total_error(t),
            }
            for t in self.times.tolist()
        ]

    def write(self, folder: str | Path) -> list[Path]:
        """Write ``sensitivity.ecsv``, ``sensitivity.png`` and ``pipeline.yaml`` to a folder; their
        paths. Raises OutputError.
        """
        return write([self], Path(folder))

    def plot(self) -> Any:
        """Depth against time, split into its parts: a matplotlib figure, not pyplot's."""
        return figure(self)

    def __str__(self) -> str:
        return report([self])

    def _repr_html_(self) -> str:
        unit = unit_of(self.seconds)
        rows = [
            (duration(t, unit), in_unit(float(self.depth.total(t)), "K_RJ"))
            for t in self.times.tolist()
        ]
        return html_table(f"Depth of {self.file.header.name}, behind the beam", rows)


def audited(
    each: Sequence[Sensitivity],
    seeds: int,
    threads: int | None = None,
) -> list[Sensitivity]:
    """Forecasts of all bands, each with the depth that simulations find."""
    forecasts = {
        one.band: Forecasted(one.planes, one.radius, one.survey.fwhm, one.survey.centre, one.source)
        for one in each
    }
    audits = audit(each[0].file, forecasts, seeds, threads)
    return [replace(one, audit=audits[one.band]) for one in each]


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

    def reach(self, rms: str | float, of: str = "peak") -> float:
        """Integration time [s] after which the maps of all bands are as deep, or the source has
        that signal-to-noise ratio in each, see `Sensitivity.reach`.
        """
        return max(found.reach(rms, of=of) for found in self.bands.values())

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
        return report([*self.bands.values()])

    def _repr_html_(self) -> str:
        return "".join(found._repr_html_() for found in self.bands.values())


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
        text, cure = "settings change a pipeline when it is loaded", "give them to zonda.load"
    if text:
        raise InputError(text, place=default_pipeline.PLACE, cure=cure)
    if pipeline is None:
        return default_pipeline.make(settings, **given)
    return pipeline if isinstance(pipeline, PipelineFile) else load(pipeline, settings)
