"""The transmission of the air without its emission, for companion runs with ``modes: full``."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import PrivateAttr

from ..data import Block, Observation
from ..operator import Operator

TRANSMISSION = "transmission"
"""It multiplies the other components: a factor, not a part of the sum."""


class _TakenAway:
    """The streams that a `SameAir` changes: it takes them away."""

    def __get__(self, operator: SameAir | None, owner: type) -> frozenset[str]:
        return frozenset() if operator is None else operator._names


class SameAir(Operator):
    """Takes away what a step made beside the transmission.

    What the filters leave of the components adds up to the main run only where all runs look through the same air: the sky
    reaches a detector as e^-tau T_astro, whose e^-tau fluctuates, and noise is calibrated with the mean e^-tau. A run with
    ``modes: full`` that leaves the air out as a component keeps its transmission. The pipeline puts this step behind the one
    that makes the air.
    """

    provides: ClassVar[Any] = _TakenAway()
    knows_means: ClassVar[bool] = True
    prepares_ahead: ClassVar[bool] = True

    _names: frozenset[str] = PrivateAttr(frozenset())

    @classmethod
    def behind(cls, operator: Operator) -> SameAir:
        """The step that belongs behind ``operator``."""
        made = cls()
        made._label = f"(transmission of {operator.label})"
        made._names = operator.provides - {TRANSMISSION}
        return made

    def prepare(self, observation: Observation) -> None:
        for name in self._names:
            observation.smooth.pop(name, None)

    def exec(self, block: Block, state: Any) -> None:
        for name in self._names:
            block.detdata.pop(name, None)
            block.means.pop(name, None)
