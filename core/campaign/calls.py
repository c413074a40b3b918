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
    """A list of calls, one for each item: how they are made and how their results are recorded."""

    def __init__(self) -> None:
        self.stop = False
        """Set to begin no more of them."""
        self.attempts = Counter[T]()
        """How often each was begun."""

    @abstractmethod
    def call(self, item: T) -> tuple[Callable[..., R], *tuple[Any, ...]]:
        """A function and its arguments, to be sent to a worker."""

    def began(self, items: list[T]) -> None:
        """Record that these calls are about to be sent."""

    @abstractmethod
    def ended(self, item: T, result: R | Lost) -> bool:
        """End a call; True if it is tried again."""


def carry_out(work: Work[T, R], items: Sequence[T], pool: Pool, folder: Path) -> None:
    """Make all calls; where this raises, workers of this machine have ended.

    A broken pool is replaced. Whatever was at work when it broke is tried again at the end, one
    call at a time, so that one that kills its worker does not take others with it.

    Raises
    ------
    PipelineError
        Where the engine has stopped for good.
    """
    waiting, suspects = deque(items), deque[T]()
    at_work: dict[Future[tuple[R, list[Warned]]], T] = {}
    ended: set[Future[tuple[R, list[Warned]]]] = set()
    shown: Registry = {}
    try:
        while True:
            batch: list[T] = []
            for future in ended:
                item, result = at_work.pop(future), _result(future, folder, shown)
                if work.ended(item, result):
                    (suspects if isinstance(result, Lost) else waiting).append(item)
            room = pool.workers + pool.ahead - len(at_work)
            while waiting and not work.stop and len(batch) < room:
                batch.append(waiting.popleft())
            if suspects and not batch and not at_work and not work.stop:
                batch.append(suspects.popleft())
            work.attempts.update(batch)
            work.began(batch)
            for item in batch:
                at_work[_submit(pool, *work.call(item))] = item
            if not at_work:
                return
            ended, _ = wait(at_work, return_when=FIRST_COMPLETED)
            if any(isinstance(f.exception(), BrokenExecutor) for f in ended if not f.cancelled()):
                ended, _ = wait(at_work)
                if pool.remake is None:
                    raise _gone(folder)
                pool.executor = pool.remake()
    except BaseException:
        for future in at_work:
            future.cancel()
        if pool.stop is not None:
            pool.stop()
        raise


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


def _result(future: Future[tuple[R, list[Warned]]], folder: Path, shown: Registry) -> R | Lost:
    try:
        result, found = future.result()
    except CancelledError:
        raise _gone(folder) from None
    except (
        Exception
    ) as err:  # of the engine: a Dask worker that died again and again, a task that cannot be sent
        return Lost(err)
    show(found, shown)
    return result


def _gone(folder: Path) -> PipelineError:
    return PipelineError("the engine has stopped", place=str(folder), cure=f"zonda resume {folder}")
