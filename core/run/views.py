"""Chains of steps, and the bands that they act on.

A camera of several bands is one focal plane: the telescope is pointed once, and every step is given
a view of one band, as if the camera had no other. Every band has the bits that it has alone. What
bands share is keyed without them: pointing, and the turbulence above the telescope. What belongs to
detectors is keyed by instrument and band (`Observation.detector_key`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

from ..data import Data
from ..mapmaker import filters, forms
from ..observation import Observation
from ..operator import Operator
from ..output import Output, Progress
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


@dataclass
class View:
    """One band of a scan, whose detectors are rows of the scan's streams; or a scan of one band.

    Attributes
    ----------
    chain
        The steps, the band's own copies.
    data
        What they add up.
    number, rows
        Its number, and its rows in the streams, among the bands that are executed together.
    states, measured
        What `Operator.prepare` returned, by label, and `Operator.measure`, by label and signal.
    """

    chain: Chain
    observation: Observation
    data: Data | None = None
    number: int = 0
    rows: slice = field(default_factory=lambda: slice(None))
    states: dict[str, Any] = field(default_factory=dict)
    measured: dict[tuple[str, str], Any] = field(default_factory=dict)

    @property
    def shape(self) -> tuple[int, int]:
        """(detectors, samples)."""
        return self.observation.n_detectors, self.observation.n_samples


@dataclass(frozen=True)
class Band:
    """One band that observes, or a camera that has one.

    Attributes
    ----------
    operators
        The steps, the band's own copies; outputs that act on all bands are none of them.
    """

    operators: Sequence[Operator]
    chain: Chain
    data: Data

    @property
    def longest(self) -> View:
        """The scan of most samples."""
        scans = self.data.observations
        return View(self.chain, max(scans, key=lambda o: o.n_detectors * o.n_samples))

    def keeping(self, streams: Sequence[str]) -> Band:
        """The band, whose ``streams`` are kept."""
        return replace(self, chain=replace(self.chain, keep=tuple(streams)))

    def watch(self, done: Progress) -> None:
        """Tell the outputs what is done."""
        for operator in self.operators:
            if isinstance(operator, Output):
                operator.watch(self.data, done)
