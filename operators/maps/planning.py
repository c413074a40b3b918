"""Planning of the map makers: pixels, weights and memory."""

from __future__ import annotations

import math

from zonda.core.data import Observation
from zonda.core.plan.bounds import Traits
from zonda.core.plan.planning import Planning

from .bin_map import BinMap
from .coverage import COUNTS
from .grid import in_frame


class BinMapPlanning(Planning[BinMap]):
    """The memory grows with the pixels."""

    of = BinMap
    smaller = "choose a larger pixel or a smaller width"

    def traits(self, observation: Observation) -> Traits:
        """Size of the pixels (the root of their solid angle in the middle of the map), and the
        weights.
        """
        step = self.operator
        side = math.sqrt(4 * math.pi / (12 * step.nside**2)) if step.nside else step.pixel
        if step.projection == "CAR" and not step.nside:
            _, latitude = in_frame(
                step.centre.icrs() if step.centre else observation.centre, step.frame
            )
            side *= math.sqrt(max(math.cos(latitude), side))
        return Traits(
            pixel=side, weighs=step.weights == "inverse_variance" and step.contents == "all"
        )

    def memory(self, observation: Observation) -> int:
        """Sums of two threads, two halves, the products of all signals; and the pointing, twice
        while it is laid out.
        """
        step, signals = self.operator, len(observation.signals)
        each, samples = 56 + 72 * signals, 150
        if step.stokes == "IQU":
            # hits, six sums and three for each signal, in two threads and two halves
            each, samples = 32 * (7 + 3 * signals) + 240 * signals, 250
        each += sum(count.memory for name, count in COUNTS.items() if getattr(step, name))
        each += 40 if step.scan_hits else 0
        samples += 144 if step.crosslinking else 0
        return each * step.grid.n_pixels + samples * observation.n_samples
