"""The grid on which a map is convolved: its own pixels, or a TAN grid of what a scan reaches, laid
out before it is filled; and bringing the map's pixels onto that: gridded with narrow Gaussians, or
interpolated.

- A TAN image is convolved on its own pixels where they have one size (`FLAT`) as far as a scan
  reaches, or are larger than half of the beam.
- The pixels of any other map of 2 pixels per FWHM or more are gridded with Gaussians (`gridded`) in
  steps that resolve the beam.
- A map without a beam, or with larger pixels, is smooth between its pixels: it is interpolated
  (`interpolated`), in steps no longer than its shortest pixel side where the scan looks.

A detector that looks along d sees, of pixels of brightness T_j and of their own solid angles W_j,

    s(d) = sum_j T_j W_j / (2 pi sigma^2) exp(-r_j^2 / 2 sigma^2),   sigma = FWHM / sqrt(8 ln 2),
    (1)

r_j the angle between d and the pixel. On a plane that touches the sphere at x = 0, with delta the
offset from a pixel on the sky and delta_r its part away from the tangent point, the Gaussian about
x_j has the covariance and the skewness

    C_j = sigma^2 (1 + x_j^2) (1 + x_j x_j^T),   (2)
    exp(-r^2 / 2 sigma^2) = exp(-delta^2 / 2 sigma^2) (1 + |x_j| delta_r delta^2 / sigma^2),
    (3)

up to terms of sigma^2 (2e-4 of a uniform sky for a beam of 1 deg). It is the convolution of a
narrower Gaussian, of covariance C_j - (1 - f) sigma^2, with one that is the same everywhere, of
(1 - f) sigma^2; (3) becomes Hermite polynomials of the narrower one. The narrower ones are summed
up pixel by pixel (Greengard & Lee 2004), the other is one Fourier transform
(`beam.convolve_evenly`). Nothing is interpolated: size, shape and place of pixels do not matter,
and flux is conserved. A grid of step h errs by exp(-2 pi^2 f (1 - f) (sigma / h)^2), 1e-6 of a peak
at 5 points per FWHM and f = 1/5.
"""

from __future__ import annotations

import math
from collections.abc import Hashable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import numpy as np

from zonda.core.data import Observation
from zonda.core.kernels import kernel
from zonda.core.numerics.chunks import chunks
from zonda.core.numerics.projection import boresights, pixel_matrix, rotation_matrices
from zonda.core.numerics.sphere import angle_between, angles, local_axes
from zonda.core.types import Bools, Floats

from .beam import REACH, SIGMA, SMOOTH_BELOW
from .input_map import ImageMap, InputMap
from .region import (
    Progress,
    blocks,
    directions_on,
    no_progress,
    places_on,
    region,
    tangent_grid_wcs,
)

LEAST, MOST = 0.2, 0.5
"""Limits of f, the share of the beam's variance that the narrower Gaussians have."""
PIXELS = 0.65
"""Standard deviation of the narrower Gaussians, in pixels of the map, from which these do not show.
"""
ALIAS = 9.0
"""Exponent of what a grid may err by, where some share attains that: 1e-4 of a peak."""
CUT = 5.0
"""Standard deviations at which the narrower Gaussians end."""
STRAIGHT = 1e-5
"""sigma |x_j| below which the skewness is left out."""


@dataclass(frozen=True)
class Gridding:
    """Gaussians with which pixels are put on a grid for a beam of ``fwhm`` [rad]: ``share`` f of
    its variance.
    """

    fwhm: float
    share: float

    @classmethod
    def of(cls, fwhm: float, pixel: float, step: float) -> Gridding:
        """The least share, in steps of 0.1, that hides pixels of a side ``pixel`` and serves a grid
        of ``step`` [rad].
        """
        wanted = (PIXELS * pixel / (SIGMA * fwhm)) ** 2
        needed = (ALIAS * (step / (SIGMA * fwhm)) ** 2) / (2 * math.pi**2)  # f (1 - f)
        least = 0.5 - math.sqrt(max(0.25 - needed, 0.0))
        return cls(fwhm, min(max(math.ceil(10 * max(wanted, least)) / 10, LEAST), MOST))

    @property
    def resolution(self) -> float:
        """FWHM [rad] of the Gaussians at the tangent point."""
        return math.sqrt(self.share) * self.fwhm

    def variance(self, fwhm: float) -> float:
        """Variance that is left to convolve with for a beam of ``fwhm`` [rad], rad^2."""
        return float(SIGMA**2 * (fwhm**2 - self.share * self.fwhm**2))


