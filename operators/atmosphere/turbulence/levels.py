"""The levels of a turbulent layer: kernels and interpolation weights of the pyramid (`lattice`),
and how well they hold.

Largest error of the implied covariance C, relative to the variance, and of the implied structure
function S, relative to itself and from one cell up (computed exactly, not sampled;
`benchmarks/atmosphere.py`), against r0 / sigma:

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
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from zonda.core.types import Floats

from .beams import Aperture
from .covariance import NU, mixture_between, spectrum_between

Field = NDArray[np.float32]

LARGEST_SCALE = 20.0
"""The mixture is cut at s = 20 r0^2: 2e-9 of the variance lies beyond."""

PREFILTER = 10
"""Half-length of the finite cubic-spline prefilter: its truncation is 3e-6 at the shortest
wavelength, less elsewhere.
"""

_GRID = 96

_NEGLIGIBLE = 40.0
"""exp(-40) is 4e-18."""


@dataclass(frozen=True)
class Fidelity:
    """Kernel radius R [cells], interpolation taps L and resolution c of the pyramid, and its
    measured error.
    """

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
    """One lattice: spacing 2^exponent m; kernel (R + 1, R + 1), quadrant of the symmetric h_j;
    None: nothing at this scale.
    """

    exponent: int
    kernel: Field | None

    @property
    def spacing(self) -> float:
        return math.ldexp(1.0, self.exponent)


@lru_cache(maxsize=256)
def gaussian_levels(
    outer_scale: float,
    sigma: float,
    lattice: float,
    fidelity: str,
) -> tuple[Level, ...]:
    """The finest first, behind a Gaussian beam."""
    f = FIDELITIES[fidelity]
    exponent = math.floor(math.log2(lattice * sigma))
    low = sigma**2
    top = LARGEST_SCALE * outer_scale**2 + sigma**2
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
def aperture_levels(
    outer_scale: float,
    aperture: Aperture,
    lattice: float,
    fidelity: str,
) -> tuple[Level, ...]:
    """Levels as `gaussian_levels`: `Aperture.gaussians` see the mixture beyond s_0 = sigma^2, the
    finest level all else.
    """
    f = FIDELITIES[fidelity]
    exponent = math.floor(math.log2(aperture.sigma * min(lattice, 0.5)))
    low = aperture.sigma**2
    top = LARGEST_SCALE * outer_scale**2
    levels = [
        Level(exponent, _aperture_kernel(outer_scale, aperture, low, math.ldexp(1.0, exponent), f))
    ]
    while low < top:
        exponent += 1
        spacing = math.ldexp(1.0, exponent)
        kernel = None
        high = min((2 * spacing / f.resolution) ** 2 - aperture.sigma**2, top)
        if high > low:
            s, w = mixture_between(outer_scale, 0.0, low, high)
            e = np.concatenate([s + square for _, square in aperture.gaussians])
            kernel = _separable_kernel(
                e,
                np.concatenate([c * w for c, _ in aperture.gaussians]),
                spacing,
                f.radius,
            )
            low = high
        levels.append(Level(exponent, kernel))
    return tuple(levels)


def _aperture_kernel(
    outer_scale: float,
    aperture: Aperture,
    split: float,
    spacing: float,
    f: Fidelity,
) -> Field:
    """The finest level behind an aperture: B^2 P for s < split, and what equation (3) of `beams`
    leaves for s > split.
    """
    radius = math.ceil((aperture.diameter / 2 + 0.4 * f.radius * math.sqrt(split)) / spacing)
    grid = 4 * (radius + 8)
    k = 2 * np.pi * np.fft.fftfreq(grid, spacing)[: grid // 2 + 1]
    alias = 2 * np.pi / spacing * np.arange(-2, 3)
    square = np.add.outer(alias, k) ** 2
    k2 = square[:, :, None, None] + square
    beam = aperture.transform(np.sqrt(k2))
    left = beam**2 - sum(c * np.exp(-s * k2) for c, s in aperture.gaussians)
    below, above = spectrum_between(k2, outer_scale, split)
    # Where the beam of `gaussians` exceeds the aperture's own, at its zeros, there is a little too
    # much to take away: what is cut is below 2e-4 of this level's power for a top hat, 2e-6 for
    # tapers of 10 dB (3 to 100 m, outer scales of 10 to 1000 m).
    power = np.maximum(beam**2 * below + left * above, 0.0).sum((0, 2)) / spacing**2
    quarter = np.sqrt(power) * np.sign(beam[2, :, 2])
    index = np.minimum(np.arange(grid), grid - np.arange(grid))
    h = np.fft.irfft2(quarter[index], (grid, grid))[: radius + 1, : radius + 1]
    return _cut(h, float(power[np.ix_(index, index)].mean()))


def _kernel(
    outer_scale: float,
    sigma: float,
    low: float,
    high: float,
    spacing: float,
    radius: int,
) -> Field:
    """Quadrant (R + 1, R + 1) of the kernel whose power is the aliased spectrum of low <= e < high,
    cut at R cells.
    """
    return _separable_kernel(*mixture_between(outer_scale, sigma, low, high), spacing, radius)


def _separable_kernel(e: Floats, w: Floats, spacing: float, radius: int) -> Field:
    """The kernel whose power is the aliased spectrum sum w exp(-e k^2)."""
    k = 2 * np.pi * np.fft.rfftfreq(_GRID, spacing)  # the spectrum is even
    alias = 2 * np.pi / spacing * np.arange(-2, 3)
    square = np.add.outer(alias, k) ** 2
    own = square[2].max()
    others = square.min(1)
    heard = (
        others <= own + _NEGLIGIBLE / e.min()
    )  # of the images, those that are not lost beside the wave itself
    gauss = np.exp(-np.multiply.outer(e, square[heard])).sum(1)
    power = (
        np.einsum("ka,kb->ab", gauss * w[:, None], gauss) / spacing**2
    )  # not BLAS: the same bits for any number of threads
    turns = _cosines(radius)
    h = np.einsum("ra,ac->rc", turns, np.einsum("ab,cb->ac", np.sqrt(power), turns))
    return _cut(h, float((w / (4 * np.pi * e)).sum()))


@lru_cache(maxsize=8)
def _cosines(radius: int) -> Floats:
    """The inverse transform (radius + 1, _GRID / 2 + 1) of an even spectrum of which half is
    given.
    """
    index = np.arange(_GRID // 2 + 1)
    times = np.where((index == 0) | (index == index[-1]), 1.0, 2.0) / _GRID
    return np.asarray(
        np.cos(2 * np.pi / _GRID * np.multiply.outer(np.arange(radius + 1), index)) * times,
        np.float64,
    )


def _cut(h: Floats, variance: float) -> Field:
    """Cut to a circle and scale to the variance."""
    index = np.arange(len(h))
    h = np.where(np.hypot(index[:, None], index) <= len(h) - 1, h, 0.0)
    times = np.where(index > 0, 2.0, 1.0)
    total = times @ (h * h) @ times
    return np.ascontiguousarray(h * math.sqrt(variance / total), np.float32)


@lru_cache(maxsize=8)
def kriging(taps: int, resolution: float) -> Field:
    """Weights that predict the middle of two lattice points from ``taps`` neighbours: best for the
    sum of coarser levels.

    Ordinary kriging: the weights sum to 1. A field that hardly varies between lattice points (an
    outer scale of many cells) passes through twenty levels unharmed; weights off by 1e-4 would
    swamp the structure function at one cell.
    """
    x: Floats = np.arange(taps, dtype=np.float64) - (taps - 1) / 2
    octaves = np.arange(4)

    def model(r: Floats) -> Floats:
        scale = 2 ** (-octaves / 2)
        weight = 2 ** (NU * octaves)
        return np.asarray(
            (np.exp(-((np.multiply.outer(r, scale) * resolution / 2) ** 2)) * weight).sum(-1),
            np.float64,
        )

    between = model(np.asarray(x[:, None] - x, np.float64))
    system = np.ones((taps + 1, taps + 1))
    system[:taps, :taps] = between + 1e-12 * between[0, 0] * np.eye(taps)
    system[taps, taps] = 0
    return np.asarray(np.linalg.solve(system, np.append(model(x), 1.0))[:taps], np.float32)


@lru_cache(maxsize=1)
def prefilter_taps() -> Field:
    """One-sided inverse of (1, 4, 1) / 6, cut at `PREFILTER` and normalized to unit sum. Shape
    (PREFILTER + 1,).
    """
    taps = np.sqrt(3.0) * (np.sqrt(3.0) - 2.0) ** np.arange(PREFILTER + 1)
    return np.asarray(taps / (taps[0] + 2 * taps[1:].sum()), np.float32)
