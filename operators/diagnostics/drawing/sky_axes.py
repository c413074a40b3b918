"""Where the pixels of an image are on the sky, and tick marks in longitude and latitude along its
edges.

numpy alone: astropy takes longer to import than a picture takes to draw. Images of other
projections have no `SkyAxes`; they, turned ones and those with a pole in them have a `graticule`
instead of tick marks.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from zonda.core.numerics.sphere import separation
from zonda.core.types import Floats

_FROM_CENTRE: dict[str, Callable[[Floats], Floats]] = {
    "TAN": np.arctan,
    "SIN": np.arcsin,
    "ARC": lambda r: r,
    "STG": lambda r: 2 * np.arctan(r / 2),
    "ZEA": lambda r: 2 * np.arcsin(r / 2),
}
"""Zenithal projections: angle from the reference point [rad] by the distance in the image plane
[rad] (Calabretta & Greisen 2002, section 5.1); NaN beyond the edge of the sky."""

_TO_CENTRE: dict[str, tuple[Callable[[Floats], Floats], float]] = {
    "TAN": (np.tan, 85.0),
    "SIN": (np.sin, 90.0),
    "ARC": (lambda a: a, 180.0),
    "STG": (lambda a: 2 * np.tan(a / 2), 170.0),
    "ZEA": (lambda a: 2 * np.sin(a / 2), 180.0),
}
"""The reverse, and the largest angle [deg] for which it is used."""

_MOST_TURNED = math.tan(math.radians(30.0))
_SIXTY = (1, 2, 5, 10, 15, 20, 30)


class Ticks(NamedTuple):
    """Marks along one edge: pixel coordinates (n,), and their labels."""

    places: Floats
    labels: list[str]


@dataclass(frozen=True)
class SkyAxes:
    """A projection of the sky to pixels, 0-based with integers at pixel centres.

    Attributes
    ----------
    projection
        TAN, SIN, ARC, STG, ZEA or CAR.
    reference, centre
        Pixel (x, y) of the reference point, and its (longitude, latitude) [deg].
    matrix
        (2, 2): degrees in the image plane per pixel.
    turn
        LONPOLE [deg] less 180, by which the image plane is turned.
    names
        Of longitude, latitude and their frame.
    """

    projection: str
    reference: tuple[float, float]
    centre: tuple[float, float]
    matrix: Floats
    turn: float
    names: tuple[str, str, str]

    @classmethod
    def of(cls, header: Any) -> SkyAxes | None:
        """From a FITS header (any mapping of keywords) or an `astropy.wcs.WCS`; None where it is
        more than is known here.
        """
        if hasattr(header, "to_header"):
            if header.has_distortion:
                return None
            header = header.to_header(relax=True)
        get = header.get
        kinds = [str(get(f"CTYPE{k}", "")).strip() for k in (1, 2)]
        projection = kinds[0][-3:]
        pairs = (("RA-", "DEC-"), ("GLON", "GLAT"))
        if (
            not any(kinds[0].startswith(a) and kinds[1].startswith(b) for a, b in pairs)
            or kinds[1][-3:] != projection
        ):
            return None
        if any(len(kind) != 8 for kind in kinds) or any(
            str(get(f"CUNIT{k}", "deg")).strip() not in ("deg", "") for k in (1, 2)
        ):
            return None
        if any(
            str(key).startswith(
                ("PV", "PS", "A_ORDER", "B_ORDER", "CPDIS", "CQDIS", "D2IM", "CROTA")
            )
            for key in header
        ):
            return None
        centre = (float(get("CRVAL1", 0.0)), float(get("CRVAL2", 0.0)))
        plain = 0.0 if projection == "CAR" or centre[1] >= 90 else 180.0
        pole = float(get("LONPOLE", plain))
        if projection == "CAR" and (centre[1] != 0 or pole != 0):
            return None
        if projection != "CAR" and projection not in _FROM_CENTRE:
            return None
        if "CD1_1" in header or "CD2_2" in header:
            matrix = np.array([[float(get(f"CD{i}_{j}", 0.0)) for j in (1, 2)] for i in (1, 2)])
        else:
            matrix = np.array(
                [[float(get(f"PC{i}_{j}", float(i == j))) for j in (1, 2)] for i in (1, 2)]
            )
            matrix *= [[float(get(f"CDELT{i}", 1.0))] for i in (1, 2)]
        reference = (float(get("CRPIX1", 0.0)) - 1, float(get("CRPIX2", 0.0)) - 1)
        return cls(projection, reference, centre, matrix, pole - 180.0, names_of(header))

    @property
    def scales(self) -> tuple[float, float]:
        """Sizes of a pixel in x and y, deg."""
        x, y = np.sqrt((self.matrix**2).sum(axis=0))
        return float(x), float(y)

    def thinned(self, step: int) -> SkyAxes:
        """The axes of every ``step``-th pixel, from the first."""
        x, y = self.reference
        return replace(self, reference=(x / step, y / step), matrix=self.matrix * step)

    def shifted(self, x: int, y: int) -> SkyAxes:
        """The axes of the part of the image that begins at pixel (x, y)."""
        return replace(self, reference=(self.reference[0] - x, self.reference[1] - y))

    def world(self, x: Any, y: Any) -> tuple[Floats, Floats]:
        """Longitude and latitude [deg] of pixel coordinates; NaN off the sky."""
        dx, dy = (
            np.asarray(x, np.float64) - self.reference[0],
            np.asarray(y, np.float64) - self.reference[1],
        )
        u, v = (self.matrix[i, 0] * dx + self.matrix[i, 1] * dy for i in (0, 1))
        if self.projection == "CAR":
            return self.centre[0] + u, np.where(np.abs(v) <= 90 + 1e-9, v, np.nan)
        turn, lon0, lat0 = np.radians([self.turn, *self.centre])
        east, north = np.cos(turn) * u + np.sin(turn) * v, -np.sin(turn) * u + np.cos(turn) * v
        plane = np.radians(np.hypot(u, v))
        with np.errstate(invalid="ignore", divide="ignore"):
            angle = _FROM_CENTRE[self.projection](plane)
            ratio = np.radians(np.where(plane > 0, np.sin(angle) / plane, 1.0))
        east, north, ahead = east * ratio, north * ratio, np.cos(angle)
        lon = lon0 + np.arctan2(east, ahead * np.cos(lat0) - north * np.sin(lat0))
        return np.degrees(lon), np.degrees(
            np.arcsin(np.clip(ahead * np.sin(lat0) + north * np.cos(lat0), -1, 1))
        )

    def pixel(self, lon: Any, lat: Any) -> tuple[Floats, Floats]:
        """Pixel coordinates of a longitude and latitude [deg]; NaN where the projection does not
        show them.
        """
        lon, lat = np.asarray(lon, np.float64), np.asarray(lat, np.float64)
        if self.projection == "CAR":
            u, v = (lon - self.centre[0] + 180) % 360 - 180, lat + 0 * lon
        else:
            turn, lon0, lat0 = np.radians([self.turn, *self.centre])
            far, up = np.radians(lon) - lon0, np.radians(lat)
            east = np.cos(up) * np.sin(far)
            north = np.sin(up) * np.cos(lat0) - np.cos(up) * np.sin(lat0) * np.cos(far)
            ahead = np.sin(up) * np.sin(lat0) + np.cos(up) * np.cos(lat0) * np.cos(far)
            beside = np.hypot(east, north)
            angle = np.arctan2(beside, ahead)
            project, most = _TO_CENTRE[self.projection]
            known = np.where(angle <= math.radians(most), angle, np.nan)
            ratio = np.degrees(
                np.where(beside > 0, project(known) / np.where(beside > 0, beside, 1.0), 1.0)
            )
            u, v = (
                (np.cos(turn) * east - np.sin(turn) * north) * ratio,
                (np.sin(turn) * east + np.cos(turn) * north) * ratio,
            )
        back = np.linalg.inv(self.matrix)
        x, y = (back[i, 0] * u + back[i, 1] * v + self.reference[i] for i in (0, 1))
        return x, y

    def distance(self, shape: tuple[int, ...], centre: tuple[float, float]) -> Floats:
        """Angle [rad] of every pixel of an image (ny, nx) from ``centre`` (longitude, latitude)
        [rad].
        """
        if self.projection != "CAR" and np.allclose(
            np.degrees(centre), self.centre, rtol=0, atol=1e-9
        ):
            dx, dy = (
                np.arange(shape[1])[None, :] - self.reference[0],
                np.arange(shape[0])[:, None] - self.reference[1],
            )
            plane = np.radians(
                np.hypot(*(self.matrix[i, 0] * dx + self.matrix[i, 1] * dy for i in (0, 1)))
            )
            with np.errstate(invalid="ignore"):
                return np.asarray(_FROM_CENTRE[self.projection](plane), np.float64)
        lon, lat = np.radians(
            self.world(np.arange(shape[1])[None, :], np.arange(shape[0])[:, None])
        )
        return separation(lon, lat, centre)

    def upright(self, shape: tuple[int, ...]) -> bool:
        """Whether meridians run up and parallels run across, within 30 deg, all along the edges of
        an image (ny, nx).
        """
        ny, nx = shape
        along, low, high, h = (
            np.linspace(0.001, 0.999, 33),
            np.full(33, 0.001),
            np.full(33, 0.999),
            1e-3 * min(nx, ny),
        )
        x = np.concatenate([along, along, low, high]) * nx - 0.5
        y = np.concatenate([low, high, along, along]) * ny - 0.5
        slopes = []
        for dx, dy in ((h, 0.0), (0.0, h)):
            (lon0, lat0), (lon1, lat1) = self.world(x - dx, y - dy), self.world(x + dx, y + dy)
            east = (lon1 - lon0 + 180) % 360 - 180
            slopes += [
                east
                * (1.0 if self.projection == "CAR" else np.cos(np.radians(self.world(x, y)[1]))),
                lat1 - lat0,
            ]
        lon_x, lat_x, lon_y, lat_y = slopes
        if not all(np.isfinite(s).all() for s in slopes):
            return False
        same = all((s > 0).all() or (s < 0).all() for s in (lon_x, lat_y))
        return bool(
            same
            and (abs(lat_x) <= _MOST_TURNED * abs(lat_y)).all()
            and (abs(lon_y) <= _MOST_TURNED * abs(lon_x)).all()
        )

    def ticks(self, shape: tuple[int, ...], width: float, height: float) -> dict[str, Ticks] | None:
        """Marks on the edges ``bottom``, ``top``, ``left``, ``right`` of an image (ny, nx), exactly
        where a round longitude or latitude crosses them; None where it is not `upright`.

        ``width``, ``height``: of the image, in characters and in lines of a label's text.
        """
        if not self.upright(shape):
            return None
        ny, nx = shape
        middle = float(self.world((nx - 1) / 2, (ny - 1) / 2)[0])

        def longitude(x: Floats, y: float) -> Floats:
            found = self.world(x, np.full_like(x, y))[0]
            return (
                found if self.projection == "CAR" else middle + (found - middle + 180) % 360 - 180
            )

        def latitude(y: Floats, x: float) -> Floats:
            return self.world(np.full_like(y, x), y)[1]

        hours = self.names[0] == "RA"
        found: dict[str, Ticks] = {}
        for edges, value, along, across, room in (
            (("bottom", "top"), longitude, nx, ny, width),
            (("left", "right"), latitude, ny, nx, height),
        ):
            t, step = np.linspace(-0.5, along - 0.5, 129), 0.0
            for edge, at in zip(edges, (-0.5, across - 0.5), strict=True):
                known = value(t, at)
                low, high = float(known.min()), float(known.max())
                step = step or _step(low, high, room, value is longitude, hours)
                wanted = multiples(low, high, step) * step
                order = np.argsort(known)
                places = np.interp(wanted, known[order], t[order])
                for _ in range(3):
                    before, after = (
                        np.maximum(places - 0.5, -0.5),
                        np.minimum(places + 0.5, along - 0.5),
                    )
                    slope = (value(after, at) - value(before, at)) / (after - before)
                    places = np.clip(
                        places - (value(places, at) - wanted) / slope, -0.5, along - 0.5
                    )
                found[edge] = Ticks(
                    places, [label_of(w, step, value is longitude, hours) for w in wanted]
                )
        return found


def names_of(header: Any) -> tuple[str, str, str]:
    """Names of the two axes of a map and of their frame, as its header says: RA, Dec, ICRS; l, b,
    Galactic.
    """
    first, second = (str(header.get(f"CTYPE{k}", "")).strip() for k in (1, 2))
    if first.startswith("GLON"):
        return "l", "b", "Galactic"
    if first.startswith("RA"):
        equinox = header.get("EQUINOX")
        usual = "ICRS" if equinox is None else "FK4" if float(equinox) < 1984 else "FK5"
        return "RA", "Dec", str(header.get("RADESYS", "")).strip() or usual
    return first.split("-")[0].lower() or "x", second.split("-")[0].lower() or "y", "as in the file"


def multiples(low: float, high: float, step: float) -> Floats:
    """Whole numbers whose products with ``step`` lie between ``low`` and ``high``."""
    return np.arange(
        math.ceil(low / step - 1e-9), math.floor(high / step + 1e-9) + 1, dtype=np.float64
    )


def round_steps(longitude: bool, hours: bool) -> list[float]:
    """Round steps [deg], ascending: of hours, minutes and seconds, or of degrees."""
    time = longitude and hours
    seconds = [m * 10.0**-k for k in range(5, 0, -1) for m in (1, 2, 5)]
    seconds += [float(m * unit) for unit in (1, 60) for m in _SIXTY]
    seconds += [
        3600.0 * m for m in ((1, 2, 3, 4, 6, 12) if time else (1, 2, 5, 10, 15, 20, 30, 45, 60, 90))
    ]
    return [s / 3600 * (15 if time else 1) for s in seconds]


def _step(low: float, high: float, room: float, longitude: bool, hours: bool) -> float:
    """Smallest round step [deg] whose labels fit into ``room``: characters for longitudes, lines
    for latitudes.
    """
    steps = round_steps(longitude, hours)
    last = steps[0]
    for step in steps:
        count = len(multiples(low, high, step)) if (high - low) / step < 100 else 100
        size = len(label_of(high, step, longitude, hours)) + 2.5 if longitude else 2.2
        if count <= 7 and count * size <= room:
            return step if count >= 2 or not len(multiples(low, high, last)) else last
        last = step
    return last


def label_of(value: float, step: float, longitude: bool, hours: bool) -> str:
    """A longitude or latitude [deg] to the digits that ``step`` [deg] has."""
    unit, marks, turn = (15.0, "ʰᵐˢ", 24) if longitude and hours else (1.0, "°′″", 360)
    seconds = step / unit * 3600
    digits = max(0, -math.floor(math.log10(seconds) + 1e-9))
    total = round(value / unit * 3600 * 10**digits)
    if longitude:
        total %= turn * 3600 * 10**digits
    whole, part = divmod(abs(total), 10**digits)
    text = f"{'−' if total < 0 else ''}{whole // 3600}{marks[0]}"
    if seconds < 3600 * (1 - 1e-9):
        text += f"{whole // 60 % 60:02d}{marks[1]}"
    if seconds < 60 * (1 - 1e-9):
        text += f"{whole % 60:02d}{f'.{part:0{digits}d}' if digits else ''}{marks[2]}"
    return text
