"""Prepares the next observation on a thread of its own while one is executed.

`Operator.prepare` is mostly Python on one thread; the blocks of the observation before it keep the
others busy meanwhile. Nothing depends on it: an observation's preparation reads and writes what
belongs to that observation.
"""

from __future__ import annotations

import threading
import time
from concurrent.futures import ThreadPoolExecutor
from typing import Any


class Ahead:
    """The thread. Close it in any case.

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
