"""Streams between two segments: in memory, in a temporary file, or nowhere, to be made again block
by block.

Making again needs no room and no disk: operators depend on absolute detectors and samples only,
random numbers are counted, so the segments before can run once more for any block that a later
segment or an `Operator.measure` reads. A rule decides, which knows sizes and couplings alone:

    kept      while all streams of an observation that are held at once take at most half of the
              budget, and leave room for blocks;
    again     otherwise, where the reader takes them in blocks or sweeps;
    spilled   otherwise: the reader needs them as a whole, or in another order.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from ..data import Observation, Stream
from ..errors import OutputError, PipelineError
from ..numerics.chunks import empty
from ..numerics.smooth import SmoothField
from ..operator import Operator
from ..types import AnyFloats
from .segments import Segment
from .views import View

DISK_SHARE = 0.9
"""Of the free disk that streams may take."""


class Ledger:
    """Bytes held for streams and blocks, by owner, and the most at any time. Thread-safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._held: dict[Any, int] = {}
        self.peak = 0

    def note(self, owner: Any, size: int) -> None:
        """``owner`` now holds ``size`` bytes."""
        with self._lock:
            self._held[owner] = size
            self.peak = max(self.peak, sum(self._held.values()))

    def drop(self, kind: str) -> None:
        """Owners (kind, ...) hold nothing any more: their threads have ended."""
        with self._lock:
            self._held = {owner: size for owner, size in self._held.items() if owner[0] != kind}


@dataclass
class Stage:
    """A segment whose streams are made again whenever they are read.

    Attributes
    ----------
    source
        What the segment reads.
    wanted
        Names of the streams that it passes on.
    swept
        Numbers of the bands of which it has worked on every sample once: what comes now comes
        again.
    """

    segment: Segment
    source: Source
    wanted: frozenset[str]
    swept: set[int] = field(default_factory=set)
    apart: bool = False
    """It makes unfiltered signals again, beside the other streams of a block."""

    @classmethod
    def without_filters(cls, steps: list[Operator], wanted: frozenset[str]) -> Stage:
        """A stage of the steps up to the one that forms signals."""
        return cls(Segment(steps), Source(), wanted, apart=True)

    @property
    def place(self) -> int:
        """Number of the buffers of its blocks: those that are worked on at the same time differ."""
        return -1 if self.apart else self.depth

    @property
    def span(self) -> str:
        """Span that its blocks must hold whole: ``time``, ``detectors``, or ``sample``, none."""
        return self.source.span if self.segment.span == "sample" else self.segment.span

    @property
    def depth(self) -> int:
        """Number of stages before it."""
        return self.source.stage.depth + 1 if self.source.stage else 0

    @property
    def in_time_order(self) -> bool:
        """True where it is much cheaper in order of time."""
        return self.segment.in_time_order or bool(
            self.source.stage and self.source.stage.in_time_order
        )

    def has_been_swept(self, views: Sequence[View]) -> None:
        """Note that every sample of some bands was worked on."""
        self.swept.update(view.number for view in views)
        if self.source.stage is not None:
            self.source.stage.has_been_swept(views)


@dataclass
class Source:
    """Streams that a segment reads.

    Attributes
    ----------
    arrays
        Those that are held, by name: the detectors of all bands, one band after the other.
    stage
        Makes them where none is held.
    means
        By number of the band, the mean emission that belongs to its rows.
    """

    arrays: dict[str, AnyFloats] = field(default_factory=dict)
    stage: Stage | None = None
    names: frozenset[str] = frozenset()
    means: dict[int, dict[str, SmoothField]] = field(default_factory=dict)

    @property
    def span(self) -> str:
        """See `Stage.span`."""
        return self.stage.span if self.stage else "sample"


class StreamMadeAgain(Stream):
    """A stream that is held nowhere: `sweep` makes it. ``sweeper`` is given what `sweep` is
    given.
    """

    def __init__(
        self,
        name: str,
        observation: Observation,
        means: dict[str, SmoothField],
        threads: int,
        dtype: type[np.floating[Any]],
        sweeper: Callable[
            [Callable[[slice, slice, AnyFloats], Any]], Iterator[tuple[slice, slice, Any]]
        ],
    ) -> None:
        self.name, self.observation, self.means, self.threads = name, observation, means, threads
        self._dtype, self._sweeper = np.dtype(dtype), sweeper

    @property
    def array(self) -> AnyFloats:  # type: ignore[override]
        """Refused: there is no such array."""
        raise PipelineError(
            f"the stream {self.name} is made again when it is read and is nowhere held as a whole",
            place=self.observation.name,
            cure="a step whose planning has `sweeps` reads it with `Stream.sweep`",
        )

    @property
    def shape(self) -> tuple[int, int]:
        """(n_det, n_samp)."""
        return self.observation.n_detectors, self.observation.n_samples

    @property
    def dtype(self) -> np.dtype[Any]:
        """Type of its values."""
        return self._dtype

    def sweep(
        self, work: Callable[[slice, slice, AnyFloats], Any]
    ) -> Iterator[tuple[slice, slice, Any]]:
        """See `Stream.sweep`."""
        return self._sweeper(work)


