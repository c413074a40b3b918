"""The time constants of the detectors: a first-order low-pass.

A detector of time constant tau answers x(t) with y, tau y' = x - y, the response 1 / (1 + 2 pi i f tau) (Mather 1982). Where x
goes in straight lines from sample to sample, 1/f_s apart, y at the samples is exactly

    y_n = a y_(n-1) + b x_n + c x_(n-1),   a = e^-r,  b = 1 - (1 - a) / r,  c = (1 - a) / r - a,  r = 1 / (tau f_s),       (1)

whose response to a wave is that of the detector times sinc^2(f / f_s), the share of the wave that straight lines hold, and 1 at
f = 0. Before the scan x is taken to be what it is at its first sample.

The recursion begins anew `REACH` time constants before every tile of samples, so that no result depends on the blocks: what it
forgets is e^-REACH of a change of x.
"""

from __future__ import annotations

import math
from typing import ClassVar

import numpy as np

from zonda.core.block import Block
from zonda.core.compilation.jit import nb
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Fraction, Seconds
from zonda.core.numerics.random import normals
from zonda.core.numerics.tiles import TILE_SAMPLES
from zonda.core.observation import Observation
from zonda.core.operator import Operator
from zonda.core.types import Floats

REACH = 23
"""Time constants after which a change counts no more: e^-23 = 1e-10."""


class TimeConstant(Operator):
    """First-order low-pass of each detector, tau y' = x - y, with x linear between samples.

    It acts on all of the signal. Noise of the readout, which a real detector does not filter, is filtered too. Samples that are
    not finite stay as they are, and the filter skips them.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    linear: ClassVar[bool] = True

    tau: Seconds = quantity("5 ms", ge=0, le=60)
    """Time constant."""
    scatter: Fraction = quantity("0 %", ge=0, le=1)
    """Relative scatter of the time constants between detectors (log-normal with this median spread, the same in all scans)."""

    def constants(self, observation: Observation) -> Floats:
        """(n_det,) time constants, s."""
        if self.scatter == 0:
            return np.full(observation.n_detectors, self.tau)
        key = observation.camera_key(self.label)
        drawn = normals(key, 0, observation.n_detectors).astype(np.float64)
        return np.asarray(self.tau * np.exp(math.log1p(self.scatter) * drawn))

    def halo(self, observation: Observation) -> int:
        """Samples that it remembers."""
        return _reach(float(self.constants(observation).max(initial=0.0)), observation.sample_rate)

    def prepare(self, observation: Observation) -> Floats:
        """(n_det, 4): a, b, c of equation (1), and the samples that each remembers."""
        tau, rate = self.constants(observation), observation.sample_rate
        cut = 1 / (2 * np.pi * max(float(np.median(tau)), 1e-12))
        if cut < 1e9:
            text = f"{1e3 * np.median(tau):.4g} ms (median); half power at {cut:.4g} Hz of {rate / 2:.4g} Hz"
            observation.tally.state(self.label, "time constant", text)
            loss = 1 - np.sinc(min(cut / rate, 0.5)) ** 2
            observation.tally.state(self.label, "straight lines between samples lose, at that frequency", f"{100 * loss:.2g} %")
        with np.errstate(divide="ignore"):
            r = 1 / (tau * rate)
        a = np.exp(-r)
        mean = -np.expm1(-r) / r
        mean[~np.isfinite(r)] = 0.0
        return np.stack([a, 1 - mean, mean - a, [_reach(float(each), rate) for each in tau]], axis=1)

    def exec(self, block: Block, state: Floats) -> None:
        """Equation (1) on each row."""
        signal = block.detdata["signal"]
        given = block.buffer("(before)", block.shape)
        given[...] = signal
        _low_pass(given, block.samples.start, state[block.detectors], TILE_SAMPLES, signal)


def _reach(tau: float, rate: float) -> int:
    return math.ceil(REACH * tau * rate) + 1 if tau > 0 else 0


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _low_pass(given, start, factors, tile, out):  # type: ignore[no-untyped-def]
    """Equation (1); ``given``, ``out`` (n_det, n) from sample ``start`` on, in tiles that are absolute."""
    n = given.shape[1]
    for d in range(given.shape[0]):
        a, b, c, reach = factors[d, 0], factors[d, 1], factors[d, 2], int(factors[d, 3])
        row = given[d]
        begin = 0
        while begin < n:
            end = min(n, (start + begin) // tile * tile + tile - start)
            begun, y, before = False, 0.0, 0.0
            for t in range(max(0, begin - reach), end):
                x = np.float64(row[t])
                if np.isfinite(x):
                    y = a * y + b * x + c * before if begun else x
                    begun, before = True, x
                    if t >= begin:
                        out[d, t] = y
            begin = end
