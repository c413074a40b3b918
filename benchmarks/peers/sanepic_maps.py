"""pysanepic's generalized least squares of one scan: python sanepic_maps.py SCAN.npz MODES MAP.npy

Weights at the full rate: spectra, means over bins of frequency, of the noise itself and of modes
that detectors share. So it is told at least as well as it could estimate. Transforms are float64,
as they always are with common modes, and as long as the scan: padded to the length that its
`fast_fft_length` names each takes 0.8 times as long, and iterations are twice as many.
"""

from __future__ import annotations

import sys
from importlib.metadata import version
from itertools import pairwise

import numpy as np
from common import case, cpu, peak, report
from pysanepic import GLS

FEW, MANY, MOST = 4, 24, 100
"""Iterations that are timed, and of the map."""
TOLERANCE = 1e-10
"""Of the residual's square."""


def spectra(noise: np.ndarray, modes: int) -> tuple[np.ndarray, ...]:
    """Modes (n_det, modes), and powers of a sample [K^2], (n // 2 + 1,) of one detector and
    (modes, ...) of the modes.
    """
    n_det, n = noise.shape
    slow = noise[:, : n // 64 * 64].reshape(n_det, -1, 64).mean(axis=2)
    shared = np.linalg.eigh(slow @ slow.T)[1][:, ::-1][:, :modes]
    found = np.fft.rfft(noise, axis=1) / np.sqrt(n)
    amplitude = shared.T @ found
    rest = (np.abs(found - shared @ amplitude) ** 2).sum(axis=0) / (n_det - modes)
    edges = np.unique(np.concatenate([[1, 4], np.geomspace(4, n // 2 + 1, 50).astype(int)]))
    middle = (edges[:-1] + edges[1:] - 1) / 2 / n
    at = np.maximum(np.arange(n // 2 + 1), 1) / n

    def binned(power: np.ndarray) -> np.ndarray:
        means = [power[a:b].mean() for a, b in pairwise(edges)]
        return np.exp(np.interp(np.log(at), np.log(middle), np.log(means)))

    own = binned(rest)
    each = [np.maximum(binned(np.abs(row) ** 2) - own, 0) for row in amplitude]
    return shared, own, np.array(each)


def main() -> None:
    given, modes, path = case(), int(sys.argv[2]), sys.argv[3]
    pixel, noise = given["pixel"], given["noise"].astype(np.float64)
    n_det, n = noise.shape
    t = np.linspace(-1, 1, n)
    noise -= noise.mean(axis=1, keepdims=True)
    noise -= np.outer(noise @ t / (t @ t), t)
    shared, own, each = spectra(noise, modes)
    common = [(list(range(n_det)), shared, each)] if modes else None
    start = cpu()
    system = GLS(
        pixel,
        None,
        [1 / own] * n_det,
        common_modes=common,
        nthreads=1,
    )
    system.apply_A(np.zeros((1, system.nobs)))  # and compilation
    setup, seconds = cpu() - start, []
    for most in (FEW, MANY):
        start = cpu()
        system.solve(noise, tol=0.0, maxiter=most)
        seconds.append(cpu() - start)
    found, info = system.solve(noise, tol=TOLERANCE, maxiter=MOST)
    np.save(path, found[0])
    report(
        setup=setup,
        spent=seconds,
        iterations=MANY - FEW,
        needed=info["iterations"],
        version=version("pysanepic"),
        peak=peak(),
    )


if __name__ == "__main__":
    main()
