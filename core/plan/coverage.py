"""How the scans cover the map: hits of a pixel and scan speed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ..data import Observation
from ..numerics.projection import rotation_matrices
from ..types import Floats
from .context import Coverage

DEEP = 0.9
"""Quantile of the hits over the covered map: its deeper part has the least noise, so what holds
there holds everywhere.
"""

CELLS, POINTS, DETECTORS = 32, 8192, 96
"""Hits are counted on CELLS x CELLS cells from at most about POINTS instants of all scans and
DETECTORS detectors of each; in pixels where no more samples than that are taken."""


def cover(observations: Sequence[Observation], pixel: float) -> Coverage:
    """Hits per pixel of side ``pixel`` [rad] and scan speed, from a thinned set of instants and
    detectors.
    """
    points: list[Floats] = []
    weights: list[Floats] = []
    speeds: list[Floats] = []
    passed: list[Floats] = []
    centre = rotation_matrices(observations[0].boresight_radec[:1])[0]
    number, most = max(POINTS // len(observations), 64), DETECTORS
    if exact := sum(o.n_samples * o.n_detectors for o in observations) <= POINTS * DETECTORS:
        number, most = (
            max(sizes)
            for sizes in zip(*((o.n_samples, o.n_detectors) for o in observations), strict=True)
        )
    for o in observations:
        times = np.unique(np.linspace(0, o.n_samples - 1, min(number, o.n_samples)).astype(int))
        rows = np.unique(np.linspace(0, o.n_detectors - 1, min(most, o.n_detectors)).astype(int))
        turn = centre.T @ rotation_matrices(o.boresight_radec[times])
        plane = np.array([-o.focalplane.eta[rows], -o.focalplane.xi[rows], np.ones(len(rows))])
        looking = turn @ plane  # (time, 3, detector)
        front = looking[:, 2] > 0.1
        points.append(
            np.array(
                [
                    looking[:, 0][front] / looking[:, 2][front],
                    looking[:, 1][front] / looking[:, 2][front],
                ]
            )
        )
        weights.append(
            np.full(points[-1].shape[1], o.n_samples * o.n_detectors / (len(times) * len(rows)))
        )
        passage = np.full(
            len(times), float(o.n_samples)
        )  # samples that a detector takes to cross a pixel, at these instants
        if o.n_samples > 1:
            at = times[:-1]
            ends = rotation_matrices(o.boresight_radec[np.stack([at, at + 1], 1).ravel()])[
                :, :, 2
            ].reshape(-1, 2, 3)
            speeds.append(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1) * o.sample_rate)
            crossing = (
                o.sample_rate * pixel / np.maximum(np.append(speeds[-1], speeds[-1][-1:]), 1e-12)
            )
            passage = np.clip(crossing, 1.0, passage)
        looked = np.maximum(passage * len(times) / o.n_samples, 1.0)
        share = np.stack(
            [1 / looked, o.n_samples * o.n_detectors / (len(times) * len(rows)) / passage]
        )
        passed.append(np.broadcast_to(share[:, :, None], (2, len(times), len(rows)))[:, front])
    where, weight = np.concatenate(points, axis=1), np.concatenate(weights)
    speed = float(np.median(np.concatenate(speeds))) if speeds else 0.0
    if exact:
        index = np.floor(where / pixel).astype(np.int64)
        index -= index.min(axis=1, keepdims=True)
        _, each = np.unique(index[0] * (index[1].max() + 1) + index[1], return_counts=True)
        return Coverage(max(float(np.quantile(each, DEEP)), 1.0), pixel, speed, exact)
    reach = np.maximum(np.ptp(where, axis=1), pixel)
    cells = np.maximum(1, np.minimum(CELLS, np.floor(reach / pixel))).astype(int)
    low = where.min(axis=1)
    side = np.maximum(np.ptp(where, axis=1) / cells, 1e-15)
    column, row = (
        np.minimum(((where[k] - low[k]) / side[k]).astype(np.int64), cells[k] - 1) for k in (0, 1)
    )
    cell = column * cells[1] + row
    covered = _covered(
        where,
        cell,
        pixel,
        max(float(side[0] * side[1]) / pixel**2, 1.0),
        np.concatenate(passed, axis=1),
    )
    counts = np.bincount(cell, weight, len(covered))
    hits = counts[covered > 0] / covered[covered > 0]
    return Coverage(max(float(np.quantile(hits, DEEP)), 1.0), pixel, speed)


def _covered(
    where: Floats, cell: NDArray[np.int64], pixel: float, most: float, passages: Floats
) -> Floats:
    """Pixels in each cell that samples fall in, of ``most`` in it, from some points ``where`` (2,
    n) that fall in u of them.

    ``passages`` (2, n): what each point counts of the passages through pixels that were looked at,
    and of all there are. Passages fall in u = P (1 - exp(-n / P)) of P pixels if they do so at
    random: P follows from those that were looked at, and then the pixels that all of them fall in.
    Few passages, each through a pixel of its own, do not tell P: it is the whole cell.
    """
    number = int(cell.max()) + 1
    index = np.floor(where / pixel).astype(np.int64)
    index -= index.min(axis=1, keepdims=True)
    one = (cell * (index[0].max() + 1) + index[0]) * (index[1].max() + 1) + index[1]
    _, first = np.unique(one, return_index=True)
    u = np.bincount(cell[first], minlength=number).astype(np.float64)
    looked, whole = (
        np.maximum(np.bincount(cell, some, number), np.minimum(u, 1.0)) for some in passages
    )
    pixels = np.minimum(u, most)
    for _ in range(50):
        pixels = np.minimum(
            u / np.maximum(-np.expm1(-looked / np.maximum(pixels, 1e-9)), 1e-9), most
        )
    pixels = np.where(looked <= 1.02 * u, most, pixels)
    covered = np.maximum(-pixels * np.expm1(-whole / np.maximum(pixels, 1e-9)), np.minimum(u, most))
    return np.asarray(np.where(u > 0, np.maximum(covered, 1.0), 0.0), np.float64)
