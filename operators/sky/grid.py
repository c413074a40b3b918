"""The grid on which a map is convolved: its own pixels, or a TAN grid of what a scan reaches; laid
out before it is filled.

Which of the two, and how the second is filled:

- A TAN image is convolved on its own pixels where they have one size (`FLAT`) as far as a scan
  reaches, or are larger than half of the beam.
- The pixels of any other map of 2 pixels per FWHM or more are gridded with Gaussians
  (`gridding.gridded`) in steps that resolve the beam.
- A map without a beam, or with larger pixels, is smooth between its pixels: it is interpolated
  (`gridding.interpolated`), in steps no longer than its shortest pixel side where the scan looks.
"""

from __future__ import annotations

from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.projection import boresights, pixel_matrix, rotation_matrices
from zonda.core.numerics.sphere import angle_between, angles, local_axes
from zonda.core.types import Floats

from .beam import REACH, SIGMA, SMOOTH_BELOW
from .gridding import Gridding
from .input_map import ImageMap, InputMap
from .region import directions_on, region, tangent_grid_wcs

if TYPE_CHECKING:
    from zonda.core.data import Observation

FLAT = 1e-3
"""Relative difference of solid angles up to which pixels of a TAN image count as equal (1.5 deg).
"""
FINER = 1.25
"""Points of a grid over which pixels are spread, in those that are asked for: 5 per FWHM err by
6e-4 of a peak, 4 by 2e-3.
"""
CLOSED = 1.3
"""Pixels per FWHM, where they are looked at, from which a sum over them leaves no gaps: a uniform
sky is so to 2 exp(-2 pi^2 (sigma / pixel)^2) = 0.5 %."""


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
    points
        How many are filled.
    pole
        ICRS direction (3,) of the pole of the meridians from which the input's Q and U are counted;
        None: it has none.
    resampled
        False: on the pixels of the file.
    tiles
        `region.Region.tiles`.
    gridding
        How pixels are gridded; None: they are not.
    """

    key: tuple[Hashable, ...]
    source: InputMap
    wcs: Any
    shape: tuple[int, int]
    points: int
    pole: Floats | None
    resampled: bool = False
    tiles: NDArray[np.bool_] | None = None
    gridding: Gridding | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of the map there, and of what is kept of the file where that is another."""
        ny, nx = self.shape
        return (8 if self.pole is None else 24) * ny * nx + (ny * nx if self.resampled else 0)

    @cached_property
    def matrix(self) -> Floats:
        """(3, 3) from ICRS directions to points, see `pixel_matrix`; its last row is the tangent
        point.
        """
        return pixel_matrix(self.wcs)

    @property
    def axis(self) -> Floats:
        """ICRS direction (3,) of the pole of the meridians from which Q and U are counted on the
        grid: north of the tangent point, 90 deg from it, so that no point of the grid is near.
        """
        north: Floats = local_axes(*(float(v) for v in angles(self.matrix[2])))[2]
        return north

    @property
    def step(self) -> float:
        """Distance [rad] of points about the tangent point of a grid that is not the map's own."""
        return float(np.radians(abs(self.wcs.wcs.cdelt[1])))

    def _reach(self, direction: Floats) -> float:
        """Largest angle [rad] from an ICRS direction (3,) to a corner."""
        x, y = ([-0.5, n - 0.5] for n in self.shape[::-1])
        corners = directions_on(self.matrix, *np.meshgrid(x, y))
        return float(angle_between(corners, direction).max())

    def reached(self, observation: Observation, widest: float) -> bool:
        """True if any detector of an observation comes within a beam of FWHM ``widest`` [rad] of
        the map.
        """
        ny, nx = self.shape
        centre = directions_on(self.matrix, (nx - 1) / 2, (ny - 1) / 2)
        nearest = _angles(observation, centre)[0] - float(np.arctan(observation.focalplane.radius))
        return bool(nearest <= self._reach(centre) + REACH * SIGMA * widest)

    def behind(self, quaternions: Floats, xi: Floats, eta: Floats) -> int:
        """Samples more than 90 deg from the tangent point, of detectors at offsets (n_det,) about
        boresights (n, 4).
        """
        along = np.einsum(
            "nij,i->nj", rotation_matrices(quaternions), self.matrix[2]
        )  # the tangent point in the boresight's frame
        return int((along @ np.array([-eta, -xi, np.ones(len(xi))]) <= 0).sum())

    @property
    def is_flat(self) -> bool:
        """True if solid angles are the same all over the grid, to `FLAT`."""
        return _is_flat(self._reach(self.matrix[2]))

    def is_flat_under(self, observation: Observation, reach: float) -> bool:
        """True if it is flat as far as an observation and its beam's ``reach`` [rad] go from the
        tangent point.
        """
        if self.is_flat:
            return True
        far = _angles(observation, self.matrix[2])[1] + reach
        far += float(np.arctan(observation.focalplane.radius))
        return far < np.pi / 2 and _is_flat(min(self._reach(self.matrix[2]), far))


def _is_flat(reach: float) -> bool:
    return bool(np.cos(reach) ** 3 >= 1 - FLAT)


def _angles(observation: Observation, direction: Floats) -> tuple[float, float]:
    """Least and largest angle [rad] of the boresight from an ICRS direction (3,)."""
    boresight = observation.sky_boresight
    cosines = [direction @ boresights(boresight[part]) for part in chunks(observation.n_samples)]
    ends = np.clip([max(c.max() for c in cosines), min(c.min() for c in cosines)], -1, 1)
    nearest, farthest = np.arccos(ends)
    return float(nearest), float(farthest)


def own_pixels(source: ImageMap, wcs: Any, key: tuple[Hashable, ...]) -> Grid:
    """The grid of a TAN image, whose pixels are at ``wcs``."""
    pole = None if source.polarization is None else source.turn[2]
    made = *key, "image", tuple(wcs.wcs.crval)
    return Grid(made, source, wcs, source.shape, source.values.size, pole)


def tangent_grid(
    source: InputMap,
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
    gridding = None
    side, longest = source.sides_seen(observation)
    if _resolves(min(longest, float(source.sides.max())), narrow) and narrow >= CLOSED * longest:
        step = narrow / points / FINER
        gridding = Gridding.of(narrow, longest, step)
    else:
        most = side if isinstance(source, ImageMap) else side / 1.5
        step = float(np.clip(narrow / points, side / 4, most))
    disc, whole = source.extent
    found = region(observation, step, REACH * SIGMA * wide, disc if whole else None, place)
    ra, dec = observation.centre
    wcs = tangent_grid_wcs(ra, dec, found.box, step)
    tiles = None if found.tiles is None else found.tiles.tobytes()
    pole = None if source.polarization is None else source.turn[2]
    made = *key, "grid", ra, dec, step, gridding, found.box, tiles
    return Grid(made, source, wcs, found.shape, found.points, pole, True, found.tiles, gridding)


def is_resolved(source: InputMap, fwhm: float) -> bool:
    """True if a beam of ``fwhm`` [rad] is at least 2 of the map's pixels wide, by the header."""
    return _resolves(float(source.sides.max()), fwhm)


def _resolves(side: float, fwhm: float) -> bool:
    return bool(fwhm > 0 and fwhm >= SMOOTH_BELOW * side)
