"""Planning of the map makers: pixels, weights and memory."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from zonda.core.data import Data, Observation
from zonda.core.plan.bounds import Traits
from zonda.core.plan.planning import Planning, samples_in

from .bin_map import BinMap
from .compressed_scan import PART, Keeps
from .coverage import COUNTS
from .grid import in_frame
from .map_layout import MapLayout
from .maximum_likelihood import FEWEST, MaximumLikelihoodMap
from .noise_record import NoiseRecord
from .normal_equations import Work
from .parameters import LONGEST
from .runs_of_pointing import FOUND

HEALPY = 32_000_000
"""Bytes of the library."""
BRIEF = 1e-2
"""Residual at which iterations end whose time is measured."""
MOST_COUNTED = 500_000
"""Pixels of a map whose iterations are counted, about."""
WINDOWS, WINDOW = 64, 64
"""Windows of a scan, and their samples, in which changes of pixel are counted."""
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
    smaller = "choose a larger pixel or a longer baseline, or shorter scans"

    def memory(self, observation: Observation) -> int:
        """The compressed scans, unless they are in files; runs of some detectors; sums and spectra
        of the baselines of a scan; and its compiled code.
        """
        signals = len(observation.signals)
        own = 8 * FOUND + (60 + 8 * signals) * self.baselines(observation)
        own += 16 * signals * self.free(observation) * observation.n_samples
        if not self.operator._in_files:
            own += self.compressed(observation)
        return super().memory(observation) + int(own) + COMPILED

    def compressed(self, observation: Observation) -> int:
        """Bytes of all compressed scans: 6 r N + (12 + 8 n) N / L + 8 n k T for n signals and k
        free modes of N samples at T instants, r runs a sample, and 6 a gap; 22 r N with I, Q and U.
        Of runs that are found anew (4 + 8 n) N / L + 8 n k T. With gaps 4 N / L more.
        """
        step, signals = self.operator, len(observation.signals)
        samples, instants = step._samples
        baselines = samples / self.length(observation)
        free = 8 * signals * self.free(observation) * instants
        gaps = self.gaps(observation)
        each = 8 * signals + (8 if gaps else 4)
        if step._keeps is Keeps.AGAIN:
            return int(each * baselines + free)
        runs = samples * self.runs(observation) + gaps
        return int(self.of_run * runs + (8 + each) * baselines + free)

    def free(self, observation: Observation) -> int:
        """Free modes of all groups."""
        return self.operator.free * len(np.unique(self.operator.groups_of(observation)))

    def gaps(self, observation: Observation) -> float:
        """Samples outside a map of a given width, each an unknown."""
        step = self.operator
        if step.width is None:
            return 0.0
        return MapLayout(step).outside([observation], step.grid) * step._samples[0]

    @property
    def of_run(self) -> int:
        """Bytes of a run."""
        return 22 if self.polarized else 6

    def finished(self, observation: Observation) -> tuple[int, int]:
        """Maps of conjugate gradients and of smooth patterns, and weights with their inverse; of a
        half difference those of the whole and of one half, too; of patterns two blocks of three.
        Each thread has baselines and maps of a scan.
        """
        most, product = super().finished(observation)
        stokes, weights = (3, 12) if self.polarized else (1, 2)
        halves = 2 * (stokes + weights) * bool(self.operator.half_difference)
        at_once, free = self.operator._at_once, self.free(observation)
        step = self.operator
        block = (max(step.patterns, 3 * stokes) + 1) * bool(step.patterns)
        maps = (15 + 3 * at_once + 14 * block) * stokes + weights + 6 + halves
        product += 8 * stokes * (1 + step.patterns) * self.pixels
        most += int(8 * (12 * stokes + 2) * self.gaps(observation))
        scan = int(50 * self.baselines(observation)) + 32 * free * observation.n_samples
        if self.operator._in_files:
            scan += PART + 80 * int(self.baselines(observation))
        bands = self.operator._bands
        if bands > 1:  # solutions are kept for other bands
            maps += stokes * self._solutions(observation)
        work = 8 * maps * self.pixels + at_once * scan
        return most + bands * work, product + COMPILED

    def baselines(self, observation: Observation) -> float:
        """Baselines of all detectors in a scan."""
        return observation.n_detectors * observation.n_samples / self.length(observation)

    def length(self, observation: Observation) -> float:
        """Samples of a baseline."""
        return max(self.operator.baseline_of(observation) * observation.sample_rate, 1)

    @property
    def polarized(self) -> bool:
        """True for maps of I, Q and U."""
        return self.operator.stokes == "IQU"

    def runs(self, observation: Observation) -> float:
        """Runs per sample: changes of pixel of some detectors in windows of the scan, a tenth more,
        and ends of baselines.
        """
        if observation.hwp_angle is not None:
            return 1.0
        n, grid, plane = observation.n_samples, self.operator.grid, observation.focalplane
        starts = np.linspace(0, max(n - WINDOW, 0), WINDOWS).astype(np.intp)
        some = (starts[:, None] + np.arange(min(WINDOW, n))).ravel()
        h = grid.pointing(replace(observation, boresight_radec=observation.boresight_radec[some]))
        every = slice(None, None, -(-len(plane) // 37))
        index = np.empty((len(plane.xi[every]), some.size), np.int32)
        grid.pixels(h, 0, some.size, plane.xi[every], plane.eta[every], index)
        changes = np.diff(index.reshape(len(index), WINDOWS, -1), axis=2) != 0
        crossed = float(changes.mean()) if changes.size else 0.0
        return min(1.0, 1.1 * crossed + 1 / self.length(observation))

    @property
    def shortest(self) -> float:
        """Length from which noise can be estimated, and one more baseline, s."""
        return (self.operator.baseline or LONGEST) * (FEWEST + self.operator.trend + 1)

    def states(self, observations: Sequence[Observation]) -> list[str]:
        """Readings, the size of the compressed scans, and solutions."""
        step, longest = self.operator, max(observations, key=lambda o: o.n_samples * o.n_detectors)
        size, runs = self.compressed(longest), self.runs(longest)
        kept = f"at {runs:.2g} runs a sample ({self.of_run} bytes each)"
        if step._keeps is Keeps.AGAIN:
            kept = f"without runs ({runs:.2g} a sample): these are found anew in each iteration"
        where = "in temporary files" if step._in_files else "in memory"
        return [
            "each scan is read twice: for runs, baselines and noise; for sums and free modes",
            f"compressed scans take {size / 1e9:.3g} GB {where}, with baselines of"
            f" {step.baseline_of(longest):.3g} s, {kept}",
            f"{self._solutions(longest)} solutions by conjugate gradients, {self._estimates} of"
            " them for the noise",
        ]

    def finishing(
        self,
        seconds: float,
        part: Data,
        observations: Sequence[Observation],
    ) -> tuple[float, str]:
        """Products with the normal equations: as many as over the whole first scan with few
        detectors, at what one takes in the slice, for each sample and for the map.
        """
        few, many = samples_in(part.observations), samples_in(observations)
        number = self._work(self.whole or part).products
        here = self._work(part)
        each = here.seconds / max(here.products * few, 1)
        of_map = max(seconds - here.seconds, 0.0) / max(here.products, 1)
        return (
            number * (each * many + of_map),
            f"about {number} products with the normal equations for"
            f" {self._solutions(part.observations[0])} solutions, as over the whole first scan with"
            f" few detectors, at {1e9 * each:.2g} ns a sample; more where scans overlap less",
        )

    def _work(self, part: Data) -> Work:
        """Work of all solutions in a run, of all bands."""
        records = [p for p in part.products.values() if isinstance(p, NoiseRecord)]
        own = {id(one.work): one.work for one in records if one.label == self.operator.label}
        works = own.values()  # one of all bands that share modes
        return Work(sum(one.products for one in works), sum(one.seconds for one in works))

    @property
    def brief(self) -> MaximumLikelihoodMap:
        """Few iterations, without patterns; runs are found anew where those of the run are."""
        few = {"tolerance": max(self.operator.tolerance, BRIEF), "patterns": 0}
        return self.operator.model_copy(update=few)

    def counted(self, observations: Sequence[Observation]) -> MaximumLikelihoodMap:
        """The step with all iterations, on pixels so large that there are few."""
        step = self.operator
        layout = MapLayout(step)
        pixels = layout.grid(layout.place(observations, {})).n_pixels
        larger = max(1, math.ceil(math.sqrt(pixels / MOST_COUNTED)))
        pixel = step.pixel * larger
        if step.projection == "CAR":
            pixel = math.pi / max(round(math.pi / pixel), 1)
        grid: dict[str, Any] = {"pixel": pixel}
        if step.nside:
            grid = {"nside": max(step.nside >> (larger - 1).bit_length(), 1)}
        made = step.model_copy(update=grid)
        made._keeps = Keeps.MEMORY
        return made

    def _solutions(self, observation: Observation) -> int:
        """Solutions over all samples; two halves are one."""
        step = self.operator
        signals = len({*observation.signals} - observation.unfiltered)
        return self._estimates + signals * (1 + bool(step.half_difference))

    @property
    def _estimates(self) -> int:
        """Solutions for the noise: the map, and that of a draw."""
        return self.operator.refined * (1 + (self.operator.noise == "estimated"))

    def sweeps(self, observation: Observation) -> int:
        """One reading finds runs and baselines."""
        return 1
