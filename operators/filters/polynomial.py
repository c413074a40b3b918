"""Filters that subtract polynomials and splines from each detector's scan (`baseline`).

`PolynomialFilter` treats every interval by itself. In interval i, B_i the Legendre polynomials up
to `order` over its samples and g the samples that are used,

    y = x - B_i^T (B_ig B_ig^T)^-1 B_ig x_g                                                      (1)

(equation (1) of `baseline` for each interval by itself; `PolyFilter` of TOAST). A sample between
two intervals belongs to none. It loses the straight line from the last value of the polynomial
before it to the first value of the one behind it, before the first interval and behind the last one
a constant, so that what is removed does not jump there; it is flagged, and no map uses it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from pydantic import Field

from zonda.core.configuration.parameters import quantity
from zonda.core.configuration.units import Seconds
from zonda.core.data import Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.flags import TRIMMED, has_a_signal, slices_in
from zonda.core.numerics.smooth import product
from zonda.core.types import Bools, Floats

from .baseline import Basis, Fit, polynomials, splines
from .rows import LinearFilter, Removal, Rows
from .source_mask import Inside, SourceMask

MOST_KNOTS = 2000
"""Knots of a scan: the normal equations are solved whole."""

Part = Literal[
    "whole",
    "scanning",
    "throw",
    "throw_leftright",
    "throw_rightleft",
    "scan_leftright",
    "scan_rightleft",
]
"""The whole scan, or one of TOAST's names of intervals (`core.flags`)."""


class Detrend(LinearFilter):
    """Remove the polynomial that fits each detector's scan best, the mean of the atmosphere
    included: equation (1) of `baseline`.

    Order 1 is what the mapper of maria 1.0.0 does first (``scipy.signal.detrend``). Flagged samples
    are not used.
    """

    order: int = Field(1, ge=0, le=20)
    """Order of the polynomial (0: the mean, 1: a line)."""
    mask: SourceMask | None = None
    """Source whose samples are not used for the fit; it is subtracted there too."""

    def prepare(self, observation: Observation) -> tuple[Removal, Inside | None]:
        """The fit to this observation's good samples."""
        basis = polynomials(observation.n_samples, self.order)
        return Fit.of(basis, has_a_signal(observation.flags)), self._inside(observation)


class Despline(LinearFilter):
    """Remove the cubic spline that fits each detector's scan best: equation (1) of `baseline` with
    B-splines.

    The knots are those of the mapper of maria 1.0.0: equally spaced, and centred on the scan. (Its
    own spacing is always 60 s: it gives `get_bspline_basis` the spacing under a name that this
    ignores.) Flagged samples are not used.
    """

    knots: Seconds = quantity("60 s", gt=0)
    """Time between two knots."""

    def _inside(self, observation: Observation) -> None:
        """No mask. Raises PipelineError for a scan of more than `MOST_KNOTS` knots."""
        if observation.duration > MOST_KNOTS * self.knots:
            raise PipelineError(
                f"knots every {self.knots:g} s are more than {MOST_KNOTS} in a scan of"
                f" {observation.duration:g} s",
                place=f"{self.label}, {observation.name}",
                cure="choose longer knots, or a HighpassFilter",
            )

    def prepare(self, observation: Observation) -> tuple[Removal, Inside | None]:
        """The fit to this observation's good samples."""
        self._inside(observation)
        basis = splines(observation.n_samples, self.knots * observation.sample_rate)
        observation.log.state(
            self.label,
            f"{observation.name}: functions fitted to each detector",
            f"{basis.size}",
        )
        return Fit.of(basis, has_a_signal(observation.flags)), None


