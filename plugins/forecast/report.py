"""Text, tables and files of `zonda sensitivity`."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.numerics.angles import ARCMIN, ARCSEC
from zonda.core.storage.ecsv import Column, write_ecsv
from zonda.core.storage.files import atomic_path, check_output_folder, write_text
from zonda.core.tables import aligned

from . import default_pipeline
from .depth import PARTS, UNITS, WITHIN, Depth, scatter
from .lines import duration, in_unit, number, prefixed
from .survey import Survey, elevations

if TYPE_CHECKING:
    from zonda.core.configuration.loaded import PipelineFile

    from .result import Forecast

TITLES = {"Jy": "point source"}


def text(found: Forecast) -> str:
    """The table and what it stands for."""
    tables = [
        ([plane] if found.polarization else []) + _table(found, depth)
        for plane, depth in found.planes.items()
    ]
    parts = [_header(found), *tables, _errors(found)]
    if found.calculated is not None:
        parts.append(_calculated(found))
    if found.audit is not None:
        parts.append([str(found.audit)])
    return "\n\n".join("\n".join(p) for p in parts)


def _header(found: Forecast) -> list[str]:
    survey, header = found.survey, found.file.header
    o = survey.observations[0]
    low, high = (math.degrees(e) for e in elevations(survey))
    number, length = len(survey.observations), duration(float(found.depth.seconds[-1]))
    place = f"{found.camera} at {survey.scene.site.name}"
    lines = [
        f"{header.name}: {place}, {number} scan{'s' if number > 1 else ''}, {length} in all, from"
        f" {o.start}"
    ]
    lines.append(f"elevation {low:.1f} to {high:.1f} deg{_water(survey)}")
    lines.append("filters: " + (", ".join(_filters(survey)) or "none"))
    beam, radius = f"{survey.fwhm / ARCSEC:.3g}", f"{found.radius / ARCMIN:.3g}"
    lines.append(
        f"noise of the map behind the beam of {beam} arcsec, averaged over a circle of radius"
        f" {radius} arcmin at its centre"
    )
    return lines


def _water(survey: Survey) -> str:
    if (step := survey.atmosphere) is None:
        return ", no atmosphere"
    model = step.model(survey.observations[survey.configured[0]])
    passed = float(
        model.band.transmission(model.pwv, float(np.median(model.observation.elevation)))
    )
    return (
        f", PWV {model.pwv * 1e3:.3g} mm with {100 * step.pwv_rms:.3g} % rms, transmission"
        f" {passed:.3g}"
    )


def _filters(survey: Survey) -> list[str]:
    found = [f"high-pass {survey.cut:.3g} Hz"] if survey.cut else []
    return [*found, "common mode"] if survey.common else found


def _table(found: Forecast, depth: Depth) -> list[str]:
    here = depth.total(found.seconds)
    scale = {unit: prefixed(float(here) * found.factors[unit], unit) for unit in UNITS}
    kelvin, name = scale["K_RJ"]
    head = [
        "time",
        name,
        *PARTS,
        *(TITLES.get(u, "") + (" " if u in TITLES else "") + scale[u][1] for u in UNITS[1:]),
    ]
    rows = []
    for t in found.times.tolist():
        total = float(depth.total(t))
        each = [
            number(float(depth.part(p, t)) * kelvin) if p in depth.known else "-" for p in PARTS
        ]
        others = [number(total * found.factors[u] * scale[u][0]) for u in UNITS[1:]]
        mark = "" if depth.seconds[0] * (1 - 1e-9) <= t <= depth.seconds[-1] * (1 + 1e-9) else " *"
        rows.append([duration(t) + mark, number(total * kelvin), *each, *others])
    return aligned(rows, head, ">")


def _errors(found: Forecast) -> list[str]:
    error = found.depth.error
    each = [f"{p} {100 * error[p]:.0f} %" for p in PARTS if found.depth.variance[p][-1] > 0]
    lines = [
        f"stated errors of the rms: {', '.join(each)}; together"
        f" {100 * found.depth.total_error(found.seconds):.0f} %"
    ]
    if found.depth.known != PARTS:
        lines.append(
            "-: what is left of the atmosphere is not forecast, and comes on top:"
            f" {found.depth.reason}"
        )
    if found.depth.variance["atmosphere"][-1] > 0:
        lines.append(
            "the atmosphere is indicative: one state of the weather, and pwv_rms is an assumption"
            " of the pipeline"
        )
    lines.append(
        "one map's rms in this circle scatters by about"
        f" {100 * scatter(found.survey.sigma, found.radius):.0f} % (white noise)"
    )
    if len(found.times):
        lines.append("*: not followed by scans; all parts as time^-1/2")
    return lines


def _calculated(found: Forecast) -> list[str]:
    c = found.calculated
    assert c is not None
    what = (
        f"{c.diameter:.4g} m dish, PWV {c.pwv * 1e3:.3g} mm, elevation"
        f" {math.degrees(c.elevation):.1f} deg"
    )
    figures = (
        f"{in_unit(c.centre, 'Jy')} at the band's centre, {in_unit(c.band, 'Jy')} averaged over the"
        " band"
    )
    return [
        (
            f"AtLAST sensitivity calculator's formula, {duration(c.seconds)} on one point source"
            f" ({what}):"
        ),
        f"  {figures}; one receiver at 5 h nu / k on AtLAST's surface, no filters: not this camera",
    ]


def made(asked: Mapping[str, Any], settings: Sequence[str]) -> str:
    """The pipeline that is made for an observer's words, and the changes to it."""
    text = default_pipeline.text(
        default_pipeline.Asked(**{k: v for k, v in asked.items() if v is not None})
    )
    return "\n".join(["# the pipeline:", text.rstrip(), *(f"# --set {s}" for s in settings), ""])


