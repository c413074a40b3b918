"""Fields that vary slowly over the focal plane and in time, kept at nodes and evaluated where they
are wanted.

A field is stored as cubic B-spline coefficients in time at ``n_node`` focal-plane nodes:

    f(d, t) = sum_n weights[d, n] * sum_j coefficients[n, m + j] * B_j(r / step),
    t = m * step + r,   j = 0..3     (1)

with B_j the four cubic B-spline weights. Both the mean emission of the atmosphere (float64:
microkelvin under tens of kelvin) and its turbulent part (float32) are such fields; see
``docs/atmosphere.md``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import lru_cache, reduce
from typing import Any, NamedTuple

import numba as nb
import numpy as np

from ..kernels import kernel
from ..types import AnyFloats, Floats
from .columns import fused

PAD = 1
"""Coefficients before the first sample's interval, so that every sample has its four neighbours."""


LINES_KEPT = 1 << 18
"""Coefficients of all detectors up to which they are worked out once, not for every block."""

SPLINE_MARGIN = 12
"""Values on either side that `spline_coefficients` uses up: its filter is cut where it has fallen
to 1.4e-7.
"""

REACH = 28
"""Values on either side beyond which the filter is below rounding: 0.27^28 = 1e-16."""


def spline_coefficients(values: AnyFloats, dtype: type = np.float64) -> AnyFloats:
    """Cubic B-spline coefficients of rows of values (n, m + 2 `SPLINE_MARGIN`): (n, m), each from
    its neighbours alone.

    A finite filter, normalized to unit sum, so that a coefficient has the same bits wherever the
    rows begin.
    """
    out: AnyFloats = np.empty((values.shape[0], values.shape[1] - 2 * SPLINE_MARGIN), dtype)
    _prefilter(np.ascontiguousarray(values, np.float64), _inverse_taps(SPLINE_MARGIN), out)
    return out


def interpolating(values: AnyFloats) -> Floats:
    """Cubic B-spline coefficients (n, m) of rows of values (n, m), mirrored about their first and
    their last: exact.
    """
    out = np.empty(values.shape)
    rows = np.pad(
        np.ascontiguousarray(values, np.float64),
        ((0, 0), (REACH, REACH)),
        mode="reflect",
    )
    _prefilter(rows, _inverse_taps(REACH), out)
    return out


@lru_cache(maxsize=2)
def _inverse_taps(reach: int) -> Floats:
    """One-sided inverse of (1, 4, 1) / 6, (``reach`` + 1,)."""
    taps = np.sqrt(3.0) * (np.sqrt(3.0) - 2.0) ** np.arange(reach + 1)
    return np.asarray(taps / (taps[0] + 2 * taps[1:].sum()), np.float64)


def spline_basis(u: Floats) -> Floats:
    """The four cubic B-splines that reach a point of a cell, at ``u`` (n,), 0 to 1 of the way
    through it: (4, n).
    """
    v = 1.0 - u
    return np.array(
        [v * v * v / 6, 2 / 3 - u * u * (2 - u) / 2, 2 / 3 - v * v * (2 - v) / 2, u * u * u / 6]
    )


@lru_cache(maxsize=32)
def _inside(samples: int, dtype: str) -> AnyFloats:
    """(samples,) places r / samples of the samples of a cell."""
    return (np.arange(samples) / samples).astype(dtype)


def _limits(samples: slice, n: int) -> tuple[int, int]:
    """Start and stop of a block. Raises ValueError where they are not within 0 and ``n``."""
    start = samples.start
    stop = samples.stop
    if not 0 <= start <= stop <= n:
        raise ValueError(f"samples {start}:{stop} outside 0:{n}")
    return start, stop


class Series(NamedTuple):
    """A field over a block, for kernels that evaluate it where they use it with `series_into`."""

    lines: AnyFloats
    """(n_det_block, n): each detector's B-spline coefficients from cell ``first`` on, C order."""
    first: int
    inside: AnyFloats
    """(step,): r / step, where a sample stands in its cell."""


