"""Bands in step: each block of a scan is worked on with one band after the other, so that what they
share is found once.

Where a step measures the detectors of all bands together, bands wait for each other. Such a band
does not have the bits that it has alone; any other has. Bands that share nothing, or for whose
streams the memory has no room, follow each other scan by scan (`in_turn`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import ThreadPoolExecutor, as_completed
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ..focalplane import Focalplane
from ..observation import Observation
from ..operator import Operator
from ..shared import SharedScan
from ..signal import MAIN
from ..stream import Stream, forget_pages
from ..tally import Tally
from ..types import AnyFloats
from .settings import Settings, Timer
from .streams import Ledger, Store

ELSEWHERE = "samples flagged as those of another band are: nothing is measured there"
"""A count of the log."""


@runtime_checkable
class JoinsBands(Protocol):
    """A step with ``couples = "all"`` that may measure the detectors of all bands together.

    Attributes
    ----------
    joins_bands
        Whether it does.
    """

    joins_bands: bool

    def of_rows(self, measured: Any, rows: slice) -> Any:
        """Of what ``measure`` returned for the detectors of all bands, what ``exec`` needs for some
        of them.
        """
        ...


@dataclass(frozen=True)
class Waiting:
    """A band that waits until a step has measured the streams of all; it takes what was found, and
    the CPU seconds of its part.

    Attributes
    ----------
    operator, stream
        The step, and the band's stream.
    takes_model
        Whether the signal takes what was measured in the complete one.
    """

    operator: Operator
    stream: Stream
    takes_model: bool


@dataclass(frozen=True)
class Sweep:
    """Work on all blocks of a scan.

    Attributes
    ----------
    work
        Called with the detectors and the samples of each of ``blocks``, on several threads.
    scan, what
        Names of the scan and of the steps, for the progress; ``together``: that of the scan with
        all bands.
    stop
        Called where a block fails: the others are of no use any more.
    """

    work: Callable[[slice, slice], None]
    blocks: Sequence[tuple[slice, slice]]
    scan: str
    what: str
    together: str
    stop: Callable[[], None]


Turns = Generator[Waiting | Sweep, Any, None]
"""An execution that yields where it works on blocks and where it waits for other bands."""


def joins(operator: Operator) -> bool:
    """Whether a step measures the detectors of all bands together."""
    return isinstance(operator, JoinsBands) and operator.joins_bands


def sweep(one: Sweep, settings: Settings) -> None:
    """Work on every block, on ``settings.threads`` threads; the first error stops all."""
    blocks, progress, total, what = (
        one.blocks,
        settings.progress,
        len(one.blocks),
        f"{one.scan}: {one.what}",
    )
    if settings.threads == 1 or total == 1:
        for done, block in enumerate(blocks, 1):
            one.work(*block)
            progress(done, total, what)
        return
    with ThreadPoolExecutor(settings.threads) as pool:
        futures = [pool.submit(one.work, *block) for block in blocks]
        try:
            for done, future in enumerate(as_completed(futures), 1):
                future.result()
                progress(done, total, what)
        except BaseException:
            one.stop()
            for future in futures:
                future.cancel()
            raise


def run_in_step(
    bands: Sequence[Turns], settings: Settings, timer: Timer, shared: SharedScan | None
) -> None:
    """Execute one scan with all bands.

    Parameters
    ----------
    settings
        ``memory``: bytes for streams of all bands together, where a step measures these.
    shared
        What blocks are worked on with one band after the other; None: each band works on all of its
        blocks at a time.
    """
    store = Store(settings.memory, settings.dtype, [], Ledger())
    models: dict[str, Any] = {}
    try:
        asked = [next(band, None) for band in bands]
        while any(asked):
            answers: list[Any] = [None] * len(bands)
            sweeps = {k: one for k, one in enumerate(asked) if isinstance(one, Sweep)}
            if sweeps:
                _sweep(list(sweeps.values()), settings, timer, shared)
                ready = list(sweeps)
            else:
                ready = [k for k, one in enumerate(asked) if one is not None]
                start = time.process_time() - timer.of_stage(
                    "exec"
                )  # a stream made again is made of blocks
                parts = _measure([one for one in asked if isinstance(one, Waiting)], models, store)
                used = (time.process_time() - timer.of_stage("exec") - start) / len(parts)
                answers = [(part, used) for part in parts]
            for k in ready:
                asked[k] = _resume(bands[k], answers[k])
    except RuntimeError as error:
        if isinstance(error.__cause__, StopIteration):  # a step's, in a generator
            raise error.__cause__ from None
        raise
    finally:
        for band in bands:
            band.close()
        store.close()


def _resume(band: Turns, answer: Any) -> Waiting | Sweep | None:
    try:
        return band.send(answer)
    except StopIteration:
        return None


def _sweep(
    sweeps: Sequence[Sweep], settings: Settings, timer: Timer, shared: SharedScan | None
) -> None:
    """Work on the blocks of several bands: on each with all of them where their blocks are the
    same.
    """
    first = sweeps[0]
    if shared is None or any(one.blocks != first.blocks for one in sweeps):
        for one in sweeps:
            sweep(one, settings)
        return

    def work(detectors: slice, samples: slice) -> None:
        with shared.block():
            for one in sweeps:
                one.work(detectors, samples)
            for label, work_due in shared.due():
                start = time.thread_time()
                work_due()
                timer.add(label, "exec", time.thread_time() - start)

    def stop() -> None:
        for one in sweeps:
            one.stop()

    sweep(replace(first, work=work, scan=first.together, stop=stop), settings)


def _measure(waiting: Sequence[Waiting], models: dict[str, Any], store: Store) -> list[Any]:
    """What each band needs of what the step measured for all; ``models``: by label, what it
    measured in the complete signal.
    """
    step, streams = waiting[0].operator, [w.stream for w in waiting]
    assert isinstance(step, JoinsBands)
    stream = _joined(streams, store)
    found = step.measure(stream, models.get(step.label) if waiting[0].takes_model else None)
    store.release([stream.array])
    if stream.signal == MAIN:
        models[step.label] = found
    streams[0].observation.tally.update(stream.observation.tally)
    rows = _rows(streams)
    for own, at in zip(streams, rows, strict=True):
        own.observation.detector_flags |= stream.observation.detector_flags[at]
        if stream.signal == MAIN:
            elsewhere = own.observation.good_samples & ~stream.observation.good_samples
            own.observation.tally.count(step.label, ELSEWHERE, int(elsewhere.sum()), elsewhere.size)
        own.observation.flags |= stream.observation.flags
    return [step.of_rows(found, at) for at in rows]


def _rows(streams: Sequence[Stream]) -> list[slice]:
    """The rows of each band in the stream of all."""
    ends = np.cumsum([0, *(stream.shape[0] for stream in streams)]).tolist()
    return [slice(first, end) for first, end in pairwise(ends)]


def _joined(streams: Sequence[Stream], store: Store) -> Stream:
    """A copy of all streams, one band after the other. In float64 it has the mean emission, which
    float32 cannot carry.
    """
    first, rows = streams[0], _rows(streams)
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
