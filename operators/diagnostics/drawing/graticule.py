"""Meridians and parallels of an image whose edges they do not follow: near a pole, turned, or of
all the sky.

numpy alone. A longitude is written where its meridian leaves the image, a latitude likewise; where
there is no such place for two of them, or a pole is in the image, latitudes are written on their
circles.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from zonda.core.types import Floats

from .sky_axes import Ticks, label_of, multiples, round_steps

EDGES = ("bottom", "left", "top", "right")
_FINE = 241
"""Points of a line."""
_MOST = {True: 12, False: 7}
"""Longitudes and latitudes that are drawn."""
_STEEP = 0.34
"""Sine of the smallest angle at which a line that is written at an edge leaves the image."""


class Projected(Protocol):
    """What a graticule needs of a projection; degrees and 0-based pixels."""

    @property
    def names(self) -> tuple[str, str, str]: ...

    def world(self, x: Any, y: Any) -> tuple[Floats, Floats]: ...

    def pixel(self, lon: Any, lat: Any) -> tuple[Floats, Floats]: ...


class AstropyAxes:
    """Any celestial WCS, by astropy."""

    def __init__(self, wcs: Any, names: tuple[str, str, str]) -> None:
        from astropy.wcs import WCS
        from astropy.wcs.utils import proj_plane_pixel_scales

        self._wcs = wcs if hasattr(wcs, "wcs") else WCS(wcs, naxis=2)
        self.names = names
        x, y = proj_plane_pixel_scales(self._wcs)
        self.scales = float(x), float(y)
        self.matrix = np.asarray(self._wcs.pixel_scale_matrix, np.float64)

    def world(self, x: Any, y: Any) -> tuple[Floats, Floats]:
        """Longitude and latitude [deg] of pixel coordinates; NaN off the sky."""
        found = self._wcs.all_pix2world(*np.broadcast_arrays(x, y), 0)
        return np.asarray(found[0], np.float64), np.asarray(found[1], np.float64)

    def pixel(self, lon: Any, lat: Any) -> tuple[Floats, Floats]:
        """The reverse; NaN where the projection does not show it."""
        found = self._wcs.wcs_world2pix(*np.broadcast_arrays(lon, lat), 0)
        return np.asarray(found[0], np.float64), np.asarray(found[1], np.float64)


class Crossing(NamedTuple):
    """Where a line leaves the image: the edge, the pixel coordinate along it, the sine of the angle
    to it.
    """

    edge: str
    place: float
    sine: float


@dataclass
class Graticule:
    """Lines (n, 2) of pixels, NaN between their parts; marks by edge; texts (x, y, text) in the
    image; names of the axes.
    """

    lines: list[Floats] = field(default_factory=list)
    marks: dict[str, Ticks] = field(default_factory=dict)
    inside: list[tuple[float, float, str]] = field(default_factory=list)
    names: tuple[str, str] = ("", "")


def graticule(
    axes: Projected, shape: tuple[int, ...], per_character: float, per_line: float
) -> Graticule:
    """The graticule of an image (ny, nx). ``per_character``, ``per_line``: width of a character,
    height of a line, pixels.
    """
    image = _Image(axes, shape, per_character, per_line)
    polar = image.polar
    if polar:
        edges: tuple[Sequence[str], Sequence[str]] = (EDGES, ())
    else:
        usual = image.leaves(True, "bottom") + image.leaves(False, "left")
        edges = (
            (("bottom",), ("left",))
            if usual >= image.leaves(True, "left") + image.leaves(False, "bottom")
            else (("left",), ("bottom",))
        )
    made = Graticule()
    inner = [
        image.add(made, longitude, where)
        for longitude, where in zip((True, False), edges, strict=True)
    ]
    lon, lat, frame = axes.names
    if polar and not inner[0]:
        made.names = f"{lon} along the edges, {lat} on its circles ({frame})", ""
        return made
    written = {
        edge: name
        for name, where, within in zip((lon, lat), edges, inner, strict=True)
        if not within
        for edge in where
    }
    rest = [
        f"{name} on its lines" for name, within in zip((lon, lat), inner, strict=True) if within
    ]
    if rest:
        made.names = (
            ", ".join([*(written[e] for e in ("bottom",) if e in written), *rest]) + f" ({frame})",
            written.get("left", ""),
        )
    else:
        made.names = f"{written['bottom']} ({frame})", f"{written['left']} ({frame})"
    return made


class _Image:
    """What is seen in an image."""

    def __init__(
        self, axes: Projected, shape: tuple[int, ...], per_character: float, per_line: float
    ) -> None:
        self.axes, self.hours = axes, axes.names[0] == "RA"
        self.ny, self.nx = shape
        self.per_character, self.per_line = per_character, per_line
        x, y = np.meshgrid(
            np.linspace(-0.5, self.nx - 0.5, 41), np.linspace(-0.5, self.ny - 0.5, 41)
        )
        lon, lat = axes.world(x, y)
        seen = np.isfinite(lon) & np.isfinite(lat)
        self.pole = 0
        self.lat, self.lon = (-90.0, 90.0), (0.0, 360.0)
        if not seen.any():
            return
        low, high = float(lat[seen].min()), float(lat[seen].max())
        for sign in (-1, 1):
            if bool(self.within(*axes.pixel(0.0, 90.0 * sign))):
                self.pole, low, high = sign, min(low, 90.0 * sign), max(high, 90.0 * sign)
        self.lat = low, high
        middle = np.degrees(np.angle(np.exp(1j * np.radians(lon[seen])).mean()))
        around = (lon[seen] - middle + 180) % 360 - 180
        if not self.pole and np.ptp(around) < 300:
            self.lon = float(middle + around.min()), float(middle + around.max())

    @property
    def polar(self) -> bool:
        """Whether meridians run together in the image or beside it."""
        return self.pole != 0 or (self.lon[1] - self.lon[0] > 100 and max(map(abs, self.lat)) > 70)

    def within(self, x: Any, y: Any) -> NDArray[np.bool_]:
        """Whether pixel coordinates are in the image."""
        with np.errstate(invalid="ignore"):
            return np.asarray(
                (x >= -0.5) & (x <= self.nx - 0.5) & (y >= -0.5) & (y <= self.ny - 0.5)
            )

    def line(self, longitude: bool, value: float) -> Floats:
        """(n, 2): a meridian or parallel, NaN where it is not in the projection or jumps."""
        low, high = self.lat if longitude else self.lon
        spare = 0.05 * (high - low)
        along = (
            np.linspace(max(low - spare, -90.0), min(high + spare, 90.0), _FINE)
            if longitude
            else np.linspace(low - spare, high + spare, _FINE)
        )
        x, y = self.axes.pixel(*((value, along) if longitude else (along, value)))
        points = np.stack(np.broadcast_arrays(x, y), axis=1).astype(np.float64)
        jumps = np.hypot(*np.diff(points, axis=0).T) > 0.3 * max(self.nx, self.ny) + 2
        points[1:][jumps] = np.nan
        return points

    def crossings(self, points: Floats) -> list[Crossing]:
        """Where a line leaves the image."""
        found = []
        for edge in EDGES:
            across, at, end = (
                (1, -0.5 if edge == "bottom" else self.ny - 0.5, self.nx)
                if edge in ("bottom", "top")
                else (0, -0.5 if edge == "left" else self.nx - 0.5, self.ny)
            )
            side = points[:, across] - at
            with np.errstate(invalid="ignore"):
                passes = np.flatnonzero(side[1:] * side[:-1] <= 0)
            for k in passes:
                step = points[k + 1] - points[k]
                if step[across] == 0:
                    continue
                place = float(points[k, 1 - across] - side[k] * step[1 - across] / step[across])
                if -0.5 <= place <= end - 0.5:
                    found.append(Crossing(edge, place, float(abs(step[across]) / np.hypot(*step))))
        return found

    def leaves(self, longitude: bool, edge: str) -> float:
        """How well lines leave the image at ``edge``: the sum of the sines of their angles to
        it.
        """
        low, high = self.lon if longitude else self.lat
        probes = np.linspace(low, high, 9)[1:-1]
        return float(
            sum(
                c.sine
                for value in probes
                for c in self.crossings(self.line(longitude, value))
                if c.edge == edge
            )
        )

    def add(self, made: Graticule, longitude: bool, edges: Sequence[str]) -> bool:
        """Add lines of the smallest round step whose labels have room, and the labels; whether they
        are in the image.
        """
        low, high = self.lon if longitude else self.lat
        steps = [
            s for s in round_steps(longitude, self.hours) if (high - low) / s <= _MOST[longitude]
        ] or [360.0]
        for step in steps:
            values = multiples(low, high, step) * step
            if longitude and high - low >= 360:
                values = values[:-1]
            if not longitude:
                values = values[abs(values) < 90]
            lines = [self.line(longitude, v) for v in values]
            texts = [label_of(float(v), step, longitude, self.hours) for v in values]
            marks, fits = self._at_edges(lines, texts, edges)
            if fits:
                break
        made.lines += [points for points in lines if self.within(*points.T).any()]
        if sum(len(m.labels) for m in marks.values()) >= 2:
            made.marks |= marks
            return False
        made.inside += self._within(lines, texts, [(x, y) for x, y, _ in made.inside])
        return True

    def _at_edges(
        self, lines: Iterable[Floats], texts: Iterable[str], edges: Sequence[str]
    ) -> tuple[dict[str, Ticks], bool]:
        """Marks of lines that are steep enough at ``edges``, and whether they have room."""
        found: dict[str, list[tuple[float, str]]] = {edge: [] for edge in edges}
        for points, text in zip(lines, texts, strict=True):
            for crossing in self.crossings(points):
                if crossing.edge in found and crossing.sine > _STEEP:
                    found[crossing.edge].append((crossing.place, text))
        fits, marks = True, {}
        for edge, rows in found.items():
            flat = edge in ("bottom", "top")
            kept: list[tuple[float, str]] = []
            for place, text in sorted(rows):
                size = (len(text) + 1.5) * self.per_character if flat else 1.6 * self.per_line
                if kept and (place - kept[-1][0] < size or (not flat and place < size)):
                    fits = False
                elif flat or place > 0.5 * self.per_line:
                    kept.append((place, text))
            marks[edge] = Ticks(np.array([p for p, _ in kept]), [t for _, t in kept])
        return marks, fits

    def _within(
        self, lines: Iterable[Floats], texts: Iterable[str], taken: Sequence[tuple[float, float]]
    ) -> list[tuple[float, float, str]]:
        """Labels on the lines: each as far from the edges and the other labels as it can be, up to
        its own size.
        """
        found: list[tuple[float, float, str]] = []
        for points, text in zip(lines, texts, strict=True):
            here = points[self.within(*points.T)]
            if not len(here):
                continue
            wide, high = (len(text) + 1) * self.per_character, 1.5 * self.per_line
            x, y = here.T
            room = np.minimum(
                np.minimum(x + 0.5, self.nx - 0.5 - x) / (0.5 * wide),
                np.minimum(y + 0.5, self.ny - 0.5 - y) / (0.5 * high),
            )
            room = np.minimum(room, 1.2)
            for a, b in [*taken, *((a, b) for a, b, _ in found)]:
                room = np.minimum(room, np.maximum(abs(x - a) / wide, abs(y - b) / high) * 1.2)
            best = room.max()
            if best < 1:
                continue
            k = int(np.flatnonzero(room >= min(best, 1.2) - 1e-9)[0])
            found.append((float(x[k]), float(y[k]), text))
        return found
