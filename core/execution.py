"""Runs a chain of operators over one observation, in blocks of detectors x samples inside a memory budget.

The chain is cut into segments where the coupling changes (see `Operator.couples`). A segment works through the observation
in blocks; operators that couple nothing work through a block in pieces of `TILE_DETECTORS` x `PIECE` samples, each of which
passes through all of them while it is hot in the cache. Between segments the streams that later operators need are kept in
memory, spilled to a temporary file, or made again when they are read (`core.streams`). Blocks and pieces begin at multiples
of `TILE_DETECTORS` and `TILE_SAMPLES`, so that no result depends on the budget or on the number of threads.
"""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed, wait
from contextlib import suppress
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from .ahead import Ahead, reach
from .blocks import PIECE, Segment, block_share, blocks, cut, least_block, pieces, trimmed, whole_span, within
from .data import Block, Data, Floats, Observation, Stream, Tally, in_order
from .errors import PipelineError
from .frozen import Frozen
from .machine import available_memory, available_threads, resident_memory
from .operator import Operator
from .smooth import SmoothField
from .streams import (
    DISK_RATE,
    SAMPLE_COST,
    WORTH_MEASURING,
    Held,
    Ledger,
    Source,
    Stage,
    Store,
    StreamMadeAgain,
    choose,
    disk_rate,
    forget_pages,
)
from .tiles import TILE_DETECTORS, TILE_SAMPLES

__all__ = ["PIECE", "Execution", "Segment", "Settings", "Timer", "available_memory", "available_threads", "cut"]


SCRATCH_STREAMS = 2
"""Block-sized arrays assumed for operators' own scratch when the budget is divided."""


@dataclass
class Settings:
    """How to execute.

    Attributes
    ----------
    threads
        Threads that work on blocks.
    memory
        Bytes for streams and blocks.
    ceiling
        Bytes that the whole process may hold; None: only ``memory`` counts.
    dtype
        Type of the streams.
    prefer
        What is done with streams that do not fit in memory where there is a choice; None: what is quicker.
    progress
        Whom to tell.
    spare
        Memory to use again.
    """

    threads: int = 1
    memory: int = 2 << 30
    dtype: type[np.floating[Any]] = np.float32
    progress: Callable[[int, int, str], None] = lambda done, total, what: None
    spare: list[Floats] = field(default_factory=list)
    ceiling: int | None = None
    prefer: Held | None = None


@dataclass
class Timer:
    """CPU seconds by (operator label, stage), added up over threads."""

    seconds: dict[tuple[str, str], float] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, label: str, stage: str, seconds: float) -> None:
        """Add to a stage."""
        with self._lock:
            self.seconds[label, stage] = self.seconds.get((label, stage), 0.0) + seconds

    def rows(self) -> list[tuple[str, str, float]]:
        """(label, stage, seconds) in the order in which they first took time."""
        with self._lock:
            return [(*key, seconds) for key, seconds in self.seconds.items()]


def _nobody(**what: Any) -> None:
    """A hook that nobody listens to."""


