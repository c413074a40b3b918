"""A campaign's output folder, whose files are the state of its tasks.

A task is done if its partial product is there, or if the record of its set of products lists it;
that is written under another name and renamed before any part is removed. A task that failed has a
file `000123.failed` beside it, which says why. One more file names the tasks at work, for `zonda
status` alone.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields, replace
from pathlib import Path
from typing import Any

from ..errors import InputError, OutputError, ZondaError
from ..storage.files import discard, put, temporary_sibling, write_text, writing
from . import machines, trees
from .campaign_file import ENTRIES, FILE, INPUTS, RECORD, TASKS, Job, OtherFormat, Say, Task, plural

RESOLVED = "resolved.yaml"

TASK_FILE = re.compile(
    r"\d{6}\.(npz|failed)|layout-\d{4}\.npz|at-work.*\.json|\..*\.\d+-[0-9a-f]{8}\.part.*"
)
"""Names of files in the folder of tasks."""

PART = re.compile(r"\.\d+-[0-9a-f]{8}\.part")
"""In the names of `temporary_sibling`."""


def check_free(folder: Path) -> None:
    """Raise `OutputError` where the folder holds an unfinished campaign."""
    if (folder / FILE).exists() and not finished(folder):
        raise OutputError(
            "holds an unfinished campaign",
            place=str(folder),
            cure=f"zonda resume {folder}, remove it, or choose another folder",
        )


def check_links(folder: Path, job: Job | None = None) -> None:
    """Raise `OutputError` where a folder of the campaign, inside its output folder, is a link to
    another one.
    """
    root = folder.resolve()
    for name in _subfolders(job):
        if (root / name).resolve() != root / name:
            raise OutputError(
                "is reached through a link, and what it leads to may be somebody else's",
                place=str(folder / name),
                cure="remove the link, or choose another output folder",
            )


def _subfolders(job: Job | None) -> Iterator[str]:
    """Names of the folders that a campaign writes to, inside its output folder ('')."""
    yield from ("", TASKS, ENTRIES, INPUTS)
    if job is not None:
        yield from (combination.folder for combination in job.combinations)
        yield from (f"{ENTRIES}/{k:06d}" for k in range(len(job.entries)))


def _remove_tasks(folder: Path) -> None:
    """Remove the files of tasks, and their folder unless it holds others."""
    check_links(folder)
    for path in (folder / TASKS).glob("*"):
        if TASK_FILE.fullmatch(path.name):
            discard(path)
    with contextlib.suppress(OSError):
        (folder / TASKS).rmdir()


def make_way(folder: Path, job: Job | None = None) -> None:
    """Delete the files of an earlier campaign except its products, and the task records that
    ``job`` will write anew. The caller holds the folder's lock.
    """
    records = [job.record(folder, number) for number in range(len(job.combinations))] if job else []
    for old in (folder / FILE, folder / RECORD, *records):
        old.unlink(missing_ok=True)
    if job is None:
        _remove_tasks(folder)


def finished(folder: Path) -> bool:
    """True if all products of the campaign in a folder are written. Raises `OtherFormat`."""
    try:
        job = Job.read(folder)
        return len(Record(job, folder).combined) == len(job.combinations)
    except OtherFormat:
        raise
    except ZondaError:
        return False


def publish(job: Job, folder: Path) -> None:
    """Write the campaign's file unless another job of an array was first."""
    draft = temporary_sibling(folder / FILE).with_suffix("")
    draft.mkdir()
    try:
        job.write(draft)
        try:
            os.link(draft / FILE, folder / FILE)
        except FileExistsError:
            pass
        except OSError:  # no hard links here
            if not (folder / FILE).exists():
                os.replace(draft / FILE, folder / FILE)
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def clean(folder: Path, job: Job) -> None:
    """Remove temporary files that killed workers left in the folders of a campaign: other folders
    there may be those of runs at work. No worker may be active there.
    """
    found = [path for name in _subfolders(job) for path in (folder / name).glob(".*.part*")]
    for path in [path for path in found if PART.search(path.name)]:
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            discard(path)


