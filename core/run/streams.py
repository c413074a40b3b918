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

import math
import os
import shutil
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..data import Observation, Stream
from ..errors import OutputError, PipelineError
from ..numerics.chunks import empty
from ..numerics.smooth import SmoothField
from ..stream import forget_pages
from ..types import AnyFloats
from .settings import Settings

DISK_SHARE = 0.9
"""Of the free disk that streams may take."""

LEAST_FILE, AT_A_TIME = 1 << 16, 1 << 22
"""Bytes of an array that is put into a file, and numbers that are written at a time."""


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
    def dtype(self) -> np.dtype[Any]:
        """Type of its values."""
        return self._dtype

    def sweep(
        self,
        work: Callable[[slice, slice, AnyFloats], Any],
    ) -> Iterator[tuple[slice, slice, Any]]:
        """See `Stream.sweep`."""
        return self._sweeper(work)


class Store:
    """Arrays for whole streams: in memory up to half of the budget, or in a temporary folder,
    removed at the end.
    """

    def __init__(self, settings: Settings) -> None:
        self._room, self._spare = settings.memory // 2, settings.spare
        self._dtype: np.dtype[Any] = np.dtype(settings.dtype)
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
        self,
        name: str,
        shape: tuple[int, int],
        in_memory: bool = True,
        dtype: Any = None,
    ) -> AnyFloats:
        """An array of anything; a memory map of a file where it does not fit or is not wanted in
        memory.

        ``dtype``: where it is not that of the streams.
        """
        kind = self._dtype if dtype is None else np.dtype(dtype)
        size = shape[0] * shape[1] * kind.itemsize
        if in_memory and self.fits(size):
            alike = [a for a in self._spare if a.shape == shape and a.dtype == kind]
            self._spare[:] = alike[1:]  # arrays of another shape are given back
            array = alike[0] if alike else empty(shape, kind)
        else:
            array = self._file(name, shape, kind)
        self._live[id(array)] = array
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

    def drop(self, arrays: list[AnyFloats]) -> None:
        """Give back what no later stream can use."""
        for array in arrays:
            self._live.pop(id(array), None)

    def clear_spare(self) -> None:
        """Give back memory that waits for the next stream."""
        self._spare.clear()

    def close(self) -> None:
        """Remove the temporary folder."""
        if self._folder is not None:
            self._folder.cleanup()

    def _file(self, name: str, shape: tuple[int, int], dtype: np.dtype[Any]) -> AnyFloats:
        size = shape[0] * shape[1] * dtype.itemsize
        try:
            if self._folder is None:
                self._folder = tempfile.TemporaryDirectory(prefix="zonda-")
            handle, path = tempfile.mkstemp(
                ".stream",
                name.replace("/", "-"),
                self._folder.name,
            )  # a new file: the old one may still be read
            try:
                _reserve(handle, size)
            finally:
                os.close(handle)
        except OSError as error:
            raise _no_room(size, error) from error
        return np.memmap(path, dtype, "r+", shape=shape)


@dataclass
class Files:
    """Arrays of products that do not fit in memory, in temporary files without a name: they are
    gone with the last array in them, also if the process is killed.

    Attributes
    ----------
    room
        Bytes that products may still take in memory.
    """

    room: int

    def fits(self, size: int) -> bool:
        """Tell whether ``size`` bytes of a product fit in memory or on the disk."""
        return size <= max(self.room, free_disk())

    def needed(self, size: int, place: str, cure: str) -> bool:
        """Tell whether ``size`` bytes of a product go into files; else they take their room.

        Raises
        ------
        PipelineError
            Where the disk has no room for them either; ``cure``: what lessens them.
        """
        if size <= self.room:
            self.room -= size
            return False
        if size > (disk := free_disk()):
            raise PipelineError(
                f"{size / 1e9:.3g} GB fit neither in memory ({self.room / 1e9:.3g} GB) nor on the"
                f" disk ({disk / 1e9:.3g} GB free in {tempfile.gettempdir()})",
                place=place,
                cure=f"{cure}, or point TMPDIR to a larger disk",
            )
        return True

    def put(self, tree: Any) -> Any:
        """A tree of mappings, lists and arrays with its larger arrays in files, memory-mapped.
        Raises OutputError where the disk is full.
        """
        if isinstance(tree, Mapping):
            return {key: self.put(value) for key, value in tree.items()}
        if isinstance(tree, list | tuple):
            return [self.put(value) for value in tree]
        there = isinstance(tree, np.memmap)
        if there or not isinstance(tree, np.ndarray) or tree.nbytes < LEAST_FILE:
            return tree
        array = in_file(tree.shape, tree.dtype)
        to, of = array.reshape(-1), tree.reshape(-1)
        for start in range(0, of.size, AT_A_TIME):
            to[start : start + AT_A_TIME] = of[start : start + AT_A_TIME]
            forget_pages(array)
        return array


def in_file(shape: Any, dtype: Any) -> NDArray[Any]:
    """An array of zeros in a temporary file without a name, memory-mapped. Raises OutputError where
    the disk is full.
    """
    size = math.prod(np.atleast_1d(shape).tolist()) * np.dtype(dtype).itemsize
    if not size:
        return np.zeros(shape, dtype)
    with tempfile.TemporaryFile(prefix="zonda-") as file:
        try:
            _reserve(file.fileno(), size)
        except OSError as error:
            raise _no_room(size, error) from error
        return np.memmap(file, dtype, "r+", shape=shape)


def _no_room(size: int, error: OSError) -> OutputError:
    return OutputError(
        f"{size / 1e9:.3g} GB cannot be put there: {error.strerror or error}",
        place=tempfile.gettempdir(),
        cure="raise --memory, or point TMPDIR to a larger disk",
    )


def _reserve(handle: int, size: int) -> None:
    """Give a file its size, and blocks on the disk: where the disk fills up later, writing to a
    mapping kills the process.
    """
    if size and hasattr(os, "posix_fallocate"):
        os.posix_fallocate(handle, 0, size)
    else:
        os.ftruncate(handle, size)


def free_disk() -> int:
    """Bytes that streams may take in the temporary folder."""
    return int(DISK_SHARE * shutil.disk_usage(tempfile.gettempdir()).free)
