"""Modes that the detectors of a scan share, as leading vectors of slow baselines and as what long
waves of the atmosphere make: the same for all detectors, and gradients across the focal plane.
"""

from __future__ import annotations

from collections.abc import Sequence
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from zonda.core.numerics.random import normals, stream_key
from zonda.core.types import Bools, Floats, Indices

CLEAR = 2.0
"""Power of what all detectors see alike over the mean over directions, from which it is a mode."""
PATTERN = 1.4
"""Power of a leading vector over that of noise, from which it is a pattern: beside gradients it is
0.98 to 1.04 for MUSTANG-2, and 1.8 for AtLAST, whose focal plane is not small beside the waves."""
TINY = 1e-300
ITERATIONS = 40
"""Products with the covariance in the search for its leading modes."""
ALIKE = 1e-6
"""Share of a gradient that is not that of other modes, below which it is one of them."""
NOWHERE = np.zeros((2, 0))
"""Places of detectors that are not known."""


def members(groups: Indices) -> list[NDArray[np.intp]]:
    """The detectors of each group."""
    return [np.flatnonzero(groups == number) for number in np.unique(groups)]


def leading_of(
    groups: Indices,
    rows: Floats,
    numbers: Sequence[int],
    known: Floats,
    places: Floats = NOWHERE,
    free: int = 1,
    alike: Floats | None = None,
) -> tuple[Floats, Bools]:
    """`leading` vectors of each group, as many as its number, 0 for other detectors: the first of
    all groups, then the second of all ...; some are ``known`` (k, n_det).

    Where ``places`` are known, those of `with_gradients` are first among three or more, of which so
    many are ``free``. Returns the vectors, and true for those up to the gradients.
    """
    found = []
    for number, at in zip(numbers, members(groups), strict=True):
        own = known[(known[:, at] != 0).any(axis=1)][:number, at]
        steady = 0
        if places.size and number > 2:
            same = None if alike is None else alike[at]
            own, steady = with_gradients(rows[at], own, places[:, at], number, free, same)
        vectors = np.zeros((number, len(rows)))
        vectors[:, at] = leading(rows[at], number, own)
        found += [(k, vector, k < steady) for k, vector in enumerate(vectors)]
    ordered = sorted(found, key=itemgetter(0))
    kept = np.array([steady for _, _, steady in ordered], np.bool_)
    return np.array([vector for _, vector, _ in ordered]).reshape(-1, len(rows)), kept


def with_gradients(
    rows: Floats,
    known: Floats,
    places: Floats,
    number: int,
    free: int,
    alike: Floats | None = None,
) -> tuple[Floats, int]:
    """First vectors (at most ``number``, n_det) of what detectors share in ``rows`` (n_det, n), of
    which some are ``known``; and their number, 0 where these are the known ones alone.

    They are what all see ``alike`` (n_det,), or one leading vector or more; and u x and u y, u the
    first and ``places`` (2, n_det) the detectors', as long waves of the atmosphere make them.
    Leading vectors that are found in noise miss the gradients by so much that the atmosphere stays
    in the map. Gradients of a short scan look like its common mode by chance: u is then tilted, and
    fast common noise stays, too. The first of these is taken beside which there is `noise_alone`.
    Where one gradient alone is ``free``, or has room, it is that along which rows change most.
    """
    firsts = [(known, number)] if len(known) else [(leading(rows, 1, known), number)]
    if alike is not None and not len(known):
        same = orthonormal(alike[None], known)
        if (np.einsum("kd,dt->kt", same, rows) ** 2).sum() > CLEAR * (rows**2).sum() / len(rows):
            firsts.insert(0, (same, 1))
    for found, most in firsts:
        steep = found[:1] * (places - (found[:1] ** 2 * places).sum(axis=1, keepdims=True))
        least = ALIKE * np.sqrt((steep**2).sum(axis=1))
        while True:
            slopes = orthonormal(np.concatenate([found, steep]), found)[len(found) :]
            slopes = slopes[np.abs((slopes * steep).sum(axis=1)) > least]
            last = len(found) + len(slopes)
            if not len(slopes):
                return found, len(found)
            if len(found) >= number:
                break
            if len(found) < free < last or number < last:
                seen = np.einsum("kd,dt->kt", slopes, rows)
                axes = np.linalg.eigh(np.einsum("it,jt->ij", seen, seen))[1].T[::-1]
                slopes = np.einsum("ij,jd->id", axes, slopes)[: number - len(found)]
            every = np.concatenate([found, slopes])
            if noise_alone(rows, every):
                return every, len(every)
            if len(found) >= most:
                break
            found = leading(rows, len(found) + 1, found)
    return known, 0


def noise_alone(rows: Floats, vectors: Floats) -> bool:
    """True if ``rows`` (n_det, n) have no pattern beside orthonormal ``vectors`` (k, n_det): with
    detectors and columns of equal size, the leading one holds no more than that of white noise,
    (sqrt(n_det) + sqrt(n))^2 times the variance (Marchenko & Pastur 1967).
    """
    for _ in range(2):  # fitted alike, then by each detector's noise beside them
        rest = rows - np.einsum("kd,kt->dt", vectors, np.einsum("kd,dt->kt", vectors, rows))
        size = np.sqrt(np.maximum((rest**2).mean(axis=1, keepdims=True), TINY))
        rows, vectors = rows / size, orthonormal(vectors / size.T, vectors[:0])
    rest /= np.sqrt(np.maximum((rest**2).mean(axis=0), TINY))
    first = leading(rest, 1, vectors[:0])
    edge = (np.sqrt(rest.shape[0]) + np.sqrt(rest.shape[1])) ** 2
    return bool((np.einsum("kd,dt->kt", first, rest) ** 2).sum() < PATTERN * edge)


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
