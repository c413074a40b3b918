"""Smoothing of maps with a Gaussian, on the sphere and on plain images.

A Gaussian of FWHM sqrt(8 ln 2) sigma on the sky, r the angle between two directions,
is the kernel

    K_pq = W_p / (2 pi sigma^2) exp(-r_pq^2 / 2 sigma^2),   W_p the solid angle of pixel p,   (2)

cut at 5 sigma: over pixels much smaller than the kernel it sums to 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from ..errors import InputError
from ..kernels import kernel
from ..numerics.sphere import FWHM_PER_SIGMA, angle_text
from ..types import AnyFloats, Bools, Floats
from .grid import ROWS, HealpixPixels, ImagePixels, MapGrid


def gaussian_taps(sigma: float) -> Floats:
    """(n,) the middle and one side of a Gaussian of ``sigma`` pixels, cut at 5 sigma, of sum 1 over
    both sides.
    """
    reach = math.ceil(5 * sigma)
    kernel = (
        np.exp(-(np.arange(-reach, reach + 1) ** 2) / (2 * sigma**2)) if sigma > 0 else np.ones(1)
    )
    return np.asarray(kernel / kernel.sum())[reach:]


def convolved(values: AnyFloats, taps: AnyFloats, along: AnyFloats | None = None) -> AnyFloats:
    """An image (ny, nx) convolved along both axes with a symmetric kernel; nothing lies outside.
    All of one type.

    ``along``: taps along x, where they are not those along y.
    """
    across = np.ascontiguousarray(_along_columns(values, taps).T)
    return np.ascontiguousarray(_along_columns(across, taps if along is None else along).T)


def convolved_rows(values: Floats, taps: Floats, rows: list[Floats]) -> Floats:
    """Convolve as `convolved` does, with a kernel of its own along each row (``rows``); ``taps`` is
    for the columns.
    """
    n = values.shape[1]
    along = np.empty_like(values)
    for values_of, own, out in zip(values, rows, along, strict=True):
        reach = min(len(own) - 1, n - 1)
        out[:] = np.convolve(values_of, np.concatenate([own[reach:0:-1], own[: reach + 1]]))[
            reach : reach + n
        ]
    return np.asarray(_along_columns(along, taps))


def _along_columns(values: AnyFloats, taps: AnyFloats) -> AnyFloats:
    """sum_k taps[|k|] values[j + k] along the first axis; zeros beyond the ends."""
    out: AnyFloats = values * taps[0]
    part = np.empty_like(values)
    for k in range(1, min(len(taps), len(values))):
        np.multiply(values, taps[k], out=part)
        out[k:] += part[:-k]
        out[:-k] += part[k:]
    return out


Smoother = Callable[..., Floats]
"""f(values, power=1.0): values, shape of the grid, convolved with the power-th power of equation
(2). Nothing lies outside.
"""

EVEN = 2e-3
"""Relative differences of steps across an image below which one kernel serves all pixels."""
GENTLE = 5e-3
"""sigma tan(latitude) of a CAR image up to which each row has its own kernel: the kernel's width
varies by half of it within.
"""
CUT = 5.0
"""Standard deviations at which kernels end."""
STEEP = 0.15
"""sigma tan(latitude) up to which the mean of two kernels for each row serves CAR images, to some
0.5 %.
"""
MOST_PAIRS = 3e6
"""Pairs of HEALPix pixels under a kernel up to which each is looked at: harmonics of a whole sphere
take as long.
"""
LARGEST_NSIDE = 2048
"""Of HEALPix maps that are smoothed by harmonics: beyond, a whole sphere takes gigabytes."""
DIRECT = 1e9
"""Pairs of pixels of an image under a kernel up to which each is looked at: some 3 s. For CAR
images the limit is a hundredth of this.
"""
TILE = 64
"""Pixels on a side of a tile up to which it is halved until one kernel serves it."""
MOST_DIRECT = 3e11
"""Pairs of pixels under a kernel, each looked at, beyond which an image is refused: some 15
minutes.
"""
SKEW = 1e-2
"""Skewness of pixels below which the kernel is that of pixels at right angles: right to half of it,
of the kernel's peak.
"""
STEPS = 8192
"""Of the table of the Gaussian: linear interpolation is right to (12.5 power / STEPS)^2 / 8, some
1e-6.
"""
DEEPEST = CUT**2 / 2
"""r^2 / 2 sigma^2 at which kernels end."""


def smoother(grid: MapGrid, fwhm: float) -> Smoother:
    """The convolution with a Gaussian of ``fwhm`` [rad], equation (2), by the fastest kernel that
    is right for the grid. Raises InputError beyond `MOST_DIRECT` pairs.
    """
    sigma = fwhm / FWHM_PER_SIGMA
    if isinstance(grid, HealpixPixels):
        return _of_healpix(grid, sigma)
    assert isinstance(grid, ImagePixels)
    car = grid.kind == "CAR" and grid.cylinder
    if car and sigma * np.tan(abs(grid.latitudes)).max(initial=0.0) < GENTLE:
        return _by_rows(grid, sigma)
    if (steps := _even_steps(grid)) is not None:
        return _evenly(steps, sigma)
    reach = grid.reach(CUT * sigma)
    pairs = 4.0 * math.prod(grid.shape) * math.prod(reach)
    if car and pairs >= DIRECT / 100:
        return _by_latitudes(grid, sigma)
    if pairs >= DIRECT and not 0 < grid.around <= grid.shape[1]:
        return _by_tiles(grid, sigma, reach)
    return _directly(grid, sigma)


def weighted_mean(convolve: Smoother, values: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Equation (3): the weighted mean of ``values`` under a Gaussian, and the convolved weights.
    Pixels that are NaN stay so, and count in no other pixel.

        m'_p = sum_q K_pq w_q m_q / sum_q K_pq w_q,
        n'_p = [sum_q (K_pq w_q n_q)^2]^(1/2) / sum_q K_pq w_q          (3)
    """
    known = np.isfinite(values)
    weights = np.where(known, weights, 0.0)
    total = convolve(weights)
    with np.errstate(invalid="ignore", divide="ignore"):
        return np.where(
            known,
            convolve(weights * np.where(known, values, 0.0)) / total,
            np.nan,
        ), total


