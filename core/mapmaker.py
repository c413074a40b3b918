"""Kinds of steps that the executor treats in a way of their own: map makers, and the step that makes the sky the signal."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar

from .block import Block
from .operator import Operator
from .output import Output
from .signal import MAIN, is_stream


class MapMaker(Operator):
    """A step that makes products of every signal: its `exec` sees all of them, under the names `Block.signals`.

    What is not finite in one of them is NaN in all.

    Where it is `linear`, the product of a remainder is subtracted (`core.product.Product.subtract`), not simulated.
    """


class SkySignal(Operator):
    """Makes the sky the signal: there is nothing to calibrate where no step makes anything else.

    The pipeline puts it before the first step that reads ``signal``, where no step provides that and all that is provided up to
    there is ``sky``. It is not one of the pipeline's own steps.
    """

    requires: ClassVar[frozenset[str]] = frozenset({"sky"})
    provides: ClassVar[frozenset[str]] = frozenset({MAIN})
    linear: ClassVar[bool] = True
    knows_means: ClassVar[bool] = True

    @property
    def label(self) -> str:
        """Its name in timings."""
        return "(sky as signal)"

    def exec(self, block: Block, state: Any) -> None:
        block.new(MAIN, zero=False)[...] = block.detdata.get("sky", 0.0)  # a signal without the sky is nothing
        if "sky" in block.means:
            block.means[MAIN] = block.means["sky"]


def place_of_signal(operators: Sequence[Operator]) -> int | None:
    """Index of the first step that reads ``signal`` where the sky alone is to be the signal, else None."""
    if any(forms(o) for o in operators):
        return None
    for index, operator in enumerate(operators):
        if MAIN in operator.requires:
            made = set().union(*(o.provides for o in operators[:index])) - {"boresight"}
            return index if made == {"sky"} else None
    return None


def with_sky_signal(operators: Sequence[Operator]) -> list[Operator]:
    """The steps, and a `SkySignal` where it has its place."""
    place = place_of_signal(operators)
    return list(operators) if place is None else [*operators[:place], SkySignal(), *operators[place:]]


def forms(operator: Operator) -> bool:
    """Whether it makes signals of their components."""
    return MAIN in operator.provides and MAIN not in operator.requires


def filters(operator: Operator) -> bool:
    """Whether it changes signals."""
    return MAIN in operator.provides and MAIN in operator.requires


def makes_products(operator: Operator) -> bool:
    """Whether all that it makes are products in memory: map makers, spectra. (What a step writes while it runs, it does not
    provide.)"""
    names = operator.provides
    return bool(names) and not any(n == "boresight" or is_stream(n) for n in names) and not isinstance(operator, Output)
