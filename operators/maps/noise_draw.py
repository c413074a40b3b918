"""Noise as its model tells it, drawn for the normal equations of a map.

A map takes a part of the noise with it: with Q the inverse covariance N^-1 of the noise n, the map
m of n has the covariance (P^T Q P)^-1, and

    <(n - P m) (n - P m)^T> = N - <P m (P m)^T>.                                             (1)

Spectra that are estimated from data minus their map are too low by those of P m, in a short scan by
half. The map of a draw of the noise tells by how much (restricted maximum likelihood, Patterson &
Thompson 1971).
"""

from __future__ import annotations

import numpy as np
from scipy import fft

from zonda.core.numerics.random import Key, normals
from zonda.core.types import Floats

from .baseline_noise import BaselineNoise
from .compressed_scan import CompressedScan


def draw(
    scan: CompressedScan, noise: BaselineNoise, n_stokes: int, key: Key
) -> tuple[Floats, Floats, Floats]:
    """P^T n / sigma^2 (n_stokes, scan.width), baselines y and free streams s of a draw n of the
    ``noise``: of white noise, of baselines and of shared modes. Free modes, of which maps see
    nothing, are left out. ``key``: of the random numbers, which count samples of each detector.
    """
    n_base = scan.shape[1]
    binned = np.zeros((n_stokes, scan.width))
    a, y = noise.free_modes, slow_noise(noise, n_base, key)
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
            weight = total[seen] / noise.white[d]
            binned[0] += np.bincount(at[seen], weight, scan.width)
            for out, angle in zip(binned[1:], angles[:, runs], strict=False):
                out += np.bincount(at[seen], weight * angle[seen], scan.width)
    return binned, y, s


def slow_noise(noise: BaselineNoise, n_base: int, key: Key) -> Floats:
    """Draw of what baselines have beside white noise (n_det, n_base), K: the detectors' own, and
    modes that are not free.
    """
    n_det, bins = len(noise.white), np.repeat(np.arange(len(noise.own)), np.diff(noise.edges))
    own = normals(key, 0, n_det * n_base, n_det).reshape(n_det, n_base).astype(np.float64)
    found = fft.rfft(own, axis=1) * np.sqrt(noise.own[bins] - 1)
    for k in range(noise.free, len(noise.modes)):
        shared = fft.rfft(normals(key, 0, n_base, n_det + 1 + k).astype(np.float64))
        found += noise.modes[k][:, None] * (np.sqrt(noise.shared[bins, k]) * shared)
    g = np.sqrt(noise.white / noise.length)[:, None]
    return np.asarray(g * fft.irfft(found, n_base, axis=1))
