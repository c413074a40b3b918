"""The schedule of one observation: its segments, what becomes of the streams between them, and the
blocks that are cut.

It is made once for an observation, without running or allocating anything, and then followed; the
forecast of a run is the schedule that would be followed with its budget.
"""

from __future__ import annotations

import tempfile
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ..errors import PipelineError
from ..mapmaker import MapMaker, filters, forms, makes_products
from ..numerics.chunks import TILE_DETECTORS
from ..observation import Observation
from ..operator import Operator
from ..plan.planning import planning_of
from ..signal import MAIN, Formed
from .means import knows_means, may_have_means, names_of
from .segments import PIECE, Segment, block_share, blocks, cut, least_block, whole_span
from .settings import Held, Settings
from .streams import Source, Stage, free_disk

SCRATCH_STREAMS = 2
"""Block-sized arrays assumed for operators' own scratch when the budget is divided."""

AMPLE = 3.0
"""Times the streams of all signals: with so much memory unfiltered ones are held across the
filters, not made again.
"""

AMPLE_BLOCK = 128 << 20
"""Bytes of a block's arrays on one thread beyond which larger ones gain nothing."""

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
class Planned:
    """A segment as it will be carried out.

    Attributes
    ----------
    stage
        Names and sizes; its streams are empty.
    how, why
        What becomes of the streams that it makes new.
    held
        Bytes of streams that are held beside it.
    """

    stage: Stage
    how: Held = "kept"
    why: str = ""
    held: int = 0

    @property
    def segment(self) -> Segment:
        """The segment's steps."""
        return self.stage.segment

    @property
    def wanted(self) -> frozenset[str]:
        """Names of the streams that it passes on."""
        return self.stage.wanted


