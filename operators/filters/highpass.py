"""A brick-wall high-pass filter of whole scans, without phase.

A detector's scan x_n, n = 0 .. N - 1, loses a polynomial and then every cosine below the cut:

    y = x - P x,    P x = p + sum_{k < K} a_k cos(pi k (n + 1/2) / N),   K = ceil(2 N f / f_s),                 (1)

p the least-squares polynomial, a_k the DCT-II of x - p: the brick wall on the evenly extended scan, which has no jump at
its ends (a periodic brick wall wraps a drift around). The low part is smooth, so it is formed on a coarse series: with
B the cubic B-spline and knots every q = N / M samples,

    s_m = sum_n x_n B((n + 1/2) / q - m),   P x = sum_m c_m B((n + 1/2) / q - m),                             (2)

where c follows from s by a DCT-I of length M + 1 and a division by sinc(k / 2M)^8, the B-spline's response both ways. The
error of the low part is (K / 2M)^4 at the cut, less below it; the polynomial is exact, because cubic B-splines hold it.
"""

from __future__ import annotations

import copy
import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, ClassVar, Literal

import numba as nb
import numpy as np
from numpy.typing import NDArray
from pydantic import Field, PrivateAttr

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Hertz, Seconds
from zonda.core.data import Block, Observation
from zonda.core.errors import PipelineError
from zonda.core.knobs import Knob
from zonda.core.operator import Operator

if TYPE_CHECKING:
    from zonda.core.plan.context import Context
    from zonda.core.plan.estimate import Estimate, Traits

Floats = NDArray[np.floating]

FLAG_TRIM = 2
"""Bit set in ``flags`` at the trimmed ends."""

SHORTEST_STEP = 8
"""Samples per coarse knot below which the full DCT is cheaper and is used instead."""


class HighpassFilter(Operator):
    """Brick-wall high-pass filter of each detector's scan, zero phase: equations (1) and (2).

    The modelled mean emission that accompanies the signal is dropped analytically, before anything else.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    prepares_ahead: ClassVar[bool] = True
    linear: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "time"
    knobs: ClassVar[tuple[Knob, ...]] = (Knob("oversampling", (8, 12, 24, 48), "slow part formed on a coarse series in time"),)

    frequency: Hertz = quantity("0.08 Hz", gt=0)
    """Cut: everything slower is removed."""
    degree: int = Field(3, ge=0, le=3)
    """Degree of the polynomial fitted to each detector's scan and removed before the even extension (1: a line)."""
    trim: Seconds = quantity("0 s", ge=0)
    """Flag this long at either end of each scan."""
    oversampling: float = Field(24.0, ge=8, le=1000)
    """Coarse knots per cut cycle (M / (K / 2)); the low part's error at the cut is about oversampling^-4."""

    _plans: dict[tuple[int, float], HighpassPlan] = PrivateAttr(default_factory=dict)

    def prepare(self, observation: Observation) -> HighpassPlan:
        """Tables for this observation's length; flags the trimmed ends."""
        n, rate, tally = observation.n_samples, observation.sample_rate, observation.tally
        if self.frequency >= rate / 2:
            raise PipelineError(
                f"a cut at {self.frequency:g} Hz removes everything: samples come at {rate:g} Hz",
                place=self.label,
                cure=f"choose a frequency well below {rate / 2:g} Hz",
            )
        bad = (observation.flags & ~np.uint8(FLAG_TRIM)) != 0
        trimmed = min(round(self.trim * rate), n)
        if 2 * trimmed >= n and trimmed:
            raise PipelineError(
                f"trimming {self.trim:g} s at either end leaves nothing of a scan of {observation.duration:g} s",
                place=f"{self.label}, {observation.name}",
                cure="shorten trim or lengthen the scan",
            )
        if trimmed:
            observation.flags[:trimmed] |= FLAG_TRIM
            observation.flags[n - trimmed :] |= FLAG_TRIM
        tally.count(self.label, "samples trimmed", 2 * trimmed)
        tally.count(self.label, "flagged samples bridged before filtering", int(bad.sum()))
        if observation.smooth.get("atmosphere") is not None:
            tally.state(self.label, "smooth mean emission", "removed analytically")
        key = n, self.frequency / rate
        if key not in self._plans:
            self._plans = {key: plan_highpass(*key, self.degree, self.oversampling)}  # that of the scan before will often do
        plan = copy.copy(self._plans[key])
        plan.bad = np.flatnonzero(bad)
        if plan.cut == 0:
            tally.state(self.label, f"{observation.name} is shorter than 1/frequency", "only the mean and a line are removed")
        return plan

    def memory(self, observation: Observation) -> int:
        """Spline weights in both precisions, and what they are made from."""
        return 100 * observation.n_samples

    def traits(self, observation: Observation) -> Traits:
        """What passes."""
        from .estimate import highpass_traits

        return highpass_traits(self, observation)

    def estimate(self, context: Context) -> Estimate:
        """Knots of the coarse series."""
        from .estimate import highpass_estimate

        return highpass_estimate(self, context)

    def exec(self, block: Block, state: HighpassPlan) -> None:
        """Filter the block's rows in place."""
        block.means.pop("signal", None)
        spoilt = state.apply(block.detdata["signal"])
        block.observation.tally.count(self.label, "samples not finite", spoilt)


