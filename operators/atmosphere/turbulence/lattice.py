"""A turbulent layer at random access on an unlimited plane: a pyramid of Gaussian scale mixtures.

The beam-convolved von Karman spectrum is a mixture of Gaussians exp(-e k^2) (`covariance`, equation 4). Level j of the
pyramid takes those with e up to (2 d_j / c)^2 on a lattice of spacing d_j = 2^j metres: white noise, addressed by absolute
lattice index, convolved with a compact kernel of radius R cells. Levels are summed from coarse to fine with x2 kriging
interpolation of L taps:

    f_j = noise_j * h_j + up2(f_(j+1)),            |FFT h_j|^2 = aliased spectrum of the level                     (1)

Every sum runs over a fixed list of taps in a fixed order, so a lattice point has the same bits in whatever region it is
asked for. The beam costs nothing and is exact; no matrix is inverted and nothing is periodic.

Behind an aperture with a rim (`beams`) the finest level takes what two Gaussians leave of the footprint's spectrum.

Largest error of the implied covariance C, relative to the variance, and of the implied structure function S, relative to
itself and from one cell up (computed exactly, not sampled; `benchmarks/atmosphere.py`), against r0 / sigma:

=========================  ======  ======  ======  ======  ======  ======  ======
R, L, c                    0.001   1       30      100     1e3     1e4     1e6
=========================  ======  ======  ======  ======  ======  ======  ======
default, 8, 10, 0.8: C     1.4e-5  7.4e-4  3.7e-4  3.9e-4  3.5e-4  3.3e-4  3.4e-4
default, 8, 10, 0.8: S     1.4e-5  8.0e-4  3.5e-4  3.5e-4  3.2e-4  3.0e-4  3.5e-4
fine, 12, 12, 0.7: C       2.8e-5  2.1e-5  4.6e-5  4.8e-5  4.3e-5  4.7e-5  4.7e-5
fine, 12, 12, 0.7: S       2.5e-5  3.4e-5  5.0e-5  5.3e-5  5.7e-5  6.1e-5  5.0e-4
=========================  ======  ======  ======  ======  ======  ======  ======
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from zonda.core.compilation.columns import fused
from zonda.core.compilation.jit import nb
from zonda.core.errors import InputError
from zonda.core.numerics.random import lattice_normals, stream_key
from zonda.core.types import Floats

from .beams import Aperture
from .covariance import NU, beam_correlation, mixture_between, spectrum_between

Field = NDArray[np.float32]

SMALLEST_RATIO, LARGEST_RATIO = 1e-3, 1e6
"""Outer scale / sigma of the beam: the range over which the error was measured."""

LARGEST_SCALE = 20.0
"""The mixture is cut at s = 20 r0^2: 2e-9 of the variance lies beyond."""

PREFILTER = 10
"""Half-length of the finite cubic-spline prefilter: its truncation is 3e-6 at the shortest wavelength, less elsewhere."""

_GRID = 96

_NEGLIGIBLE = 40.0
"""exp(-40) is 4e-18."""

_stream_key = lru_cache(maxsize=1024)(stream_key)


@dataclass(frozen=True)
class Fidelity:
    """Kernel radius R [cells], interpolation taps L and resolution c of the pyramid, and its measured error."""

    name: str
    radius: int
    taps: int
    resolution: float
    error: float
    """Largest error of the implied covariance, relative to the variance."""
    structure_error: float
    """Largest relative error of the implied structure function, from one cell up."""
    lattice: float
    """Largest spacing, in units of the beam's sigma."""


FIDELITIES = {
    "default": Fidelity("default", 8, 10, 0.8, 8e-4, 1e-3, 0.8),
    "fine": Fidelity("fine", 12, 12, 0.7, 1e-4, 6e-4, 0.5),
}


@dataclass(frozen=True)
class Level:
    """One lattice: spacing 2^exponent m; kernel (R + 1, R + 1), quadrant of the symmetric h_j; None: nothing at this scale."""

    exponent: int
    kernel: Field | None

    @property
    def spacing(self) -> float:
        return math.ldexp(1.0, self.exponent)


