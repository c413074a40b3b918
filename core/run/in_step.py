"""Bands in step: where a step measures the detectors of all bands together, the bands of a scan wait for each other there.

Such a band does not have the bits that it has alone. All other cameras and pipelines observe with one band after the other
(`in_turn`).
"""

from __future__ import annotations

import time
from collections.abc import Callable, Generator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Protocol, runtime_checkable

import numpy as np

from ..focalplane import Focalplane
from ..observation import Observation
from ..operator import Operator
from ..signal import MAIN
from ..stream import Stream, forget_pages
from ..tally import Tally
from ..types import AnyFloats
from .settings import Timer

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
        """Of what ``measure`` returned for the detectors of all bands, what ``exec`` needs for some of them."""
        ...


@dataclass(frozen=True)
class Waiting:
    """A band that waits until a step has measured the streams of all.

    Attributes
    ----------
    operator, stream
        The step, and the band's stream.
    takes_model
        Whether the signal takes what was measured in the complete one.
    lend
        Gives an array (n_det, n_samp) of a type for as long as the step measures.
    """

    operator: Operator
    stream: Stream
    takes_model: bool
    lend: Callable[[tuple[int, int], np.dtype[Any]], AnyFloats]


Turns = Generator[Waiting, Any, None]
"""An execution that yields where it waits, and takes what was measured."""


def joins(operator: Operator) -> bool:
    """Whether a step measures the detectors of all bands together."""
    return isinstance(operator, JoinsBands) and operator.joins_bands


def run_in_step(bands: Sequence[Turns], timer: Timer) -> None:
    """Execute one scan with all bands, which wait for each other at each stream that a step measures for all."""
    models: dict[str, Any] = {}
    try:
        waiting = [next(band, None) for band in bands]
        while here := [w for w in waiting if w is not None]:
            start = time.process_time() - timer.of_stage("exec")
            parts = _measure(here, models)
            timer.add(here[0].operator.label, "measure", time.process_time() - timer.of_stage("exec") - start)
            waiting = [_resume(band, part) for band, part in zip(bands, parts, strict=True)]
    except RuntimeError as error:
        if isinstance(error.__cause__, StopIteration):  # a step's, in a generator
            raise error.__cause__ from None
        raise
    finally:
        for band in bands:
            band.close()


def _resume(band: Turns, part: Any) -> Waiting | None:
    try:
        return band.send(part)
    except StopIteration:
        return None


def _measure(waiting: Sequence[Waiting], models: dict[str, Any]) -> list[Any]:
    """What each band needs of what the step measured for all; ``models``: by label, what it measured in the complete signal."""
    step, streams = waiting[0].operator, [w.stream for w in waiting]
    assert isinstance(step, JoinsBands)
    stream = _joined(streams, waiting[0].lend)
    found = step.measure(stream, models.get(step.label) if waiting[0].takes_model else None)
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


def _joined(streams: Sequence[Stream], lend: Callable[[tuple[int, int], np.dtype[Any]], AnyFloats]) -> Stream:
    """A copy of all streams, one band after the other. In float64 it has the mean emission, which float32 cannot carry."""
    first, rows = streams[0], _rows(streams)
    array = lend((rows[-1].stop, first.shape[1]), first.dtype)
    carries = first.dtype == np.float64
    for stream, at in zip(streams, rows, strict=True):
        mean = stream.means.get(stream.name) if carries else None

        def copy(detectors: slice, samples: slice, part: AnyFloats, start: int = at.start, mean: Any = mean) -> None:
            to = array[start + detectors.start : start + detectors.stop, samples]
            to[...] = part if mean is None else part + mean.evaluate(detectors, samples)

        for _ in stream.sweep(copy):
            forget_pages(array)
    scan, room = _all_detectors([s.observation for s in streams]), min(s.room for s in streams)
    means = {} if carries else first.means
    joined = Stream(first.name, scan, array, means, first.threads, room)
    joined.signal, joined.components, joined.state = first.signal, first.components, first.state
    return joined


def _all_detectors(scans: Sequence[Observation]) -> Observation:
    """A scan with the detectors of all bands. A sample that one band flags is flagged: the bands have no common mode there."""
    first = scans[0]
    return replace(
        first, name=f"{first.name.removesuffix('-' + first.instrument.band.name)}, all bands",
        focalplane=Focalplane.of_bands({str(k): scan.focalplane for k, scan in enumerate(scans)}),
        flags=np.bitwise_or.reduce([scan.flags for scan in scans]),
        detector_flags=np.concatenate([scan.detector_flags for scan in scans]), smooth={}, detdata={}, tally=Tally(),
    )  # fmt: skip
