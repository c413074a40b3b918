"""Makes the blocks of one observation: a segment's steps, carried out on a rectangle of detectors x
samples.

A step acts on a block in one of four ways: it forms every signal of its components; it filters each
signal, as if that were the only one; it maps all of them (`core.mapmaker`); or it makes or reads
components, and of the signals sees the complete one.
"""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from ..block import Block
from ..errors import PipelineError
from ..faults import whose
from ..kernels import kernel
from ..log import Log
from ..mapmaker import MapMaker, filters, forms
from ..numerics.chunks import TILE_SAMPLES
from ..operator import Operator
from ..signal import Formed, is_stream
from ..types import AnyFloats
from .means import knows_means, means_of, names_of, take_whole, whole_block
from .schedule import Schedule
from .segments import Segment, pieces, trimmed, within
from .settings import Timer
from .views import View


class Due(NamedTuple):
    """A map maker that is to act on a block together with those of the other bands."""

    step: Operator
    block: Block
    state: Any


class BlockMaker:
    """Works on the blocks of one band, from several threads at once.

    Parameters
    ----------
    stopped
        True: what is made is of no use any more.
    """

    def __init__(
        self,
        view: View,
        schedule: Schedule,
        timer: Timer,
        stopped: Callable[[], bool],
    ) -> None:
        self._chain = chain = schedule.chain
        self._view = view
        self._observation = view.observation
        self._dtype = schedule.settings.dtype
        self._streams = schedule.streams
        self._schedule = schedule
        self._timer = timer
        self._stopped = stopped
        # the attributes of a step are slow to look up, and each piece needs them
        own = ((o, o.label) for o in view.chain.steps)
        self._own = {id(o): mine for o, mine in zip(chain.steps, own, strict=True)}
        self._labels = {id(step): label for step, label in self._own.values()}
        acting = [o for o in chain.steps if type(o).exec is not Operator.exec]
        self._declared = {
            o.label: names_of(o, self._observation.signals) for o in acting if not knows_means(o)
        }
        self._due: dict[str, frozenset[str]] = {}
        """By label: streams that a step must have made, for a later one requires them."""
        required = frozenset[str]()
        for step in reversed(chain.steps):
            self._due[step.label] = frozenset(n for n in step.provides & required if is_stream(n))
            required |= step.requires if step in acting else frozenset()
        self._joining = {
            id(o) for o in acting if isinstance(o, MapMaker) and o.all_bands and knows_means(o)
        }
        """Map makers that act on the blocks of all bands at once."""
        # an unfiltered signal may be finite where a filter has spoilt the others
        self._masks_maps = not all(signal.filtered for signal in chain.signals)
        self._local = threading.local()
        self._apart = frozenset(s.stream for s in schedule.made_again)
        """Streams of the signals that are made again where they are mapped."""
        self._unfiltered = Segment(chain.needed_for(schedule.made_again, filtered=False))
        self._unfiltered.wanted = self._apart

    def release(self) -> None:
        """Forget the blocks: their threads have ended."""
        self._local = threading.local()

    def make(
        self,
        segment: Segment,
        detectors: slice,
        samples: slice,
        made: dict[str, AnyFloats],
        *,
        again: bool,
        signals: Sequence[Formed] | None = None,
        due: list[Due] | None = None,
    ) -> Block:
        """A block with the segment's steps, and those that make its streams again, carried out.

        Parameters
        ----------
        signals
            Those that are of use in it; None: all that are not made again where they are mapped.
        due
            Takes the map makers at the segment's end that act on all bands at once; they do not
            act here. None: all steps act. The block is then one piece, or the segment has a step
            that needs more (`segments.Segment.split`).
        """
        again = again or self._view.number in segment.swept
        if signals is None:
            signals = [s for s in self._chain.signals if s.stream not in self._apart]
        n_samples = self._observation.n_samples
        margin = -(-segment.halo // TILE_SAMPLES) * TILE_SAMPLES
        reach = slice(max(0, samples.start - margin), min(n_samples, samples.stop + margin))
        first, rest = segment.split()
        # whole scans, and what is only taken in pieces, are worked on where they are kept
        in_place = bool(made) and not segment.halo and (not rest or reach == slice(0, n_samples))
        passed_on = set(segment.wanted).union(
            *(self._chain.expanded(o.requires | o.optional) for o in rest)
        )
        if again:
            of_use = self._of_use(signals)
            first, rest = ([o for o in part if id(o) in of_use] for part in (first, rest))
        else:
            first, rest = (
                [o for o in part if not o.provides or self._is_read(o)] for part in (first, rest)
            )
        places = made if in_place else {}
        copied = not first or bool(rest)
        block = self._block(segment, detectors, samples, reach, places, again, copied, signals)
        if self._apart and any(isinstance(o, MapMaker) for o in segment.operators):
            self._add_unfiltered(block)
        if first:
            self._in_pieces(first, block, passed_on, signals, None if rest else due)
        self._exec(rest[:1], block, signals, due if len(rest) == 1 else None)
        if reach != samples:
            block = trimmed(block, samples)
        self._exec(rest[1:], block, signals, due)
        return block

    # ---- which steps act

    def _is_read(self, step: Operator) -> bool:
        """Tell whether a step must act: one of its streams is read later, or it makes products."""
        provides = step.provides - {"boresight"}
        streams = [n for n in provides if is_stream(n)]
        return (
            not provides or len(streams) < len(provides) or any(n in self._streams for n in streams)
        )

    def _of_use(self, signals: Sequence[Formed]) -> set[int]:
        """The steps, by identity, that change the streams of a block that is made again, of which
        only ``signals`` are of use.
        """
        few = len(signals) < len(self._chain.signals)
        steps = self._chain.needed_for(signals, filtered=True) if few else self._chain.steps
        return {id(step) for step in steps if step.provides & self._streams}

    # ---- steps

    def _exec(
        self,
        steps: list[Operator],
        block: Block,
        signals: Sequence[Formed],
        due: list[Due] | None = None,
    ) -> None:
        """Let steps act on a block; ``due`` takes the last ones of them as in `make`."""
        start = time.thread_time()
        last = len(steps)
        while due is not None and last and id(steps[last - 1]) in self._joining:
            last -= 1
        states = self._view.states
        measured = self._view.measured
        for number, first in enumerate(steps):
            if self._stopped():
                return
            step, label = self._own[id(first)]
            if due is not None and number >= last:
                if self._masks_maps:
                    share_mask(block, block.signals)
                due.append(Due(step, block, states[label]))
            elif forms(step):
                self._form(step, label, block, signals)
            elif filters(step):
                self._filter(step, label, block)
            else:
                if self._masks_maps and isinstance(step, MapMaker):
                    share_mask(block, block.signals)
                self._act(
                    step,
                    block,
                    next((f for (who, _), f in measured.items() if who == label), states[label]),
                )
            now = time.thread_time()
            self._timer.add(label, "exec", now - start)
            start = now

    def _form(self, step: Operator, label: str, block: Block, signals: Sequence[Formed]) -> None:
        """Let a step form each signal of its components, and give all of them the same mask."""
        for signal in signals:
            self._on_one(step, block, signal, self._view.states[label])
        if len(signals) > 1:
            share_mask(block, [s.stream for s in signals])

    def _filter(self, step: Operator, label: str, block: Block) -> None:
        """Let a step filter each signal."""
        here = [s for s in self._chain.signals if s.stream in block.detdata and s.filtered]
        for signal in here:
            state = self._view.states[label]
            self._on_one(
                step,
                block,
                signal,
                self._view.measured.get((label, signal.stream), state),
            )
        if len(here) > 1 and not step.linear:
            share_mask(block, [s.stream for s in here])

    def _on_one(self, step: Operator, block: Block, signal: Formed, state: Any) -> None:
        """Let a step act on one signal, as if it were the only one."""
        if len(self._chain.signals) == 1 and signal.components == self._chain.components:
            block.components = signal.components
            self._act(step, block, state)
            return
        seen = block.alone(
            signal.stream,
            signal.components,
            self._chain.components - signal.components,
        )
        self._act(step, seen, state)
        block.take(signal.stream, seen)

    def _act(self, step: Operator, block: Block, state: Any) -> None:
        """Let a step act on a block, and check the streams that it leaves. A step that does not
        know of means is given a block with the means added.
        """
        label = self._labels[id(step)]
        fields = {}
        seen = block
        if names := self._declared.get(label, frozenset()) & block.detdata.keys():
            fields = means_of(self._observation, block.means, names)
        if fields:
            buffers = self._local.__dict__.setdefault("whole", {})
            seen = whole_block(block, step, fields, buffers)
        before = dict(seen.detdata)
        if (lost := step.exec(seen, state)) is not None:  # type: ignore[func-returns-value]
            raise PipelineError(
                f"exec returned {type(lost).__name__}, which nobody takes: a step changes"
                " block.detdata in place",
                place=label,
                cure='write block.detdata["signal"][...] = ..., and return nothing',
            )
        seen.check(before, step.provides, self._due[label], partial(whose, step))
        if fields:
            take_whole(block, seen, step, fields)

    # ---- what is in a block

    def _block(
        self,
        segment: Segment,
        detectors: slice,
        samples: slice,
        reach: slice,
        made: dict[str, AnyFloats],
        again: bool,
        copied: bool,
        signals: Sequence[Formed],
    ) -> Block:
        """A block with its sources in it: where they are kept (as ``made`` says), copies, or made
        again.

        With margins never in place: others read them too. Not ``copied``: steps work on copies of
        parts of it alone.
        """
        source = segment.source
        observation = self._observation
        if again:
            observation = copy.copy(observation)
            observation.log = Log()
        buffers = self._local.__dict__.setdefault("blocks", {}).setdefault(id(segment), {})
        block = Block(
            observation,
            detectors,
            reach,
            dtype=self._dtype,
            buffers=buffers,
            again=again,
        )
        rows = self._view.rows
        block.places = {name: array[rows][detectors, reach] for name, array in made.items()}
        for name, array in source.arrays.items():
            here = array[rows][detectors, reach]
            if made or not copied:
                block.detdata[name] = block.places.get(name, here)
            else:
                block.detdata[name] = block.buffer(name, block.shape)
                block.detdata[name][...] = here
        block.means.update(source.means.get(self._view.number, {}))
        if source.segment is None:
            return block
        margins = slice(reach.start, samples.start), slice(samples.stop, reach.stop)
        for part, known in ((margins[0], True), (samples, again), (margins[1], True)):
            if part.start == part.stop:
                continue
            before = self.make(source.segment, detectors, part, {}, again=known, signals=signals)
            for name in source.names & before.detdata.keys():
                if reach == samples:
                    block.detdata[name] = before.detdata[name]
                    continue
                if name not in block.detdata:
                    block.detdata[name] = block.buffer(name, block.shape)
                block.detdata[name][:, within(reach, part)] = before.detdata[name]
            block.means.update(before.means)
        return block

    def _add_unfiltered(self, block: Block) -> None:
        """Put the signals that pass no filter into a block of a map maker, made again from their
        components.
        """
        found = self.make(
            self._unfiltered,
            block.detectors,
            block.samples,
            {},
            again=True,
            signals=self._schedule.made_again,
        )
        for name in self._apart:
            block.detdata[name] = found.detdata[name]
            if name in found.means:
                block.means[name] = found.means[name]

    def _in_pieces(
        self,
        steps: list[Operator],
        block: Block,
        passed_on: set[str],
        signals: Sequence[Formed],
        due: list[Due] | None = None,
    ) -> None:
        """Let steps that couple nothing work on copies of parts of a block; put the streams
        ``passed_on`` into it.
        """
        given = block.detdata
        means = block.means
        made = dict[str, AnyFloats]()
        buffers = self._local.__dict__.setdefault("pieces", {})
        for detectors, samples in pieces(block.detectors, block.samples):
            piece = Block(
                block.observation,
                detectors,
                samples,
                means=dict(means),
                dtype=block.dtype,
                buffers=buffers,
                again=block.again,
            )
            where = within(block.detectors, detectors), within(block.samples, samples)
            for name, stream in given.items():
                piece.detdata[name] = piece.buffer(name, piece.shape)
                piece.detdata[name][...] = stream[where]
            self._exec(steps, piece, signals, due)
            for name in passed_on & piece.detdata.keys():
                if name not in made:
                    made[name] = (
                        block.places[name]
                        if name in block.places
                        else block.buffer(name, block.shape)
                    )
                made[name][where] = piece.detdata[name]
            block.means = piece.means  # the same fields in every piece
        block.detdata = {**given, **made}


def share_mask(block: Block, streams: Sequence[str]) -> None:
    """Make samples NaN in all signals that are not finite in one: their maps have the same hits,
    and remainders hold.
    """
    arrays = tuple(block.detdata[name] for name in streams)
    for d in range(block.shape[0]):
        if not all(_finite(array[d]) for array in arrays):
            bad = np.logical_or.reduce([~np.isfinite(array[d]) for array in arrays])
            for array in arrays:
                array[d, bad] = np.nan


@kernel(fastmath={"contract", "nsz", "reassoc"})
def _finite(row):  # type: ignore[no-untyped-def]
    """Tell whether all samples of a row are finite."""
    total = zero = row.dtype.type(0)
    for t in range(row.size):
        total += row[t] * zero  # row[t] - row[t] would be cancelled where sums are reassociated
    return total == 0
