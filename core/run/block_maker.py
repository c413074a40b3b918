"""Makes the blocks of one observation: a segment's operators, carried out on a rectangle of detectors x samples."""

from __future__ import annotations

import copy
import threading
import time
from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any

import numpy as np

from ..data import STREAMS, Block, Observation, Stream, Tally
from ..faults import PluginError, whose
from ..numerics.tiles import TILE_SAMPLES
from ..operator import Operator
from ..types import AnyFloats
from .blocks import pieces, trimmed, within
from .repeated import Repeated
from .same_air import SameAir
from .settings import Settings, Timer
from .streams import Ledger, Stage
from .whole import exec_whole, knows_means, means_of, names_of


class BlockMaker:
    """Works on blocks, from several threads at once.

    Parameters
    ----------
    states
        By label: what `Operator.prepare` returned. It fills up before the first block.
    streams
        As in `Layout`.
    stopped
        True: what is made is of no use any more.
    repeated
        Streams that this run keeps for later ones, or that it finds there.
    """

    def __init__(
        self,
        operators: Sequence[Operator],
        observation: Observation,
        settings: Settings,
        states: Mapping[str, Any],
        streams: Collection[str],
        timer: Timer,
        ledger: Ledger,
        stopped: Callable[[], bool],
        repeated: Repeated | None = None,
    ) -> None:
        self._observation, self._dtype, self._states = observation, settings.dtype, states
        self._streams, self._timer, self._ledger, self._stopped = frozenset(streams), timer, ledger, stopped
        self._repeated = repeated
        self._labels = {id(operator): operator.label for operator in operators}  # the property is slow
        acting = [o for o in operators if type(o).exec is not Operator.exec]
        self._declared = {o.label: names_of(o) for o in acting if not knows_means(o)}
        self._due: dict[str, frozenset[str]] = {}
        """By label: streams that a step must have made, for a later one requires them."""
        required = frozenset[str]()
        for operator in reversed(operators):
            takes_away = isinstance(operator, SameAir)
            self._due[operator.label] = frozenset() if takes_away else operator.provides & required & frozenset(STREAMS)
            required |= operator.requires if operator in acting else frozenset()
        self._local = threading.local()

    def let_go(self) -> None:
        """Blocks are done with: their threads have ended."""
        self._local = threading.local()
        self._ledger.drop("blocks")

    def make(self, stage: Stage, detectors: slice, samples: slice, made: dict[str, Stream], *, again: bool) -> Block:
        """A block with the segment's operators, and those of the stages before it, carried out."""
        segment, again = stage.segment, again or stage.swept
        n_samples = self._observation.n_samples
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
        held = self._local.__dict__
        buffers = [*held.get("blocks", {}).values(), held.get("pieces", {}), held.get("whole", {})]
        size = sum(array.nbytes for held in buffers for array in held.values())
        self._ledger.note(("blocks", threading.get_ident()), size)
        return block

    def _exec(self, operators: list[Operator], block: Block) -> None:
        start = time.thread_time()
        for operator in operators:
            if self._stopped():
                return
            label = self._labels[id(operator)]
            alike = self._repeated if self._repeated is not None and label in self._repeated.names else None
            if alike is not None and alike.complete:
                alike.repeat(label, block)
            else:
                self._act(operator, label, block)
                if alike is not None:
                    alike.record(label, block)
            now = time.thread_time()
            self._timer.add(label, "exec", now - start)
            start = now

    def _act(self, operator: Operator, label: str, block: Block) -> None:
        """`Operator.exec`, and a look at what it left."""

        def work(block: Block) -> None:
            before = dict(block.detdata)
            operator.exec(block, self._states[label])
            check_left(operator, block, before, self._due[label])

        fields = {}
        if names := self._declared.get(label, frozenset()) & block.detdata.keys():
            fields = means_of(self._observation, block.means, names)
        if fields:
            exec_whole(block, operator, fields, self._local.__dict__.setdefault("whole", {}), work)
        else:
            work(block)

    def _block(
        self, stage: Stage, detectors: slice, reach: slice, samples: slice, made: dict[str, Stream], again: bool, copied: bool
    ) -> Block:
        """A block with its sources in it: where they are kept (as ``made`` says), copies, or made again.

        With margins never in place: others read them too. Not ``copied``: operators work on copies of parts of it alone.
        """
        source, observation = stage.source, self._observation
        if again:
            observation = copy.copy(observation)
            observation.tally = Tally()
        buffers = self._local.__dict__.setdefault("blocks", {}).setdefault(stage.depth, {})
        block = Block(observation, detectors, reach, dtype=self._dtype, buffers=buffers, again=again)
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
            before = self.make(source.stage, detectors, part, {}, again=known)
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
        given, means, made = block.detdata, block.means, dict[str, AnyFloats]()
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


def check_left(operator: Operator, block: Block, before: Mapping[str, AnyFloats], due: frozenset[str]) -> None:
    """Refuse what `Operator.exec` must not leave: a stream that is missing, or is no array of the block's shape and type.

    Parameters
    ----------
    before
        The block's streams before; an array that is still there is not looked at.
    due
        Streams that it must have made.

    Raises
    ------
    PluginError
        Names the step, its class and where that comes from.
    """
    for name, stream in block.detdata.items():
        if stream is before.get(name):
            continue
        wanted = f"an array {block.shape} of {np.dtype(block.dtype)} in C order"
        if not isinstance(stream, np.ndarray):
            found = f"a {type(stream).__name__}"
        elif stream.shape != block.shape or stream.dtype != block.dtype:
            found = f"an array {stream.shape} of {stream.dtype}"
        elif not stream.flags.c_contiguous:
            found = "an array that is not in C order"
        else:
            continue
        raise PluginError(
            f"exec left the stream {name!r} as {found}; it must be {wanted}",
            place=whose(operator),
            cure=f"fill it in place: block.new({name!r})[...] = values",
        )
    gone = (due - block.detdata.keys()) | (before.keys() - operator.provides - block.detdata.keys())
    if gone:
        name = min(gone)
        raise PluginError(
            f"exec left no stream {name!r}, which {'it provides' if name in operator.provides else 'others read'}",
            place=whose(operator),
            cure=f"make it with block.new({name!r}), or leave it out of provides" if name in due else "leave it in block.detdata",
        )
