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
from typing import Any, ClassVar, cast

import numpy as np
from numpy.typing import NDArray
from pydantic import PrivateAttr

from zonda.core.data import Block, Data, Observation
from zonda.core.errors import PipelineError
from zonda.core.numerics.tiles import TILE_SAMPLES

from .angle_checks import check_polarized, warn_before
from .coverage import COUNTS, Coverage, Directions
from .grid import Grid, TangentGrid
from .halves import halves_of
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
        """Pointing, weights and empty sums for one observation."""
        return prepared(self, observation, self._layout["variance"], self._spare)

    def exec(self, block: Block, state: Prepared) -> None:
        """Add one block to this thread's sums."""
        add_bands(self, [block], [state])

    def exec_bands(self, blocks: Sequence[Block], states: Sequence[Prepared]) -> None:
        """Add the blocks of several bands, each to its own sums; what is the same is found once."""
        add_bands(self, blocks, states)

    def collect(self, data: Data, observation: Observation, state: Prepared) -> None:
        """Add this observation to the even or the odd scans' sums."""
        add_scan(self, data, observation, state)

    def finalize(self, data: Data) -> None:
        """Turn the sums into one `MapProduct` for each signal, under the name `product`."""
        self._spare.clear()
        sums: MapSums | None = data.take(self.label)
        if sums is not None:
            MapFromSums(self, self.grid, self._layout, sums).finish(data)


@dataclass
class Prepared:
    """An observation's pointing, weights and sums.

    ``looking``: in which pixels its detectors look. ``binnings``: of each half (`halves_of`), one
    for all signals or one for each with noise of its own. ``directions``: where the map tells how
    scans cross. ``reference``: unit of the variance, K^2.
    """

    looking: Looking
    binnings: list[Binning] | list[StokesBinning]
    directions: Directions | None
    reference: float


def prepared(
    step: BinMap, observation: Observation, reference: float, spare: list[Sums]
) -> Prepared:
    """State of `BinMap.prepare`. ``reference``: unit of the variance, K^2; ``spare``: see
    `Binning`.

    Raises PipelineError where noise is wanted from the scatter of samples that a window has
    changed.
    """
    weight, noise = weights_of(step, observation, reference)
    window = observation.window if step.contents == "all" else None
    if window is not None and step.noise == "scatter":
        text = (
            "noise: scatter needs samples that no window has changed;"
            f" {' and '.join(observation.windows)} did"
        )
        raise PipelineError(text, place=step.label, cure="leave out noise: scatter, or the window")
    seen = observation.good_samples
    if window is None:
        window = np.zeros(0)
    else:
        seen &= (heavy := window >= LIGHTEST)
        observation.tally.count(step.label, LIGHT, int((~heavy).sum()), heavy.size)
    if "white" not in observation.components and step.noise == "net" and step.contents == "all":
        observation.tally.state(step.label, "noise of a pixel", NO_WHITE)
    if step.stokes == "IQU":
        check_polarized(observation, step.label)
    looking = Looking.of(observation, step.grid)
    how = step, looking, (weight, noise, window), seen, spare
    made: list[Any] = stokes_binnings(*how) if step.stokes == "IQU" else binnings(*how)
    directions = Directions.of(looking, seen) if step.crosslinking else None
    return Prepared(looking, made, directions, reference)


def binnings(
    step: BinMap,
    looking: Looking,
    levels: tuple[Any, Any, Any],
    seen: NDArray[np.bool_],
    spare: list[Sums],
) -> list[Binning]:
    """Binnings of each half (`halves_of`), one for all signals or one for each; arguments as of
    `stokes_binnings`.
    """
    observation, (weight, noise, window) = looking.observation, levels
    alike = (
        step.noise == "net"
        and not window.size
        and bool((weight == weight[0]).all() and (noise == noise[0]).all())
    )
    signals = 1 if step.contents == "hits" else len(observation.signals)
    others, count = (0, signals) if step.noise == "scatter" else (signals - 1, 1)
    return [
        Binning(
            step.grid,
            looking.pointing,
            use,
            (seen & samples).astype(np.uint8),
            window,
            weight,
            noise,
            alike,
            others,
            spare,
        )
        for use, samples in halves_of(step.split, observation)
        for _ in range(count)
    ]


def weights_of(step: BinMap, observation: Observation, reference: float) -> tuple[Any, Any]:
    """(w, w^2 times the variance of one sample) of each detector, in units of the variance
    ``reference`` [K^2].

    Raises PipelineError where they differ by too much, or are not known.
    """
    usable, net = observation.good_detectors, observation.focalplane.net.copy()
    if not usable.any():
        return np.ones(len(net)), np.ones(len(net))
    net[~usable] = net[usable][0]  # they weigh nothing, whatever their noise
    variance = net**2 * observation.sample_rate / reference
    weight = np.ones(len(net))
    if step.weights == "inverse_variance" and step.contents == "all":
        if (net > 0).all():
            weight = 1 / variance
        elif (net != net[0]).any():
            bad = observation.focalplane.names[int(np.flatnonzero(net <= 0)[0])]
            raise PipelineError(
                f"detector {bad} has NET 0, which has no inverse variance",
                place=step.label,
                cure="set weights: uniform",
            )
    weight = np.rint(weight * WEIGHT) / WEIGHT  # so that the sums of w d and of w use the same w
    if weight.max(initial=0.0) > 2.0**20 or weight.min(initial=1.0) < 2.0**-20:
        spread = net.max() > 1000 * net.min()
        much = "the detectors' NETs differ by more than a factor of 1000"
        far = "the NET is more than 1000 times larger or smaller than that of the first scan"
        raise PipelineError(much if spread else far, place=step.label, cure="set weights: uniform")
    return weight, weight**2 * variance