def error_of_mean(
    convolve: Smoother,
    noise: Floats,
    weights: Floats,
    known: Bools,
    total: Floats,
) -> Floats:
    """Equation (3): standard error of `weighted_mean` for independent ``noise`` in the pixels; NaN
    where the mean is not ``known``, or the noise. ``total``: the convolved ``weights``.
    """
    quiet = known & np.isfinite(noise)
    with np.errstate(invalid="ignore", divide="ignore"):
        square = convolve((weights * np.where(quiet, noise, 0.0)) ** 2, 2.0) / total**2
        # the noise is not known where the transform's rounding is all there is
        return np.where(quiet & (square >= 0), np.sqrt(square), np.nan)


def smoothed(
    grid: MapGrid,
    values: Floats,
    fwhm: float,
    noise: Floats | None = None,
) -> tuple[Floats, Floats | None]:
    """(values, noise) of `weighted_mean` and `error_of_mean`. Weights are solid angles: values are
    points of a brightness.
    """
    convolve = smoother(grid, fwhm)
    own = np.broadcast_to(np.nan_to_num(np.where(grid.once, grid.areas, 0.0)), grid.shape)
    known = np.isfinite(values)
    weights = np.where(known, own / own.max(initial=0.0), 0.0)
    found, total = weighted_mean(convolve, values, weights)
    return found, None if noise is None else error_of_mean(convolve, noise, weights, known, total)


def _evenly(steps: tuple[float, float], sigma: float) -> Smoother:
    """Smoother of an image whose pixels are alike."""
    along_y, along_x = (gaussian_taps(sigma / step) for step in steps)
    return lambda values, power=1.0: np.asarray(convolved(values, along_y**power, along_x**power))


