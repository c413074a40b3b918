"""The time constants of the detectors: a first-order low-pass.

A detector of time constant tau answers x(t) with y, tau y' = x - y, the response 1 / (1 + 2 pi i f
tau) (Mather 1982). From sample to sample, 1/f_s apart,

    y_n = a y_(n-1) + r int_0^1 e^(-r v) x(n - v) dv,   a = e^-r,   r = 1 / (tau f_s),   (1)

v in samples. Of a signal without waves above f_s / 2, x(n - v) is the sum of its samples times
sinc, here times Kaiser's window over `TAPS` samples on either side (Kaiser & Schafer 1980), so that
the integral is one over samples too:

    y_n = a y_(n-1) + sum_j w_j x_(n+j),   w_j = r int_0^1 e^(-r v) K(v + j) dv,   (2)

K divided by its sum over j, so that a constant stays. The integral is a Gauss-Legendre sum over p =
(1 - e^(-r v)) / (1 - a), exact for time constants from 0 to any. The response is that of the
detector within 0.3 % up to 0.46 f_s. Before the scan x is taken to be what it is at its first
sample, behind it what it is at its last.

The recursion begins anew `REACH` time constants before every tile of samples, so that no result
depends on the blocks: what it forgets is e^-REACH of a change of x.
"""

from __future__ import annotations

import math

import numpy as np

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Fraction, Seconds
from zonda.core.data import Block, Observation
from zonda.core.kernels import kernel
from zonda.core.numerics.chunks import TILE_SAMPLES
from zonda.core.numerics.random import normals
from zonda.core.operator import Operator
from zonda.core.types import Floats

REACH = 23
"""Time constants after which a change counts no more: e^-23 = 1e-10."""
TAPS, BETA, NODES = 24, 5.5, 48
"""Samples on either side of an instant that tell the signal there, and the parameter of their
window: 0.2 % up to 0.46 f_s. Nodes of the integral."""


class TimeConstant(Operator):
    """First-order low-pass of each detector, tau y' = x - y, with x what its samples say of a
    signal without waves above half of the sample rate: within 0.5 % up to 0.46 of it.

    It acts on all of the signal. Noise of the readout, which a real detector does not filter, is
    filtered too. A jump between two samples, which holds waves of any frequency, rings for a few
    samples. Samples that are not finite stay as they are; the filter sees a straight line there.
    """

    requires = frozenset({"signal"})
    provides = frozenset({"signal"})
    linear = True

    tau: Seconds = quantity("5 ms", ge=0, le=60)
    """Time constant."""
    scatter: Fraction = quantity("0 %", ge=0, le=1, examples=["5 %"])
    """Relative scatter of the time constants between detectors (log-normal with this median spread,
    the same in all scans).
    """

    def constants(self, observation: Observation) -> Floats:
        """(n_det,) time constants, s."""
        if self.scatter == 0:
            return np.full(observation.n_detectors, self.tau)
        key = observation.camera_key(self.label)
        drawn = normals(key, 0, observation.n_detectors).astype(np.float64)
        return self.tau * np.exp(math.log1p(self.scatter) * drawn)

    def halo(self, observation: Observation) -> int:
        """Samples that it remembers and that tell the signal between two."""
        reach = _reach(float(self.constants(observation).max(initial=0.0)), observation.sample_rate)
        return reach + TAPS if reach else 0

    def prepare(self, observation: Observation) -> Floats:
        """(n_det, 2 + 2 TAPS): a of equation (2), the samples that each remembers (0: it does
        nothing), and w.
        """
        tau = self.constants(observation)
        rate = observation.sample_rate
        cut = 1 / (2 * np.pi * max(float(np.median(tau)), 1e-12))
        if cut < 1e9:
            text = (
                f"{1e3 * np.median(tau):.4g} ms (median); half power at {cut:.4g} Hz of"
                f" {rate / 2:.4g} Hz"
            )
            observation.log.state(self.label, "time constant", text)
        different, which = np.unique(tau, return_inverse=True)
        made = [
            [math.exp(-1 / (t * rate)) if t else 0.0, _reach(t, rate), *weights(t * rate)]
            for t in different.tolist()
        ]
        return np.array(made)[which]

    def exec(self, block: Block, state: Floats) -> None:
        """Equation (2) on each row."""
        signal = block.detdata["signal"]
        given = block.buffer("(before)", block.shape)
        given[...] = signal
        _low_pass(given, block.samples.start, state[block.detectors], TILE_SAMPLES, signal)


def weights(tau: float) -> Floats:
    """w_j of equation (2), j = -TAPS ... TAPS - 1, for a time constant in samples."""
    if not tau:
        return np.where(np.arange(-TAPS, TAPS) == 0, 1.0, 0.0)
    x, share = np.polynomial.legendre.leggauss(NODES)
    rest = -math.expm1(-1 / tau)
    v = -tau * np.log1p(-rest * (x + 1) / 2)
    kernel = _interpolating(v[:, None] + np.arange(-TAPS, TAPS))
    return np.asarray(rest * (share / 2) @ (kernel / kernel.sum(axis=1, keepdims=True)))


def _interpolating(x: Floats) -> Floats:
    """sinc times Kaiser's window of half width `TAPS`."""
    window = np.i0(BETA * np.sqrt(np.maximum(1 - (x / TAPS) ** 2, 0))) / np.i0(BETA)
    return np.where(np.abs(x) < TAPS, np.sinc(x) * window, 0.0)


def _reach(tau: float, rate: float) -> int:
    return math.ceil(REACH * tau * rate) + 1 if tau > 0 else 0


@kernel
def _low_pass(given, start, factors, tile, out):  # type: ignore[no-untyped-def]
    """Equation (2); ``given``, ``out`` (n_det, n) from sample ``start`` on, in tiles that are
    absolute.
    """
    n, taps = given.shape[1], (factors.shape[1] - 2) // 2
    for d in range(given.shape[0]):
        a, reach, w = factors[d, 0], int(factors[d, 1]), factors[d, 2:]
        if reach == 0:
            continue
        row = given[d]
        begin = 0
        while begin < n:
            end = min(n, (start + begin) // tile * tile + tile - start)
            first = max(0, begin - reach)
            x = _around(row, first - taps, end + taps)
            y, begun = 0.0, False
            for t in range(first, end):
                if begun:
                    total = 0.0
                    for j in range(2 * taps):
                        total += w[j] * x[t - first + j]
                    y = a * y + total
                else:
                    begun, y = True, x[taps]
                if t >= begin and np.isfinite(row[t]):
                    out[d, t] = y
            begin = end


@kernel
def _around(row, low, high):  # type: ignore[no-untyped-def]
    """Samples low .. high - 1 of a row in float64: straight lines where they are not finite, held
    beyond the last that are.
    """
    x, before = np.zeros(high - low), -1
    for t in range(max(low, 0), min(high, row.size)):
        if np.isfinite(row[t]):
            now = t - low
            x[now] = row[t]
            if before < 0:
                x[:now] = x[now]
            else:
                for k in range(before + 1, now):
                    x[k] = x[before] + (x[now] - x[before]) * (k - before) / (now - before)
            before = now
    if before >= 0:
        x[before + 1 :] = x[before]
    return x
