"""A claim in one picture: the paper's value, zonda's realizations and mean, and the
counter-experiments below them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from zonda.core.experiment.experiment import Values

    from .rows import CounterResult, Row

LINE = 0.42
"""Height of a line, in."""
OWN, GOOD, BAD = "#0072B2", "#009E73", "#b3261e"
"""Colours of the claim, and of counter-experiments that satisfy their criterion or do not."""


def draw(row: Row) -> Figure:
    """A figure of its own. Counter-experiments of another quantity or unit than the claim's have
    axes of their own below.
    """
    from matplotlib.figure import Figure

    claim, paper = row.claim, row.claim.paper
    beside = [_line(c) for c in row.counters if c.comparable]
    own = ([("zonda", row.values, OWN), *beside], paper.factor, paper.unit or claim.statistic)
    panels = [own]
    for name, alike in groupby((c for c in row.counters if not c.comparable), _axis):
        found = list(alike)
        panels.append((list(map(_line, found)), found[0].unit.factor, name))
    heights = [(0.6 if k else 1.3) + LINE * len(lines) for k, (lines, _, _) in enumerate(panels)]
    figure = Figure(figsize=(6.4, sum(heights)), dpi=110, layout="constrained")
    axes = figure.subplots(len(heights), squeeze=False, height_ratios=heights)[:, 0]
    value, half = paper.value / paper.factor, (claim.rounding.value + claim.error.value)
    sign = {"equal": "", "at_least": "at least ", "at_most": "at most "}[claim.relation]
    if half:
        span = value - half / paper.factor, value + half / paper.factor
        axes[0].axvspan(*span, color="#E69F00", alpha=0.25, lw=0)
    label = f"paper: {sign}{value:.4g} {paper.unit}".rstrip()
    axes[0].axvline(value, color="#D55E00", lw=1.5, label=label)
    for ax, panel in zip(axes, panels, strict=True):
        _draw_lines(ax, *panel)
    axes[0].legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def _draw_lines(
    ax: Any, lines: Sequence[tuple[str, Values, str]], factor: float, across: str | None
) -> None:
    """A line for each result: realizations as strokes, their mean with its standard error."""
    for k, (_, values, colour) in enumerate(lines):
        numbers = [v / factor for v in values.values]
        if len(numbers) > 1:
            ax.plot(numbers, [-k - 0.18] * len(numbers), "|", color=colour, ms=8, alpha=0.6)
        error, mean = values.standard_error / factor or None, values.mean / factor
        ax.errorbar(mean, -k, xerr=error, fmt="o", color=colour, ms=6, capsize=3)
    ax.set_yticks([-k for k in range(len(lines))], [name for name, _, _ in lines])
    ax.set_ylim(-len(lines) + 0.4, 0.6)
    ax.set_xlabel(across or "value")
    ax.ticklabel_format(axis="x", useOffset=False)
    ax.grid(True, axis="x", color="#dddddd", lw=0.6)
    ax.margins(x=0.08)


def _axis(counter: CounterResult) -> str:
    """Name of its values, with their unit."""
    unit, what = counter.unit.unit, counter.experiment.statistic or "value"
    return f"{what} [{unit}]" if unit else what


def _line(counter: CounterResult) -> tuple[str, Values, str]:
    """Name, values and colour of its line."""
    colour = GOOD if counter.satisfied else BAD
    return counter.name.replace("_", " "), counter.values, colour
