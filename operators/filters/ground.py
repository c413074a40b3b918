"""Removes from each detector's scan what repeats with the azimuth.

With G (n_bin, N), G_bt = 1 where sample t is in the azimuth bin b, T (K, N) the Legendre
polynomials of order 1 to K over the scan, and g the samples that are used, the least-squares fit of
both together is removed:

    y = x - G^T a - T^T c,
    (a, c) = argmin sum_g (x - G^T a - T^T c)^2                                     (1)

(`GroundFilter` of TOAST with bins). With T' = T - T G_g^T (G_g G_g^T)^-1 G, the trend without what
the bins hold, this is

    c = (T'_g T'_g^T)^-1 T'_g x_g,
    a = (G_g G_g^T)^-1 G_g (x_g - T_g^T c)                                  (2)

(Frisch & Waugh 1933), where G_g G_g^T is diagonal: the number of samples in each bin. White noise
loses n_bin + K degrees of freedom. A bin without used samples removes nothing. T' has no mean over
the used samples of a bin, so that

    G^T a + T^T c = G^T (G_g G_g^T)^-1 G_g x_g + T'^T c:                                         (3)

the sums of x over bins and with T' are found in one reading.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle
from zonda.core.flags import has_a_signal
from zonda.core.observation import Observation
from zonda.core.types import Floats, Integers

from .baseline import Basis, Bins, Fit, polynomials, runs, solved
from .rows import LinearFilter, Mask, Removal, Rows


class GroundFilter(LinearFilter):
    """Remove a template of each detector in bins of the boresight's azimuth, fitted together with a
    trend in time.

    What the ground adds repeats with the azimuth at constant elevation. Flagged samples are not
    used for the fit; turnarounds are.
    """

    bin: Angle = quantity("0.5 deg", gt=0, le=1)
    """Width of the bins of the mount's azimuth."""
    split: bool = False
    """One template for samples in which the azimuth increases (left to right), another for those in
    which it decreases.
    """
    trend: int = Field(1, ge=0, le=20)
    """Order of the polynomial in time that is fitted and removed with the template (0: none besides
    the mean, which is the template's)."""

    def prepare(self, observation: Observation) -> tuple[Removal, None]:
        """The template's bins and the trend of this observation. Warns where all samples are in one
        bin.
        """
        number = _bins(observation, self.bin, self.split)
        size = int(number.max()) + 1
        if size == 1:
            reach = np.degrees(np.ptp(np.unwrap(observation.azimuth)))
            text = (
                f"{observation.name} spans {reach:.3g} deg of azimuth, one bin of"
                f" {np.degrees(self.bin):.3g} deg"
            )
            warnings.warn(
                f"{self.label}: {text}: the template is a mean; choose a smaller bin",
                stacklevel=2,
            )
        observation.log.state(self.label, f"{observation.name}: bins of the template", f"{size}")
        trend = polynomials(observation.n_samples, self.trend).functions[1:]
        return Template.of(number, trend, has_a_signal(observation.flags)), None


def _bins(observation: Observation, width: float, split: bool) -> Integers:
    """(n,) bin of each sample, from 0; bins that are nowhere are not counted."""
    azimuth = (
        observation.azimuth
        if observation.recorded_azimuth is None
        else observation.recorded_azimuth
    )
    around = round(2 * np.pi / width)
    if abs(around * width - 2 * np.pi) > 1e-9:  # no whole number of bins
        azimuth = azimuth % (2 * np.pi)
        around = 1 << 32
    number = (
        np.floor_divide(azimuth, width).astype(np.int64) % around
    )  # as TOAST, at the edges of bins too
    if split and len(azimuth) > 1:
        number = 2 * number + (np.gradient(np.unwrap(azimuth)) > 0)
    return np.asarray(np.unique(number, return_inverse=True)[1], np.int64)


@dataclass(frozen=True)
class Template:
    """Equation (3) for one scan.

    Attributes
    ----------
    bins
        (n,) bin of each sample.
    raw
        (K, n): T of equation (1).
    use
        (n,) samples that are used.
    runs
        Runs of samples in one bin, as `Basis.subtract` takes them.
    share
        (n_bin,) 1 / number of used samples, 0 where there are none.
    trend
        The fit of T'.
    """

    bins: Integers
    raw: Floats
    use: Mask
    runs: Bins
    share: Floats
    trend: Fit

    @classmethod
    def of(cls, bins: Integers, raw: Floats, use: Mask) -> Template:
        """For the samples ``use`` (n,)."""
        count = np.bincount(bins[use], minlength=int(bins.max()) + 1)
        share = np.divide(1.0, count, where=count > 0, out=np.zeros(len(count)))
        within = np.array(raw, np.float64)
        for row in within:
            row -= (np.bincount(bins[use], row[use], len(count)) * share)[bins]
        trend = Fit.of(Basis.of(within, np.zeros(len(bins), np.int64), len(raw)), use)
        ends = runs(bins)
        return cls(bins, raw, use, (ends, bins[ends - 1]), share, trend)

    def remove(self, rows: Rows, masked: Mask | None = None) -> int:
        """Equation (3) on rows in place. Returns how many samples were not finite; they stay as
        they were.
        """
        sums, means = self.trend.basis.sums_of_bins(rows, self.use, self.runs, len(self.share))
        means *= self.share
        spoilt = np.flatnonzero(~np.isfinite(means).all(axis=1)).tolist()
        alone = [self._alone(rows, d) for d in spoilt]
        self.trend.basis.subtract(rows, solved(self.trend.inverse, sums), self.runs, means)
        for d, (row, _) in zip(spoilt, alone, strict=True):
            rows.values[d] = row
        return sum(number for _, number in alone)

    def adjoint(self, rows: Rows, masked: Mask | None = None) -> None:
        """Transpose of equation (3) on float64 rows in place: all samples are summed up, those that
        are used change.
        """
        every = np.ones(len(self.use), bool)
        basis = self.trend.basis
        sums, means = basis.sums_of_bins(rows, every, self.runs, len(self.share))
        kept = rows.values[:, ~self.use]
        basis.subtract(rows, solved(self.trend.inverse, sums), self.runs, means * self.share)
        rows.values[:, ~self.use] = kept

    def _alone(self, rows: Rows, d: int) -> tuple[Floats, int]:
        """Row ``d`` without its template, and how many of its samples are not finite."""
        row = rows.double(slice(d, d + 1), len(self.use))
        finite = np.isfinite(row[0])
        kept = row[0, ~finite]
        row[0, ~finite] = 0.0
        Template.of(self.bins, self.raw, self.use & finite).remove(Rows.of(row))
        row[0, ~finite] = kept
        return row[0], len(kept)
