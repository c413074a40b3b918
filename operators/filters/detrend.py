"""Removes a polynomial from each detector's scan: equation (1) of `baseline`."""

from __future__ import annotations

from typing import ClassVar, Literal

from pydantic import Field

from zonda.core.data import Block, Data, Observation
from zonda.core.flags import has_a_signal
from zonda.core.operator import Operator

from .baseline import Fit, polynomials
from .rows import by_rows
from .source_mask import Inside, SourceMask, check_mask, check_masks


class Detrend(Operator):
    """Remove the polynomial that fits each detector's scan best, the mean of the atmosphere
    included: equation (1) of `baseline`.

    Order 1 is what the mapper of maria 1.0.0 does first (``scipy.signal.detrend``). Flagged samples
    are not used.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"signal"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    knows_means: ClassVar[bool] = True
    linear: ClassVar[bool] = True
    couples: ClassVar[Literal["sample", "detectors", "time", "all"]] = "time"

    order: int = Field(1, ge=0, le=20)
    """Order of the polynomial (0: the mean, 1: a line)."""
    mask: SourceMask | None = None
    """Source whose samples are not used for the fit; it is subtracted there too."""

    def check(self, data: Data) -> list[str]:
        """Refuse a mask that cannot be used."""
        return check_masks(self.mask, data, self.label)

    def prepare(self, observation: Observation) -> tuple[Fit, Inside | None]:
        """The fit to this observation's good samples."""
        use = has_a_signal(observation.flags)
        inside = self.mask.of(observation) if self.mask else None
        if inside is not None:
            check_mask(inside, observation, f"{self.label}, {observation.name}")
        return Fit.of(polynomials(observation.n_samples, self.order), use), inside

    def exec(self, block: Block, state: tuple[Fit, Inside | None]) -> None:
        """Subtract the fit from each row."""
        fit, inside = state
        by_rows(self.label, block, fit.remove, inside)
