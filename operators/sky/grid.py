"""The grid on which a map is convolved: its own pixels, or a TAN grid of what a scan reaches; laid
out before it is filled.

Which of the two, and how the second is filled:

- A TAN image is convolved on its own pixels where they have one size (`FLAT`) as far as a scan
  reaches, or are larger than half of the beam.
- The pixels of any other map of 2 pixels per FWHM or more are spread over a grid (`spread`) whose
  step resolves the beam.
- A map without a beam, or with larger pixels, is smooth between its pixels: it is interpolated
  (`resample`), in steps no longer than its shortest pixel side where the scan looks.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.projection import (
    boresights,
    directions,
    frame_rotation,
    pixel_matrix,
    rotation_matrices,
    wcs_frame_rotation,
)
from zonda.core.numerics.sphere import angle_between, local_axes
from zonda.core.types import Floats

from .beam import REACH, SIGMA, SMOOTH_BELOW
from .footprint import extent
from .inputs import HealpixMap, WcsMap
from .region import Disc, region, tangent_wcs
from .resample import ImageOnSky
from .spread import Spread

if TYPE_CHECKING:
    from zonda.core.data import Observation

FLAT = 1e-3
"""Relative difference of solid angles up to which pixels of a TAN image count as equal (1.5 deg).
"""
FINER = 1.25
"""Points of a grid over which pixels are spread, in those that are asked for: 5 per FWHM err by
6e-4 of a peak, 4 by 2e-3.
"""
NARROWEST = 8
"""Shortest side of pixels that are not skipped, as a part of their nominal one. (Near a pole those
of CAR have none.)
"""
CLOSED = 1.3
"""Pixels per FWHM, where they are looked at, from which a sum over them leaves no gaps: a uniform
sky is so to 2 exp(-2 pi^2 (sigma / pixel)^2) = 0.5 %."""
ALIKE = 1.01
"""Ratio of sides up to which these count as the nominal ones."""
LOOKED_AT = 256, 37
"""Instants of a scan and detectors of which it is looked up where they are on a map, at most."""


@dataclass(frozen=True)
class Grid:
    """Pixels on which the map of ``source`` is convolved.

    Attributes
    ----------
    key
        Of what is computed there.
    wcs
        TAN, two-dimensional.
    shape
        (ny, nx).
    tiles
        `region.Region.tiles`.
    resampled
        False: on the pixels of the file.
    points
        How many are filled.
    spread
        How pixels are spread over it; None: they are not.
    pole
        ICRS direction (3,) of the pole of the meridians from which the input's Q and U are counted;
        None: it has none.
    """

    key: tuple[Hashable, ...]
    source: WcsMap | HealpixMap
    wcs: Any
    shape: tuple[int, int]
    tiles: NDArray[np.bool_] | None
    resampled: bool
    points: int
    pole: Floats | None = None
    spread: Spread | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of the map there, and of what is kept of the file where that is another."""
        ny, nx = self.shape
        return (8 if self.pole is None else 24) * ny * nx + (ny * nx if self.resampled else 0)

    @property
    def axis(self) -> Floats:
        """ICRS direction (3,) of the pole of the meridians from which Q and U are counted on the
        grid: north of the tangent point, 90 deg from it, so that no point of the grid is near.
        """
        x, y, z = pixel_matrix(self.wcs)[2]
        north: Floats = local_axes(float(np.arctan2(y, x)), float(np.arctan2(z, np.hypot(x, y))))[2]
        return north

    def reached(self, observation: Observation, widest: float) -> bool:
        """True if any detector of an observation comes within a beam of FWHM ``widest`` [rad] of
        the map.
        """
        ny, nx = self.shape
        corners = [
            [-0.5, -0.5],
            [-0.5, ny - 0.5],
            [nx - 0.5, -0.5],
            [nx - 0.5, ny - 0.5],
            [(nx - 1) / 2, (ny - 1) / 2],
        ]
        rays = np.column_stack([corners, np.ones(5)]) @ np.linalg.inv(pixel_matrix(self.wcs)).T
        *rim, centre = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        radius = float(angle_between(np.array(rim), centre).max())
        boresight = observation.sky_boresight
        cosine = max(
            float((centre @ boresights(boresight[chunk])).max())
            for chunk in chunks(observation.n_samples)
        )
        nearest = float(np.arccos(np.clip(cosine, -1, 1))) - float(
            np.arctan(observation.focalplane.radius)
        )
        return bool(nearest <= radius + REACH * SIGMA * widest)

    def behind(self, quaternions: Floats, xi: Floats, eta: Floats) -> int:
        """Samples more than 90 deg from the tangent point, of detectors at offsets (n_det,) about
        boresights (n, 4).
        """
        tangent = pixel_matrix(self.wcs)[2]
        along = np.einsum(
            "nij,i->nj", rotation_matrices(quaternions), tangent
        )  # the tangent point in the boresight's frame
        return int((along @ np.array([-eta, -xi, np.ones(len(xi))]) <= 0).sum())

    @property
    def step(self) -> float:
        """Distance [rad] of points about the tangent point of a grid that is not the map's own."""
        return float(np.radians(abs(self.wcs.wcs.cdelt[1])))

    @property
    def is_flat(self) -> bool:
        """True if solid angles are the same all over the grid, to `FLAT`."""
        ny, nx = self.shape
        corners = np.array([[x, y, 1.0] for x in (-0.5, nx - 0.5) for y in (-0.5, ny - 0.5)])
        matrix = pixel_matrix(self.wcs)
        rays = corners @ np.linalg.inv(matrix).T
        furthest = float(
            angle_between(rays / np.linalg.norm(rays, axis=1, keepdims=True), matrix[2]).max()
        )
        return bool(np.cos(furthest) ** 3 >= 1 - FLAT)


