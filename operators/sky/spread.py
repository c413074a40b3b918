"""Spreading the pixels of a map over a tangent-plane grid: a beam on the grid is then the sum over
the pixels under it.

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
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel
from zonda.core.numerics.projection import frame_rotation, pixel_matrix
from zonda.core.polarization import between_meridians, turned_by
from zonda.core.types import Floats

from .beam import SIGMA
from .inputs import HealpixMap, WcsMap
from .region import TILE
from .resample import BLOCK, Block, ImageOnSky, Progress, blocks, no_progress, slots

LEAST, MOST = 0.2, 0.5
"""Of f."""
PIXELS = 0.65
"""Standard deviation of the narrower Gaussians, in pixels of the map, from which these do not show.
"""
ALIAS = 9.0
"""Exponent of what a grid may err by, where some share attains that: 1e-4 of a peak."""
CUT = 5.0
"""Standard deviations at which the narrower Gaussians end."""
STRAIGHT = 1e-5
"""sigma |x_j| below which the skewness is left out."""
AT_ONCE = 2**18
"""Pixels of a map that are placed together."""
NORTH = np.array([0.0, 0.0, 1.0])

Part = tuple[Floats, Floats, Floats]
"""Of some pixels: ICRS directions (n, 3), solid angles [sr] (n,), the map's planes (k, n)."""
Chosen = Callable[[Floats], NDArray[np.bool_]]
"""Which of the pixels in ICRS directions (n, 3) are wanted."""
Under = Callable[[Block, Chosen], tuple[NDArray[np.bool_], Iterator[Part]]]
"""Of a block of a grid: which of its points are covered, and the pixels that are chosen."""


@dataclass(frozen=True)
class Spread:
    """Spread of pixels over a grid for a beam of ``fwhm`` [rad]: ``share`` f of its variance."""

    fwhm: float
    share: float

    @classmethod
    def of(cls, fwhm: float, pixel: float, step: float) -> Spread:
        """The least share, in steps of 0.1, that hides pixels of a side ``pixel`` and serves a grid
        of ``step`` [rad].
        """
        wanted = (PIXELS * pixel / (SIGMA * fwhm)) ** 2
        needed = (ALIAS * (step / (SIGMA * fwhm)) ** 2) / (2 * math.pi**2)  # f (1 - f)
        least = 0.5 - math.sqrt(max(0.25 - needed, 0.0))
        return cls(fwhm, min(max(math.ceil(10 * max(wanted, least)) / 10, LEAST), MOST))

    @property
    def resolution(self) -> float:
        """FWHM [rad] of what is spread, at the tangent point."""
        return math.sqrt(self.share) * self.fwhm

    def variance(self, fwhm: float) -> float:
        """Variance that is left to convolve with for a beam of ``fwhm`` [rad], rad^2."""
        return float(SIGMA**2 * (fwhm**2 - self.share * self.fwhm**2))

    def add(
        self,
        out: Floats,
        x: Floats,
        y: Floats,
        powers: Floats,
        origin: tuple[float, float],
        step: float,
    ) -> None:
        """Add pixels of ``powers`` (k, n) [K sr] at grid points ``x``, ``y`` (n,) to ``out`` (k,
        ny, nx) [K].

        The grid touches the sphere at its point ``origin`` (x, y); its ``step`` is in rad.
        """
        _add(out, x, y, powers, *origin, step, SIGMA * self.fwhm, self.share)


