"""Runs all scans in order (`execute`): the steps over one scan, with one band or with several
together, in blocks of detectors x samples inside a memory budget (`Execution`).

The steps are cut into segments where the coupling changes (see `Operator.couples`). A segment works
through the scan in blocks; operators that couple nothing work through a block in pieces of
`TILE_DETECTORS` x `PIECE` samples, each of which passes through all of them while it is hot in the
cache. All signals are in the same block. Between segments the streams that later operators need are
kept in memory, spilled to a temporary file, or made again when they are read, as the `schedule`
says. Blocks and pieces begin at multiples of `TILE_DETECTORS` and `TILE_SAMPLES`, so that no result
depends on the budget or on the number of threads.

Bands are rows: a stream has the detectors of all bands, one band after the other. A block has
detectors of one band, counted from the band's first row, and a step is given that band's view of
the scan. Where the detectors of all bands look through the same pixels, each block is worked on
with all bands before those steps that map all bands act once. A step that measures all bands
together is given the stream of all rows; a band does then not have the bits that it has alone.

From a run to a step's `exec`: `Execution.run` takes segment after segment (`_act`), `_sweep` its
blocks, on several threads, `_on_block` the bands of a block. `BlockMaker.make` makes the block of a
band and takes step after step (`BlockMaker._exec`); `BlockMaker._act` calls ``step.exec``.
"""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from contextlib import suppress
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from ..discovery import RAISED
from ..errors import PipelineError
from ..hooks import manager
from ..log import Log
from ..machine import give_back_memory, resident_memory
from ..mapmaker import filters, joins
from ..numerics.smooth import SmoothField
from ..observation import Observation
from ..operator import Operator
from ..signal import MAIN, Formed, is_signal
from ..stream import Stream, forget_pages, in_order
from ..types import AnyFloats
from .block_maker import BlockMaker, Due
from .budget import divide, memory_of
from .means import MeansOfBands, WholeStream, knows_means, means_of
from .schedule import Schedule, schedule
from .segments import Segment, Source, least_block, pieces
from .settings import Ahead, Settings, Timer
from .streams import Store, StreamMadeAgain
from .views import Band, View


def execute(bands: Sequence[Band], settings: Settings, timer: Timer) -> None:
    """Run all scans in order; the next one is prepared while one is executed."""
    hooks = manager().hook.zonda_before_operator, manager().hook.zonda_after_operator
    # a plugin that listens is told of one observation after the other
    heard = any(hook.get_hookimpls() for hook in hooks)
    several = len(bands) + len(bands[0].data.observations) > 2
    ahead = Ahead(settings.threads > 1 and several and not heard)
    groups = divide(bands, settings, ahead)
    turns = [
        (these, Execution([View(b.chain, b.data.observations[k], b.data) for b in these], own,
                          timer, *hooks))
        for k in range(len(bands[0].data.observations))
        for these, own in groups
    ]  # fmt: skip
    following = [*(execution for _, execution in turns[1:]), None]
    try:
        for (these, execution), after in zip(turns, following, strict=True):
            execution.run(ahead, after)
            for band, view in zip(these, execution.views, strict=True):
                band.data.log.update(view.observation.log)
                if band is bands[-1] and view.observation.common is not None:
                    view.observation.common.clear()  # the last that may need it
                band.watch("scan")
    finally:
        ahead.close()
        for _, own in groups:
            own.spare.clear()
        give_back_memory()


ELSEWHERE = "samples flagged as those of another band are: nothing is measured there"
"""A count of the log."""


