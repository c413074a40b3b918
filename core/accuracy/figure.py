"""The work-precision diagram: error against CPU seconds, both logarithmic."""

from __future__ import annotations

from typing import Any

from .study import Study

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#666666")
"""Okabe & Ito 2008: told apart by colour-blind eyes."""
MARKERS = "osD^vPX"


def draw(study: Study, ax: Any = None) -> Any:
    """Each knob alone, the joint front, the file's own and the chosen setting, floor and scatter; returns the Axes.

    A setting that gives the reference's bits has no place on a logarithmic axis: it stands on the lower edge, hollow.
    """
    if ax is None:
        from matplotlib.figure import Figure

        ax = Figure(figsize=(7.6, 5.4), dpi=120, layout="constrained").add_subplot()
    errors = [p.error for p in study.points] + [r.error or 0.0 for a in study.sweep.alone if not a.knob.redraws for r in a.rungs]
    smallest = min([e for e in errors if e > 0] + [study.setup.target])
    bottom = smallest / 4
    ax.set_yscale("log")
    ax.set_xscale("log")
    shown = [a for a in study.sweep.alone if not a.knob.redraws and not a.inert]
    for number, alone in enumerate(shown):
        colour, marker = COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)]
        rungs = [r for r in alone.rungs if r.error is not None]
        x, y = [r.seconds for r in rungs], [max(r.error or 0.0, bottom) for r in rungs]
        ax.plot(x, y, color=colour, lw=0.9, alpha=0.7, zorder=2)
        for r, e in zip(rungs, y, strict=True):
            ax.errorbar(
                r.seconds, e, xerr=r.spread, color=colour, marker=marker, ms=5, mfc=colour if r.error else "none", zorder=2
            )
        ax.plot([], [], color=colour, marker=marker, ms=5, lw=0.9, label=f"{alone.knob.key} alone")
    front = study.front
    x, y = [p.seconds for p in front], [max(p.error, bottom) for p in front]
    ax.errorbar(
        x, y, xerr=[p.spread for p in front], color="black", marker=".", ms=7, lw=1.8, capsize=2, label="joint front", zorder=3
    )
    ax.plot(
        study.present.seconds, max(study.present.error, bottom), "s", ms=10, mfc="none", mec="black", label="the file's setting"
    )
    if study.chosen:
        ax.plot(
            study.chosen.seconds,
            max(study.chosen.error, bottom),
            "*",
            ms=16,
            color="#E69F00",
            mec="black",
            label="chosen",
            zorder=4,
        )
    ax.axhline(study.setup.target, color="black", lw=1, ls="--", label=f"target {100 * study.setup.target:.3g} %")
    for value, style, name in ((study.floor, ":", "instrument noise"), (study.scatter, "-.", "realization scatter")):
        if value:
            ax.axhline(value, color="#666666", lw=1, ls=style, label=name)
    ax.set_ylim(bottom=bottom)
    _axes(ax, study)
    return ax


def save(study: Study, path: Any) -> None:
    """Draw to a file (PNG, PDF, SVG by its suffix)."""
    from ..files import atomic_path

    with atomic_path(path) as temporary:
        draw(study).figure.savefig(temporary)


def _axes(ax: Any, study: Study) -> None:
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    ax.set_xlabel(f"CPU seconds (median of {study.setup.repeats} runs, bars: half their range)")
    ax.set_ylabel(f"error of {study.setup.metric}")
    ax.set_title(f"{study.setup.pipeline}: {study.says}", fontsize=9, wrap=True)
    ax.yaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{100 * v:g} %"))
    ax.xaxis.set_major_locator(LogLocator(subs=(1, 1.5, 2, 3, 5, 7)))
    ax.xaxis.set_major_formatter(FuncFormatter(lambda v, _: f"{v:g}"))
    ax.xaxis.set_minor_formatter(NullFormatter())
    ax.grid(True, which="major", color="#dddddd", lw=0.6)
    ax.legend(fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False)
