"""A chain: the steps that act on an observation, and the signals that they make."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

from ..mapmaker import filters, forms
from ..operator import Operator
from ..signal import MAIN, Formed

COMPLETE = (Formed(MAIN, frozenset()),)
"""The complete signal alone."""


@dataclass(frozen=True)
class Chain:
    """The steps that act on an observation, and the signals that they make.

    Attributes
    ----------
    steps
        In order.
    signals
        Those that are formed, the complete one first.
    components
        Names of all streams that become part of a signal.
    keep
        Streams that the user asked for.
    """

    steps: Sequence[Operator]
    signals: tuple[Formed, ...] = COMPLETE
    components: frozenset[str] = frozenset()
    keep: tuple[str, ...] = ()

    def expanded(self, names: Collection[str]) -> frozenset[str]:
        """Names of streams, with those of all signals in place of ``signal``."""
        return (
            frozenset(names) | {s.stream for s in self.signals}
            if MAIN in names
            else frozenset(names)
        )

    @property
    def read(self) -> frozenset[str]:
        """Names of the streams that are needed: what `Operator.exec` or `Operator.measure` reads,
        and what is kept.
        """
        names = frozenset(self.keep)
        for step in self.steps:
            if type(step).exec is not Operator.exec or type(step).measure is not Operator.measure:
                names |= (
                    self.of(step, self.signals) if forms(step) else step.requires | step.optional
                )
        return self.expanded(names - {"boresight"})

    def of(self, step: Operator, signals: Collection[Formed]) -> frozenset[str]:
        """Names of the streams that a step which forms signals reads for these."""
        unknown = not self.components
        parts = frozenset[str]().union(*(s.components for s in signals))
        return frozenset(
            n
            for n in step.requires | step.optional | parts
            if unknown or n in parts or n not in self.components
        )

    def needed_for(self, signals: Collection[Formed], *, filtered: bool) -> list[Operator]:
        """The steps that form signals, those that filter them if so wanted, and those that make
        what these read.
        """
        found: list[Operator] = []
        names = frozenset[str]()
        for step in reversed(self.steps):
            if forms(step) or (filtered and filters(step)):
                names |= self.of(step, signals)
            elif step.provides & names:
                names |= step.requires | step.optional
            else:
                continue
            found.insert(0, step)
        return found
