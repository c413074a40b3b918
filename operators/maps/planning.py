"""Planning of the map makers: pixels, weights and memory."""

from __future__ import annotations

import math

import numpy as np

from zonda.core.data import Observation
from zonda.core.numerics.projection import boresights
from zonda.core.plan.bounds import Traits
from zonda.core.plan.planning import Planning

from .bin_map import BinMap
from .coverage import COUNTS
from .grid import in_frame
from .maximum_likelihood import MaximumLikelihoodMap

HEALPY = 32_000_000
"""Bytes of the library."""
COMPILED = 25_000_000
"""Bytes of the compiled code of maximum-likelihood maps, and of what the allocator keeps."""


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
                step.centre.icrs() if step.centre else observation.centre,
                step.frame,
            )
            side *= math.sqrt(max(math.cos(latitude), side))
        return Traits(
            pixel=side,
            weighs=step.weights == "inverse_variance" and step.contents == "all",
        )

    def memory(self, observation: Observation) -> int:
        """Sums of two halves, what is found of the pointing, and healpy."""
        step, signals = self.operator, len(observation.signals)
        each, samples = 16 * (3 + signals), 150
        if step.stokes == "IQU":
            each, samples = 16 * (7 + 3 * signals), 250
        each += sum(count.memory for name, count in COUNTS.items() if getattr(step, name))
        each += 40 if step.scan_hits else 0
        samples += 144 if step.crosslinking else 0
        more = HEALPY + 24 * step.grid.n_pixels if step.nside else 0
        return each * step.grid.n_pixels + samples * observation.n_samples + more

    def per_thread(self, observation: Observation, spilled: int) -> int:
        """Sums of a thread: hits, weights and data; weights and noise of their own where detectors
        differ.
        """
        signals, net = len(observation.signals), observation.focalplane.net
        own = self.operator.noise == "scatter" or observation.window is not None
        if self.operator.stokes == "IQU":
            columns = 7 + 3 * signals + 6 * own
        else:
            columns = 1 + signals + 2 * (own or not np.all(net == net[:1]))
        return 8 * columns * self.pixels

    def finished(self, observation: Observation) -> tuple[int, int]:
        """Sums beside the planes of all signals, the difference of others among them; planes of
        HEALPix maps are copied into tables.
        """
        step, signals = self.operator, len(observation.signals)
        each = 165 if step.stokes == "IQU" else 40
        each += sum(count.memory for name, count in COUNTS.items() if getattr(step, name))
        planes = each * (signals + (signals > 1)) * self.pixels
        table = 75 * self.pixels if step.nside else 0
        return self.memory(observation) + planes + table, planes + table

    @property
    def pixels(self) -> int:
        """Pixels of the map."""
        return self.operator.grid.n_pixels


class MaximumLikelihoodPlanning(BinMapPlanning):
    """Runs and baselines of all scans; at the end the maps of the iteration."""

    of = MaximumLikelihoodMap
    operator: MaximumLikelihoodMap
    smaller = "choose a larger pixel or a longer baseline"

    def memory(self, observation: Observation) -> int:
        """Six bytes a run (22 with I, Q and U), twice while those of a scan are put in order; sums
        of baselines and free modes; and its compiled code.
        """
        step = self.operator
        samples, instants = step._samples
        signals, length = len(observation.signals), max(step.baseline * observation.sample_rate, 1)
        twice = samples + observation.n_samples * observation.n_detectors
        runs = (22 if self.polarized else 6) * twice * self.runs(observation)
        sums = (40 + 16 * signals) * samples / length + 16 * signals * step.free * instants
        return super().memory(observation) + int(runs + sums) + COMPILED

    def finished(self, observation: Observation) -> tuple[int, int]:
        """Maps of conjugate gradients and of smooth patterns, and weights with their inverse; of a
        half difference those of the whole and of one half, too.
        """
        most, product = super().finished(observation)
        stokes, weights = (3, 12) if self.polarized else (1, 2)
        halves = 2 * (stokes + weights) * bool(self.operator.half_difference)
        maps = 15 * stokes + weights + 6 + halves
        return most + 8 * maps * self.pixels, product + COMPILED

    @property
    def polarized(self) -> bool:
        """True for maps of I, Q and U."""
        return self.operator.stokes == "IQU"

    def runs(self, observation: Observation) -> float:
        """Runs per sample: the boresight crosses 4 / pi pixels for each pixel of its way, and runs
        end with baselines.
        """
        step = self.operator
        if observation.hwp_angle is not None:
            return 1.0
        forward = np.diff(boresights(observation.boresight_radec), axis=1)
        way = float(np.sqrt((forward**2).sum(axis=0)).mean()) if forward.size else 0.0
        crossed = 4 / math.pi * way / (self.traits(observation).pixel or way or 1.0)
        return min(1.0, 1.1 * crossed + 1 / max(step.baseline * observation.sample_rate, 1))

    def sweeps(self, observation: Observation) -> int:
        """One reading finds runs and baselines."""
        return 1
