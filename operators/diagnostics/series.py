"""What steps keep of time streams: power spectra and the streams of a few detectors. numpy alone, for the process that draws."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from zonda.core.types import Floats


@dataclass
class Spectrum:
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
    """

    frequency: Floats
    psd: dict[str, Floats]
    averages: float
    white_level: float
    label: str
    detectors: int
    observations: int = 1

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


@dataclass
class TimeStream:
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
    """

    seconds: Floats
    streams: dict[str, Floats]
    names: list[str]
    observation: str
    label: str
