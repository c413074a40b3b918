"""How far the air averages down in a pixel of the map.

Of a layer's field g and a pixel that H samples see, at times t_h along rays x_h, the map holds

    m = 1/H sum_h [g(x_h) - <g(x_d, t_h)>_d],    <m^2> = int dk P(k) |1/H sum_h [e^(i k x_h) - <e^(i k x_d)>_d]|^2      (1)

the detectors' mean taken off where it is removed. The integral is a sum over random wave vectors of the mixture
sum_j w_j exp(-r^2 / 4 e_j) (normal, of variance 1 / 2 e_j on each axis; components that differ over the field are drawn more
often), the sum over h one over random instants at which the pixel is in the field; what these instants scatter more than the H
samples do is taken off. Positions move with the wind: this is the ensemble's variance, exact but for the draws, whose standard
error is added twice. One scan is looked at, and no high-pass filter. Such a filter removes most of what drifts slowly by, but not
all: a scan has ends, and the singular mode that is subtracted turns a little with what it is made of. Counting only the waves
that a ray sees above the cut made bounds that did not hold (docs/plan.md).
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from zonda.core.numerics.projection import rotation_matrices
from zonda.core.types import Floats

from .turbulence.geometry import axes, crossing, rays, tracks

if TYPE_CHECKING:
    from zonda.core.plan.context import Context

    from .layers import AtmosphereLayers
    from .planning import Air

INSTANTS, CANDIDATES, HITS, WAVES = 4000, 48, 160, 160


def shares(operator: AtmosphereLayers, context: Context, a: Air) -> list[float]:
    """For each layer, the rms in a pixel over that in a sample (with the detectors' mean removed where it is), at most 1."""
    o = context.first
    if context.coverage is None or o.n_samples < 2:
        return [1.0] * len(a.models)
    rng = np.random.default_rng(1)
    track = operator._tracks.get(o.name) or tracks([o])[0]
    seen = _seen(context, rng)
    xi, eta = _nodes(context, 2 if _smooth(context, a) else 4)
    found: list[float] = []
    for layer, model in zip(a.layers, a.models, strict=True):
        e, w = a.components[len(found)]
        reach = 2 * o.focalplane.radius * model.distance
        chance = w * -np.expm1(-(reach**2) / (4 * e)) + 1e-6 * w
        chance /= chance.sum()
        j = rng.choice(len(e), WAVES, p=chance)
        k = rng.standard_normal((WAVES, 2)) / np.sqrt(2 * e[j])[:, None]
        weight = w[j] / chance[j] / WAVES
        drift = track.drift @ layer.wind
        worst = 0.0
        for at, where, hits in seen:
            seconds = o.seconds[at]
            frame = axes(o.boresight_azel[at])
            own = frame[:, :, 2] - where[1][:, None] * frame[:, :, 0] - where[0][:, None] * frame[:, :, 1]
            here = model.height * track.unroll(crossing(own.T)) - drift[:, None] * seconds
            wave = np.exp(1j * (k @ here))
            if context.removes_common:
                all_of_them = model.height * track.unroll(crossing(rays(frame, xi, eta))) - drift[:, None, None] * seconds
                wave -= np.exp(1j * np.tensordot(k, all_of_them, 1)).mean(axis=1)
            number = len(at)
            one = float(weight @ (np.abs(wave) ** 2).mean(axis=1))
            parts = weight * np.abs(wave.mean(axis=1)) ** 2
            raw = float(parts.sum())
            mean = max((number * raw - one) / max(number - 1, 1), raw / 4)
            total = mean + one / max(hits, 1.0) + 2 * math.sqrt(float((parts**2).sum()))
            worst = max(worst, total / one if one > 0 else 1.0)
        found.append(math.sqrt(min(worst, 1.0)))
    return found


def _smooth(context: Context, a: Air) -> bool:
    """Whether the field's footprint is within the beam's in every layer: four points then stand for the detectors' mean."""
    radius = context.first.focalplane.radius
    return all(m.distance * radius <= m.sigma for m in a.models)


def _nodes(context: Context, n: int) -> tuple[Floats, Floats]:
    """n x n points of equal weight with the detectors' mean and second moments."""
    plane = context.first.focalplane
    x = (2 * np.arange(n) + 1) / n - 1
    x /= math.sqrt(float((x * x).mean()))
    xi, eta = plane.xi.mean() + x * plane.xi.std(), plane.eta.mean() + x * plane.eta.std()
    return np.repeat(xi, n), np.tile(eta, n)


def _seen(context: Context, rng: np.random.Generator) -> list[tuple[NDArray[np.intp], tuple[Floats, Floats], float]]:
    """For some pixels: instants of the first scan at which they are in the field, where in it, and the pixel's samples then."""
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
    density = o.n_detectors * context.coverage.pixel**2 / (math.pi * radius**2)  # detectors in a pixel
    chosen = []
    for number in np.argsort(count)[[CANDIDATES // 2, 3 * CANDIDATES // 4]]:  # of those that samples fall in
        index = np.flatnonzero(inside[number])
        if len(index) > HITS:
            index = np.sort(rng.choice(index, HITS, replace=False))
        hits = count[number] / len(at) * o.n_samples * density
        chosen.append((at[index], (x[number, index], y[number, index]), float(hits)))
    return chosen
