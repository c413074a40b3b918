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
        others = len(observation.signals) - 1
        counts = (count.memory for name, count in COUNTS.items() if getattr(self.operator, name))
        more = sum(counts) + (40 if self.operator.scan_hits else 0)
        samples = 144 * observation.n_samples if self.operator.crosslinking else 0
        return more * self.operator.grid.n_pixels + samples + self._sums(observation, others)

    def _sums(self, observation: Observation, others: int) -> int:
        """Bytes of the sums with ``others`` signals beside the first."""
        if (
            self.operator.stokes == "IQU"
        ):  # hits, six sums and three for each signal, in two threads and two halves
            return (
                32 * (7 + 3 * (1 + others)) + 240 * (1 + others)
            ) * self.operator.grid.n_pixels + 250 * observation.n_samples
        return (128 + 72 * others) * self.operator.grid.n_pixels + 150 * observation.n_samples
