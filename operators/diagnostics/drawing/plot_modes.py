"""Pictures of principal components."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from .canvas import SEQUENCE, log_labels, new_figure, unit_of, write_title

if TYPE_CHECKING:
    from matplotlib.axes import Axes

    from ..series import Modes

SHOWN = 4
"""Modes whose streams are drawn."""


def plot_modes(modes: Modes, *, axes: Any = None, title: str = "Modes") -> Axes:
    """Share of the variance in each mode, and the leading modes in time, below one another;
    ``axes``: two Axes to draw into.
    """
    left, right = axes or new_figure(
        (9.6, 4.2), [(0.085, 0.14, 0.30, 0.77), (0.475, 0.14, 0.515, 0.77)]
    )
    share = modes.shares[modes.shares > 0]
    left.loglog(
        np.arange(1, share.size + 1), share, "o-", color=SEQUENCE[0], markersize=3.5, linewidth=0.9
    )
    for k, value in enumerate(share[:2]):
        place: dict[str, Any] = {"xytext": (5, 5), "textcoords": "offset points", "fontsize": 9}
        left.annotate(f"{100 * value:.3g} %", (k + 1, value), **place)
    left.set_xlabel("mode")
    left.set_ylabel("share of the variance")
    left.set_xlim(0.8, max(2.0, 1.2 * share.size))
    left.grid(which="major", color="0.9", linewidth=0.7)
    for axis, limits in ((left.xaxis, left.get_xlim()), (left.yaxis, left.get_ylim())):
        log_labels(axis, *limits)
    rows = modes.streams[:SHOWN] / np.sqrt(max(1, modes.vectors.shape[1]))
    peak = float(np.nanmax(abs(rows), initial=0.0)) or 1.0
    factor, unit = unit_of(peak) if modes.unit else (1.0, "")
    step = max(1, rows.shape[1] // 4000)
    for k, row in enumerate(rows):
        right.plot(
            modes.seconds[::step],
            row[::step] * factor,
            linewidth=0.7,
            color=SEQUENCE[k],
            label=f"{k + 1}",
            zorder=4 - k,
        )
    right.set_xlabel(f"time since the start of {modes.observation} [s]")
    right.set_ylabel(f"mode / √rows [{unit}]" if unit else "mode / √rows")
    right.margins(x=0)
    low, high = right.get_ylim()
    right.set_ylim(low, high + 0.12 * (high - low))
    right.grid(color="0.92", linewidth=0.7)
    for line in right.legend(fontsize=8, frameon=False, ncols=SHOWN, loc="upper right").get_lines():
        line.set_linewidth(2)
    write_title(left, title, room=3.2)
    return left  # type: ignore[no-any-return]
