"""A campaign's output folder, whose files are the state of its tasks.

A task is done if its partial product is there, or if the record of its combination lists it; that
is written under another name and renamed before any part is removed, and all of them become one
file when the campaign is finished. A task that failed has a file `000123.failed` beside it, which
says why. One more file names the tasks at work, for `zonda status` alone.
"""

from __future__ import annotations

import json
import os
import re
import shutil
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, astuple, dataclass, fields
from pathlib import Path

from ..errors import InputError, OutputError, ZondaError
from ..storage.files import discard, put, temporary_sibling, write_text, writing
from . import machines, parts
from .campaign_file import FILE, TASKS, Job, OtherFormat, Say, Task, digest_of_text, plural

RESOLVED = "resolved.yaml"

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


def make_way(folder: Path) -> None:
    """Remove what an earlier campaign left besides its products. The caller holds the folder's
    lock.
    """
    for old in (folder / FILE, folder / FINISHED):
        old.unlink(missing_ok=True)
    shutil.rmtree(folder / TASKS, ignore_errors=True)


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


def verify(record: Record, tasks: Sequence[Task], say: Say, same_machine: bool) -> list[Task]:
    """Read the products of tasks, and return the tasks whose products are missing or damaged.

    ``same_machine``: products of another kind of machine than the first task's are removed.
    """
    found, missing, damaged, strange = [], [], 0, 0
    for task in tasks:
        path = task.path(record.folder)
        try:
            parts.read(path, task.key)
            row = done_row(task, record.folder)
        except InputError:
            row = None
        if row is None:
            missing.append(task)
            damaged += path.exists()
        else:
            found.append((task, row))
    known = sorted((row for row in record.rows() if row.machine), key=lambda row: row.number)
    first = next(filter(None, (machines.kind(row.machine) for row in known)), None)
    for task, row in found:
        if same_machine and machines.kind(row.machine) not in (first, frozenset()):
            discard(task.path(record.folder))
            missing.append(task)
            strange += 1
        else:
            record.known(row)
    record.reset(missing)
    if strange:
        say(f"{plural(strange, 'task')} ran on another kind of machine than the first: run again")
    if damaged:
        say(f"{plural(damaged, 'partial product')} damaged: run again")
    return sorted(missing, key=lambda task: task.number)


def clean(folder: Path) -> None:
    """Remove temporary files that killed workers left anywhere in the folder. No worker may be
    active there.
    """
    for path in [p for p in folder.rglob(".*.part*") if PART.search(p.name)]:
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
FINISHED = "tasks.npz"
"""Record of all tasks of a campaign that is finished."""


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
    """The state of tasks, as one main process reads and writes it.

    Parameters
    ----------
    share
        Of a job of an array, to tell its file of tasks at work from those of others.
    """

    def __init__(self, job: Job, folder: Path, share: str = "") -> None:
        self.job, self.folder = job, folder
        self._path = folder / TASKS / AT_WORK.format(share=share)
        self._at_work: set[int] = set()
        self._attempts = Counter[int]()
        self._done: dict[int, TaskRow] = {}
        self._combined: dict[int, dict[int, TaskRow]] = {}
        whole = _read_rows(folder / FINISHED, _identity(job))
        wanted: dict[int, set[int]] = {}
        for task in job.tasks:
            wanted.setdefault(task.combination, set()).add(task.number)
        for number, tasks in wanted.items():
            path, layout = _combined_path(folder, number), job.combinations[number].layout
            found = {n: whole[n] for n in tasks if n in whole} or _read_rows(path, layout)
            if found.keys() == tasks:
                self._combined[number] = found

    @property
    def complete(self) -> set[int]:
        """Numbers of the tasks that are known to be done."""
        return set(self._done).union(*self._combined.values())

    @property
    def combined(self) -> set[int]:
        """Combinations whose products are written."""
        return set(self._combined)

    def rows(self) -> Iterator[TaskRow]:
        """The state of every task, in order."""
        at_work = _at_work(self.folder)
        for task in self.job.tasks:
            known = self._combined.get(task.combination, self._done).get(task.number)
            yield known or _row(task, self.folder, at_work)

    def known(self, row: TaskRow) -> None:
        """Take in a task that is done."""
        self._done[row.number] = row

    def claim(self, numbers: Iterable[int]) -> None:
        """Record that tasks are given to workers."""
        numbers = list(numbers)
        if numbers:
            self._attempts.update(numbers)
            self._at_work |= set(numbers)
            self._write()

    def done(self, task: Task, host: str, seconds: float, machine: str) -> None:
        """Record that a task's product is complete."""
        self._at_work.discard(task.number)
        error, _ = _failure(task, self.folder)
        attempts = self._attempts[task.number]
        self.known(TaskRow(task.number, "done", attempts, error, host, seconds, machine))

    def failed(self, task: Task, host: str, seconds: float, error: str, again: bool) -> None:
        """Record that an attempt failed; ``again``: another one follows."""
        self._at_work.discard(task.number)
        state = "waiting" if again else "failed"
        row = TaskRow(task.number, state, self._attempts[task.number], error, host, seconds)
        write_text(_failed_path(task, self.folder), json.dumps(asdict(row)))
        self._write()

    def put_off(self) -> None:
        """Tasks at work wait again."""
        self._at_work.clear()
        self._write()

    def reset(self, tasks: Iterable[Task]) -> None:
        """Tasks wait again, with all their attempts before them."""
        for task in tasks:
            discard(_failed_path(task, self.folder))
        self.put_off()

    def combine(self, number: int) -> None:
        """Record that a combination's products are written."""
        found = {task.number: self._done[task.number] for task in self.job.tasks_of(number)}
        layout = self.job.combinations[number].layout
        _write_rows(_combined_path(self.folder, number), layout, found)
        self._combined[number] = found

    def finish(self) -> None:
        """Record that all combinations are written, and remove the folder of partial products."""
        rows = {n: row for found in self._combined.values() for n, row in found.items()}
        _write_rows(self.folder / FINISHED, _identity(self.job), rows)
        if not self.job.keep_tasks:
            shutil.rmtree(self.folder / TASKS, ignore_errors=True)

    def discard_parts(self, number: int) -> None:
        """Remove the partial products of a combination."""
        for task in self.job.tasks_of(number):
            discard(task.path(self.folder))
            discard(_failed_path(task, self.folder))

    def _write(self) -> None:
        with writing(self._path):
            put(self._path, json.dumps(sorted(self._at_work)).encode())


