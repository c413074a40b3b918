"""The picture of ``zonda when``: elevation against time tonight, and month against hour with the
PWV.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.canvas import SEQUENCE, log_labels, new_figure
from zonda.core.types import Floats
from zonda.operators.atmosphere.weather.summary import MONTHS

from .visibility import HORIZON, HOUR, Month, Seen, solar_offset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

TWILIGHT = (HORIZON, math.radians(-12), math.radians(-18))
"""Elevations of the Sun between which the shade of the night grows."""


def when_figure(seen: Seen, year: Sequence[Month]) -> Figure:
    """Tonight above, the year below; one figure, not pyplot's."""
    figure = new_figure(f"{seen.name} from {seen.site.name}", (8.5, 8.5))
    upper, lower = figure.subplots(2, 1)
    plot_night(upper, seen)
    plot_year(lower, seen, year)
    return figure  # type: ignore[no-any-return]


def plot_night(ax: Any, seen: Seen) -> None:
    """Elevation of the target, the Sun and the Moon from noon to noon; the night is shaded."""
    night, offset = seen.night, solar_offset(seen.site)
    hours = (night.times - night.times[0]) / HOUR
    utc = (night.times[0] % 86400) / HOUR
    shade: Any = {"color": "0.5", "alpha": 0.16, "lw": 0, "transform": ax.get_xaxis_transform()}
    for depth in TWILIGHT:
        ax.fill_between(hours, 0, 1, where=night.sun.elevation < depth, **shade)
    own = seen.name.lower()
    for track, name, colour in (
        (night.sun, "Sun", SEQUENCE[4]),
        (night.moon, f"Moon, {100 * night.moon_lit:.0f} % lit", "0.45"),
    ):
        if not name.lower().startswith(own):
            ax.plot(hours, np.degrees(track.elevation), color=colour, lw=1.0, ls="--", label=name)
    elevation, limit = np.degrees(night.target.elevation), math.degrees(night.above)
    up = np.where(elevation >= limit, elevation, np.nan)
    ax.plot(hours, elevation, color=SEQUENCE[0], lw=1.0)
    ax.plot(hours, up, color=SEQUENCE[0], lw=2.8, label=seen.name)
    ax.axhline(limit, color=SEQUENCE[1], lw=0.8, label=f"{limit:.4g} deg")
    ax.set_xlim(0, 24)
    ax.set_ylim(0, 90)
    ax.set_yticks(range(0, 91, 15))
    ax.set_ylabel("elevation [deg]")
    ax.set_xlabel(f"UTC [h], night of {seen.night_name}")
    solar = ax.secondary_xaxis("top", functions=(lambda x: x, lambda x: x))
    solar.set_xlabel("local mean solar time [h]")
    begin = ((night.times[0] + offset) % 86400) / HOUR
    for axis, start in ((ax, utc), (solar, begin)):
        every = np.arange(math.ceil(start / 2) * 2, start + 24.01, 2)
        axis.set_xticks(every - start, [f"{t % 24:02.0f}" for t in every])
    ax.grid(alpha=0.25, lw=0.5)
    ax.legend(loc="lower center", bbox_to_anchor=(0.5, -0.42), ncols=4, frameon=False, fontsize=9)


def plot_year(ax: Any, seen: Seen, year: Sequence[Month]) -> None:
    """Month against hour (UTC): the median PWV, lines of equal elevation, and hatching where the
    Sun is up.
    """
    place = np.concatenate([number + month.place for number, month in enumerate(year)])
    elevation = np.degrees(np.concatenate([month.elevation for month in year]))
    day = np.concatenate([month.depth for month in year]) <= 0
    hours = np.linspace(0, 24, elevation.shape[1])
    if seen.known:
        _plot_pwv(ax, 1e3 * seen.pwv_by_month[:, :, 1])
    ax.contourf(
        hours, place, day.astype(np.float64), levels=[0.5, 1.5], colors="none", hatches=["//"]
    )
    limit = math.degrees(seen.night.above)
    low, high = elevation.min(), elevation.max()
    monthly = seen.name.lower() == "moon"  # too many lines for names
    steps = (15.0, 30.0, 45.0, 60.0, 75.0)
    levels = [level for level in steps if low < level < high and abs(level - limit) > 4]
    where = hours, place, elevation
    if levels and not monthly:
        colour = "white" if seen.known else "black"
        thin = ax.contour(*where, levels=levels, colors=colour, linewidths=0.7)
        ax.clabel(thin, fmt="%g°", fontsize=8)
    if low < limit < high:
        width = 1.2 if monthly else 2.2
        thick = ax.contour(*where, levels=[limit], colors=SEQUENCE[1], linewidths=width)
        if not monthly:
            ax.clabel(thick, fmt=f"{limit:.4g}°", fontsize=9)
    else:
        ax.set_title(f"{'always' if low >= limit else 'never'} above {limit:.4g} deg", fontsize=10)
    ax.set_yticks(np.arange(12) + 0.5, MONTHS)
    ax.tick_params(axis="y", length=0)
    ax.set_xticks(range(0, 25, 3))
    ax.set_xlim(0, 24)
    ax.set_ylim(12, 0)
    ax.set_xlabel(f"UTC [h] in {seen.when.datetime.year}; hatched: the Sun is up; lines: elevation")


def _plot_pwv(ax: Any, pwv: Floats) -> None:
    """The PWV (12, 24) [mm] in the middle of each month, with its colour bar."""
    from matplotlib.colors import LogNorm

    closed = np.concatenate([pwv, pwv[:, :1]], axis=1)
    closed = np.concatenate([closed[-1:], closed, closed[:1]])
    norm = LogNorm(pwv.min(), pwv.max())
    style: Any = {"cmap": "viridis_r", "shading": "gouraud", "rasterized": True}
    image = ax.pcolormesh(np.arange(25), np.arange(14) - 0.5, closed, norm=norm, **style)
    bar = ax.figure.colorbar(image, ax=ax, pad=0.02)
    bar.set_label("median PWV [mm]")
    log_labels(bar.ax.yaxis)
