"""Begin, work through, resume and finish a campaign."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Future, wait
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from ..errors import InputError, OutputError, PipelineError, ZondaError
from ..storage.files import check_output_folder, discard
from . import parts
from .engines import Pool, engine_failed
from .folder import (
    RESOLVED,
    Say,
    check_free,
    clean,
    make_way,
    open_log,
    opened,
    publish,
    readable,
    sources_of,
    verify,
    write_sources,
)
from .job import FILE, LOG, TASKS, Job, Task, digest_of_text, plural
from .log import Log, Row
from .machines import Watch
from .memory import share_out
from .prepare import Source, changed, restore_layout
from .prepare import job as prepare
from .reduce import Combined, combine
from .task import Order, Outcome, perform, product_path


@dataclass
class Result:
    """How a campaign went.

    Attributes
    ----------
    tally
        Of all combinations: rows (combination, who, what, value, whether it is a count).
    tasks
        Number of tasks that were run now.
    seconds
        Wall time of the tasks; ``samples`` in them.
    """

    folder: Path
    tally: list[tuple[str, str, str, str, bool]] = field(default_factory=list)
    tasks: int = 0
    samples: int = 0
    seconds: float = 0.0


def begin(
    sources: Sequence[Source],
    folder: Path,
    command: str,
    pool: Pool,
    say: Say,
    *,
    keep: Sequence[str] = (),
    drop: Sequence[str] = (),
    prune_all: bool = True,
) -> Result:
    """Run a new campaign. The caller holds the folder's lock.

    Raises
    ------
    OutputError
        Where the folder holds an unfinished campaign, or cannot be written.
    ZondaError
        For mistakes in the campaign; and at the end where tasks have failed.
    """
    check_output_folder(folder)
    check_free(folder)
    if (folder / RESOLVED).exists() and not (folder / FILE).exists():
        say(f"{folder} holds products of an earlier run: those of the same names are replaced, others stay")
    make_way(folder)
    try:
        made = prepare(sources, folder, command, keep, drop, prune_all, _progress())
    except BaseException:
        make_way(folder)  # of the layouts of a campaign that does not begin
        raise
    try:
        share_out(pool, made.need, made.name)
    except BaseException:
        make_way(folder)
        raise
    _describe(made, folder, say)
    write_sources(made, folder)
    with contextlib.closing(open_log(folder / LOG, made)) as log:
        made.write(folder)
        return _work(made, folder, log, pool, _watch(made.same_machine, folder, [log.rows()], say), made.tasks)


def resume(folder: Path, pool: Pool, say: Say, *, anyway: bool = False, same_machine: bool | None = None) -> Result:
    """Go on with a campaign: what is done is verified, what is missing is run. The caller holds the folder's lock.

    ``same_machine``: refuse what another kind of machine made, or do not; default: as the campaign has it.

    Raises
    ------
    InputError
        Where there is no campaign, its file is damaged, or zonda or a file has changed (not with ``anyway``).
    """
    job = Job.read(folder)
    strict = job.same_machine if same_machine is None else same_machine
    check_unchanged(job, folder, anyway)
    share_out(pool, job.need, job.name)
    clean(folder)
    log = opened(folder, job, say)
    with contextlib.closing(log):
        combined = log.combined(job.layouts)
        for number, combination in enumerate(job.combinations):
            if number not in combined:
                try:
                    parts.read(folder / TASKS / combination.layout_file(number), "layout", combination.layout)
                except InputError:
                    restore_layout(job, folder, number)
        missing = verify(job, folder, log, combined, say, strict)
        return _work(job, folder, log, pool, _watch(strict, folder, [log.rows()], say), missing)


def share(
    sources: Sequence[Source], folder: Path, command: str, pool: Pool, say: Say, which: int, of: int, **options: Any
) -> Result:
    """Run every ``of``-th task from the ``which``-th on (counted from 1): a job of an array. Combines nothing.

    The first job there works the campaign out; all write their own job log. The caller holds the lock of its share.
    """
    from zonda import __version__

    check_output_folder(folder)
    if not (folder / FILE).exists():
        made = prepare(sources, folder, command, say=_progress(), **options)
        write_sources(made, folder)
        publish(made, folder)
    job = Job.read(folder)
    if job.source != tuple(s.file.resolved_yaml() for s in sources) or job.version != __version__:
        raise OutputError("holds another campaign", place=str(folder), cure="choose another output folder")
    share_out(pool, job.need, job.name)
    mine = [task for task in job.tasks if task.number % of == which - 1]
    path = folder / f"jobs.{which}-of-{of}.sqlite"
    try:
        log = Log(path)
        rows = {row.number: row for row in log.rows()}
    except InputError:
        discard(path)
        log, rows = Log(path), {}
    with contextlib.closing(log):
        log.begin((task.number, task.samples) for task in mine)
        missing = []
        for task in mine:
            digest = parts.digest_of(product_path(folder, task), task.key)
            if digest is None:
                missing.append(task)
            elif task.number not in rows or rows[task.number].state != "done":
                log.done(task.number, "", 0.0, digest)
        log.put_off(task.number for task in missing)
        theirs = [readable(path) for path in sorted(folder.glob("jobs.*-of-*.sqlite"))]
        result, failed = _flow(job, folder, log, pool, _watch(job.same_machine, folder, theirs, say), missing)
    _tell(result, say)
    _fail(folder, failed, len(mine))
    return result


def check_unchanged(job: Job, folder: Path, anyway: bool) -> None:
    """Refuse to go on with another zonda or other files than at the beginning."""
    from zonda import __version__

    reasons = []
    if job.version != __version__:
        reasons.append(f"it began with zonda {job.version}, this is {__version__}")
    for path, text in zip(sources_of(job, folder), job.source, strict=True):
        if not path.is_file() or digest_of_text(path.read_text(encoding="utf-8", errors="replace")) != digest_of_text(text):
            reasons.append(f"{path} is not what it was")
    reasons += [f"{path} has changed or is gone" for path in changed(job)]
    if reasons and not anyway:
        raise InputError(
            "; ".join(reasons),
            place=str(folder),
            cure="the maps would be of two kinds: run the campaign anew in another folder, or go on all the same with --anyway",
        )


# ---- tasks


def _watch(strict: bool, folder: Path, logs: Iterable[Iterable[Row]], say: Say) -> Watch:
    known = {row.number: row.machine for rows in logs for row in rows if row.machine}
    return Watch(known, strict, folder, say)


def _work(job: Job, folder: Path, log: Log, pool: Pool, watch: Watch, missing: Iterable[Task]) -> Result:
    """Run tasks, combine what is complete, remove partial products."""
    result, failed = _flow(job, folder, log, pool, watch, list(missing))
    if result.tasks:
        _tell(result, watch.say)
    incomplete = {row.number for row in log.rows() if row.state != "done"}
    digests = {row.number: row.digest for row in log.rows()}
    combined = log.combined(job.layouts)
    ready = [
        number
        for number in range(len(job.combinations))
        if number not in combined and not any(t.number in incomplete for t in job.tasks_of(number))
    ]
    _combine(job, folder, log, pool, ready, digests, result)
    clean(folder)  # of workers that were killed while they wrote
    _fail(folder, failed, len(job.tasks))
    if incomplete:
        raise PipelineError(f"{len(incomplete)} tasks were not run", place=str(folder), cure=f"zonda resume {folder}")
    if not job.keep_tasks:
        shutil.rmtree(folder / TASKS, ignore_errors=True)
    return result


def _flow(job: Job, folder: Path, log: Log, pool: Pool, watch: Watch, tasks: Sequence[Task]) -> tuple[Result, dict[int, str]]:
    """Work through tasks; (what was done, errors by number).

    A broken pool is replaced. Whatever was at work when it broke is tried again at the end, one task at a time, so that one that
    kills its worker does not take others with it.
    """
    waiting, suspects = deque(tasks), deque[Task]()
    at_work: dict[Future[Outcome], Task] = {}
    attempts = dict.fromkeys((t.number for t in tasks), 0)
    claimed: set[int] = set()
    result, failed, stop = Result(folder), dict[int, str](), ""
    shown = _Progress(len(tasks), sum(t.samples for t in tasks))

    def note(task: Task, outcome: Outcome) -> None:
        nonlocal stop
        claimed.discard(task.number)
        if not outcome.error and (error := watch.meet(outcome.machine, f"task {task.number} on {outcome.host}")):
            discard(product_path(folder, task))
            outcome = replace(outcome, error=error, final=True, stop=True)
        if not outcome.error:
            log.done(task.number, outcome.host, outcome.seconds, outcome.digest, outcome.machine)
            result.tasks += 1
            result.samples += task.samples
        else:
            again = not outcome.final and attempts[task.number] <= job.retries
            log.failed(task.number, outcome.host, outcome.seconds, outcome.error, again)
            if again:
                (suspects if outcome.host == LOST else waiting).append(task)
            else:
                failed[task.number] = outcome.error
                stop = outcome.error if outcome.stop else stop
        shown.step(task.samples, bool(outcome.error))

    try:
        begin = time.monotonic()
        ended: set[Future[Outcome]] = set()
        while True:
            batch: list[Task] = []
            with log.together():
                for future in ended:
                    task = at_work.pop(future)
                    note(task, _outcome(future, task, folder))
                while waiting and not stop and len(at_work) + len(batch) < pool.workers + pool.ahead:
                    batch.append(waiting.popleft())
                if not batch and not at_work and suspects and not stop:
                    batch.append(suspects.popleft())
                claimed |= {task.number for task in batch}
                log.claim(task.number for task in batch)
            for task in batch:
                attempts[task.number] += 1
                at_work[_submit(pool, _order(job, folder, pool, task))] = task
            if not at_work:
                break
            ended, _ = wait(at_work, return_when=FIRST_COMPLETED)
            if any(isinstance(f.exception(), BrokenExecutor) for f in ended if not f.cancelled()):
                ended, _ = wait(at_work)
                if pool.remake is None:
                    raise PipelineError("the engine is gone", place=str(folder), cure=f"zonda resume {folder}")
                pool.executor = pool.remake()
        result.seconds = time.monotonic() - begin
    except BaseException:
        for future in at_work:
            future.cancel()
        with contextlib.suppress(Exception):
            log.put_off(claimed)
        if pool.stop is not None:
            pool.stop()
            clean(folder)
        raise
    finally:
        shown.end()
    return result, failed


LOST = "(lost)"
"""Host of an attempt whose worker was killed."""


def _submit(pool: Pool, order: Order) -> Future[Outcome]:
    assert pool.executor is not None
    try:
        return pool.executor.submit(perform, order)
    except Exception as err:
        future: Future[Outcome] = Future()
        future.set_exception(err if isinstance(err, BrokenExecutor) else CancelledError())  # a worker was killed; all is gone
        return future


def _order(job: Job, folder: Path, pool: Pool, task: Task) -> Order:
    from zonda import __version__

    combination = job.combinations[task.combination]
    layout = folder.resolve() / TASKS / combination.layout_file(task.combination)
    return Order(
        task, job.pipelines[task.pipeline], str(layout), combination.layout, str(folder.resolve()), pool.threads, pool.memory,
        __version__,
    )  # fmt: skip


def _outcome(future: Future[Outcome], task: Task, folder: Path) -> Outcome:
    try:
        return future.result()
    except BrokenExecutor:
        error = "its worker process was killed (by the system for want of memory?), or another one beside it"
        return Outcome(task.number, LOST, 0.0, error=error)
    except CancelledError:
        raise PipelineError("the engine is gone", place=str(folder), cure=f"zonda resume {folder}") from None
    except Exception as err:  # of the engine: a Dask worker that died again and again, a task that cannot be sent
        return Outcome(task.number, LOST, 0.0, error=f"{type(err).__name__}: {err}")


# ---- combinations


def _combine(
    job: Job, folder: Path, log: Log, pool: Pool, numbers: Sequence[int], digests: dict[int, str], result: Result
) -> None:
    """Combine on the workers too: pictures and reports take time, and memory that the main process need not hold."""
    left = deque(numbers)
    at_work: dict[Future[Combined], int] = {}
    broken = 0
    while left or at_work:
        assert pool.executor is not None
        while left and len(at_work) < pool.workers:
            number = left.popleft()
            own = {t.number: digests[t.number] for t in job.tasks_of(number)}
            try:
                at_work[pool.executor.submit(combine, str(folder.resolve()), number, own)] = number
            except BrokenExecutor:
                left.appendleft(number)
                break
        ended, _ = wait(at_work, return_when=FIRST_COMPLETED) if at_work else (set(), None)
        if not at_work or any(isinstance(f.exception(), BrokenExecutor) for f in ended if not f.cancelled()):
            broken += 1
            if pool.remake is None or broken > job.retries + 1:
                cure = f"give it more memory, then zonda resume {folder}"
                raise PipelineError("the worker that combined the maps was killed", place=str(folder), cure=cure)
            wait(at_work)
            left.extendleft(number for future, number in at_work.items() if future.exception() is not None)
            done = {f: n for f, n in at_work.items() if f.exception() is None}
            pool.executor = pool.remake()
            at_work = done
            ended = set(done)
        for future in ended:
            number = at_work.pop(future)
            try:
                combined = future.result()
            except (Exception, CancelledError) as err:
                if not engine_failed(err):
                    raise
                raise PipelineError(
                    f"the engine failed when it combined the maps: {err}", place=str(folder), cure=f"zonda resume {folder}"
                ) from None
            if combined.error is not None:
                raise combined.error
            log.combine(number, job.combinations[number].layout)
            result.tally += [(job.combinations[number].name, *row) for row in combined.tally]
            if not job.keep_tasks:
                for task in job.tasks_of(number):
                    discard(product_path(folder, task))


# ---- what is said


class _Progress:
    """Tells the hooks how far it is."""

    def __init__(self, total: int, samples: int) -> None:
        from ..hooks import manager

        self._hook = manager().hook
        self._total, self._samples, self._begin = total, samples, time.monotonic()
        self._done, self._made, self._failed = 0, 0, 0

    def step(self, samples: int, failed: bool) -> None:
        """One attempt more."""
        if failed:
            self._failed += 1
        else:
            self._done, self._made = self._done + 1, self._made + samples
        self._hook.zonda_campaign_progress(
            done=self._done, total=self._total, failed=self._failed, samples=self._made, all_samples=self._samples,
            seconds=time.monotonic() - self._begin,
        )  # fmt: skip

    def end(self) -> None:
        """No more is coming."""
        self._hook.zonda_campaign_end()


def _progress() -> Callable[[int, int, str], None]:
    from ..hooks import manager

    hook = manager().hook
    return lambda done, total, what: hook.zonda_progress(done=done, total=total, what=what)


def _describe(job: Job, folder: Path, say: Say) -> None:
    entries = len({task.entry for task in job.tasks})
    counts = [
        "1 entry" if entries == 1 else f"{entries} entries",
        plural(len(job.tasks), "task"),
        f"{plural(len(job.combinations), 'set')} of products",
    ]
    say(f"campaign: {', '.join(counts)}, {job.samples:.3g} samples; zonda status {folder}")


def _tell(result: Result, say: Say) -> None:
    rate = result.samples / result.seconds if result.seconds else 0.0
    say(f"{plural(result.tasks, 'task')} in {result.seconds:.1f} s, {rate:.3g} samples/s")


def _fail(folder: Path, failed: dict[int, str], total: int) -> None:
    if failed:
        number, error = next(iter(sorted(failed.items())))
        last = error.strip().splitlines()[-1] if error.startswith("Traceback") else error
        raise ZondaError(
            f"{len(failed)} of {total} tasks failed; the first is {number}: {last}",
            place=str(folder),
            cure=f"zonda status {folder} lists them; zonda resume {folder} tries them again",
        )