def _by_tiles(grid: ImagePixels, sigma: float, reach: tuple[int, int]) -> Smoother:
    """Smoother of a large image: tile by tile where one kernel serves a tile, else pixel by
    pixel.
    """
    halo = [math.ceil(1.2 * n) + 2 for n in reach]
    rest = np.zeros(grid.shape, np.bool_)
    tiles = []
    for tile, steps in _tiles(grid, *(slice(0, n) for n in grid.shape)):
        if steps is None:
            rest[tile] = True
            continue
        low = [max(own.start - n, 0) for own, n in zip(tile, halo, strict=True)]
        whole = tuple(slice(a, own.stop + n) for a, own, n in zip(low, tile, halo, strict=True))
        inner = tuple(slice(own.start - a, own.stop - a) for a, own in zip(low, tile, strict=True))
        tiles.append((tile, whole, inner, _evenly(steps, sigma)))
    directly = _directly(grid, sigma, rest)

    def found(values: AnyFloats, power: float = 1.0) -> Floats:
        out, values = directly(values, power), np.asarray(values, np.float64)
        for tile, whole, inner, evenly in tiles:
            out[tile] = evenly(values[whole], power)[inner]
        return out

    return found


def _tiles(
    grid: ImagePixels, *tile: slice
) -> list[tuple[tuple[slice, ...], tuple[float, float] | None]]:
    """Halves of halves of the image, until each is even or of no more than `TILE` pixels a side;
    and its steps, None where these differ.
    """
    steps = _even_steps(grid.window(*tile))
    sides = [own.stop - own.start for own in tile]
    if steps is not None or max(sides) <= TILE:
        return [(tile, steps)]
    along = int(sides[1] > sides[0])
    found = []
    middle = tile[along].start + sides[along] // 2
    for half in (slice(tile[along].start, middle), slice(middle, tile[along].stop)):
        found += _tiles(grid, *((tile[0], half) if along else (half, tile[1])))
    return found


def _by_latitudes(grid: ImagePixels, sigma: float) -> Smoother:
    """Smoother of a large CAR image: row by row, but near the poles pixel by pixel."""
    rows = _by_rows(grid, sigma, both=True)
    poles = []
    for pole in (-1, 1):
        near = sigma * np.sin(pole * grid.latitudes) >= STEEP * np.cos(grid.latitudes)
        if near.any():
            poles.append((near, _directly(grid, sigma, near[:, None])))

    def found(values: AnyFloats, power: float = 1.0) -> Floats:
        out = rows(values, power)
        for near, directly in poles:
            out[near] = directly(values, power)[near]
        return out

    return found


