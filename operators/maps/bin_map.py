"""Averages samples into pixels.

    m_p = sum_i w_i d_i / sum_i w_i over the samples i in pixel p                                (1)

Where a `Taper` multiplied the signal by a window W, the samples weigh w W:

    m_p = sum_i w_i (W d)_i / sum_i w_i W_i,
    variance (sum_i w_i^2 W_i^2 sigma_i^2) / (sum_i w_i W_i)^2.  (2)

The sums are kept in fixed point (`sums`), so that they are exact; each sample is rounded to 2^-36 K
(1.5e-11 K).
"""

from __future__ import annotations

from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar, NamedTuple, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr

from zonda.core.data import Block, Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.numerics.chunks import TILE_SAMPLES

from .angle_checks import check_polarized, warn_before
from .coverage import COUNTS, Coverage, Directions
from .grid import Grid, TangentGrid
from .halves import Split, halves_of
from .map_from_sums import MapFromSums
from .map_layout import MapLayout
from .map_sums import MapSums
from .parameters import MapParameters
from .pixels import Cells, Looking
from .stokes_sums import Part, StokesBinning, add_blocks, stokes_binnings
from .sums import (
    FLAGGED,
    NOT_FINITE,
    OUTSIDE,
    TOO_LARGE,
    WEIGHT,
    Binning,
    Sums,
    add_image,
    add_list,
)

NO_WHITE = "what the detectors' NET would make; this scene has no white noise"
"""Said of the noise that the map of such a scene states."""

LIGHTEST = 0.1
"""Least window of a sample that is in a map. What steps behind the window added is divided by it,
and the noise does not know it: with transients, pixels that the ends of scans alone reach were up
to 100 times their noise without this limit."""

LIGHT = "instants that count as flagged: a window leaves less than a tenth of their weight"
"""A count of the log."""