@dataclass(frozen=True)
class SmoothField:
    """Equation (1).

    Attributes
    ----------
    weights
        (n_det, n_node): interpolation from nodes to detectors (any per-detector gain is absorbed
        here).
    coefficients
        (n_node, ceil(n_samples / step) + 3): B-spline coefficients in time; index k stands at
        sample (k - 1) * step.
    step
        Samples between coefficients; a power of two, so that blocks never cut an interval (see
        `core.run.execution`).
    n_samples
        Samples covered.
    """

    weights: AnyFloats
    coefficients: AnyFloats
    step: int
    n_samples: int
    _kept: dict[str, AnyFloats] = field(default_factory=dict, init=False, repr=False, compare=False)
    """Lines of all detectors by type, if they are small."""

    @classmethod
    def from_values(
        cls,
        weights: AnyFloats,
        values: AnyFloats,
        step: int,
        n_samples: int,
        dtype: type = np.float64,
    ) -> SmoothField:
        """From node values with a margin: ``values`` (n_node, n_coarse + 2 * margin) sampled every
        ``step`` samples.

        The margin (equal on both sides, inferred from the width) is used by the spline prefilter
        and then dropped; 12 coefficients make the edge effect of the mirror boundary < 2e-7.
        """
        wanted = -(-n_samples // step) + 3
        margin, odd = divmod(values.shape[1] - wanted, 2)
        if margin < 0 or odd:
            raise ValueError(
                f"values must have {wanted} + 2 * margin columns, got {values.shape[1]}"
            )
        kept = np.ascontiguousarray(interpolating(values)[:, margin : margin + wanted])
        return cls(np.ascontiguousarray(weights, dtype), kept.astype(dtype), step, n_samples)

    @classmethod
    def constant(cls, per_detector: AnyFloats, n_samples: int, step: int = 2048) -> SmoothField:
        """A field that does not vary in time: ``per_detector`` (n_det,)."""
        ones = np.ones((1, -(-n_samples // step) + 3))
        return cls(
            np.ascontiguousarray(np.asarray(per_detector, np.float64)[:, None]),
            ones,
            step,
            n_samples,
        )

    def scaled(self, per_detector: AnyFloats) -> SmoothField:
        """The field times a per-detector factor (n_det,)."""
        return SmoothField(
            self.weights * np.asarray(per_detector)[:, None],
            self.coefficients,
            self.step,
            self.n_samples,
        )

    def plus(self, other: SmoothField) -> SmoothField:
        """The sum of two fields over the same detectors and samples, at the shorter of their
        steps.
        """
        step = min(self.step, other.step)
        parts = [part.refined(step) for part in (self, other)]
        weights = np.hstack([np.asarray(part.weights, np.float64) for part in parts])
        return SmoothField(
            weights,
            np.vstack([part.coefficients for part in parts]),
            step,
            self.n_samples,
        )

    def refined(self, step: int) -> SmoothField:
        """The same field at a shorter ``step``, by halving: b_2k = (c_k + c_k+1) / 2, b_2k-1 =
        (c_k-1 + 6 c_k + c_k+1) / 8.
        """
        now = self.step
        c = np.asarray(self.coefficients, np.float64)
        while now > step:
            now //= 2
            finer = np.empty((len(c), 2 * c.shape[1] - 3))
            finer[:, 0::2] = (c[:, :-1] + c[:, 1:]) / 2
            finer[:, 1::2] = (c[:, :-2] + 6 * c[:, 1:-1] + c[:, 2:]) / 8
            c = finer[:, : -(-self.n_samples // now) + 3]
        return SmoothField(self.weights, np.ascontiguousarray(c), now, self.n_samples)

    def time_mean(self) -> Floats:
        """(n_det,) mean over the scan."""
        return np.asarray(self.weights @ self.coefficients.mean(1), np.float64)

    def evaluate(self, detectors: slice, samples: slice, out: AnyFloats | None = None) -> AnyFloats:
        """f at the detectors and samples of a block: (n_det_block, n_samp_block), of ``out``'s
        dtype or float64.

        Bits depend on the absolute detector and sample only. ``out`` is overwritten.
        """
        if out is None:
            out = np.empty((len(self.weights[detectors]), samples.stop - samples.start))
        _evaluate(*self.series(detectors, samples, out.dtype), samples.start, out)
        return out

    def series(self, detectors: slice, samples: slice, dtype: np.dtype[Any]) -> Series:
        """Arrays with which a kernel evaluates f at the detectors and samples of a block, to the
        same bits as `evaluate`.
        """
        start, stop = _limits(samples, self.n_samples)
        kind = dtype.str
        if (kept := self._kept.get(kind)) is not None:
            return Series(kept[detectors], 0, _inside(self.step, kind))
        shape = len(self.weights), -(-self.n_samples // self.step) + 3
        if shape[0] * shape[1] <= LINES_KEPT:
            lines = np.empty(shape, dtype)
            _lines(self.weights, self.coefficients, 0, lines)
            self._kept[kind] = lines
            return Series(lines[detectors], 0, _inside(self.step, kind))
        weights = self.weights[detectors]
        first = start // self.step
        lines = np.empty((len(weights), -(-stop // self.step) - first + 3), dtype)
        _lines(weights, self.coefficients, first, lines)
        return Series(lines, first, _inside(self.step, kind))

    def forget(self) -> None:
        """Give back the memory of what was kept for other blocks."""
        self._kept.clear()


class FieldSums:
    """Sums of fields, each worked out once: all blocks are given the same object."""

    def __init__(self) -> None:
        self._made: dict[tuple[int, ...], tuple[Sequence[SmoothField], SmoothField]] = {}

    def of(self, fields: Sequence[SmoothField]) -> SmoothField:
        """The sum of one or more fields. Called from several threads at once."""
        if len(fields) == 1:
            return fields[0]
        key = tuple(map(id, fields))
        if (
            key not in self._made
        ):  # the fields are held with their sum, so that none of another scan takes their place
            self._made.setdefault(key, (fields, reduce(SmoothField.plus, fields)))
        return self._made[key][1]


def product(rows: AnyFloats, matrix: AnyFloats) -> Floats:
    """Rows (n, m) times a small matrix (m, k), (n, k): not by BLAS, whose bits in one row depend on
    how many there are and where it stands among them."""
    out = np.empty((len(rows), matrix.shape[1]))
    _lines(np.ascontiguousarray(rows, np.float64), np.ascontiguousarray(matrix, np.float64), 0, out)
    return out


@dataclass(frozen=True)
class DetectorField:
    """Equation (1) where every detector is its own node: no weights, and no focal-plane
    interpolation to pay for.

    Attributes
    ----------
    coefficients
        (n_det, ceil(n_samples / step) + 3), as in `SmoothField`.
    step, n_samples
        As in `SmoothField`.
    """

    coefficients: AnyFloats
    step: int
    n_samples: int

    def evaluate(self, detectors: slice, samples: slice, out: AnyFloats | None = None) -> AnyFloats:
        """Values at detectors and samples; see `SmoothField.evaluate`."""
        start, stop = _limits(samples, self.n_samples)
        rows = self.coefficients[detectors]
        if out is None:
            out = np.empty((len(rows), stop - start))
        _evaluate(rows, 0, _inside(self.step, out.dtype.str), start, out)
        return out


@kernel(error_model="python")
def _prefilter(values, taps, out):  # type: ignore[no-untyped-def]
    half, n = taps.size - 1, nb.uint64(out.shape[1])
    total = np.empty(out.shape[1])
    for d in range(out.shape[0]):
        row, target = values[d], out[d]
        middle = row[half:]
        for t in range(n):
            total[t] = taps[0] * middle[t]
        for k in range(1, half + 1):
            weight, left, right = taps[k], row[half - k :], row[half + k :]
            for t in range(n):
                total[t] += weight * (left[t] + right[t])
        for t in range(n):
            target[t] = total[t]


@kernel(error_model="python")
def _lines(weights, coefficients, first, lines):  # type: ignore[no-untyped-def]
    """lines[d, k] = sum_n weights[d, n] coefficients[n, first + k], summed in float64."""
    total = np.empty(lines.shape[1])
    for d in range(lines.shape[0]):
        total[:] = 0.0
        for node in range(weights.shape[1]):
            weight, values = weights[d, node], coefficients[node, first : first + total.size]
            for k in range(nb.uint64(total.size)):  # unsigned: vectorized
                total[k] += weight * values[k]
        for k in range(nb.uint64(total.size)):
            lines[d, k] = total[k]


@kernel(error_model="python")
def _evaluate(lines, first, inside, start, out):  # type: ignore[no-untyped-def]
    for d in range(out.shape[0]):
        series_into(lines[d], first, inside, start, out[d])


@kernel(fastmath=False)
def series_into(line, first, inside, start, into):  # type: ignore[no-untyped-def]
    """One detector of a `Series` at the samples start .. start + into.size - 1 (absolute). For use
    in kernels.
    """
    step, size = nb.uint64(inside.size), nb.uint64(into.size)
    one, two, six = inside.dtype.type(1), inside.dtype.type(2), inside.dtype.type(6)
    m, done = nb.uint64(start) // step, nb.uint64(0)
    k, r = m - nb.uint64(first), nb.uint64(start) - m * step
    while done < size:
        n = min(step - r, size - done)
        c0, c1, c2, c3 = (
            line[k],
            line[k + nb.uint64(1)],
            line[k + nb.uint64(2)],
            line[k + nb.uint64(3)],
        )
        p0, p1 = (c0 + (two + two) * c1 + c2) / six, (c2 - c0) / two
        p2, p3 = (c0 - two * c1 + c2) / two, (c3 - c0 + (two + one) * (c1 - c2)) / six
        for t in range(n):
            x = inside[r + t]
            into[done + t] = fused(x, fused(x, fused(x, p3, p2), p1), p0)
        done, k, r = done + n, k + nb.uint64(1), nb.uint64(0)