def reached(found: Forecast, wanted: str, seconds: float) -> str:
    """The integration time that reaches a depth, of a map of I, Q and U in each, and the kinds of
    noise that make it up; ``seconds``: that of I."""
    lines = []
    for plane, depth in found.planes.items():
        seconds = seconds if plane == "I" else found.reach(wanted, plane)
        parts = ", ".join(
            f"{p} {in_unit(float(depth.part(p, seconds)), 'K_RJ')}" for p in depth.known
        )
        low, high = ((1 + sign * depth.total_error(seconds)) ** 2 * seconds for sign in (-1, 1))
        lines += [
            (f"band {found.band}: " if found.band else "")
            + (f"{plane}: " if found.polarization else "")
            + f"{wanted} after {duration(seconds)} of integration, {low / 3600:.3g} to"
            f" {high / 3600:.3g} h by the stated errors",
            f"  {parts}",
        ]
    end = float(found.depth.seconds[-1])
    if seconds > end:
        text = (
            "  white and 1/f noise fall as time^-1/2; the atmosphere is forecast for the first"
            f" {duration(end)}"
        )
        lines.append(f"{text} and taken to do so too")
    return "\n".join(lines)


def reached_by_all(wanted: str, seconds: float) -> str:
    """Time to a depth in every band."""
    return f"{wanted} in all bands after {duration(seconds)} of integration"