@dataclass
class HighpassPlan:
    """Everything equation (2) needs for scans of one length.

    Attributes
    ----------
    n, cut
        Samples N, and the number K of cosines removed (0: the scan is shorter than one cycle; polynomial only).
    knots
        M; 0: use the full DCT.
    edges
        (M + 1,): first sample of each interval between knots.
    weights
        (4, N): B at the four knots around each sample, float64.
    modes
        (degree + 1, M + 3): coarse coefficients of orthonormal polynomials; `spread_modes`, the same shape, their s.
    polynomials
        (degree + 1, N): the polynomials themselves where the full DCT is used.
    response
        (K,): factor from the DCT-I of s to that of c.
    bad
        Flagged samples, bridged before filtering.
    """

    n: int
    cut: int
    knots: int
    edges: NDArray[np.int64]
    weights: Floats
    modes: Floats
    spread_modes: Floats
    polynomials: Floats
    response: Floats
    bad: NDArray[np.intp] = field(default_factory=lambda: np.zeros(0, np.intp))

    def __post_init__(self) -> None:
        self._weights = {np.dtype(t): np.ascontiguousarray(self.weights, t) for t in (np.float32, np.float64)}

    def apply(self, rows: Floats) -> int:
        """Filter ``rows`` (n_det, N), C order, in place. Returns how many samples were not finite; they stay as they were."""
        done = np.zeros(len(rows), bool)
        if self.knots and not self.bad.size:
            coarse = self._spread(rows)
            done[:] = np.isfinite(coarse).all(axis=1)
            coarse[~done] = 0
            self._subtract(rows, coarse)
        return sum(self._bridged(rows[d]) for d in np.flatnonzero(~done))

    def _bridged(self, row: Floats) -> int:
        """`apply` to one row (N,) that has gaps or no coarse series."""
        lost = np.flatnonzero(~np.isfinite(row))
        gaps = np.union1d(self.bad, lost)
        if gaps.size == self.n:
            return int(lost.size)
        kept = row[lost]
        bridge(row, gaps)
        if self.knots:
            self._subtract(row[None], self._spread(row[None]))
        else:
            row -= self._low_exact(row.astype(np.float64)).astype(row.dtype)
        row[lost] = kept
        return int(lost.size)

    def _spread(self, rows: Floats) -> Floats:
        s = np.zeros((len(rows), self.knots + 3))
        _spread(rows, self.edges, self._weights[rows.dtype], s)
        return s

    def _subtract(self, rows: Floats, coarse: Floats) -> None:
        _subtract(rows, self.edges, self._weights[rows.dtype], self._low(coarse).astype(rows.dtype))

    def _low(self, s: Floats) -> Floats:
        """Coarse coefficients c_m, m = -1 .. M + 1, of P x from s, (n_det, M + 3) each."""
        from scipy.fft import dct

        # not with BLAS, whose bits in one row depend on how many rows there are and where it stands among them
        amplitude = np.einsum("dm,km->dk", s, self.modes)
        rest = s - np.einsum("dk,km->dm", amplitude, self.spread_modes)
        c = np.einsum("dk,km->dm", amplitude, self.modes)
        if self.cut:
            folded = rest[:, 1:-1].copy()
            folded[:, [0, -1]] *= 2
            folded[:, 1] += rest[:, 0]
            folded[:, -2] += rest[:, -1]
            spectrum = dct(folded, type=1)
            spectrum[:, self.cut :] = 0
            spectrum[:, : self.cut] *= self.response
            low = dct(spectrum, type=1)
            c[:, 1:-1] += low
            c[:, 0] += low[:, 1]
            c[:, -1] += low[:, -2]
        return np.asarray(c)

    def _low_exact(self, x: Floats) -> Floats:
        """P x of equation (1), directly."""
        from scipy.fft import dct, idct

        fit = (self.polynomials @ x) @ self.polynomials
        if not self.cut:
            return np.asarray(fit)
        spectrum = dct(x - fit, type=2)
        spectrum[self.cut :] = 0
        return np.asarray(fit + idct(spectrum, type=2))