def spread_map(
    source: WcsMap | HealpixMap,
    target: Any,
    spread: Spread,
    factor: float = 1.0,
    *,
    per_area: bool = False,
    outside: float = 0.0,
    tiles: NDArray[np.bool_] | None = None,
    progress: Progress = no_progress,
    axis: Floats | None = None,
) -> tuple[Floats, NDArray[np.bool_]]:
    """(values, covered) of a map on the TAN grid ``target``: K_RJ less ``outside``, spread.

    Each pixel counts once: of an image that goes round the sky more than once, the first time. A
    grid point is covered where the map has the pixel that it lies in.

    Parameters
    ----------
    factor
        K_RJ per unit of the map, or K_RJ sr where ``per_area``.
    outside
        K_RJ, of I.
    tiles, progress, axis
        As of `resample.resample_image`.
    """
    nx, ny = target.pixel_shape
    matrix, step = pixel_matrix(target), float(np.radians(target.wcs.cdelt[1]))
    origin = float(target.wcs.crpix[0]) - 1, float(target.wcs.crpix[1]) - 1
    found, covered = np.zeros((1 if axis is None else 3, ny, nx)), np.zeros((ny, nx), bool)
    under = (
        _of_healpix(source, axis)
        if isinstance(source, HealpixMap)
        else _of_image(source, target, axis)
    )
    for block in blocks(target, tiles, progress):
        left, low = int(block.x.min()) // BLOCK * BLOCK, int(block.y.min()) // BLOCK * BLOCK

        def nearest(d: Floats, left: int = left, low: int = low) -> NDArray[np.bool_]:
            """True if pixels are nearest to points of the block."""
            with np.errstate(invalid="ignore", divide="ignore"):
                x, y = (np.rint(k) for k in _places(matrix, d))
                inside = (
                    (x >= left)
                    & (x < min(left + BLOCK, nx))
                    & (y >= low)
                    & (y < min(low + BLOCK, ny))
                    & (d @ matrix[2] > 0)
                )
            if tiles is not None:
                inside[inside] = tiles[
                    (y[inside] // TILE).astype(int), (x[inside] // TILE).astype(int)
                ]
            return np.asarray(inside, np.bool_)

        there, parts = under(block, nearest)
        covered[block.y, block.x] = there
        for d, areas, planes in parts:
            powers = factor * (planes if per_area else planes * areas)
            powers[0] -= outside * areas
            spread.add(found, *_places(matrix, d), powers, origin, step)
    return (found if axis is not None else found[0]), covered


def _places(matrix: Floats, d: Floats) -> tuple[Floats, Floats]:
    """0-based grid points (x, y) of directions (n, 3)."""
    x, y, depth = matrix @ d.T
    return np.ascontiguousarray(x / depth), np.ascontiguousarray(y / depth)


def _of_image(image: WcsMap, target: Any, axis: Floats | None) -> Under:
    """Pixels of an image under blocks of ``target``."""
    sky, to_sky = ImageOnSky(image), np.linalg.inv(pixel_matrix(target)).T

    def parts(
        rows: NDArray[np.int64], columns: NDArray[np.int64], chosen: Chosen
    ) -> Iterator[Part]:
        some = max(AT_ONCE // max(len(columns), 1), 1)
        for first in range(0, len(rows), some):
            x, y = (k.ravel() for k in np.meshgrid(columns, rows[first : first + some]))
            d = sky.directions(x, y)
            wanted = chosen(d)
            if wanted.any():
                x, y, d = x[wanted], y[wanted], d[wanted]
                areas = sky.areas(x, y)
                known = np.isfinite(areas) & sky.is_own(x, y)
                yield d[known], areas[known], sky.planes(x[known], y[known], axis)

    def under(block: Block, chosen: Chosen) -> tuple[NDArray[np.bool_], Iterator[Part]]:
        (x0, x1), (y0, y1) = ((int(k.min()) - 1, int(k.max()) + 1) for k in (block.x, block.y))
        along, up = np.arange(x0, x1 + 1), np.arange(y0, y1 + 1)
        x = np.concatenate([along, along, np.full(len(up), x0), np.full(len(up), x1)])
        y = np.concatenate([np.full(len(along), y0), np.full(len(along), y1), up, up])
        rim = np.stack([x, y, np.ones(len(x))], axis=1) @ to_sky
        rows, columns, there = sky.under(block, rim / np.linalg.norm(rim, axis=1, keepdims=True))
        return there, parts(rows, columns, chosen)

    return under


def _of_healpix(sky: HealpixMap, axis: Floats | None) -> Under:
    """Pixels of a HEALPix map, as `_of_image`."""
    import healpy

    to_frame, area = frame_rotation(sky.frame), float(healpy.nside2pixarea(sky.nside))

    def parts(numbers: NDArray[np.int64], chosen: Chosen) -> Iterator[Part]:
        for first in range(0, len(numbers), AT_ONCE):
            some = numbers[first : first + AT_ONCE]
            at, there = slots(sky, some)
            at, some = at[there], some[there]
            own = np.stack(healpy.pix2vec(sky.nside, some, nest=sky.nest), axis=1)
            wanted = chosen(own @ to_frame)
            own, planes = own[wanted], sky.values[None, at[wanted]]
            if axis is not None and sky.polarization is not None:
                turn = between_meridians(own, NORTH, to_frame @ axis)
                planes = np.concatenate([planes, turned_by(sky.polarization[:, at[wanted]], turn)])
            yield own @ to_frame, np.full(len(own), area), planes

    def under(block: Block, chosen: Chosen) -> tuple[NDArray[np.bool_], Iterator[Part]]:
        d = block.d @ to_frame.T
        there = slots(sky, healpy.vec2pix(sky.nside, *d.T, nest=sky.nest))[1]
        middle = d.mean(axis=0)
        middle /= np.linalg.norm(middle)
        radius = float(np.arccos(np.clip((d @ middle).min(), -1, 1))) + block.step
        return there, parts(
            np.sort(healpy.query_disc(sky.nside, middle, min(radius, np.pi), nest=sky.nest)), chosen
        )

    return under


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
