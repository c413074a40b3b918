"""How the streams of one observation fit into memory: what becomes of them between segments, and which blocks are cut."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence

import numpy as np

from ..data import Observation
from ..errors import PipelineError
from ..numerics.tiles import TILE_DETECTORS
from ..operator import Operator
from ..plan.planning import planning_of
from .blocks import PIECE, Segment, block_share, blocks, least_block, whole_span
from .settings import Settings
from .streams import DISK_RATE, SAMPLE_COST, WORTH_MEASURING, Held, Source, Stage, choose, disk_rate
from .whole import knows_means, names_of

SCRATCH_STREAMS = 2
"""Block-sized arrays assumed for operators' own scratch when the budget is divided."""


def read(operators: Sequence[Operator]) -> set[str]:
    """Names of the streams that steps read in `Operator.exec`."""
    names = set[str]().union(*(o.requires | o.optional for o in operators if type(o).exec is not Operator.exec))
    return names - {"boresight"}


class Layout:
    """Sizes and choices; nothing is run, nothing is allocated. The execution and the forecast of it keep to the same ones.

    Parameters
    ----------
    streams
        Names of those that are of use: `read`, and those to be kept.
    means
        Names of those that may have a mean (`may_have_means`).
    """

    def __init__(
        self, observation: Observation, settings: Settings, streams: Collection[str], means: Collection[str] = ()
    ) -> None:
        self.observation, self.settings = observation, settings
        self.streams, self.means = frozenset(streams), frozenset(means)

    @property
    def shape(self) -> tuple[int, int]:
        """(detectors, samples) of the observation."""
        return self.observation.n_detectors, self.observation.n_samples

    @property
    def stream_size(self) -> int:
        """Bytes of a whole stream."""
        return self.shape[0] * self.shape[1] * np.dtype(self.settings.dtype).itemsize

    # ---- streams between segments

    def passed_on(self, segment: Segment, source: Source, wanted: Collection[str]) -> frozenset[str]:
        """Streams that later segments may read."""
        made = source.names.union(*(o.provides for o in segment.operators))
        return frozenset(made & set(wanted) & self.streams)

    def keeps(self, stage: Stage, size: int, held: int, later: list[Segment]) -> bool:
        """Whether ``size`` bytes of streams beside those held stay in memory: in half of it, and leave room for blocks."""
        following = Stage(later[0], Source(names=stage.wanted), frozenset())
        least = max(self.least_blocks(stage), self.least_blocks(following))
        return held + size <= min(self.settings.memory // 2, self.settings.memory - least)

    def where(
        self, stage: Stage, new: list[str], size: int, held: int, later: list[Segment], cost: Callable[[Stage], float] | None
    ) -> tuple[Held, str]:
        """What becomes of streams that do not fit in memory beside ``held`` bytes, and why.

        ``cost``: measures what a sample of a stage costs (CPU s); None: nothing is tried, neither operators nor the disk.
        """
        following = later[0]
        head, span = following.operators[0], stage.span
        hindrance = ""
        if head.couples == "all" and not planning_of(head).sweeps(self.observation):
            hindrance = f"{head.label} reads it as a whole"
        elif {span, following.span} == {"time", "detectors"}:
            hindrance = f"{head.label} needs the other direction whole"
        # what is made in order of time at little cost would cost much in any other
        slow = stage.in_time_order and whole_span(following.span, span) == "time"
        rate, sample_cost = DISK_RATE, SAMPLE_COST
        if cost is not None and size >= WORTH_MEASURING and not hindrance:
            rate, sample_cost = disk_rate(), cost(stage)
        return choose(
            f"the stream{'s' if len(new) > 1 else ''} {', '.join(new)}",
            size,
            self.shape[0] * self.shape[1],
            readings=self.readings(later),
            hindrance=hindrance,
            threads=self.settings.threads,
            prefer="spilled" if slow else self.settings.prefer,
            rate=rate,
            cost=sample_cost,
            place=self.observation.name,
            ceiling=self._ceiling_for(2 * (held + size)),
        )

    def readings(self, later: Sequence[Segment]) -> int:
        """How often, beyond once, the segments to come read what is passed on to the first of them."""
        heads = [s.operators[0] for s in later]
        swept = sum(planning_of(o).sweeps(self.observation) for o in heads if o.couples == "all")
        return swept + round(2 * later[0].halo / PIECE + 0.4)

    # ---- blocks

    def blocks(self, stage: Stage, held: int) -> list[tuple[slice, slice]]:
        """The blocks in which a stage works beside ``held`` bytes of streams.

        Raises
        ------
        PipelineError
            Where the least one does not fit.
        """
        rows, columns = least_block(stage.span, self.shape)
        share = self._share(stage, held)
        if rows * columns > share:
            settings, need = self.settings, self.least_blocks(stage)
            raise PipelineError(
                f"one block of {rows} detectors needs {need / settings.threads / 1e6:.1f} MB on each of {settings.threads} "
                f"threads, the memory budget has {(settings.memory - held) / 1e6:.1f} MB for all of them",
                place=self.observation.name,
                cure=f"raise --memory to {self._ceiling_for(need + held)}, use fewer --threads, or make the scan shorter",
            )
        return list(blocks(stage.span, stage.in_time_order, self.shape, share))

    def least_blocks(self, stage: Stage) -> int:
        """Bytes of the smallest blocks, on all threads."""
        rows, columns = least_block(stage.span, self.shape)
        return self._bytes(stage, rows * columns, min(rows, TILE_DETECTORS) * min(columns, PIECE))

    def largest_blocks(self, stage: Stage, held: int) -> int:
        """Bytes of the blocks that would be cut beside ``held`` bytes of streams, on all threads."""
        share = max(self._share(stage, held), 1)
        first = next(iter(blocks(stage.span, stage.in_time_order, self.shape, share)))
        rows, columns = (s.stop - s.start for s in first)
        return self._bytes(stage, rows * columns, min(rows, TILE_DETECTORS) * min(columns, PIECE))

    def _share(self, stage: Stage, held: int) -> int:
        """Samples that a block may hold beside ``held`` bytes of streams: within half of the budget, or all that is left."""
        settings, (whole, part) = self.settings, self._streams_in_block(stage)
        rows, columns = least_block(stage.span, self.shape)
        each = settings.threads * np.dtype(settings.dtype).itemsize
        share = block_share(settings.memory // 2 // each, whole, part)
        return share if share >= rows * columns else block_share((settings.memory - held) // each, whole, part)

    def _bytes(self, stage: Stage, block: int, piece: int) -> int:
        whole, part = self._streams_in_block(stage)
        return self.settings.threads * np.dtype(self.settings.dtype).itemsize * (whole * block + part * piece)

    def _streams_in_block(self, stage: Stage | None) -> tuple[int, int]:
        """Numbers of block-sized and of piece-sized arrays that a stage and those before it hold."""
        if stage is None:
            return 0, 0
        first, rest = stage.segment.split()
        names = set(stage.source.names | stage.wanted).union(*(o.requires | o.optional | o.provides for o in rest))
        every = names.union(*(o.requires | o.optional | o.provides for o in first)) if first else set()
        before = self._streams_in_block(stage.source.stage)
        whole, part = len(names & self.streams), len(every & self.streams)
        scratch = SCRATCH_STREAMS if rest else 0
        margins = 2 if stage.segment.halo else 1  # a block with margins is trimmed to a copy
        whole, part = margins * whole + scratch, part + (SCRATCH_STREAMS if first else 0)
        return before[0] + whole + self._copies(rest), max(before[1], part + self._copies(first))

    def _copies(self, operators: Sequence[Operator]) -> int:
        """Arrays of the run's precision that whole streams and one mean take, float64, where a step does not know of means."""
        each = 8 // np.dtype(self.settings.dtype).itemsize
        paying = [o for o in operators if (o.requires | o.optional) & self.means and not knows_means(o)]
        return each * (1 + max(len(names_of(o) & self.streams) for o in paying)) if paying else 0

    def _ceiling_for(self, need: int) -> str:
        """``--memory`` with which streams and blocks may take ``need`` bytes."""
        settings = self.settings
        fixed = max(settings.asked - settings.memory, 0) if settings.asked else 0
        return f"{-(-(need + fixed) * 21 // 20_000_000)}MB"
