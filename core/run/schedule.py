"""The schedule of one scan: its segments, what becomes of the streams between them, and the
blocks that are cut.

It is made once for a scan, without running or allocating anything, and then followed; the forecast
of a run is the schedule that would be followed with its budget. A stream has the detectors of all
bands that are executed together, one band after the other; a block has those of one.
"""

from __future__ import annotations

import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from ..errors import PipelineError
from ..mapmaker import MapMaker, forms
from ..numerics.chunks import TILE_DETECTORS
from ..operator import Operator
from ..plan.planning import planning_of
from ..signal import Formed
from .means import knows_means, may_have_means, names_of
from .segments import PIECE, Segment, Source, block_share, blocks, cut, least_block
from .settings import Held, Settings, megabytes
from .streams import free_disk
from .views import View

SCRATCH_STREAMS = 2
"""Block-sized arrays assumed for operators' own scratch when the budget is divided."""

MAPPED = 32_000_000
"""Bytes of a spilled stream that are in memory at most: the system maps pages around those that are
touched, which are given back block by block.
"""

AMPLE = 3.0
"""Times the streams of all signals: with so much memory unfiltered ones are held across the
filters, not made again.
"""

AMPLE_BLOCK = 128 << 20
"""Bytes of a block's arrays on one thread beyond which larger ones gain nothing."""