def gridded(
    source: InputMap,
    target: Any,
    gridding: Gridding,
    factor: float = 1.0,
    *,
    per_area: bool = False,
    outside: float = 0.0,
    tiles: Bools | None = None,
    progress: Progress = no_progress,
    axis: Floats | None = None,
) -> tuple[Floats, Bools]:
    """(values, covered) of a map on the TAN grid ``target``: (k, ny, nx) K_RJ less ``outside``.

    Each pixel counts once: of an image that goes round the sky more than once, the first time. A
    grid point is covered where the map has the pixel that it lies in.

    Parameters
    ----------
    factor
        K_RJ per unit of the map, or K_RJ sr where ``per_area``.
    outside
        K_RJ, of I.
    tiles, axis
        As of `interpolated`.
    """
    nx, ny = target.pixel_shape
    step = float(np.radians(target.wcs.cdelt[1]))
    sigma = SIGMA * gridding.fwhm
    x0 = float(target.wcs.crpix[0]) - 1
    y0 = float(target.wcs.crpix[1]) - 1
    found = np.zeros((1 if axis is None else 3, ny, nx))
    covered = np.zeros((ny, nx), bool)
    for block in blocks(target, tiles, progress):
        covered[block.y, block.x], parts = source.under(block)
        for at in parts:
            d = source.directions(at)
            wanted = block.nearest(d)
            if not wanted.any():
                continue
            d = d[wanted]
            at = tuple(k[wanted] for k in at)
            areas = source.areas(at)
            known = np.isfinite(areas) & source.own_centre(at)
            d = d[known]
            at = tuple(k[known] for k in at)
            areas = areas[known]
            planes = source.planes(at, axis)
            powers = factor * (planes if per_area else planes * areas)
            powers[0] -= outside * areas
            x, y = places_on(block.matrix, d)
            _add(found, x, y, powers, x0, y0, step, sigma, gridding.share)
    return found, covered


def interpolated(
    source: InputMap,
    target: Any,
    tiles: Bools | None = None,
    progress: Progress = no_progress,
    per_area: bool = False,
    axis: Floats | None = None,
) -> tuple[Floats, Bools, int]:
    """(values, covered, poor) of a map on the TAN grid ``target``, (k, ny, nx), by
    `InputMap.interpolated`. Not covered is 0; ``poor`` counts points that take a mean instead.

    Parameters
    ----------
    tiles
        `region.Region.tiles`: where False nothing is worked on, and not covered.
    axis
        ICRS direction (3,) of a pole: values are I, Q and U, and each pixel's Q and U are turned to
        the meridians through that pole before they are interpolated. None: I alone.
    """
    nx, ny = target.pixel_shape
    found = np.zeros((1 if axis is None else 3, ny, nx))
    covered = np.zeros((ny, nx), bool)
    poor = 0
    for block in blocks(target, tiles, progress):
        there, values, means = source.interpolated(block, axis, per_area)
        if values.size:
            found[:, block.y[there], block.x[there]] = values
            covered[block.y[there], block.x[there]] = True
            poor += means
    return found, covered, poor


def extremes(
    source: InputMap,
    target: Any,
    tiles: Bools | None,
    per_area: bool = False,
) -> tuple[float, float]:
    """Least and largest value of the map's pixels under a grid, from a thinned set of its points;
    (0, 0) where there are none.

    ``per_area``: of values divided by the solid angles of their pixels [sr].
    """
    found = [np.zeros(0)]
    for block in blocks(target, tiles, no_progress, thin=16):
        at = source.around(block)
        with np.errstate(divide="ignore", invalid="ignore"):
            values = source.values[at] / (source.areas(at) if per_area else 1.0)
        found.append(values[np.isfinite(values)])
    ends = [end for values in found if values.size for end in (values.min(), values.max())]
    return float(min(ends, default=0.0)), float(max(ends, default=0.0))


