"""One scan, executed with one band or with several together.

Bands that are executed together have the same segments. In each they are measured, then worked on
block by block: every band's steps act on a block before those that map all bands act once. A step
that measures the detectors of all bands together is given their streams as one, row after row; such
a band does not have the bits that it has alone. Any other has.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from contextlib import ExitStack
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np

from ..data import Data
from ..focalplane import Focalplane
from ..mapmaker import JoinsBands, joins
from ..observation import Observation
from ..operator import Operator
from ..signal import MAIN
from ..stream import Stream, forget_pages
from ..tally import Tally
from ..types import AnyFloats
from .block_maker import Due
from .execution import Execution, Pass
from .prefetch import Ahead
from .segments import pieces
from .streams import Ledger, Store

ELSEWHERE = "samples flagged as those of another band are: nothing is measured there"
"""A count of the log."""


def run(
    bands: Sequence[Execution],
    datas: Sequence[Data],
    ahead: Ahead | None = None,
    following: Sequence[Execution | None] = (),
    blockwise: bool = True,
) -> None:
    """Configure, prepare, execute and collect a scan with all of these bands; on any failure
    operators discard what they began.

    Parameters
    ----------
    datas
        Take what each band's steps add up.
    following
        Executions that ``ahead`` may prepare meanwhile.
    blockwise
        False: there is no room for a block of every band at a time.
    """
    try:
        for band in bands:
            band.ready(ahead)
        halos: dict[str, int] = {}
        for band in bands:
            for step in band.chain.steps:
                own = step.halo(band.observation)
                halos[step.label] = max(own, halos.get(step.label, 0))
        ordered = {label for band in bands for label in band.ordered}
        for band in bands:
            band.begin(len(bands), ordered, halos)
        for execution in following if ahead is not None else ():
            ahead.start(execution)  # type: ignore[union-attr]
        for number, planned in enumerate(bands[0].schedule.planned):
            head = planned.segment.operators[0]
            if head.couples == "all" and len(bands) > 1 and joins(head):
                _measure_together(bands, head)
            elif head.couples == "all":
                for band in bands:
                    band.measure(band.schedule.planned[number].segment.operators[0])
            passes = [one for band in bands if (one := band.start(number)) is not None]
            _carry_out(passes, blockwise)
            for one in passes:
                one.end()
        for band, data in zip(bands, datas, strict=True):
            band.keep()
            band.collect(data)
    except BaseException:
        for band in bands:
            band.abandon()
        raise
    finally:
        for band in bands:
            band.close()


# ---- blocks


def _carry_out(passes: Sequence[Pass], blockwise: bool) -> None:
    """Work on all blocks: on each with all bands where their blocks are the same."""
    if len(passes) < 2 or not blockwise or not all(one.shares_blocks(passes[0]) for one in passes):
        for one in passes:
            _sweep(one, one.work, one.execution.observation.name)
        return
    whole = passes[0].stage.segment.split()[1]

    def work(detectors: slice, samples: slice) -> None:
        for part in [(detectors, samples)] if whole else pieces(detectors, samples):
            every: list[list[Due]] = [[] for _ in passes]
            for one, due in zip(passes, every, strict=True):
                one.work(*part, due=due)
            for together in zip(*every, strict=True):
                step, start = together[0].step, time.thread_time()
                step.exec_bands([due.block for due in together], [due.state for due in together])
                passes[0].execution.timer.add(step.label, "exec", time.thread_time() - start)

    _sweep(passes[0], work, name_of_all(passes[0].execution.observation), passes)


def _sweep(
    one: Pass, work: Callable[[slice, slice], None], scan: str, passes: Sequence[Pass] = ()
) -> None:
    """Work on every block of a pass, on several threads; the first error stops all ``passes``."""
    settings, blocks = one.execution.settings, one.blocks
    working = (o for o in one.stage.segment.operators if type(o).exec is not Operator.exec)
    total, what = len(blocks), f"{scan}: {', '.join(o.label for o in working)}"
    threads = min([settings.threads, *(other.execution.settings.threads for other in passes)])
    if threads == 1 or total == 1:
        for done, block in enumerate(blocks, 1):
            work(*block)
            settings.progress(done, total, what)
        return
    with ThreadPoolExecutor(threads) as pool:
        futures = [pool.submit(work, *block) for block in blocks]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                settings.progress(done, total, what)
        except BaseException:
            for other in passes or (one,):
                other.execution.stop()
            for future in futures:
                future.cancel()
            raise


# ---- steps that measure the detectors of all bands together


def _measure_together(bands: Sequence[Execution], step: Operator) -> None:
    """Let a step measure each signal of all bands, and give each band its rows of what is found."""
    assert isinstance(step, JoinsBands)
    first, model, used = bands[0], None, 0.0
    memory = sum(band.settings.memory for band in bands)
    store = Store(memory, first.settings.dtype, [], Ledger())
    try:
        signals = [band.measured_by(step) for band in bands]
        for signal in signals[0]:
            with ExitStack() as stack:
                streams = [stack.enter_context(band.stream(step, signal)) for band in bands]
                start = first.without_blocks()
                stream = _joined(streams, store)
                found = step.measure(stream, model if signal.takes_model(step.label) else None)
                used += first.without_blocks() - start
            store.release([stream.array])
            model = found if signal.stream == MAIN else model
            rows = list(_rows(streams))
            _note(step.label, stream, streams, rows)
            for band, at in zip(bands, rows, strict=True):
                band.measured[step.label, signal.stream] = step.of_rows(found, at)
    finally:
        store.close()
    for band in bands:
        band.tell(step, "measure", used if band is first else 0.0)


def _note(label: str, whole: Stream, streams: Sequence[Stream], rows: Sequence[slice]) -> None:
    """Note in each band's observation what was flagged and counted in that of all."""
    streams[0].observation.tally.update(whole.observation.tally)
    for own, at in zip(streams, rows, strict=True):
        own.observation.detector_flags |= whole.observation.detector_flags[at]
        if whole.signal == MAIN:
            elsewhere = own.observation.good_samples & ~whole.observation.good_samples
            own.observation.tally.count(label, ELSEWHERE, int(elsewhere.sum()), elsewhere.size)
        own.observation.flags |= whole.observation.flags