class PolynomialFilter(LinearFilter):
    """Remove the polynomial that fits each interval of each detector's scan best (least squares).

    Flagged samples are not used for the fit; turnarounds are, where the interval contains them.
    Where an interval has too few samples for all orders, the polynomials that they determine are
    removed.
    """

    order: int = Field(3, ge=0, le=20)
    """Order of the polynomials (0: the mean, 1: a line)."""
    interval: Part = "whole"
    """What each polynomial is fitted to: the whole scan, every pass at constant speed (`scanning`,
    or one direction alone), or every pass with half of the turnarounds on either side (`throw`)."""
    mask: SourceMask | None = None
    """Source whose samples are not used for the fit; it is subtracted there too."""

    def check(self, data: Data) -> list[str]:
        """Refuse intervals that a scan does not have, and a mask that cannot be used."""
        for observation in data.observations:
            if not observation.intervals.get(self.interval):
                self._parts(observation)
        return super().check(data)

    def prepare(self, observation: Observation) -> tuple[Removal, Inside | None]:
        """The fits to this observation's good samples; flags what is in no interval."""
        n = observation.n_samples
        parts = self._parts(observation)
        pieces = Pieces.of(parts, self.order, has_a_signal(observation.flags))
        observation.flags[pieces.outside] |= TRIMMED
        observation.log.count(
            self.label,
            "samples between intervals, flagged",
            int(pieces.outside.sum()),
            n,
        )
        observation.log.state(
            self.label,
            f"{observation.name}: polynomials of order {self.order}",
            f"{len(parts)}",
        )
        return pieces, self._inside(observation)

    def _parts(self, observation: Observation) -> list[slice]:
        """The intervals of a scan. Raises PipelineError where there are none of that name."""
        if self.interval == "whole":
            return [slice(0, observation.n_samples)]
        spans = slices_in(observation.intervals.get(self.interval, []), observation.seconds)
        found = [p for p in spans if p.stop > p.start]
        if not found:
            there = [name for name, spans in observation.intervals.items() if spans]
            raise PipelineError(
                f"the scan has no interval {self.interval!r}; it has {', '.join(there) or 'none'}",
                place=f"{self.label}, {observation.name}",
                cure="choose one of these, or interval: whole",
            )
        return found


@dataclass(frozen=True)
class Pieces:
    """Equation (1) for scans of one kind.

    Attributes
    ----------
    parts, fits
        The samples of each interval, and the fit to them.
    gaps
        Samples between intervals: how many intervals are before them, and what lines are made of.
    outside
        (n,) True for samples in no interval.
    """

    parts: list[slice]
    fits: list[Fit]
    gaps: list[tuple[int, slice, Basis]]
    outside: Bools

    @classmethod
    def of(cls, parts: list[slice], order: int, use: Bools) -> Pieces:
        """Polynomials up to ``order`` fitted to the samples ``use`` (n,) of each part; a part
        begins behind the one before.
        """
        outside = np.ones(len(use), bool)
        for part in parts:
            outside[part] = False
        fits = [Fit.of(polynomials(p.stop - p.start, order), use[p]) for p in parts]
        starts = [0, *(p.stop for p in parts)]
        stops = [*(p.start for p in parts), len(use)]
        gaps = [
            (k, slice(a, b), polynomials(b - a, 1))
            for k, (a, b) in enumerate(zip(starts, stops, strict=True))
            if b > a
        ]
        return cls(parts, fits, gaps, outside)

    def remove(self, rows: Rows, masked: Bools | None = None) -> int:
        """Equation (1) on rows in place; the rest as of `Fit.remove`."""
        spoilt = 0
        removed = list[Floats]()
        for part, fit in zip(self.parts, self.fits, strict=True):
            found, bad = fit.coefficients(
                rows.at(part.start),
                None if masked is None else masked[:, part],
            )
            fit.basis.subtract(rows.at(part.start), found)
            removed.extend(product(found, fit.basis.functions[:, [0, -1]]).T)
            spoilt += bad
        removed = [removed[0], *removed, removed[-1]]
        for k, gap, lines in self.gaps:
            before = removed[2 * k]
            behind = removed[2 * k + 1]
            n = gap.stop - gap.start
            line = (
                (before + behind) / 2,
                (behind - before) / (2 + 2 / n),
            )  # through the samples on either side of the gap
            lines.subtract(rows.at(gap.start), np.stack(line, axis=1))
        return spoilt

    def adjoint(self, rows: Rows, masked: Bools | None = None) -> None:
        """Transpose of `remove` on float64 rows in place: lines of gaps act on the polynomials'
        values at the ends of the intervals beside them.
        """
        ends = np.zeros((2 * len(self.parts) + 2, len(rows.values)))
        for k, gap, lines in self.gaps:
            n = gap.stop - gap.start
            mean, slope = lines.sums(rows.at(gap.start), np.ones(n, bool)).T
            ends[2 * k] += mean / 2 - slope / (2 + 2 / n)
            ends[2 * k + 1] += mean / 2 + slope / (2 + 2 / n)
        ends[1] += ends[0]
        ends[-2] += ends[-1]
        for k, (part, fit) in enumerate(zip(self.parts, self.fits, strict=True)):
            some = np.ascontiguousarray(rows.values[:, part])
            more = product(ends[2 * k + 1 : 2 * k + 3].T, fit.basis.functions[:, [0, -1]].T)
            fit.adjoint(Rows.of(some), None if masked is None else masked[:, part], more)
            rows.values[:, part] = some
