"""The depth of a map against time, and a source in it: numbers, text, table and picture of a
forecast.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from zonda.core.canvas import COLOURS, DPI
from zonda.core.configuration.loaded import PipelineFile
from zonda.core.errors import InputError
from zonda.core.numerics.sphere import ARCMIN, ARCSEC
from zonda.core.storage.files import atomic_path, check_output_folder, write_text
from zonda.core.storage.table_files import Column, write_ecsv
from zonda.core.tables import aligned, html_table

from .audit import Audited, Forecasted, audit
from .calculator import Calculated
from .depth import (
    PARTS,
    UNITS,
    WITHIN,
    Depth,
    duration,
    in_unit,
    number,
    prefixed,
    read_depth,
    scatter,
    times,
    unit_of,
)
from .source import FORMS, OF, Placed, Seen, Source, sigmas
from .survey import Survey, elevations

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


TEMPLATE = 0.1
"""Relative error of the S/N of a template beyond that of the depth, by audits."""
NAMES = {
    "white": ("white noise", "white"),
    "1/f": ("1/f noise", "pink"),
    "atmosphere": ("atmosphere (indicative)", "atmosphere"),
}
"""By part of the noise, its label in the picture and the component whose colour it has."""


def report(each: Sequence[Sensitivity], wanted: str | None = None) -> str:
    """Text of forecasts of all bands: header, table, errors; when a depth or ``5 sigma`` is reached
    if that is ``wanted``. The times of tables are in one unit.
    """
    unit = unit_of(max(one.seconds for one in each))
    parts = [_text(one, unit) for one in each]
    parts += [_reached(one, wanted) for one in each if wanted is not None]
    if wanted is not None and len(each) > 1:
        longest = max(one.reach(wanted) for one in each)
        time = duration(longest, unit_of(longest))
        parts.append(f"{wanted} in all bands after {time} of integration")
    return "\n\n".join(parts)


def _text(found: Sensitivity, unit: str) -> str:
    source = found.source
    about = [noise_alone(found)] if source is None else source.lines(found.factors)
    parts = [_header(found), about]
    for plane, depth in found.planes.items():
        parts.append(([plane] if found.polarization else []) + _table(found, depth, unit))
    parts.append(_errors(found))
    if c := found.calculated:
        scene = f"{c.diameter:.4g} m dish, PWV {c.pwv * 1e3:.3g} mm"
        centre, band = in_unit(c.centre, "Jy"), in_unit(c.band, "Jy")
        parts.append(
            [
                f"AtLAST sensitivity calculator's formula, {duration(c.seconds, unit)} on one point"
                f" source ({scene}, elevation {math.degrees(c.elevation):.1f} deg):",
                f"  {centre} at the band's centre, {band} averaged over the band; one receiver at"
                " 5 h nu / k on AtLAST's surface, no filters: not this camera",
            ]
        )
    if found.audit is not None:
        parts.append([str(found.audit)])
    return "\n\n".join(map("\n".join, parts))


def noise_alone(found: Sensitivity) -> str:
    """The line that says what a depth without a source leaves out."""
    each = [f"a {name} keeps {100 * share:.0f} %" for name, share in found.keeps.items()]
    return (
        f"noise alone: behind these filters {' and '.join(each)} of its peak (closed form);"
        " --source forecasts the S/N of a source"
    )


def _header(found: Sensitivity) -> list[str]:
    survey, count = found.survey, len(found.survey.observations)
    whole = float(found.depth.seconds[-1])
    low, high = (math.degrees(e) for e in elevations(survey))
    water = ", no atmosphere"
    if (step := survey.atmosphere) is not None:
        model = step.model(survey.observations[survey.configured[0]])
        middle = float(np.median(model.observation.elevation))
        passed = float(model.band.transmission(model.pwv, middle))
        water = (
            f", PWV {model.pwv * 1e3:.3g} mm with {100 * step.pwv_rms:.3g} % rms, transmission"
            f" {passed:.3g}"
        )
    filters = [f"high-pass {survey.cut:.3g} Hz"] if survey.cut else []
    filters += ["common mode"] if survey.common else []
    return [
        f"{found.file.header.name}: {found.camera} at {survey.scene.site.name}, {count}"
        f" scan{'s' if count > 1 else ''}, {duration(whole, unit_of(whole))} in all,"
        f" from {survey.observations[0].start}",
        f"elevation {low:.1f} to {high:.1f} deg{water}",
        f"filters: {', '.join(filters) or 'none'}",
        f"noise of the map behind the beam of {survey.fwhm / ARCSEC:.3g} arcsec, averaged over a"
        f" circle of radius {found.radius / ARCMIN:.3g} arcmin at"
        f" {'its centre' if survey.centre is None else 'the peak of the source'}",
    ]


def _table(found: Sensitivity, depth: Depth, unit: str) -> list[str]:
    here, with_source = float(depth.total(found.seconds)), found.source and depth is found.depth
    scales, names = zip(*(prefixed(here * found.factors[u], u) for u in UNITS), strict=True)
    rows = []
    for t in found.times.tolist():
        total = float(depth.total(t))
        first, *others = (
            number(total * found.factors[u] * scale) for u, scale in zip(UNITS, scales, strict=True)
        )
        parts = (float(depth.part(p, t)) * scales[0] for p in PARTS)
        rows.append(
            [
                duration(t, unit) + ("" if depth.followed(t) else " *"),
                first,
                *("-" if math.isnan(value) else number(value) for value in parts),
                *others,
                *([number(found.snr(t, of)) for of in OF] if with_source else []),
            ]
        )
    head = ["time", names[0], *PARTS, *names[1:-1], f"point source {names[-1]}"]
    head += ["S/N peak", "template"] if with_source else []
    return aligned(rows, head, ">")


def _errors(found: Sensitivity) -> list[str]:
    depth, error = found.depth, found.depth.error
    there = [p for p in PARTS if depth.variance[p][-1] > 0]
    lines = [
        f"stated errors of the rms: {', '.join(f'{p} {100 * error[p]:.0f} %' for p in there)};"
        f" together {100 * depth.total_error(found.seconds):.0f} %"
    ]
    if depth.known != PARTS:
        lines.append(
            "-: what is left of the atmosphere is not forecast, and comes on top (S/N are without"
            f" it): {depth.reason}"
        )
    if "atmosphere" in there:
        lines.append(
            "the atmosphere is indicative: one state of the weather, and pwv_rms is an assumption"
            " of the pipeline"
        )
    return [
        *lines,
        "one map's rms in this circle scatters by about"
        f" {100 * scatter(found.survey.sigma, found.radius):.0f} % (white noise)",
        "*: not followed by scans; all parts as time^-1/2",
    ]


def _reached(found: Sensitivity, wanted: str) -> str:
    """The integration time that reaches a depth, of a map of I, Q and U in each, and the kinds of
    noise that make it up; or a signal-to-noise ratio, of the peak and of the template.
    """
    sigma, seconds, lines = sigmas(wanted), 0.0, []
    planes = {"I": found.depth} if sigma else found.planes
    for (plane, depth), of in itertools.product(planes.items(), OF if sigma else OF[:1]):
        seconds = found.reach(wanted, plane, of)
        if not math.isfinite(seconds):
            lines.append(f"{wanted} of the {of} is not forecast")
            continue
        error = depth.total_error(seconds) + TEMPLATE * (of == "template")
        low, high = ((1 + sign * error) ** 2 * seconds for sign in (-1, 1))
        before = [f"band {found.band}"] * bool(found.band) + [plane] * bool(found.polarization)
        what = f"{wanted} of the {of}" if sigma else wanted
        unit = unit_of(seconds)
        lines.append(
            f"{': '.join([*before, what])} after {duration(seconds, unit)} of integration,"
            f" {duration(low, unit)} to {duration(high, unit)} by the stated errors"
        )
        if not sigma:
            each = (f"{p} {in_unit(float(depth.part(p, seconds)), 'K_RJ')}" for p in depth.known)
            lines.append(f"  {', '.join(each)}")
    if seconds > (end := float(found.depth.seconds[-1])):
        lines.append(
            "  white and 1/f noise fall as time^-1/2; the atmosphere is forecast for the first"
            f" {duration(end, unit_of(end))} and taken to do so too"
        )
    return "\n".join(lines)


def write(each: Sequence[Sensitivity], folder: Path) -> list[Path]:
    """Table and picture of each band, and the pipeline; their paths. Raises OutputError."""
    check_output_folder(folder)
    paths = [path for found in each for path in _write(found, folder)]
    return [*paths, write_text(folder / "pipeline.yaml", each[0].file.resolved_yaml())]


def _write(found: Sensitivity, folder: Path) -> list[Path]:
    """Table and picture; the band's name is behind theirs where the camera has several."""
    seconds, scene = found.times, found.survey.scene
    columns = [Column("time", seconds, "s", "integration time")]
    for plane, depth in found.planes.items():
        before, of = ("", "") if plane == "I" else (f"{plane}_", f" of {plane}")
        for unit in UNITS:
            what = "flux density of a point source" if unit == "Jy" else "rms behind the beam"
            name = f"{before}depth_{unit.replace('/', '_per_')}"
            values = depth.total(seconds) * found.factors[unit]
            fits = "K" if unit.startswith("K_") else unit
            columns.append(Column(name, values, fits, f"{what}, {unit}, all noise{of}"))
        for part in depth.known:
            name = before + part.replace("1/f", "one_over_f")
            text = f"rms of the {part} noise{of}, K_RJ"
            columns.append(Column(name, depth.part(part, seconds), "K", text))
    if found.source is not None:
        for of in OF:
            values = np.array([found.snr(t, of) for t in seconds.tolist()])
            columns.append(Column(f"snr_{of}", values, "", f"signal-to-noise ratio of the {of}"))
    errors = {p.replace("1/f", "one_over_f").upper(): found.depth.error[p] for p in PARTS}
    meta = {
        "PIPELINE": found.file.header.name,
        "INSTRUMENT": scene.instrument.name,
        "BAND": scene.instrument.band.name,
        "SITE": scene.site.name,
        "BEAM": f"{found.survey.fwhm / ARCSEC:.6g} arcsec",
        "RADIUS": f"{found.radius / ARCMIN:.6g} arcmin",
        "SCANS": len(found.survey.observations),
        "SCANTIME": float(found.depth.seconds[-1]),
        **({"SOURCE": s.source.text, "KEPT": float(s.kept[-1])} if (s := found.source) else {}),
        **{f"ERROR_{name}": float(error) for name, error in errors.items()},
    }
    stem = f"sensitivity_{found.band}" if found.band else "sensitivity"
    table, picture = (folder / f"{stem}.{kind}" for kind in ("ecsv", "png"))
    write_ecsv(table, columns, meta)
    with atomic_path(picture) as temporary:
        figure(found).savefig(temporary)
    return [table, picture]


