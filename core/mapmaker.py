"""Kinds of steps that the executor treats in a way of their own: map makers, steps that measure all
bands together, and the step that adds up what is calibrated.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Protocol, runtime_checkable

from pydantic import PrivateAttr

from .block import Block
from .data import Data
from .numerics.smooth import FieldSums
from .operator import Operator
from .output import Output
from .signal import MAIN, Component, is_stream


class MapMaker(Operator):
    """A step that makes products of every signal: its `exec` sees all of them, under the names
    `Block.signals`.

    What is not finite in one of them is NaN in all.

    Where it does more than to average (`averages`), the maps of signals with ``filters: none`` are
    means of samples all the same: what its other maps are compared with.

    Where it is `linear`, the product of a remainder is subtracted
    (`core.product.Product.subtract`), not simulated. With `all_bands` it has `exec_bands`.

    Where it is `unfiltered`, steps that remove something of signals (`removes`) are refused before
    it.
    """

    averages: ClassVar[bool] = True
    unfiltered: ClassVar[bool] = False

    def exec_bands(self, blocks: Sequence[Block], states: Sequence[Any]) -> None:
        """Act on the blocks of several bands, of the same detectors and samples, each with what
        `prepare` of its band's own copy of this step returned.

        Called in place of `exec` where the detectors of all bands look through the same pixels.
        """
        raise NotImplementedError

    def finalize_bands(self, every: Sequence[Data]) -> None:
        """Finish the products of all bands, given the data of each.

        Called in place of `finalize` where the step measures all bands together (`joins`), when the
        products of the first band are due.
        """
        raise NotImplementedError


@runtime_checkable
class JoinsBands(Protocol):
    """A step with ``couples = "all"`` that may measure the detectors of all bands together.

    Attributes
    ----------
    all_bands
        True where it does.
    """

    all_bands: bool

    def of_rows(self, measured: Any, rows: slice) -> Any:
        """Select, of what ``measure`` returned for the detectors of all bands, the part of some of
        them.
        """
        ...


def joins(operator: Operator) -> bool:
    """Tell whether a step measures the detectors of all bands together."""
    return operator.couples == "all" and isinstance(operator, JoinsBands) and operator.all_bands


class CalibratedSignal(Operator):
    """Adds up the sky and the components that enter calibrated, where no step makes anything else:
    nothing is to be calibrated.

    The pipeline puts it before the first step that reads ``signal``, where no step provides that
    and nothing else is provided up to there. It is not one of the pipeline's own steps.
    """

    provides = frozenset({MAIN})
    linear = True
    knows_means = True

    _reads: frozenset[str] = PrivateAttr(frozenset({"sky"}))
    _means: FieldSums = PrivateAttr(default_factory=FieldSums)

    @property
    def requires(self) -> frozenset[str]:
        """Streams that are added up."""
        return self._reads

    @property
    def label(self) -> str:
        """Its name in timings."""
        return "(sky as signal)" if self._reads == {"sky"} else "(sum as signal)"

    def exec(self, block: Block, state: Any) -> None:
        out = block.new(MAIN, zero=False)
        empty = True
        names = [
            name for name in sorted(self._reads) if name in block.detdata
        ]  # a signal without the sky has none
        for name in names:
            if empty:
                out[...] = block.detdata[name]
            else:
                out += block.detdata[name]
            empty = False
        if empty:
            out.fill(0)
        if fields := [block.means[name] for name in names if name in block.means]:
            block.means[MAIN] = self._means.of(fields)


def place_of_signal(operators: Sequence[Operator], wanted: bool = False) -> int | None:
    """Index of the first step that reads ``signal`` where what is calibrated makes up the signal,
    else None. ``wanted``: the end, if no step reads it.
    """
    if any(forms(o) for o in operators):
        return None
    for index, operator in enumerate(operators):
        if MAIN in operator.requires:
            return index if _calibrated(operators[:index]) else None
    return len(operators) if wanted and _calibrated(operators) else None


def _calibrated(operators: Sequence[Operator]) -> frozenset[str]:
    """Streams of these steps, where all of them are sky or enter calibrated; else none."""
    made = [
        name
        for o in operators
        if not changes_components(o)
        for name in o.provides
        if name != "boresight"
    ]
    known = all(
        name == "sky" or (isinstance(name, Component) and name.enters == "calibrated")
        for name in made
    )
    return frozenset(made) if known else frozenset()


def with_calibrated_signal(operators: Sequence[Operator], wanted: bool = False) -> list[Operator]:
    """The steps, and a `CalibratedSignal` where it has its place (`place_of_signal`)."""
    place = place_of_signal(operators, wanted)
    if place is None:
        return list(operators)
    step = CalibratedSignal()
    step._reads = _calibrated(operators[:place])
    return [*operators[:place], step, *operators[place:]]


def forms(operator: Operator) -> bool:
    """Tell whether a step makes signals of their components."""
    return MAIN in operator.provides and MAIN not in operator.requires


def filters(operator: Operator) -> bool:
    """Tell whether a step changes signals."""
    return MAIN in operator.provides and MAIN in operator.requires


def removes(operator: Operator) -> bool:
    """Tell whether a step removes something of signals, by what it declares: it depends on whole
    scans, or handles means, as steps do that remove them. Instruments' effects do neither.
    """
    return filters(operator) and (operator.couples in ("time", "all") or operator.knows_means)


def changes_components(operator: Operator) -> bool:
    """Tell whether a step changes streams that others make, before a signal is formed of them, and
    makes none: it reads all that it provides, and is no part of any signal itself."""
    return (
        MAIN not in operator.provides
        and bool(operator.provides)
        and operator.provides <= operator.requires | operator.optional
    )


def made_by(operator: Operator) -> frozenset[str]:
    """Names that a step provides, without streams that it only changes."""
    return frozenset() if changes_components(operator) else operator.provides


def makes_products(operator: Operator) -> bool:
    """Tell whether a step makes products in memory alone: map makers, spectra. (What a step writes
    while it runs, it does not provide.)"""
    names = operator.provides
    return (
        bool(names)
        and not any(n == "boresight" or is_stream(n) for n in names)
        and not isinstance(operator, Output)
    )


def acts(operator: Operator) -> bool:
    """Tell whether a step works on observations: it is no output, and no step that points and
    has no ``exec``.
    """
    points = "boresight" in operator.provides and type(operator).exec is Operator.exec
    return not isinstance(operator, Output) and not points
