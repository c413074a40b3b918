"""Bands that are observed, and their views of a scan.

A camera of several bands is one focal plane: the telescope is pointed once, and every step is given
a view of one band, as if the camera had no other. Every band has the bits that it has alone. What
bands share is keyed without them: pointing, and the turbulence above the telescope. What belongs to
detectors is keyed by instrument and band (`Observation.detector_key`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

from ..assembly.signals import Chain
from ..data import Data
from ..observation import Observation
from ..operator import Operator
from ..output import Output, Progress


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

    def watch(self, done: Progress) -> None:
        """Tell the outputs what is done."""
        for operator in self.operators:
            if isinstance(operator, Output):
                operator.watch(self.data, done)