def _by_rows(grid: ImagePixels, sigma: float, both: bool = False) -> Smoother:
    """Smoother of a CAR image: along each row with its own width, then along the columns; right to
    sigma tan(latitude) / 2.

    ``both``: the mean of that, of the height that equation (2) has, and of columns first, rows
    then. The widths go with cos(latitude) of the pixel that is seen, and of the one that sees it;
    so has r^2 the mean of both: right to the square.
    """
    side = abs(float(grid.matrix[0, 0]))
    taps = gaussian_taps(sigma / abs(float(grid.matrix[1, 1])))
    cosines = np.cos(grid.latitudes)
    if both:  # rows nearer to a pole are left to `_directly`
        cosines = np.maximum(cosines, sigma / 2 / STEEP)
    rows = [gaussian_taps(sigma / side / cosine) for cosine in cosines]
    around = grid.around
    nx = grid.shape[1]
    columns: Any = slice(None)
    own: Any = columns
    if 0 < around <= nx:
        reach = min(max((len(row) for row in rows), default=0), (around - 1) // 2)
        columns = np.arange(-reach, around + reach) % around
        own = reach + np.arange(nx) % around

    def found(values: AnyFloats, power: float = 1.0) -> Floats:
        whole = np.asarray(values, np.float64)[:, columns]
        along, one = [row**power for row in rows], np.ones(1)
        if not both:
            return convolved_rows(whole, taps**power, along)[:, own]
        height = cosines[:, None] ** power
        seen = height * convolved_rows(whole / height, taps**power, along)
        whole = convolved_rows(whole, taps**power, [one] * len(rows))
        return (seen + convolved_rows(whole, one, along))[:, own] / 2

    return found


def _even_steps(grid: ImagePixels) -> tuple[float, float] | None:
    """Steps (y, x) that hold for all pixels to `EVEN`, whose axes are at right angles; None: they
    differ.
    """
    if 0 < grid.around <= grid.shape[1]:
        return None
    xx, xy, yy = grid.scattered_metric
    reference = tuple(float(v) for v in np.sqrt((grid.matrix**2).sum(axis=0))[::-1])
    for dy, dx in (reference, grid.sides):
        with np.errstate(invalid="ignore"):
            same = (
                (abs(np.sqrt(xx) / dx - 1) < EVEN)
                & (abs(np.sqrt(yy) / dy - 1) < EVEN)
                & (abs(xy) < SKEW / 2 * dx * dy)
            )
        if same.all():
            return dy, dy if abs(dx / dy - 1) < 1e-9 else dx
    return None


def _directly(
    grid: ImagePixels,
    sigma: float,
    where: Bools = np.ones((1, 1), np.bool_),
) -> Smoother:
    """Equation (2) as it stands, of the pixels ``where`` (others are 0): each with its own kernel.
    InputError beyond `MOST_DIRECT` pairs.
    """
    ny, nx = grid.shape
    whole = 0 < grid.around <= nx
    columns = grid.around if whole else nx
    where = np.broadcast_to(where, grid.shape)[:, :columns]
    wanted = np.flatnonzero(where.any(axis=1))
    across = np.arange(columns, dtype=np.float64)
    reach = np.zeros((2, ny, columns), np.int32)
    for part in np.array_split(wanted, math.ceil(len(wanted) / ROWS) or 1):
        xx, xy, yy = grid.metric(across, part[:, None])
        with np.errstate(invalid="ignore", divide="ignore"):
            wide = 1.1 * CUT * sigma * np.sqrt(np.stack([yy, xx]) / (xx * yy - xy**2)) + 1
            if grid.cylinder:  # meridians meet: a circle about the pole has all columns
                side = abs(float(grid.matrix[0, 0]))
                share = math.sin(min(CUT * sigma, math.pi / 2)) / (np.sqrt(xx) / side)
                wide[0] = np.where(share < 1, np.arcsin(np.minimum(share, 1.0)) / side + 1, np.inf)
        most = np.array([columns // 2 if whole else columns, ny])[:, None, None]
        reach[:, part] = np.minimum(np.where(np.isnan(wide), 0.0, wide), most) * where[part]
    if (pairs := 4 * float(reach.prod(axis=0, dtype=np.float64).sum())) > MOST_DIRECT:
        raise InputError(
            f"a map of {nx} x {ny} pixels, smoothed by {angle_text(sigma * FWHM_PER_SIGMA)}, would"
            f" take {pairs / 1e12:.2g} hours",
            place="smoothing",
            cure="smooth it less, cut off the poles of a CAR map, or make a HEALPix map (nside)",
        )
    high = int(reach[1].max(initial=0))
    first = wanted.min(initial=ny) - high
    stop = wanted.max(initial=-1) + high + 1
    seen = slice(max(int(first), 0), min(int(stop), ny))
    rows = np.arange(ny)[seen]
    parts = np.array_split(rows, math.ceil(len(rows) / ROWS) or 1)
    directions = np.concatenate([grid.at(across, part[:, None]) for part in parts])
    areas = np.nan_to_num(np.where(where, grid.areas[:, :columns], 0.0)[seen])
    reach = np.ascontiguousarray(reach[:, seen])

    def found(values: AnyFloats, power: float = 1.0) -> Floats:
        own, out = np.ascontiguousarray(values[seen, :columns], np.float64), np.zeros((ny, nx))
        ours = smooth_directly(own, directions, areas, reach, whole, sigma, power, table(power))
        out[seen] = ours[:, np.arange(nx) % columns]
        return out

    return found


def _of_healpix(grid: HealpixPixels, sigma: float) -> Smoother:
    """Smoother of a HEALPix map: pair by pair of few pixels, or of a part of a sphere that is too
    fine for harmonics; else by harmonics of the whole sphere.
    """
    import healpy
    from scipy.spatial import cKDTree

    size = sigma / grid.sides[0]
    scale = 1 / (2 * math.pi * size**2)
    under = math.pi * (CUT * size) ** 2

    def by_harmonics(values: AnyFloats, power: float = 1.0) -> Floats:
        whole = np.zeros(healpy.nside2npix(grid.nside))
        ring = healpy.nest2ring(grid.nside, grid.pixels) if grid.nest else grid.pixels
        whole[ring] = values
        whole = healpy.smoothing(whole, sigma=sigma / math.sqrt(power), iter=3)
        return np.asarray(whole[ring] * scale ** (power - 1) / power, np.float64)

    if len(grid.pixels) * under >= MOST_PAIRS and grid.nside <= LARGEST_NSIDE:
        return by_harmonics
    directions = grid.directions()
    tree = cKDTree(directions)

    def by_pairs(values: AnyFloats, power: float = 1.0) -> Floats:
        out = np.zeros(len(directions))
        rows = max(1, round(1e6 / max(1.0, under)))
        for first in range(0, len(directions), rows):
            part = cKDTree(directions[first : first + rows])
            near = part.sparse_distance_matrix(tree, CUT * sigma, output_type="ndarray")
            chord = near["v"] ** 2
            kernel = np.exp(-power * chord * (1 + chord / 12) / (2 * sigma**2))
            out[first : first + rows] = np.bincount(near["i"], kernel * values[near["j"]], part.n)
        return np.asarray(out * scale**power, np.float64)

    return by_pairs


def table(power: float) -> Floats:
    """(STEPS + 2,) exp(-power u) at u = 0 ... `DEEPEST`."""
    return np.asarray(np.exp(-power * DEEPEST / STEPS * np.arange(STEPS + 2)), np.float64)


@kernel
def smooth_directly(  # type: ignore[no-untyped-def]
    values, d, areas, reach, whole, sigma, power, gaussian
):
    """sum_q K_pq^power values_q (ny, nx).

    ``d`` (ny, nx, 3) directions, NaN off the sky; ``areas`` (ny, nx) [sr]; ``reach`` (2, ny, nx)
    columns and rows to look at on either side; ``whole``: the last column is beside the first one.
    """
    ny, nx = values.shape
    out = np.zeros((ny, nx))
    for y in range(ny):
        for x in range(nx):
            scale = areas[y, x] / (2 * math.pi * sigma * sigma)
            if not scale > 0.0:
                continue
            a, b, c = d[y, x, 0], d[y, x, 1], d[y, x, 2]
            wide, high, found = reach[0, y, x], reach[1, y, x], 0.0
            left, right = x - wide, x + wide
            if whole:  # each column once
                right = min(right, left + nx - 1)
            else:
                left, right = max(left, 0), min(right, nx - 1)
            for j in range(max(y - high, 0), min(y + high, ny - 1) + 1):
                for k in range(left, right + 1):
                    i = k + nx if k < 0 else k - nx if k >= nx else k
                    p, q, r = d[j, i, 0] - a, d[j, i, 1] - b, d[j, i, 2] - c
                    chord = p * p + q * q + r * r
                    at = chord * (1.0 + chord / 12.0) / (2 * sigma * sigma) * (STEPS / DEEPEST)
                    if at < STEPS:
                        n = int(at)
                        found += (
                            gaussian[n] + (at - n) * (gaussian[n + 1] - gaussian[n])
                        ) * values[j, i]
            out[y, x] = found * scale**power
    return out
