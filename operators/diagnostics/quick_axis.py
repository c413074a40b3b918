"""Make a finished figure quicker to draw, to the same pixels.

An axis is drawn with one tick in all places, instead of one tick object (five artists) for each place; an image is coloured
before it is brought to the figure's pixels.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np


def prepare(figure: Any) -> None:
    """Let ``figure`` be drawn so from now on, but for axes that are not plain ones (astropy's)."""
    from matplotlib.axes import Axes

    for ax in figure.axes:
        for image in ax.images:
            if np.ndim(image.get_array()) == 2:
                image.set_data(image.to_rgba(image.get_array(), bytes=True))
        if type(ax) is Axes:
            for axis in (ax.xaxis, ax.yaxis):
                axis.draw = partial(draw_axis, axis)  # type: ignore[method-assign]


def draw_axis(axis: Any, renderer: Any) -> None:
    """As ``axis.draw(renderer)`` of matplotlib.axis.Axis."""
    from matplotlib.transforms import Bbox

    if not axis.get_visible():
        return
    boxes: tuple[list[Any], list[Any]] = ([], [])
    _draw_ticks(axis.get_major_ticks(1)[0], axis, axis.get_majorticklocs(), axis.get_major_formatter(), renderer, boxes)
    _draw_ticks(axis.get_minor_ticks(1)[0], axis, axis.get_minorticklocs(), axis.get_minor_formatter(), renderer, boxes)
    label, edge = axis.label, axis.get_label_position()
    far = edge in ("top", "right")
    if label.get_text():
        spine = axis.axes.spines[edge] if edge in axis.axes.spines and not boxes[far] else axis.axes
        around = Bbox.union([*boxes[far], spine.get_window_extent(renderer)])  # labels are farther out than marks
        pad = axis.labelpad * axis.axes.figure.dpi / 72
        x, y = label.get_position()
        place = {"bottom": (x, around.y0 - pad), "top": (x, around.y1 + pad)}
        place |= {"left": (around.x0 - pad, y), "right": (around.x1 + pad, y)}
        label.set_position(place[edge])
    label.draw(renderer)
    if offset := axis.get_major_formatter().get_offset():
        axis.offsetText.set_text(offset)
        axis._update_offset_text_position(*boxes)
        axis.offsetText.draw(renderer)


def _draw_ticks(tick: Any, axis: Any, places: Any, formatter: Any, renderer: Any, boxes: tuple[list[Any], list[Any]]) -> None:
    """``tick`` in all ``places`` within the axis; the extents of its labels are added to ``boxes``."""
    low, high = sorted(axis.get_transform().transform(np.asarray(axis.get_view_interval(), np.float64)))
    at = axis.get_transform().transform(np.asarray(places, np.float64))
    spare = 1e-10 * (high - low)
    inside = np.flatnonzero((at >= low - spare) & (at <= high + spare))
    texts = formatter.format_ticks(places)
    if not inside.size:
        return
    across = axis.axis_name == "x"
    if tick.gridline.get_visible():
        for k in inside:
            tick.update_position(places[k])
            tick.gridline.draw(renderer)
    for line in (tick.tick1line, tick.tick2line):
        if line.get_visible():
            along, edge = np.asarray(places, np.float64)[inside], np.full(inside.size, float(line is tick.tick2line))
            line.set_data(*((along, edge) if across else (edge, along)))
            line.draw(renderer)
    for label, found in zip((tick.label1, tick.label2), boxes, strict=True):
        if label.get_visible():
            for k in inside:
                tick.update_position(places[k])
                label.set_text(texts[k])
                label.draw(renderer)
                found.append(label.get_window_extent(renderer))
