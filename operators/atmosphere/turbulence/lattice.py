"""A turbulent layer at random access on an unlimited plane: a pyramid of Gaussian scale mixtures.

The beam-convolved von Karman spectrum is a mixture of Gaussians exp(-e k^2) (`covariance`, equation
4). Level j of the pyramid takes those with e up to (2 d_j / c)^2 on a lattice of spacing d_j = 2^j
metres: white noise, addressed by absolute lattice index, convolved with a compact kernel of radius
R cells. Levels are summed from coarse to fine with x2 kriging interpolation of L taps:

    f_j = noise_j * h_j + up2(f_(j+1)),
    |FFT h_j|^2 = aliased spectrum of the level                     (1)

Every sum runs over a fixed list of taps in a fixed order, so a lattice point has the same bits in
whatever region it is evaluated. The beam costs nothing and is exact; no matrix is inverted and
nothing is periodic.

Behind an aperture with a rim (`beams`) the finest level takes what two Gaussians leave of the
footprint's spectrum. What the kernels are, and how well the covariance holds: `levels`.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cached_property, lru_cache

import numba as nb
import numpy as np

from zonda.core.errors import InputError
from zonda.core.kernels import kernel
from zonda.core.numerics.columns import fused
from zonda.core.numerics.random import lattice_normals, stream_key

from .beams import Aperture
from .covariance import beam_correlation
from .levels import (
    FIDELITIES,
    PREFILTER,
    Field,
    aperture_levels,
    gaussian_levels,
    kriging,
    prefilter_taps,
)

SMALLEST_RATIO, LARGEST_RATIO = 1e-3, 1e6
"""Outer scale / sigma of the beam: the range over which the error was measured."""

_stream_key = lru_cache(maxsize=1024)(stream_key)


class Turbulence:
    """One layer: a Gaussian field of covariance `covariance.beam_correlation`, on a lattice of
    `spacing` metres.

    Parameters
    ----------
    seed, names
        What the random stream belongs to (`core.numerics.random.stream_key`). Lattices are powers
        of two metres whatever the beam, so two beams that look through the same stream see the same
        air.
    outer_scale, sigma
        r0 and the Gaussian beam's standard deviation, m.
    aperture
        A footprint with a rim instead of the Gaussian (`beams`).
    lattice
        Largest spacing, in units of sigma; that of the fidelity where absent. At most 0.5 of the
        sigma of the Gaussian of equal second moment behind an aperture, whose rim leaves finer
        structure.
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
        self.outer_scale = outer_scale
        self.sigma = sigma
        self.aperture = aperture
        self.fidelity = FIDELITIES[fidelity]
        if not (np.isfinite([outer_scale, sigma]).all() and outer_scale > 0 and sigma > 0):
            raise InputError(
                f"outer scale {outer_scale:g} m and beam {sigma:g} m must be finite and positive",
                place="turbulence",
            )
        lattice = lattice or self.fidelity.lattice
        ratio = outer_scale / sigma
        if not SMALLEST_RATIO <= ratio <= LARGEST_RATIO:
            raise InputError(
                f"outer scale {outer_scale:g} m is {ratio:.3g} times the beam's sigma of"
                f" {sigma:.3g} m; the error of the turbulence is known from {SMALLEST_RATIO:g} to"
                f" {LARGEST_RATIO:g}",
                place="turbulence",
                cure=(
                    f"choose an outer_scale from {SMALLEST_RATIO * sigma:.2g} m to"
                    f" {LARGEST_RATIO * sigma:.2g} m"
                ),
            )
        if aperture:
            self.levels = aperture_levels(outer_scale, aperture, lattice, fidelity)
        else:
            self.levels = gaussian_levels(outer_scale, sigma, lattice, fidelity)
        self.spacing = self.levels[0].spacing
        self._keys = [_stream_key(seed, *names, "level", level.exponent) for level in self.levels]
        self.weights = kriging(self.fidelity.taps, self.fidelity.resolution)

    @cached_property
    def variance(self) -> float:
        """Variance after the beam (1 before it)."""
        if self.aperture:
            return self.aperture.variance(self.outer_scale)
        return float(beam_correlation(0.0, self.outer_scale, self.sigma)[0])

    def alike(self, other: Turbulence) -> bool:
        """True if another field is a convolution of the same random numbers with kernels of the
        same shapes.
        """
        if len(self.levels) != len(other.levels) or not np.array_equal(self._keys, other._keys):
            return False
        pairs = zip(self.levels, other.levels, strict=True)
        return self.fidelity is other.fidelity and all(
            _same_taps(a.kernel, b.kernel) for a, b in pairs
        )

    def region(self, i0: int, i1: int, j0: int, j1: int) -> Field:
        """The field at lattice points i0 <= i < i1, j0 <= j < j1 (any integers). Shape (i1 - i0, j1
        - j0), float32.
        """
        found: Field = _regions([self], i0, i1, j0, j1)[0]
        return found

    def coefficients(self, i0: int, i1: int, j0: int, j1: int) -> Field:
        """Cubic B-spline coefficients at lattice points, so that the spline passes through the
        field. As `region`.
        """
        return coefficients([self], i0, i1, j0, j1)[0]