@kernel
def _add(out, x, y, powers, x0, y0, step, sigma, share):  # type: ignore[no-untyped-def]
    planes, ny, nx = out.shape
    square, rest = sigma * sigma, 1.0 - share
    for j in range(x.size):
        u, v = (x[j] - x0) * step, (y[j] - y0) * step
        away = u * u + v * v
        q = 1.0 + away
        xx, xy, yy = (
            square * (q * (1.0 + u * u) - rest),
            square * q * u * v,
            square * (q * (1.0 + v * v) - rest),
        )
        det = xx * yy - xy * xy
        a, b, c = yy / det * step * step, -xy / det * step * step, xx / det * step * step
        factor = q * math.sqrt(q) / (2.0 * math.pi * math.sqrt(det))
        wide, high = CUT * math.sqrt(xx) / step, CUT * math.sqrt(yy) / step
        left, right = max(math.ceil(x[j] - wide), 0), min(math.floor(x[j] + wide), nx - 1)
        low, top = max(math.ceil(y[j] - high), 0), min(math.floor(y[j] + high), ny - 1)
        t = math.sqrt(away)
        skew = sigma * t > STRAIGHT
        cu, cv, au, av, k1, k3, k12 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        if skew:  # delta_r = (cu dx + cv dy) sigma, delta_t = (au dx + av dy) sigma
            cu, cv = u / t * step / q / sigma, v / t * step / q / sigma
            root = math.sqrt(q)
            au, av = -v / t * step / root / sigma, u / t * step / root / sigma
            qr, qt = 1.0 / (1.0 - rest / (q * q)), 1.0 / (1.0 - rest / q)
            k1, k3, k12 = (
                sigma * t * qr * (3.0 * (1.0 - qr) + 1.0 - qt),
                sigma * t * qr * qr * qr,
                sigma * t * qr * qt * qt,
            )
        ratio = math.exp(-a)
        for row in range(low, top + 1):
            dy, dx = row - y[j], left - x[j]
            value = factor * math.exp(-0.5 * (a * dx * dx + 2.0 * b * dx * dy + c * dy * dy))
            times = math.exp(-(a * (dx + 0.5) + b * dy))
            if skew:
                for column in range(left, right + 1):
                    dx = column - x[j]
                    r, s = cu * dx + cv * dy, au * dx + av * dy
                    weight = value * (1.0 + r * (k1 + k3 * r * r + k12 * s * s))
                    for k in range(planes):
                        out[k, row, column] += weight * powers[k, j]
                    value *= times
                    times *= ratio
            else:
                for column in range(left, right + 1):
                    for k in range(planes):
                        out[k, row, column] += value * powers[k, j]
                    value *= times
                    times *= ratio


FLAT = 1e-3
"""Relative difference of solid angles up to which pixels of a TAN image count as equal (1.5 deg).
"""
FINER = 1.25
"""Factor by which a grid over which pixels are spread is finer than asked for: 5 points per FWHM
err by 6e-4 of a peak, 4 by 2e-3.
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
        Key in the cache of what is computed there.
    wcs
        TAN, two-dimensional.
    shape
        (ny, nx).
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
    resampled: bool = False
    tiles: Bools | None = None
    gridding: Gridding | None = None

    @property
    def nbytes(self) -> int:
        """Bytes of the map there, and of what is kept of the file where that is another."""
        ny, nx = self.shape
        each = 8 if self.source.polarization is None else 24
        return (each + self.resampled) * ny * nx

    @property
    def size(self) -> str:
        """``64 x 48``, columns and rows."""
        return f"{self.shape[1]} x {self.shape[0]}"

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
        # the tangent point in the boresight's frame
        along = np.einsum("nij,i->nj", rotation_matrices(quaternions), self.matrix[2])
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
    return Grid((*key, "image", tuple(wcs.wcs.crval)), source, wcs, source.shape)


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
    made = *key, "grid", ra, dec, step, gridding, found.box, tiles
    return Grid(made, source, wcs, found.shape, True, found.tiles, gridding)


def is_resolved(source: InputMap, fwhm: float) -> bool:
    """True if a beam of ``fwhm`` [rad] is at least 2 of the map's pixels wide, by the header."""
    return _resolves(float(source.sides.max()), fwhm)


def _resolves(side: float, fwhm: float) -> bool:
    return bool(fwhm > 0 and fwhm >= SMOOTH_BELOW * side)
