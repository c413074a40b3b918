"""Sums over the samples near probes on the map, with the beam as weight.

Probes stand on a square comb so far apart that no sample is near two of them.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel
from zonda.core.types import Floats

from .survey import Survey, Track

NEAR = 8.0
"""Least distance of probes, in the beam's standard deviations."""
FAR = 12.0
"""-ln K up to which a sample counts."""
STEP = (0.7548776662466927, 0.5698402909980532)
"""Steps of a low-discrepancy sequence in the plane (Roberts 2018)."""


@dataclass(frozen=True)
class Comb:
    """Probes in a circle about the map's centre.

    Attributes
    ----------
    origin, spacing
        Of the first probe and between probes, rad.
    inside
        (n, n) whether a probe is in the circle.
    """

    origin: Floats
    spacing: float
    inside: NDArray[np.bool_]


def combs(survey: Survey, radius: float, probes: int, most: int = 8) -> list[Comb]:
    """Combs with about ``probes`` probes in a circle of ``radius`` [rad] together; the first has
    one at its centre.
    """
    spacing = max(NEAR * survey.sigma, radius / 4)
    number = 2 * int(radius / spacing) + 3
    found: list[Comb] = []
    total = 0
    for k in range(64):
        shift = np.zeros(2) if k == 0 else (k * np.array(STEP) + 0.5) % 1 - 0.5
        origin = (shift - number // 2) * spacing
        grid = origin[:, None] + spacing * np.arange(number)
        inside = np.hypot(grid[0][:, None], grid[1][None]) <= radius
        if inside.any():
            found.append(Comb(origin, spacing, inside))
            total += int(inside.sum())
        if total >= probes or len(found) >= most:
            break
    return found


def kernel_sums(
    track: Track, comb: Comb, offsets: Floats, sizes: tuple[float, float], thin: int
) -> Floats:
    """(n, n, 2): for each probe the sums of K and K^2 over detectors at ``offsets`` (n_det, 2) and
    all samples of a scan, from every ``thin``-th instant. ``sizes``: the beam's standard deviation
    and the radius of the focal plane, rad."""
    total = np.zeros((*comb.inside.shape, 2))
    sigma, radius = sizes
    far = 1.05 * radius + math.sqrt(2 * FAR) * sigma
    _sums(
        track.matrices,
        track.centre,
        offsets,
        comb.origin,
        comb.spacing,
        comb.inside,
        sigma**2,
        far,
        thin,
        total,
    )
    return total * (thin * track.step)


def kernel_series(
    survey: Survey, track: Track, comb: Comb, factors: Floats, offsets: Floats
) -> NDArray[np.float32]:
    """(n_det, n_instant): factor K of the nearest probe, for detectors at ``offsets`` (n_det,
    2).
    """
    out = np.zeros((len(offsets), len(track.index)), np.float32)
    _series(track.matrices, offsets, comb.origin, comb.spacing, factors, survey.sigma**2, out)
    return out


@kernel
def _sums(  # type: ignore[no-untyped-def]
    matrices, centre, offsets, origin, spacing, inside, variance, far, thin, total
):
    number = inside.shape[0]
    low, high = origin - far, origin + far + spacing * (number - 1)
    for t in range(thin // 2, len(matrices), thin):
        if (
            centre[t, 0] < low[0]
            or centre[t, 0] > high[0]
            or centre[t, 1] < low[1]
            or centre[t, 1] > high[1]
        ):
            continue
        h = matrices[t]
        for d in range(len(offsets)):
            a, b = offsets[d, 0], offsets[d, 1]
            scale = 1.0 / (h[6] * a + h[7] * b + h[8])
            x = (h[0] * a + h[1] * b + h[2]) * scale - origin[0]
            y = (h[3] * a + h[4] * b + h[5]) * scale - origin[1]
            i, j = math.floor(x / spacing + 0.5), math.floor(y / spacing + 0.5)
            if 0 <= i < number and 0 <= j < number and inside[i, j]:
                u, v = x - i * spacing, y - j * spacing
                r = (u * u + v * v) / (2 * variance)
                if r < FAR:
                    g = math.exp(-r)
                    total[i, j, 0] += g
                    total[i, j, 1] += g * g


@kernel
def _series(  # type: ignore[no-untyped-def]
    matrices, offsets, origin, spacing, factors, variance, out
):
    number = factors.shape[0]
    for d in range(len(offsets)):
        a, b = offsets[d, 0], offsets[d, 1]
        for t in range(len(matrices)):
            h = matrices[t]
            scale = 1.0 / (h[6] * a + h[7] * b + h[8])
            x = (h[0] * a + h[1] * b + h[2]) * scale - origin[0]
            y = (h[3] * a + h[4] * b + h[5]) * scale - origin[1]
            i, j = math.floor(x / spacing + 0.5), math.floor(y / spacing + 0.5)
            if 0 <= i < number and 0 <= j < number and factors[i, j] != 0.0:
                u, v = x - i * spacing, y - j * spacing
                out[d, t] = factors[i, j] * math.exp(-(u * u + v * v) / (2 * variance))