@dataclass
class Schedule:
    """Work on one observation, and the memory that it takes.

    Attributes
    ----------
    planned
        The segments in order.
    made_again
        Signals that are passed to map makers as they were formed, made again from their components
        where they are mapped.
    bytes, least
        Bytes that streams and blocks take at once; the least budget that would do.
    elsewhere
        Streams that are kept nowhere or on disk, in words.
    again
        How many times more the operators, by label, act whose streams are made again when they are
        read.
    """

    chain: Chain
    observation: Observation
    settings: Settings
    planned: list[Planned] = field(default_factory=list)
    made_again: tuple[Formed, ...] = ()
    bytes: int = 0
    least: int = 0
    elsewhere: tuple[str, ...] = ()
    again: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.streams, self.means = (
            self.chain.read,
            self.chain.expanded(may_have_means(self.chain.steps)),
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(detectors, samples) of the observation."""
        return self.observation.n_detectors, self.observation.n_samples

    @property
    def stream_size(self) -> int:
        """Bytes of a whole stream."""
        return self.shape[0] * self.shape[1] * np.dtype(self.settings.dtype).itemsize

    def blocks(self, planned: Planned) -> list[tuple[slice, slice]]:
        """The blocks in which a segment works.

        Raises
        ------
        PipelineError
            Where the least one does not fit.
        """
        stage, held = planned.stage, planned.held
        rows, columns = least_block(stage.span, self.shape)
        share = self._share(stage, held)
        if rows * columns > share:
            settings, need = self.settings, self._least_blocks(stage)
            raise PipelineError(
                f"one block of {rows} detectors needs {need / settings.threads / 1e6:.1f} MB on"
                f" each of {settings.threads} threads, the memory budget has"
                f" {(settings.memory - held) / 1e6:.1f} MB for all of them",
                place=self.observation.name,
                cure=(
                    f"raise --memory to {self._ceiling_for(need + held)}, use fewer --threads, or"
                    " make the scan shorter"
                ),
            )
        return list(blocks(stage.span, stage.in_time_order, self.shape, share))

    # ---- made once

    def make(self, ordered: Collection[str] = (), halos: Mapping[str, int] | None = None) -> None:
        """Walk through the segments.

        ``ordered`` and ``halos``: of the other bands that are executed together with this one, see
        `segments.cut`.
        """
        steps = self.chain.steps
        every = {*ordered, *ordered_in(steps, self.observation)}
        segments = cut(steps, self.observation, every, halos or {})
        self.made_again = self._made_again(segments)
        apart = {s.stream for s in self.made_again}
        source, held, elsewhere, again = Source(), 0, list[str](), dict[str, int]()
        for number, segment in enumerate(segments):
            later = segments[number + 1 :]
            wanted = frozenset(self.chain.keep).union(
                *(o.requires | o.optional for s in later for o in s.operators)
            )
            made = source.names.union(*(self.chain.expanded(o.provides) for o in segment.operators))
            stage = Stage(
                segment, source, made & self.chain.expanded(wanted) & self.streams - apart
            )
            new = (
                stage.wanted
                if segment.halo
                else stage.wanted - (frozenset() if source.stage else source.names)
            )
            size, how, why = len(new) * self.stream_size, "kept", ""
            planned = Planned(stage)
            if later and new and not self._keeps(stage, size, held, later):
                how, why = self._where(stage, sorted(new), size, held, later)
                elsewhere += [
                    f"{name} {'spilled to disk' if how == 'spilled' else 'made again'}"
                    for name in sorted(new)
                ]
            planned.how, planned.why = how, why  # type: ignore[assignment]
            self.planned.append(planned)
            if how == "again":
                times = self._readings(later)
                again.update(
                    {
                        o.label: max(times, again.get(o.label, 0))
                        for o in segment.operators
                        if not makes_products(o)
                    }
                )
                source = Source({}, stage, stage.wanted)
                continue
            size = 0 if how == "spilled" else size
            planned.held = held + (size if later else 0)
            smallest = self._least_blocks(stage)
            largest = max(self._largest_blocks(stage, planned.held), smallest)
            self.bytes, self.least = (
                max(self.bytes, held + size + largest),
                max(self.least, smallest),
            )
            held = planned.held
            source = Source(names=stage.wanted)
        self.elsewhere, self.again = tuple(elsewhere), again

    def _made_again(self, segments: Sequence[Segment]) -> tuple[Formed, ...]:
        """Unfiltered signals, where streams are held on the way to the maps and memory is not ample
        for all of them, and blocks need neither a span nor neighbours."""
        unfiltered = tuple(
            s for s in self.chain.signals if not s.filtered and s.stream not in self.chain.keep
        )
        if (
            not unfiltered
            or AMPLE * len(self.chain.signals) * self.stream_size <= self.settings.memory
        ):
            return ()
        before = [k for k, s in enumerate(segments) if any(forms(o) for o in s.operators)]
        mapped = [
            k for k, s in enumerate(segments) if any(isinstance(o, MapMaker) for o in s.operators)
        ]
        needed = self.chain.needed_for(unfiltered, filtered=False)
        bound = any(o.couples != "sample" or o.halo(self.observation) for o in needed)
        return unfiltered if before and mapped and min(mapped) > before[0] and not bound else ()

    def _keeps(self, stage: Stage, size: int, held: int, later: list[Segment]) -> bool:
        """Tell whether ``size`` bytes of streams beside those held stay in memory: in half of it,
        with room for blocks.
        """
        following = Stage(later[0], Source(names=stage.wanted), frozenset())
        least = max(self._least_blocks(stage), self._least_blocks(following))
        return held + size <= min(self.settings.memory // 2, self.settings.memory - least)

    def _where(
        self, stage: Stage, new: list[str], size: int, held: int, later: list[Segment]
    ) -> tuple[Held, str]:
        """Decide about streams that do not fit in memory beside ``held`` bytes, and say why.

        Raises
        ------
        PipelineError
            Where they can neither be made again nor fit on the disk.
        """
        following, disk = later[0], free_disk()
        head, span = following.operators[0], stage.span
        hindrance = ""
        if head.couples == "all" and not planning_of(head).sweeps(self.observation):
            hindrance = f"{head.label} reads it as a whole"
        elif {span, following.span} == {"time", "detectors"}:
            hindrance = f"{head.label} needs the other direction whole"
        if hindrance and size > disk:
            plural = "s" if len(new) > 1 else ""
            raise PipelineError(
                f"the stream{plural} {', '.join(new)} takes {size / 1e9:.3g} GB, which fit neither"
                f" in memory nor on the disk ({disk / 1e9:.3g} GB free in"
                f" {tempfile.gettempdir()}), and cannot be made again when it is read: {hindrance}",
                place=self.observation.name,
                cure=(
                    f"use --memory {self._ceiling_for(2 * (held + size))}, or point TMPDIR to a"
                    " larger disk, or split into shorter scans"
                ),
            )
        if not hindrance and stage.in_time_order and whole_span(following.span, span) == "time":
            hindrance = "" if size > disk else f"made in order of time, {head.label} needs scans"
        return (
            ("spilled", f"{size / 1e9:.2f} GB: {hindrance}")
            if hindrance
            else ("again", f"{size / 1e9:.3g} GB; {head.label} reads it in blocks")
        )

    def _readings(self, later: Sequence[Segment]) -> int:
        """Number of readings, beyond one, of the streams that are passed on to the first of the
        segments to come.
        """
        heads = [s.operators[0] for s in later]
        swept = sum(planning_of(o).sweeps(self.observation) for o in heads if o.couples == "all")
        swept *= sum(s.filtered for s in self.chain.signals)
        return swept + round(2 * later[0].halo / PIECE + 0.4)

    # ---- sizes of blocks

    def _least_blocks(self, stage: Stage) -> int:
        """Bytes of the smallest blocks, on all threads."""
        rows, columns = least_block(stage.span, self.shape)
        return self._bytes(stage, rows * columns, min(rows, TILE_DETECTORS) * min(columns, PIECE))

    def _largest_blocks(self, stage: Stage, held: int) -> int:
        """Bytes of the blocks that would be cut beside ``held`` bytes of streams, on all
        threads.
        """
        share = max(self._share(stage, held), 1)
        first = next(iter(blocks(stage.span, stage.in_time_order, self.shape, share)))
        rows, columns = (s.stop - s.start for s in first)
        return self._bytes(stage, rows * columns, min(rows, TILE_DETECTORS) * min(columns, PIECE))

    def _share(self, stage: Stage, held: int) -> int:
        """Samples that a block may hold beside ``held`` bytes of streams: within half of the
        budget, or all that is left.
        """
        settings, (whole, part) = self.settings, self._streams_in_block(stage)
        rows, columns = least_block(stage.span, self.shape)
        each = settings.threads * np.dtype(settings.dtype).itemsize
        share = block_share(
            min(settings.memory // 2, settings.threads * AMPLE_BLOCK) // each, whole, part
        )
        return (
            share
            if share >= rows * columns
            else block_share((settings.memory - held) // each, whole, part)
        )

    def _bytes(self, stage: Stage, block: int, piece: int) -> int:
        whole, part = self._streams_in_block(stage)
        return (
            self.settings.threads
            * np.dtype(self.settings.dtype).itemsize
            * (whole * block + part * piece)
        )

    def _streams_in_block(self, stage: Stage | None) -> tuple[int, int]:
        """Numbers of block-sized and of piece-sized arrays that a stage and those before it
        hold.
        """
        if stage is None:
            return 0, 0
        first, rest = stage.segment.split()
        expanded = self.chain.expanded
        names = set(stage.source.names | stage.wanted).union(
            *(expanded(o.requires | o.optional | o.provides) for o in rest)
        )
        every = (
            names.union(*(expanded(o.requires | o.optional | o.provides) for o in first))
            if first
            else set()
        )
        before = self._streams_in_block(stage.source.stage)
        whole, part = len(names & self.streams), len(every & self.streams)
        scratch = SCRATCH_STREAMS if rest else 0
        margins = 2 if stage.segment.halo else 1  # a block with margins is trimmed to a copy
        whole, part = margins * whole + scratch, part + (SCRATCH_STREAMS if first else 0)
        return before[0] + whole + self._copies(rest), max(before[1], part + self._copies(first))

    def _copies(self, operators: Sequence[Operator]) -> int:
        """Arrays of the run's precision that whole streams and one mean take, float64, where a step
        does not know of means.
        """
        each = 8 // np.dtype(self.settings.dtype).itemsize
        paying = [
            o for o in operators if (o.requires | o.optional) & self.means and not knows_means(o)
        ]
        return (
            each
            * (1 + max(len(names_of(o, self.observation.signals) & self.streams) for o in paying))
            if paying
            else 0
        )

    def _ceiling_for(self, need: int) -> str:
        """``--memory`` with which streams and blocks may take ``need`` bytes."""
        settings = self.settings
        fixed = max(settings.process - settings.memory, 0) if settings.process else 0
        return f"{-(-(need + fixed) * 21 // 20_000_000)}MB"


def ordered_in(steps: Sequence[Operator], observation: Observation) -> list[str]:
    """Labels of the steps that are much cheaper in order of time."""
    return [o.label for o in steps if planning_of(o).in_time_order(observation)]


def schedule(chain: Chain, observation: Observation, settings: Settings) -> Schedule:
    """Make the schedule of an observation.

    Raises
    ------
    PipelineError
        Where a stream fits neither in memory nor on the disk and cannot be made again.
    """
    made = Schedule(chain, observation, settings)
    made.make()
    return made


def spares(chain: Chain, observation: Observation, settings: Settings, size: int) -> bool:
    """Tell whether streams and blocks do the same with ``size`` bytes less memory."""
    if settings.memory <= size:
        return False
    less = replace(settings, memory=settings.memory - size)
    try:
        with_all, with_less = (schedule(chain, observation, s) for s in (settings, less))
    except PipelineError:  # a stream would go to a disk that has no room for it
        return False
    same = with_less.elsewhere == with_all.elsewhere and with_less.made_again == with_all.made_again
    return same and with_less.least <= less.memory
