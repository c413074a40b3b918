"""The signal of a pipeline that simulates nothing but the sky."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from .data import Block
from .operator import Operator


class SkySignal(Operator):
    """Makes the sky the signal: there is nothing to calibrate where no step makes anything else.

    The pipeline puts it before the first step that reads ``signal``, where no step provides that and all that is provided up to
    there is ``sky``. It is not one of the pipeline's own steps.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"sky"})
    provides: ClassVar[frozenset[str]] = frozenset({"signal"})
    linear: ClassVar[bool] = True
    knows_means: ClassVar[bool] = True

    @property
    def label(self) -> str:
        """In timings."""
        return "(sky as signal)"

    def exec(self, block: Block, state: Any) -> None:
        block.new("signal", zero=False)[...] = block.detdata["sky"]
        if "sky" in block.means:
            block.means["signal"] = block.means["sky"]


def place_of_signal(operators: Sequence[Operator]) -> int | None:
    """Index of the first step that reads ``signal`` where the sky alone is to be the signal, else None."""
    if any("signal" in o.provides and "signal" not in o.requires for o in operators):
        return None
    for index, operator in enumerate(operators):
        if "signal" in operator.requires:
            made = set().union(*(o.provides for o in operators[:index])) - {"boresight"}
            return index if made == {"sky"} else None
    return None