def plan_highpass(n: int, frequency: float, degree: int, oversampling: float) -> HighpassPlan:
    """The plan for scans of ``n`` samples and a cut at ``frequency`` cycles per sample; the rest as in `HighpassFilter`."""
    from scipy.fft import next_fast_len

    cycles = n * frequency
    cut = max(1, math.ceil(2 * cycles - 1e-9)) if cycles >= 1 else 0
    degree = min(degree if cut else min(degree, 1), n - 1)
    if cut:
        degree = min(degree, cut - 1)
    knots = int(next_fast_len(max(16, math.ceil(oversampling * cut / 2))))
    if not cut or n < SHORTEST_STEP * knots:
        knots = 0
    position = (np.arange(n) + 0.5) * (knots / n)
    cell = position.astype(np.int64)
    u = position - cell
    v = 1.0 - u
    weights = np.array([v**3 / 6, 2 / 3 - u * u * (2 - u) / 2, 2 / 3 - v * v * (2 - v) / 2, u**3 / 6])
    edges = np.searchsorted(cell, np.arange(knots + 1)).astype(np.int64)
    if not knots:
        powers = np.polynomial.legendre.legvander((2 * np.arange(n) + 1) / n - 1, degree)
        basis, none = np.linalg.qr(powers)[0].T.copy(), np.zeros((0, 0))
        return HighpassPlan(n, cut, 0, edges, weights[:, :0], none, none, basis, np.zeros(0))
    # polynomials through their B-spline coefficients: B * (t^2) = t^2 + 1/3, B * (t^3) = t^3 + t
    t = (np.arange(knots + 3) - 1) * (2 / knots) - 1
    third = (2 / knots) ** 2 / 3
    raw = np.array([np.ones_like(t), t, t * t - third, t**3 - 3 * third * t])[: degree + 1]
    spread = np.zeros_like(raw)
    for c, s in zip(raw, spread, strict=True):
        sampled = sum(weights[j] * c[cell + j] for j in range(4))
        s += sum(np.bincount(cell + j, weights[j] * sampled, knots + 3) for j in range(4))
    norm = np.linalg.inv(np.linalg.cholesky(raw @ spread.T))
    sinc = np.sinc(np.arange(cut) / (2 * knots)) ** 4
    response = 1 / (2 * n * sinc**2)
    return HighpassPlan(n, cut, knots, edges, weights, norm @ raw, norm @ spread, np.zeros((0, n)), response)


def bridge(row: Floats, gaps: NDArray[np.intp]) -> None:
    """Replace the samples ``gaps`` by straight lines between their good neighbours (held constant at the ends)."""
    good = np.ones(row.size, bool)
    good[gaps] = False
    known = np.flatnonzero(good)
    row[gaps] = np.interp(gaps, known, row[known])


LANES = 16
"""Partial sums per interval: fixed, so that bits do not depend on the machine's vectors."""

AT_ONCE = 16
"""Intervals between knots that all rows pass through together, while their weights are in the cache."""


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _spread(rows, edges, weights, s):  # type: ignore[no-untyped-def]
    """s[d, m] += sum_n weights[j, n] rows[d, n], m = cell + j, in `LANES` fixed partial sums per interval."""
    lanes = np.empty((4, LANES), rows.dtype)
    l0, l1, l2, l3 = lanes[0], lanes[1], lanes[2], lanes[3]
    for begin in range(0, edges.size - 1, AT_ONCE):
        for d in range(rows.shape[0]):
            for m in range(begin, min(begin + AT_ONCE, edges.size - 1)):
                x = rows[d, edges[m] : edges[m + 1]]
                w0, w1 = weights[0, edges[m] : edges[m + 1]], weights[1, edges[m] : edges[m + 1]]
                w2, w3 = weights[2, edges[m] : edges[m + 1]], weights[3, edges[m] : edges[m + 1]]
                whole = x.size // LANES * LANES
                lanes[:] = 0
                for base in range(0, whole, LANES):
                    for i in range(LANES):
                        l0[i] += x[base + i] * w0[base + i]
                        l1[i] += x[base + i] * w1[base + i]
                        l2[i] += x[base + i] * w2[base + i]
                        l3[i] += x[base + i] * w3[base + i]
                for n in range(whole, x.size):
                    l0[n - whole] += x[n] * w0[n]
                    l1[n - whole] += x[n] * w1[n]
                    l2[n - whole] += x[n] * w2[n]
                    l3[n - whole] += x[n] * w3[n]
                t0, t1, t2, t3 = 0.0, 0.0, 0.0, 0.0
                for i in range(LANES):
                    t0, t1, t2, t3 = t0 + l0[i], t1 + l1[i], t2 + l2[i], t3 + l3[i]
                s[d, m] += t0
                s[d, m + 1] += t1
                s[d, m + 2] += t2
                s[d, m + 3] += t3


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy", fastmath={"contract", "nsz"})
def _subtract(rows, edges, weights, c):  # type: ignore[no-untyped-def]
    """rows[d, n] -= sum_j weights[j, n] c[d, cell + j]."""
    for begin in range(0, edges.size - 1, AT_ONCE):
        for d in range(rows.shape[0]):
            for m in range(begin, min(begin + AT_ONCE, edges.size - 1)):
                c0, c1, c2, c3 = c[d, m], c[d, m + 1], c[d, m + 2], c[d, m + 3]
                x = rows[d, edges[m] : edges[m + 1]]
                w0, w1 = weights[0, edges[m] : edges[m + 1]], weights[1, edges[m] : edges[m + 1]]
                w2, w3 = weights[2, edges[m] : edges[m + 1]], weights[3, edges[m] : edges[m + 1]]
                for n in range(x.size):
                    x[n] -= c0 * w0[n] + c1 * w1[n] + c2 * w2[n] + c3 * w3[n]