def figure(found: Sensitivity) -> Any:
    """Depth against time, all noise and its parts, with bands of their stated errors, and the
    S/N of the source beside it: a matplotlib figure, not pyplot's.
    """
    from matplotlib.figure import Figure

    panels = 1 if found.source is None else 2
    drawn = Figure(figsize=(7.2 * panels, 5.0), dpi=DPI, layout="constrained")
    ax, *others = drawn.subplots(1, panels, squeeze=False)[0]
    depth = found.depth
    end = float(depth.seconds[-1])
    grid = np.geomspace(found.times.min(), found.times.max(), 200)
    t = np.unique(np.r_[grid, depth.seconds[depth.seconds > grid[0]]])
    factor, unit = prefixed(float(depth.total(found.seconds)), "K_RJ")
    hours = t / 3600
    for part, (label, component) in NAMES.items():
        values, error = depth.part(part, t) * factor, depth.error[part]
        if part in depth.known and values.any():
            style = {"color": COLOURS[component]}
            ends = (values * (1 + sign * error) for sign in (-1, 1))
            ax.fill_between(hours, *ends, alpha=0.2, lw=0, **style)
            ax.plot(hours, values, lw=1.4, label=label, **style)
    total = depth.total(t) * factor
    inside = t <= end * (1 + 1e-9)
    black: dict[str, Any] = {"color": "black", "lw": 2}
    ax.plot(hours[inside], total[inside], label="together", **black)
    later = "together, as time$^{-1/2}$"
    ax.plot(hours[~inside], total[~inside], ls="--", label=later, **black)
    for line, (plane, other) in zip(("-.", ":"), found.polarization.items(), strict=False):
        values = other.total(t) * factor
        ax.plot(hours, values, color="black", lw=1.2, ls=line, label=f"{plane}, together")
    if found.audit is not None and (row := found.audit.together):
        label = f"{row.seeds} simulations"
        mean, error = row.mean * factor, row.error * factor
        ax.errorbar(end / 3600, mean, error, fmt="o", color="#D55E00", label=label)
    ax.set(xscale="log", yscale="log", xlabel="integration time [h]")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
    kelvin = unit.replace("u", "µ").replace("K_RJ", "K$_\\mathrm{RJ}$")
    ax.set_ylabel(f"rms behind the beam [{kelvin}]")
    ax.grid(alpha=0.25, lw=0.5, which="both")
    ax.legend(frameon=False)
    circle = f"circle of radius {found.radius / ARCMIN:.3g}′"
    ax.set_title(f"{found.file.header.name}: {found.camera}, {circle}", fontsize=10)
    if found.source is not None:
        found.source.draw(others[0], depth, t)
    return drawn
