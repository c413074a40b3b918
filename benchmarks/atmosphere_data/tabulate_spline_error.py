"""Make `operators/atmosphere/data/spline_error.npz`: equation (2) of
`zonda.operators.atmosphere.turbulence.nodes` on its grid.

python benchmarks/atmosphere_data/tabulate_spline_error.py
operators/atmosphere/data/spline_error.npz
"""

from __future__ import annotations

import sys

import numpy as np

Floats = np.ndarray


def spline_table() -> tuple[Floats, Floats]:
    """(ln q, ln G(q)) of equation (2) on 500 points of q, 0.01 to 1000."""
    q = np.geomspace(1e-2, 1e3, 500)
    u = np.linspace(
        -6, 6, 1201
    )  # w / q: the spectrum of exp(-q^2 n^2 / 4) is a Gaussian exp(-(w/q)^2)
    density = np.exp(-u * u) / np.sqrt(np.pi) * (u[1] - u[0])
    even = 2 * density[600:]
    even[0] = density[600]
    out = np.concatenate(
        [_lost(np.multiply.outer(part, u[600:])) @ even for part in np.array_split(q, 50)]
    )
    return np.log(q), np.log(out)


def _lost(w: Floats) -> Floats:
    """(1 - A_0 b)^2 + sum (A_m b)^2 of equation (2)."""
    b = 3 / (2 + np.cos(w))
    # Images of frequencies far above Nyquist: fold w to (-pi, pi] and name its own image m.
    own = np.round(w / (2 * np.pi))
    half = (w - 2 * np.pi * own) / 2
    top = np.sin(half) ** 4 * b
    tiny = np.abs(half) < 1e-12
    half[tiny], top[tiny] = 1.0, 0.0
    base = np.where(
        tiny, 1.0, top / half**4
    )  # sinc^4 b of the image at the folded frequency itself
    error = np.zeros_like(w)
    for m in range(1, 9):
        for shift in (m * np.pi, -m * np.pi):
            fourth = (half + shift) ** 2
            fourth *= fourth
            fourth *= fourth
            error += 1 / fourth
    error = error * top**2 + np.where(own == 0, 0.0, base**2)
    here = np.where(own == 0, base, np.where(tiny, 0.0, top / np.where(w == 0, 1.0, w / 2) ** 4))
    error -= np.where((own != 0) & (np.abs(own) <= 8), here**2, 0.0)
    return np.asarray(error + (1 - here) ** 2, np.float64)


if __name__ == "__main__":
    log_q, log_g = spline_table()
    np.savez(sys.argv[1], log_q=log_q, log_g=log_g)