class Execution:
    """The steps at work on one scan.

    Parameters
    ----------
    views
        The bands that are executed together.
    before, after
        Called before and after each stage of a step, with ``operator``, ``observation``, ``stage``
        (and ``seconds``).
    """

    def __init__(
        self,
        views: Sequence[View],
        settings: Settings,
        timer: Timer,
        before: Callable[..., None] = lambda **what: None,
        after: Callable[..., None] = lambda **what: None,
    ) -> None:
        self.views = views
        self.settings = settings
        self.timer = timer
        self._before = before
        self._after = after
        self.beforehand: Future[None] | None = None
        self.schedule: Schedule
        self._makers: list[BlockMaker] = []
        self._ahead = Ahead(False)
        self._stop = threading.Event()
        self._store = Store(settings)
        self._made: dict[str, AnyFloats] = {}
        """Arrays of the streams that the segment at work passes on."""
        self._source = Source()
        self._begun = list[tuple[Operator, Observation]]()
        self._first = views[0].observation
        row = 0
        for number, view in enumerate(views):
            view.number, view.rows = number, slice(row, row + view.shape[0])
            row = view.rows.stop

    def run(self, ahead: Ahead | None = None, following: Execution | None = None) -> None:
        """Configure, prepare, execute and collect; on any failure operators discard what they
        began.

        ``following``: what ``ahead`` may prepare meanwhile.
        """
        try:
            self._ahead = ahead or self._ahead
            if self.beforehand is not None:
                self.beforehand.result()
            else:
                self.prepare()
            self._begin()
            self._ahead.start(following)
            for segment in self.schedule.segments:
                head = segment.operators[0]
                if head.couples == "all":
                    joined = [self.views] if joins(head) else [[view] for view in self.views]
                    for views in joined:
                        self._measure(views, head.label)
                self._act(segment)
            self._keep()
            for view in self.views:
                for operator in view.chain.steps:
                    start = time.thread_time()
                    state = view.states[operator.label]
                    operator.collect(view.data, view.observation, state)  # type: ignore[arg-type]
                    self.timer.add(operator.label, "collect", time.thread_time() - start)
        except BaseException:
            self.abandon()
            raise
        finally:
            self._close()

    def prepare(self) -> None:
        """Configure and prepare all steps; perhaps while another scan is executed (`Ahead`)."""
        for view in self.views:
            for operator in view.chain.steps:
                operator.configure(view.observation)
            for operator in view.chain.steps:
                if self._stop.is_set():
                    return
                self._before(operator=operator, observation=view.observation, stage="prepare")
                start = time.thread_time()
                view.states[operator.label] = operator.prepare(view.observation)
                self._tell(view, operator, "prepare", time.thread_time() - start)

    def abandon(self) -> None:
        """Stop; let operators discard what they began."""
        self._stop.set()
        if self.beforehand is not None:
            self.beforehand.cancel()
            wait([self.beforehand])
        for view in self.views:
            for operator in view.chain.steps:
                if operator.label in view.states:
                    with suppress(*RAISED):
                        operator.discard(view.observation, view.states[operator.label])
            view.states.clear()

    def _close(self) -> None:
        """Release what the scan took."""
        self._store.close()
        for view in self.views:
            view.states.clear()
            view.measured.clear()
            for smooth in view.observation.smooth.values():
                if isinstance(smooth, SmoothField):
                    smooth.forget()

    def _tell(self, view: View, operator: Operator, stage: str, used: float) -> None:
        """Note CPU seconds and call the hooks."""
        self.timer.add(operator.label, stage, used)
        self._after(operator=operator, observation=view.observation, stage=stage, seconds=used)

    # ---- the schedule

    def _begin(self) -> None:
        """Make the schedule, with the memory that there is now: what operators hold is known."""
        self.settings = settings = self._within_process()
        self._store = Store(settings)
        self.schedule = schedule(self.views, settings)
        stopped = self._stop.is_set
        self._makers = [BlockMaker(view, self.schedule, self.timer, stopped) for view in self.views]

    def _within_process(self) -> Settings:
        """Lessen the memory of streams and blocks where operators took more than they said, and
        the threads where the smallest blocks would not fit.
        """
        settings = self.settings
        if settings.process is None:
            return settings
        taken = resident_memory() - sum(array.nbytes for array in settings.spare)
        room = max(
            settings.process - taken - memory_of(self.views, settings.threads, products=True),
            1,
        )
        threads = settings.threads
        if room >= settings.memory:
            return settings
        least = schedule(self.views, settings).least
        if room < least:
            threads = max(1, threads * room // least)
            room = max(room, least * threads // settings.threads)
        return replace(settings, memory=room, threads=threads)

    # ---- segments

    def _act(self, segment: Segment) -> None:
        """Let a segment act on all blocks, or note that its streams are made again when they are
        read.
        """
        segment.source = self._source
        steps = [(o, view.observation) for view in self.views for o in segment.operators]
        for operator, observation in steps:
            self._before(operator=operator, observation=observation, stage="exec")
        self._begun += steps
        if segment.how == "again":
            self._source = self._made_again(segment)
            return
        self._source = self._worked_through(segment)
        for operator, observation in self._begun:
            used = self.timer.seconds.get((operator.label, "exec"), 0.0)
            self._after(operator=operator, observation=observation, stage="exec", seconds=used)
        self._begun.clear()

    def _made_again(self, segment: Segment) -> Source:
        """The streams of a segment that is not carried out, with the means of its smallest
        blocks.
        """
        self._store.clear_spare()
        found = Source(segment=segment)
        for view, maker in zip(self.views, self._makers, strict=True):
            rows, columns = least_block(segment.whole, view.shape)
            block = maker.make(segment, slice(0, rows), slice(0, columns), {}, again=True)
            found.names = frozenset(segment.wanted & block.detdata.keys())
            found.means[view.number] = dict(block.means)
            for name in sorted(found.names):
                what = f"stream {name} made again when it is read"
                view.observation.log.state("Execution", what, segment.why)
        return found

    def _worked_through(self, segment: Segment) -> Source:
        """The streams that a segment passes on, once it has worked on all blocks."""
        before = segment.source.arrays
        self._made = self._room_for(segment)
        found = Source(means={view.number: {} for view in self.views})
        working = (o for o in segment.operators if type(o).exec is not Operator.exec)
        labels = ", ".join(o.label for o in working)
        together = self.schedule.at_once > 1
        for views in [self.views] if together else [[view] for view in self.views]:
            scan = self._first.name_of_all_bands if together else views[0].observation.name
            self._sweep(segment, views, found, f"{scan}: {labels}")
        segment.has_been_swept(self.views)
        for maker in self._makers:
            maker.release()
        found.names, held = frozenset(found.arrays), set(map(id, found.arrays.values()))
        every = (*before.values(), *self._made.values())
        self._store.release([a for a in every if id(a) not in held])
        self._made = {}
        return found

    def _room_for(self, segment: Segment) -> dict[str, AnyFloats]:
        """Arrays for the streams that a segment passes on: new ones, or those that it changes in
        place.
        """
        before = segment.source.arrays
        made = dict[str, AnyFloats]()
        for name in sorted(segment.wanted):
            if name in before and not segment.halo:
                made[name] = before[name]
                continue
            shape = self.views[-1].rows.stop, self._first.n_samples
            made[name] = self._store.allocate(name, shape, segment.how == "kept")
            if isinstance(made[name], np.memmap):
                for view in self.views:
                    what = f"stream {name} spilled to disk"
                    size = f"{made[name][view.rows].nbytes / 1e9:.2f} GB"
                    view.observation.log.state("Execution", what, size)
        return made

    def _sweep(self, segment: Segment, views: Sequence[View], found: Source, what: str) -> None:
        """Work on every block, on several threads; the first error stops all of them."""
        settings, stop, failed = self.settings, self._stop.set, list[BaseException]()
        blocks = self.schedule.blocks(segment, views[0])

        def one(detectors: slice, samples: slice) -> None:
            try:
                self._on_block(segment, views, found, detectors, samples)
            except BaseException as error:
                # StopIteration too, which a generator would turn into RuntimeError
                failed.append(error)
                stop()

        for done, _ in enumerate(in_order(one, blocks, settings.threads, stop), 1):
            if failed:
                raise failed[0]
            settings.progress(done, len(blocks), what)

    def _on_block(
        self,
        segment: Segment,
        views: Sequence[View],
        found: Source,
        detectors: slice,
        samples: slice,
    ) -> None:
        """Work on a block of a band; or on one of several, piece by piece unless a step needs all
        of it, and let the steps that map all bands act once.
        """
        if len(views) == 1:
            self._of_band(segment, views[0], found, detectors, samples, None)
            return
        whole = segment.split()[1]
        for part in [(detectors, samples)] if whole else pieces(detectors, samples):
            every: list[list[Due]] = [[] for _ in views]
            for view, due in zip(views, every, strict=True):
                self._of_band(segment, view, found, *part, due)
            for together in zip(*every, strict=True):
                step = together[0].step
                start = time.thread_time()
                step.exec_bands([due.block for due in together], [due.state for due in together])
                self.timer.add(step.label, "exec", time.thread_time() - start)

    def _of_band(
        self,
        segment: Segment,
        view: View,
        found: Source,
        detectors: slice,
        samples: slice,
        due: list[Due] | None,
    ) -> None:
        """Let the steps act on a block of one band, and put what it passes on into ``found``."""
        made = self._made
        maker = self._makers[view.number]
        block = maker.make(segment, detectors, samples, made, again=False, due=due)
        for name in made.keys() & block.detdata.keys():
            found.arrays[name] = made[name]
            if block.detdata[name] is not block.places.get(name):
                made[name][view.rows][detectors, samples] = block.detdata[name]
        found.means[view.number].update(block.means)  # the same fields in every block
        for array in (*made.values(), *segment.source.arrays.values()):
            forget_pages(array)

    def _keep(self) -> None:
        """Keep the streams that the user asked for, and the means that stand beside them."""
        for name in self.views[0].chain.keep:
            if name not in self._source.arrays:
                raise PipelineError(
                    f"stream {name!r} was asked to be kept, but no operator makes it",
                    cure="keep a stream that a step provides",
                )
            for view in self.views:
                array = self._source.arrays[name][view.rows]
                means = self._source.means[view.number]
                view.observation.detdata.parts[name] = np.array(array), means.get(name)
                forget_pages(array)

    # ---- steps that measure whole streams

    def _measure(self, views: Sequence[View], label: str) -> None:
        """Let a filter measure each signal, the complete one first; let another step measure the
        one stream that it requires. Several bands are measured as one, of all their detectors.
        """
        step = next(o for o in views[0].chain.steps if o.label == label)
        for view in views:
            self._before(operator=step, observation=view.observation, stage="measure")
        used = 0.0
        model = None
        for signal in self._measured_by(step):
            lent: list[AnyFloats] = []
            stream = self._stream(views, step, signal, lent)
            start = self._without_blocks()
            found = step.measure(stream, model if signal.takes_model(label) else None)
            used += self._without_blocks() - start
            self._store.drop(lent)
            model = found if signal.stream == MAIN else model
            for view, rows in zip(views, _rows_of(views), strict=True):
                joined: Any = step
                own = joined.of_rows(found, rows) if len(views) > 1 else found
                view.measured[label, signal.stream] = own
            if len(views) > 1 and signal.stream == stream.name:
                self._note(views, label, stream.observation)
        for view in views:
            self._tell(view, step, "measure", used if view is views[0] else 0.0)

    def _measured_by(self, step: Operator) -> list[Formed]:
        """The signals, or the one stream, that a step measures."""
        here = self._source.names
        signals = self.schedule.chain.signals
        names = sorted(step.requires & here)
        if len(names) != 1:
            raise PipelineError(
                f"{step.label} measures a whole stream, but {len(names)} reach it",
                cure="it must require exactly one",
            )
        if filters(step):
            return [s for s in signals if s.filtered and s.stream in here]
        return [signals[0] if names == [MAIN] else Formed(names[0], frozenset())]

    def _stream(
        self,
        views: Sequence[View],
        step: Operator,
        signal: Formed,
        lent: list[AnyFloats],
    ) -> Stream:
        """A stream for a step that measures: under the name that it knows, with its own mean
        alone. ``lent`` takes the arrays that are to be given back.
        """
        source = self._source
        settings = self.settings
        held = signal.stream
        name = MAIN if is_signal(held) else held
        observation = views[0].observation
        means = dict(source.means[views[0].number])
        if name == MAIN:
            means = {MAIN: means[held]} if held in means else {}
        if len(views) > 1:
            every = [source.means[view.number].get(held) for view in views]
            observation = Observation.of_bands([view.observation for view in views])
            means = {}
            if any(mean is not None for mean in every):
                joined: Any = MeansOfBands(list(zip(every, _rows_of(views), strict=True)))
                means[name] = joined
        elif held != name:  # what is found out of it is not the scene's
            observation = copy.copy(observation)
            observation.log = Log()
            observation.flags = observation.flags.copy()
            observation.detector_flags = observation.detector_flags.copy()
        if source.segment is not None:
            sweeper = partial(
                self._make_again,
                views,
                source.segment,
                signal,
                f"{step.label} measures {name}",
            )
            stream: Stream = StreamMadeAgain(
                name,
                observation,
                means,
                settings.threads,
                settings.dtype,
                sweeper,
            )
        else:
            room = max(settings.memory - self._store.held, 0)
            array = source.arrays[held][views[0].rows.start : views[-1].rows.stop]
            stream = Stream(name, observation, array, means, settings.threads, room)
        if not knows_means(step) and (fields := means_of(observation, means, frozenset({name}))):

            def lend(shape: tuple[int, int]) -> AnyFloats:
                lent.append(self._store.allocate(name, shape, dtype=np.float64))
                return lent[-1]

            stream = WholeStream(stream, fields[name], lend)
        stream.signal, stream.components = held, signal.components
        states = [view.states[step.label] for view in views]
        stream.state, stream.states = states[0], states if len(states) > 1 else ()
        return stream

    def _make_again(
        self,
        views: Sequence[View],
        segment: Segment,
        signal: Formed,
        what: str,
        work: Callable[[slice, slice, AnyFloats], Any],
    ) -> Iterator[tuple[slice, slice, Any]]:
        """`Stream.sweep` of a stream that ``segment`` makes."""
        swept = {view.number for view in views} <= segment.swept
        signals = [signal] if swept and signal in self.schedule.chain.signals else None

        def one(
            view: View,
            first: int,
            detectors: slice,
            samples: slice,
        ) -> tuple[slice, slice, Any]:
            maker = self._makers[view.number]
            block = maker.make(segment, detectors, samples, {}, again=False, signals=signals)
            rows = slice(first + detectors.start, first + detectors.stop)
            return rows, samples, work(rows, samples, block.detdata[signal.stream])

        todo = [
            (view, rows.start, *block)
            for view, rows in zip(views, _rows_of(views), strict=True)
            for block in self.schedule.blocks(segment, view)
        ]
        scan = self._first.name_of_all_bands if len(views) > 1 else views[0].observation.name
        for done, result in enumerate(in_order(one, todo, self.settings.threads), 1):
            self.settings.progress(done, len(todo), f"{scan}: {what}")
            yield result
        segment.has_been_swept(views)
        for maker in self._makers:
            maker.release()

    def _without_blocks(self) -> float:
        """CPU seconds of this process, without those of blocks (a stream made again is made of
        them) and of the scan ahead.
        """
        return time.process_time() - self.timer.of_stage("exec") - self._ahead.seconds()

    def _note(self, views: Sequence[View], label: str, whole: Observation) -> None:
        """Note flags of the scan of all bands in each band, and its log in the first."""
        views[0].observation.log.update(whole.log)
        for view, rows in zip(views, _rows_of(views), strict=True):
            own = view.observation
            own.detector_flags |= whole.detector_flags[rows]
            elsewhere = own.good_samples & ~whole.good_samples
            own.log.count(label, ELSEWHERE, int(elsewhere.sum()), elsewhere.size)
            own.flags |= whole.flags


def _rows_of(views: Sequence[View]) -> list[slice]:
    """Rows of bands in a stream of these bands alone."""
    start = views[0].rows.start
    return [slice(view.rows.start - start, view.rows.stop - start) for view in views]
