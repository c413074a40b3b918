"""Engines that run tasks: anything with the interface of `concurrent.futures.Executor`.

Warnings of worker processes are kept there, sent with the results, and shown by the main process as
its own. The budget of ``--memory`` is divided among workers before the campaign starts. With MPI
and Dask, whose processes are started by others, each process has the whole budget, and so has a job
of an array (``--task``).
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import platform
import signal
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import (
    BrokenExecutor,
    CancelledError,
    Executor,
    Future,
    ProcessPoolExecutor,
)
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar, cast

from ..errors import PipelineError
from ..machine import (
    SAFE,
    available_memory,
    available_threads,
    needed,
    one_blas_thread,
    resident_memory,
    restore,
    safe_path,
    without_script,
)
from ..storage.files import first_line

if TYPE_CHECKING:
    from ..campaign.settings import Engine, Tls


SCHEDULER_FILE_WAIT = 20.0
"""Longest wait for a scheduler file that is missing or incomplete, s."""


@dataclass
class Pool:
    """An executor at work, whose workers were started by others.

    Attributes
    ----------
    executor
        Takes tasks. None: this process is one of MPI's workers, and has done its part.
    workers
        Tasks that run at once.
    ahead
        Tasks that may wait in the executor's own queue, so that no worker is idle while results are
        noted down.
    threads, memory
        For each task; None: the worker decides (all it may use). The memory is that of its whole
        process.
    asked
        Memory that the user asked for; None: nothing.
    """

    executor: Executor | None
    workers: int
    ahead: int = 0
    threads: int | None = None
    memory: int | None = None
    asked: int | None = None

    def start(self, workers: int | None = None) -> bool:
        """Start other workers in place of these; False if zonda did not start them."""
        return False

    def stop(self) -> bool:
        """End the workers at once; False if zonda did not start them."""
        return False


class ProcessPool(Pool):
    """Worker processes that this process starts.

    ``fixed``: the user asked for this number of workers.
    """

    def __init__(self, workers: int | None, threads: int | None, memory: int | None) -> None:
        count = workers or available_threads()
        share = (memory or available_memory() // 2) // count
        super().__init__(None, count, 1, threads, share, memory)
        self.fixed = workers is not None
        self._asked_threads = threads
        self.start()

    def start(self, workers: int | None = None) -> bool:
        """Start the workers, as many as before or another number of them."""
        self.stop()
        self.workers = workers or self.workers
        self.threads = self._asked_threads or max(1, available_threads() // self.workers)
        safe = os.environ.get(SAFE)
        with safe_path():  # its queues start a process that counts them
            self.executor = _Workers(
                self.workers,
                mp_context=get_context("spawn"),
                initializer=begin_worker,
                initargs=(safe,),
            )
        return True

    def stop(self) -> bool:
        """End the processes, at work or not."""
        if self.executor is not None:
            for process in list((getattr(self.executor, "_processes", None) or {}).values()):
                process.terminate()
            self.executor.shutdown(wait=True, cancel_futures=True)
        return True


class _Workers(ProcessPoolExecutor):
    """Processes that ignore Ctrl-C from their start, imports included."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """See `Executor.submit`."""
        with safe_path(), without_script(), _ctrl_c_held_back():
            return super().submit(fn, *args, **kwargs)


class SerialExecutor(Executor):
    """Runs each call at once, in this thread."""

    def submit(self, fn: Callable[..., Any], /, *args: Any, **kwargs: Any) -> Future[Any]:
        """The finished future of the call."""
        future: Future[Any] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as err:
            future.set_exception(err)
        return future


def engine_failed(err: BaseException) -> bool:
    """True if a call did not run to its end for a reason of the engine: a worker that is gone, a
    scheduler that is not there.
    """
    return isinstance(err, BrokenExecutor | CancelledError) or type(err).__module__.partition(".")[
        0
    ] in ("distributed", "dask")


def engine(
    name: Engine,
    *,
    workers: int | None = None,
    threads: int | None = None,
    memory: int | None = None,
    scheduler: str | None = None,
    tls: Tls | None = None,
) -> contextlib.AbstractContextManager[Pool]:
    """An engine, open while the context lasts.

    Parameters
    ----------
    workers
        Of ``processes``; default: as many as CPUs. MPI and Dask have those that were started.
    threads, memory
        Threads for each task, and memory of the whole campaign on this machine (with MPI and Dask:
        of each process); default: the machine's CPUs, and half of its free memory, shared among the
        workers. `share_out` divides and checks it.

    Raises
    ------
    InputError
        A package is missing.
    PipelineError
        MPI has one process, or the scheduler of Dask is not named or cannot be reached.
    """
    if name == "processes":
        return _processes(workers, threads, memory)
    if name == "mpi":
        return _mpi(threads, memory)
    if name == "dask":
        return _dask(scheduler, tls, threads, memory)
    return contextlib.nullcontext(Pool(SerialExecutor(), 1, 0, threads, memory, asked=memory))


@contextlib.contextmanager
def _processes(workers: int | None, threads: int | None, memory: int | None) -> Iterator[Pool]:
    pool = ProcessPool(workers, threads, memory)
    try:
        yield pool
    except BaseException:
        pool.stop()
        raise
    if pool.executor is not None:
        pool.executor.shutdown()


@contextlib.contextmanager
def _ctrl_c_held_back() -> Iterator[None]:
    """Block SIGINT in this thread and in the processes that it starts, where the system can; one
    that came is delivered after.
    """
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    from multiprocessing import resource_tracker

    resource_tracker.ensure_running()  # it unblocks SIGINT when it starts
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def begin_worker(safe: str | None = None) -> None:
    """Prepare a new worker process: it leaves Ctrl-C and warnings to the main process, and ends
    with it.

    ``safe``: ``PYTHONSAFEPATH`` of the main process.
    """
    restore(safe)
    keep_warnings()
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if hasattr(signal, "pthread_sigmask"):
        signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    one_blas_thread()
    from multiprocessing import connection, parent_process

    parent = parent_process()
    if parent is None:
        return

    def watch() -> None:
        connection.wait([parent.sentinel])
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


@contextlib.contextmanager
def _mpi(threads: int | None, memory: int | None) -> Iterator[Pool]:
    try:
        mpi = needed("mpi4py.MPI", "mpi", "engine mpi")
        futures = needed("mpi4py.futures", "mpi", "engine mpi")
    except RuntimeError as err:  # mpi4py is there, the library is not
        text = f"MPI cannot be loaded: {first_line(err)}"
        cure = "install Open MPI or MPICH"
        raise PipelineError(text, place="engine mpi", cure=cure) from None
    size = mpi.COMM_WORLD.Get_size()
    if size < 2:
        raise PipelineError(
            "there is one MPI process alone, which leaves no worker",
            place="engine mpi",
            cure="start at least two: mpiexec -n 8 zonda run FILE --engine mpi",
        )
    beside = mpi.COMM_WORLD.Split_type(mpi.COMM_TYPE_SHARED).Get_size()  # on this machine
    with futures.MPICommExecutor(mpi.COMM_WORLD, root=0) as executor:
        mine = max(1, beside - 1) if size == beside else beside
        # true if each process has CPUs of its own, as srun gives them
        bound = available_threads() < (os.cpu_count() or 1)
        threads = threads or (available_threads() if bound else max(1, available_threads() // mine))
        yield Pool(
            cast(Executor | None, executor),
            size - 1,
            size - 1,
            threads,
            memory or available_memory() // 2 // mine,
            asked=memory,
        )


@contextlib.contextmanager
def _dask(
    scheduler: str | None,
    tls: Tls | None,
    threads: int | None,
    memory: int | None,
) -> Iterator[Pool]:
    distributed, config = (
        needed(name, "dask", "engine dask") for name in ("distributed", "dask.config")
    )
    for logger in (
        "distributed",
        "distributed.client",
        "distributed.core",
        "tornado",
        "tornado.application",
    ):
        # errors are reported without Dask's traceback
        logging.getLogger(logger).setLevel(logging.CRITICAL)
    if scheduler is None:
        raise PipelineError(
            "no Dask scheduler is named",
            place="engine dask",
            cure=(
                "write campaign.scheduler: tcp://host:8786, or use --scheduler; zonda connects"
                " nowhere of itself"
            ),
        )
    security = None
    cure = "is it running there?"
    if tls is not None:
        security = distributed.Security(
            tls_ca_file=tls.ca_file,
            tls_client_cert=tls.cert,
            tls_client_key=tls.key,
            require_encryption=True,
        )
    try:
        address = _address(scheduler)
        if address.startswith("tls://"):
            cure = (
                "is it running there, and are its certificates and yours signed by the same"
                " authority (ca_file)?"
            )
            if security is not None or not config.get(
                "distributed.client.security-loader",
                None,
            ):
                _check_certificates(security or distributed.Security(), address)
        client = distributed.Client(address, security=security, timeout=20, set_as_default=False)
    except (OSError, ValueError, TypeError, KeyError) as err:
        why = str(err).splitlines()[0] if str(err) else type(err).__name__
        raise PipelineError(
            f"cannot reach the Dask scheduler: {why}",
            place=scheduler,
            cure=cure,
        ) from None
    with client:
        try:
            client.wait_for_workers(1, timeout=600)
        except TimeoutError:
            raise PipelineError(
                "the Dask scheduler has had no worker for ten minutes",
                place=scheduler,
            ) from None
        workers = client.scheduler_info(n_workers=-1)["workers"].values()
        # a Dask worker does as many tasks at once as it has threads
        count = max(1, sum(int(w["nthreads"]) for w in workers))
        limits = [
            int(w["memory_limit"]) // int(w["nthreads"]) for w in workers if w.get("memory_limit")
        ]
        yield Pool(
            client.get_executor(pure=False, retries=0),
            count,
            count,
            threads or 1,
            memory or min(limits, default=0) // 2 or None,
            asked=memory,
        )


def _address(scheduler: str) -> str:
    """Address of the scheduler: the name itself, or the address in the scheduler file of that name.
    A scheduler that is starting may not have written it yet.
    """
    if "://" in scheduler or not (scheduler.endswith(".json") or Path(scheduler).is_file()):
        return scheduler
    end = time.monotonic() + SCHEDULER_FILE_WAIT
    while True:
        try:
            return str(json.loads(Path(scheduler).read_text())["address"])
        except (OSError, ValueError, TypeError, KeyError) as err:
            if time.monotonic() > end:
                why = err.strerror if isinstance(err, OSError) else f"{type(err).__name__}: {err}"
                raise ValueError(f"its file cannot be read: {why}") from None
            time.sleep(0.1)


def _check_certificates(security: Any, address: str) -> None:
    """Raise `PipelineError` where this side's certificates are missing or unfit; Dask would say
    neither which nor where.
    """
    cure = (
        "name them in campaign.tls, or in Dask's own configuration: distributed.comm.tls.ca-file,"
        " client.cert, client.key"
    )
    for name, path in [
        ("ca_file", security.tls_ca_file),
        ("cert", security.tls_client_cert),
        ("key", security.tls_client_key),
    ]:
        if not path and name != "key":  # which may be in the same file as cert
            raise PipelineError(f"no {name} for TLS is named", place=address, cure=cure)
        # Dask takes the text of a certificate, too
        if path and "\n" not in path and not Path(path).is_file():
            raise PipelineError(f"{name} of TLS: there is no file {path}", place=address, cure=cure)
    try:
        security.get_connection_args("client")
    except (OSError, ValueError) as err:
        raise PipelineError(
            f"the certificates for TLS cannot be used: {err}",
            place=address,
            cure=cure,
        ) from None


R = TypeVar("R")

Warned = tuple[str, type[Warning], str, int]
"""Text, category, file and line of a warning."""

Registry = dict[str | tuple[str, type[Warning], int], int]
"""Warnings that were shown, as `warnings` records them in a module."""

_kept: list[Warned] = []
_lock = threading.Lock()
_at_work: list[Any] = []
"""Functions that showed warnings before this process kept them, one for each call at work in it."""


def here() -> str:
    """Name of this process."""
    return f"{platform.node()} {os.getpid()}"


def keep_warnings() -> None:
    """Keep the warnings of this process for the main process; they are not written to stderr."""
    warnings.showwarning = _keep_warning


def with_warnings(main: str, function: Callable[..., R], *arguments: Any) -> tuple[R, list[Warned]]:
    """The result of a call, and the warnings that this process has kept; none in ``main`` (`here`),
    which shows them itself.
    """
    if here() == main:
        return function(*arguments), []
    with _kept_during():
        result = function(*arguments)
    with _lock:
        found = _kept.copy()
        _kept.clear()
    return result, found


@contextlib.contextmanager
def _kept_during() -> Iterator[None]:
    """Keep the warnings of all threads until the last call in this process has ended (a process of
    Dask may work on several).
    """
    with _lock:
        _at_work.append(warnings.showwarning)
        keep_warnings()
    try:
        yield
    finally:
        with _lock:
            before = _at_work.pop()
            if not _at_work:
                warnings.showwarning = before


def show_warnings(found: Sequence[Warned], shown: Registry) -> None:
    """Show warnings of another process. ``shown``: those that were shown already; they are not
    shown again, unless the user's filters say so.
    """
    for text, category, file, line in found:
        warnings.warn_explicit(text, category, file, line, registry=shown)


def _keep_warning(
    message: Warning | str,
    category: type[Warning],
    filename: str,
    lineno: int,
    *more: Any,
    **others: Any,
) -> None:
    # others may not be importable in the main process
    known = category if category.__module__ == "builtins" else UserWarning
    _kept.append((str(message), known, filename, lineno))


MAIN = 320_000_000
"""Bytes of the main process, which plans, and of the small helper that Python starts beside the
workers.
"""
GROWTH = 20_000_000
"""Bytes by which the main process may still grow."""


def share_out(pool: Pool, need: int, place: str) -> None:
    """Set what each worker may hold (``pool.memory``), and where fewer workers fit, their number.

    Parameters
    ----------
    need
        Least bytes with which any task runs (`core.run.budget`); 0: not known.
    place
        The campaign's name, for errors.

    Raises
    ------
    PipelineError
        Where a worker that can do the tasks does not fit: before any of them starts.
    """
    if not need:
        return
    if not isinstance(pool, ProcessPool):
        _each(pool, need, place)
        return
    main = max(resident_memory() + GROWTH, MAIN)
    free = available_memory()
    budget = pool.asked - main if pool.asked else max(free // 2, min(need, free))
    fitting = max(budget // need, 0)
    if fitting < (pool.workers if pool.fixed else 1):
        if pool.asked or pool.workers * need > free:
            _refuse(pool, need, main, place)
        budget = pool.workers * need
        fitting = pool.workers
    if fitting < pool.workers:
        pool.start(fitting)
    pool.memory = budget // pool.workers


def _each(pool: Pool, need: int, place: str) -> None:
    """Check the budget of processes that have one each; take it back where nobody asked for it."""
    if pool.memory is not None and pool.memory < need and pool.asked is None:
        pool.memory = None  # no explicit budget: the worker may use its own free memory
    if pool.memory is not None and pool.memory < need:
        raise PipelineError(
            f"a task needs {_megabytes(need)}; the memory budget of each process is"
            f" {_megabytes(pool.memory)}",
            place=place,
            cure=f"use --memory {_megabytes(need, '')}, or shorter scans",
        )


def _refuse(pool: ProcessPool, need: int, main: int, place: str) -> None:
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
