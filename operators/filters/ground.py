"""Removes from each detector's scan what repeats with the azimuth.

With G (n_bin, N), G_bt = 1 where sample t is in the azimuth bin b, T (K, N) the Legendre polynomials of order 1 to K over the
scan, and g the samples that are used, the least-squares fit of both together is removed:

    y = x - G^T a - T^T c,   (a, c) = argmin sum_g (x - G^T a - T^T c)^2                                     (1)

(`GroundFilter` of TOAST with bins). With T' = T - T G_g^T (G_g G_g^T)^-1 G, the trend without what the bins hold, this is

    c = (T'_g T'_g^T)^-1 T'_g x_g,   a = (G_g G_g^T)^-1 G_g (x_g - T_g^T c)                                  (2)

(Frisch & Waugh 1933), where G_g G_g^T is diagonal: the number of samples in each bin. White noise loses n_bin + K degrees of
freedom. A bin without used samples removes nothing.
"""

from __future__ import annotations

import warnings
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from zonda.core.compilation.jit import nb
from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Angle
from zonda.core.data import Block, Observation
from zonda.core.flags import EXCLUDE_SAMPLE, HAS_A_SIGNAL, good
from zonda.core.operator import Operator
from zonda.core.types import Floats

from .baseline import Basis, Fit, Mask, in_double, polynomials


class GroundFilter(Operator):
    """Remove a template of each detector in bins of the boresight's azimuth, fitted together with a trend in time.

    What the ground adds repeats with the azimuth at constant elevation. Flagged samples are not used for the fit;
    turnarounds are.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    linear: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "time"

    bin: Angle = quantity("0.5 deg", gt=0, le=1)
    """Width of the bins of the mount's azimuth."""
    split: bool = False
    """One template for samples in which the azimuth increases (left to right), another for those in which it decreases."""
    trend: int = Field(1, ge=0, le=20)
    """Order of the polynomial in time that is fitted and removed with the template (0: none besides the mean, which is the
    template's)."""

    def prepare(self, observation: Observation) -> Template:
        """The template's bins and the trend of this observation. Warns where all samples are in one bin."""
        number = _bins(observation, self.bin, self.split)
        size = int(number.max()) + 1
        if size == 1:
            reach = np.degrees(np.ptp(np.unwrap(observation.azimuth)))
            text = f"{observation.name} spans {reach:.3g} deg of azimuth, one bin of {np.degrees(self.bin):.3g} deg"
            warnings.warn(f"{self.label}: {text}: the template is a mean; choose a smaller bin", stacklevel=2)
        observation.tally.state(self.label, f"{observation.name}: bins of the template", f"{size}")
        use = good(observation.flags, EXCLUDE_SAMPLE & ~HAS_A_SIGNAL)
        return Template.of(number, polynomials(observation.n_samples, self.trend).weights[:, 1:], use)

    def exec(self, block: Block, state: Template) -> None:
        """Subtract the template and the trend from each row."""
        in_double(self.label, block, lambda rows, _: state.remove(rows))


def _bins(observation: Observation, width: float, split: bool) -> NDArray[np.int64]:
    """(n,) bin of each sample, from 0; bins that are nowhere are not counted."""
    azimuth = observation.azimuth
    number = np.floor(azimuth / width).astype(np.int64)
    if split and len(azimuth) > 1:
        number = 2 * number + (np.gradient(np.unwrap(azimuth)) > 0)
    return np.asarray(np.unique(number, return_inverse=True)[1], np.int64)


@dataclass(frozen=True)
class Template:
    """Equation (2) for one scan.

    Attributes
    ----------
    bins
        (n,) bin of each sample.
    raw
        (n, K): T of equation (1), transposed.
    use
        (n,) samples that are used.
    share
        (n_bin,) 1 / number of used samples, 0 where there are none.
    trend
        The fit of T'; None: K = 0.
    """

    bins: NDArray[np.int64]
    raw: Floats
    use: Mask
    share: Floats
    trend: Fit | None

    @classmethod
    def of(cls, bins: NDArray[np.int64], raw: Floats, use: Mask) -> Template:
        """For the samples ``use`` (n,)."""
        count = np.bincount(bins[use], minlength=int(bins.max()) + 1)
        share = np.divide(1.0, count, where=count > 0, out=np.zeros(len(count)))
        if not raw.shape[1]:
            return cls(bins, raw, use, share, None)
        within = np.ascontiguousarray(raw, np.float64).copy()
        for column in within.T:
            column -= (np.bincount(bins[use], column[use], len(count)) * share)[bins]
        basis = Basis(np.zeros(len(bins), np.int64), within, raw.shape[1])
        return cls(bins, raw, use, share, Fit.of(basis, use))

    def remove(self, rows: Floats) -> int:
        """Equation (1) on ``rows`` (n_det, n) in place. Returns how many samples were not finite; they stay as they were."""
        finite = np.isfinite(rows)
        whole: NDArray[np.bool_] = np.logical_and.reduce(finite, axis=1)
        if self.trend is not None and whole.all():
            self.trend.remove(rows)
        for row, fine, complete in zip(rows, finite, whole, strict=True):
            one = self if complete else Template.of(self.bins, self.raw, self.use & fine)
            if one.trend is not None and not whole.all():
                one.trend.remove(row[None])
            _remove_bins(row, one.use, one.bins, one.share)
        return int(np.count_nonzero(~finite))


@nb.njit(nogil=True, cache=True, boundscheck=False, error_model="numpy")
def _remove_bins(row, use, bins, share):  # type: ignore[no-untyped-def]
    """Subtract the mean over the used samples of each bin."""
    means = np.zeros(share.size)
    for t in range(row.size):
        if use[t]:
            means[bins[t]] += row[t]
    for b in range(share.size):
        means[b] *= share[b]
    for t in range(row.size):
        row[t] -= means[bins[t]]
