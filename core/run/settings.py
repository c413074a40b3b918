"""Settings with which observations are executed, the CPU time that it took, and the thread that
prepares the next one.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ..types import AnyFloats


class Ahead:
    """Prepares the next observation on a thread of its own while one is executed. Close it in any
    case.

    `Operator.prepare` is mostly Python on one thread; the blocks of the observation before it keep
    the others busy meanwhile. Nothing depends on it: an observation's preparation reads and writes
    what belongs to that observation.

    Parameters
    ----------
    on
        False: nothing is ever prepared ahead.
    """

    def __init__(self, on: bool) -> None:
        self.on = on
        self._pool: ThreadPoolExecutor | None = None
        self._clock: int | None = None
        self._begun: list[Any] = []

    def start(self, execution: Any) -> None:
        """Begin with the preparation of an observation, whose execution will wait for it."""
        if execution is None or not self.on:
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "ahead", initializer=self._note_clock)
        self._begun.append(execution)
        execution.beforehand = self._pool.submit(execution.prepare)

    def seconds(self) -> float:
        """CPU time that the thread has taken, 0 where the system does not tell."""
        return 0.0 if self._clock is None else time.clock_gettime(self._clock)

    def close(self) -> None:
        """End the thread; discard what was prepared for observations that were never run."""
        for execution in self._begun:
            execution.abandon()
        self._begun.clear()
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = self._clock = None

    def _note_clock(self) -> None:
        if hasattr(time, "pthread_getcpuclockid"):
            self._clock = time.pthread_getcpuclockid(threading.get_ident())


Held = Literal["kept", "spilled", "again"]
"""Streams between two segments: in memory, in a temporary file, or nowhere, to be made again block
by block.
"""


@dataclass(frozen=True)
class Settings:
    """Threads, memory and precision of an execution.

    Attributes
    ----------
    threads
        Threads that work on blocks.
    memory
        Bytes for streams and blocks of one band.
    process
        Bytes that the whole process may hold (``--memory``), of which ``memory`` is what is left
        for streams and blocks; None: only ``memory`` counts.
    dtype
        Type of the streams.
    progress
        Progress callback.
    spare
        Memory to use again.
    asked
        The user asked for so much ``memory``.
    fresh
        False in a worker, which still holds what tasks before this one have left: that is no part
        of the forecast.
    place
        The pipeline's name, for errors.
    """

    threads: int = 1
    memory: int = 2 << 30
    dtype: type[np.floating[Any]] = np.float32
    progress: Callable[[int, int, str], None] = lambda done, total, what: None
    spare: list[AnyFloats] = field(default_factory=list)
    process: int | None = None
    asked: bool = False
    fresh: bool = True
    place: str = ""


def megabytes(size: int) -> int:
    """MB to ask for with ``--memory``: what the libraries take differs a little from run to run."""
    return -(-size * 21 // 20_000_000)


@dataclass
class Timer:
    """CPU seconds by (operator label, stage), added up over threads."""

    seconds: dict[tuple[str, str], float] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def add(self, label: str, stage: str, seconds: float) -> None:
        """Add to a stage."""
        with self._lock:
            self.seconds[label, stage] = self.seconds.get((label, stage), 0.0) + seconds

    def of_stage(self, stage: str) -> float:
        """Seconds of one stage of all steps."""
        with self._lock:
            return sum(seconds for (_, which), seconds in self.seconds.items() if which == stage)

    def rows(self) -> list[tuple[str, str, float]]:
        """(label, stage, seconds) in the order in which they first took time."""
        with self._lock:
            return [(*key, seconds) for key, seconds in self.seconds.items()]