class Turbulence:
    """One layer: a Gaussian field of covariance `covariance.beam_correlation`, on a lattice of `spacing` metres.

    Parameters
    ----------
    seed, names
        What the random stream belongs to (`core.numerics.random.stream_key`). Lattices are powers of two metres whatever the
        beam, so two beams that look through the same stream see the same air.
    outer_scale, sigma
        r0 and the Gaussian beam's standard deviation, m.
    aperture
        A footprint with a rim instead of the Gaussian (`beams`).
    lattice
        Largest spacing, in units of sigma; that of the fidelity where absent. At most 0.5 of the sigma of the Gaussian of equal
        second moment behind an aperture, whose rim leaves finer structure.
    fidelity
        ``default`` or ``fine``, see the table above.

    Raises
    ------
    InputError
        Where the measured error of the pyramid does not cover the outer scale and beam.
    """

    def __init__(
        self,
        seed: int,
        *names: str | int,
        outer_scale: float,
        sigma: float = 0.0,
        aperture: Aperture | None = None,
        lattice: float | None = None,
        fidelity: str = "default",
    ) -> None:
        sigma = aperture.sigma if aperture else sigma
        self.outer_scale, self.sigma, self.aperture, self.fidelity = outer_scale, sigma, aperture, FIDELITIES[fidelity]
        if not (np.isfinite([outer_scale, sigma]).all() and outer_scale > 0 and sigma > 0):
            raise InputError(
                f"outer scale {outer_scale:g} m and beam {sigma:g} m must be finite and positive", place="turbulence"
            )
        lattice = lattice or self.fidelity.lattice
        ratio = outer_scale / sigma
        if not SMALLEST_RATIO <= ratio <= LARGEST_RATIO:
            raise InputError(
                f"outer scale {outer_scale:g} m is {ratio:.3g} times the beam's sigma of {sigma:.3g} m; the error of the "
                f"turbulence is known from {SMALLEST_RATIO:g} to {LARGEST_RATIO:g}",
                place="turbulence",
                cure=f"choose an outer_scale from {SMALLEST_RATIO * sigma:.2g} m to {LARGEST_RATIO * sigma:.2g} m",
            )
        if aperture:
            self.levels = _aperture_levels(outer_scale, aperture, lattice, fidelity)
        else:
            self.levels = _levels(outer_scale, sigma, lattice, fidelity)
        self.spacing = self.levels[0].spacing
        self._keys = [_stream_key(seed, *names, "level", level.exponent) for level in self.levels]
        self._weights = _kriging(self.fidelity.taps, self.fidelity.resolution)

    @cached_property
    def variance(self) -> float:
        """Variance after the beam (1 before it)."""
        if self.aperture:
            return self.aperture.variance(self.outer_scale)
        return float(beam_correlation(0.0, self.outer_scale, self.sigma)[0])

    def region(self, i0: int, i1: int, j0: int, j1: int) -> Field:
        """The field at lattice points i0 <= i < i1, j0 <= j < j1 (any integers). Shape (i1 - i0, j1 - j0), float32."""
        pad = self.fidelity.taps // 2
        boxes = [(i0, i1, j0, j1)]
        for _ in self.levels[1:]:
            a, b, c, d = boxes[-1]
            boxes.append(((a >> 1) - pad + 1, ((b - 1) >> 1) + pad + 1, (c >> 1) - pad + 1, ((d - 1) >> 1) + pad + 1))
        field: Field | None = None
        for k in range(len(self.levels) - 1, -1, -1):
            a, b, c, d = boxes[k]
            here = np.zeros((b - a, d - c), np.float32)
            if field is not None:
                _upsample(field, boxes[k + 1][0], boxes[k + 1][2], self._weights, here, a, c)
            kernel = self.levels[k].kernel
            if kernel is not None:
                radius = len(kernel) - 1
                noise = lattice_normals(self._keys[k], a - radius, b + radius, c - radius, d + radius)
                _convolve(noise, kernel, here)
            field = here
        assert field is not None
        return field

    def coefficients(self, i0: int, i1: int, j0: int, j1: int) -> Field:
        """Cubic B-spline coefficients at lattice points, so that the spline passes through the field. As `region`."""
        h = PREFILTER
        out = np.empty((i1 - i0, j1 - j0), np.float32)
        _prefilter(self.region(i0 - h, i1 + h, j0 - h, j1 + h), _prefilter_taps(), out)
        return out

    def implied_covariance(self, a: NDArray[np.integer], b: NDArray[np.integer]) -> Floats:
        """Exact covariance of the float32-free algorithm between lattice points ``a`` and ``b``, each (n, 2). Shape (n,)."""
        a, b = np.atleast_2d(a), np.atleast_2d(b)
        out = np.zeros(len(a))
        for k, level in enumerate(self.levels):
            if level.kernel is None:
                continue
            r = len(level.kernel) - 1
            h = np.zeros((4 * r + 2, 4 * r + 2))
            index = np.arange(-r, r + 1)
            h[np.ix_(index, index)] = level.kernel[np.ix_(abs(index), abs(index))]
            auto = np.fft.irfft2(abs(np.fft.rfft2(h)) ** 2, h.shape)
            known: dict[tuple[int, int], tuple[NDArray[np.int64], Floats]] = {}
            for n in range(len(a)):
                ends = [(int(a[n, axis]), int(b[n, axis])) for axis in (0, 1)]
                for pair in set(ends) - set(known):
                    known[pair] = self._lags(*pair, k)
                lags = [known[pair] for pair in ends]
                (u, wu), (v, wv) = ((lag[abs(lag) <= 2 * r], w[abs(lag) <= 2 * r]) for lag, w in lags)
                out[n] += wu @ auto[np.ix_(u, v)] @ wv
        return out

    def _lags(self, a: int, b: int, k: int) -> tuple[NDArray[np.int64], Floats]:
        """Lags on level k between the lattice points that a and b of level 0 are interpolated from (one axis), and weights."""
        (xa, wa), (xb, wb) = self._sources(a, k), self._sources(b, k)
        lag, inverse = np.unique(np.subtract.outer(xa, xb), return_inverse=True)
        weight = np.bincount(inverse.ravel(), np.multiply.outer(wa, wb).ravel())
        return np.asarray(lag, np.int64), np.asarray(weight, np.float64)

    def _sources(self, index: int, k: int) -> tuple[NDArray[np.int64], Floats]:
        weights, half = self._weights.astype(np.float64), self.fidelity.taps // 2
        points = {index: 1.0}
        for _ in range(k):
            coarse: dict[int, float] = {}
            for i, w in points.items():
                if i & 1 == 0:
                    coarse[i >> 1] = coarse.get(i >> 1, 0.0) + w
                else:
                    for tap in range(2 * half):
                        at = (i >> 1) - half + 1 + tap
                        coarse[at] = coarse.get(at, 0.0) + w * weights[tap]
            points = coarse
        return np.array(list(points), np.int64), np.array(list(points.values()))


