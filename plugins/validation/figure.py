"""A claim in one picture: the paper's value, zonda's realizations and mean, and the
counter-experiments below them.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import groupby
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from .rows import CounterResult, Row
    from .verdict import Values

LINE = 0.42
"""Height of a line, in."""
OWN, GOOD, BAD = "#0072B2", "#009E73", "#b3261e"
"""Colours of the claim, and of counter-experiments that satisfy their criterion or do not."""


def draw(row: Row) -> Figure:
    """A figure of its own. Counter-experiments of another quantity or unit than the claim's have
    axes of their own below.
    """
    from matplotlib.figure import Figure

    beside = [c for c in row.counters if c.comparable]
    others = [
        list(found)
        for _, found in groupby((c for c in row.counters if not c.comparable), lambda c: _axis(c))
    ]
    heights = [1.3 + LINE * (1 + len(beside)), *(0.6 + LINE * len(found) for found in others)]
    figure = Figure(figsize=(6.4, sum(heights)), dpi=110, layout="constrained")
    axes = figure.subplots(len(heights), squeeze=False, height_ratios=heights)[:, 0]
    _draw_claim(axes[0], row, beside)
    for ax, found in zip(axes[1:], others, strict=True):
        _draw_lines(
            ax,
            [(_name(c), c.values, _colour(c)) for c in found],
            found[0].unit.factor,
            _axis(found[0]),
        )
    return figure


def _draw_claim(ax: Any, row: Row, beside: Sequence[CounterResult]) -> None:
    """The claim and what is of its quantity. Numbers are in the unit of the paper's value."""
    claim, factor = row.claim, row.claim.paper.factor
    value, half = claim.paper.value / factor, (claim.rounding.value + claim.error.value) / factor
    sign = {"equal": "", "at_least": "at least ", "at_most": "at most "}[claim.relation]
    if half:
        ax.axvspan(value - half, value + half, color="#E69F00", alpha=0.25, lw=0)
    ax.axvline(
        value,
        color="#D55E00",
        lw=1.5,
        label=f"paper: {sign}{value:.4g} {claim.paper.unit}".rstrip(),
    )
    lines = [("zonda", row.values, OWN), *((_name(c), c.values, _colour(c)) for c in beside)]
    _draw_lines(ax, lines, factor, claim.paper.unit or claim.statistic or "value")
    ax.legend(fontsize=8, frameon=False, loc="lower center", bbox_to_anchor=(0.5, 1.0))


def _draw_lines(
    ax: Any, lines: Sequence[tuple[str, Values, str]], factor: float, across: str
) -> None:
    """A line for each result: realizations as strokes, their mean with its standard error."""
    for k, (_, values, colour) in enumerate(lines):
        numbers = [v / factor for v in values.values]
        if len(numbers) > 1:
            ax.plot(numbers, [-k - 0.18] * len(numbers), "|", color=colour, ms=8, alpha=0.6)
        error = values.standard_error / factor
        ax.errorbar(
            values.mean / factor,
            -k,
            xerr=error if error > 0 else None,
            fmt="o",
            color=colour,
            ms=6,
            capsize=3,
        )
    ax.set_yticks([-k for k in range(len(lines))], [name for name, _, _ in lines])
    ax.set_ylim(-len(lines) + 0.4, 0.6)
    ax.set_xlabel(across)
    ax.ticklabel_format(axis="x", useOffset=False)
    ax.grid(True, axis="x", color="#dddddd", lw=0.6)
    ax.margins(x=0.08)


def _axis(counter: CounterResult) -> str:
    """Name of its values, with their unit."""
    unit, what = counter.unit.unit, counter.experiment.statistic or "value"
    return f"{what} [{unit}]" if unit else what


def _name(counter: CounterResult) -> str:
    return counter.name.replace("_", " ")


def _colour(counter: CounterResult) -> str:
    return GOOD if counter.satisfied else BAD
