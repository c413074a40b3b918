"""Carry out many calls on an engine, also where workers are killed."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Generic, TypeVar

from ..errors import PipelineError
from .engines import Pool, Registry, Warned, call, here, show

T = TypeVar("T")
R = TypeVar("R")


@dataclass(frozen=True)
class Lost:
    """The result of a call that did not end: its worker was killed, or the engine could not send
    it.
    """

    error: Exception

    def __str__(self) -> str:
        if isinstance(self.error, BrokenExecutor):
            return (
                "its worker process was killed (by the system for want of memory?), or another one"
                " beside it"
            )
        return f"{type(self.error).__name__}: {self.error}"


class Work(ABC, Generic[T, R]):
    """A list of calls on an engine, one for each item: how they are made and how their results are
    recorded.
    """

    def __init__(self, folder: Path, pool: Pool) -> None:
        self.folder, self.pool = folder, pool
        self.stop = False
        """Set to begin no more of them."""
        self.attempts = Counter[T]()
        """How often each was begun."""
        self._shown: Registry = {}

    @abstractmethod
    def call(self, item: T) -> tuple[Callable[..., R], *tuple[Any, ...]]:
        """A function and its arguments, to be sent to a worker."""

    def began(self, items: list[T]) -> None:
        """Record that these calls are about to be sent."""

    @abstractmethod
    def ended(self, item: T, result: R | Lost) -> bool:
        """End a call; True if it is tried again."""

    def carry_out(self, items: Sequence[T]) -> None:
        """Make all calls; where this raises, workers of this machine have ended.

        A broken pool is replaced. Whatever was at work when it broke is tried again at the end, one
        call at a time, so that one that kills its worker does not take others with it.

        Raises
        ------
        PipelineError
            Where the engine has stopped for good.
        """
        pool, waiting, suspects = self.pool, deque(items), deque[T]()
        at_work: dict[Future[tuple[R, list[Warned]]], T] = {}
        ended: set[Future[tuple[R, list[Warned]]]] = set()
        try:
            while True:
                batch: list[T] = []
                for future in ended:
                    item, result = at_work.pop(future), self._result(future)
                    if self.ended(item, result):
                        (suspects if isinstance(result, Lost) else waiting).append(item)
                room = pool.workers + pool.ahead - len(at_work)
                while waiting and not self.stop and len(batch) < room:
                    batch.append(waiting.popleft())
                if suspects and not batch and not at_work and not self.stop:
                    batch.append(suspects.popleft())
                self.attempts.update(batch)
                self.began(batch)
                for item in batch:
                    at_work[_submit(pool, *self.call(item))] = item
                if not at_work:
                    return
                ended, _ = wait(at_work, return_when=FIRST_COMPLETED)
                if any(
                    isinstance(f.exception(), BrokenExecutor) for f in ended if not f.cancelled()
                ):
                    ended, _ = wait(at_work)
                    if not pool.start():
                        raise self._gone()
        except BaseException:
            for future in at_work:
                future.cancel()
            pool.stop()
            raise

    def _result(self, future: Future[tuple[R, list[Warned]]]) -> R | Lost:
        """The result of a call, whose warnings are shown."""
        try:
            result, found = future.result()
        except CancelledError:
            raise self._gone() from None
        except Exception as err:
            # of the call, or of the engine: a Dask worker that died again and again, a task that
            # cannot be sent
            return Lost(err)
        show(found, self._shown)
        return result

    def _gone(self) -> PipelineError:
        cure = f"zonda resume {self.folder}"
        return PipelineError("the engine has stopped", place=str(self.folder), cure=cure)


def _submit(
    pool: Pool, function: Callable[..., R], *arguments: Any
) -> Future[tuple[R, list[Warned]]]:
    assert pool.executor is not None
    try:
        return pool.executor.submit(call, here(), function, *arguments)
    except Exception as err:
        future: Future[tuple[R, list[Warned]]] = Future()
        future.set_exception(
            err if isinstance(err, BrokenExecutor) else CancelledError()
        )  # a worker was killed; all is gone
        return future