def add_bands(step: BinMap, blocks: Sequence[Block], states: Sequence[Prepared]) -> None:
    """See `BinMap.exec_bands`."""
    every = [signals_of(step, *one) for one in zip(blocks, states, strict=True)]
    parts, cells = list(zip(every, blocks, states, strict=True)), Cells()
    for signals, block, state in parts:
        if state.directions is not None:
            state.directions.add(signals, block, cells)
    if step.stokes == "IQU":
        add_blocks(
            [Part(cast(Any, s.binnings), signals, block) for signals, block, s in parts], cells
        )
        return
    alike: dict[Hashable, list[tuple[Any, Block, Prepared]]] = {}
    for number, part in enumerate(parts):
        looking = part[2].looking
        image = looking.key is None or isinstance(looking.grid, TangentGrid)
        alike.setdefault(number if image else looking.key, []).append(part)
    for together in alike.values():
        add_together(step, together)


def signals_of(step: BinMap, block: Block, state: Prepared) -> tuple[Any, ...]:
    """Signals of a block, (n_det, n) each; zeros where only the hits are wanted."""
    if step.contents == "hits":
        nothing = block.buffer("nothing", block.shape)
        nothing.fill(0)
        return (nothing,)
    window, unfiltered = state.binnings[0].window[block.samples], block.observation.unfiltered
    whole = any(name in block.means for name in block.signals) or (window.size and unfiltered)
    signals = [block.total(name) if whole else block.detdata[name] for name in block.signals]
    if window.size:  # no filter, no window, acted on these
        signals = [
            signal * window if name in unfiltered else signal
            for name, signal in zip(block.signals, signals, strict=True)
        ]
    return tuple(signals)


def halves(step: BinMap, state: list[Any]) -> list[Any]:
    """The binnings of either half; of scans, which are a half each, all together."""
    middle = len(state) // 2
    return [state] if step.split == "scans" else [state[:middle], state[middle:]]


def add_together(step: BinMap, parts: Sequence[tuple[Any, Block, Prepared]]) -> None:
    """Add the signals of blocks, of bands that look in the same pixels, to this thread's sums."""
    todo = []
    for signals, block, state in parts:
        for half in halves(step, list(state.binnings)):
            left = signals
            for binning in half:
                count = 1 + binning.n_others
                todo.append(
                    (tuple(left[:count]), binning, *_how(step, block, binning, state.reference))
                )
                left = left[count:]
    block, looking = parts[0][1], parts[0][2].looking
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


def _how(step: BinMap, block: Block, binning: Binning, reference: float) -> tuple[Any, ...]:
    """Samples of a block that count, their weights, and this thread's sums."""
    rows, samples = block.detectors, block.samples
    return (
        block.observation.good_detectors[rows] & binning.use[rows],
        binning.good[samples],
        binning.window[samples],
        binning.weight[rows],
        binning.noise[rows],
        step.noise == "scatter",
        1 / reference,
        *binning.of_thread(),
    )


def note_beams(step: BinMap, observation: Observation, sums: MapSums, binned: int) -> None:
    """Note the beams of an observation's detectors, with what they weigh in the map: ``binned``
    samples, as many of each.
    """
    good = observation.good_detectors
    if count := int(np.count_nonzero(good)):
        weight, _ = weights_of(step, observation, step._layout["variance"])
        sums.beams.add(observation.focalplane.fwhm[good], weight[good], -(-binned // count))


def add_scan(step: BinMap, data: Data, observation: Observation, state: Prepared) -> None:
    """Add a scan to the map's sums; what is dropped is counted. Raises PipelineError for samples
    that are too large.
    """
    if step.label not in data.partial:
        signals = () if step.contents == "hits" else observation.signals
        how = step.stokes == "IQU", step.noise == "scatter", step.split == "scans"
        made = MapSums(step.grid.n_pixels, signals, *how)
        counts = [name for name in COUNTS if getattr(step, name)]
        made.coverage = Coverage.empty(step.grid.n_pixels, counts, step.scan_hits)
        data.add(step.label, made)
    sums: Any = data.partial[step.label]
    before = sums.hits.sum(axis=0) if sums.coverage.of_hits else None
    binned, dropped = sums.add(observation, halves(step, list(state.binnings)), step.label)
    hits = None if before is None else sums.hits.sum(axis=0) - before
    sums.coverage.add(hits, state.directions, f"{step.label}, {observation.name}")
    note_beams(step, observation, sums, binned)
    used = observation.focalplane.net[observation.good_detectors]
    sums.unknown_variance |= step.weights == "inverse_variance" and not (used > 0).all()
    every, tally = observation.n_detectors * observation.n_samples, observation.tally
    tally.count(step.label, "samples binned", binned, every)
    for what, number in (
        ("outside the map", OUTSIDE),
        ("flagged", FLAGGED),
        ("not finite", NOT_FINITE),
    ):
        tally.count(step.label, f"samples dropped: {what}", int(dropped[number]), every)
    if dropped[TOO_LARGE]:
        raise PipelineError(
            f"{int(dropped[TOO_LARGE])} samples are too large for the map's fixed-point sums",
            place=f"{step.label}, {observation.name}",
            cure="look for the operator that makes them; a signal is below 1e4 K",
        )
