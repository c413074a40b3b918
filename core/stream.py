"""Streams of whole observations: their names in parameters, the samples that steps read which
measure, and the result of a step that changes a whole stream at once (`Changed`).
"""

from __future__ import annotations

import mmap
import os
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from .block import Block
from .configuration.diagnostics import nearest
from .errors import OutputError, PipelineError
from .numerics.chunks import TILE_DETECTORS, TILE_SAMPLES
from .numerics.smooth import SmoothField
from .observation import Observation
from .signal import BUILT_IN, MAIN, Component, is_signal
from .types import AnyFloats, Floats

StreamName = Annotated[str, Field(pattern=r"^[A-Za-z_][A-Za-z0-9_]*$")]
"""A name that a parameter ``streams`` may list: ``signal``, a component (``sky``, or one of a
plugin), or another stream that a step makes (``pwv``)."""

AnyStream = Annotated[
    str, Field(pattern=rf"^([A-Za-z_][A-Za-z0-9_]*|{MAIN}/[A-Za-z][A-Za-z0-9_]*)$")
]
"""The same, or the stream of a signal of `runs` (``signal/noiseless``)."""

COMPONENTS = frozenset(map(str, BUILT_IN))
"""Signal components of zonda's own operators."""

UNITS = {"transmission": "", "opacity": "", "flags": "", "pwv": "m", "path_delay": "m"}
"""Units of streams that are not in K."""


def unit_of_stream(name: str) -> str:
    """K_RJ; ``m`` or empty for streams of other kinds."""
    return UNITS.get(name, "K_RJ")


def streams_asked(streams: Iterable[str] | None) -> frozenset[str]:
    """Components of zonda's own and streams of signals among ``streams`` (None: all components),
    for `Operator.optional`: the executor keeps no stream that nobody reads (`core.run.execution`).
    """
    if streams is None:
        return COMPONENTS
    return frozenset(name for name in streams if name in COMPONENTS or f"{MAIN}/" in name)


def streams_needed(streams: Iterable[str] | None) -> frozenset[str]:
    """``signal``, and those of ``streams`` that are no components of zonda's own, for
    `Operator.requires`: no step makes these by default, so that a name without a maker is an error.
    """
    asked = (MAIN if is_signal(name) else name for name in streams or ())
    return frozenset({MAIN, *asked}) - COMPONENTS


def check_signals(streams: Iterable[str], observation: Observation, place: str) -> None:
    """Refuse the stream of a signal that is not formed: that `runs` does not have, or that is a
    remainder (PipelineError).
    """
    for name in streams:
        if is_signal(name) and name not in observation.signals:
            have = [one for one in observation.signals if not one.partition("/")[2].startswith("_")]
            listed = f"streams of signals: {', '.join(have)}; of a remainder there are maps alone"
            cure = "\n".join(filter(None, (nearest(name, have[1:]), listed)))
            raise PipelineError(f"there is no stream {name!r}", place=place, cure=cure)


@dataclass
class Stream:
    """A named stream of one whole observation, between two segments.

    Attributes
    ----------
    array
        (n_det, n_samp) float32 or float64, C order; in memory, or a memory map of a temporary file.
        A stream that is made again when it is read (`core.run.streams`) has none: it is read by
        `sweep`.
    means
        What must be added in float64 to have all of it, see `Block.means`.
    threads
        Threads an operator's ``measure`` may use.
    room
        Bytes that it may take for a while, beyond what `Operator.memory` said.
    """

    name: str
    observation: Observation
    array: AnyFloats
    means: dict[str, SmoothField]
    threads: int
    room: int = 0
    signal: str = MAIN
    """Name of the signal that it is, if it is one: ``signal/noiseless``. Its ``name`` is ``signal``
    for the step that measures it.
    """
    components: frozenset[Component] = frozenset()
    """Components whose sum is the signal."""
    state: Any = None
    """Result of `Operator.prepare` of the step that measures it."""
    states: Sequence[Any] = ()
    """Those of each band, where the bands are measured together."""

    @property
    def shape(self) -> tuple[int, int]:
        """(n_det, n_samp)."""
        return self.observation.n_detectors, self.observation.n_samples

    @property
    def dtype(self) -> np.dtype[Any]:
        """float32 or float64."""
        return self.array.dtype

    def sweep(
        self,
        work: Callable[[slice, slice, AnyFloats], Any],
    ) -> Iterator[tuple[slice, slice, Any]]:
        """(detectors, samples, result) of ``work(detectors, samples, part)`` over blocks that cover
        the stream once.

        ``work`` is called from several threads and must not change or keep the part. Results come
        in an order in which no detector's samples and no sample's detectors are ever out of order,
        whatever the blocks and threads: what is added up tile by tile (`core.numerics.chunks`) has
        the same bits.
        """
        n_det, n_samp = self.shape
        blocks = [
            (slice(d, min(d + SWEEP_DETECTORS, n_det)), slice(t, min(t + SWEEP_SAMPLES, n_samp)))
            for d in range(0, n_det, SWEEP_DETECTORS)
            for t in range(0, n_samp, SWEEP_SAMPLES)
        ]

        def one(detectors: slice, samples: slice) -> tuple[slice, slice, Any]:
            result = work(detectors, samples, self.array[detectors, samples])
            forget_pages(self.array)
            return detectors, samples, result

        return in_order(one, blocks, self.threads)


