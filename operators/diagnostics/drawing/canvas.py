"""Matplotlib figures without pyplot: margins, colours and labels that all pictures share."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

COLOURS = {
    "signal": "#000000",
    "atmosphere": "#0072B2",
    "pink": "#CC79A7",
    "white": "#999999",
    "sky": "#D55E00",
    "transmission": "#009E73",
}
OTHER = "#56B4E9"
SEQUENCE = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9", "#000000")
PALE = {"facecolor": "white", "alpha": 0.75, "edgecolor": "none", "pad": 1.0}
"""The box behind text that lies on lines."""

DPI = 110
TOP, BOTTOM = 0.34, 0.58
"""Margins for a title, and for tick labels with an axis label, in."""
CHARACTER, LINE = 0.078, 0.17
"""Width of a character and height of a line of 9 pt text, in."""


def new_axes(
    ax: Any,
    size: tuple[float, float] = (7.2, 5.0),
    left: float = 0.85,
    top: float = TOP,
    right: float = 0.12,
) -> Any:
    """``ax``, or the Axes of a new figure that belongs to nobody else (not to pyplot). ``left``,
    ``top``, ``right``: margins, in."""
    if ax is not None:
        return ax
    width, height = size
    inside = (
        left / width,
        BOTTOM / height,
        1 - (left + right) / width,
        1 - (BOTTOM + top) / height,
    )
    return new_figure(size, [inside])[0]


def new_figure(
    size: tuple[float, float], places: Sequence[tuple[float, float, float, float]]
) -> list[Any]:
    """The axes of a new figure of ``size`` [in], at ``places`` (left, bottom, width, height),
    shares of it.
    """
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=DPI)
    return [figure.add_axes(place) for place in places]


def fit_left(ax: Any) -> None:
    """Move the left edge of the one axes of a figure to where its tick labels and their name have
    room.
    """
    labels = ax.yaxis.get_major_formatter().format_ticks(ax.yaxis.get_majorticklocs())
    left = (
        0.4 + 1.12 * CHARACTER * max((len(label) for label in labels), default=0)
    ) / ax.figure.get_figwidth()
    box = ax.get_position()
    ax.set_position((left, box.y0, box.x1 - left, box.height))


def unit_of(peak: float) -> tuple[float, str]:
    """Factor and name of the unit in which a brightness of ``peak`` kelvin reads well."""
    for factor, name in ((1e6, "µK"), (1e3, "mK")):
        if peak * factor < 3e3:
            return factor, name
    return 1.0, "K"


_RAISED = str.maketrans("-0123456789", "⁻⁰¹²³⁴⁵⁶⁷⁸⁹")


def _power_of_ten(value: float) -> str:
    power = int(np.floor(np.log10(value) + 1e-9))
    mantissa = f"{value / 10.0**power:.3g}"
    return f"{'' if mantissa == '1' else mantissa + ' · '}10{str(power).translate(_RAISED)}"


def log_labels(axis: Any, low: float, high: float) -> None:
    """Label the powers of ten between ``low`` and ``high``, and 2 and 5 of each where there are few
    of them.
    """
    few = 0 < low < high < 160 * low
    text = (lambda value: f"{value:.6g}") if low > 1e-3 and high < 1e5 else _power_of_ten
    axis.set_major_formatter(lambda value, _: text(value) if value > 0 else "")
    axis.set_tick_params(
        which="minor", pad=5
    )  # their labels are as far away as those of the longer marks
    axis.set_minor_formatter(
        lambda value, _: text(value) if few and value > 0 and f"{value:.0e}"[0] in "25" else ""
    )


def write_title(ax: Any, title: str, pad: float | None = None, room: float | None = None) -> None:
    """Above the axes, where it stands: looking for room takes as long as drawing. ``room``: its
    width, in; where that is not enough for 12 pt, the letters are smaller."""
    size = None if room is None else min(12.0, max(7.0, 12.0 * room / (0.1 * max(len(title), 1))))
    ax.set_title(title, y=1.0, pad=pad, **({} if size is None else {"fontsize": size}))