def sources_of(job: Job, folder: Path) -> list[Path]:
    """Files that keep the campaign's pipeline files, resolved, one for each."""
    if len(job.source) == 1:
        return [folder / RESOLVED]
    return [folder / f"resolved-{k}.yaml" for k in range(1, len(job.source) + 1)]


def write_sources(job: Job, folder: Path) -> None:
    """Write the campaign's pipeline files, resolved, into its output folder."""
    for path, text in zip(sources_of(job, folder), job.source, strict=True):
        write_text(path, text)


STATES = ("waiting", "claimed", "done", "failed")
AT_WORK = "at-work{share}.json"


@dataclass(frozen=True)
class TaskRow:
    """The state of a task.

    Attributes
    ----------
    attempts
        Number of times it was begun since the campaign began or was resumed.
    error
        Of the last attempt that failed, also where a later one succeeded.
    machine
        The machine and libraries of the attempt that succeeded (`machines.here`); empty: unknown.
    """

    number: int
    state: str = "waiting"
    attempts: int = 0
    error: str = ""
    host: str = ""
    seconds: float = 0.0
    machine: str = ""


COLUMNS = tuple(column.name for column in fields(TaskRow))


class Record:
    """The file that says which tasks of a campaign are done or failed.

    Parameters
    ----------
    share
        Of a job of an array, to tell its file of tasks at work from those of others.

    Attributes
    ----------
    done
        Rows of the tasks that are known to be done, by number.
    combined
        Combinations whose products are written: what was kept of each when it was combined.
    """

    def __init__(self, job: Job, folder: Path, share: str = "") -> None:
        self.job = job
        self.folder = folder
        self.done: dict[int, TaskRow] = {}
        self.combined: dict[int, Any] = {}
        self._path = folder / TASKS / AT_WORK.format(share=share)
        self._at_work: set[int] = set()
        self._attempts = Counter[int]()
        for number in range(len(job.combinations)):
            try:
                tree = trees.read(job.record(folder, number), job.identity(number))
                rows = [dict(zip(COLUMNS, row, strict=True)) for row in tree["tasks"]]
                found = [
                    TaskRow(**row | {"machine": tree["machines"][row["machine"]]}) for row in rows
                ]
                self.combined[number] = tree["figures"]
                self.done |= {row.number: row for row in found}
            except (InputError, KeyError, TypeError, IndexError, ValueError):
                continue  # missing or damaged: its tasks are done again

    def rows(self) -> Iterator[TaskRow]:
        """The state of every task, in order."""
        at_work = _at_work(self.folder)
        for task in self.job.tasks:
            yield self.done.get(task.number) or _row(task, self.folder, task.number in at_work)

    def claim(self, numbers: Iterable[int]) -> None:
        """Record that tasks are given to workers."""
        numbers = list(numbers)
        if numbers:
            self._attempts.update(numbers)
            self._at_work |= set(numbers)
            self._write()

    def succeeded(self, task: Task, host: str, seconds: float, machine: str) -> None:
        """Record that a task's product is complete."""
        self._at_work.discard(task.number)
        attempts = self._attempts[task.number]
        error = _failure(task, self.folder).error
        self.done[task.number] = TaskRow(
            task.number,
            "done",
            attempts,
            error,
            host,
            seconds,
            machine,
        )

    def failed(self, task: Task, host: str, seconds: float, error: str, again: bool) -> None:
        """Record that an attempt failed; ``again``: another one follows."""
        self._at_work.discard(task.number)
        state = "waiting" if again else "failed"
        row = TaskRow(task.number, state, self._attempts[task.number], error, host, seconds)
        write_text(_failed_path(task, self.folder), json.dumps(asdict(row)))
        self._write()

    def put_off(self, tasks: Iterable[Task] = ()) -> None:
        """Mark tasks at work as waiting; give ``tasks`` all their attempts again."""
        for task in tasks:
            discard(_failed_path(task, self.folder))
        self._at_work.clear()
        self._write()

    def combine(self, number: int, figures: Any) -> None:
        """Record that a combination's products are written, and the figures measured of them."""
        rows = [self.done[task.number] for task in self.job.tasks_of[number]]
        made_on = list(dict.fromkeys(row.machine for row in rows))
        table = [(*astuple(row)[:-1], made_on.index(row.machine)) for row in rows]
        tree = {"machines": made_on, "tasks": table, "figures": figures}
        trees.write(self.job.record(self.folder, number), self.job.identity(number), tree)
        self.combined[number] = figures

    def finish(self) -> None:
        """Remove the folder of partial products: all combinations are written."""
        if not self.job.keep_tasks:
            _remove_tasks(self.folder)

    def discard_partials(self, number: int) -> None:
        """Remove the partial products of a combination."""
        for task in self.job.tasks_of[number]:
            discard(task.path(self.folder))
            discard(_failed_path(task, self.folder))

    def verify(self, tasks: Sequence[Task], say: Say, same_machine: bool) -> list[Task]:
        """Read the products of tasks, and return the tasks whose products are missing or damaged.

        ``same_machine``: products of another kind of machine than the first task's are removed.
        """
        found: list[tuple[Task, TaskRow]] = []
        missing = []
        damaged = 0
        strange = 0
        for task in tasks:
            path = task.path(self.folder)
            try:
                trees.read(path, task.key)
                found.append((task, done_row(task, self.folder)))
            except InputError:
                missing.append(task)
                damaged += path.exists()
        known = sorted((row for row in self.rows() if row.machine), key=lambda row: row.number)
        first = next(filter(None, (machines.kind(row.machine) for row in known)), None)
        for task, row in found:
            if same_machine and machines.kind(row.machine) not in (first, frozenset()):
                discard(task.path(self.folder))
                missing.append(task)
                strange += 1
            else:
                self.done[task.number] = row
        self.put_off(missing)
        if strange:
            say(
                f"{plural(strange, 'task')} ran on another kind of machine than the first: run"
                " again"
            )
        if damaged:
            say(f"{plural(damaged, 'partial product')} damaged: run again")
        return sorted(missing, key=lambda task: task.number)

    def _write(self) -> None:
        with writing(self._path):
            put(self._path, json.dumps(sorted(self._at_work)).encode())


