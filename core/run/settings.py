"""Settings with which observations are executed, and the CPU time that it took."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np

from ..types import AnyFloats

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