@lru_cache(maxsize=256)
def _levels(outer_scale: float, sigma: float, lattice: float, fidelity: str) -> tuple[Level, ...]:
    f = FIDELITIES[fidelity]
    exponent = math.floor(math.log2(lattice * sigma))
    low, top = sigma**2, LARGEST_SCALE * outer_scale**2 + sigma**2
    levels = []
    while low < top:
        high = min((2 * math.ldexp(1.0, exponent) / f.resolution) ** 2, top)
        kernel = None
        if high > low:
            kernel = _kernel(outer_scale, sigma, low, high, math.ldexp(1.0, exponent), f.radius)
            low = high
        levels.append(Level(exponent, kernel))
        exponent += 1
    return tuple(levels)


@lru_cache(maxsize=64)
def _aperture_levels(outer_scale: float, aperture: Aperture, lattice: float, fidelity: str) -> tuple[Level, ...]:
    """As `_levels`; the mixture beyond s_0 = sigma^2 is seen through `Aperture.gaussians`, all else by the finest level."""
    f = FIDELITIES[fidelity]
    exponent = math.floor(math.log2(aperture.sigma * min(lattice, 0.5)))
    low, top = aperture.sigma**2, LARGEST_SCALE * outer_scale**2
    levels = [Level(exponent, _aperture_kernel(outer_scale, aperture, low, math.ldexp(1.0, exponent), f))]
    while low < top:
        exponent += 1
        spacing, kernel = math.ldexp(1.0, exponent), None
        high = min((2 * spacing / f.resolution) ** 2 - aperture.sigma**2, top)
        if high > low:
            s, w = mixture_between(outer_scale, 0.0, low, high)
            e = np.concatenate([s + square for _, square in aperture.gaussians])
            kernel = _separable_kernel(e, np.concatenate([c * w for c, _ in aperture.gaussians]), spacing, f.radius)
            low = high
        levels.append(Level(exponent, kernel))
    return tuple(levels)