@dataclass
class Schedule:
    """Work on one scan, and the memory that it takes.

    Attributes
    ----------
    segments
        In order.
    made_again
        Signals that are passed to map makers as they were formed, made again from their components
        where they are mapped.
    bytes, least
        Bytes that streams and blocks take at once; the least budget that would do.
    elsewhere
        Streams that are kept nowhere or on disk, in words.
    spilled
        Bytes of a sample, if one is on disk; else 0.
    mapped
        Bytes of pages of streams on disk that are in memory, beside ``bytes``.
    at_once
        Bands whose blocks are worked on together: all, if their detectors look through the same
        pixels and their smallest blocks fit in memory; else 1.
    """

    views: Sequence[View]
    settings: Settings
    segments: list[Segment] = field(default_factory=list)
    made_again: tuple[Formed, ...] = ()
    bytes: int = 0
    least: int = 0
    elsewhere: tuple[str, ...] = ()
    spilled: int = 0
    mapped: int = 0
    at_once: int = 1

    def __post_init__(self) -> None:
        self.chain, first = self.views[0].chain, self.views[0].observation
        self.streams = self.chain.read
        self.means = self.chain.expanded(may_have_means(self.chain.steps))
        if all(view.observation.looks_as(first) for view in self.views):
            self.at_once = len(self.views)

    @property
    def shape(self) -> tuple[int, int]:
        """(detectors, samples) of the band of most detectors."""
        return max(view.shape for view in self.views)

    @property
    def stream_size(self) -> int:
        """Bytes of a whole stream."""
        rows = sum(view.shape[0] for view in self.views)
        return rows * self.shape[1] * np.dtype(self.settings.dtype).itemsize

    def blocks(self, segment: Segment, view: View) -> list[tuple[slice, slice]]:
        """The blocks in which a segment works on a band.

        Raises
        ------
        PipelineError
            Where the least one does not fit.
        """
        rows, columns = least_block(segment.whole, self.shape)
        share = self._share(segment, segment.held)
        held = segment.held
        if rows * columns > share:
            settings = self.settings
            need = self._least_blocks(segment)
            raise PipelineError(
                f"one block of {rows} detectors needs {need / settings.threads / 1e6:.1f} MB on"
                f" each of {settings.threads} threads, the memory budget has"
                f" {(settings.memory - held) / 1e6:.1f} MB for all of them",
                place=view.observation.name,
                cure=(
                    f"raise --memory to {self._ceiling_for(need + held)}, use fewer --threads, or"
                    " make the scan shorter"
                ),
            )
        return list(blocks(segment.whole, segment.ordered, view.shape, share))

    # ---- made once

    def make(self) -> None:
        """Walk through the segments."""
        self.segments = segments = cut(self.views)
        self.made_again = self._made_again(segments)
        apart = {s.stream for s in self.made_again}
        source = Source()
        held = 0
        elsewhere = list[str]()
        for number, segment in enumerate(segments):
            later, segment.source = segments[number + 1 :], source
            wanted = frozenset(self.chain.keep).union(
                *(o.requires | o.optional for s in later for o in s.operators)
            )
            made = source.names.union(*(self.chain.expanded(o.provides) for o in segment.operators))
            segment.wanted = made & self.chain.expanded(wanted) & self.streams - apart
            copied = segment.halo or source.segment  # nothing is changed in place
            new = segment.wanted if copied else segment.wanted - source.names
            size = len(new) * self.stream_size
            if later and new and not self._keeps(segment, size, held, later):
                segment.how, segment.why = self._where(segment, sorted(new), size, held, later)
                what = "spilled to disk" if segment.how == "spilled" else "made again"
                elsewhere += [f"{name} {what}" for name in sorted(new)]
            if segment.how == "again":
                source = Source(segment=segment, names=segment.wanted)
                continue
            if segment.how == "spilled":
                self.spilled = np.dtype(self.settings.dtype).itemsize
                self.mapped = max(self.mapped, min(size, MAPPED))
            size = 0 if segment.how == "spilled" else size
            segment.held = held + (size if later else 0)
            smallest = self._least_blocks(segment)
            largest = max(self._largest_blocks(segment), smallest)
            self.bytes = max(self.bytes, held + size + largest)
            self.least = max(self.least, smallest)
            held = segment.held
            source = Source(names=segment.wanted)
        self.elsewhere = tuple(elsewhere)

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
        bound = any(o.couples != "sample" or o.halo(self.views[0].observation) for o in needed)
        return unfiltered if before and mapped and min(mapped) > before[0] and not bound else ()

    def _keeps(self, segment: Segment, size: int, held: int, later: list[Segment]) -> bool:
        """Tell whether ``size`` bytes of streams beside those held stay in memory: in half of it,
        with room for blocks.
        """
        later[0].source = Source(names=segment.wanted)
        least = max(self._least_blocks(segment), self._least_blocks(later[0]))
        return held + size <= min(self.settings.memory // 2, self.settings.memory - least)

    def _where(
        self,
        segment: Segment,
        new: list[str],
        size: int,
        held: int,
        later: list[Segment],
    ) -> tuple[Held, str]:
        """Decide about streams that do not fit in memory beside ``held`` bytes, and say why.

        Raises
        ------
        PipelineError
            Where they can neither be made again nor fit on the disk.
        """
        following = later[0]
        disk = free_disk()
        head = following.operators[0]
        span = segment.whole
        hindrance = ""
        if head.couples == "all" and not planning_of(head).sweeps(self.views[0].observation):
            hindrance = f"{head.label} reads it as a whole"
        elif {span, following.span} == {"time", "detectors"}:
            hindrance = f"{head.label} needs the other direction whole"
        if hindrance and size > disk:
            plural = "s" if len(new) > 1 else ""
            raise PipelineError(
                f"the stream{plural} {', '.join(new)} takes {size / 1e9:.3g} GB, which fit neither"
                f" in memory nor on the disk ({disk / 1e9:.3g} GB free in"
                f" {tempfile.gettempdir()}), and cannot be made again when it is read: {hindrance}",
                place=self.views[0].observation.name,
                cure=(
                    f"use --memory {self._ceiling_for(2 * (held + size))}, or point TMPDIR to a"
                    " larger disk, or split into shorter scans"
                ),
            )
        following.source = Source(segment=segment)
        if not hindrance and segment.ordered and following.whole == "time":
            hindrance = "" if size > disk else f"made in order of time, {head.label} needs scans"
        return (
            ("spilled", f"{size / 1e9:.2f} GB: {hindrance}")
            if hindrance
            else ("again", f"{size / 1e9:.3g} GB; {head.label} reads it in blocks")
        )

    # ---- sizes of blocks

    def _least_blocks(self, segment: Segment) -> int:
        """Bytes of the smallest blocks, on all threads."""
        return self._bytes(segment, *least_block(segment.whole, self.shape))

    def _largest_blocks(self, segment: Segment) -> int:
        """Bytes of the blocks that would be cut beside the streams that are held, on all
        threads.
        """
        share = max(self._share(segment, segment.held), 1)
        first = next(iter(blocks(segment.whole, segment.ordered, self.shape, share)))
        return self._bytes(segment, *(s.stop - s.start for s in first))

    @property
    def _item(self) -> int:
        """Bytes of a sample in the blocks of all threads."""
        return self.settings.threads * self.at_once * np.dtype(self.settings.dtype).itemsize

    def _share(self, segment: Segment, held: int) -> int:
        """Samples that a block may hold beside ``held`` bytes of streams: within half of the
        budget, or all that is left.
        """
        settings, (whole, part) = self.settings, self._streams_in_block(segment)
        rows, columns = least_block(segment.whole, self.shape)
        most = min(settings.memory // 2, settings.threads * self.at_once * AMPLE_BLOCK)
        share = block_share(most // self._item, whole, part)
        left = block_share((settings.memory - held) // self._item, whole, part)
        return share if share >= rows * columns else left

    def _bytes(self, segment: Segment, rows: int, columns: int) -> int:
        whole, part = self._streams_in_block(segment)
        piece = min(rows, TILE_DETECTORS) * min(columns, PIECE)
        return self._item * (whole * rows * columns + part * piece)

    def _streams_in_block(self, segment: Segment | None) -> tuple[int, int]:
        """Numbers of block-sized and of piece-sized arrays that are held for a segment and for
        those that make its streams again.
        """
        if segment is None:
            return 0, 0
        first, rest = segment.split()
        expanded = self.chain.expanded
        names = set(segment.source.names | segment.wanted).union(
            *(expanded(o.requires | o.optional | o.provides) for o in rest)
        )
        every = (
            names.union(*(expanded(o.requires | o.optional | o.provides) for o in first))
            if first
            else set()
        )
        before = self._streams_in_block(segment.source.segment)
        whole = len(names & self.streams)
        part = len(every & self.streams)
        scratch = SCRATCH_STREAMS if rest else 0
        margins = 2 if segment.halo else 1  # a block with margins is trimmed to a copy
        whole = margins * whole + scratch
        part = part + (SCRATCH_STREAMS if first else 0)
        return before[0] + whole + self._copies(rest), max(before[1], part + self._copies(first))

    def _copies(self, operators: Sequence[Operator]) -> int:
        """Arrays of the run's precision that whole streams and one mean take, float64, where a step
        does not know of means.
        """
        signals = self.views[0].observation.signals
        copied = [
            1 + len(names_of(o, signals) & self.streams)
            for o in operators
            if (o.requires | o.optional) & self.means and not knows_means(o)
        ]
        return 8 // np.dtype(self.settings.dtype).itemsize * max(copied, default=0)

    def _ceiling_for(self, need: int) -> str:
        """``--memory`` with which streams and blocks may take ``need`` bytes."""
        settings = self.settings
        fixed = max(settings.process - settings.memory, 0) if settings.process else 0
        return f"{megabytes(need + fixed)}MB"


def schedule(views: Sequence[View], settings: Settings) -> Schedule:
    """Make the schedule of a scan with some bands.

    Raises
    ------
    PipelineError
        Where a stream fits neither in memory nor on the disk and cannot be made again.
    """
    made = Schedule(views, settings)
    made.make()
    if made.least > settings.memory and made.at_once > 1:
        made = Schedule(views, settings)
        made.at_once = 1
        made.make()
    return made


def does_the_same(views: Sequence[View], settings: Settings, others: Sequence[Schedule]) -> bool:
    """Tell whether streams are kept where other schedules keep them, and blocks fit."""
    try:
        found = schedule(views, settings)
    except PipelineError:  # a stream would go to a disk that has no room for it
        return False
    same = all(
        (found.elsewhere, found.made_again) == (one.elsewhere, one.made_again) for one in others
    )
    return same and found.least <= settings.memory
