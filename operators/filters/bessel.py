"""The causal Bessel high-pass filter of the paper's authors.

The mapper of maria 1.0.0 (`maria/utils/signal.py`) filters with ``scipy.signal.bessel(4, 2 f / f_s,
"high")`` in second-order sections and ``scipy.signal.sosfilt``: four poles, normalized so that the
phase at f is half-way (``norm="phase"``), made digital by the bilinear transform. The filter is
causal, so that a source is followed by a trough; its initial state is zero, so that a scan that
does not begin with zero has a transient, which decays within about 1 / f.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from zonda.core.types import AnyFloats, Floats

from .baseline import Fit
from .rows import Rows
from .source_mask import filter_outside

ORDER = 4
"""Poles, as in the authors' code."""


def sections(frequency: float, rate: float) -> Floats:
    """(2, 6) second-order sections of the filter; ``frequency`` below half of the sample ``rate``,
    Hz.
    """
    from scipy.signal import bessel

    return np.asarray(bessel(ORDER, 2 * frequency / rate, "high", output="sos"), np.float64)


def amplitude(frequency: Floats, cutoff: float, rate: float) -> Floats:
    """|H| at frequencies (n,), Hz; beyond half of the sample ``rate`` that there."""
    from scipy.signal import sosfreqz

    at = np.minimum(frequency, rate / 2)
    return np.abs(sosfreqz(sections(cutoff, rate), 2 * np.pi * at / rate)[1])


@dataclass(frozen=True)
class BesselPlan:
    """The filter for scans of one length: ``sos`` (2, 6), and the polynomial that is removed first,
    if any.
    """

    sos: Floats
    trend: Fit | None

    def apply(self, rows: Floats, bad: NDArray[np.intp], masked: NDArray[np.bool_] | None) -> int:
        """Filter ``rows`` (n_det, N) float64 in place; the rest as in
        `source_mask.filter_outside`.
        """
        from scipy.signal import sosfilt

        def act(row: AnyFloats) -> None:
            row[...] = sosfilt(self.sos, row)

        if self.trend is not None:
            self.trend.remove(Rows.of(rows), masked)
        return sum(
            filter_outside(row, bad, None if masked is None else masked[d], act)
            for d, row in enumerate(rows)
        )