def as_dict(found: Forecast) -> dict[str, Any]:
    """See `Sensitivity.as_dict`."""
    survey, c = found.survey, found.calculated
    low, high = elevations(survey)
    return {
        "pipeline": found.file.header.name,
        "instrument": survey.scene.instrument.name,
        "band": survey.scene.instrument.band.name,
        "site": survey.scene.site.name,
        "start": str(survey.observations[0].start),
        "scans": len(survey.observations),
        "scan_seconds": float(found.depth.seconds[-1]),
        "elevation_deg": [math.degrees(low), math.degrees(high)],
        "fwhm_arcsec": survey.fwhm / ARCSEC,
        "radius_arcmin": found.radius / ARCMIN,
        "seconds": found.seconds,
        "units_per_K_RJ": dict(found.factors),
        "relative_error": dict(found.depth.error),
        "audited_within": WITHIN,
        "scatter_of_one_map": scatter(found.survey.sigma, found.radius),
        "table": _rows(found, found.depth),
        **(
            {"stokes": {p: _rows(found, d) for p, d in found.polarization.items()}}
            if found.polarization
            else {}
        ),
        "calculator": (
            None
            if c is None
            else {
                "Jy_at_centre": c.centre,
                "Jy_over_band": c.band,
                "seconds": c.seconds,
                "pwv_m": c.pwv,
            }
        ),
        "audit": None if found.audit is None else found.audit.as_dict(),
    }


def _rows(found: Forecast, depth: Depth) -> list[dict[str, Any]]:
    """Rows of a plane's table, for JSON; null: not forecast."""
    return [
        {
            "seconds": t,
            "followed": bool(depth.seconds[0] * (1 - 1e-9) <= t <= depth.seconds[-1] * (1 + 1e-9)),
            "depth": {u: float(depth.total(t)) * found.factors[u] for u in UNITS},
            "K_RJ": {p: float(depth.part(p, t)) if p in depth.known else None for p in PARTS},
            "relative_error": depth.total_error(t),
        }
        for t in found.times.tolist()
    ]


def write(found: Forecast, folder: Path) -> list[Path]:
    """See `Sensitivity.write`. Raises OutputError."""
    return write_bands(found.file, {found.band: found}, folder)


def write_bands(file: PipelineFile, bands: Mapping[str, Forecast], folder: Path) -> list[Path]:
    """See `SensitivityOfBands.write`. Raises OutputError."""
    check_output_folder(folder)
    paths = [path for found in bands.values() for path in write_depth(found, folder)]
    return [*paths, write_text(folder / "pipeline.yaml", file.resolved_yaml())]


def write_depth(found: Forecast, folder: Path) -> list[Path]:
    """Table and picture; the band's name is behind theirs where the camera has several. Raises
    OutputError.
    """
    from .picture import figure

    stem = f"sensitivity_{found.band}" if found.band else "sensitivity"
    seconds = found.times
    columns = [Column("time", seconds, "s", "integration time")]
    for plane, depth in found.planes.items():
        before, of = ("", "") if plane == "I" else (f"{plane}_", f" of {plane}")
        for unit in UNITS:
            what = "flux density of a point source" if unit == "Jy" else "rms behind the beam"
            name = f"{before}depth_" + unit.replace("/", "_per_")
            fits = "K" if unit.startswith("K_") else unit
            columns.append(
                Column(
                    name,
                    depth.total(seconds) * found.factors[unit],
                    fits,
                    f"{what}, {unit}, all noise{of}",
                )
            )
        for part in depth.known:
            name = before + part.replace("1/f", "one_over_f")
            columns.append(
                Column(name, depth.part(part, seconds), "K", f"rms of the {part} noise{of}, K_RJ")
            )
    meta = {
        "PIPELINE": found.file.header.name,
        "INSTRUMENT": found.survey.scene.instrument.name,
        "BAND": found.survey.scene.instrument.band.name,
        "SITE": found.survey.scene.site.name,
        "BEAM": f"{found.survey.fwhm / ARCSEC:.6g} arcsec",
        "RADIUS": f"{found.radius / ARCMIN:.6g} arcmin",
        "SCANS": len(found.survey.observations),
        "SCANTIME": float(found.depth.seconds[-1]),
        **{
            f"ERROR_{p.replace('1/f', 'one_over_f').upper()}": float(found.depth.error[p])
            for p in PARTS
        },
    }
    table, picture = (folder / f"{stem}.{kind}" for kind in ("ecsv", "png"))
    write_ecsv(table, columns, meta)
    with atomic_path(picture) as temporary:
        figure(found).savefig(temporary)
    return [table, picture]
