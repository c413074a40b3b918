"""Runs a chain of operators over one observation, in blocks of detectors x samples inside a memory
budget.

The chain is cut into segments where the coupling changes (see `Operator.couples`). A segment works
through the observation in blocks; operators that couple nothing work through a block in pieces of
`TILE_DETECTORS` x `PIECE` samples, each of which passes through all of them while it is hot in the
cache. All signals are in the same block. Between segments the streams that later operators need are
kept in memory, spilled to a temporary file, or made again when they are read, as the `schedule`
says. Blocks and pieces begin at multiples of `TILE_DETECTORS` and `TILE_SAMPLES`, so that no result
depends on the budget or on the number of threads.
"""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from concurrent.futures import Future, wait
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

import numpy as np

from ..block import Block
from ..data import Data
from ..discovery import RAISED
from ..errors import PipelineError
from ..machine import resident_memory
from ..mapmaker import filters
from ..numerics.chunks import TILE_DETECTORS, empty
from ..numerics.smooth import SmoothField
from ..observation import Observation
from ..operator import Operator
from ..signal import MAIN, Formed, is_signal
from ..stream import Stream, forget_pages, in_order
from ..tally import Tally
from ..types import AnyFloats
from .block_maker import BlockMaker, Due, Measured
from .budget import products_of
from .means import WholeStream, knows_means, means_of
from .prefetch import Ahead
from .schedule import Chain, Planned, Schedule, ordered_in, schedule
from .segments import least_block
from .settings import Settings, Timer
from .streams import Ledger, Source, Stage, Store, StreamMadeAgain