class Store:
    """Arrays for whole streams: in memory up to half of the budget, or in a temporary folder,
    removed at the end.
    """

    def __init__(
        self, memory: int, dtype: type[np.floating[Any]], spare: list[AnyFloats], ledger: Ledger
    ) -> None:
        self._room, self._dtype, self._spare, self._ledger = (
            memory // 2,
            np.dtype(dtype),
            spare,
            ledger,
        )
        self._folder: tempfile.TemporaryDirectory[str] | None = None
        self._live: dict[int, AnyFloats] = {}

    @property
    def held(self) -> int:
        """Bytes in memory, those that wait for the next stream included."""
        return self._in_use + sum(a.nbytes for a in self._spare)

    @property
    def _in_use(self) -> int:
        return sum(a.nbytes for a in self._live.values() if not isinstance(a, np.memmap))

    def fits(self, size: int) -> bool:
        """Tell whether ``size`` more bytes stay within the streams' share of the budget."""
        return self._in_use + size <= self._room

    def allocate(
        self, name: str, shape: tuple[int, int], in_memory: bool = True, dtype: Any = None
    ) -> AnyFloats:
        """An array of anything; a memory map of a file where it does not fit or is not wanted in
        memory.

        ``dtype``: where it is not that of the streams.
        """
        kind = self._dtype if dtype is None else np.dtype(dtype)
        size = shape[0] * shape[1] * kind.itemsize
        if in_memory and self.fits(size):
            alike = [a for a in self._spare if a.shape == shape and a.dtype == kind]
            self._spare[:] = alike[1:]
            if not alike:
                self._spare.clear()
            array = alike[0] if alike else empty(shape, kind)
        else:
            array = self._file(name, shape, kind)
        self._live[id(array)] = array
        self._note()
        return array

    def release(self, arrays: list[AnyFloats]) -> None:
        """Keep memory that is no longer used for the next stream: touching fresh memory costs as
        much as the physics.
        """
        for array in {id(a): a for a in arrays}.values():
            self._live.pop(id(array), None)
            if not isinstance(array, np.memmap) and self.fits(
                array.nbytes + sum(a.nbytes for a in self._spare)
            ):
                self._spare.append(array)
        self._note()

    def drop(self, arrays: list[AnyFloats]) -> None:
        """Give back what no later stream can use."""
        for array in arrays:
            self._live.pop(id(array), None)
        self._note()

    def clear_spare(self) -> None:
        """Give back memory that waits for the next stream."""
        self._spare.clear()
        self._note()

    def close(self) -> None:
        """Remove the temporary folder."""
        if self._folder is not None:
            self._folder.cleanup()

    def _note(self) -> None:
        self._ledger.note(("streams",), self.held)

    def _file(self, name: str, shape: tuple[int, int], dtype: np.dtype[Any]) -> AnyFloats:
        size = shape[0] * shape[1] * dtype.itemsize
        try:
            if self._folder is None:
                self._folder = tempfile.TemporaryDirectory(prefix="zonda-")
            handle, path = tempfile.mkstemp(
                ".stream", name.replace("/", "-"), self._folder.name
            )  # a new file: the old one may still be read
            try:
                _reserve(handle, size)
            finally:
                os.close(handle)
        except OSError as error:
            raise OutputError(
                f"a stream of {size / 1e9:.3g} GB cannot be put there: {error.strerror or error}",
                place=tempfile.gettempdir(),
                cure="raise --memory, or point TMPDIR to a larger disk",
            ) from error
        return np.memmap(path, dtype, "r+", shape=shape)


def _reserve(handle: int, size: int) -> None:
    """Give a file its size, and blocks on the disk: where the disk fills up later, writing to a
    mapping kills the process.
    """
    if size and hasattr(os, "posix_fallocate"):
        os.posix_fallocate(handle, 0, size)
    else:
        os.ftruncate(handle, size)


def columns(array: AnyFloats, samples: slice) -> AnyFloats:
    """(n_det, n) samples of all detectors as an array of its own.

    A spilled stream's are read from its file: around each page that is touched in a mapping the
    system maps up to 64 kB, which is most of a stream whose rows are that short.
    """
    if not isinstance(array, np.memmap):
        return np.array(array[:, samples], order="C")
    found = np.empty((array.shape[0], samples.stop - samples.start), array.dtype)
    whole, size = found.data.cast("B"), found.strides[0]
    mapped: Any = array._mmap  # type: ignore[attr-defined]
    begin = array.ctypes.data - np.frombuffer(mapped, np.uint8).ctypes.data
    with open(str(array.filename), "rb", buffering=0) as file:
        for row in range(array.shape[0]):
            place, left = (
                begin + row * array.strides[0] + samples.start * array.itemsize,
                whole[row * size : (row + 1) * size],
            )
            while left:
                read = _read_at(file, left, place)
                if not read:
                    cure = "do not change files in the temporary folder while zonda runs"
                    raise OutputError(
                        "the temporary file was truncated", place=str(array.filename), cure=cure
                    )
                place, left = place + read, left[read:]
    return found


def _read_at(file: Any, into: memoryview, place: int) -> int:
    """Bytes read into ``into`` from ``place`` on, in one call of the system where there is one."""
    if hasattr(os, "preadv"):
        return os.preadv(file.fileno(), [into], place)
    file.seek(place)
    return int(file.readinto(into))


def free_disk() -> int:
    """Bytes that streams may take in the temporary folder."""
    return int(DISK_SHARE * shutil.disk_usage(tempfile.gettempdir()).free)
