"""Removes a polynomial from every interval of each detector's scan.

In interval i, B_i the Legendre polynomials up to `order` over its samples and g the samples that
are used,

    y = x - B_i^T (B_ig B_ig^T)^-1 B_ig x_g                                                      (1)

(equation (1) of `baseline` for each interval by itself; `PolyFilter` of TOAST). A sample between
two intervals belongs to none. It loses the straight line from the last value of the polynomial
before it to the first value of the one behind it, before the first interval and behind the last one
a constant, so that what is removed does not jump there; it is flagged, and no map uses it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from zonda.core.data import Block, Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.flags import TRIMMED, has_a_signal
from zonda.core.intervals import ranges
from zonda.core.numerics.smooth import product
from zonda.core.operator import Operator
from zonda.core.types import Floats

from .baseline import Basis, Fit, polynomials
from .rows import Rows, by_rows
from .source_mask import Inside, SourceMask, check_mask, check_masks

Part = Literal[
    "whole",
    "scanning",
    "throw",
    "throw_leftright",
    "throw_rightleft",
    "scan_leftright",
    "scan_rightleft",
]
"""The whole scan, or one of TOAST's names of intervals (`core.intervals`)."""


class PolynomialFilter(Operator):
    """Remove the polynomial that fits each interval of each detector's scan best (least squares).

    Flagged samples are not used for the fit; turnarounds are, where the interval contains them.
    Where an interval has too few samples for all orders, the polynomials that they determine are
    removed.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    linear: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "time"

    order: int = Field(3, ge=0, le=20)
    """Order of the polynomials (0: the mean, 1: a line)."""
    interval: Part = "whole"
    """What each polynomial is fitted to: the whole scan, every pass at constant speed (`scanning`,
    or one direction alone), or every pass with half of the turnarounds on either side (`throw`)."""
    mask: SourceMask | None = None
    """Source whose samples are not used for the fit; it is subtracted there too."""

    def check(self, data: Data) -> list[str]:
        """Refuse intervals that a scan does not have."""
        for observation in data.observations if self.interval != "whole" else ():
            if not observation.intervals.get(self.interval):
                self._parts(observation)
        return check_masks(self.mask, data, self.label)

    def prepare(self, observation: Observation) -> tuple[Pieces, Inside | None]:
        """The fits to this observation's good samples; flags what is in no interval."""
        n = observation.n_samples
        parts = [slice(0, n)] if self.interval == "whole" else self._parts(observation)
        use = has_a_signal(observation.flags)
        pieces = Pieces.of(parts, self.order, use)
        observation.flags[pieces.outside] |= TRIMMED
        observation.tally.count(
            self.label, "samples between intervals, flagged", int(pieces.outside.sum()), n
        )
        observation.tally.state(
            self.label, f"{observation.name}: polynomials of order {self.order}", f"{len(parts)}"
        )
        inside = self.mask.of(observation) if self.mask else None
        if inside is not None:
            check_mask(inside, observation, f"{self.label}, {observation.name}")
        return pieces, inside

    def _parts(self, observation: Observation) -> list[slice]:
        """The intervals of a scan. Raises PipelineError where there are none of that name."""
        found = [
            p
            for p in ranges(observation.intervals.get(self.interval, []), observation.seconds)
            if p.stop > p.start
        ]
        if not found:
            there = (
                ", ".join(name for name, spans in observation.intervals.items() if spans) or "none"
            )
            raise PipelineError(
                f"the scan has no interval {self.interval!r}; it has {there}",
                place=f"{self.label}, {observation.name}",
                cure="choose one of these, or interval: whole",
            )
        return found

    def exec(self, block: Block, state: tuple[Pieces, Inside | None]) -> None:
        """Subtract the fits from each row."""
        pieces, inside = state
        by_rows(self.label, block, pieces.remove, inside)


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
    outside: NDArray[np.bool_]

    @classmethod
    def of(cls, parts: list[slice], order: int, use: NDArray[np.bool_]) -> Pieces:
        """Polynomials up to ``order`` fitted to the samples ``use`` (n,) of each part; a part
        begins behind the one before.
        """
        outside = np.ones(len(use), bool)
        for part in parts:
            outside[part] = False
        fits = [
            Fit(_basis(n, order), use[p], _inverse(n, order, use[p]))
            for p in parts
            for n in (p.stop - p.start,)
        ]
        starts, stops = [0, *(p.stop for p in parts)], [*(p.start for p in parts), len(use)]
        gaps = [
            (k, slice(a, b), _basis(b - a, 1))
            for k, (a, b) in enumerate(zip(starts, stops, strict=True))
            if b > a
        ]
        return cls(parts, fits, gaps, outside)

    def remove(self, rows: Rows, masked: NDArray[np.bool_] | None = None) -> int:
        """Equation (1) on rows in place; the rest as of `Fit.remove`."""
        spoilt, removed = 0, list[Floats]()
        for part, fit in zip(self.parts, self.fits, strict=True):
            found, bad = fit.coefficients(
                rows.at(part.start), None if masked is None else masked[:, part]
            )
            fit.basis.subtract(rows.at(part.start), found)
            removed.extend(product(found, fit.basis.functions[:, [0, -1]]).T)
            spoilt += bad
        removed = [removed[0], *removed, removed[-1]]
        for k, gap, lines in self.gaps:
            before, behind, n = removed[2 * k], removed[2 * k + 1], gap.stop - gap.start
            line = (
                (before + behind) / 2,
                (behind - before) / (2 + 2 / n),
            )  # through the samples on either side of the gap
            lines.subtract(rows.at(gap.start), np.stack(line, axis=1))
        return spoilt


@lru_cache(maxsize=16)
def _basis(n: int, order: int) -> Basis:
    """`polynomials`, once for intervals of equal length."""
    return polynomials(n, order)


def _inverse(n: int, order: int, use: NDArray[np.bool_]) -> Floats:
    """`Basis.inverse`, once for intervals of equal length all of whose samples are used."""
    return _whole(n, order) if use.all() else _basis(n, order).inverse(use)


@lru_cache(maxsize=256)
def _whole(n: int, order: int) -> Floats:
    return _basis(n, order).inverse(np.ones(n, bool))
