"""The equations of a maximum-likelihood map, P^T Q P m = P^T Q d, and their solution.

With the noise of `baseline_noise`, in which x is what a map m, or the data, make of the samples,

    P^T Q x = P^T x / sigma^2 - Y^T (n / sigma^2) y - S^T s + Y^T Q_b y,                     (1)

where y and s are those of `compressed_scan`, and n the samples of a baseline that count: samples
about the mean of their baseline, without free modes, have the weight of white noise; baselines have
that of their own spectrum. (1) is added up over scans, in their order. Gaps (`compressed_scan`) are
unknowns beside the map, so that noise is stationary, and shared by all detectors, where some of
them lack samples; the map is that of the samples that count.

Conjugate gradients, preconditioned with the inverse of the weights in each pixel (of I, Q and U the
pseudo-inverse of a 3 x 3 matrix), end where the norm of the residual in that metric is `tolerance`
times that of the right side. Of their coefficients follow the Ritz values of the preconditioned
matrix: where the smallest is far below 1 there are patterns that the data hardly determine.

After `PATIENCE` iterations, where those that are left cost more than `preconditioner` does, they
begin again at the map of least residual that they have, with smooth patterns added to the
preconditioner. Residuals alone decide, not seconds: the map's bits depend on nothing else.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from zonda.core.kernels import kernel
from zonda.core.numerics.random import Key, normals, stream_key
from zonda.core.product import Product
from zonda.core.stream import forget_pages, in_order
from zonda.core.types import Floats

from .baseline_noise import BaselineNoise
from .compressed_scan import CompressedScan
from .map_from_sums import SINGULAR, TRIANGLE
from .preconditioner import PATTERNS, UNDETERMINED, SmoothPatterns
from .stokes_kernel import PLACES

PATIENCE, RECENT = 25, 10
"""Iterations before smooth patterns may be added; last ones from which the number of those that are
left is predicted."""

EXACT, MOST = 1e-10, 1000
"""Residual at which values of gaps for a given map are known, and iterations at most."""


@dataclass
class Compressed:
    """A compressed scan, its noise, y and s of its signals, and the first detector of each band and
    their number.
    """

    scan: CompressedScan
    noise: BaselineNoise
    data: dict[str, tuple[Floats, Floats]]
    ends: list[int]


class CompressedScans(Product):
    """Compressed scans, in their order."""

    in_files = True

    def __init__(self, scans: list[Compressed]) -> None:
        self.scans = scans

    def __iadd__(self, other: CompressedScans) -> CompressedScans:
        self.scans += other.scans
        return self

    def arrays(self) -> Mapping[str, Any]:
        """See `Product.arrays`."""
        return {
            "scans": [
                {
                    "scan": {key: v for key, v in vars(c.scan).items() if key != "again"},
                    "noise": vars(c.noise),
                    "data": {n: list(d) for n, d in c.data.items()},
                    "ends": c.ends,
                }
                for c in self.scans
            ]
        }

    @classmethod
    def of(cls, arrays: Mapping[str, Any]) -> CompressedScans:
        """See `Product.of`."""
        return cls(
            [
                Compressed(
                    CompressedScan(**one["scan"]),
                    BaselineNoise(**one["noise"]),
                    {name: tuple(pair) for name, pair in one["data"].items()},
                    one["ends"],
                )
                for one in arrays["scans"]
            ]
        )


class WeighedScan(NamedTuple):
    """A scan with its noise."""

    scan: CompressedScan
    noise: BaselineNoise

    def spread(self, y: Floats, s: Floats, n_stokes: int) -> Floats:
        """The last three terms of equation (1), (n_stokes, scan.width)."""
        scan, noise = self
        found = np.zeros((n_stokes, scan.width))
        slow, within = noise.weigh(y, scan.counted), y / noise.white[:, None]
        within *= scan.counted
        slow -= within
        scan.spread(slow, -s, noise.free_modes, found)
        return found

    def draw(self, n_stokes: int, key: Key) -> tuple[Floats, Floats, Floats]:
        """P^T n / sigma^2 (n_stokes, scan.width), baselines y and free streams s of a draw n of the
        noise: white noise, baselines and shared modes; free modes, of which maps see nothing, are
        left out. ``key``: of the random numbers, which count the samples of each detector.
        """
        scan, noise = self
        n_base, a = scan.shape[1], noise.free_modes
        binned, y = np.zeros((n_stokes, scan.width)), noise.draw(n_base, key)
        s = np.zeros((len(a), scan.n_samples))
        base = np.repeat(np.arange(n_base), scan.length)[: scan.n_samples]
        for some, (first, pixel, samples, angles, _) in scan.parts():
            for row, d in enumerate(range(some.start, some.stop)):
                begins = first[row * n_base : (row + 1) * n_base + 1]
                runs = slice(begins[0], begins[-1])
                at, number = pixel[runs], samples[runs].astype(np.intp)
                seen = at < scan.n_pixels
                counts = np.repeat(seen, number)
                white = normals(key, 0, scan.n_samples, d) * np.sqrt(noise.white[d]) * counts
                total = np.add.reduceat(white, np.cumsum(number) - number)
                mean = np.add.reduceat(total, begins[:-1] - begins[0])
                mean /= np.maximum(scan.known[d], 1)
                s += a[:, d, None] * (white - counts * mean[base])
                total += seen * number * np.repeat(y[d], np.diff(begins))
                y[d] += mean
                total *= seen / noise.white[d]
                add_to(binned[0], at, total)
                for out, angle in zip(binned[1:], angles[:, runs], strict=False):
                    add_to(out, at, total * angle)
        return binned, y, s

    def square(self, y: Floats, s: Floats) -> float:
        """Sum d^T Q d of the complete signal, whose y and s these are."""
        scan, noise = self
        slow = float((y * noise.weigh(y, scan.counted)).sum())
        return float((scan.within / noise.white).sum()) - float((s * s).sum()) + slow

    @property
    def freedom(self) -> float:
        """Degrees of freedom of the samples: those that neither free modes nor polynomials take."""
        scan, noise = self
        samples = scan.known.sum(axis=1)
        of_mode = scan.counted.sum(axis=1)  # of gaps too: one value at each instant
        free = float(((noise.modes[: noise.free] ** 2).sum(axis=0) * of_mode).sum())
        lines = len(noise.lines) * (np.count_nonzero(samples) - noise.free)
        return float(samples.sum()) - free - lines


class Solution(NamedTuple):
    """A map, and how it was found.

    Attributes
    ----------
    values
        (n_stokes, n_pixels), K; 0 without samples. The one with the least residual.
    history
        Norm of the residual after each iteration, over that of the right side, in the metric of the
        preconditioner in use.
    ritz
        Ritz values of the matrix preconditioned with the weights of pixels, rising: those of the
        iterations without smooth patterns, and those of the patterns.
    smooth, before
        Smooth patterns of the preconditioner, and the iterations before they were added.
    gaps
        (n_stokes, gaps of all scans) values there, less the mean of their baseline in the streams.
    """

    values: Floats
    history: list[float]
    ritz: Floats
    smooth: SmoothPatterns | None = None
    before: int = 0
    gaps: Floats = field(default_factory=lambda: np.zeros((1, 0)))


@dataclass
class Work:
    """Products with equation (1), right sides of the data among them, and CPU seconds of their
    scans."""

    products: int = 0
    seconds: float = 0.0


@dataclass
class NormalEquations:
    """Equation (1) of some scans, for maps (n_stokes, n_pixels).

    ``threads``: scans that are worked on at a time; ``places``: coordinates (2, n) of pixels, for
    smooth patterns; ``work``: is added to.
    """

    scans: Sequence[WeighedScan]
    n_stokes: int
    n_pixels: int
    threads: int = 1
    places: Callable[[NDArray[np.intp]], Floats] | None = None
    work: Work = field(default_factory=Work)

    def __post_init__(self) -> None:
        rows = 1 if self.n_stokes == 1 else 6
        self._ends = np.cumsum([self.n_pixels, *(scan.gaps for scan, _ in self.scans)]).tolist()
        self._wide = np.zeros((rows, self._ends[-1]))
        for k, (scan, noise) in enumerate(self.scans):
            weights = self._part(self._wide, k)
            scan.weigh(1 / noise.white, weights)
            self._take(self._wide, k, weights)
        self.weights = self._wide[:, : self.n_pixels]
        self._inverse = np.zeros_like(self._wide)
        self._inverse[:, : self.n_pixels] = inverse_of(self.weights)
        self._inverse[0, self.n_pixels :] = 1 / self._wide[0, self.n_pixels :]
        self.inverse = self._inverse[:, : self.n_pixels]

    def _part(self, m: Floats, k: int) -> Floats:
        """Map and gaps of a scan, (rows, scan.width); a view where the scan has no gap."""
        gaps = slice(self._ends[k], self._ends[k + 1])
        if gaps.start == gaps.stop:
            return m[:, : self.n_pixels]
        return np.concatenate([m[:, : self.n_pixels], m[:, gaps]], axis=1)

    def _take(self, m: Floats, k: int, part: Floats) -> None:
        """Write map and gaps of a scan into those of all."""
        m[:, : self.n_pixels] = part[:, : self.n_pixels]
        m[:, self._ends[k] : self._ends[k + 1]] = part[:, self.n_pixels :]

    def _widened(self, m: Floats) -> Floats:
        """A map, or one with gaps, as one with gaps; 0 there if it has none."""
        return np.pad(m, ((0, 0), (0, self._ends[-1] - m.shape[1])))

    @property
    def spread(self) -> Floats:
        """(n_stokes, n_pixels) diagonal of the inverse weights; 0 without samples."""
        return self.inverse if self.n_stokes == 1 else self.inverse[[0, 3, 5]]

    @property
    def rank(self) -> float:
        """Number of values of a map that the weights of pixels determine."""
        places = [0] if self.n_stokes == 1 else list(PLACES)
        return float((self.inverse[places] * self.weights[places]).sum())

    def chi_square(
        self, found: Solution, right: Floats, data: Sequence[tuple[Floats, Floats]]
    ) -> tuple[float, float]:
        """chi^2 = (d - P m)^T Q (d - P m) of the complete signal and its map, per degree of
        freedom, and its standard error where Q is the inverse covariance of the noise. ``right``,
        ``data``: as of `right_side`.
        """
        square = math.fsum(scan.square(*one) for scan, one in zip(self.scans, data, strict=True))
        m = np.concatenate([found.values, found.gaps], axis=1)
        square += float((m * (self._product(m) - 2 * right)).sum())
        freedom = sum(scan.freedom for scan in self.scans) - self.rank
        return float(square / freedom), math.sqrt(2 / freedom)

    def right_side(self, binned: Floats, data: Sequence[tuple[Floats, Floats]]) -> Floats:
        """The right side, also of gaps: ``binned`` P^T d / sigma^2, and y and s of the data of each
        scan.
        """
        out = self._widened(binned)
        for k, ((scan, noise), (y, _)) in enumerate(zip(self.scans, data, strict=True)):
            gaps = slice(self._ends[k], self._ends[k + 1])
            out[0, gaps] = scan.in_gaps(y / noise.white[:, None])
        return out + self._added(data.__getitem__)

    def draw(self, number: int, k: int) -> tuple[Floats, Floats, Floats]:
        """Draw of the noise of scan k, as `WeighedScan.draw`; ``number`` of the draw."""
        key = stream_key(0, "MaximumLikelihoodMap", "draw", number, k)
        return self.scans[k].draw(self.n_stokes, key)

    def drawn(self, number: int) -> Floats:
        """Right side of a draw of the noise, of map and gaps. A map takes a part of the noise with
        it: m of noise n with the inverse covariance Q has the covariance (P^T Q P)^-1, and

            <(n - P m) (n - P m)^T> = Q^-1 - <P m (P m)^T>.                              (2)

        Spectra of data minus their map are too low by those of P m, in a short scan by half. The
        map of a draw tells by how much (restricted maximum likelihood, Patterson & Thompson 1971).
        """

        def one(k: int) -> Floats:
            scan, noise = self.scans[k]
            out, y, s = self.draw(number, k)
            out[0, self.n_pixels :] = scan.in_gaps(y / noise.white[:, None])
            return out + self.scans[k].spread(y, s, self.n_stokes)

        return self._sum(one)

    def apply(self, m: Floats, own: slice = slice(None), *how: Any) -> Floats:
        """P^T Q P m, Q of the samples that count; ``own``, ``how``: as of `eliminated`."""
        return self.eliminated(self._product(self._widened(m)), own, *how)

    def eliminated(
        self,
        right: Floats,
        own: slice = slice(None),
        tolerance: float = EXACT,
        tell: Callable[[float], None] = lambda residual: None,
    ) -> Floats:
        """A right side, or a product, of the pixels ``own`` of the map alone (n_stokes, n_pixels):
        gaps, and other pixels, are solved for by conjugate gradients, and what they make of the map
        is taken off. ``tolerance``, ``tell``: as of `solve`.
        """
        inverse = self._inverse.copy()
        inverse[:, : self.n_pixels][:, own] = 0.0
        if inverse.any():
            others = self.solve(right, tolerance, MOST, inverse, tell)
            values = np.concatenate([others.values, others.gaps], axis=1)
            right = right - self._product(values)
        return right[:, : self.n_pixels]

    def _product(self, m: Floats) -> Floats:
        """Left side of a map with gaps."""

        def seen(k: int) -> tuple[Floats, Floats]:
            scan, noise = self.scans[k]
            return scan.seen(self._part(m, k), noise.free_modes)

        return times(self._wide, m) + self._added(seen)

    def solve(
        self,
        right: Floats,
        tolerance: float,
        most: int,
        inverse: Floats | None = None,
        tell: Callable[[float], None] = lambda residual: None,
    ) -> Solution:
        """Conjugate gradients from 0, at most so many iterations: the map with the least residual.
        Behind it, and along patterns that the data do not determine, there is rounding alone.

        ``inverse``: of the weights of what is solved for, 0 elsewhere; None: map and gaps.
        ``tell``: told the residual after each iteration, over that of the right side.
        """
        places, right = self.places if inverse is None else None, self._widened(right)
        weights = self._inverse if inverse is None else inverse
        m, r, smooth, before = np.zeros_like(right), right.copy(), None, 0
        z = times(weights, r)
        p, product = z.copy(), float((r * z).sum())
        first, history, ritz = product, list[float](), list[Floats]()
        steps, turns, best, size = list[float](), list[float](), m, product
        while first > 0 and len(history) < most and (not history or history[-1] >= tolerance):
            if smooth is None and places and takes_long(history, tolerance):
                smooth, before = self.smooth, len(history)
                ritz = [ritz_values(steps, turns), smooth.information]
                z[0] += smooth.correct(r[0])
                p, product, steps, turns = z, float((r * z).sum()), [], []
                size = product
                first += float((right[0] * smooth.correct(right[0])).sum())
            q = self._product(p)
            if (curvature := float((p * q).sum())) <= UNDETERMINED * size:
                break
            step = product / curvature
            m += step * p
            r -= step * q
            z = times(weights, r)
            if smooth:
                z[0] += smooth.correct(r[0])
            product, last = float((r * z).sum()), product
            steps.append(step)
            turns.append(product / last)
            history.append(float(np.sqrt(max(product, 0.0) / first)))
            tell(history[-1])
            if history[-1] == min(history[before:]):
                best = m.copy()
            p, size = z + turns[-1] * p, product + turns[-1] ** 2 * size
        ritz = ritz or [ritz_values(steps, turns)]
        values, gaps = np.split(best, [self.n_pixels], axis=1)
        return Solution(values, history, np.sort(np.concatenate(ritz)), smooth, before, gaps)

    def baselines(self, found: Solution, k: int) -> Floats:
        """Y m of a scan, (n_det, n_base): of a map and gaps that were found."""
        scan, noise = self.scans[k]
        m = self._part(np.concatenate([found.values, found.gaps], axis=1), k)
        return scan.seen(m, np.zeros((0, len(noise.white))))[0]

    @cached_property
    def smooth(self) -> SmoothPatterns:
        """Smooth patterns of I, and what the scans tell of them."""
        assert self.places is not None

        def of_intensity(m: Floats) -> Floats:
            rows = self._widened(np.zeros((self.n_stokes, self.n_pixels)))
            rows[0, : self.n_pixels] = m
            return np.asarray(self._product(rows)[0, : self.n_pixels])

        return SmoothPatterns.of(self.places, self.weights[0], of_intensity)

    def _added(self, of: Callable[[int], tuple[Floats, Floats]]) -> Floats:
        """Last three terms of equation (1), added up in order, from y and s ``of`` scan k."""

        seconds = [0.0] * len(self.scans)

        def one(k: int) -> Floats:
            begun = time.thread_time()
            y, s = of(k)
            found = self.scans[k].spread(y, s, self.n_stokes)
            seconds[k] = time.thread_time() - begun
            for array in (y, s, self.scans[k].scan.counted):  # in files they stay there
                forget_pages(array)
            return found

        total = self._sum(one)
        self.work.products += 1
        self.work.seconds += sum(seconds)
        return total

    def _sum(self, one: Callable[[int], Floats]) -> Floats:
        """Maps with gaps of ``one`` scan k, added up in order."""
        total, number = np.zeros((self.n_stokes, self._ends[-1])), len(self.scans)
        parts = in_order(one, ((k,) for k in range(number)), min(self.threads, number))
        for k, part in enumerate(parts):
            total[:, : self.n_pixels] += part[:, : self.n_pixels]
            total[:, self._ends[k] : self._ends[k + 1]] = part[:, self.n_pixels :]
        return total


@kernel
def add_to(out, at, values):  # type: ignore[no-untyped-def]
    """Add values (n,) to pixels of a map, in their order; those beyond it are left out."""
    for r in range(at.size):
        if at[r] < out.size:
            out[at[r]] += values[r]


def inverse_of(weights: Floats) -> Floats:
    """Pseudo-inverse of symmetric matrices of pixels (1 or 6, n_pixels), in their places; 0 without
    samples.
    """
    out, seen = np.zeros_like(weights), weights[0] > 0
    if len(weights) == 1:
        out[:, seen] = 1 / weights[:, seen]
        return out
    low, axes = np.linalg.eigh(weights[:, seen].T[:, PLACES].reshape(-1, 3, 3))
    fine = low > SINGULAR * low[:, 2:]
    inverse = np.where(fine, 1 / np.where(fine, low, 1.0), 0.0)
    every = np.einsum("nij,nj,nkj->nik", axes, inverse, axes)
    out[:, seen] = every[:, *TRIANGLE].T
    return out


def times(matrix: Floats, m: Floats) -> Floats:
    """Product of a symmetric matrix in each pixel, (1 or 6, n_pixels), with a map."""
    if len(matrix) == 1:
        return matrix * m
    return np.stack([(matrix[list(row)] * m).sum(axis=0) for row in np.reshape(PLACES, (3, 3))])


def takes_long(history: Sequence[float], tolerance: float) -> bool:
    """True if, at the rate of the last iterations, more than `PATTERNS` are left."""
    if len(history) < PATIENCE:
        return False
    gained = np.log(history[-1 - RECENT] / history[-1])
    return bool(RECENT * np.log(history[-1] / tolerance) > PATTERNS * gained)


def ritz_values(steps: Sequence[float], turns: Sequence[float]) -> Floats:
    """Ritz values of the coefficients of conjugate gradients (Golub & Van Loan 2013, 11.3)."""
    if not steps:
        return np.zeros(0)
    alpha, beta = np.array(steps), np.array(turns[:-1])
    diagonal = 1 / alpha
    diagonal[1:] += beta / alpha[:-1]
    from scipy.linalg import eigh_tridiagonal

    return np.asarray(eigh_tridiagonal(diagonal, np.sqrt(beta) / alpha[:-1], eigvals_only=True))