def _aperture_kernel(outer_scale: float, aperture: Aperture, split: float, spacing: float, f: Fidelity) -> Field:
    """The finest level behind an aperture: B^2 P for s < split, and what equation (3) of `beams` leaves for s > split."""
    radius = math.ceil((aperture.diameter / 2 + 0.4 * f.radius * math.sqrt(split)) / spacing)
    grid = 4 * (radius + 8)
    k = 2 * np.pi * np.fft.fftfreq(grid, spacing)[: grid // 2 + 1]
    alias = 2 * np.pi / spacing * np.arange(-2, 3)
    square = np.add.outer(alias, k) ** 2
    k2 = square[:, :, None, None] + square
    beam = aperture.transform(np.sqrt(k2))
    left = beam**2 - sum(c * np.exp(-s * k2) for c, s in aperture.gaussians)
    below, above = spectrum_between(k2, outer_scale, split)
    # Where the beam of `gaussians` exceeds the aperture's own, at its zeros, there is a little too much to take away: what is cut
    # is below 2e-4 of this level's power for a top hat, 2e-6 for tapers of 10 dB (3 to 100 m, outer scales of 10 to 1000 m).
    power = np.maximum(beam**2 * below + left * above, 0.0).sum((0, 2)) / spacing**2
    quarter = np.sqrt(power) * np.sign(beam[2, :, 2])
    index = np.minimum(np.arange(grid), grid - np.arange(grid))
    h = np.fft.irfft2(quarter[index], (grid, grid))[: radius + 1, : radius + 1]
    return _cut(h, float(power[np.ix_(index, index)].mean()))


def _kernel(outer_scale: float, sigma: float, low: float, high: float, spacing: float, radius: int) -> Field:
    """Quadrant (R + 1, R + 1) of the kernel whose power is the aliased spectrum of low <= e < high, cut at R cells."""
    return _separable_kernel(*mixture_between(outer_scale, sigma, low, high), spacing, radius)


def _separable_kernel(e: Floats, w: Floats, spacing: float, radius: int) -> Field:
    """The kernel whose power is the aliased spectrum sum w exp(-e k^2)."""
    k = 2 * np.pi * np.fft.rfftfreq(_GRID, spacing)  # the spectrum is even
    alias = 2 * np.pi / spacing * np.arange(-2, 3)
    square = np.add.outer(alias, k) ** 2
    own, others = square[2].max(), square.min(1)
    heard = others <= own + _NEGLIGIBLE / e.min()  # of the images, those that are not lost beside the wave itself
    gauss = np.exp(-np.multiply.outer(e, square[heard])).sum(1)
    power = np.einsum("ka,kb->ab", gauss * w[:, None], gauss) / spacing**2  # not BLAS: the same bits for any number of threads
    turns = _cosines(radius)
    h = np.einsum("ra,ac->rc", turns, np.einsum("ab,cb->ac", np.sqrt(power), turns))
    return _cut(h, float((w / (4 * np.pi * e)).sum()))


@lru_cache(maxsize=8)
def _cosines(radius: int) -> Floats:
    """The inverse transform (radius + 1, _GRID / 2 + 1) of an even spectrum of which half is given."""
    index = np.arange(_GRID // 2 + 1)
    times = np.where((index == 0) | (index == index[-1]), 1.0, 2.0) / _GRID
    return np.asarray(np.cos(2 * np.pi / _GRID * np.multiply.outer(np.arange(radius + 1), index)) * times, np.float64)


def _cut(h: Floats, variance: float) -> Field:
    """Cut to a circle and scale to the variance."""
    index = np.arange(len(h))
    h = np.where(np.hypot(index[:, None], index) <= len(h) - 1, h, 0.0)
    times = np.where(index > 0, 2.0, 1.0)
    total = times @ (h * h) @ times
    return np.ascontiguousarray(h * math.sqrt(variance / total), np.float32)


@lru_cache(maxsize=8)
def _kriging(taps: int, resolution: float) -> Field:
    """Weights that predict the middle of two lattice points from ``taps`` neighbours: best for the sum of coarser levels.

    Ordinary kriging: the weights sum to 1. A field that hardly varies between lattice points (an outer scale of many cells)
    passes through twenty levels unharmed; weights off by 1e-4 would swamp the structure function at one cell.
    """
    x: Floats = np.arange(taps, dtype=np.float64) - (taps - 1) / 2
    octaves = np.arange(4)

    def model(r: Floats) -> Floats:
        scale, weight = 2 ** (-octaves / 2), 2 ** (NU * octaves)
        return np.asarray((np.exp(-((np.multiply.outer(r, scale) * resolution / 2) ** 2)) * weight).sum(-1), np.float64)

    between = model(np.asarray(x[:, None] - x, np.float64))
    system = np.ones((taps + 1, taps + 1))
    system[:taps, :taps] = between + 1e-12 * between[0, 0] * np.eye(taps)
    system[taps, taps] = 0
    return np.asarray(np.linalg.solve(system, np.append(model(x), 1.0))[:taps], np.float32)


@lru_cache(maxsize=1)
def _prefilter_taps() -> Field:
    """One-sided inverse of (1, 4, 1) / 6, cut at `PREFILTER` and normalized to unit sum. Shape (PREFILTER + 1,)."""
    taps = np.sqrt(3.0) * (np.sqrt(3.0) - 2.0) ** np.arange(PREFILTER + 1)
    return np.asarray(taps / (taps[0] + 2 * taps[1:].sum()), np.float32)


# No fastmath in the kernels: a compiler that may fuse or reorder could give a point other bits at the end of a row. What is
# fused is fused by name.


@nb.njit(nogil=True, cache=True, boundscheck=False)
def _add_symmetric(row, taps, out):  # type: ignore[no-untyped-def]
    """out[j] += taps[0] row[j + R] + sum_k taps[k] (row[j + R - k] + row[j + R + k]); R = taps.size - 1. Four taps at a time."""
    radius, n = taps.size - 1, nb.uint64(out.size)
    middle, weight = row[radius:], taps[0]
    for j in range(n):
        out[j] += weight * middle[j]
    k = 1
    while k + 3 <= radius:
        a, b, c, d = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        a0, b0, c0, d0 = row[radius - k :], row[radius - k - 1 :], row[radius - k - 2 :], row[radius - k - 3 :]
        a1, b1, c1, d1 = row[radius + k :], row[radius + k + 1 :], row[radius + k + 2 :], row[radius + k + 3 :]
        for j in range(n):
            near = fused(a, a0[j] + a1[j], fused(b, b0[j] + b1[j], out[j]))
            out[j] = fused(c, c0[j] + c1[j], fused(d, d0[j] + d1[j], near))
        k += 4
    while k <= radius:
        weight, left, right = taps[k], row[radius - k :], row[radius + k :]
        for j in range(n):
            out[j] = fused(weight, left[j] + right[j], out[j])
        k += 1


@nb.njit(nogil=True, cache=True, boundscheck=False)
def _convolve(noise, kernel, out):  # type: ignore[no-untyped-def]
    """out += noise * kernel; ``noise`` has R more cells on every side, ``kernel`` is a symmetric quadrant (R + 1, R + 1)."""
    radius = kernel.shape[0] - 1
    rows = np.empty(noise.shape[1], np.float32)
    m = nb.uint64(rows.size)
    for i in range(out.shape[0]):
        for di in range(radius + 1):
            above, below = noise[i + radius - di], noise[i + radius + di]
            if di == 0:
                for j in range(m):
                    rows[j] = above[j]
            else:
                for j in range(m):
                    rows[j] = above[j] + below[j]
            taps = kernel[di]
            size = radius + 1
            while size > 1 and taps[size - 1] == 0:  # the kernel is cut to a circle
                size -= 1
            _add_symmetric(rows[radius + 1 - size :], taps[:size], out[i])


@nb.njit(nogil=True, cache=True, boundscheck=False)
def _upsample(coarse, ci, cj, weights, out, fi, fj):  # type: ignore[no-untyped-def]
    """out += x2 kriging interpolation; (ci, cj) and (fi, fj) are the absolute indices of the arrays' first points."""
    half = weights.size // 2
    n_i, n_j = out.shape
    row = np.empty(coarse.shape[1], np.float32)
    odd = np.empty(coarse.shape[1], np.float32)
    span = nb.uint64(coarse.shape[1] - 2 * half + 1)
    for i in range(n_i):
        at = ((fi + i) >> 1) - ci
        if (fi + i) & 1 == 0:
            source = coarse[at]
            for j in range(nb.uint64(row.size)):
                row[j] = source[j]
        else:
            for j in range(nb.uint64(row.size)):
                row[j] = 0
            for tap in range(half):
                weight = weights[tap]
                one, two = coarse[at - half + 1 + tap], coarse[at + half - tap]
                for j in range(nb.uint64(row.size)):
                    row[j] += weight * (one[j] + two[j])
        # odd[j] lies between row[j + half - 1] and row[j + half]
        for j in range(span):
            odd[j] = 0
        for tap in range(half):
            weight = weights[tap]
            one, two = row[tap:], row[2 * half - 1 - tap :]
            for j in range(span):
                odd[j] += weight * (one[j] + two[j])
        target = out[i]
        first = fj & 1
        start = ((fj + first) >> 1) - cj
        for j in range((n_j - first + 1) // 2):
            target[first + 2 * j] += row[start + j]
        first = 1 - first
        start = ((fj + first) >> 1) - cj - half + 1
        for j in range((n_j - first + 1) // 2):
            target[first + 2 * j] += odd[start + j]


@nb.njit(nogil=True, cache=True, boundscheck=False)
def _prefilter(field, taps, out):  # type: ignore[no-untyped-def]
    """Separable symmetric filter; ``field`` has taps.size - 1 more cells on every side than ``out``."""
    half = taps.size - 1
    row = np.empty(field.shape[1], np.float32)
    m = nb.uint64(row.size)
    for i in range(out.shape[0]):
        source, weight = field[i + half], taps[0]
        for j in range(m):
            row[j] = weight * source[j]
        for tap in range(1, half, 2):
            a, b = taps[tap], taps[tap + 1]
            a0, a1, b0, b1 = field[i + half - tap], field[i + half + tap], field[i + half - tap - 1], field[i + half + tap + 1]
            for j in range(m):
                row[j] = fused(a, a0[j] + a1[j], fused(b, b0[j] + b1[j], row[j]))
        target = out[i]
        for j in range(nb.uint64(out.shape[1])):
            target[j] = 0
        _add_symmetric(row, taps, target)
