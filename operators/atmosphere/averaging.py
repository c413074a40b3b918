"""Variance of the atmosphere that is left in a pixel of the map.

Of a layer's field g and a pixel that H samples see, at times t_h along rays x_h, the map holds

    m = 1/H sum_h [g(x_h) - <g(x_d, t_h)>_d],
    <m^2> = int dk P(k) |1/H sum_h [e^(i k x_h) - <e^(i k x_d)>_d]|^2      (1)

the detectors' mean taken off where it is removed. The integral is a sum over random wave vectors of
the mixture sum_j w_j exp(-r^2 / 4 e_j) (normal, of variance 1 / 2 e_j on each axis; components that
differ over the field are drawn more often), the sum over h one over random instants at which the
pixel is in the field; what these instants scatter more than the H samples do is taken off.
Positions move with the wind: this is the ensemble's variance, exact but for the draws, whose
standard error is added twice. One scan is looked at, and no high-pass filter. Such a filter removes
most of what drifts slowly by, but not all: a scan has ends, and the singular mode that is
subtracted turns a little with what it is made of. Counting only the waves that a ray sees above the
cut made bounds that did not hold (docs/plan.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.numerics.projection import rotation_matrices
from zonda.core.observation import Observation
from zonda.core.plan.bounds import Context
from zonda.core.types import Floats

from .turbulence.geometry import ScanPlane, axes, crossing, rays
from .turbulence.nodes import Layer

INSTANTS, CANDIDATES, HITS, WAVES = 4000, 48, 160, 160


def shares(
    context: Context, layers: list[Layer], components: list[tuple[Floats, Floats]], plane: ScanPlane
) -> list[float]:
    """For each layer, the rms in a pixel over that in a sample (with the detectors' mean removed
    where it is), at most 1.

    ``components``: (e, w) of each layer. ``plane``: of the first scan.
    """
    o = context.first
    if context.coverage is None or o.n_samples < 2:
        return [1.0] * len(layers)
    rng = np.random.default_rng(1)
    seen = _seen(context, rng)
    # Where the field's footprint is within the beam's in every layer four points stand for the
    # detectors' mean.
    smooth = all(layer.distance * o.focalplane.radius <= layer.sigma for layer in layers)
    points = _nodes(context, 2 if smooth else 4) if context.removes_common else None
    found: list[float] = []
    for layer, (e, w) in zip(layers, components, strict=True):
        reach = 2 * o.focalplane.radius * layer.distance
        chance = w * -np.expm1(-(reach**2) / (4 * e)) + 1e-6 * w
        chance /= chance.sum()
        j = rng.choice(len(e), WAVES, p=chance)
        k = rng.standard_normal((WAVES, 2)) / np.sqrt(2 * e[j])[:, None]
        weight = w[j] / chance[j] / WAVES
        worst = max(
            [
                0.0,
                *(
                    _in_pixel(_waves(o, layer, plane, pixel, k, points), weight, pixel.hits)
                    for pixel in seen
                ),
            ]
        )
        found.append(math.sqrt(min(worst, 1.0)))
    return found


@dataclass(frozen=True)
class _Pixel:
    """Sample numbers at which a pixel is in the field, where in it (xi, eta), and the number of its
    samples in all.
    """

    at: NDArray[np.intp]
    xi: Floats
    eta: Floats
    hits: float


def _waves(
    o: Observation,
    layer: Layer,
    plane: ScanPlane,
    pixel: _Pixel,
    k: Floats,
    points: tuple[Floats, Floats] | None,
) -> NDArray[np.complex128]:
    """Plane waves k of a layer in a pixel (n_wave, n_instant), less their mean over points of the
    focal plane.
    """
    seconds, frame, drift = (
        o.seconds[pixel.at],
        axes(o.boresight_azel[pixel.at]),
        plane.drift @ layer.wind,
    )
    own = frame[:, :, 2] - pixel.eta[:, None] * frame[:, :, 0] - pixel.xi[:, None] * frame[:, :, 1]
    wave = np.exp(
        1j * (k @ (layer.height * plane.unroll(crossing(own.T)) - drift[:, None] * seconds))
    )
    if points is not None:
        everywhere = (
            layer.height * plane.unroll(crossing(rays(frame, *points)))
            - drift[:, None, None] * seconds
        )
        wave -= np.exp(1j * np.tensordot(k, everywhere, 1)).mean(axis=1)
    return np.asarray(wave, np.complex128)


def _in_pixel(wave: NDArray[np.complex128], weight: Floats, hits: float) -> float:
    """Variance of the mean of a pixel's samples over that of a sample."""
    number = wave.shape[1]
    one = float(weight @ (np.abs(wave) ** 2).mean(axis=1))
    parts = weight * np.abs(wave.mean(axis=1)) ** 2
    raw = float(parts.sum())
    mean = max((number * raw - one) / max(number - 1, 1), raw / 4)
    total = mean + one / max(hits, 1.0) + 2 * math.sqrt(float((parts**2).sum()))
    return total / one if one > 0 else 1.0


def _nodes(context: Context, n: int) -> tuple[Floats, Floats]:
    """n x n points of equal weight with the detectors' mean and second moments."""
    plane = context.first.focalplane
    x = (2 * np.arange(n) + 1) / n - 1
    x /= math.sqrt(float((x * x).mean()))
    xi, eta = plane.xi.mean() + x * plane.xi.std(), plane.eta.mean() + x * plane.eta.std()
    return np.repeat(xi, n), np.tile(eta, n)


def _seen(context: Context, rng: np.random.Generator) -> list[_Pixel]:
    """For some pixels: instants of the first scan at which they are in the field, where in it, and
    the pixel's samples then.
    """
    o, plane = context.first, context.first.focalplane
    at = np.sort(rng.integers(0, o.n_samples, INSTANTS))
    turn = rotation_matrices(o.boresight_radec[at])
    picked = rng.integers(0, len(at), CANDIDATES)
    rows = rng.integers(0, o.n_detectors, CANDIDATES)
    offsets = np.stack([-plane.eta[rows], -plane.xi[rows], np.ones(CANDIDATES)], axis=1)
    directions = np.einsum("nij,nj->ni", turn[picked], offsets)
    found = np.einsum("nji,pj->pni", turn, directions)
    x, y = -found[:, :, 1] / found[:, :, 2], -found[:, :, 0] / found[:, :, 2]
    middle = plane.xi.mean(), plane.eta.mean()
    radius = max(float(np.hypot(plane.xi - middle[0], plane.eta - middle[1]).max()), 1e-9)
    inside = (np.hypot(x - middle[0], y - middle[1]) <= radius) & (found[:, :, 2] > 0)
    count = inside.sum(axis=1)
    assert context.coverage is not None
    density = (
        o.n_detectors * context.coverage.pixel**2 / (math.pi * radius**2)
    )  # detectors in a pixel
    chosen = []
    for number in np.argsort(count)[
        [CANDIDATES // 2, 3 * CANDIDATES // 4]
    ]:  # of those that samples fall in
        index = np.flatnonzero(inside[number])
        if len(index) > HITS:
            index = np.sort(rng.choice(index, HITS, replace=False))
        hits = count[number] / len(at) * o.n_samples * density
        chosen.append(_Pixel(at[index], x[number, index], y[number, index], float(hits)))
    return chosen
