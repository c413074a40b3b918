"""Runs a chain of operators over one observation, in blocks of detectors x samples inside a memory budget.

The chain is cut into segments where the coupling changes (see `Operator.couples`). A segment works through the observation
in blocks; operators that couple nothing work through a block in pieces of `TILE_DETECTORS` x `PIECE` samples, each of which
passes through all of them while it is hot in the cache. Between segments the streams that later operators need are kept in
memory, spilled to a temporary file, or made again when they are read (`core.run.streams`). Blocks and pieces begin at multiples
of `TILE_DETECTORS` and `TILE_SAMPLES`, so that no result depends on the budget or on the number of threads.
"""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, as_completed, wait
from contextlib import suppress
from functools import partial
from typing import Any

import numpy as np

from ..data import Block, Data, Observation, Stream, Tally, in_order
from ..discovery import RAISED
from ..errors import PipelineError
from ..machine import resident_memory
from ..numerics.smooth import SmoothField
from ..operator import Operator
from ..stream import forget_pages
from ..types import AnyFloats
from .ahead import Ahead, reach
from .block_maker import BlockMaker
from .blocks import Segment, cut, least_block
from .frozen import Frozen
from .layout import Layout, read
from .repeated import Repeated
from .settings import Settings, Timer
from .streams import Ledger, Source, Stage, Store, StreamMadeAgain
from .whole import WholeStream, knows_means, may_have_means, means_of


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
        repeated: Repeated | None = None,
    ) -> None:
        self.operators, self.observation, self.settings, self.timer = list(operators), observation, settings, timer
        self.keep, self.frozen, self.repeated = tuple(keep), frozen, repeated
        self.states: dict[str, Any] = {}
        self.beforehand: Future[None] | None = None
        self._ahead = Ahead(False)
        self._stop = threading.Event()
        self.ledger = Ledger()
        self._store = Store(settings.memory, settings.dtype, settings.spare, self.ledger)
        streams = read(operators) | set(keep)
        self.layout = Layout(observation, settings, streams, may_have_means(operators))
        self._blocks = BlockMaker(
            operators, observation, settings, self.states, streams, timer, self.ledger, self._stop.is_set, repeated
        )

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
        self._ahead = ahead or self._ahead
        try:
            if self.beforehand is not None:
                self.beforehand.result()
            else:
                self._configure()
            self._prepare(self.operators[len(self.states) :], before, after)
            self._same_use("", "prepared")
            self._keep_to_ceiling()
            if self.repeated is not None and not self.repeated.complete:
                self.repeated.begin(self.layout.shape, self.settings)
            self._ahead.start(following)
            self._leave_out()
            self._execute(before, after)
            self._keep_out()
            for operator in self.operators:
                start = time.thread_time()
                self._collect(operator, data)
                self.timer.add(operator.label, "collect", time.thread_time() - start)
            if self.repeated is not None:
                self.repeated.complete = True
        except BaseException:
            self.abandon()
            raise
        finally:
            self.states.clear()
            self._store.close()
            for field in self.observation.smooth.values():
                if isinstance(field, SmoothField):
                    field.forget()

    def prepare_ahead(self) -> None:
        """Configure, and prepare what can be prepared while another observation is executed (`ahead`); nobody is told."""
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
                with suppress(*RAISED):
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

    def _collect(self, operator: Operator, data: Data) -> None:
        """`Operator.collect`; where the step is not carried out again, what it told in the main run."""
        observation, label = self.observation, operator.label
        if self.repeated is None or label not in self.repeated.names:
            operator.collect(data, observation, self.states[label])
            return
        if not self.repeated.complete:
            before, observation.tally = observation.tally, Tally()
            operator.collect(data, observation, self.states[label])
            self.repeated.told[label], observation.tally = observation.tally, before
        observation.tally.update(self.repeated.told[label])

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
            source = self._advance(Stage(segment, source, self.layout.passed_on(segment, source, wanted)), later)
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
        known = sum(a.nbytes for a in (*settings.spare, *settings.kept))
        room = max(settings.ceiling - (resident_memory() - known), 1)
        if room < settings.memory:
            self.settings = settings = copy.copy(settings)
            if room < settings.least:  # the operators took a little more than they said: work on fewer blocks at once
                threads = max(1, settings.threads * room // settings.least)
                room, settings.threads = max(room, settings.least * threads // settings.threads), threads
            settings.memory = room
            self._store = Store(room, settings.dtype, settings.spare, self.ledger)
            self.layout = Layout(self.observation, settings, self.layout.streams, self.layout.means)

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

            def sweeper(work: Callable[[slice, slice, AnyFloats], Any]) -> Iterator[tuple[slice, slice, Any]]:
                return self._sweep(stage, name, work, what)

            stream = StreamMadeAgain(name, self.observation, source.means, threads, self.settings.dtype, sweeper)
        else:
            stream = source.streams[names[0]]
            stream.room = max(self.settings.memory - self._store.held, 0)
        lent: list[AnyFloats] = []
        if not knows_means(operator) and (fields := means_of(self.observation, source.means, frozenset(names))):
            stream = WholeStream(stream, fields[names[0]], partial(self._lend, names[0], lent))
        before(operator=operator, observation=self.observation, stage="measure")
        start, others = time.process_time(), self._seconds("exec") + self._ahead.seconds()
        state, frozen = self.states[operator.label], self.frozen
        if frozen is not None and frozen.complete:
            operator.measure_frozen(stream, state, frozen.found[operator.label])
        else:
            operator.measure(stream, state)
            if frozen is not None and operator.can_freeze:
                frozen.found[operator.label] = operator.freeze(state)
        self._store.drop(lent)
        self._same_use(operator.label, "measure")
        others = self._seconds("exec") + self._ahead.seconds() - others  # what makes the stream again is theirs
        used = time.process_time() - start - others
        self.timer.add(operator.label, "measure", used)
        after(operator=operator, observation=self.observation, stage="measure", seconds=used)

    def _lend(self, name: str, lent: list[AnyFloats], shape: tuple[int, int]) -> AnyFloats:
        """A float64 array, noted in ``lent``, for as long as a step measures."""
        lent.append(self._store.allocate(name, shape, dtype=np.float64))
        return lent[-1]

    def _seconds(self, stage: str) -> float:
        return sum(self.timer.seconds.get((o.label, stage), 0.0) for o in self.operators)

    def _sweep(
        self, stage: Stage, name: str, work: Callable[[slice, slice, AnyFloats], Any], what: str
    ) -> Iterator[tuple[slice, slice, Any]]:
        """`Stream.sweep` of a stream that ``stage`` makes."""

        def one(detectors: slice, samples: slice) -> tuple[slice, slice, Any]:
            block = self._blocks.make(stage, detectors, samples, {}, again=False)
            return detectors, samples, work(detectors, samples, block.detdata[name])

        todo = self.layout.blocks(stage, self._store.held)
        for done, result in enumerate(in_order(one, todo, self.settings.threads), 1):
            self.settings.progress(done, len(todo), f"{self.observation.name}: {what}")
            yield result
        stage.has_been_swept()
        self._blocks.let_go()

    # ---- streams between segments

    def _advance(self, stage: Stage, later: list[Segment]) -> Source:
        """Let the segment of ``stage`` work, or put that off until its streams are read."""
        in_place = frozenset() if stage.segment.halo else stage.wanted & stage.source.streams.keys()
        new = sorted(stage.wanted - in_place)
        size, held = len(new) * self.layout.stream_size, self._store.held
        if later and new and not self.layout.keeps(stage, size, held, later):
            how, why = self.layout.where(stage, new, size, held, later, self._cost)
            if how == "again":
                self._store.clear_spare()
                found = self._probe(stage)
                names = frozenset(stage.wanted & found.detdata.keys())
                for name in sorted(names):
                    self.observation.tally.state("Execution", f"stream {name} made again when it is read", why)
                return Source({}, stage, names, dict(found.means))
            return self._pass(stage, in_memory=False)
        return self._pass(stage)

    def _cost(self, stage: Stage) -> float:
        """CPU seconds for a sample, from a small block made twice: the first may compile."""
        self._probe(stage)
        start = time.thread_time()
        block = self._probe(stage)
        return (time.thread_time() - start) / (block.shape[0] * block.shape[1])

    def _probe(self, stage: Stage) -> Block:
        """The smallest block, made before its time."""
        rows, columns = least_block(stage.span, self.layout.shape)
        return self._blocks.make(stage, slice(0, rows), slice(0, columns), {}, again=True)

    def _pass(self, stage: Stage, in_memory: bool = True) -> Source:
        """Run a segment's operators over all blocks; what it passes on is held, ``in_memory`` where there is room."""
        observation, settings, source = self.observation, self.settings, stage.source
        made: dict[str, Stream] = {}
        for name in sorted(stage.wanted):
            if name in source.streams and not stage.segment.halo:
                made[name] = source.streams[name]  # changed in place
                continue
            array = self._store.allocate(name, self.layout.shape, in_memory)
            made[name] = Stream(name, observation, array, {}, settings.threads)
            if isinstance(array, np.memmap):
                observation.tally.state("Execution", f"stream {name} spilled to disk", f"{array.nbytes / 1e9:.2f} GB")
        seen: set[str] = set()
        means: dict[str, SmoothField] = {}

        def work(detectors: slice, samples: slice) -> None:
            block = self._blocks.make(stage, detectors, samples, made, again=False)
            for name, stream in made.items():
                if name in block.detdata:
                    seen.add(name)
                    if block.detdata[name] is not block.places.get(name):
                        stream.array[block.detectors, block.samples] = block.detdata[name]
            means.update(block.means)  # the same fields in every block
            for stream in (*made.values(), *source.streams.values()):
                forget_pages(stream.array)

        what = ", ".join(o.label for o in stage.segment.operators)
        self._map(work, self.layout.blocks(stage, self._store.held), what)
        stage.has_been_swept()
        self._blocks.let_go()
        kept = {name: Stream(name, observation, s.array, means, settings.threads) for name, s in made.items() if name in seen}
        held = {id(s.array) for s in kept.values()}
        self._store.release([s.array for s in [*source.streams.values(), *made.values()] if id(s.array) not in held])
        return Source.of(kept, means)

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