class Execution:
    """One chain of steps over one observation.

    Parameters
    ----------
    before, after
        Called before and after each stage of a step, with ``operator``, ``observation``, ``stage``
        (and ``seconds``).
    """

    def __init__(
        self,
        chain: Chain,
        observation: Observation,
        settings: Settings,
        timer: Timer,
        before: Callable[..., None] = lambda **what: None,
        after: Callable[..., None] = lambda **what: None,
    ) -> None:
        self.chain, self.observation, self.settings, self.timer = (
            chain,
            observation,
            settings,
            timer,
        )
        self._before, self._after = before, after
        self.states: dict[str, Any] = {}
        self.measured: Measured = {}
        self.beforehand: Future[None] | None = None
        self.schedule: Schedule
        self.ledger = Ledger()
        self._ahead = Ahead(False)
        self._stop = threading.Event()
        self._store = Store(settings.memory, settings.dtype, settings.spare, self.ledger)
        self._source, self._begun = Source(), list[Operator]()

    def begin(self, bands: int, ordered: Collection[str], halos: Mapping[str, int]) -> None:
        """Make the schedule, with the memory that there is now: what operators hold is known.

        Parameters
        ----------
        bands
            Number of those that hold streams and blocks at the same time.
        ordered, halos
            See `segments.cut`.
        """
        self.settings = self._within_process(bands)
        self._store = Store(
            self.settings.memory, self.settings.dtype, self.settings.spare, self.ledger
        )
        self.schedule = Schedule(self.chain, self.observation, self.settings)
        stopped = self._stop.is_set
        self.blocks = BlockMaker(
            self.schedule, self.states, self.measured, self.timer, self.ledger, stopped
        )
        self.schedule.make(ordered, halos)

    def collect(self, data: Data) -> None:
        """Let all steps hand over what they added up."""
        for operator in self.chain.steps:
            start = time.thread_time()
            operator.collect(data, self.observation, self.states[operator.label])
            self.timer.add(operator.label, "collect", time.thread_time() - start)

    def close(self) -> None:
        """Release what the observation took."""
        self.states.clear()
        self.measured.clear()
        self._store.close()
        for smooth in self.observation.smooth.values():
            if isinstance(smooth, SmoothField):
                smooth.forget()

    def ready(self, ahead: Ahead | None) -> None:
        """Configure and prepare all steps, unless ``ahead`` did so beforehand."""
        self._ahead = ahead or self._ahead
        if self.beforehand is not None:
            self.beforehand.result()
        else:
            self.prepare()

    def prepare(self) -> None:
        """Configure and prepare all steps; perhaps while another observation is executed
        (`prefetch`).
        """
        for operator in self.chain.steps:
            operator.configure(self.observation)
        for operator in self.chain.steps:
            if self._stop.is_set():
                return
            self._before(operator=operator, observation=self.observation, stage="prepare")
            start = time.thread_time()
            self.states[operator.label] = operator.prepare(self.observation)
            self.tell(operator, "prepare", time.thread_time() - start)

    def abandon(self) -> None:
        """Stop; let operators discard what they began."""
        self._stop.set()
        if self.beforehand is not None:
            self.beforehand.cancel()
            wait([self.beforehand])
        for operator in self.chain.steps:
            if operator.label in self.states:
                with suppress(*RAISED):
                    operator.discard(self.observation, self.states[operator.label])
        self.states.clear()

    def tell(self, operator: Operator, stage: str, used: float) -> None:
        """Note CPU seconds and call the hooks."""
        self.timer.add(operator.label, stage, used)
        self._after(operator=operator, observation=self.observation, stage=stage, seconds=used)

    # ---- the schedule

    @property
    def ordered(self) -> list[str]:
        """Labels of the steps that are much cheaper in order of time."""
        return ordered_in(self.chain.steps, self.observation)

    def _within_process(self, bands: int) -> Settings:
        """Lessen the memory of streams and blocks where operators took more than they said, and
        the threads where the smallest blocks would not fit.
        """
        settings = self.settings
        if settings.process is None:
            return settings
        taken = resident_memory() - sum(array.nbytes for array in settings.spare)
        to_come = products_of(self.chain, self.observation)
        room = max((settings.process - taken) // bands - to_come, 1)
        threads = settings.threads
        if room >= settings.memory:
            return settings
        least = schedule(self.chain, self.observation, settings).least
        if room < least:
            threads = max(1, threads * room // least)
            room = max(room, least * threads // settings.threads)
        return replace(settings, memory=room, threads=threads)

    def _probe(self, stage: Stage) -> Block:
        """The smallest block, made before its time."""
        rows, columns = least_block(stage.span, self.schedule.shape)
        return self.blocks.make(stage, slice(0, rows), slice(0, columns), {}, again=True)

    # ---- segments

    def start(self, number: int) -> Pass | None:
        """Let a segment begin: its work on blocks, or None where its streams are made again when
        they are read.
        """
        planned = self.schedule.planned[number]
        stage = Stage(planned.segment, self._source, planned.wanted)
        for operator in planned.segment.operators:
            self._before(operator=operator, observation=self.observation, stage="exec")
        self._begun += planned.segment.operators
        if planned.how != "again":
            return Pass.of(self, planned, stage)
        self._store.clear_spare()
        found = self._probe(stage)
        names = frozenset(stage.wanted & found.detdata.keys())
        for name in sorted(names):
            self.observation.tally.state(
                "Execution", f"stream {name} made again when it is read", planned.why
            )
        self._source = Source({}, stage, names, dict(found.means))
        return None

    def passed(self, source: Source) -> None:
        """Note the streams that a segment has left, and that its steps are through."""
        self._source = source
        for operator in self._begun:
            used = self.timer.seconds.get((operator.label, "exec"), 0.0)
            self._after(operator=operator, observation=self.observation, stage="exec", seconds=used)
        self._begun.clear()

    def stop(self) -> None:
        """Let blocks that are being worked on end: they are of no use any more."""
        self._stop.set()

    def keep(self) -> None:
        """Keep the streams that the user asked for."""
        for name in self.chain.keep:
            if name not in self._source.streams:
                raise PipelineError(
                    f"stream {name!r} was asked to be kept, but no operator makes it",
                    cure="keep a stream that a step provides",
                )
            self.observation.detdata[name] = self._whole(self._source.streams[name])

    def _whole(self, stream: Stream) -> AnyFloats:
        """A whole stream with its mean, float64; a few detectors at a time, so that nothing of its
        size is made besides.
        """
        whole = empty(self.schedule.shape, np.float64)
        for first in range(0, len(whole), TILE_DETECTORS):
            rows = slice(first, min(first + TILE_DETECTORS, len(whole)))
            whole[rows] = stream.array[rows]
            if stream.name in stream.means:
                whole[rows] += stream.means[stream.name].evaluate(rows, slice(0, whole.shape[1]))
            forget_pages(stream.array)
        return whole

    # ---- steps that measure whole streams

    def measure(self, operator: Operator) -> None:
        """Let a filter measure each signal, the complete one first; let another step measure the
        one stream that it requires.
        """
        used = 0.0
        for signal in self.measured_by(operator):
            with self.stream(operator, signal) as stream:
                start = self.without_blocks()
                model = (
                    self.measured.get((operator.label, MAIN))
                    if signal.takes_model(operator.label)
                    else None
                )
                self.measured[operator.label, signal.stream] = operator.measure(stream, model)
                used += self.without_blocks() - start
        self.tell(operator, "measure", used)

    def measured_by(self, operator: Operator) -> list[Formed]:
        """The signals, or the one stream, that a step measures."""
        names = sorted(operator.requires & self._source.names)
        if len(names) != 1:
            raise PipelineError(
                f"{operator.label} measures a whole stream, but {len(names)} reach it",
                cure="it must require exactly one",
            )
        self._before(operator=operator, observation=self.observation, stage="measure")
        if filters(operator):
            here = self._source.names
            return [s for s in self.chain.signals if s.filtered and s.stream in here]
        return [self.chain.signals[0] if names == [MAIN] else Formed(names[0], frozenset())]

    @contextmanager
    def stream(self, operator: Operator, signal: Formed) -> Iterator[Stream]:
        """A stream for a step that measures: under the name that it knows, with its own mean
        alone.
        """
        lent: list[AnyFloats] = []
        yield self._stream(operator, signal, lent)
        self._store.drop(lent)

    def _stream(self, operator: Operator, signal: Formed, lent: list[AnyFloats]) -> Stream:
        source = self._source
        held, name = signal.stream, MAIN if is_signal(signal.stream) else signal.stream
        observation, threads, means = self.observation, self.settings.threads, dict(source.means)
        if name == MAIN:
            means = {MAIN: source.means[held]} if held in source.means else {}
        if held != name:  # what is found out of it is not the scene's
            observation = copy.copy(observation)
            observation.tally = Tally()
            observation.flags, observation.detector_flags = (
                observation.flags.copy(),
                observation.detector_flags.copy(),
            )
        if source.stage is not None:
            sweeper = partial(
                self._sweep, source.stage, signal, f"{operator.label} measures {name}"
            )
            stream: Stream = StreamMadeAgain(
                name, observation, means, threads, self.settings.dtype, sweeper
            )
        else:
            room = max(self.settings.memory - self._store.held, 0)
            stream = Stream(name, observation, source.streams[held].array, means, threads, room)
        if not knows_means(operator) and (
            fields := means_of(observation, means, frozenset({name}))
        ):
            stream = WholeStream(stream, fields[name], partial(self._lend, name, lent))
        stream.signal, stream.components, stream.state = (
            held,
            signal.components,
            self.states[operator.label],
        )
        return stream

    def _lend(self, name: str, lent: list[AnyFloats], shape: tuple[int, int]) -> AnyFloats:
        """A float64 array, noted in ``lent``, for as long as a step measures."""
        lent.append(self._store.allocate(name, shape, dtype=np.float64))
        return lent[-1]

    def without_blocks(self) -> float:
        """CPU seconds of this process, without those of blocks (a stream made again is made of
        them) and of the scan ahead.
        """
        return time.process_time() - self.timer.of_stage("exec") - self._ahead.seconds()

    def _sweep(
        self,
        stage: Stage,
        signal: Formed,
        what: str,
        work: Callable[[slice, slice, AnyFloats], Any],
    ) -> Iterator[tuple[slice, slice, Any]]:
        """`Stream.sweep` of a stream that ``stage`` makes."""
        signals: Sequence[Formed] | None = (
            [signal] if stage.swept and signal in self.chain.signals else None
        )

        def one(detectors: slice, samples: slice) -> tuple[slice, slice, Any]:
            block = self.blocks.make(stage, detectors, samples, {}, again=False, signals=signals)
            return detectors, samples, work(detectors, samples, block.detdata[signal.stream])

        todo = self.schedule.blocks(Planned(stage))
        for done, result in enumerate(in_order(one, todo, self.settings.threads), 1):
            self.settings.progress(done, len(todo), f"{self.observation.name}: {what}")
            yield result
        stage.has_been_swept()
        self.blocks.release()


@dataclass
class Pass:
    """Work of one observation's segment on all blocks.

    Attributes
    ----------
    made
        The streams that it holds, by name.
    """

    execution: Execution
    planned: Planned
    stage: Stage
    made: dict[str, Stream]
    seen: set[str] = field(default_factory=set)
    means: dict[str, SmoothField] = field(default_factory=dict)

    @classmethod
    def of(cls, execution: Execution, planned: Planned, stage: Stage) -> Pass:
        """Room for the streams that a segment passes on."""
        made: dict[str, Stream] = {}
        observation, settings = execution.observation, execution.settings
        for name in sorted(stage.wanted):
            if name in stage.source.streams and not stage.segment.halo:
                made[name] = stage.source.streams[name]  # changed in place
                continue
            array = execution._store.allocate(name, execution.schedule.shape, planned.how == "kept")
            made[name] = Stream(name, observation, array, {}, settings.threads)
            if isinstance(array, np.memmap):
                observation.tally.state(
                    "Execution", f"stream {name} spilled to disk", f"{array.nbytes / 1e9:.2f} GB"
                )
        return cls(execution, planned, stage, made)

    @cached_property
    def blocks(self) -> list[tuple[slice, slice]]:
        """Detectors and samples of the blocks."""
        return self.execution.schedule.blocks(self.planned)

    def shares_blocks(self, other: Pass) -> bool:
        """Tell whether the blocks are those of another band that looks through the same pixels."""
        one, two = self.execution.observation, other.execution.observation
        return one is two or (one.looks_as(two) and self.blocks == other.blocks)

    def work(self, detectors: slice, samples: slice, due: list[Due] | None = None) -> None:
        """Work on a block; ``due`` as in `BlockMaker.make`."""
        block = self.execution.blocks.make(
            self.stage, detectors, samples, self.made, again=False, due=due
        )
        for name, stream in self.made.items():
            if name in block.detdata:
                self.seen.add(name)
                if block.detdata[name] is not block.places.get(name):
                    stream.array[block.detectors, block.samples] = block.detdata[name]
        self.means.update(block.means)  # the same fields in every block
        for stream in (*self.made.values(), *self.stage.source.streams.values()):
            forget_pages(stream.array)

    def end(self) -> None:
        """Hold the streams that were made; release the others."""
        execution, source = self.execution, self.stage.source
        self.stage.has_been_swept()
        execution.blocks.release()
        kept = {
            name: Stream(name, s.observation, s.array, self.means, execution.settings.threads)
            for name, s in self.made.items()
            if name in self.seen
        }
        held = {id(s.array) for s in kept.values()}
        execution._store.release(
            [
                s.array
                for s in [*source.streams.values(), *self.made.values()]
                if id(s.array) not in held
            ]
        )
        execution.passed(Source.of(kept, self.means))
