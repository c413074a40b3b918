"""Modes that the detectors of a scan share, as leading vectors of slow baselines and as what long
waves of the atmosphere make: the same for all detectors, and gradients across the focal plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from zonda.core.numerics.random import normals, stream_key
from zonda.core.types import Floats

CLEAR = 2.0
"""Power of what all detectors see alike over the mean over directions, from which it is a mode."""
TINY = 1e-300
ITERATIONS = 40
"""Products with the covariance in the search for its leading modes."""
ALIKE = 1e-6
"""Share of a gradient that is not that of other modes, below which it is one of them."""
NOWHERE = np.zeros((2, 0))
"""Places of detectors that are not known."""


def members(groups: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """The detectors of each group."""
    return [np.flatnonzero(groups == number) for number in np.unique(groups)]


def leading_of(
    groups: NDArray[np.intp],
    rows: Floats,
    numbers: Sequence[int],
    known: Floats,
    places: Floats = NOWHERE,
    free: int = 1,
    alike: Floats | None = None,
) -> tuple[Floats, NDArray[np.bool_]]:
    """`leading` vectors of each group, as many as its number, 0 for other detectors: the first of
    all groups, then the second of all ...; some are ``known`` (k, n_det).

    Where ``places`` are known, the gradients of the first are among three or more (see
    `with_gradients`), of which so many are ``free``; the first is ``alike`` (n_det,), if given,
    where it and its gradients hold as much as the leading one and its gradients. Returns the
    vectors, and true for those up to the gradients.
    """
    found = []
    for number, at in zip(numbers, members(groups), strict=True):
        own = known[(known[:, at] != 0).any(axis=1)][:number, at]
        steady = 0
        if places.size and number > 2:
            if not len(own) and alike is not None:
                own = first_of(rows[at], alike[at], places[:, at])
            own, steady = with_gradients(rows[at], own, places[:, at], number, free)
        vectors = np.zeros((number, len(rows)))
        vectors[:, at] = leading(rows[at], number, own)
        found += [(k, vector, k < steady) for k, vector in enumerate(vectors)]
    ordered = sorted(found, key=itemgetter(0))
    kept = np.array([steady for _, _, steady in ordered], np.bool_)
    return np.array([vector for _, vector, _ in ordered]).reshape(-1, len(rows)), kept


def first_of(rows: Floats, alike: Floats, places: Floats) -> Floats:
    """``alike`` (1, n_det), with size 1, where it and its gradients hold no less of one half of the
    columns of ``rows`` (n_det, n) than the leading vector of the other and its gradients, and it is
    above their mean over directions; else none (0, n_det).

    A leading vector is tilted by chance, as gradients of a short scan look like its common mode.
    The free mode is then not what all see alike: a part of the fast common noise stays in the map.
    """
    vectors = orthonormal(alike[None], np.zeros((0, len(rows))))
    half, held = rows[:, 1::2], []
    for first in (vectors, leading(rows[:, ::2], 1, vectors[:0])):
        span = orthonormal(np.concatenate([first, _steep(first, places)]), first)
        held.append((np.einsum("kd,dt->kt", span, half) ** 2).sum(axis=1))
    clear = held[0][0] > CLEAR * np.mean(half**2) * half.shape[1]
    return vectors if clear and held[0].sum() >= held[1].sum() else vectors[:0]


def _steep(first: Floats, places: Floats) -> Floats:
    """Gradients (2, n_det) of a vector (1, n_det)."""
    return np.asarray(first * (places - (first**2 * places).sum(axis=1, keepdims=True)))


def with_gradients(
    rows: Floats, known: Floats, places: Floats, number: int, free: int
) -> tuple[Floats, int]:
    """Vectors (at most ``number``, n_det) that lead ``rows`` (n_det, n), of which the first are
    ``known``: at least the leading one u. Of u x and u y of the detectors' ``places`` (2, n_det),
    which long waves of the atmosphere make, those that are not among them come next: leading
    vectors that are found in the noise of the streams miss these by so much that the atmosphere
    stays in the map. Before them come further leading vectors, as long as those of one half of the
    columns hold more of the others. Columns count alike, without the vectors before: else the
    slowest noise of the detectors decides. Where one of the two alone is ``free``, or has room, it
    is that along which rows change most. Returns also the number of vectors up to the gradients, 0
    where these are not among them.
    """
    found = known if len(known) else leading(rows, 1, known)
    steep = _steep(found[:1], places)
    least = ALIKE * np.sqrt((steep**2).sum(axis=1))
    while True:
        rest = rows - np.einsum("kd,kt->dt", found, np.einsum("kd,dt->kt", found, rows))
        rest /= np.sqrt(np.maximum((rest**2).sum(axis=0), TINY))
        slopes = orthonormal(np.concatenate([found, steep]), found)[len(found) :]
        slopes = slopes[np.abs((slopes * steep).sum(axis=1)) > least]
        last = len(found) + len(slopes)
        if not len(slopes):
            return found, len(found)
        if len(found) >= number:
            return found, 0
        if len(found) < free < last or number < last:
            seen = np.einsum("kd,dt->kt", slopes, rows)
            axes = np.linalg.eigh(np.einsum("it,jt->ij", seen, seen))[1].T[::-1]
            slopes = np.einsum("ij,jd->id", axes, slopes)[: number - len(found)]
        others = leading(rest[:, ::2], len(found) + len(slopes), found)[len(found) :]
        power = [(np.einsum("kd,dt->kt", v, rest[:, 1::2]) ** 2).sum() for v in (slopes, others)]
        if power[0] > power[1]:
            return np.concatenate([found, slopes]), len(found) + len(slopes)
        found = leading(rows, len(found) + 1, found)


def leading(rows: Floats, number: int, known: Floats) -> Floats:
    """Leading left singular vectors (number, n_det) of ``rows`` (n_det, n), of which the first are
    ``known`` (k, n_det). Each has a positive sum.
    """
    n_det = len(rows)
    start = normals(stream_key(0, "MaximumLikelihoodMap", 0), 0, number * n_det)
    vectors = orthonormal(start.reshape(number, n_det).astype(np.float64), known)
    for _ in range(ITERATIONS):
        times = np.einsum("kd,dt->kt", vectors, rows)
        vectors = orthonormal(np.einsum("kt,dt->kd", times, rows), known)
    return np.where(vectors.sum(axis=1, keepdims=True) < 0, -vectors, vectors)


def orthonormal(vectors: Floats, known: Floats) -> Floats:
    """Gram-Schmidt, in the order of the vectors; the first are ``known``."""
    found = list(known)[: len(vectors)]
    for row in vectors[len(found) :]:
        for _ in range(2):
            for other in found:
                row = row - (row * other).sum() * other
        size = np.sqrt((row * row).sum())
        found.append(row / size if size > 0 else np.zeros_like(row))
    return np.array(found).reshape(len(vectors), vectors.shape[1])
