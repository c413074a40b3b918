"""``--memory`` of a campaign: the budget of all its processes on this machine, divided among
workers before it starts.

With MPI and Dask, whose processes are started by others, and for a job of an array (``--task``) it
is that of one process or job.
"""

from __future__ import annotations

from ..errors import PipelineError
from ..machine import available_memory, resident_memory
from .engines import Pool

MAIN = 320_000_000
"""Bytes of the main process, which plans, and of the small helper that Python starts beside the
workers.
"""
GROWTH = 20_000_000
"""Bytes more than it holds now that it may come to hold."""


def share_out(pool: Pool, need: int, place: str) -> None:
    """Set what each worker may hold (``pool.memory``), and where fewer workers fit, their number.

    Parameters
    ----------
    need
        Least bytes with which any task runs (`core.run.forecast.need`); 0: not known.
    place
        The campaign's name, for errors.

    Raises
    ------
    PipelineError
        Where a worker that can do the tasks does not fit: before any of them starts.
    """
    if not need:
        return
    if pool.resize is None:
        _each(pool, need, place)
        return
    main, free = max(resident_memory() + GROWTH, MAIN), available_memory()
    budget = pool.asked - main if pool.asked else max(free // 2, min(need, free))
    fitting = max(budget // need, 0)
    if fitting < (pool.workers if pool.fixed else 1):
        if pool.asked or pool.workers * need > free:
            _refuse(pool, need, main, place)
        budget, fitting = pool.workers * need, pool.workers
    if fitting < pool.workers:
        pool.resize(fitting)
    pool.memory = budget // pool.workers


def _each(pool: Pool, need: int, place: str) -> None:
    """Budgets where every process has one of its own."""
    if pool.memory is not None and pool.memory < need and pool.asked is None:
        pool.memory = None  # half of a share: the task may have more, if that is free where it runs
    if pool.memory is not None and pool.memory < need:
        raise PipelineError(
            f"a task needs {_megabytes(need)}; the memory budget of each process is"
            f" {_megabytes(pool.memory)}",
            place=place,
            cure=f"use --memory {_megabytes(need, '')}, or shorter scans",
        )


def _refuse(pool: Pool, need: int, main: int, place: str) -> None:
    workers = pool.workers if pool.fixed else 1
    has = (
        f"the memory budget is {_megabytes(pool.asked)}"
        if pool.asked
        else f"{_megabytes(available_memory())} are free"
    )
    each = f"each of {workers} workers needs" if workers > 1 else "a worker needs"
    cures = (
        [f"use --memory {_megabytes(workers * need + main * 23 // 20, '')}"] if pool.asked else []
    )
    if workers > 1:
        cures.append(
            f"--workers 1 with --memory {_megabytes(need + main * 23 // 20, '')}"
            if pool.asked
            else "use --workers 1"
        )
    raise PipelineError(
        f"{each} {_megabytes(need)} for its tasks, and the main process holds {_megabytes(main)};"
        f" {has}",
        place=place,
        cure="; or ".join([*cures, "make the scans shorter"]),
    )


def _megabytes(size: int | None, space: str = " ") -> str:
    return f"{-(-(size or 0) // 1_000_000)}{space}MB"
