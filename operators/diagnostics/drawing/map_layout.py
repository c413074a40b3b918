"""Axes for images of the sky: sizes, places, tick marks in longitude and latitude."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from zonda.core.numerics.sphere import unit_vectors

from .canvas import BOTTOM, CHARACTER, LINE, PALE, TOP, new_figure
from .graticule import AstropyAxes, Graticule, graticule
from .sky_axes import SkyAxes, Ticks, names_of

IMAGE = (4.23, 4.28)
"""Largest width and height of an image, in."""
LONG, THIN = 8.4, 1.05
"""Width of an image of a strip, and the least height or width of one, in: a longer strip is
stretched across.
"""
STRIP = 2.2
"""Width over height from which an image is a strip."""
BAR, GAP, UNDER = 1.12, 0.2, 0.62
"""Room for a colour bar with its labels beside an image, before the next image, and for a colour
bar below, in.
"""
NEARLY = 0.01
"""Relative difference of steps on the sky that no picture shows."""
TITLE = 4.4
"""Least room for a title, in."""


@dataclass(frozen=True)
class _Marks:
    """Tick marks and lines of an image, and the margins [in] that their labels need."""

    ticks: dict[str, Ticks]
    grid: Graticule | None
    names: tuple[str, str]

    @property
    def left(self) -> float:
        longest = (
            max((len(label) for label in self.ticks["left"].labels), default=0)
            if "left" in self.ticks
            else 0
        )
        return 0.36 + CHARACTER * longest

    @property
    def right(self) -> float:
        if self.grid is None or "right" not in self.grid.marks:
            return 0.0
        return 0.08 + CHARACTER * max(
            (len(label) for label in self.grid.marks["right"].labels), default=0
        )

    @property
    def top(self) -> float:
        return 0.2 if self.grid is not None and "top" in self.grid.marks else 0.0


def located(wcs: Any) -> SkyAxes | AstropyAxes:
    """Where an image is: its `SkyAxes`, or astropy's WCS in their place. ``wcs``: one of them, or a
    FITS header.
    """
    if isinstance(wcs, SkyAxes | AstropyAxes):
        return wcs
    header = wcs.to_header(relax=True) if hasattr(wcs, "to_header") else wcs
    return SkyAxes.of(wcs) or AstropyAxes(wcs, names_of(header))


def map_axes(shape: tuple[int, ...], wcs: Any, count: int = 1, scales: int = 1) -> list[Any]:
    """Axes of a new figure for ``count`` images (ny, nx), each with one for its colour bar as
    ``bar_axes``.

    They have the image's pixel coordinates, with tick marks in longitude and latitude, or lines of
    them where these do not follow the edges. Pixels have the shape that they have on the sky in the
    middle of the image. Images of strips are wide, with the colour bar below and one below the
    other; a strip too thin to be seen is stretched, and its axis says so. ``scales``: of a colour
    bar, 1 or 2. Latitudes are written at the first of images side by side only, since they are the
    same for all.
    """
    axes = located(wcs)
    ny, nx = shape
    step_x, step_y = sky_steps(axes, shape)
    across = nx * step_x / step_y  # in the pixels' height
    strip = across > STRIP * ny
    scale = min((LONG if strip else IMAGE[0]) / across, IMAGE[1] / ny)
    width, height = max(across * scale, min(THIN, IMAGE[0])), max(ny * scale, THIN)
    marks = _marks(axes, shape, width, height)
    places, size = _places((width, height), marks, count, strip, scales)
    found = new_figure(size, places)
    made = found[::2]
    stretched = width / across / (height / ny)
    for k, ax in enumerate(made):
        ax.bar_axes, ax.names_latitude = found[2 * k + 1], strip or k == 0
        ax.bar_below, ax.sky = strip, axes
        ax.title_room = size[0] - 0.1 if strip else max(TITLE, width + marks.right + BAR + 0.4)
        ax.title_pad = 6.0 + 72 * marks.top
        ax.sky_names = _stretched(marks.names, axes.names, stretched)
        _mark(ax, marks, shape)
    return made


def sky_steps(axes: SkyAxes | AstropyAxes, shape: tuple[int, ...]) -> tuple[float, float]:
    """Steps on the sky [deg] of the middle pixel of an image (ny, nx), by one in x and in y; those
    of the header to 1 %.
    """
    y, x = ((n - 1) / 2 for n in shape)
    lon, lat = axes.world(x + np.array([0.5, -0.5, 0.0, 0.0]), y + np.array([0.0, 0.0, 0.5, -0.5]))
    ends = unit_vectors(np.radians(lon), np.radians(lat))
    steps = np.degrees(np.linalg.norm(ends[::2] - ends[1::2], axis=1))
    if np.isfinite(steps).all() and (abs(steps / axes.scales - 1) > NEARLY).any():
        return float(steps[0]), float(steps[1])
    return axes.scales


def _stretched(names: tuple[str, str], sky: tuple[str, str, str], ratio: float) -> tuple[str, str]:
    """Names of the axes; the lower one says which is stretched. ``ratio``: of the scales across and
    up.
    """
    if 0.99 < ratio < 1.01:
        return names
    text = (
        f"{names[0]}, {sky[1]} stretched {1 / ratio:.2g}×"
        if ratio < 1
        else f"{names[0]}, stretched {ratio:.2g}×"
    )
    return text, names[1]


def _marks(
    axes: SkyAxes | AstropyAxes, shape: tuple[int, ...], width: float, height: float
) -> _Marks:
    """Tick marks of an image of this width and height, in."""
    ny, nx = shape
    lon, lat, frame = axes.names
    ticks = (
        axes.ticks(shape, width / CHARACTER, height / LINE) if isinstance(axes, SkyAxes) else None
    )
    if ticks is not None:
        return _Marks(ticks, None, (f"{lon} ({frame})", f"{lat} ({frame})"))
    grid = graticule(axes, shape, CHARACTER * nx / width, LINE * ny / height)
    return _Marks(grid.marks, grid, grid.names)


def _places(
    image: tuple[float, float], marks: _Marks, count: int, strip: bool, scales: int
) -> tuple[list[tuple[float, float, float, float]], tuple[float, float]]:
    """Places (left, bottom, width, height) of each image and its colour bar, shares of the figure;
    its size, in.
    """
    width, height = image
    left, top = marks.left, TOP + marks.top
    found = []
    if strip:
        under = BOTTOM + 0.1 + (0.34 if scales == 2 else 0.0)
        pitch = top + height + under + UNDER - 0.1
        size = left + width + max(0.35, marks.right), count * pitch
        for k in range(count):
            y = size[1] - k * pitch - top - height
            found += [(left, y, width, height), (left + 0.1 * width, y - under, 0.8 * width, 0.14)]
    else:
        bar = max(0.9 * height, min(1.2, IMAGE[1]))
        tall = max(height, bar)
        beside = 0.1 + marks.right + (0.75 if scales == 2 else 0.0)
        spare = max(0.0, TITLE - width - BAR - beside)
        pitch = width + beside + BAR - 0.1 + spare + (GAP if marks.grid is None else left)
        size = (
            left + spare / 2 + width + beside + BAR - 0.1 + spare / 2 + (count - 1) * pitch,
            tall + top + BOTTOM,
        )
        for k in range(count):
            x = left + spare / 2 + k * pitch
            found += [
                (x, BOTTOM + (tall - height) / 2, width, height),
                (x + width + beside, BOTTOM + (tall - bar) / 2, 0.2, bar),
            ]
    return [(x / size[0], y / size[1], w / size[0], h / size[1]) for x, y, w, h in found], size


def _mark(ax: Any, marks: _Marks, shape: tuple[int, ...]) -> None:
    """Tick marks and their labels, and lines."""
    from matplotlib.ticker import FixedFormatter, FixedLocator

    ny, nx = shape
    none = Ticks(np.zeros(0), [])
    for axis, edge in ((ax.xaxis, "bottom"), (ax.yaxis, "left")):
        found = marks.ticks.get(edge, none)
        axis.set_major_locator(FixedLocator(found.places.tolist()))
        axis.set_major_formatter(FixedFormatter(found.labels))
        axis.set_tick_params(labelsize=9)
    ax.yaxis.set_tick_params(labelleft=ax.names_latitude or marks.grid is not None)
    if marks.grid is None:
        top, right = marks.ticks["top"].places, marks.ticks["right"].places
        ax.plot(top, np.full(len(top), ny - 0.5), **_tick_style(2))
        ax.plot(np.full(len(right), nx - 0.5), right, **_tick_style(1))
        return
    for points in marks.grid.lines:
        ax.plot(*points.T, color="0.4", linewidth=0.6, alpha=0.7, zorder=3)
    for edge, (dx, dy), where in (
        ("top", (0, 3), {"ha": "center", "va": "bottom"}),
        ("right", (3, 0), {"ha": "left", "va": "center"}),
    ):
        for place, label in zip(*marks.ticks.get(edge, none), strict=True):
            at = (place, ny - 0.5) if edge == "top" else (nx - 0.5, place)
            ax.annotate(
                label,
                at,
                xytext=(dx, dy),
                textcoords="offset points",
                fontsize=9,
                annotation_clip=False,
                **where,
            )
    for x, y, text in marks.grid.inside:
        ax.text(x, y, text, fontsize=8, ha="center", va="center", zorder=4, bbox=PALE)


def _tick_style(marker: int) -> dict[str, Any]:
    """Style of tick marks that no axis draws."""
    return {
        "linestyle": "none",
        "marker": marker,
        "markersize": 3.5,
        "markeredgewidth": 0.8,
        "color": "black",
        "clip_on": False,
    }