def coefficients(fields: Sequence[Turbulence], i0: int, i1: int, j0: int, j1: int) -> list[Field]:
    """`Turbulence.coefficients` of fields that are `alike`: each has the bits that it has alone."""
    h = PREFILTER
    out = [np.empty((i1 - i0, j1 - j0), np.float32) for _ in fields]
    for field, made in zip(_regions(fields, i0 - h, i1 + h, j0 - h, j1 + h), out, strict=True):
        _prefilter(field, prefilter_taps(), made)
    return out


def _regions(fields: Sequence[Turbulence], i0: int, i1: int, j0: int, j1: int) -> Field:
    """`Turbulence.region` of fields that are `alike`, (n_field, i1 - i0, j1 - j0): their random
    numbers are drawn once.
    """
    first = fields[0]
    pad = first.fidelity.taps // 2
    boxes = [(i0, i1, j0, j1)]
    for _ in first.levels[1:]:
        a, b, c, d = boxes[-1]
        boxes.append(
            (
                (a >> 1) - pad + 1,
                ((b - 1) >> 1) + pad + 1,
                (c >> 1) - pad + 1,
                ((d - 1) >> 1) + pad + 1,
            )
        )
    coarse: Field | None = None
    for k in range(len(boxes) - 1, -1, -1):
        a, b, c, d = boxes[k]
        here = np.zeros((len(fields), b - a, d - c), np.float32)
        if coarse is not None:
            for source, target in zip(coarse, here, strict=True):
                _upsample(source, boxes[k + 1][0], boxes[k + 1][2], first.weights, target, a, c)
        kernels = [kernel for field in fields if (kernel := field.levels[k].kernel) is not None]
        if kernels:
            radius = len(kernels[0]) - 1
            noise = lattice_normals(first._keys[k], a - radius, b + radius, c - radius, d + radius)
            _convolve(noise, np.stack(kernels), here)
        coarse = here
    assert coarse is not None
    return coarse


def _same_taps(one: Field | None, other: Field | None) -> bool:
    """True if two kernels have the same taps, with any weights: sums are then made in the same
    order.
    """
    if one is None or other is None:
        return one is other
    return one.shape == other.shape and np.array_equal(one == 0, other == 0)


# No fastmath in the kernels: a compiler that may fuse or reorder could give a point other bits at
# the end of a row. What is fused is fused by name.


@kernel(error_model="python")
def _add_symmetric(row, taps, out):  # type: ignore[no-untyped-def]
    """out[j] += taps[0] row[j + R] + sum_k taps[k] (row[j + R - k] + row[j + R + k]); R = taps.size
    - 1. Four taps at a time.
    """
    radius, n = taps.size - 1, nb.uint64(out.size)
    middle, weight = row[radius:], taps[0]
    for j in range(n):
        out[j] += weight * middle[j]
    k = 1
    while k + 3 <= radius:
        a, b, c, d = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        a0, b0, c0, d0 = (
            row[radius - k :],
            row[radius - k - 1 :],
            row[radius - k - 2 :],
            row[radius - k - 3 :],
        )
        a1, b1, c1, d1 = (
            row[radius + k :],
            row[radius + k + 1 :],
            row[radius + k + 2 :],
            row[radius + k + 3 :],
        )
        for j in range(n):
            near = fused(a, a0[j] + a1[j], fused(b, b0[j] + b1[j], out[j]))
            out[j] = fused(c, c0[j] + c1[j], fused(d, d0[j] + d1[j], near))
        k += 4
    while k <= radius:
        weight, left, right = taps[k], row[radius - k :], row[radius + k :]
        for j in range(n):
            out[j] = fused(weight, left[j] + right[j], out[j])
        k += 1


