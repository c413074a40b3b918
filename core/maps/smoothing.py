"""Smoothing of maps with a Gaussian on the sphere.

A Gaussian of FWHM sqrt(8 ln 2) sigma on the sky, r the angle between two directions,
is the kernel

    K_pq = W_p / (2 pi sigma^2) exp(-r_pq^2 / 2 sigma^2),   W_p the solid angle of pixel p,   (2)

cut at 5 sigma: over pixels much smaller than the kernel it sums to 1.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from ..errors import InputError
from ..kernels import kernel
from ..numerics.angles import FWHM_PER_SIGMA, angle_text
from ..numerics.transforms import convolved, convolved_rows, gaussian_taps
from ..types import AnyFloats, Floats
from .grid import ROWS, HealpixPixels, ImagePixels, MapGrid

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
"""Pairs of pixels under a kernel up to which each is looked at: some 3 s."""
MOST_DIRECT = 3e11
"""Pairs beyond which that is not done."""
TILE = 64
SKEW = 1e-2
"""Skewness of pixels below which the kernel is that of pixels at right angles: right to half of it,
of the kernel's peak.
"""
STEPS = 8192
"""Of the table of the Gaussian: linear interpolation is right to (12.5 power / STEPS)^2 / 8, some
1e-6.
"""
DEEPEST = 12.5
"""r^2 / 2 sigma^2 at which kernels end: 5 sigma."""


def smoother(grid: MapGrid, fwhm: float) -> Smoother:
    """The convolution with a Gaussian of ``fwhm`` [rad], equation (2)."""
    if isinstance(grid, ImagePixels):
        return ImageSmoothing(grid).smoother(fwhm)
    assert isinstance(grid, HealpixPixels)
    return HealpixSmoothing(grid).smoother(fwhm)


def smoothed(
    grid: MapGrid,
    values: Floats,
    fwhm: float,
    weights: Floats | None = None,
    noise: Floats | None = None,
) -> tuple[Floats, Floats | None]:
    """(values, noise) of the mean under a Gaussian; NaN where ``values`` are, which count in no
    other pixel.

        m'_p = sum_q K_pq w_q m_q / sum_q K_pq w_q,
        n'_p = [sum_q (K_pq w_q n_q)^2]^(1/2) / sum_q K_pq w_q          (3)

    ``weights``: default the solid angles, so that values are points of a brightness; noise is
    of pixels that are independent.
    """
    convolve = smoother(grid, fwhm)
    own = np.broadcast_to(np.nan_to_num(np.where(grid.once, grid.areas, 0.0)), grid.shape)
    own = own / own.max(initial=0.0) if weights is None else weights
    known = np.isfinite(values)
    weight = np.where(known, own, 0.0)
    total = convolve(weight)
    with np.errstate(invalid="ignore", divide="ignore"):
        found = np.where(known, convolve(weight * np.where(known, values, 0.0)) / total, np.nan)
        if noise is None:
            return found, None
        quiet = known & np.isfinite(noise)
        variance = convolve((weight * np.where(quiet, noise, 0.0)) ** 2, 2.0)
        return found, np.where(
            quiet & (variance >= 0), np.sqrt(np.maximum(variance, 0.0)) / total, np.nan
        )


@dataclass(frozen=True)
class ImageSmoothing:
    """Smoothing of an image, by the fastest kernel that is right for its projection."""

    grid: ImagePixels

    def smoother(self, fwhm: float) -> Smoother:
        sigma = fwhm / FWHM_PER_SIGMA
        if (
            self.grid.kind == "CAR"
            and self.grid.cylinder
            and sigma * np.tan(abs(self.grid.latitudes)).max(initial=0.0) < GENTLE
        ):
            return self._by_rows(sigma)
        steps = self._even()
        if steps is None:
            reach = self.grid.reach(CUT * sigma)
            by_latitudes = (
                self.grid.kind == "CAR" and self.grid.cylinder
            )  # right to 0.2 %, and much faster
            if 4.0 * math.prod(self.grid.shape) * math.prod(reach) < (
                DIRECT / 100 if by_latitudes else DIRECT
            ):
                return self._directly(sigma)
            if by_latitudes:
                return self._by_latitudes(sigma)
            return (
                self._directly(sigma)
                if 0 < self.grid.around <= self.grid.shape[1]
                else self._by_tiles(sigma, reach)
            )
        along_y, along_x = (gaussian_taps(sigma / step) for step in steps)
        return lambda values, power=1.0: np.asarray(
            convolved(values, along_y**power, along_x**power)
        )

    def _by_tiles(self, sigma: float, reach: tuple[int, int]) -> Smoother:
        """Smoother of a large image: tile by tile, each so small that one kernel serves it where
        that can be.
        """
        ny, nx = self.grid.shape
        more = tuple(math.ceil(1.2 * n) + 2 for n in reach)
        tiles = self._tiles(slice(0, ny), slice(0, nx))

        def found(values: AnyFloats, power: float = 1.0) -> Floats:
            out = np.empty((ny, nx))
            for y, x in tiles:
                low = max(y.start - more[0], 0), max(x.start - more[1], 0)
                around = (
                    slice(low[0], min(y.stop + more[0], ny)),
                    slice(low[1], min(x.stop + more[1], nx)),
                )
                steps, part = (
                    ImageSmoothing(self.grid.window(y, x))._even(),
                    np.asarray(values[around], np.float64),
                )
                if steps is None:
                    own = [slice(s.start - n, s.stop - n) for s, n in zip((y, x), low, strict=True)]
                    whole = ImageSmoothing(self.grid.window(*around))._directly(
                        sigma, (own[0], own[1])
                    )(part, power)
                else:
                    along_y, along_x = (gaussian_taps(sigma / step) for step in steps)
                    whole = np.asarray(convolved(part, along_y**power, along_x**power), np.float64)
                out[y, x] = whole[
                    y.start - low[0] : y.stop - low[0], x.start - low[1] : x.stop - low[1]
                ]
            return out

        return found

    def _tiles(self, y: slice, x: slice) -> list[tuple[slice, slice]]:
        """Halves of halves of the image, until each is even or of no more than `TILE` pixels a
        side.
        """
        rows, columns = y.stop - y.start, x.stop - x.start
        if max(rows, columns) <= TILE or ImageSmoothing(self.grid.window(y, x)).even:
            return [(y, x)]
        if rows >= columns:
            middle = y.start + rows // 2
            return self._tiles(slice(y.start, middle), x) + self._tiles(slice(middle, y.stop), x)
        middle = x.start + columns // 2
        return self._tiles(y, slice(x.start, middle)) + self._tiles(y, slice(middle, x.stop))

    def _by_rows(self, sigma: float, both: bool = False) -> Smoother:
        """Smoother of a CAR image: along each row with its own width, then along the columns; right
        to sigma tan(latitude) / 2.

        ``both``: the mean of that, of the height that equation (2) has, and of columns first, rows
        then. The widths go with cos(latitude) of the pixel that is seen, and of the one that sees
        it; so has r^2 the mean of both: right to the square.
        """
        side, taps = (
            abs(float(self.grid.matrix[0, 0])),
            gaussian_taps(sigma / abs(float(self.grid.matrix[1, 1]))),
        )
        cosines = np.cos(self.grid.latitudes)
        if both:  # rows nearer to a pole are left to `_directly`
            cosines = np.maximum(cosines, sigma / 2 / STEEP)
        rows = [gaussian_taps(sigma / side / cosine) for cosine in cosines]
        around, nx = self.grid.around, self.grid.shape[1]

        def convolve(values: Floats, power: float) -> Floats:
            along, one = [row**power for row in rows], np.ones(1)
            if not both:
                return convolved_rows(values, taps**power, along)
            height = cosines[:, None] ** power
            seen = height * convolved_rows(values / height, taps**power, along)
            return (
                seen
                + convolved_rows(convolved_rows(values, taps**power, [one] * len(rows)), one, along)
            ) / 2

        if not 0 < around <= nx:
            return lambda values, power=1.0: convolve(np.asarray(values, np.float64), power)
        reach = min(max((len(row) for row in rows), default=0), (around - 1) // 2)
        columns = np.arange(-reach, around + reach) % around

        def found(values: AnyFloats, power: float = 1.0) -> Floats:
            return convolve(np.asarray(values, np.float64)[:, columns], power)[
                :, reach + np.arange(nx) % around
            ]

        return found

    def _by_latitudes(self, sigma: float) -> Smoother:
        """Smoother of a large CAR image: by rows, but near the poles pixel by pixel. InputError
        where that would take hours.
        """
        ny, nx = self.grid.shape
        with np.errstate(divide="ignore", invalid="ignore"):
            steep = ~(sigma * np.tan(abs(self.grid.latitudes)) < STEEP)
        rows, halo = (
            self._by_rows(sigma, both=True),
            math.ceil(1.1 * CUT * sigma / abs(float(self.grid.matrix[1, 1]))) + 2,
        )
        edges = np.flatnonzero(np.diff(np.concatenate([[0], steep.view(np.int8), [0]]))).reshape(
            -1, 2
        )
        if (pairs := float(steep.sum()) * nx * nx * 2 * halo) > MOST_DIRECT:
            text = (
                f"a CAR map of {nx} x {ny} pixels that holds a pole, smoothed by"
                f" {angle_text(sigma * FWHM_PER_SIGMA)}"
            )
            cure = "smooth it less, cut the pole off, or make a HEALPix map (nside)"
            raise InputError(
                f"{text}, would take {pairs / 1e12:.2g} hours", place="smoothing", cure=cure
            )

        def found(values: AnyFloats, power: float = 1.0) -> Floats:
            out = rows(values, power)
            for first, stop in edges:
                low, high = max(int(first) - halo, 0), min(int(stop) + halo, ny)
                own, whole = slice(int(first) - low, int(stop) - low), slice(0, nx)
                part = ImageSmoothing(self.grid.window(slice(low, high), whole))._directly(
                    sigma, (own, whole)
                )
                out[first:stop] = part(np.asarray(values)[low:high], power)[own]
            return out

        return found

    @property
    def even(self) -> bool:
        """True if all pixels have the same steps along its axes, to `EVEN`: one kernel serves
        all.
        """
        return self._even() is not None

    def _even(self) -> tuple[float, float] | None:
        """Steps (y, x) that hold for all pixels to `EVEN`, whose axes are at right angles; None:
        they differ.
        """
        if 0 < self.grid.around <= self.grid.shape[1]:
            return None
        xx, xy, yy = self.grid.scattered_metric
        reference = tuple(float(v) for v in np.sqrt((self.grid.matrix**2).sum(axis=0))[::-1])
        for dy, dx in (reference, self.grid.sides):
            with np.errstate(invalid="ignore"):
                same = (
                    (abs(np.sqrt(xx) / dx - 1) < EVEN)
                    & (abs(np.sqrt(yy) / dy - 1) < EVEN)
                    & (abs(xy) < SKEW / 2 * dx * dy)
                )
            if same.all():
                return dy, dy if abs(dx / dy - 1) < 1e-9 else dx
        return None

    def _directly(self, sigma: float, within: tuple[slice, slice] | None = None) -> Smoother:
        """Equation (2) as it stands: each pixel with its own kernel. ``within``: only for these
        rows and columns.
        """
        ny, nx = self.grid.shape
        whole = 0 < self.grid.around <= nx
        columns = self.grid.around if whole else nx
        directions = np.ascontiguousarray(self.grid.directions()[:, :columns])
        areas = np.ascontiguousarray(
            np.nan_to_num(np.broadcast_to(self.grid.areas, self.grid.shape)[:, :columns])
        )
        farthest = columns // 2 if whole else columns
        down, across = within or (slice(0, ny), slice(0, columns))
        begin, end = (down.start, across.start), (down.stop, min(across.stop, columns))
        reach = np.zeros((2, ny, columns), np.int32)
        for first in range(0, ny, ROWS):
            rows = np.arange(first, min(first + ROWS, ny), dtype=np.float64)
            xx, xy, yy = self.grid.metric(np.arange(columns, dtype=np.float64), rows[:, None])
            with np.errstate(invalid="ignore", divide="ignore"):
                wide = 1.1 * CUT * sigma * np.sqrt(np.stack([yy, xx]) / (xx * yy - xy**2)) + 1
                if self.grid.cylinder:  # meridians meet: a circle about the pole has all columns
                    side = abs(float(self.grid.matrix[0, 0]))
                    share = math.sin(min(CUT * sigma, math.pi / 2)) / (np.sqrt(xx) / side)
                    wide[0] = np.where(
                        share < 1, np.arcsin(np.minimum(share, 1.0)) / side + 1, np.inf
                    )
            wide = np.where(np.isnan(wide), 0.0, wide)
            reach[:, first : first + ROWS] = np.minimum(
                wide, np.array([farthest, ny])[:, None, None]
            )

        def found(values: AnyFloats, power: float = 1.0) -> Floats:
            own = np.ascontiguousarray(values[:, :columns], np.float64)
            out = smooth_directly(
                own, directions, areas, reach, whole, sigma, power, table(power), begin, end
            )
            return np.asarray(out[:, np.arange(nx) % columns] if nx > columns else out, np.float64)

        return found


@dataclass(frozen=True)
class HealpixSmoothing:
    """Smoothing of HEALPix maps: pair by pair, or by harmonics of the whole sphere."""

    grid: HealpixPixels

    def smoother(self, fwhm: float) -> Smoother:
        sigma = fwhm / FWHM_PER_SIGMA / self.grid.sides[0]
        if (
            len(self.grid.pixels) * math.pi * (CUT * sigma) ** 2 < MOST_PAIRS
            or self.grid.nside > LARGEST_NSIDE
        ):
            return self._directly(fwhm / FWHM_PER_SIGMA)

        def found(values: AnyFloats, power: float = 1.0) -> Floats:
            import healpy

            whole = np.zeros(healpy.nside2npix(self.grid.nside))
            whole[self.grid.pixels] = values
            if self.grid.nest:
                whole = healpy.reorder(whole, n2r=True)
            whole = healpy.smoothing(whole, fwhm=fwhm / math.sqrt(power), iter=3)
            if self.grid.nest:
                whole = healpy.reorder(whole, r2n=True)
            kept: Floats = whole[self.grid.pixels] * (4 * math.pi * sigma**2) ** (1 - power)
            return kept

        return found

    def _directly(self, sigma: float) -> Smoother:
        """Equation (2) as it stands: of few pixels, or of a part of a sphere that is too fine for
        harmonics of the whole.
        """
        from scipy.spatial import cKDTree

        directions = self.grid.directions()
        tree, scale = cKDTree(directions), float(self.grid.areas[0]) / (2 * math.pi * sigma**2)

        def found(values: AnyFloats, power: float = 1.0) -> Floats:
            out = np.zeros(len(directions))
            rows = max(1, round(1e6 / max(1.0, math.pi * (CUT * sigma / self.grid.sides[0]) ** 2)))
            for first in range(0, len(directions), rows):
                part = cKDTree(directions[first : first + rows])
                near = part.sparse_distance_matrix(tree, CUT * sigma, output_type="ndarray")
                chord = near["v"] ** 2
                kernel = np.exp(-power * chord * (1 + chord / 12) / (2 * sigma**2))
                out[first : first + rows] = np.bincount(
                    near["i"], kernel * values[near["j"]], part.n
                )
            return np.asarray(out * scale**power, np.float64)

        return found


def table(power: float) -> Floats:
    """(STEPS + 2,) exp(-power u) at u = 0 ... `DEEPEST`."""
    return np.asarray(np.exp(-power * DEEPEST / STEPS * np.arange(STEPS + 2)), np.float64)


@kernel
def smooth_directly(  # type: ignore[no-untyped-def]
    values, d, areas, reach, whole, sigma, power, gaussian, first, stop
):
    """sum_q K_pq^power values_q (ny, nx) for pixels from (row, column) ``first`` to before
    ``stop``; others are 0.

    ``d`` (ny, nx, 3) directions, NaN off the sky; ``areas`` (ny, nx) [sr]; ``reach`` (2, ny, nx)
    columns and rows to look at on either side; ``whole``: the last column is beside the first one.
    """
    ny, nx = values.shape
    out = np.zeros((ny, nx))
    for y in range(first[0], stop[0]):
        for x in range(first[1], stop[1]):
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
