"""The depth of a map against time, and a source in it: text, table and picture of a forecast."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.canvas import COLOURS, DPI
from zonda.core.numerics.sphere import ARCMIN, ARCSEC, angle_text
from zonda.core.storage.files import atomic_path, check_output_folder, write_text
from zonda.core.storage.table_files import Column, write_ecsv
from zonda.core.tables import aligned
from zonda.core.types import Floats

from .depth import PARTS, UNITS, Depth, duration, in_unit, number, prefixed, scatter, unit_of
from .source import OF, Seen, sigmas
from .survey import elevations

if TYPE_CHECKING:
    from .sensitivity import Sensitivity

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
    if that is ``wanted``. All times are in one unit.
    """
    needed = [] if wanted is None else [
        one.reach(wanted, of=of) for one in each for of in (OF if sigmas(wanted) else OF[:1])
    ]  # fmt: skip
    unit = unit_of(max([one.seconds for one in each] + [t for t in needed if math.isfinite(t)]))
    parts = [_text(one, unit) for one in each]
    parts += [_reached(one, wanted, unit) for one in each if wanted is not None]
    if wanted is not None and len(each) > 1:
        longest = duration(max(one.reach(wanted) for one in each), unit)
        parts.append(f"{wanted} in all bands after {longest} of integration")
    return "\n\n".join(parts)


def _text(found: Sensitivity, unit: str) -> str:
    parts = [
        _header(found, unit),
        [noise_alone(found)] if found.source is None else _source(found, found.source),
    ]
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


def _source(found: Sensitivity, s: Seen) -> list[str]:
    where = "at the map's centre"
    if s.source.kind == "file":
        where = f"peak {angle_text(s.away)} from the map's centre"
    unit = next((u for u in found.factors if str(s.source.peak).endswith(u)), "Jy/beam")
    seen = in_unit(s.peak * found.factors[unit], unit)
    return [
        f"source: {s.source.words}, {where}, {seen} ({in_unit(s.peak, 'K_RJ')}) at its peak as the"
        " beam sees it",
        f"  of its peak in the map smoothed with the beam, {in_unit(s.smoothed, 'K_RJ')}, the"
        f" filters leave {100 * s.kept[-1]:.3g} % (closed form)",
        "  S/N of the peak: what is left of it in that map over the rms there",
        "  S/N of the template: the map times the source as the beam sees it, unfiltered, and the"
        " map's weights, over the rms",
        "  that all noise gives this sum (behind white noise sqrt(t^T N^-1 t), t the filtered"
        " template)",
    ]


def _header(found: Sensitivity, unit: str) -> list[str]:
    survey, count = found.survey, len(found.survey.observations)
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
        f" scan{'s' if count > 1 else ''}, {duration(float(found.depth.seconds[-1]), unit)} in all,"
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


def _reached(found: Sensitivity, wanted: str, unit: str) -> str:
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
            f" {duration(end, unit)} and taken to do so too"
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
        _draw_source(found, found.source, others[0], t)
    return drawn


def _draw_source(found: Sensitivity, source: Seen, ax: Any, t: Floats) -> None:
    """Signal-to-noise ratios against time [s]."""
    for of, color in zip(OF, ("#0072B2", "#009E73"), strict=True):
        ax.plot(t / 3600, source.snr(found.depth, t, of), lw=2, color=color, label=of)
    ax.axhline(5, color="black", lw=0.8, ls=":", label="5 sigma")
    ax.set(xscale="log", yscale="log", xlabel="integration time [h]", ylabel="S/N")
    for axis in (ax.xaxis, ax.yaxis):
        axis.set_major_formatter("{x:g}")
    ax.grid(alpha=0.25, lw=0.5, which="both")
    ax.legend(frameon=False)
    kept = f"{100 * source.kept[-1]:.3g} % of its peak left"
    ax.set_title(f"{source.source.words}: {kept}", fontsize=10)