def own_pixels(
    source: WcsMap, wcs: Any, key: tuple[Hashable, ...], turn: Floats | None = None
) -> Grid:
    """The grid of a TAN image. ``turn``: from ICRS directions to the frame of its Q and U, where it
    is not that of ``wcs``.
    """
    shape = (source.values.shape[0], source.values.shape[1])
    pole = (
        None
        if source.polarization is None
        else (wcs_frame_rotation(wcs) if turn is None else turn)[2]
    )
    return Grid(
        (*key, "image", tuple(wcs.wcs.crval)),
        source,
        wcs,
        shape,
        None,
        False,
        source.values.size,
        pole,
    )


def is_flat(source: WcsMap, wcs: Any, observation: Observation, reach: float) -> bool:
    """True if a TAN image is flat (`FLAT`) as far as an observation and its beam's ``reach`` [rad]
    go from its tangent point.
    """
    ny, nx = source.values.shape
    matrix = pixel_matrix(wcs)
    corners = np.array(
        [[-0.5, -0.5, 1], [-0.5, ny - 0.5, 1], [nx - 0.5, -0.5, 1], [nx - 0.5, ny - 0.5, 1]]
    )
    rays = corners @ np.linalg.inv(matrix).T
    end = float(angle_between(rays / np.linalg.norm(rays, axis=1, keepdims=True), matrix[2]).max())
    if np.cos(end) ** 3 >= 1 - FLAT:
        return True
    boresight = observation.sky_boresight
    cosine = min(
        float((matrix[2] @ boresights(boresight[chunk])).min())
        for chunk in chunks(observation.n_samples)
    )
    far = (
        float(np.arccos(np.clip(cosine, -1, 1)))
        + float(np.arctan(observation.focalplane.radius))
        + reach
    )
    return bool(far < np.pi / 2 and np.cos(min(end, far)) ** 3 >= 1 - FLAT)


def tangent_grid(
    source: WcsMap | HealpixMap,
    observation: Observation,
    widths: tuple[float, float],
    points: float,
    key: tuple[Hashable, ...],
    place: str,
) -> Grid:
    """A grid about an observation, of the part of the map that its detectors reach.

    ``widths``: of the narrowest and of the widest beam [rad], 0: none; ``points`` per FWHM. Raises
    InputError as `region.region`.
    """
    narrow, wide = widths
    spread = None
    side, longest = sides_seen(source, observation)
    if (
        _resolves(min(longest, float(nominal_sides(source).max())), narrow)
        and narrow >= CLOSED * longest
    ):
        step = narrow / points / FINER
        spread = Spread.of(narrow, longest, step)
    else:
        step = float(
            np.clip(narrow / points, side / 4, side if isinstance(source, WcsMap) else side / 1.5)
        )
    found = region(observation, step, REACH * SIGMA * wide, _disc(source), place)
    ra, dec = observation.centre
    wcs = tangent_wcs(ra, dec, found.box, step)
    tiles = None if found.tiles is None else found.tiles.tobytes()
    pole = None if source.polarization is None else _frame(source, place)[2]
    made = *key, "grid", ra, dec, step, spread, found.box, tiles
    return Grid(made, source, wcs, found.shape, found.tiles, True, found.points, pole, spread)