def done_row(task: Task, folder: Path) -> TaskRow | None:
    """The row of a task whose partial product is there; None: it is not, or its head is damaged."""
    try:
        made = parts.head(task.path(folder), task.key)
        host, seconds, machine = str(made["host"]), float(made["seconds"]), str(made["machine"])
    except (InputError, KeyError, TypeError, ValueError):
        return None
    error, attempts = _failure(task, folder)
    return TaskRow(task.number, "done", attempts + 1, error, host, seconds, machine)


def _row(task: Task, folder: Path, at_work: set[int]) -> TaskRow:
    """The state of a task whose combination is not finished."""
    if (row := done_row(task, folder)) is not None:
        return row
    state = "claimed" if task.number in at_work else "waiting"
    try:
        found = json.loads(_failed_path(task, folder).read_text(encoding="utf-8"))
        row = TaskRow(**found)
        attempts, seconds = int(row.attempts), float(row.seconds)
    except (OSError, ValueError, TypeError):
        return TaskRow(task.number, state, int(state == "claimed"))
    return TaskRow(
        task.number,
        "failed" if row.state == "failed" and state != "claimed" else state,
        attempts + (state == "claimed"),
        str(row.error),
        str(row.host),
        seconds,
    )


def _failure(task: Task, folder: Path) -> tuple[str, int]:
    """Error of the last attempt that failed, and the number of attempts up to it."""
    if not _failed_path(task, folder).exists():
        return "", 0
    row = _row(task, folder, set())
    return row.error, row.attempts


def _write_rows(path: Path, identity: str, rows: Mapping[int, TaskRow]) -> None:
    machines = list(dict.fromkeys(row.machine for row in rows.values()))
    table = [(*astuple(row)[:-1], machines.index(row.machine)) for row in rows.values()]
    parts.write(path, identity, {"machines": machines, "tasks": table})


def _read_rows(path: Path, identity: str) -> dict[int, TaskRow]:
    """Tasks that a file lists, by number; none if it is missing or damaged."""
    try:
        tree = parts.read(path, identity)
        table = [dict(zip(COLUMNS, row, strict=True)) for row in tree["tasks"]]
        rows = [TaskRow(**{**row, "machine": tree["machines"][row["machine"]]}) for row in table]
    except (InputError, KeyError, TypeError, IndexError, ValueError):
        return {}
    return {row.number: row for row in rows}


def _identity(job: Job) -> str:
    """Identity of a whole campaign: of all its tasks."""
    return digest_of_text("".join(task.key for task in job.tasks))


def _at_work(folder: Path) -> set[int]:
    """Tasks at work, of all main processes."""
    found: set[int] = set()
    for path in (folder / TASKS).glob(AT_WORK.format(share="*")):
        try:
            found.update(int(number) for number in json.loads(path.read_text(encoding="utf-8")))
        except (OSError, ValueError, TypeError):
            continue
    return found


def _combined_path(folder: Path, number: int) -> Path:
    return folder / TASKS / f"combined-{number:04d}.npz"


def _failed_path(task: Task, folder: Path) -> Path:
    return task.path(folder).with_suffix(".failed")