@kernel(error_model="python")
def _add_two_symmetric(row, taps, others, out, other):  # type: ignore[no-untyped-def]
    """`_add_symmetric` with two sets of taps: to ``out`` and to ``other`` at once, each in the same
    order.
    """
    radius, n = taps.size - 1, nb.uint64(out.size)
    middle, one, two = row[radius:], taps[0], others[0]
    for j in range(n):
        out[j] += one * middle[j]
        other[j] += two * middle[j]
    k = 1
    while k + 3 <= radius:
        a, b, c, d = taps[k], taps[k + 1], taps[k + 2], taps[k + 3]
        e, f, g, h = others[k], others[k + 1], others[k + 2], others[k + 3]
        a0, b0, c0, d0 = (
            row[radius - k :],
            row[radius - k - 1 :],
            row[radius - k - 2 :],
            row[radius - k - 3 :],
        )
        a1, b1, c1, d1 = (
            row[radius + k :],
            row[radius + k + 1 :],
            row[radius + k + 2 :],
            row[radius + k + 3 :],
        )
        for j in range(n):
            p, q, r, s = a0[j] + a1[j], b0[j] + b1[j], c0[j] + c1[j], d0[j] + d1[j]
            out[j] = fused(c, r, fused(d, s, fused(a, p, fused(b, q, out[j]))))
            other[j] = fused(g, r, fused(h, s, fused(e, p, fused(f, q, other[j]))))
        k += 4
    while k <= radius:
        one, two, left, right = taps[k], others[k], row[radius - k :], row[radius + k :]
        for j in range(n):
            p = left[j] + right[j]
            out[j], other[j] = fused(one, p, out[j]), fused(two, p, other[j])
        k += 1


@kernel(error_model="python")
def _convolve(noise, kernels, out):  # type: ignore[no-untyped-def]
    """out[b] += noise * kernels[b]; ``noise`` has R more cells on every side, the kernels are
    symmetric quadrants (R + 1, R + 1) whose taps are zero in the same places."""
    number, radius = kernels.shape[0], kernels.shape[1] - 1
    rows = np.empty(noise.shape[1], np.float32)
    m = nb.uint64(rows.size)
    for i in range(out.shape[1]):
        for di in range(radius + 1):
            above, below = noise[i + radius - di], noise[i + radius + di]
            if di == 0:
                for j in range(m):
                    rows[j] = above[j]
            else:
                for j in range(m):
                    rows[j] = above[j] + below[j]
            size = radius + 1
            while size > 1 and kernels[0, di, size - 1] == 0:  # the kernel is cut to a circle
                size -= 1
            row = rows[radius + 1 - size :]
            for b in range(0, number - 1, 2):
                _add_two_symmetric(
                    row,
                    kernels[b, di, :size],
                    kernels[b + 1, di, :size],
                    out[b, i],
                    out[b + 1, i],
                )
            if number % 2:
                _add_symmetric(row, kernels[number - 1, di, :size], out[number - 1, i])


@kernel(error_model="python")
def _upsample(coarse, ci, cj, weights, out, fi, fj):  # type: ignore[no-untyped-def]
    """out += x2 kriging interpolation; (ci, cj) and (fi, fj) are the absolute indices of the
    arrays' first points.
    """
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


@kernel(error_model="python")
def _prefilter(field, taps, out):  # type: ignore[no-untyped-def]
    """Separable symmetric filter; ``field`` has taps.size - 1 more cells on every side than
    ``out``.
    """
    half = taps.size - 1
    row = np.empty(field.shape[1], np.float32)
    m = nb.uint64(row.size)
    for i in range(out.shape[0]):
        source, weight = field[i + half], taps[0]
        for j in range(m):
            row[j] = weight * source[j]
        for tap in range(1, half, 2):
            a, b = taps[tap], taps[tap + 1]
            a0, a1, b0, b1 = (
                field[i + half - tap],
                field[i + half + tap],
                field[i + half - tap - 1],
                field[i + half + tap + 1],
            )
            for j in range(m):
                row[j] = fused(a, a0[j] + a1[j], fused(b, b0[j] + b1[j], row[j]))
        target = out[i]
        for j in range(nb.uint64(out.shape[1])):
            target[j] = 0
        _add_symmetric(row, taps, target)
