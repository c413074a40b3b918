"""The work-precision diagram: error against CPU seconds, both logarithmic."""

from __future__ import annotations

from typing import Any

from .study import Study
from .sweep import Alone

COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#666666")
"""Okabe & Ito 2008: told apart by colour-blind eyes."""
MARKERS = "osD^vPX"


def draw(study: Study, ax: Any = None) -> Any:
    """Each knob alone, the Pareto front, the file's own and the chosen setting, floor and scatter;
    returns the Axes.

    A setting that gives the reference's bits has no place on a logarithmic axis: it stands on the
    lower edge, hollow.
    """
    if ax is None:
        from matplotlib.figure import Figure

        ax = Figure(figsize=(7.6, 5.4), dpi=120, layout="constrained").add_subplot()
    errors = [p.error for p in study.points] + [
        r.error or 0.0 for a in study.sweep.alone if not a.knob.redraws for r in a.rungs
    ]
    smallest = min([e for e in errors if e > 0] + [study.setup.target])
    bottom = smallest / 4
    ax.set_yscale("log")
    ax.set_xscale("log")
    for number, alone in enumerate(
        a for a in study.sweep.alone if not a.knob.redraws and not a.inert
    ):
        _line(ax, alone, COLOURS[number % len(COLOURS)], MARKERS[number % len(MARKERS)], bottom)
    front, present, chosen = study.front, study.present, study.chosen
    x, y, spread = (
        [p.seconds for p in front],
        [max(p.error, bottom) for p in front],
        [p.spread for p in front],
    )
    ax.errorbar(
        x,
        y,
        xerr=spread,
        color="black",
        marker=".",
        ms=7,
        lw=1.8,
        elinewidth=0.8,
        label="Pareto front",
        zorder=4,
    )
    ax.plot(
        present.seconds,
        max(present.error, bottom),
        "s",
        ms=10,
        mfc="none",
        mec="black",
        label="the file's setting",
        zorder=5,
    )
    if chosen:
        ax.plot(
            chosen.seconds,
            max(chosen.error, bottom),
            "*",
            ms=15,
            color="#E69F00",
            mec="black",
            label="chosen",
            zorder=5,
        )
    ax.axhline(
        study.setup.target,
        color="black",
        lw=1,
        ls="--",
        label=f"target {100 * study.setup.target:.3g} %",
    )
    for value, style, name in (
        (study.floor, ":", "instrument noise"),
        (study.scatter, "-.", "realization scatter"),
    ):
        if value:
            ax.axhline(value, color="#666666", lw=1, ls=style, label=name)
    ax.set_ylim(bottom=bottom)
    ax.text(
        0.01,
        0.01,
        "hollow on this edge: the reference's bits",
        transform=ax.transAxes,
        fontsize=7,
        color="#666666",
    )
    _axes(ax, study)
    return ax


def save(study: Study, path: Any) -> None:
    """Draw to a file (PNG, PDF, SVG by its suffix)."""
    from ..storage.files import atomic_path

    with atomic_path(path) as temporary:
        draw(study).figure.savefig(temporary)


def _line(ax: Any, alone: Alone, colour: str, marker: str, bottom: float) -> None:
    """One knob alone, coarse to fine."""
    rungs = [r for r in alone.rungs if r.error is not None]
    errors = [max(r.error or 0.0, bottom) for r in rungs]
    seconds, spread = [r.seconds for r in rungs], [r.spread for r in rungs]
    ax.errorbar(
        seconds, errors, xerr=spread, color=colour, lw=0.9, elinewidth=0.6, alpha=0.6, zorder=2
    )
    for x, y, r in zip(seconds, errors, rungs, strict=True):
        ax.plot(
            x,
            y,
            marker,
            color=colour,
            ms=5,
            mfc=colour if r.error else "white",
            zorder=3,
            clip_on=False,
        )
    ax.plot([], [], color=colour, marker=marker, ms=5, lw=0.9, label=f"{alone.knob.key} alone")


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
    ax.legend(
        fontsize=7, loc="center left", bbox_to_anchor=(1.01, 0.5), frameon=False, markerscale=0.8
    )
