"""What tells a companion run from the main run."""

from __future__ import annotations

from typing import Literal

from pydantic import Field, model_validator

from ..configuration.parameters import Parameters


class Companion(Parameters):
    """A companion run: the same pipeline and random numbers with some signal components absent."""

    only: list[str] | None = Field(None, min_length=1)
    """Components to keep (e.g. [sky]: the noiseless run); all others are left out."""
    without: list[str] | None = Field(None, min_length=1)
    """Components to leave out (e.g. [sky]: the source-free run)."""
    modes: Literal["own", "full"] = "own"
    """Singular modes of filters: those of this run's own data (`own`: the noiseless run), or those of the complete data (`full`:
    with the main run's modes, flags, weights and transmission of the air all is linear, and what is left of each part adds up to
    the main run; of two runs that are its parts one need not be simulated, see `core.run.derived`)."""
    filters: Literal["all", "none"] = "all"
    """`none`: leave out every step that changes the signal once it is formed."""

    @model_validator(mode="after")
    def _one_of_two(self) -> Companion:
        if (self.only is None) == (self.without is None):
            raise ValueError("give either only or without")
        return self

    def keeps(self, provides: frozenset[str]) -> bool:
        """Whether an operator that provides these components takes part."""
        if self.only is not None:
            return bool(provides & set(self.only))
        return not provides & set(self.without or ())
