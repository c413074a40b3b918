"""Averages samples into pixels: a weighted mean of I, or the best fitting I, Q and U (equations (1)
and (2) of `binning`).

Where a `Taper` multiplied the signal by a window W, the samples of a map of I weigh w W:

    m_p = sum_i w_i (W d)_i / sum_i w_i W_i,
    variance (sum_i w_i^2 W_i^2 sigma_i^2) / (sum_i w_i W_i)^2.  (1)

The sums are kept in fixed point, so that they are exact; each sample is rounded to 2^-36 K
(1.5e-11 K).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr

from zonda.core.data import Block, Data, Observation, percent
from zonda.core.errors import PipelineError
from zonda.core.types import Floats

from .angle_checks import check_polarized, warn_before
from .binning import BandBlock, Binning, Weights, add_blocks, binnings, weights_of
from .coverage import COUNTS, Coverage, Directions
from .grid import Cells, Grid, Looking
from .intensity_kernel import FLAGGED, NOT_FINITE, OUTSIDE, TOO_LARGE, Sums
from .map_from_sums import MapFromSums
from .map_layout import MapLayout
from .map_sums import MapSums
from .parameters import MapParameters

NO_WHITE = "what the detectors' NET would make; this scene has no white noise"
"""Said of the noise that the map of such a scene states."""

LIGHTEST = 0.1
"""Least window of a sample that is in a map. What steps behind the window added is divided by it,
and the noise does not know it: with transients, pixels that the ends of scans alone reach were up
to 100 times their noise without this limit."""

LIGHT = "instants that count as flagged: a window leaves less than a tenth of their weight"
"""A count of the log."""


class BinMap(MapParameters):
    """Weighted mean of the samples in each pixel, as a FITS image or a HEALPix map; or I, Q and U
    (`stokes`).
    """

    provides = frozenset({"map"})
    knows_means = True
    all_bands = True

    _layout: Mapping[str, Any] = PrivateAttr(default_factory=dict)
    _grid: Grid | None = PrivateAttr(None)
    _spare: list[Sums] = PrivateAttr(default_factory=list)

    @property
    def requires(self) -> frozenset[str]:
        """No signal if the hits alone are wanted."""
        return frozenset({"boresight"} if self.contents == "hits" else {"signal", "boresight"})

    @property
    def linear(self) -> bool:
        """The map is linear in the signal; noise from the samples' scatter is not."""
        return self.noise == "net"

    def check(self, data: Data) -> list[str]:
        """The share of the samples outside a map of a given width. `Data.layouts` has what kind of
        map there will be.
        """
        data.layouts[self.label] = {"product": self.product, "kind": self.kind}
        if not data.observations:
            return []
        MapLayout(self).warn_of_pixels(data.observations)
        if self.stokes == "IQU":
            check_polarized(data.observations[0], self.label)
            warn_before(data.observations, self.frame, self.condition_limit, self.label)
        if self.nside is not None:
            return []
        outside = MapLayout(self).outside(data.observations)
        text = f"samples outside the map: about {percent(outside, 2)}"
        return [] if self.width is None else [text]

    def observe(self, data: Data) -> None:
        """Lay out one grid for all observations."""
        layout = data.layouts.get(self.label)
        if not data.laid_out:
            layout = MapLayout(self).common(data.observations, layout)
        if layout is not None:
            data.layouts[self.label] = self._layout = layout
            self._grid = MapLayout(self).grid(layout)

    @property
    def grid(self) -> Grid:
        """The pixels, known once the telescope is pointed. Raises PipelineError before."""
        if self._grid is None:
            raise PipelineError(
                "no grid: observe() was not called", place=self.label, cure="run it in a Pipeline"
            )
        return self._grid

    def prepare(self, observation: Observation) -> Prepared:
        """Pointing, weights and empty sums for one observation.

        Raises PipelineError where noise is wanted from the scatter of samples that a window has
        changed.
        """
        weights, seen = self._weights(observation)
        polarized, hits = self.stokes == "IQU", self.contents == "hits"
        if polarized:
            check_polarized(observation, self.label)
        looking = Looking.of(observation, self.grid)
        made = binnings(
            self.split,
            looking,
            weights,
            seen,
            self._spare,
            signals=1 if hits else len(observation.signals),
            polarized=polarized,
            scatter=1 / self._layout["variance"] if self.noise == "scatter" else 0.0,
        )
        directions = Directions.of(looking, seen) if self.crosslinking else None
        return Prepared(made, directions, hits)

    def exec(self, block: Block, state: Prepared) -> None:
        """Add one block to this thread's sums."""
        self.exec_bands([block], [state])

    def exec_bands(self, blocks: Sequence[Block], states: Sequence[Prepared]) -> None:
        """Add the blocks of several bands, each to its own sums; what is the same is found once."""
        bands = [BandBlock(s.signals(b), b, s.halves) for b, s in zip(blocks, states, strict=True)]
        cells = Cells()
        for band, state in zip(bands, states, strict=True):
            if state.directions is not None:
                state.directions.add(band.signals, band.block, cells)
        add_blocks(bands, cells)

    def collect(self, data: Data, observation: Observation, state: Prepared) -> None:
        """Add this observation to the even or the odd scans' sums; what is dropped is counted.

        Raises PipelineError for samples that are too large.
        """
        if self.label not in data.partial:
            signals = () if self.contents == "hits" else observation.signals
            made = MapSums(
                self.grid.n_pixels,
                signals,
                polarized=self.stokes == "IQU",
                scatter=self.noise == "scatter",
                of_scans=self.split == "scans",
            )
            counts = [name for name in COUNTS if getattr(self, name)]
            made.coverage = Coverage.empty(self.grid.n_pixels, counts, self.scan_hits)
            data.add(self.label, made)
        sums: Any = data.partial[self.label]
        before = sums.hits.sum(axis=0) if sums.coverage.of_hits else None
        binned, dropped = sums.add(observation, state.halves, self.label)
        hits = None if before is None else sums.hits.sum(axis=0) - before
        sums.coverage.add(hits, state.directions, f"{self.label}, {observation.name}")
        self._note_beams(observation, sums, state.weights.detector, binned)
        used = observation.focalplane.net[observation.good_detectors]
        sums.unknown_variance |= self.weights == "inverse_variance" and not (used > 0).all()
        every, log = observation.n_detectors * observation.n_samples, observation.log
        log.count(self.label, "samples binned", binned, every)
        for what, number in (
            ("outside the map", OUTSIDE),
            ("flagged", FLAGGED),
            ("not finite", NOT_FINITE),
        ):
            log.count(self.label, f"samples dropped: {what}", int(dropped[number]), every)
        if dropped[TOO_LARGE]:
            raise PipelineError(
                f"{int(dropped[TOO_LARGE])} samples are too large for the map's fixed-point sums",
                place=f"{self.label}, {observation.name}",
                cure="look for the operator that makes them; a signal is below 1e4 K",
            )

    def finalize(self, data: Data) -> None:
        """Turn the sums into one `MapProduct` for each signal, under the name `product`."""
        self._spare.clear()
        sums: MapSums | None = data.take(self.label)
        if sums is not None:
            MapFromSums(self, self.grid, self._layout, sums).finish(data)

    def _weights(self, observation: Observation) -> tuple[Weights, NDArray[np.bool_]]:
        """Weights of the samples, and which of these count (n_samp,)."""
        everything = self.contents == "all"
        window = observation.window if everything else None
        if window is not None and self.noise == "scatter":
            text = (
                "noise: scatter needs samples that no window has changed;"
                f" {' and '.join(observation.windows)} did"
            )
            raise PipelineError(
                text, place=self.label, cure="leave out noise: scatter, or the window"
            )
        inverse = self.weights == "inverse_variance" and everything
        weights = weights_of(
            observation, self._layout["variance"], inverse, window, place=self.label
        )
        seen = observation.good_samples
        if window is not None:
            seen &= (heavy := window >= LIGHTEST)
            observation.log.count(self.label, LIGHT, int((~heavy).sum()), heavy.size)
        if "white" not in observation.components and self.noise == "net" and everything:
            observation.log.state(self.label, "noise of a pixel", NO_WHITE)
        return weights, seen

    def _note_beams(
        self,
        observation: Observation,
        sums: MapSums,
        weight: Floats,
        binned: int,
    ) -> None:
        """Note the beams of an observation's detectors, with what they weigh in the map: ``binned``
        samples, as many of each.
        """
        good = observation.good_detectors
        if count := int(np.count_nonzero(good)):
            sums.beams.add(observation.focalplane.fwhm[good], weight[good], -(-binned // count))


@dataclass
class Prepared:
    """An observation's binnings: of each half of its samples (`binnings`), or of all where the
    halves are of scans.

    ``directions``: those of the scans, where the map tells how they cross. ``hits``: only hits are
    wanted.
    """

    halves: list[list[Binning]]
    directions: Directions | None
    hits: bool

    @property
    def weights(self) -> Weights:
        """Weights of the samples."""
        return self.halves[0][0].weights

    def signals(self, block: Block) -> tuple[Any, ...]:
        """Signals of a block, (n_det, n) each; zeros where only the hits are wanted."""
        if self.hits:
            nothing = block.buffer("nothing", block.shape)
            nothing.fill(0)
            return (nothing,)
        window, unfiltered = self.weights.window[block.samples], block.observation.unfiltered
        whole = any(name in block.means for name in block.signals) or (window.size and unfiltered)
        signals = [block.total(name) if whole else block.detdata[name] for name in block.signals]
        if window.size:  # no filter, no window, acted on these
            signals = [
                signal * window if name in unfiltered else signal
                for name, signal in zip(block.signals, signals, strict=True)
            ]
        return tuple(signals)