def _rows(streams: Sequence[Stream]) -> Iterator[slice]:
    """The rows of each band in the stream of all."""
    ends = np.cumsum([0, *(stream.shape[0] for stream in streams)]).tolist()
    return (slice(first, end) for first, end in pairwise(ends))


def _joined(streams: Sequence[Stream], store: Store) -> Stream:
    """A copy of all streams, one band after the other. In float64 it has the mean emission, which
    float32 cannot carry.
    """
    first, rows = streams[0], list(_rows(streams))
    array = store.allocate(first.name, (rows[-1].stop, first.shape[1]), dtype=first.dtype)
    carries = first.dtype == np.float64
    for stream, at in zip(streams, rows, strict=True):
        mean = stream.means.get(stream.name) if carries else None

        def copy(
            detectors: slice,
            samples: slice,
            part: AnyFloats,
            start: int = at.start,
            mean: Any = mean,
        ) -> None:
            to = array[start + detectors.start : start + detectors.stop, samples]
            to[...] = part if mean is None else part + mean.evaluate(detectors, samples)

        for _ in stream.sweep(copy):
            forget_pages(array)
    scan, room = _all_detectors([s.observation for s in streams]), min(s.room for s in streams)
    means = {} if carries else first.means
    joined = Stream(first.name, scan, array, means, first.threads, room)
    joined.signal, joined.components, joined.state = first.signal, first.components, first.state
    return joined


def name_of_all(scan: Observation) -> str:
    """The name of a scan without that of its band."""
    return scan.name.removesuffix(f"-{scan.instrument.band.name}")


def _all_detectors(scans: Sequence[Observation]) -> Observation:
    """A scan with the detectors of all bands. A sample that one band flags is flagged: the bands
    have no common mode there.
    """
    first = scans[0]
    return replace(
        first,
        name=f"{name_of_all(first)}, all bands",
        focalplane=Focalplane.of_bands({str(k): scan.focalplane for k, scan in enumerate(scans)}),
        flags=np.bitwise_or.reduce([scan.flags for scan in scans]),
        detector_flags=np.concatenate([scan.detector_flags for scan in scans]),
        smooth={},
        detdata={},
        tally=Tally(),
    )