def done_row(task: Task, folder: Path) -> TaskRow:
    """The row of a task whose partial product is there. Raises `InputError` where it is not, or its
    head is damaged.
    """
    made = trees.head(task.path(folder), task.key)
    failure = _failure(task, folder)
    try:
        host = str(made["host"])
        seconds = float(made["seconds"])
        machine = str(made["machine"])
    except (KeyError, TypeError, ValueError) as err:
        raise InputError(f"cannot be used: {err}", place=str(task.path(folder))) from None
    attempts = failure.attempts + 1
    return TaskRow(task.number, "done", attempts, failure.error, host, seconds, machine)


def _row(task: Task, folder: Path, at_work: bool) -> TaskRow:
    """The state of a task whose combination is not finished."""
    try:
        return done_row(task, folder)
    except InputError:
        row = _failure(task, folder)
    if at_work:
        return replace(row, state="claimed", attempts=row.attempts + 1)
    return row


def _failure(task: Task, folder: Path) -> TaskRow:
    """Row of the last failed attempt of a task; that of a waiting task if none failed."""
    try:
        found: Mapping[str, Any] = json.loads(
            _failed_path(task, folder).read_text(encoding="utf-8")
        )
        state = "failed" if found["state"] == "failed" else "waiting"
        error = str(found["error"])
        host = str(found["host"])
        attempts = int(found["attempts"])
        seconds = float(found["seconds"])
        return TaskRow(task.number, state, attempts, error, host, seconds)
    except (OSError, ValueError, TypeError, KeyError):
        return TaskRow(task.number)


def _at_work(folder: Path) -> set[int]:
    """Tasks at work, of all main processes."""
    found: set[int] = set()
    for path in (folder / TASKS).glob(AT_WORK.format(share="*")):
        try:
            found.update(int(number) for number in json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            continue
    return found


def _failed_path(task: Task, folder: Path) -> Path:
    return task.path(folder).with_suffix(".failed")
