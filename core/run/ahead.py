"""Prepares the next observation, or the first one of the next run, on a thread of its own while one is executed.

`Operator.prepare` is mostly Python on one thread; the blocks of the observation before it keep the others busy meanwhile. Nothing
depends on it: an observation's preparation reads and writes what belongs to that observation. Only operators that say so
(`Operator.prepares_ahead`) take part; from the first other one on, preparation waits for its turn.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from ..data import Observation
from ..operator import Operator
from ..plan.planning import planning_of
from .forecast import spares
from .settings import Settings

if TYPE_CHECKING:
    from .execution import Execution


def ready(operator: Operator) -> bool:
    """Whether it can be configured and prepared ahead: it says so itself, or it has neither to do. A class that overrides one of
    the two must say so anew."""
    mine = type(operator)
    neither = mine.prepare is Operator.prepare and mine.configure is Operator.configure
    return neither or operator.declares("prepares_ahead", "prepare", "configure")


def reach(operators: Sequence[Operator]) -> int:
    """How many of the operators, from the first on, can be prepared ahead. None where one that cannot has a `configure`: all
    configure before any prepares."""
    waiting = [not ready(o) for o in operators]
    if any(w and type(o).configure is not Operator.configure for w, o in zip(waiting, operators, strict=True)):
        return 0
    return waiting.index(True) if any(waiting) else len(operators)


def memory(operators: Sequence[Operator], observations: Sequence[Observation]) -> int:
    """Bytes that an observation prepared ahead holds."""
    longest = max(observations, key=lambda o: o.n_detectors * o.n_samples)
    return sum(planning_of(o).memory(longest) for o in operators[: reach(operators)] if not o.product_only)


def affordable(operators: Sequence[Operator], observations: Sequence[Observation], settings: Settings) -> int | None:
    """`memory`, where streams and blocks do the same without it; None where it would take room that they need."""
    size = memory(operators, observations)
    longest = max(observations, key=lambda o: o.n_detectors * o.n_samples)
    return size if spares(operators, longest, settings, size) else None


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
        self._begun: Execution | None = None

    def start(self, execution: Execution | None) -> None:
        """Begin with the preparation of an observation, which `Execution.run` will wait for."""
        if execution is None or not self.on or not reach(execution.operators):
            return
        if self._pool is None:
            self._pool = ThreadPoolExecutor(1, "ahead", initializer=self._note_clock)
        self._begun, execution.beforehand = execution, self._pool.submit(execution.prepare_ahead)

    def seconds(self) -> float:
        """CPU time that the thread has taken, 0 where the system does not tell."""
        return 0.0 if self._clock is None else time.clock_gettime(self._clock)

    def close(self) -> None:
        """End the thread; where its last observation was never run, discard what was prepared for it."""
        if self._begun is not None:
            self._begun.abandon()
        if self._pool is not None:
            self._pool.shutdown()
        self._pool = self._clock = self._begun = None

    def _note_clock(self) -> None:
        if hasattr(time, "pthread_getcpuclockid"):
            self._clock = time.pthread_getcpuclockid(threading.get_ident())
