"""Runs a chain of operators over one observation, in blocks of detectors x samples inside a memory budget.

The chain is cut into segments where the coupling changes (see `Operator.couples`). A segment works through the observation
in blocks; operators that couple nothing work through a block in pieces of `TILE_DETECTORS` x `PIECE` samples, each of which
passes through all of them while it is hot in the cache. Between segments the streams that later operators need are kept in
memory, or spilled to a temporary file where they do not fit. Blocks and pieces begin at multiples of `TILE_DETECTORS` and
`TILE_SAMPLES`, so that no result depends on the budget or on the number of threads.
"""

from __future__ import annotations

import os
import tempfile
import threading
import time
from collections.abc import Callable, Collection, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from .data import Block, Data, Floats, Observation, Stream
from .errors import PipelineError
from .frozen import Frozen
from .operator import Operator
from .smooth import SmoothField
from .tiles import TILE_DETECTORS, TILE_SAMPLES

SCRATCH_STREAMS = 3
"""Block-sized arrays assumed for operators' own scratch when the budget is divided."""

PIECE = 4 * TILE_SAMPLES
"""Samples that operators without coupling see at once: 0.5 MB per float32 stream, and little time lost between calls."""


@dataclass
class Settings:
    """How to execute: threads, memory budget [bytes], stream type, whom to tell of progress, memory to use again."""

    threads: int = 1
    memory: int = 2 << 30
    dtype: type[np.floating[Any]] = np.float32
    progress: Callable[[int, int, str], None] = lambda done, total, what: None
    spare: list[Floats] = field(default_factory=list)


@dataclass
class Segment:
    """Operators that see the same blocks. ``span``: what a block must hold whole (sample: nothing).

    ``in_time_order``: blocks hold all detectors and come in order of time (`Operator.in_time_order`).
    """

    operators: list[Operator]
    span: str = "sample"
    halo: int = 0
    in_time_order: bool = False

    def split(self) -> tuple[list[Operator], list[Operator]]:
        """The first operators, which take a block in pieces, and those from the first coupled one on."""
        if self.halo:
            return [], self.operators
        coupled = [o.couples in ("detectors", "time") for o in self.operators]
        cut = coupled.index(True) if any(coupled) else len(coupled)
        return self.operators[:cut], self.operators[cut:]