def is_resolved(source: WcsMap | HealpixMap, fwhm: float) -> bool:
    """True if a beam of ``fwhm`` [rad] is at least 2 of the map's pixels wide, by the header."""
    return _resolves(float(nominal_sides(source).max()), fwhm)


def _resolves(side: float, fwhm: float) -> bool:
    return bool(fwhm > 0 and fwhm >= SMOOTH_BELOW * side)


def nominal_sides(source: WcsMap | HealpixMap) -> Floats:
    """Sides (2,) of a pixel [rad] by the header's scale; of a HEALPix map of the square of its
    area.
    """
    if isinstance(source, HealpixMap):
        return np.full(2, np.sqrt(np.pi / 3) / source.nside)
    return np.asarray(np.radians(np.linalg.norm(np.asarray(source.wcs.pixel_scale_matrix), axis=0)))


def sides_seen(source: WcsMap | HealpixMap, observation: Observation) -> tuple[float, float]:
    """The shortest width and the longest side of pixels [rad] where an observation looks; those of
    the header where it looks beside the map.

    The former is rounded down in steps of 2^(1/2) of the nominal one (`NARROWEST` at least), the
    latter up in steps of 2^(1/8), `ALIKE` apart.
    """
    least, most = float(nominal_sides(source).min()), float(nominal_sides(source).max())
    if isinstance(source, HealpixMap):
        return least, most
    plane = observation.focalplane
    at, of = (
        slice(None, None, -(-n // limit))
        for n, limit in zip((observation.n_samples, len(plane)), LOOKED_AT, strict=True)
    )
    d = directions(observation.sky_boresight[at], plane.xi[of], plane.eta[of]).reshape(-1, 3)
    sky = ImageOnSky(source)
    x, y, inside = sky.at(d)
    if not inside.any():
        return least, most
    xx, xy, yy = sky.grid.metric(x[inside], y[inside])
    half, rest = (xx + yy) / 2, np.sqrt(((xx - yy) / 2) ** 2 + xy**2)
    narrow = float(np.nanmin(np.sqrt(np.maximum(half - rest, 0.0)), initial=least)) / least
    long = np.sqrt(np.maximum(xx, yy))
    wide = float(np.max(long[np.isfinite(long)], initial=0.0)) / most or 1.0
    steps = (
        math.floor(2 * math.log2(max(narrow, 1e-9)) + 1e-6),
        math.ceil(8 * math.log2(wide / ALIKE)),
    )
    return least * float(max(2.0 ** (steps[0] / 2), 1 / NARROWEST)), most * float(
        2.0 ** (steps[1] / 8)
    )


def _frame(source: WcsMap | HealpixMap, place: str) -> Floats:
    """From ICRS directions to those of a map's frame (3, 3). Raises InputError where it is no
    rotation of ICRS (FK4).
    """
    if isinstance(source, HealpixMap):
        return frame_rotation(source.frame)
    if source.turn is not None:
        return source.turn
    try:
        return wcs_frame_rotation(source.wcs)
    except InputError:
        cure = "convert the map to ICRS, or set plane to that of I"
        raise InputError(
            "Q and U in FK4 coordinates are not turned to ICRS", place=place, cure=cure
        ) from None


def _disc(source: WcsMap | HealpixMap) -> Disc | None:
    """A circle that holds a map; None: it may be anywhere."""
    if isinstance(source, HealpixMap):
        return _disc_of_pixels(source)
    try:
        turn = wcs_frame_rotation(source.wcs) if source.turn is None else source.turn
    except InputError:  # FK4 is no rotation of ICRS
        return None
    found, whole = extent(source.wcs, turn, (source.values.shape[0], source.values.shape[1]))
    return found if whole else None


def _disc_of_pixels(source: HealpixMap) -> Disc | None:
    import healpy

    if source.pixels is None or not len(source.pixels):
        return None
    d = np.stack(healpy.pix2vec(source.nside, source.pixels, nest=source.nest), axis=1)
    middle = d.mean(axis=0)
    length = float(np.linalg.norm(middle))
    if length < 0.1:  # all round the sky
        return None
    radius = float(np.arccos(np.clip((d @ middle).min() / length, -1, 1))) + float(
        healpy.max_pixrad(source.nside)
    )
    return Disc(frame_rotation(source.frame).T @ (middle / length), radius)
