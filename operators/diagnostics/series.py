"""What steps keep of time streams: power spectra and the streams of a few detectors. numpy alone, for the process that draws."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from zonda.core.product import Record
from zonda.core.types import Floats

if TYPE_CHECKING:
    from zonda.core.operator import Operator


@dataclass
class Spectrum(Record):
    """Mean one-sided power spectral densities of time streams.

    Attributes
    ----------
    frequency
        (n,) Hz, without zero.
    psd
        (n,) per stream, K_RJ^2/Hz on the calibrated sky (`transmission`: relative, 1/Hz).
    averages
        Equivalent number of independent periodograms in each value: its relative standard error is averages^-1/2 where
        detectors are independent.
    white_level
        2 <NET^2> of the detectors used, K_RJ^2/Hz: the level of white noise; 0 where none is simulated.
    label
        Of the step that measured it.
    detectors, observations
        How many were averaged.
    of_another_length
        Scans that are not in the mean, since their frequencies or streams differ.
    """

    frequency: Floats
    psd: dict[str, Floats]
    averages: float
    white_level: float
    label: str
    detectors: int
    observations: int = 1
    of_another_length: int = 0

    def __iadd__(self, other: Spectrum) -> Spectrum:
        """The mean of all scans, each with the same weight."""
        self.of_another_length += other.of_another_length
        if self.psd.keys() != other.psd.keys() or not _close(self.frequency, other.frequency):
            self.of_another_length += other.observations
            return self
        n, m = self.observations, other.observations
        self.psd = {k: (self.psd[k] * n + other.psd[k] * m) / (n + m) for k in self.psd}
        self.white_level = (self.white_level * n + other.white_level * m) / (n + m)
        self.averages += other.averages
        self.detectors, self.observations = other.detectors, n + m
        return self

    def knee(self) -> float | None:
        """Highest frequency at which the pink part exceeds the white one [Hz]; None where it never does or one is absent."""
        if not {"pink", "white"} <= set(self.psd):
            return None
        edges = np.geomspace(self.frequency[0], self.frequency[-1], 31)
        bins = np.clip(np.searchsorted(edges, self.frequency, "right") - 1, 0, 29)
        sums = [np.bincount(bins, w, 30) for w in (np.log(self.frequency), self.psd["pink"], self.psd["white"])]
        count = np.bincount(bins, minlength=30)
        used = count > 0
        log_f, pink, white = (s[used] / count[used] for s in sums)
        if not (pink > 0).all() or not (white > 0).all():
            return None
        ratio = np.log(pink / white)
        above = np.flatnonzero(ratio > 0)
        if not above.size or above[-1] + 1 == ratio.size:
            return None
        k = above[-1]
        return float(np.exp(np.interp(0.0, [-ratio[k], -ratio[k + 1]], [log_f[k], log_f[k + 1]])))


def _close(a: Floats, b: Floats) -> bool:
    return a.shape == b.shape and np.allclose(a, b, rtol=1e-12)


@dataclass
class TimeStream(Record):
    """Streams of a few detectors of one scan.

    Attributes
    ----------
    seconds
        (n_samp,) s since the scan's start.
    streams
        (n_det, n_samp) K_RJ each, mean included.
    names
        (n_det) detector names.
    observation, label
        Name of the scan; the step at which they were taken.
    product
        Name among the products.
    """

    seconds: Floats
    streams: dict[str, Floats]
    names: list[str]
    observation: str
    label: str
    product: str = "time_streams"

    def __iadd__(self, other: TimeStream) -> TimeStream:
        """The first one stays."""
        return self


def key_of(step: Operator, usual: str) -> str:
    """Name of a step's product: ``usual``, or the step's own where it has one."""
    return step.name or (usual if step.label == type(step).__name__ else step.label)