def cut(operators: Sequence[Operator], observation: Observation, ordered: Collection[str] = ()) -> list[Segment]:
    """Cut a chain into segments. ``ordered``: labels of the operators that want their blocks in order of time."""
    segments = [Segment([])]
    for operator in operators:
        last = segments[-1]
        couples, halo, in_order = operator.couples, operator.halo(observation), operator.label in ordered
        if (in_order and last.span == "time") or (last.in_time_order and couples == "time"):
            segments.append(Segment([operator], couples, in_time_order=in_order))
        elif couples == "all":
            segments.append(Segment([operator]))
        elif halo > 0 and last.span != "time":  # whole scans need no halo; otherwise read the stream with margins
            segments.append(Segment([operator], halo=halo))
        elif couples in ("sample", last.span):
            last.operators.append(operator)
        elif last.span == "sample" and not last.halo:
            last.operators.append(operator)
            last.span = couples
        else:
            segments.append(Segment([operator], couples))
        segments[-1].in_time_order |= in_order
    return [s for s in segments if s.operators]


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
        self._stop = threading.Event()
        self._local = threading.local()
        self._spill: tempfile.TemporaryDirectory[str] | None = None

    def run(self, data: Data, before: Callable[..., None], after: Callable[..., None]) -> None:
        """Configure, prepare, execute and collect; on any failure operators discard what they began."""
        observation = self.observation
        try:
            for operator in self.operators:
                operator.configure(observation)
            for operator in self.operators:
                before(operator=operator, observation=observation, stage="prepare")
                self._same_use(operator.label, "prepare")
                start = time.thread_time()
                self.states[operator.label] = operator.prepare(observation)
                used = time.thread_time() - start
                self.timer.add(operator.label, "prepare", used)
                after(operator=operator, observation=observation, stage="prepare", seconds=used)
            self._same_use("", "prepared")
            self._execute(before, after)
            if self.frozen is not None:
                self.frozen.complete = True
            for operator in self.operators:
                start = time.thread_time()
                operator.collect(data, observation, self.states[operator.label])
                self.timer.add(operator.label, "collect", time.thread_time() - start)
        except BaseException:
            self._stop.set()
            for operator in self.operators:
                if operator.label in self.states:
                    with suppress(Exception):
                        operator.discard(observation, self.states[operator.label])
            raise
        finally:
            self.states.clear()
            if self._spill is not None:
                self._spill.cleanup()

    def _same_use(self, label: str, stage: str) -> None:
        """Let a run with frozen modes use the samples and detectors that the main run used at this point."""
        if self.frozen is not None:
            self.frozen.at(self.observation, label, stage)

    # ---- segments

    def _execute(self, before: Callable[..., None], after: Callable[..., None]) -> None:
        ordered = [o.label for o in self.operators if o.in_time_order(self.observation, self.states[o.label])]
        segments = cut(self.operators, self.observation, ordered)
        streams: dict[str, Stream] = {}
        for number, segment in enumerate(segments):
            last = number + 1 == len(segments)
            later = [o for s in segments[number + 1 :] for o in s.operators]
            wanted = set(self.keep) if last else set(self.keep).union(*(o.requires | o.optional for o in later))
            head = segment.operators[0]
            if head.couples == "all":
                self._measure(head, streams, before, after)
            for operator in segment.operators:
                before(operator=operator, observation=self.observation, stage="exec")
            streams = self._pass(segment, streams, wanted)
            for operator in segment.operators:
                used = self.timer.seconds.get((operator.label, "exec"), 0.0)
                after(operator=operator, observation=self.observation, stage="exec", seconds=used)
        for name in self.keep:
            if name not in streams:
                raise PipelineError(
                    f"stream {name!r} was asked to be kept, but no operator makes it", cure="keep a stream that a step provides"
                )
            stream = streams[name]
            whole = np.array(stream.array, np.float64)
            if name in stream.means:
                whole += stream.means[name].evaluate(slice(0, whole.shape[0]), slice(0, whole.shape[1]))
            self.observation.detdata[name] = whole

    def _measure(
        self, operator: Operator, streams: dict[str, Stream], before: Callable[..., None], after: Callable[..., None]
    ) -> None:
        names = sorted(operator.requires & set(streams))
        if len(names) != 1:
            raise PipelineError(
                f"{operator.label} measures a whole stream, but {len(names)} reach it", cure="it must require exactly one"
            )
        before(operator=operator, observation=self.observation, stage="measure")
        start = time.process_time()
        stream, state, frozen = streams[names[0]], self.states[operator.label], self.frozen
        if frozen is not None and frozen.complete:
            operator.measure_frozen(stream, state, frozen.found[operator.label])
        else:
            operator.measure(stream, state)
            if frozen is not None and operator.can_freeze:
                frozen.found[operator.label] = operator.freeze(state)
        self._same_use(operator.label, "measure")
        used = time.process_time() - start
        self.timer.add(operator.label, "measure", used)
        after(operator=operator, observation=self.observation, stage="measure", seconds=used)

    def _pass(self, segment: Segment, sources: dict[str, Stream], wanted: set[str]) -> dict[str, Stream]:
        """Run one segment's operators over all blocks; return the streams that are wanted later."""
        observation, settings = self.observation, self.settings
        shape = (observation.n_detectors, observation.n_samples)
        provided = set(sources).union(*(o.provides | o.optional | o.requires for o in segment.operators))
        made: dict[str, Stream] = {}
        for name in sorted(wanted & provided):
            if name in sources and not segment.halo:
                made[name] = sources[name]  # changed in place
            elif name in sources or any(name in o.provides for o in segment.operators):
                made[name] = Stream(name, observation, self._allocate(name, shape), {}, settings.threads)
        seen: set[str] = set()
        means: dict[str, SmoothField] = {}

        first, rest = segment.split()
        passed_on = set(made).union(*(o.requires | o.optional for o in rest))
        in_block = set(sources).union(passed_on, *(o.provides for o in rest)) if rest else provided
        n_streams = len((in_block & provided) - {"boresight"}) + SCRATCH_STREAMS

        def work(detectors: slice, samples: slice) -> None:
            margin = -(-segment.halo // TILE_SAMPLES) * TILE_SAMPLES
            reach = slice(max(0, samples.start - margin), min(shape[1], samples.stop + margin))
            # whole scans, and what is only taken in pieces, are worked on where they are kept
            in_place = not segment.halo and (not rest or reach == slice(0, shape[1]))
            block = self._block(detectors, reach, sources, made, in_place)
            if first:
                self._in_pieces(first, block, passed_on)
            self._exec(rest[:1], block)
            if reach != samples:
                block = _trimmed(block, samples)
            self._exec(rest[1:], block)
            for name, stream in made.items():
                if name in block.detdata:
                    seen.add(name)
                    if block.detdata[name] is not block.places.get(name):
                        stream.array[block.detectors, block.samples] = block.detdata[name]
            means.update(block.means)  # the same fields in every block

        blocks = list(self._blocks(segment, shape, n_streams))
        what = ", ".join(o.label for o in segment.operators)
        self._map(work, blocks, what)
        kept = {name: Stream(name, observation, s.array, means, settings.threads) for name, s in made.items() if name in seen}
        held = {id(s.array) for s in kept.values()}
        self._release([s.array for s in [*sources.values(), *made.values()] if id(s.array) not in held])
        return kept

    def _exec(self, operators: list[Operator], block: Block) -> None:
        for operator in operators:
            if self._stop.is_set():
                return
            start = time.thread_time()
            operator.exec(block, self.states[operator.label])
            self.timer.add(operator.label, "exec", time.thread_time() - start)

    def _block(
        self, detectors: slice, samples: slice, sources: dict[str, Stream], made: dict[str, Stream], in_place: bool
    ) -> Block:
        """A block with its sources in it: where they are kept, or copies. With margins never in place: others read them too."""
        buffers = self._local.__dict__.setdefault("blocks", {})
        block = Block(self.observation, detectors, samples, dtype=self.settings.dtype, buffers=buffers)
        if in_place:
            block.places = {name: stream.array[detectors, samples] for name, stream in made.items()}
        for name, stream in sources.items():
            if in_place:
                block.detdata[name] = block.places.get(name, stream.array[detectors, samples])
            else:
                block.detdata[name] = block.buffer(name, block.shape)
                block.detdata[name][...] = stream.array[detectors, samples]
            block.means.update(stream.means)
        return block

    def _in_pieces(self, operators: list[Operator], block: Block, passed_on: set[str]) -> None:
        """Let operators that couple nothing work on copies of parts of a block; put the streams ``passed_on`` into it."""
        given, means = dict(block.detdata), block.means
        buffers = self._local.__dict__.setdefault("pieces", {})
        for detectors, samples in _pieces(block.detectors, block.samples):
            piece = Block(block.observation, detectors, samples, means=dict(means), dtype=block.dtype, buffers=buffers)
            where = _within(block.detectors, detectors), _within(block.samples, samples)
            for name, stream in given.items():
                piece.detdata[name] = piece.buffer(name, piece.shape)
                piece.detdata[name][...] = stream[where]
            self._exec(operators, piece)
            for name in passed_on & piece.detdata.keys():
                if name not in block.detdata:
                    block.detdata[name] = block.places[name] if name in block.places else block.buffer(name, block.shape)
                block.detdata[name][where] = piece.detdata[name]
            block.means = piece.means  # the same fields in every piece

    def _allocate(self, name: str, shape: tuple[int, int]) -> Floats:
        size = shape[0] * shape[1] * np.dtype(self.settings.dtype).itemsize
        if size <= self.settings.memory // 2:
            spare = self.settings.spare
            while spare:
                array = spare.pop()
                if array.shape == shape and array.dtype == self.settings.dtype:
                    return array
            return np.empty(shape, self.settings.dtype)
        if self._spill is None:
            self._spill = tempfile.TemporaryDirectory(prefix="zonda-")
        self.observation.tally.state("Execution", f"stream {name} spilled to disk", f"{size / 1e9:.2f} GB")
        handle, path = tempfile.mkstemp(".stream", name, self._spill.name)  # a new file: the old one may still be read
        os.close(handle)
        return np.memmap(path, self.settings.dtype, "w+", shape=shape)

    def _release(self, arrays: list[Floats]) -> None:
        """Keep memory that is no longer used for the next stream: touching fresh memory costs as much as the physics."""
        for array in {id(a): a for a in arrays if not isinstance(a, np.memmap)}.values():
            self.settings.spare.append(array)

    def _blocks(self, segment: Segment, shape: tuple[int, int], n_streams: int) -> Iterator[tuple[slice, slice]]:
        span = segment.span
        n_det, n_samp = shape
        item = np.dtype(self.settings.dtype).itemsize
        share = self.settings.memory // 2 // self.settings.threads // (n_streams * item)  # samples a block may hold
        if span == "detectors":
            rows, least = n_det, n_det * min(n_samp, TILE_SAMPLES)
        else:
            rows = min(n_det, TILE_DETECTORS)
            least = rows * (n_samp if span == "time" else min(n_samp, TILE_SAMPLES))
        if least > share:
            need = 2 * least * self.settings.threads * n_streams * item
            raise PipelineError(
                f"one block of {rows} detectors needs {need / 1e6:.1f} MB, "
                f"the memory budget is {self.settings.memory / 1e6:.1f} MB",
                place=self.observation.name,
                cure=f"raise --memory to {-(-need // 1_000_000)}MB, use fewer --threads, or make the scan shorter",
            )
        if segment.in_time_order and span == "sample":
            columns = min(n_samp, PIECE, max(1, share // rows // TILE_SAMPLES) * TILE_SAMPLES)
            rows = min(n_det, max(1, share // columns // TILE_DETECTORS) * TILE_DETECTORS)
            for start in range(0, n_samp, columns):
                for first in range(0, n_det, rows):
                    yield slice(first, min(first + rows, n_det)), slice(start, min(start + columns, n_samp))
            return
        columns = n_samp if span == "time" else min(n_samp, max(1, share // rows // TILE_SAMPLES) * TILE_SAMPLES)
        for first in range(0, n_det, rows):
            for start in range(0, n_samp, columns):
                yield slice(first, min(first + rows, n_det)), slice(start, min(start + columns, n_samp))

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


def _pieces(detectors: slice, samples: slice) -> Iterator[tuple[slice, slice]]:
    """The pieces of a block, in order of time."""
    for start in range(samples.start, samples.stop, PIECE):
        for first in range(detectors.start, detectors.stop, TILE_DETECTORS):
            yield slice(first, min(first + TILE_DETECTORS, detectors.stop)), slice(start, min(start + PIECE, samples.stop))


def _within(whole: slice, part: slice) -> slice:
    """Where ``part`` lies in an array that begins where ``whole`` does."""
    return slice(part.start - whole.start, part.stop - whole.start)


def _trimmed(block: Block, samples: slice) -> Block:
    """The block without its margins."""
    inside = _within(block.samples, samples)
    detdata = {name: np.ascontiguousarray(array[:, inside]) for name, array in block.detdata.items()}
    return Block(block.observation, block.detectors, samples, detdata, block.means, block.dtype)


def available_memory() -> int:
    """Free memory of this machine in bytes (2 GB where it cannot be told)."""
    with suppress(OSError, ValueError):
        for line in Path("/proc/meminfo").read_text().splitlines():
            if line.startswith("MemAvailable:"):
                return int(line.split()[1]) * 1024
    with suppress(OSError, ValueError, AttributeError):
        return os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    return 2 << 30


def available_threads() -> int:
    """CPUs this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
