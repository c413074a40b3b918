"""The grid on which a map is convolved: its own pixels, or a TAN grid of what a scan reaches; laid out before it is filled."""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.errors import InputError
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.projection import boresights, frame_rotation, pixel_matrix, rotation_matrices, wcs_frame_rotation
from zonda.core.numerics.sphere import angle_between, local_axes
from zonda.core.types import Floats

from .beam import REACH, SIGMA
from .footprint import extent
from .inputs import HealpixMap, WcsMap
from .region import Disc, region, tangent_wcs

if TYPE_CHECKING:
    from zonda.core.data import Observation

PER_VALUE = 1e-7
"""Seconds on the reference machine for a pixel of a file: read, checked, converted."""
LARGE = 2**22
"""Values of a file below which reading is no matter."""
PER_POINT = {"image": 1.5e-6, "healpix": 2.5e-5}
"""Seconds for a point of a grid that is interpolated."""


@dataclass(frozen=True)
class Grid:
    """Where the map of ``source`` is convolved.

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
    pole
        ICRS direction (3,) of the pole of the meridians from which the input's Q and U are counted; None: it has none.
    """

    key: tuple[Hashable, ...]
    source: WcsMap | HealpixMap
    wcs: Any
    shape: tuple[int, int]
    tiles: NDArray[np.bool_] | None
    resampled: bool
    points: int
    pole: Floats | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of the map there, and of what is kept of the file where that is another."""
        ny, nx = self.shape
        return (8 if self.pole is None else 24) * ny * nx + (ny * nx if self.resampled else 0)

    @property
    def axis(self) -> Floats:
        """ICRS direction (3,) of the pole of the meridians from which Q and U are counted on the grid: north of the tangent
        point, 90 deg from it, so that no point of the grid is near.
        """
        x, y, z = pixel_matrix(self.wcs)[2]
        north: Floats = local_axes(float(np.arctan2(y, x)), float(np.arctan2(z, np.hypot(x, y))))[2]
        return north

    def reached(self, observation: Observation, widest: float) -> bool:
        """Whether any detector of an observation comes within a beam of FWHM ``widest`` [rad] of the map."""
        ny, nx = self.shape
        corners = [[-0.5, -0.5], [-0.5, ny - 0.5], [nx - 0.5, -0.5], [nx - 0.5, ny - 0.5], [(nx - 1) / 2, (ny - 1) / 2]]
        rays = np.column_stack([corners, np.ones(5)]) @ np.linalg.inv(pixel_matrix(self.wcs)).T
        *rim, centre = rays / np.linalg.norm(rays, axis=1, keepdims=True)
        radius = float(angle_between(np.array(rim), centre).max())
        boresight = observation.sky_boresight
        cosine = max(float((centre @ boresights(boresight[chunk])).max()) for chunk in chunks(observation.n_samples))
        nearest = float(np.arccos(np.clip(cosine, -1, 1))) - float(np.arctan(observation.focalplane.radius))
        return bool(nearest <= radius + REACH * SIGMA * widest)

    def behind(self, quaternions: Floats, xi: Floats, eta: Floats) -> int:
        """Samples more than 90 deg from the tangent point, of detectors at offsets (n_det,) about boresights (n, 4)."""
        tangent = pixel_matrix(self.wcs)[2]
        along = np.einsum("nij,i->nj", rotation_matrices(quaternions), tangent)  # the tangent point in the boresight's frame
        return int((along @ np.array([-eta, -xi, np.ones(len(xi))]) <= 0).sum())

    @property
    def interpolation(self) -> float:
        """Seconds on the reference machine to bring the map onto the grid."""
        return self.points * PER_POINT["image" if isinstance(self.source, WcsMap) else "healpix"] if self.resampled else 0.0

    @property
    def seconds(self) -> float:
        """Seconds on the reference machine to read the file and bring it onto the grid."""
        size = self.source.values.size
        return (PER_VALUE * size if size > LARGE else 0.0) + self.interpolation


def own_pixels(source: WcsMap, wcs: Any, key: tuple[Hashable, ...], turn: Floats | None = None) -> Grid:
    """The grid of a TAN image. ``turn``: from ICRS directions to the frame of its Q and U, where it is not that of ``wcs``."""
    shape = (source.values.shape[0], source.values.shape[1])
    pole = None if source.polarization is None else (wcs_frame_rotation(wcs) if turn is None else turn)[2]
    return Grid((*key, "image", tuple(wcs.wcs.crval)), source, wcs, shape, None, False, source.values.size, pole)


def tangent_grid(
    source: WcsMap | HealpixMap, observation: Observation, beam: tuple[float, float], key: tuple[Hashable, ...], place: str
) -> Grid:
    """A grid about an observation, of the part of the map that its detectors reach.

    ``beam``: its reach, and the step that it needs [rad]. Raises InputError as `region.region`.
    """
    reach, step = beam
    pixel = pixel_side(source)
    step = float(np.clip(step, pixel / 4, pixel if isinstance(source, WcsMap) else pixel / 1.5))
    found = region(observation, step, reach, _disc(source), place)
    ra, dec = observation.centre
    wcs = tangent_wcs(ra, dec, found.box, step)
    tiles = None if found.tiles is None else found.tiles.tobytes()
    pole = None if source.polarization is None else _frame(source, place)[2]
    return Grid((*key, "grid", ra, dec, step, found.box, tiles), source, wcs, found.shape, found.tiles, True, found.points, pole)


def _frame(source: WcsMap | HealpixMap, place: str) -> Floats:
    """From ICRS directions to those of a map's frame (3, 3). Raises InputError where it is no rotation of ICRS (FK4)."""
    if isinstance(source, HealpixMap):
        return frame_rotation(source.frame)
    if source.turn is not None:
        return source.turn
    try:
        return wcs_frame_rotation(source.wcs)
    except InputError:
        cure = "convert the map to ICRS, or set plane to that of I"
        raise InputError("Q and U in FK4 coordinates are not turned to ICRS", place=place, cure=cure) from None


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
    radius = float(np.arccos(np.clip((d @ middle).min() / length, -1, 1))) + float(healpy.max_pixrad(source.nside))
    return Disc(frame_rotation(source.frame).T @ (middle / length), radius)


def pixel_side(source: WcsMap | HealpixMap) -> float:
    """Side of a pixel, rad."""
    if isinstance(source, HealpixMap):
        return float(np.sqrt(np.pi / 3) / source.nside)
    return float(np.radians(np.sqrt(abs(np.linalg.det(source.wcs.pixel_scale_matrix)))))
