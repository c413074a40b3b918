"""Structure function and temporal spectrum of realizations, over what the von Karman covariance of
their layers gives.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
from scipy.signal.windows import blackmanharris

from zonda.operators.atmosphere.turbulence.covariance import beam_correlation, beam_structure

BANDS = (0.02, 0.05, 0.1, 0.2, 0.5, 1.0)
"""Hz."""
SEEN = 1e-6
"""Bands whose expectation is below this fraction of the lowest band's hold the leakage of the
window, not the air.
"""


def mean_and_error(ratios: np.ndarray) -> str:
    """Over realizations."""
    return f"{ratios.mean():.3f} +- {ratios.std(ddof=1) / np.sqrt(len(ratios)):.3f}"


def table(path: Path, pairs: dict[str, tuple[int, int]]) -> list[tuple[str, str]]:
    """(what, measured / expected +- standard error) for each pair of detectors and each band of
    frequencies.
    """
    f = np.load(path)
    y = f["y"].astype(np.float64)
    layers = list(
        zip(f["amplitude"], f["outer_scale"], f["sigma"], f["positions"], f["speed"], strict=True)
    )
    rows = [
        (
            "variance",
            mean_and_error(
                (y[:, 0] ** 2).mean(-1)
                / sum(a * a * beam_correlation(0.0, r0, s)[0] for a, r0, s, _, _ in layers)
            ),
        )
    ]
    for name, (i, j) in pairs.items():
        expected = sum(
            a * a * beam_structure(np.hypot(*(x[i] - x[j])), r0, s)[0] for a, r0, s, x, _ in layers
        )
        found = ((y[:, i] - y[:, j]) ** 2).mean(-1) / 2
        rows.append((f"S {name}", mean_and_error(found / expected)))
    n, step = y.shape[-1], float(f["step"])
    window = blackmanharris(n, sym=False)
    covariance = sum(
        a * a * beam_correlation(v * step * np.arange(n), r0, s) for a, r0, s, _, v in layers
    )
    lagged = np.correlate(window, window, "full")[n - 1 :] * covariance
    expected = np.fft.rfft(np.r_[lagged, 0, lagged[:0:-1]]).real[::2]
    found = abs(np.fft.rfft(y[:, 0] * window)) ** 2
    frequency = np.fft.rfftfreq(n, step)
    for low, high in pairwise(BANDS):
        band = (frequency >= low) & (frequency < high)
        if band.any() and expected[band].min() > SEEN * expected.max():
            rows.append(
                (
                    f"P {low:g} to {high:g} Hz",
                    mean_and_error((found[:, band] / expected[band]).mean(-1)),
                )
            )
    return rows
