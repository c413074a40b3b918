"""White and 1/f noise of a filtered map of I, Q and U that is smoothed with the beam, without its
time streams.

A sample i of weight a_i and noise of rms sigma_i sees r_i = (1, p cos 2 psi, p sin 2 psi) of (I, Q,
U). The map solves in each pixel (`operators.maps.binning`) for what has the covariance

    C = A^-1 N A^-1,   A = sum_i a_i r_i r_i^T,
    N = sum_i a_i^2 sigma_i^2 r_i r_i^T.                              (1)

The plane S of the map, smoothed with the beam K and the weights w = 1 / (A^-1)_SS of its pixels,
has at a pixel the variance

    sum_pixels K^2 w^2 C_SS / (sum_pixels K w)^2,   (2)

which is averaged over the pixels in a circle with the weights w. A is added up by the map's own
kernel in the map's own pixels. What the filters leave of it is the factor of `detector_noise`,
equation (2), of the weights K w a (A^-1)_S r of the samples.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from functools import partial

import numpy as np
from numpy.typing import NDArray

from zonda.core.block import Block
from zonda.core.maps.smoothing import convolved, gaussian_taps
from zonda.core.polarization import PolarizationAngles
from zonda.core.types import AnyFloats, Floats, Indices
from zonda.operators.maps.binning import BandBlock, Binning, Weights, add_blocks
from zonda.operators.maps.grid import Cells, Looking, TangentGrid
from zonda.operators.maps.intensity_kernel import WEIGHT
from zonda.operators.maps.stokes_kernel import MATRIX, PLACES

from .detector_noise import SIGNS, Comb, Filtered, Series, combs
from .survey import Survey, Track, polarization_angles

PLANES = "IQU"
PROBES = 64
"""Number of probes in the circle: angles differ more from place to place than numbers of samples.
"""
PER_PIXEL, PER_TURN = 2.0, 3.0
"""Instants per pixel that is crossed, and per cycle of the polarization's modulation by a half-wave
plate, of filtered series.
"""
SAMPLES = 1e9
"""Samples of all scans that are added up: of more, some instants are drawn, each of which stands
for several. A pixel then has so many that the few determine A as well."""
DETECTORS, INSTANTS = 256, 1 << 14
"""Detectors and instants that are added up at a time."""
FOLLOWED = 24
"""Scans after which the equations are solved; between them time x variance is linear."""


def variances(survey: Survey, radius: float) -> dict[str, dict[str, Floats]]:
    """Variances [K^2] after each scan, (n_scan,), ``white`` and ``1/f`` by plane of the map,
    averaged over a circle of ``radius`` [rad]; NaN where no pixel there is solved.
    """
    grid = _window(survey, radius)
    number = len(survey.observations)
    taps = gaussian_taps(survey.sigma / grid.pixel)
    after = np.unique(np.geomspace(1, number, min(number, FOLLOWED)).round().astype(int)) - 1
    limit = survey.steps.binning.condition_limit
    levels = survey.levels
    a = np.zeros((grid.n_pixels, 6))
    noise = np.zeros((len(levels[0]), grid.n_pixels, 6))
    found = np.full((len(PLANES), len(levels[0]), number), np.nan)
    for scan, sums in enumerate(_scans(survey, grid)):
        a += survey.weights[scan] * sums
        for k, level in enumerate(levels[scan]):
            noise[k] += (survey.weights[scan] * level.sample) ** 2 * sums
        if scan in after:
            found[:, :, scan] = _smoothed(inverse(a, limit), noise, grid, taps, radius)
    rate = max(PER_PIXEL * survey.speed / grid.pixel, survey.rate) + PER_TURN * survey.modulation
    solved = inverse(a, limit)
    looks = _Looks(survey, grid)
    planes = {}
    for s, plane in enumerate(PLANES):
        weight = _weight(solved[:, s, s]).reshape(grid.shape)
        draws = _signed(looks, grid, solved[:, s], weight, taps, combs(survey, radius, PROBES))
        filtered = Filtered(survey, draws, rate)
        planes[plane] = {"white": np.zeros(number), "1/f": np.zeros(number)}
        for k, level in enumerate(levels[0]):
            known = survey.seconds[after] * found[s, k, after]
            planes[plane][level.part] += (
                filtered.share(k)
                * np.interp(survey.seconds, survey.seconds[after], known)
                / survey.seconds
            )
    return planes


def inverse(a: Floats, limit: float) -> Floats:
    """(n, 3, 3) A^-1 of the sums (n, 6); NaN where the condition number is above the ``limit``."""
    low, axes = np.linalg.eigh(a[:, PLACES].reshape(-1, 3, 3))
    fine = (low[:, 2] > 0) & (low[:, 0] * limit >= low[:, 2])
    found = np.full((len(a), 3, 3), np.nan)
    found[fine] = (axes[fine] / low[fine, None, :]) @ axes[fine].transpose(0, 2, 1)
    return found


def _window(survey: Survey, radius: float) -> TangentGrid:
    """The pixels of the map that the smoothed circle sees."""
    grid = survey.grid
    half = math.ceil((radius + 5 * survey.sigma) / grid.pixel) + 1
    ny, nx = (min(n, 2 * half + n % 2) for n in grid.shape)
    return dataclasses.replace(grid, shape=(ny, nx))


def _scans(survey: Survey, grid: TangentGrid) -> Iterator[Floats]:
    """Sum of r r^T in all pixels, (n_pixels, 6), for each scan."""
    rng = np.random.default_rng(5)
    plane = survey.focalplane
    share = min(1.0, SAMPLES / sum(o.n_samples * len(plane) for o in survey.observations))
    signal = np.zeros((min(DETECTORS, len(plane)), INSTANTS), np.float32)
    for o in survey.observations:
        index = np.arange(o.n_samples)
        if share < 1:
            index = np.sort(rng.permutation(o.n_samples)[: max(1, round(share * o.n_samples))])
        looking = Looking(o, grid, np.ascontiguousarray(grid.pointing(o)[:, index]))
        angles: PolarizationAngles = polarization_angles(survey, o, index)
        ones = np.ones(len(plane))
        good = np.ones(index.size, np.uint8)
        weights = Weights(ones, ones, np.zeros(0))
        binning = Binning(looking, ones > 0, good, weights, slice(0, 1), angles=angles)
        for first in range(0, len(plane), DETECTORS):
            for start in range(0, index.size, INSTANTS):
                detectors = slice(first, min(first + DETECTORS, len(plane)))
                block = Block(o, detectors, slice(start, min(start + INSTANTS, index.size)))
                n_det, n = block.shape
                signals = (np.ascontiguousarray(signal[:n_det, :n]),)
                add_blocks([BandBlock(signals, block, [[binning]])], Cells())
        total = np.zeros((grid.n_pixels, 6))
        for thread in binning.threads.values():
            total += thread.sums[:, MATRIX] * (o.n_samples / index.size / WEIGHT)
        yield total


def _smoothed(
    solved: Floats,
    noise: Floats,
    grid: TangentGrid,
    taps: Floats,
    radius: float,
) -> Floats:
    """(3, n_noise) equation (2) in the circle; ``solved``: A^-1, ``noise`` (n_noise, n_pixels, 6):
    N.
    """
    found = np.full((len(PLANES), len(noise)), np.nan)
    inside = _distance(grid) <= radius
    for s in range(len(PLANES)):
        weight = _weight(solved[:, s, s]).reshape(grid.shape)
        near = inside & (weight > 0)
        if not near.any():
            continue
        total = convolved(weight, taps)[near]
        row = np.nan_to_num(solved[:, s])
        for k, each in enumerate(noise):
            own = np.einsum("ni,nij,nj->n", row, each[:, PLACES].reshape(-1, 3, 3), row).reshape(
                grid.shape
            )
            squares = convolved(weight**2 * own, taps**2)[near]
            found[s, k] = np.average(squares / total**2, weights=weight[near])
    return found


class _Looks:
    """Series of detectors by the pixels that they look at, and by their angles: those of the latest
    track are kept.
    """

    def __init__(self, survey: Survey, grid: TangentGrid) -> None:
        self._survey = survey
        self._grid = grid
        self._track: Track | None = None

    def series(self, rows: NDArray[np.float32], track: Track, few: Indices) -> AnyFloats:
        """(n_det, n_instant) r times the row (n_pixels + 1, 3) of the pixel of a detector's sample;
        the last: outside.
        """
        if track is not self._track:
            o = track.observation
            grid = self._grid
            cosine, sine = np.empty((2, len(few), len(track.index)))
            polarization_angles(self._survey, o, track.index).fill(few, 0, cosine, sine)
            efficiency = o.focalplane.polarization_efficiency[few, None]
            self._cosine, self._sine = (
                (efficiency * each).astype(np.float32) for each in (cosine, sine)
            )
            pointing = np.ascontiguousarray(grid.pointing(o)[:, track.index])
            self._pixels = Looking(o, grid, pointing).pixels(few, 0, len(track.index))
            self._track = track
        found: AnyFloats = rows[self._pixels, 0]
        found += rows[self._pixels, 1] * self._cosine
        found += rows[self._pixels, 2] * self._sine
        return found


def _signed(
    looks: _Looks,
    grid: TangentGrid,
    row: Floats,
    weight: Floats,
    taps: Floats,
    chosen: list[Comb],
) -> list[Series]:
    """Same as `detector_noise._signed`, from ``row`` (n_pixels, 3), (A^-1)_S, and ``weight`` (ny,
    nx), w.
    """
    rng = np.random.default_rng(2)
    draws: list[Series] = []
    total = convolved(weight, taps)
    for comb in chosen:
        at = (comb.origin + comb.spacing * np.argwhere(comb.inside)) / grid.pixel  # columns, rows
        columns, rows = (
            np.clip(np.rint(at[:, k] + (n - 1) / 2).astype(int), 0, n - 1)
            for k, n in enumerate(grid.shape[::-1])
        )
        with np.errstate(divide="ignore"):
            size = np.where(total[rows, columns] > 0, total[rows, columns] ** -0.5, 0.0)
        for _ in range(max(1, SIGNS // len(chosen))):
            probes = np.zeros(grid.shape)
            probes[rows, columns] = rng.choice([-1.0, 1.0], len(size)) * size
            each = (convolved(probes, taps) * weight).reshape(-1, 1) * np.nan_to_num(row)
            draws.append(
                partial(looks.series, np.append(each, np.zeros((1, 3)), axis=0).astype(np.float32))
            )
    return draws


def _weight(spread: Floats) -> Floats:
    """1 / (A^-1)_SS, 0 where it is not known."""
    return np.nan_to_num(1 / spread)


def _distance(grid: TangentGrid) -> Floats:
    """Distance of the pixels from the map's centre, rad."""
    rows, columns = ((np.arange(n) - (n - 1) / 2) * grid.pixel for n in grid.shape)
    return np.asarray(np.hypot(rows[:, None], columns[None]))
