"""Pictures of the atmosphere above a site: profile, PWV by month and hour, spectra with the bands
of instruments; and of ``zonda when``: elevation against time tonight, and month against hour.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from zonda.core.canvas import PALE, SEQUENCE, log_labels, new_figure
from zonda.core.types import Floats
from zonda.operators.atmosphere.weather.climatology import HOURS, MONTHS, QUANTILES, PwvByMonth
from zonda.operators.atmosphere.weather.profiles import pwv_steps
from zonda.operators.atmosphere.weather.radiative_transfer import spectrum

from .visibility import HORIZON, HOUR, Month, Seen, solar_offset

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from zonda.core.instrument import Band
    from zonda.operators.atmosphere.weather.profiles import Profile

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
    night = seen.night
    offset = solar_offset(seen.site)
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
    elevation = np.degrees(night.target.elevation)
    limit = math.degrees(night.above)
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
        hours,
        place,
        day.astype(np.float64),
        levels=[0.5, 1.5],
        colors="none",
        hatches=["//"],
    )
    limit = math.degrees(seen.night.above)
    low = elevation.min()
    high = elevation.max()
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


LOWEST, HIGHEST = 1e9, 1000e9
"""Hz: what the absorption table holds, and the spectra show."""
LINES = {
    "H₂O": [
        22.24,
        183.31,
        325.15,
        380.20,
        448.00,
        474.69,
        556.94,
        620.70,
        752.03,
        916.17,
        970.32,
        987.93,
    ],
    "O₂": [60.3, 118.75, 368.50, 424.76, 487.25, 715.39, 773.84, 834.15],
    "O₃": [110.84, 249.96, 301.81, 358.85, 655.29, 843.0],
}
"""GHz: the strong lines of water and oxygen (of 60 GHz, the middle of many), and what stands out of
ozone's hundreds.
"""
LINE_COLOURS = dict(zip(LINES, SEQUENCE, strict=False))


def plot_profile(ax: Any, air: Profile) -> None:
    """Temperature, and on a second scale water vapour and wind, up to 20 km above the site."""
    low = air.height <= 20e3
    km = air.height[low] / 1e3
    ax.plot(air.temperature[low], km, color=SEQUENCE[1])
    ax.set_xlabel("temperature [K]", color=SEQUENCE[1])
    ax.set_ylabel("height above the site [km]")
    ax.set_ylim(0, 20)
    other = ax.twiny()
    other.plot(np.hypot(air.wind_east, air.wind_north)[low], km, color=SEQUENCE[0], label="wind")
    ground = float(air.vapour_density[0]) * 1e3
    scale = 10 ** math.floor(math.log10(20 / ground)) if ground > 0 else 1.0
    label = "vapour [g/m³]" if scale == 1 else f"vapour × {scale:g} [g/m³]"
    other.plot(air.vapour_density[low] * 1e3 * scale, km, color=SEQUENCE[2], label="vapour")
    other.set_xlim(left=0)
    other.set_xlabel(f"wind [m/s], {label}")
    other.legend(loc="upper right", fontsize=8, framealpha=0.85, edgecolor="none")


def plot_pwv(ax: Any, water: PwvByMonth) -> None:
    """PWV over the year: the medians of eight hours of the day, and the quantiles of the months."""
    month = np.arange(12)
    low, lower, _, upper, high = water.quantiles.T * 1e3
    bands = ((low, high, 0.3, QUANTILES[::4]), (lower, upper, 0.6, QUANTILES[1::2]))
    for first, last, alpha, (least, most) in bands:
        label = f"{100 * least:g} to {100 * most:g} %"
        ax.fill_between(month, first, last, color=SEQUENCE[5], alpha=alpha, lw=0, label=label)
    from matplotlib import colormaps

    for k, hour in enumerate(HOURS):
        colour = colormaps["viridis"](hour / 24)
        label = f"median, {hour:02d} h UTC"
        ax.plot(month, water.median[:, k] * 1e3, color=colour, lw=1.2, label=label)
    ax.set_yscale("log")
    ax.set_xticks(month, [name[0] for name in MONTHS])
    ax.set_ylabel("PWV [mm]")
    log_labels(ax.yaxis)
    ax.set_xlabel("month")
    below = {"loc": "upper center", "bbox_to_anchor": (0.5, -0.14), "frameon": False}
    ax.legend(fontsize=6.5, ncols=4, columnspacing=1.0, **below)


def plot_spectrum(
    ax: Any,
    air: Profile,
    elevation: float,
    bands: Sequence[Band],
    which: str,
) -> None:
    """Emission (``brightness``) or ``transmission`` from 1 to 1000 GHz for several PWVs; bands are
    shaded, lines named above.
    """
    low = LOWEST
    high = HIGHEST
    for k, pwv in enumerate(pwv_steps(air)):
        seen = spectrum(air.scaled(pwv).layers, elevation, low=low, high=high)
        values = seen.brightness if which == "brightness" else np.exp(-seen.slant_opacity)
        own = pwv == air.pwv
        label = f"PWV {pwv * 1e3:.3g} mm"
        style = {"color": "black", "lw": 1.4} if own else {"color": SEQUENCE[k % 6], "lw": 0.9}
        ax.plot(seen.frequency / 1e9, values, label=label, **style)
    place = ax.get_xaxis_transform()  # in the height of the picture, whatever its scale
    at, side = (0.98, "top") if which == "brightness" else (0.02, "bottom")
    named = sorted(enumerate(bands), key=lambda pair: pair[1].centre)
    centres = spread([band.centre / 1e9 for _, band in named], 1.4 * NAME, low / 1e9, high / 1e9)
    for (k, band), centre in zip(named, centres, strict=True):
        colour = SEQUENCE[(k + 3) % 7]
        ghz = band.frequency / 1e9
        ax.fill_between(ghz, band.transmission, color=colour, alpha=0.2, lw=0, transform=place)
        _upright(ax, band.name, (centre, at), va=side, fontsize=7, bbox=PALE)
    _name_lines(ax)
    ax.set_xlim(low / 1e9, high / 1e9)
    if which == "brightness":
        ax.set_yscale("log")
        ax.set_ylim(1.0, 400.0)
        ax.yaxis.set_major_formatter("{x:g}")
    else:
        ax.set_ylim(0, 1)
    ax.set_xlabel("frequency [GHz]")
    ax.set_ylabel("emission [K$_\\mathrm{RJ}$]" if which == "brightness" else "transmission")
    ax.grid(alpha=0.25, lw=0.5)


NAME = 21.0
"""GHz that a name beside another takes."""


def _name_lines(ax: Any) -> None:
    """Names of the lines above the spectrum, each with a stroke to its place."""
    rows = sorted(
        (frequency, name) for name, frequencies in LINES.items() for frequency in frequencies
    )
    place = ax.get_xaxis_transform()
    for (frequency, name), at in zip(
        rows,
        spread([f for f, _ in rows], NAME, LOWEST / 1e9, HIGHEST / 1e9),
        strict=True,
    ):
        colour = LINE_COLOURS[name]
        stroke = {"color": colour, "lw": 0.6, "clip_on": False, "transform": place}
        ax.plot([frequency, frequency, at], [1.0, 1.015, 1.05], **stroke)
        text = f"{name} {frequency:.0f}"
        _upright(ax, text, (at, 1.06), va="bottom", fontsize=6.5, color=colour)


def _upright(ax: Any, text: str, at: tuple[float, float], **style: Any) -> None:
    """Text across the axis, at a frequency and a height of the picture, whatever its scale."""
    ax.annotate(text, at, xycoords=ax.get_xaxis_transform(), rotation=90, ha="center", **style)


def spread(places: Sequence[float], least: float, low: float, high: float) -> list[float]:
    """Sorted places moved as little as makes them ``least`` apart (least squares), within ``low``
    and ``high``.
    """
    groups: list[
        tuple[float, int]
    ] = []  # places less what goes before, of names that touch: their mean and number
    for k, place in enumerate(places):
        mean = place - k * least
        count = 1
        while groups and groups[-1][0] >= mean:
            before, number = groups.pop()
            mean = (mean * count + before * number) / (count + number)
            count = count + number
        groups.append((mean, count))
    means = [mean for mean, count in groups for _ in range(count)]
    last = high - (len(places) - 1) * least
    return [max(min(mean, last), low) + k * least for k, mean in enumerate(means)]


def weather_figure(
    title: str,
    air: Profile,
    water: PwvByMonth | None,
    elevation: float = math.pi / 2,
    bands: Sequence[Band] = (),
) -> Figure:
    """Profile, PWV by month and hour (where it is known), emission and transmission: one figure,
    not pyplot's.
    """
    figure = new_figure(title, (11, 9.5))
    axes = figure.subplots(2, 2)
    plot_profile(axes[0, 0], air)
    if water is not None:
        plot_pwv(axes[0, 1], water)
    else:
        axes[0, 1].set_axis_off()
        axes[0, 1].text(0.5, 0.5, "no climatology here: no PWV by month", ha="center")
    plot_spectrum(axes[1, 0], air, elevation, bands, "brightness")
    plot_spectrum(axes[1, 1], air, elevation, bands, "transmission")
    handles = axes[1, 1].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=6, fontsize=8, frameon=False)
    return figure  # type: ignore[no-any-return]