class Execution:
    """One pipeline over one observation."""

    def __init__(
        self,
        operators: Sequence[Operator],
        observation: Observation,
        settings: Settings,
        timer: Timer,
        keep: Sequence[str],
        frozen: Frozen | None = None,
    ) -> None:
        self.operators, self.observation, self.settings, self.timer = list(operators), observation, settings, timer
        self.keep, self.frozen = tuple(keep), frozen
        self.states: dict[str, Any] = {}
        self._labels = {id(operator): operator.label for operator in operators}  # the property is slow
        self.beforehand: Future[None] | None = None
        self._ahead = Ahead(False)
        self._stop = threading.Event()
        self._local = threading.local()
        self.ledger = Ledger()
        self._store = Store(settings.memory, settings.dtype, settings.spare, self.ledger)
        streams = set(keep).union(*(o.requires | o.optional for o in operators if type(o).exec is not Operator.exec))
        self._streams = frozenset(streams - {"boresight"})

    def run(
        self,
        data: Data,
        before: Callable[..., None],
        after: Callable[..., None],
        ahead: Ahead | None = None,
        following: Execution | None = None,
    ) -> None:
        """Configure, prepare, execute and collect; on any failure operators discard what they began.

        ``following``: what ``ahead`` may prepare meanwhile.
        """
        observation = self.observation
        self._ahead = ahead or self._ahead
        try:
            if self.beforehand is not None:
                self.beforehand.result()
            else:
                self._configure()
            self._prepare(self.operators[len(self.states) :], before, after)
            self._same_use("", "prepared")
            self._keep_to_ceiling()
            self._ahead.start(following)
            self._leave_out()
            self._execute(before, after)
            self._keep_out()
            for operator in self.operators:
                start = time.thread_time()
                operator.collect(data, observation, self.states[operator.label])
                self.timer.add(operator.label, "collect", time.thread_time() - start)
        except BaseException:
            self.abandon()
            raise
        finally:
            self.states.clear()
            self._store.close()

    def prepare_ahead(self) -> None:
        """Configure, and prepare what can be prepared while another observation is executed (`core.ahead`); nobody is told."""
        self._configure()
        self._prepare(self.operators[: reach(self.operators)], _nobody, _nobody)

    def abandon(self) -> None:
        """Stop; let operators discard what they began."""
        self._stop.set()
        if self.beforehand is not None:
            self.beforehand.cancel()
            wait([self.beforehand])
        for operator in self.operators:
            if operator.label in self.states:
                with suppress(Exception):
                    operator.discard(self.observation, self.states[operator.label])
        self.states.clear()

    def _configure(self) -> None:
        for operator in self.operators:
            operator.configure(self.observation)

    def _prepare(self, operators: Sequence[Operator], before: Callable[..., None], after: Callable[..., None]) -> None:
        for operator in operators:
            if self._stop.is_set():
                return
            before(operator=operator, observation=self.observation, stage="prepare")
            self._same_use(operator.label, "prepare")
            start = time.thread_time()
            self.states[operator.label] = operator.prepare(self.observation)
            used = time.thread_time() - start
            self.timer.add(operator.label, "prepare", used)
            after(operator=operator, observation=self.observation, stage="prepare", seconds=used)

    def _same_use(self, label: str, stage: str) -> None:
        """Let a run with frozen modes use the samples and detectors that the main run used at this point."""
        if self.frozen is not None:
            self.frozen.at(self.observation, label, stage)

    def _leave_out(self) -> None:
        """Let a run with frozen modes leave out the single samples that the main run left out."""
        if self.frozen is not None and self.frozen.complete:
            for operator in self.operators:
                if (kept_out := self.frozen.kept_out.get(operator.label)) is not None:
                    operator.leave_out(self.states[operator.label], kept_out)

    def _keep_out(self) -> None:
        """Note what the main run left out."""
        if self.frozen is not None and not self.frozen.complete:
            for operator in self.operators:
                kept_out = operator.keep_out(self.observation, self.states[operator.label])
                if kept_out is not None:
                    self.frozen.kept_out[operator.label] = kept_out
            self.frozen.complete = True

    # ---- segments

    def _execute(self, before: Callable[..., None], after: Callable[..., None]) -> None:
        ordered = [o.label for o in self.operators if o.in_time_order(self.observation, self.states[o.label])]
        segments = cut(self.operators, self.observation, ordered)
        source, begun = Source(), list[Operator]()
        for number, segment in enumerate(segments):
            later = segments[number + 1 :]
            wanted = set(self.keep).union(*(o.requires | o.optional for s in later for o in s.operators))
            head = segment.operators[0]
            if head.couples == "all":
                self._measure(head, source, before, after)
            for operator in segment.operators:
                before(operator=operator, observation=self.observation, stage="exec")
            begun += segment.operators
            source = self._advance(Stage(segment, source, self.passed_on(segment, source, wanted)), later)
            if source.stage is None:  # else they are not through yet
                for operator in begun:
                    used = self.timer.seconds.get((operator.label, "exec"), 0.0)
                    after(operator=operator, observation=self.observation, stage="exec", seconds=used)
                begun.clear()
        for name in self.keep:
            if name not in source.streams:
                raise PipelineError(
                    f"stream {name!r} was asked to be kept, but no operator makes it", cure="keep a stream that a step provides"
                )
            stream = source.streams[name]
            whole = np.array(stream.array, np.float64)
            if name in stream.means:
                whole += stream.means[name].evaluate(slice(0, whole.shape[0]), slice(0, whole.shape[1]))
            self.observation.detdata[name] = whole

    def _keep_to_ceiling(self) -> None:
        """What operators hold by now is known; streams and blocks may have the rest."""
        settings = self.settings
        if settings.ceiling is None:
            return
        spare = sum(a.nbytes for a in settings.spare)
        room = max(settings.ceiling - (resident_memory() - spare), 1)
        if room < settings.memory:
            self.settings = settings = copy.copy(settings)
            settings.memory = room
            self._store = Store(room, settings.dtype, settings.spare, self.ledger)

    def passed_on(self, segment: Segment, source: Source, wanted: set[str]) -> frozenset[str]:
        """Streams that later segments may read."""
        made = source.names.union(*(o.provides for o in segment.operators))
        return frozenset(made & wanted & self._streams)

    def _measure(self, operator: Operator, source: Source, before: Callable[..., None], after: Callable[..., None]) -> None:
        names = sorted(operator.requires & source.names)
        if len(names) != 1:
            raise PipelineError(
                f"{operator.label} measures a whole stream, but {len(names)} reach it", cure="it must require exactly one"
            )
        stream: Stream
        if source.stage is not None:
            stage, name, threads = source.stage, names[0], self.settings.threads
            what = f"{operator.label} measures {name}"

            def sweeper(work: Callable[[slice, slice, Floats], Any]) -> Iterator[tuple[slice, slice, Any]]:
                return self._sweep(stage, name, work, what)

            stream = StreamMadeAgain(name, self.observation, source.means, threads, self.settings.dtype, sweeper)
        else:
            stream = source.streams[names[0]]
        before(operator=operator, observation=self.observation, stage="measure")
        start, others = time.process_time(), self._seconds("exec") + self._ahead.seconds()
        state, frozen = self.states[operator.label], self.frozen
        if frozen is not None and frozen.complete:
            operator.measure_frozen(stream, state, frozen.found[operator.label])
        else:
            operator.measure(stream, state)
            if frozen is not None and operator.can_freeze:
                frozen.found[operator.label] = operator.freeze(state)
        self._same_use(operator.label, "measure")
        others = self._seconds("exec") + self._ahead.seconds() - others  # what makes the stream again is theirs
        used = time.process_time() - start - others
        self.timer.add(operator.label, "measure", used)
        after(operator=operator, observation=self.observation, stage="measure", seconds=used)

    def _seconds(self, stage: str) -> float:
        return sum(self.timer.seconds.get((o.label, stage), 0.0) for o in self.operators)

    def _sweep(
        self, stage: Stage, name: str, work: Callable[[slice, slice, Floats], Any], what: str
    ) -> Iterator[tuple[slice, slice, Any]]:
        """`Stream.sweep` of a stream that ``stage`` makes."""

        def one(detectors: slice, samples: slice) -> tuple[slice, slice, Any]:
            block = self._make(stage, detectors, samples, {}, again=False)
            return detectors, samples, work(detectors, samples, block.detdata[name])

        todo = self._blocks(stage)
        for done, result in enumerate(in_order(one, todo, self.settings.threads), 1):
            self.settings.progress(done, len(todo), f"{self.observation.name}: {what}")
            yield result
        stage.has_been_swept()
        self._let_go()

    # ---- streams between segments

    def _advance(self, stage: Stage, later: list[Segment]) -> Source:
        """Let the segment of ``stage`` work, or put that off until its streams are read."""
        in_place = frozenset() if stage.segment.halo else stage.wanted & stage.source.streams.keys()
        new = sorted(stage.wanted - in_place)
        size = len(new) * self.stream_size
        if later and new and not self.keeps(stage, size, self._store.held, later):
            how, why = self.where(stage, new, size, later)
            if how == "again":
                self._store.clear_spare()
                found = self._probe(stage)
                names = frozenset(stage.wanted & found.detdata.keys())
                for name in sorted(names):
                    self.observation.tally.state("Execution", f"stream {name} made again when it is read", why)
                return Source({}, stage, names, dict(found.means))
            return self._pass(stage, in_memory=False)
        return self._pass(stage)

    def keeps(self, stage: Stage, size: int, held: int, later: list[Segment]) -> bool:
        """Whether ``size`` bytes of streams beside those held stay in memory: in half of it, and leave room for blocks."""
        following = Stage(later[0], Source(names=stage.wanted), frozenset())
        blocks = max(self.least_blocks(stage), self.least_blocks(following))
        return held + size <= min(self.settings.memory // 2, self.settings.memory - blocks)

    def where(self, stage: Stage, new: list[str], size: int, later: list[Segment], measure: bool = True) -> tuple[Held, str]:
        """What becomes of streams that do not fit in memory, and why. ``measure``: try what disk and operators take."""
        following = later[0]
        head, span = following.operators[0], stage.span
        hindrance = ""
        if head.couples == "all" and not head.sweeps(self.observation):
            hindrance = f"{head.label} reads it as a whole"
        elif {span, following.span} == {"time", "detectors"}:
            hindrance = f"{head.label} needs the other direction whole"
        # what is made in order of time at little cost would cost much in any other
        slow = stage.in_time_order and whole_span(following.span, span) == "time"
        rate, cost = DISK_RATE, SAMPLE_COST
        if measure and size >= WORTH_MEASURING and not hindrance:
            rate, cost = disk_rate(), self._cost(stage)
        return choose(
            f"the stream{'s' if len(new) > 1 else ''} {', '.join(new)}",
            size,
            self.observation.n_detectors * self.observation.n_samples,
            readings=self.readings(later),
            hindrance=hindrance,
            threads=self.settings.threads,
            prefer="spilled" if slow else self.settings.prefer,
            rate=rate,
            cost=cost,
            place=self.observation.name,
            ceiling=self._ceiling_for(2 * (self._store.held + size)),
        )

    def readings(self, later: Sequence[Segment]) -> int:
        """How often, beyond once, the segments to come read what is passed on to the first of them."""
        heads = [s.operators[0] for s in later]
        swept = sum(o.sweeps(self.observation) for o in heads if o.couples == "all")
        return swept + round(2 * later[0].halo / PIECE + 0.4)

    def _cost(self, stage: Stage) -> float:
        """CPU seconds for a sample, from a small block made twice: the first may compile."""
        self._probe(stage)
        start = time.thread_time()
        block = self._probe(stage)
        return (time.thread_time() - start) / (block.shape[0] * block.shape[1])

    def _probe(self, stage: Stage) -> Block:
        """The smallest block, made before its time."""
        rows, columns = least_block(stage.span, (self.observation.n_detectors, self.observation.n_samples))
        return self._make(stage, slice(0, rows), slice(0, columns), {}, again=True)

    @property
    def stream_size(self) -> int:
        """Bytes of a whole stream."""
        return self.observation.n_detectors * self.observation.n_samples * np.dtype(self.settings.dtype).itemsize

    def _pass(self, stage: Stage, in_memory: bool = True) -> Source:
        """Run a segment's operators over all blocks; what it passes on is held, ``in_memory`` where there is room."""
        observation, settings, source = self.observation, self.settings, stage.source
        made: dict[str, Stream] = {}
        for name in sorted(stage.wanted):
            if name in source.streams and not stage.segment.halo:
                made[name] = source.streams[name]  # changed in place
                continue
            array = self._store.allocate(name, self._shape, in_memory)
            made[name] = Stream(name, observation, array, {}, settings.threads)
            if isinstance(array, np.memmap):
                observation.tally.state("Execution", f"stream {name} spilled to disk", f"{array.nbytes / 1e9:.2f} GB")
        seen: set[str] = set()
        means: dict[str, SmoothField] = {}

        def work(detectors: slice, samples: slice) -> None:
            block = self._make(stage, detectors, samples, made, again=False)
            for name, stream in made.items():
                if name in block.detdata:
                    seen.add(name)
                    if block.detdata[name] is not block.places.get(name):
                        stream.array[block.detectors, block.samples] = block.detdata[name]
            means.update(block.means)  # the same fields in every block
            for stream in (*made.values(), *source.streams.values()):
                forget_pages(stream.array)

        what = ", ".join(o.label for o in stage.segment.operators)
        self._map(work, self._blocks(stage), what)
        stage.has_been_swept()
        self._let_go()
        kept = {name: Stream(name, observation, s.array, means, settings.threads) for name, s in made.items() if name in seen}
        held = {id(s.array) for s in kept.values()}
        self._store.release([s.array for s in [*source.streams.values(), *made.values()] if id(s.array) not in held])
        return Source.of(kept, means)

    def _let_go(self) -> None:
        """Blocks are done with: their threads have ended."""
        self._local = threading.local()
        self.ledger.drop("blocks")

    # ---- blocks

    def _make(self, stage: Stage, detectors: slice, samples: slice, made: dict[str, Stream], *, again: bool) -> Block:
        """A block with the segment's operators, and those of the stages before it, carried out."""
        segment, again = stage.segment, again or stage.swept
        n_samples = self.observation.n_samples
        margin = -(-segment.halo // TILE_SAMPLES) * TILE_SAMPLES
        reach = slice(max(0, samples.start - margin), min(n_samples, samples.stop + margin))
        first, rest = segment.split()
        # whole scans, and what is only taken in pieces, are worked on where they are kept
        in_place = bool(made) and not segment.halo and (not rest or reach == slice(0, n_samples))
        passed_on = set(stage.wanted).union(*(o.requires | o.optional for o in rest))
        if again:
            first, rest = ([o for o in some if o.provides & self._streams] for some in (first, rest))
        copied = not first or bool(rest)
        block = self._block(stage, detectors, reach, samples, made if in_place else {}, again, copied)
        if first:
            self._in_pieces(first, block, passed_on)
        self._exec(rest[:1], block)
        if reach != samples:
            block = trimmed(block, samples)
        self._exec(rest[1:], block)
        buffers = [*self._local.__dict__.get("blocks", {}).values(), self._local.__dict__.get("pieces", {})]
        size = sum(array.nbytes for held in buffers for array in held.values())
        self.ledger.note(("blocks", threading.get_ident()), size)
        return block

    def _exec(self, operators: list[Operator], block: Block) -> None:
        start = time.thread_time()
        for operator in operators:
            if self._stop.is_set():
                return
            label = self._labels[id(operator)]
            operator.exec(block, self.states[label])
            now = time.thread_time()
            self.timer.add(label, "exec", now - start)
            start = now

    def _block(
        self, stage: Stage, detectors: slice, reach: slice, samples: slice, made: dict[str, Stream], again: bool, copied: bool
    ) -> Block:
        """A block with its sources in it: where they are kept (as ``made`` says), copies, or made again.

        With margins never in place: others read them too. Not ``copied``: operators work on copies of parts of it alone.
        """
        source, observation = stage.source, self.observation
        if again:
            observation = copy.copy(observation)
            observation.tally = Tally()
        buffers = self._local.__dict__.setdefault("blocks", {}).setdefault(stage.depth, {})
        block = Block(observation, detectors, reach, dtype=self.settings.dtype, buffers=buffers, again=again)
        block.places = {name: stream.array[detectors, reach] for name, stream in made.items()}
        for name, stream in source.streams.items():
            if made or not copied:
                block.detdata[name] = block.places.get(name, stream.array[detectors, reach])
            else:
                block.detdata[name] = block.buffer(name, block.shape)
                block.detdata[name][...] = stream.array[detectors, reach]
            block.means.update(stream.means)
        if source.stage is None:
            return block
        margins = slice(reach.start, samples.start), slice(samples.stop, reach.stop)
        for part, known in ((margins[0], True), (samples, again), (margins[1], True)):
            if part.start == part.stop:
                continue
            before = self._make(source.stage, detectors, part, {}, again=known)
            for name in source.names:
                if reach == samples:
                    block.detdata[name] = before.detdata[name]
                    continue
                if name not in block.detdata:
                    block.detdata[name] = block.buffer(name, block.shape)
                block.detdata[name][:, within(reach, part)] = before.detdata[name]
            block.means.update(before.means)
        return block

    def _in_pieces(self, operators: list[Operator], block: Block, passed_on: set[str]) -> None:
        """Let operators that couple nothing work on copies of parts of a block; put the streams ``passed_on`` into it."""
        given, means, made = block.detdata, block.means, dict[str, Floats]()
        buffers = self._local.__dict__.setdefault("pieces", {})
        for detectors, samples in pieces(block.detectors, block.samples):
            piece = Block(
                block.observation, detectors, samples, means=dict(means), dtype=block.dtype, buffers=buffers, again=block.again
            )
            where = within(block.detectors, detectors), within(block.samples, samples)
            for name, stream in given.items():
                piece.detdata[name] = piece.buffer(name, piece.shape)
                piece.detdata[name][...] = stream[where]
            self._exec(operators, piece)
            for name in passed_on & piece.detdata.keys():
                if name not in made:
                    made[name] = block.places[name] if name in block.places else block.buffer(name, block.shape)
                made[name][where] = piece.detdata[name]
            block.means = piece.means  # the same fields in every piece
        block.detdata = {**given, **made}

    def _blocks(self, stage: Stage) -> list[tuple[slice, slice]]:
        """The blocks in which a stage works. Raises PipelineError where the least one does not fit."""
        rows, columns = least_block(stage.span, self._shape)
        share = self._share(stage, self._store.held)
        if rows * columns > share:
            settings, need = self.settings, self.least_blocks(stage)
            raise PipelineError(
                f"one block of {rows} detectors needs {need / settings.threads / 1e6:.1f} MB on each of {settings.threads} "
                f"threads, the memory budget has {(settings.memory - self._store.held) / 1e6:.1f} MB for all of them",
                place=self.observation.name,
                cure=f"raise --memory to {self._ceiling_for(need + self._store.held)}, use fewer --threads, or make the scan "
                "shorter",
            )
        return list(blocks(stage.span, stage.in_time_order, self._shape, share))

    @property
    def _shape(self) -> tuple[int, int]:
        return self.observation.n_detectors, self.observation.n_samples

    def _share(self, stage: Stage, held: int) -> int:
        """Samples that a block may hold beside ``held`` bytes of streams: within half of the budget, or all that is left."""
        settings, (whole, part) = self.settings, self._streams_in_block(stage)
        rows, columns = least_block(stage.span, self._shape)
        each = settings.threads * np.dtype(settings.dtype).itemsize
        share = block_share(settings.memory // 2 // each, whole, part)
        return share if share >= rows * columns else block_share((settings.memory - held) // each, whole, part)

    def least_blocks(self, stage: Stage) -> int:
        """Bytes of the smallest blocks, on all threads."""
        rows, columns = least_block(stage.span, self._shape)
        return self._bytes(stage, rows * columns, min(rows, TILE_DETECTORS) * min(columns, PIECE))

    def largest_blocks(self, stage: Stage, held: int) -> int:
        """Bytes of the blocks that would be cut beside ``held`` bytes of streams, on all threads."""
        share = max(self._share(stage, held), 1)
        first = next(iter(blocks(stage.span, stage.in_time_order, self._shape, share)))
        rows, columns = (s.stop - s.start for s in first)
        return self._bytes(stage, rows * columns, min(rows, TILE_DETECTORS) * min(columns, PIECE))

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
        whole, part = len(names & self._streams), len(every & self._streams)
        scratch = SCRATCH_STREAMS if rest else 0
        margins = 2 if stage.segment.halo else 1  # a block with margins is trimmed to a copy
        return before[0] + margins * whole + scratch, max(before[1], part + (SCRATCH_STREAMS if first else 0))

    def _ceiling_for(self, need: int) -> str:
        """``--memory`` with which streams and blocks may take ``need`` bytes."""
        settings = self.settings
        fixed = max(settings.ceiling - settings.memory, 0) if settings.ceiling else 0
        return f"{-(-(need + fixed) // 1_000_000)}MB"

    def _map(self, work: Callable[[slice, slice], None], blocks: list[tuple[slice, slice]], what: str) -> None:
        """Call ``work`` on every block, on ``threads`` threads; the first error stops all."""
        progress, total = self.settings.progress, len(blocks)
        if self.settings.threads == 1 or total == 1:
            for done, block in enumerate(blocks, 1):
                work(*block)
                progress(done, total, f"{self.observation.name}: {what}")
            return
        with ThreadPoolExecutor(self.settings.threads) as pool:
            futures = [pool.submit(work, *block) for block in blocks]
            try:
                for done, future in enumerate(as_completed(futures), 1):
                    future.result()
                    progress(done, total, f"{self.observation.name}: {what}")
            except BaseException:
                self._stop.set()
                for future in futures:
                    future.cancel()
                raise
