"""Anderson-Darling test of two parts of a time stream for the same distribution.

The p-value is that of the k-sample test (Scholz & Stephens 1987, JASA 82, 918) between the first
and the second half of one detector's stream, as scipy tabulates it: from 0.001 to 0.25. A small p
*rejects* that both halves have one distribution. The test takes samples as independent; those of
red noise are not, so that two halves of one law fail it. High-passed, and thinned to samples that
are independent, they pass it.
"""

from __future__ import annotations

import math
import warnings
from collections.abc import Sequence
from typing import ClassVar

import numpy as np
from pydantic import Field

from zonda.core.configuration.units import Hertz
from zonda.core.data import Data
from zonda.core.errors import InputError
from zonda.core.figures import FigureMetric
from zonda.core.types import Floats
from zonda.operators.diagnostics.series import TimeStream

from .common import product_of

LEAST = 10
"""Samples that each half must have."""


class AndersonDarling(FigureMetric):
    """p-value of the Anderson-Darling test between the two halves of the first detector's stream;
    0.001 to 0.25.

    It is measured on a `TimeStreams`. A small value rejects that the halves have the same
    distribution.
    """

    reads: ClassVar[frozenset[str]] = frozenset({"time_streams"})

    stream: str = "signal"
    """Which stream."""
    above: Hertz | None = Field(None, gt=0)
    """Remove all below this frequency first."""
    every: int = Field(1, ge=1)
    """Take every so many samples."""

    def find(self, data: Data, names: Sequence[str]) -> tuple[float, float]:
        """The p-value."""
        what = "product of streams, TimeStreams"
        found = product_of(data, "time_streams", TimeStream, "anderson_darling", what)
        if self.stream not in found.streams:
            raise InputError(
                f"there is no stream {self.stream!r}",
                place="anderson_darling",
                cure=f"streams of this run: {', '.join(found.streams)}",
            )
        rate = (found.seconds.size - 1) / (found.seconds[-1] - found.seconds[0])
        return p_value(found.streams[self.stream][0], rate, self.above, self.every), math.nan


def p_value(stream: Floats, rate: float, above: float | None, every: int) -> float:
    """The test between the halves of a stream (n_samp,), high-passed ``above`` a frequency, thinned
    to ``every`` samples.
    """
    from scipy.stats import anderson_ksamp

    values = stream - stream.mean()
    if above is not None:
        spectrum = np.fft.rfft(values)
        spectrum[np.fft.rfftfreq(values.size, 1 / rate) < above] = 0
        values = np.fft.irfft(spectrum, values.size)
    values = values[::every]
    half = values.size // 2
    if half < LEAST or not np.ptp(values) > 0:
        cure = "lengthen the scan, or make `every` smaller; the stream must not be constant"
        raise InputError(
            f"the halves of the stream have {half} samples", place="anderson_darling", cure=cure
        )
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # that p lies beyond the table
        return float(anderson_ksamp([values[:half], values[half:]]).pvalue)