SWEEP_DETECTORS, SWEEP_SAMPLES = 4 * TILE_DETECTORS, 32 * TILE_SAMPLES
"""Detectors and samples that are read at a time of a kept stream."""


def in_order(
    work: Callable[..., Any],
    items: Iterable[tuple[Any, ...]],
    threads: int,
    stop: Callable[[], object] = lambda: None,
) -> Iterator[Any]:
    """Results of ``work(*item)``, in order, made on several threads that run ahead by at most two
    items each. ``stop`` is called on an error, before the items that are worked on are waited for.
    """
    if threads == 1:
        yield from (work(*item) for item in items)
        return
    with ThreadPoolExecutor(threads) as pool:
        pending: deque[Future[Any]] = deque()
        try:
            for item in items:
                pending.append(pool.submit(work, *item))
                if len(pending) > 2 * threads:
                    yield pending.popleft().result()
            while pending:
                yield pending.popleft().result()
        except BaseException:
            stop()
            raise
        finally:
            for future in pending:
                future.cancel()


def forget_pages(array: NDArray[Any]) -> None:
    """Take the pages of an array in a file out of this process's memory; the file keeps them."""
    pages = getattr(array, "_mmap", None)
    if pages is not None and hasattr(mmap, "MADV_DONTNEED"):
        pages.madvise(mmap.MADV_DONTNEED)


def columns(array: AnyFloats, samples: slice) -> AnyFloats:
    """(n_det, n) samples of all detectors as an array of its own.

    A spilled stream's are read from its file: around each page that is touched in a mapping the
    system maps up to 64 kB, which is most of a stream whose rows are that short.
    """
    if not isinstance(array, np.memmap):
        return np.array(array[:, samples], order="C")
    found = np.empty((array.shape[0], samples.stop - samples.start), array.dtype)
    whole = found.data.cast("B")
    size = found.strides[0]
    mapped: Any = array._mmap  # type: ignore[attr-defined]
    begin = array.ctypes.data - np.frombuffer(mapped, np.uint8).ctypes.data
    with open(str(array.filename), "rb", buffering=0) as file:
        for row in range(array.shape[0]):
            place = begin + row * array.strides[0] + samples.start * array.itemsize
            left = whole[row * size : (row + 1) * size]
            while left:
                read = _read_at(file, left, place)
                if not read:
                    cure = "do not change files in the temporary folder while zonda runs"
                    raise OutputError(
                        "the temporary file was truncated",
                        place=str(array.filename),
                        cure=cure,
                    )
                place = place + read
                left = left[read:]
    return found


def _read_at(file: Any, into: memoryview, place: int) -> int:
    """Bytes read into ``into`` from ``place`` on, in one call of the system where there is one."""
    if hasattr(os, "preadv"):
        return os.preadv(file.fileno(), [into], place)
    file.seek(place)
    return int(file.readinto(into))


@dataclass(frozen=True)
class Changed:
    """A stream that was changed as a whole: values (n_det, n_samp), and the mean that stands beside
    them, if it still does.
    """

    values: AnyFloats
    mean: SmoothField | None

    @classmethod
    def of(cls, values: Floats, stream: Stream, fixed: SmoothField | None = None) -> Changed:
        """Take the whole (n_det, n_samp), which is used up. The mean of ``stream`` stays beside it
        where it is nearer than zero; ``fixed``: a mean that other signals share; it is kept."""
        mean = stream.means.get(stream.name)
        observation = stream.observation
        if mean is not None and not _is_left(values, mean, observation):
            mean = None
        for field in (mean, fixed):
            if field is not None:
                for row, each in enumerate(values):
                    each -= field.evaluate(slice(row, row + 1), slice(0, len(each)))[0]
        return cls(values.astype(stream.dtype), mean)

    def put(self, block: Block, name: str) -> None:
        """Replace the stream ``name`` of a block."""
        block.detdata[name][...] = self.values[block.detectors, block.samples]
        block.means.pop(name, None)
        if self.mean is not None:
            block.means[name] = self.mean


def whole(stream: Stream, fixed: SmoothField | None = None) -> Floats:
    """A copy (n_det, n_samp) float64 of a stream with its mean."""
    values = np.empty(stream.shape)
    for row, each in enumerate(values):
        each[:] = stream.array[row]
        for field in (stream.means.get(stream.name), fixed):
            if field is not None:
                each += field.evaluate(slice(row, row + 1), slice(0, len(each)))[0]
    return values


def _is_left(values: AnyFloats, mean: SmoothField, observation: Observation) -> bool:
    """True if the mean is still in the signal: its samples are nearer to the mean than to zero."""
    with_it = 0.0
    without = 0.0
    good = observation.good_samples
    for row in np.flatnonzero(observation.good_detectors):
        part = values[row, good]
        rest = part - mean.evaluate(slice(row, row + 1), slice(0, len(good)))[0, good]
        with_it = with_it + float(np.nansum(rest * rest))
        without = without + float(np.nansum(part * part))
    return with_it < without