class BinMap(MapParameters):
    """Weighted mean of the samples in each pixel, equation (1), as a FITS image or a HEALPix map;
    or I, Q and U (`stokes`).
    """

    provides: ClassVar[frozenset[str]] = frozenset({"map"})
    knows_means: ClassVar[bool] = True
    all_bands: ClassVar[bool] = True

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
        if self.stokes == "IQU":
            check_polarized(data.observations[0], self.label)
            warn_before(data.observations, self.frame, self.condition_limit, self.label)
        if self.nside is None:
            MapLayout(self).check_size(data.observations)
        return [] if self.width is None else [MapLayout(self).outside(data.observations)]

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
        levels, seen = self._levels(observation)
        if self.stokes == "IQU":
            check_polarized(observation, self.label)
        looking = Looking.of(observation, self.grid)
        hits, scatter = self.contents == "hits", self.noise == "scatter"
        signals = 1 if hits else len(observation.signals)
        how = self.split, looking, levels, seen, self._spare
        made: list[Any] = (
            stokes_binnings(*how)
            if self.stokes == "IQU"
            else binnings(*how, signals=signals, scatter=scatter)
        )
        directions = Directions.of(looking, seen) if self.crosslinking else None
        reference = self._layout["variance"]
        return Prepared(looking, made, directions, reference, self.split != "scans", hits, scatter)

    def exec(self, block: Block, state: Prepared) -> None:
        """Add one block to this thread's sums."""
        self.exec_bands([block], [state])

    def exec_bands(self, blocks: Sequence[Block], states: Sequence[Prepared]) -> None:
        """Add the blocks of several bands, each to its own sums; what is the same is found once."""
        parts = [Blocks(s.signals(b), b, s) for b, s in zip(blocks, states, strict=True)]
        cells = Cells()
        for signals, block, state in parts:
            if state.directions is not None:
                state.directions.add(signals, block, cells)
        if self.stokes == "IQU":
            add_blocks(
                [Part(cast(Any, s.binnings), signals, block) for signals, block, s in parts], cells
            )
            return
        for together in alike(parts):
            add_together(together)

    def collect(self, data: Data, observation: Observation, state: Prepared) -> None:
        """Add this observation to the even or the odd scans' sums; what is dropped is counted.

        Raises PipelineError for samples that are too large.
        """
        if self.label not in data.partial:
            signals = () if self.contents == "hits" else observation.signals
            how = self.stokes == "IQU", self.noise == "scatter", self.split == "scans"
            made = MapSums(self.grid.n_pixels, signals, *how)
            counts = [name for name in COUNTS if getattr(self, name)]
            made.coverage = Coverage.empty(self.grid.n_pixels, counts, self.scan_hits)
            data.add(self.label, made)
        sums: Any = data.partial[self.label]
        before = sums.hits.sum(axis=0) if sums.coverage.of_hits else None
        binned, dropped = sums.add(observation, state.halves, self.label)
        hits = None if before is None else sums.hits.sum(axis=0) - before
        sums.coverage.add(hits, state.directions, f"{self.label}, {observation.name}")
        self._note_beams(observation, sums, binned)
        used = observation.focalplane.net[observation.good_detectors]
        sums.unknown_variance |= self.weights == "inverse_variance" and not (used > 0).all()
        every, tally = observation.n_detectors * observation.n_samples, observation.tally
        tally.count(self.label, "samples binned", binned, every)
        for what, number in (
            ("outside the map", OUTSIDE),
            ("flagged", FLAGGED),
            ("not finite", NOT_FINITE),
        ):
            tally.count(self.label, f"samples dropped: {what}", int(dropped[number]), every)
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

    def _levels(self, observation: Observation) -> tuple[tuple[Any, Any, Any], NDArray[np.bool_]]:
        """((weight, noise of each detector, window), samples that count (n_samp,))."""
        weight, noise = self._weights(observation)
        window = observation.window if self.contents == "all" else None
        if window is not None and self.noise == "scatter":
            text = (
                "noise: scatter needs samples that no window has changed;"
                f" {' and '.join(observation.windows)} did"
            )
            raise PipelineError(
                text, place=self.label, cure="leave out noise: scatter, or the window"
            )
        seen = observation.good_samples
        if window is None:
            window = np.zeros(0)
        else:
            seen &= (heavy := window >= LIGHTEST)
            observation.tally.count(self.label, LIGHT, int((~heavy).sum()), heavy.size)
        if "white" not in observation.components and self.noise == "net" and self.contents == "all":
            observation.tally.state(self.label, "noise of a pixel", NO_WHITE)
        return (weight, noise, window), seen

    def _weights(self, observation: Observation) -> tuple[Any, Any]:
        """Weight and noise of each detector (`detector_weights`)."""
        inverse = self.weights == "inverse_variance" and self.contents == "all"
        return detector_weights(observation, self._layout["variance"], inverse, self.label)

    def _note_beams(self, observation: Observation, sums: MapSums, binned: int) -> None:
        """Note the beams of an observation's detectors, with what they weigh in the map: ``binned``
        samples, as many of each.
        """
        good = observation.good_detectors
        if count := int(np.count_nonzero(good)):
            weight, _ = self._weights(observation)
            sums.beams.add(observation.focalplane.fwhm[good], weight[good], -(-binned // count))


@dataclass
class Prepared:
    """An observation's pointing, weights and sums.

    ``looking``: the detectors' pixels. ``binnings``: of each half (`halves_of`), one for all
    signals or one for each with noise of its own. ``directions``: those of the scans, where the map
    tells how they cross. ``reference``: unit of the variance, K^2. ``apart``: the halves are of
    samples, not of scans; ``hits``: only hits are wanted; ``scatter``: noise is that of the
    samples' scatter.
    """

    looking: Looking
    binnings: list[Binning] | list[StokesBinning]
    directions: Directions | None
    reference: float
    apart: bool
    hits: bool
    scatter: bool

    def signals(self, block: Block) -> tuple[Any, ...]:
        """Signals of a block, (n_det, n) each; zeros where only the hits are wanted."""
        if self.hits:
            nothing = block.buffer("nothing", block.shape)
            nothing.fill(0)
            return (nothing,)
        window, unfiltered = self.binnings[0].window[block.samples], block.observation.unfiltered
        whole = any(name in block.means for name in block.signals) or (window.size and unfiltered)
        signals = [block.total(name) if whole else block.detdata[name] for name in block.signals]
        if window.size:  # no filter, no window, acted on these
            signals = [
                signal * window if name in unfiltered else signal
                for name, signal in zip(block.signals, signals, strict=True)
            ]
        return tuple(signals)

    @property
    def halves(self) -> list[list[Any]]:
        """The binnings of either half; of scans, which are a half each, all together."""
        middle = len(self.binnings) // 2
        every: list[Any] = list(self.binnings)
        return [every[:middle], every[middle:]] if self.apart else [every]

    def counted(self, block: Block, binning: Binning) -> tuple[Any, ...]:
        """Samples of a block that count, their weights, and this thread's sums."""
        rows, samples = block.detectors, block.samples
        return (
            block.observation.good_detectors[rows] & binning.use[rows],
            binning.good[samples],
            binning.window[samples],
            binning.weight[rows],
            binning.noise[rows],
            self.scatter,
            1 / self.reference,
            *binning.of_thread(),
        )


class Blocks(NamedTuple):
    """A block of one band: its signals (n_det, n), and the state of its observation."""

    signals: tuple[Any, ...]
    block: Block
    state: Prepared


def alike(parts: Sequence[Blocks]) -> list[list[Blocks]]:
    """The blocks of bands that look in the same pixels, together."""
    found: dict[Hashable, list[Blocks]] = {}
    for number, part in enumerate(parts):
        looking = part.state.looking
        image = looking.key is None or isinstance(looking.grid, TangentGrid)
        found.setdefault(number if image else looking.key, []).append(part)
    return list(found.values())


def add_together(parts: Sequence[Blocks]) -> None:
    """Add the signals of blocks, of bands that look in the same pixels, to this thread's sums."""
    todo = []
    for signals, block, state in parts:
        for half in state.halves:
            left = signals
            for binning in half:
                count = 1 + binning.n_others
                todo.append((tuple(left[:count]), binning, *state.counted(block, binning)))
                left = left[count:]
    block, looking = parts[0].block, parts[0].state.looking
    begin, end, rows = block.samples.start, block.samples.stop, block.detectors
    if isinstance(looking.grid, TangentGrid):
        plane = block.observation.focalplane
        for signals, binning, *how in todo:
            add_image(
                signals,
                binning.pointing,
                begin,
                plane.xi[rows],
                plane.eta[rows],
                *looking.grid.shape,
                *how,
            )
        return
    which = np.arange(rows.start, rows.stop)
    for start in range(begin, end, TILE_SAMPLES):
        stop, index = min(start + TILE_SAMPLES, end), None
        for signals, binning, *how in todo:
            if binning.good[start:stop].any():
                index = looking.pixels(which, start, stop) if index is None else index
                add_list(signals, start - begin, index, *how)
            else:
                how[-2][FLAGGED] += (stop - start) * which.size


def detector_weights(
    observation: Observation, reference: float, inverse: bool, place: str
) -> tuple[Any, Any]:
    """(w, w^2 times the variance of one sample) of each detector, in units of the variance
    ``reference`` [K^2]; ``inverse``: w is the inverse variance, else 1.

    Raises PipelineError where they differ by too much, or are not known.
    """
    usable, net = observation.good_detectors, observation.focalplane.net.copy()
    if not usable.any():
        return np.ones(len(net)), np.ones(len(net))
    net[~usable] = net[usable][0]  # they weigh nothing, whatever their noise
    variance = net**2 * observation.sample_rate / reference
    weight = np.ones(len(net))
    if inverse:
        if (net > 0).all():
            weight = 1 / variance
        elif (net != net[0]).any():
            bad = observation.focalplane.names[int(np.flatnonzero(net <= 0)[0])]
            raise PipelineError(
                f"detector {bad} has NET 0, which has no inverse variance",
                place=place,
                cure="set weights: uniform",
            )
    weight = np.rint(weight * WEIGHT) / WEIGHT  # so that the sums of w d and of w use the same w
    if weight.max(initial=0.0) > 2.0**20 or weight.min(initial=1.0) < 2.0**-20:
        spread = net.max() > 1000 * net.min()
        much = "the detectors' NETs differ by more than a factor of 1000"
        far = "the NET is more than 1000 times larger or smaller than that of the first scan"
        raise PipelineError(much if spread else far, place=place, cure="set weights: uniform")
    return weight, weight**2 * variance


def binnings(
    split: Split,
    looking: Looking,
    levels: tuple[Any, Any, Any],
    good: NDArray[np.bool_],
    spare: list[Sums],
    *,
    signals: int,
    scatter: bool,
) -> list[Binning]:
    """Empty sums for one observation, for each half of its samples: one for all ``signals``, or one
    for each if their noise is that of their ``scatter``. Arguments as of `stokes_binnings`.
    """
    observation, (weight, noise, window) = looking.observation, levels
    alike = (
        not scatter
        and not window.size
        and bool((weight == weight[0]).all() and (noise == noise[0]).all())
    )
    others, count = (0, signals) if scatter else (signals - 1, 1)
    return [
        Binning(
            looking.grid,
            looking.pointing,
            use,
            (good & samples).astype(np.uint8),
            window,
            weight,
            noise,
            alike,
            others,
            spare,
        )
        for use, samples in halves_of(split, observation)
        for _ in range(count)
    ]
